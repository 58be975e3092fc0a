//! What the stack calls its frames: signals of `can-io`, the predefined objects of CANopen.

use dinrail_can_io::plan::plan;
use dinrail_can_io::protocol::value::{Codec, IecType};
use dinrail_iec::Addressing;
use ipc_types::payload::{CanFrame, id_flag};
use ipc_types::stack::Stack;
use ipc_types::topic::TopicKind;
use std::collections::{BTreeMap, BTreeSet};

#[derive(Debug, Clone)]
struct Signal {
    name: String,
    codec: Option<Codec>,
}

/// See the module.
#[derive(Debug, Clone, Default)]
pub struct Names {
    /// By identifier with its flag, and bus.
    signals: BTreeMap<(u32, String), Vec<Signal>>,
    /// Buses with a CANopen service.
    canopen: BTreeSet<String>,
}

impl Names {
    /// The names of a stack. What cannot be read is left out: names are a help, not a condition.
    pub fn of(stack: &Stack) -> Self {
        let mut names = Self::default();
        let has_bus =
            |s: &&ipc_types::stack::ServiceEntry| s.wiring.topics.iter().any(|t| t.kind == TopicKind::CanRx);
        let buses: Vec<&str> = stack.services.iter().filter(has_bus).map(|s| s.name.as_str()).collect();
        for service in &stack.services {
            let named = service.config.get("bus").and_then(|v| v.as_str());
            let only = (buses.len() == 1).then(|| buses[0]);
            let Some(bus) = named.or(only) else { continue };
            if service.kind.starts_with("canopen") {
                names.canopen.insert(bus.to_owned());
            } else if service.kind == "can-io"
                && let Ok(config) = serde_json::from_value::<dinrail_can_io::Config>(service.config.clone())
            {
                names.add(bus, &config);
            }
        }
        names
    }

    fn add(&mut self, bus: &str, config: &dinrail_can_io::Config) {
        let plan = plan(config, Addressing::default());
        for point in &plan.inputs {
            let Some(input) = config.inputs.get(point.index) else { continue };
            let name = input.symbol.clone().unwrap_or_else(|| input.to.clone());
            self.insert(bus, point.can_id, name, Some(point.codec));
        }
        for frame in &plan.outputs {
            let Some(output) = config.outputs.get(frame.index) else { continue };
            for (signal, point) in output.signals.iter().zip(&frame.signals) {
                let name = signal.symbol.clone().unwrap_or_else(|| signal.from.clone());
                self.insert(bus, frame.can_id, name, Some(point.codec));
            }
        }
    }

    fn insert(&mut self, bus: &str, can_id: u32, name: String, codec: Option<Codec>) {
        self.signals.entry((can_id, bus.to_owned())).or_default().push(Signal { name, codec });
    }

    /// Names without values, for tests.
    #[cfg(test)]
    pub fn of_table(table: &[(&str, u32, &str)]) -> Self {
        let mut names = Self::default();
        for (bus, can_id, name) in table {
            names.insert(bus, *can_id, (*name).to_owned(), None);
        }
        names
    }

    /// Every name, sorted.
    pub fn all(&self) -> Vec<String> {
        let all: BTreeSet<&String> = self.signals.values().flatten().map(|s| &s.name).collect();
        all.into_iter().cloned().collect()
    }

    /// Bus and identifier of the frames with this name, whatever its case.
    pub fn find(&self, name: &str) -> Vec<(String, u32)> {
        let has = |signals: &Vec<Signal>| signals.iter().any(|s| s.name.eq_ignore_ascii_case(name));
        let found = self.signals.iter().filter(|(_, signals)| has(signals));
        found.map(|((id, bus), _)| (bus.clone(), *id)).collect()
    }

    /// Name and value of everything in a frame. A value is missing when the frame is too short for it.
    pub fn describe(&self, bus: &str, frame: &CanFrame) -> Vec<(String, Option<String>)> {
        if frame.is_error() {
            return Vec::new();
        }
        let id = frame.id() | (frame.can_id & id_flag::EFF);
        if let Some(signals) = self.signals.get(&(id, bus.to_owned())) {
            let value = |s: &Signal| {
                s.codec.filter(|_| !frame.is_remote()).and_then(|c| value_text(&c, frame.payload()))
            };
            return signals.iter().map(|s| (s.name.clone(), value(s))).collect();
        }
        if self.canopen.contains(bus) && !frame.is_extended() {
            return canopen_name(frame.id()).map(|name| (name, None)).into_iter().collect();
        }
        Vec::new()
    }

