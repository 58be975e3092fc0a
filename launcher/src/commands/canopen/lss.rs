//! `dinrail canopen lss`: through the canopen-master of the bus, or, where the bus has none, as LSS master for as long
//! as the command runs.

use super::super::{UsageError, println};
use super::bus::Bus;
use super::{AddressArgs, BusArgs, LssCommand, Range};
use crate::supervise::client::{find, observe};
use crate::supervise::jobs::{JobLine, choose};
use dinrail_canopen::master::lss::{LssCall, LssLine, LssOutcome};
use dinrail_canopen::protocol::io::Outbox;
use dinrail_canopen::protocol::lss::LssAddress;
use dinrail_canopen::protocol::lss::master::FastscanHint;
use ipc_types::topic::TopicKind;
use ipc_types::{Context, clock};
use serde_json::{Value, json};
use std::time::Duration;

const KIND: &str = "canopen-master";
/// A fastscan asks up to 132 questions, and other LSS jobs may be before it.
const LIMIT: Duration = Duration::from_mins(10);

/// Who speaks on the bus.
enum Line {
    Master(Box<JobLine>),
    Own(Box<Bus>, Box<LssLine>),
}

/// The canopen-master of a bus, if it has one.
fn master_of(ctx: &Context, bus: &str) -> Option<String> {
    let rx = TopicKind::CanRx.of(bus);
    let masters = ctx.stack.services.iter().filter(|s| s.kind == KIND);
    masters.filter(|s| s.wiring.reads.iter().any(|r| r.topic == rx)).map(|s| s.name.clone()).next()
}

impl Line {
    fn open(args: &BusArgs, direct: bool) -> anyhow::Result<Self> {
        let running = find(args.which.stack.as_deref())?;
        let mut ctx = observe(&running)?;
        let bus = choose(&ctx, "can", args.bus.as_deref())?;
        match master_of(&ctx, &bus).filter(|_| !direct) {
            Some(master) => Ok(Self::Master(Box::new(JobLine::open(&mut ctx, running, KIND, &master)?))),
            None => {
                drop(ctx);
                Ok(Self::Own(Box::new(Bus::open(args)?), Box::default()))
            }
        }
    }

    /// One call, to its end.
    fn call(&mut self, call: &LssCall) -> anyhow::Result<Value> {
        call.check().map_err(UsageError)?;
        match self {
            Self::Master(line) => {
                let mut job = serde_json::to_value(call)?;
                job["do"] = json!("lss");
                Ok(line.ask(&job, LIMIT)?)
            }
            Self::Own(bus, line) => Ok(carry_out(bus, line, call)?.result?),
        }
    }
}

fn carry_out(bus: &mut Bus, line: &mut LssLine, call: &LssCall) -> anyhow::Result<LssOutcome> {
    let mut out = Outbox::default();
    let now_ns = clock::mono_ns();
    if let Err(outcome) = line.start(now_ns, call.clone(), now_ns + LIMIT.as_nanos() as u64) {
        return Ok(outcome);
    }
    loop {
        let mut end = line.on_time(clock::mono_ns(), &mut out);
        bus.send(&mut out)?;
        if end.is_none() {
            bus.take(|t_ns, frame| {
                if end.is_none() {
                    end = line.on_frame(t_ns, frame);
                }
            });
        }
        if let Some(end) = end {
            return Ok(end);
        }
    }
}

fn address(args: &AddressArgs) -> Option<LssAddress> {
    let AddressArgs { vendor, product, revision, serial, .. } = *args;
    Some(LssAddress { vendor: vendor?, product: product?, revision: revision?, serial: serial? })
}

pub fn run(command: LssCommand, as_json: bool) -> anyhow::Result<()> {
    let (bus, direct, call) = match command {
        LssCommand::Fastscan { from, store, timeout, bus, direct } => {
            return fastscan(&mut Line::open(&bus, direct)?, from, store, timeout, as_json);
        }
        LssCommand::SetNodeId { node, address: args, store, bus, direct } => {
            (bus, direct, LssCall::SetNodeId { node_id: node, address: address(&args), store })
        }
        LssCommand::SetBitrate { kbit, address: args, store, activate, bus, direct } => {
            let address = address(&args);
            (bus, direct, LssCall::SetBitrate { kbit, address, store, activate_ms: activate })
        }
        LssCommand::Inquire { address: args, bus, direct } => {
            (bus, direct, LssCall::InquireDevice { address: address(&args) })
        }
        LssCommand::Identify { vendor, product, revision, serial, bus, direct } => {
            let call = match (vendor, product) {
                (Some(vendor), Some(product)) => {
                    LssCall::Identify { vendor, product, revision: revision.0, serial: serial.0 }
                }
                _ => LssCall::IdentifyNonConfigured {},
            };
            (bus, direct, call)
        }
        LssCommand::Switch { state, bus, direct } => {
            (bus, direct, LssCall::SwitchGlobal { state: state.state() })
        }
        LssCommand::Activate { delay, bus, direct } => {
            (bus, direct, LssCall::ActivateBitTiming { delay_ms: delay })
        }
    };
    let value = Line::open(&bus, direct)?.call(&call)?;
    println(&if as_json { value.to_string() } else { text(&call, &value) });
    Ok(())
}

