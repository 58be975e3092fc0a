//! `dinrail canopen lss`: this command is the LSS master for as long as it runs.

use super::super::{UsageError, println};
use super::bus::Bus;
use super::{AddressArgs, BusArgs, LssCommand};
use dinrail_canopen::protocol::io::Outbox;
use dinrail_canopen::protocol::lss::master::{
    FastscanHint, Inquiry, LssMaster, LssRequest, LssResult, LssTimes,
};
use dinrail_canopen::protocol::lss::{BIT_TIMING_KBIT, LssAddress, LssState};
use ipc_types::clock;
use serde_json::{Value, json};

/// Lost frames of a fastscan are made good by another one.
const SCAN_TRIES: u32 = 3;

struct Line {
    bus: Bus,
    master: LssMaster,
}

impl Line {
    fn open(args: &BusArgs) -> anyhow::Result<Self> {
        Ok(Self { bus: Bus::open(args)?, master: LssMaster::new(LssTimes::default()) })
    }

    /// One service, to its end.
    fn ask(&mut self, request: LssRequest) -> anyhow::Result<LssResult> {
        let mut out = Outbox::default();
        self.master.start(clock::mono_ns(), request)?;
        loop {
            if let Some(result) = self.master.on_time(clock::mono_ns(), &mut out) {
                self.bus.send(&mut out)?;
                return Ok(result);
            }
            self.bus.send(&mut out)?;
            let (master, mut result) = (&mut self.master, None);
            self.bus.take(|t_ns, frame| {
                if result.is_none() {
                    result = master.on_frame(t_ns, frame);
                }
            });
            if let Some(result) = result {
                return Ok(result);
            }
        }
    }

    /// A service of the one device in configuration, whose refusal is an error.
    fn must(&mut self, request: LssRequest, what: &str) -> anyhow::Result<LssResult> {
        match self.ask(request)? {
            LssResult::Nobody => anyhow::bail!("{what}: the device did not answer"),
            LssResult::Lost => anyhow::bail!("{what}: frames were lost; try again"),
            LssResult::Refused { code, specific } => {
                let why = match code {
                    1 => "out of range, or not supported by it".to_owned(),
                    0xFF => format!("its own error {specific}"),
                    other => format!("error {other}"),
                };
                anyhow::bail!("{what}: the device refused: {why}")
            }
            good => Ok(good),
        }
    }

    /// Leaves all devices as they work.
    fn wait_state(&mut self) -> anyhow::Result<()> {
        self.ask(LssRequest::SwitchGlobal(LssState::Waiting)).map(|_| ())
    }

    fn select(&mut self, address: &AddressArgs) -> anyhow::Result<()> {
        let AddressArgs { vendor, product, revision, serial } = *address;
        let address = LssAddress { vendor, product, revision, serial };
        match self.ask(LssRequest::SwitchSelective(address))? {
            LssResult::Done => Ok(()),
            _ => anyhow::bail!(
                "no device has vendor {vendor:#010X}, product {product:#010X}, revision {revision:#010X}, serial {serial:#010X}: is it powered, and does it support LSS?"
            ),
        }
    }
}

pub fn run(command: LssCommand, as_json: bool) -> anyhow::Result<()> {
    match command {
        LssCommand::Fastscan { from, store, bus } => fastscan(&bus, from, store, as_json),
        LssCommand::SetNodeId { node, address, store, bus } => {
            let mut line = Line::open(&bus)?;
            line.select(&address)?;
            line.must(LssRequest::ConfigureNodeId(node), "setting the node-id")?;
            if store {
                line.must(LssRequest::Store, "storing")?;
            }
            line.wait_state()?;
            told(as_json, &json!({ "node_id": node }), &format!("the device has node-id {node} now"));
            Ok(())
        }
        LssCommand::SetBitrate { kbit, address, store, activate, bus } => {
            let index = BIT_TIMING_KBIT.iter().position(|&k| k == kbit && k != 0).ok_or_else(|| {
                UsageError(format!(
                    "LSS has no bit rate of {kbit} kbit/s; it has 10, 20, 50, 125, 250, 500, 800, 1000"
                ))
            })?;
            let mut line = Line::open(&bus)?;
            line.select(&address)?;
            line.must(LssRequest::ConfigureBitTiming(index as u8), "setting the bit rate")?;
            if store {
                line.must(LssRequest::Store, "storing")?;
            }
            if let Some(delay_ms) = activate {
                line.ask(LssRequest::ActivateBitTiming { delay_ms })?;
            }
            line.wait_state()?;
            told(
                as_json,
                &json!({ "kbit": kbit }),
                &format!("the device has {kbit} kbit/s from its next start on"),
            );
            Ok(())
        }
        LssCommand::Inquire { address, bus } => {
            let mut line = Line::open(&bus)?;
            line.select(&address)?;
            let result = line.must(LssRequest::Inquire(Inquiry::NodeId), "asking for the node-id")?;
            line.wait_state()?;
            let node = match result {
                LssResult::Value(node) => node,
                _ => anyhow::bail!("the device gave no node-id"),
            };
            let text =
                if node == 0xFF { "it has no node-id".to_owned() } else { format!("it has node-id {node}") };
            told(as_json, &json!({ "node_id": node }), &text);
            Ok(())
        }
    }
}

fn fastscan(bus: &BusArgs, from: Option<u8>, store: bool, as_json: bool) -> anyhow::Result<()> {
    let mut line = Line::open(bus)?;
    let mut found = Vec::new();
    let mut next = from;
    let mut lost = 0;
    loop {
        let address = match line.ask(LssRequest::Fastscan(FastscanHint::default()))? {
            LssResult::Found(address) => address,
            LssResult::Lost if lost < SCAN_TRIES => {
                lost += 1;
                line.wait_state()?;
                continue;
            }
            LssResult::Lost => {
                anyhow::bail!(
                    "devices answer, but none to its whole identity: frames are lost, or one is faulty"
                )
            }
            _ => break,
        };
        lost = 0;
        let [vendor, product, revision, serial] = address.parts();
        let mut entry =
            json!({ "vendor": vendor, "product": product, "revision": revision, "serial": serial });
        let mut text = format!(
            "vendor {vendor:#010X}  product {product:#010X}  revision {revision:#010X}  serial {serial:#010X}"
        );
        if let Some(node) = next {
            anyhow::ensure!(node <= 127, "no node-id is left for the device with serial {serial:#010X}");
            line.must(LssRequest::ConfigureNodeId(node), "setting the node-id")?;
            if store {
                line.must(LssRequest::Store, "storing")?;
            }
            entry["node_id"] = json!(node);
            text.push_str(&format!("  -> node-id {node}"));
            next = Some(node + 1);
        }
        if !as_json {
            println(&text);
        }
        found.push(entry);
        line.wait_state()?;
        // Without a node-id it would be found again and again.
        if from.is_none() {
            break;
        }
    }
    line.wait_state()?;
    if as_json {
        println(&Value::Array(found).to_string());
    } else if found.is_empty() {
        println("no device without node-id answers");
    } else if from.is_none() {
        println("one of the devices without node-id; --from NODE gives all of them node-ids");
    }
    Ok(())
}

fn told(as_json: bool, value: &Value, text: &str) {
    println(&if as_json { value.to_string() } else { text.to_owned() });
}