    /// [`Self::describe`] in one line.
    pub fn text(&self, bus: &str, frame: &CanFrame) -> String {
        let parts = self.describe(bus, frame).into_iter().map(|(name, value)| match value {
            Some(value) => format!("{name}={value}"),
            None => name,
        });
        parts.collect::<Vec<_>>().join(" ")
    }
}

fn value_text(codec: &Codec, payload: &[u8]) -> Option<String> {
    let bytes = codec.decode(payload)?;
    let raw = u64::from_le_bytes(bytes);
    let shift = 64 - 8 * codec.iec.bytes() as u32;
    let signed = ((raw << shift) as i64) >> shift;
    let raw = raw << shift >> shift;
    Some(match codec.iec {
        IecType::Bool => if raw & 1 == 1 { "TRUE" } else { "FALSE" }.to_owned(),
        IecType::Real => f32::from_bits(raw as u32).to_string(),
        IecType::Lreal => f64::from_bits(raw).to_string(),
        IecType::Sint | IecType::Int | IecType::Dint | IecType::Lint => signed.to_string(),
        IecType::Byte | IecType::Word | IecType::Dword | IecType::Lword => format!("16#{raw:X}"),
        _ => raw.to_string(),
    })
}

/// The predefined connection set of CiA 301 (7.3.5): what a COB-ID means unless a device was told otherwise.
fn canopen_name(id: u32) -> Option<String> {
    let node = id & 0x7F;
    let of_node = |what: &str| (node != 0).then(|| format!("{what} {node}"));
    match id {
        0 => Some("NMT".to_owned()),
        0x80 => Some("SYNC".to_owned()),
        0x100 => Some("TIME".to_owned()),
        0x7E4 | 0x7E5 => Some("LSS".to_owned()),
        _ => match id >> 7 {
            1 => of_node("EMCY"),
            3 => of_node("TPDO1"),
            4 => of_node("RPDO1"),
            5 => of_node("TPDO2"),
            6 => of_node("RPDO2"),
            7 => of_node("TPDO3"),
            8 => of_node("RPDO3"),
            9 => of_node("TPDO4"),
            10 => of_node("RPDO4"),
            11 => of_node("SDO answer"),
            12 => of_node("SDO request"),
            14 => of_node("heartbeat"),
            _ => None,
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn signals_with_their_values() {
        let config: dinrail_can_io::Config = serde_json::from_value(json!({
            "in": [
                { "id": 0x1A0, "start": 0, "len": 16, "to": "%IW0", "type": "UINT", "symbol": "Speed" },
                { "id": 0x1A0, "start": 16, "len": 8, "signed": true, "to": "%IB2", "type": "SINT" },
                { "id": "18FEF100", "start": 0, "len": 1, "to": "%IX4.0", "type": "BOOL", "symbol": "Door" },
            ],
            "out": [{ "id": 0x210, "dlc": 2, "mode": "cyclic", "period": "100ms",
                      "signals": [{ "start": 0, "len": 16, "from": "%QW0", "type": "UINT", "symbol": "Command" }] }],
        }))
        .unwrap();
        let mut names = Names::default();
        names.add("can0", &config);
        let text = |frame: &CanFrame| names.text("can0", frame);
        assert_eq!(text(&CanFrame::classic(0x1A0, &[0xB0, 4, 0xFE])), "Speed=1200 %IB2=-2");
        assert_eq!(text(&CanFrame::classic(0x1A0, &[0xB0, 4])), "Speed=1200 %IB2");
        assert_eq!(text(&CanFrame::classic(0x18FE_F100, &[1])), "Door=TRUE");
        assert_eq!(text(&CanFrame::classic(0x210, &[8, 7])), "Command=1800");
        assert_eq!(names.text("can1", &CanFrame::classic(0x210, &[8, 7])), "");
        assert_eq!(names.find("COMMAND"), [("can0".to_owned(), 0x210)]);
        assert_eq!(names.all(), ["%IB2", "Command", "Door", "Speed"]);
    }

    #[test]
    fn canopen_names() {
        let table = [
            (0, "NMT"),
            (0x80, "SYNC"),
            (0x85, "EMCY 5"),
            (0x185, "TPDO1 5"),
            (0x57F, "RPDO4 127"),
            (0x581, "SDO answer 1"),
            (0x601, "SDO request 1"),
            (0x705, "heartbeat 5"),
            (0x7E5, "LSS"),
        ];
        for (id, name) in table {
            assert_eq!(canopen_name(id).as_deref(), Some(name));
        }
        assert_eq!(canopen_name(0x700), None);
        assert_eq!(canopen_name(0x680), None);
    }
}