/// What came of a call, in words.
fn text(call: &LssCall, value: &Value) -> String {
    match call {
        LssCall::SetNodeId { node_id: 255, .. } => "the device has no node-id now".to_owned(),
        LssCall::SetNodeId { node_id, .. } => format!("the device has node-id {node_id} now"),
        LssCall::SetBitrate { kbit, activate_ms: None, .. } => {
            format!("the device has {kbit} kbit/s from its next start on")
        }
        LssCall::SetBitrate { kbit, .. } => format!("the device changes over to {kbit} kbit/s"),
        LssCall::InquireDevice { .. } => {
            let node = match value["node_id"].as_u64() {
                Some(node) => format!("it has node-id {node}"),
                None => "it has no node-id".to_owned(),
            };
            format!("{}\n{node}", identity(value))
        }
        LssCall::Identify { .. } if value["answered"] == json!(true) => {
            "at least one such device answers".to_owned()
        }
        LssCall::Identify { .. } => "no such device answers".to_owned(),
        LssCall::IdentifyNonConfigured {} if value["answered"] == json!(true) => {
            "at least one device without node-id answers".to_owned()
        }
        LssCall::IdentifyNonConfigured {} => "no device without node-id answers".to_owned(),
        _ => "sent".to_owned(),
    }
}

fn identity(value: &Value) -> String {
    let part = |key: &str| value[key].as_u64().unwrap_or(0);
    format!(
        "vendor {:#010X}  product {:#010X}  revision {:#010X}  serial {:#010X}",
        part("vendor"),
        part("product"),
        part("revision"),
        part("serial")
    )
}

/// One device after the other, so that each is seen when it is found.
fn fastscan(
    line: &mut Line,
    from: Option<u8>,
    store: bool,
    timeout_ms: Option<u16>,
    as_json: bool,
) -> anyhow::Result<()> {
    let mut all: Vec<Value> = Vec::new();
    let mut next = from;
    loop {
        let call = match next {
            Some(from) if from <= 127 => LssCall::Assign { from, store, max: 1, timeout_ms },
            // Behind 127 there is no node-id: whether a device is left is still worth knowing.
            _ => LssCall::Fastscan { hint: FastscanHint::default(), hold: false, timeout_ms },
        };
        let value = line.call(&call)?;
        let Some(found) = value["found"].as_array().and_then(|found| found.first()) else { break };
        anyhow::ensure!(
            next.is_none_or(|next| next <= 127),
            "no node-id is left for the device with {}",
            identity(found)
        );
        let known = all.iter().find(|f| identity(f) == identity(found));
        anyhow::ensure!(
            known.is_none(),
            "the device with {} was given a node-id and says that it has none: two devices with one identity, or a faulty one",
            identity(found)
        );
        if !as_json {
            let node = found["node_id"].as_u64().map(|node| format!("  -> node-id {node}"));
            println(&format!("{}{}", identity(found), node.unwrap_or_default()));
        }
        all.push(found.clone());
        match &mut next {
            Some(next) => *next += 1,
            // Without a node-id it would be found again and again.
            None => break,
        }
    }
    if as_json {
        println(&Value::Array(all).to_string());
    } else if all.is_empty() {
        println("no device without node-id answers");
    } else if from.is_none() {
        println("one of the devices without node-id; --from NODE gives all of them node-ids");
    }
    Ok(())
}

/// `7`, `1..9`, in decimal or hex.
pub fn range(text: &str) -> Result<Range, String> {
    let (low, high) = text.split_once("..").unwrap_or((text, text));
    let (low, high) = (super::number(low.trim())?, super::number(high.trim())?);
    if low > high {
        return Err(format!("{text}: the first bound is above the second"));
    }
    Ok(Range((low, high)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn results_are_sentences() {
        let node = json!({ "vendor": 1, "product": 2, "revision": 3, "serial": 0x1234, "node_id": null });
        let inquiry = text(&LssCall::InquireDevice { address: None }, &node);
        insta::assert_snapshot!(inquiry, @r"
        vendor 0x00000001  product 0x00000002  revision 0x00000003  serial 0x00001234
        it has no node-id
        ");
        let identify = LssCall::IdentifyNonConfigured {};
        assert_eq!(text(&identify, &json!({ "answered": false })), "no device without node-id answers");
    }

    #[test]
    fn ranges_are_read_and_refused() {
        let bounds = |text| range(text).map(|r| r.0);
        assert_eq!(bounds("7"), Ok((7, 7)));
        assert_eq!(bounds("0x10 .. 32"), Ok((16, 32)));
        assert!(bounds("9..1").is_err() && bounds("x").is_err());
    }
}
