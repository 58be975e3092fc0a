//! `dinrail canopen scan`: asks every node-id for its device type and identity.

use super::super::{UsageError, println, table};
use super::BusArgs;
use super::bus::Bus;
use dinrail_canopen::protocol::io::Outbox;
use dinrail_canopen::protocol::sdo::{Channel, ClientConfig, Finished, Options, SdoClient};
use ipc_types::clock;
use serde_json::{Value, json};

/// A node that is there answers within milliseconds; at 10 kbit/s a request and its answer take 26 ms.
const TIMEOUT_NS: u64 = 300_000_000;
/// Nodes asked at once: so many requests do not fill a slow bus.
const AT_ONCE: usize = 8;

/// Objects asked of a node, in order.
const OBJECTS: [(u16, u8); 6] =
    [(0x1000, 0), (0x1018, 1), (0x1018, 2), (0x1018, 3), (0x1018, 4), (0x1008, 0)];

struct Asking {
    node: u8,
    client: SdoClient,
    /// Next of [`OBJECTS`].
    next: usize,
    values: [Option<Vec<u8>>; 6],
    answered: bool,
}

impl Asking {
    fn new(node: u8) -> Self {
        let config = ClientConfig { timeout_ns: TIMEOUT_NS, ..ClientConfig::default() };
        Self {
            node,
            client: SdoClient::new(Channel::default_of(node), config),
            next: 0,
            values: Default::default(),
            answered: false,
        }
    }

    /// Asks the next object; false when there is none.
    fn ask(&mut self, now_ns: u64, out: &mut Outbox) -> bool {
        let Some((index, sub)) = OBJECTS.get(self.next) else { return false };
        self.client.start_read(now_ns, *index, *sub, Options::default(), out).is_ok()
    }

    /// True when the node is done.
    fn ended(&mut self, now_ns: u64, end: &Finished, out: &mut Outbox) -> bool {
        match end.result {
            Ok(n) => self.values[self.next] = Some(self.client.data().get(..n).unwrap_or_default().to_vec()),
            // Not there: the other objects need not be asked.
            Err(failure) if failure.is_timeout() => return true,
            Err(_) => {}
        }
        self.answered = true;
        self.next += 1;
        !self.ask(now_ns, out)
    }

    fn number(&self, which: usize) -> Option<u32> {
        let data = self.values[which].as_ref()?;
        let mut bytes = [0; 4];
        let n = data.len().min(4);
        bytes[..n].copy_from_slice(&data[..n]);
        Some(u32::from_le_bytes(bytes))
    }
}

pub fn run(args: &BusArgs, toml: bool, as_json: bool) -> anyhow::Result<()> {
    if toml && as_json {
        let both = "--json and --toml are two forms of one result: leave one of them out";
        return Err(UsageError(both.to_owned()).into());
    }
    let mut bus = Bus::open(args)?;
    let mut out = Outbox::default();
    // The master itself has no SDO server.
    let own: Vec<u8> = bus
        .stack
        .services
        .iter()
        .filter(|s| s.kind == "canopen-master")
        .filter_map(|s| s.config.get("node_id").and_then(Value::as_u64))
        .map(|id| id as u8)
        .collect();
    let mut todo = (1..=127u8).filter(|id| !own.contains(id)).rev().collect::<Vec<_>>();
    let mut running: Vec<Asking> = Vec::new();
    let mut found: Vec<Asking> = Vec::new();
    loop {
        while running.len() < AT_ONCE
            && let Some(node) = todo.pop()
        {
            let mut asking = Asking::new(node);
            asking.ask(clock::mono_ns(), &mut out);
            running.push(asking);
        }
        if running.is_empty() {
            break;
        }
        bus.send(&mut out)?;
        let mut ended = Vec::new();
        let now_ns = bus.take(|t_ns, frame| {
            for asking in &mut running {
                if let Some(end) = asking.client.on_frame(t_ns, frame, &mut out)
                    && asking.ended(t_ns, &end, &mut out)
                {
                    ended.push(asking.node);
                }
            }
        });
        for asking in &mut running {
            // Silence is no error here: an abort would only fill the bus.
            let mut unsent = Outbox::default();
            if let Some(end) = asking.client.on_time(now_ns, &mut unsent)
                && asking.ended(now_ns, &end, &mut out)
            {
                ended.push(asking.node);
            }
        }
        let mut i = 0;
        while i < running.len() {
            if ended.contains(&running[i].node) {
                let done = running.swap_remove(i);
                if done.answered {
                    found.push(done);
                }
            } else {
                i += 1;
            }
        }
    }
    found.sort_by_key(|f| f.node);
    show(&found, toml, as_json);
    Ok(())
}

fn name(found: &Asking) -> String {
    let bytes = found.values[5].clone().unwrap_or_default();
    String::from_utf8_lossy(&bytes).trim_end_matches('\0').chars().filter(|c| !c.is_control()).collect()
}

fn show(found: &[Asking], toml: bool, as_json: bool) {
    if as_json {
        let list: Vec<Value> = found
            .iter()
            .map(|f| {
                json!({
                    "id": f.node, "name": name(f), "device_type": f.number(0), "vendor_id": f.number(1),
                    "product_code": f.number(2), "revision": f.number(3), "serial_number": f.number(4),
                })
            })
            .collect();
        return println(&Value::Array(list).to_string());
    }
    if found.is_empty() {
        return println("no node answers");
    }
    if toml {
        for f in found {
            println(&toml_text(f));
        }
        return;
    }
    let hex = |n: Option<u32>| n.map_or_else(|| "-".to_owned(), |n| format!("{n:08X}h"));
    let rows: Vec<Vec<String>> = found
        .iter()
        .map(|f| {
            let mut row = vec![f.node.to_string(), name(f)];
            row.extend((0..5).map(|i| hex(f.number(i))));
            row
        })
        .collect();
    let head = ["NODE", "NAME", "DEVICE TYPE", "VENDOR", "PRODUCT", "REVISION", "SERIAL"];
    println(table(&head, &rows).trim_end());
}

fn toml_text(f: &Asking) -> String {
    let mut text = format!("[[service.node]]\nid = {}\n", f.node);
    let name = name(f);
    if !name.is_empty() {
        text.push_str(&format!("name = {}\n", Value::String(name)));
    }
    text.push_str("# eds = \"FILE.eds\"             # from the device's maker: needed to map objects\n");
    let keys =
        [("device_type", 0), ("vendor_id", 1), ("product_code", 2), ("revision", 3), ("serial_number", 4)];
    for (key, which) in keys {
        if let Some(value) = f.number(which) {
            // The serial number is for those who want to notice an exchanged device.
            let off = if key == "serial_number" || key == "revision" { "# " } else { "" };
            text.push_str(&format!("{off}{key} = {value:#010X}\n"));
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::Which;

    #[test]
    fn one_form_at_a_time() {
        let bus = BusArgs { bus: None, which: Which { stack: None } };
        assert!(run(&bus, true, true).unwrap_err().is::<UsageError>());
    }
}
