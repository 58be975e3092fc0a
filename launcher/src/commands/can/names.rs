//! What the stack calls its frames: signals of `can-io`, and on a bus with a CANopen service its PDOs with the mapped
//! objects, SDO, heartbeat and so on (see [`super::canopen_names`]).

use super::canopen_names::{Network, Wanted, names_of_node};
use crate::stackfile::{nearest, suggestion};
use dinrail_can_io::plan::plan;
use dinrail_can_io::protocol::value::{Codec, IecType};
use dinrail_canopen::config::{MasterConfig, SlaveConfig};
use dinrail_iec::Addressing;
use ipc_types::payload::{CanFrame, id_flag};
use ipc_types::stack::Stack;
use ipc_types::topic::TopicKind;
use std::collections::{BTreeMap, BTreeSet};

/// Names that are listed to somebody who misspelt one.
const MAX_LISTED: usize = 60;

/// Buses with identifiers, these with their flag.
pub type Ids = BTreeMap<String, BTreeSet<u32>>;

/// A part of a frame that has a name.
#[derive(Debug, Clone)]
pub struct Signal {
    pub name: String,
    /// `None`: no value is told.
    pub codec: Option<Codec>,
}

/// See the module.
#[derive(Debug, Clone, Default)]
pub struct Names {
    /// Signals of `can-io` by identifier with its flag, and bus.
    signals: BTreeMap<(u32, String), Vec<Signal>>,
    /// Buses with a CANopen service.
    canopen: BTreeMap<String, Network>,
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
            let config = || service.config.clone();
            if service.kind.starts_with("canopen") {
                let network = names.canopen.entry(bus.to_owned()).or_default();
                if let Ok(master) = serde_json::from_value::<MasterConfig>(config()) {
                    network.add_master(&master, &stack.dir);
                } else if let Ok(slave) = serde_json::from_value::<SlaveConfig>(config()) {
                    network.add_slave(&slave);
                }
            } else if service.kind == "can-io"
                && let Ok(config) = serde_json::from_value::<dinrail_can_io::Config>(config())
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

    /// Whether the stack names anything.
    pub fn is_empty(&self) -> bool {
        self.signals.is_empty() && self.canopen.is_empty()
    }

    /// The frames with this name, whatever its case: a signal's, or CANopen's with or without a node.
    pub fn find(&self, name: &str) -> Ids {
        let signals = self.find_signal(name);
        if !signals.is_empty() {
            return signals;
        }
        let mut found = Ids::new();
        let Some(wanted) = Wanted::parse(name) else { return found };
        for (bus, network) in &self.canopen {
            let ids = network.ids().filter(|id| {
                !self.signals.contains_key(&(*id, bus.clone()))
                    && network.name(*id).is_some_and(|(name, _)| wanted.is(&name))
            });
            let ids: BTreeSet<u32> = ids.collect();
            if !ids.is_empty() {
                found.insert(bus.clone(), ids);
            }
        }
        found
    }

    /// The frames that carry a signal or mapped object of this name.
    pub fn find_signal(&self, name: &str) -> Ids {
        let mut found = Ids::new();
        let has = |signals: &Vec<Signal>| signals.iter().any(|s| s.name.eq_ignore_ascii_case(name));
        for ((id, bus), _) in self.signals.iter().filter(|(_, signals)| has(signals)) {
            found.entry(bus.clone()).or_default().insert(*id);
        }
        for (bus, network) in &self.canopen {
            for (id, _) in network.symbols().filter(|(_, symbol)| symbol.eq_ignore_ascii_case(name)) {
                found.entry(bus.clone()).or_default().insert(id);
            }
        }
        found
    }

    /// What to say about a name that is none: the nearest, and which there are.
    pub fn unknown(&self, name: &str) -> String {
        if self.is_empty() {
            return "the stack gives no names to frames: they come from services of kind can-io and canopen-*"
                .to_owned();
        }
        let mut signals: BTreeSet<&str> = self.signals.values().flatten().map(|s| s.name.as_str()).collect();
        signals.extend(self.canopen.values().flat_map(|n| n.symbols().map(|(_, symbol)| symbol)));
        let listed: Vec<&str> = signals.iter().copied().take(MAX_LISTED).collect();
        let more = match signals.len() - listed.len() {
            0 => String::new(),
            n => format!(" and {n} more"),
        };
        if self.canopen.is_empty() {
            return suggestion(name, "names in this stack", listed.iter().copied()) + &more;
        }
        let mut nodes: BTreeSet<u8> =
            self.canopen.values().flat_map(|n| n.nodes.iter().copied()).filter(|n| *n <= 127).collect();
        let known = nodes.iter().map(u8::to_string).collect::<Vec<_>>().join(", ");
        nodes.extend(Wanted::parse(name).and_then(|wanted| wanted.node()));
        let of_nodes: Vec<String> = nodes.into_iter().flat_map(names_of_node).collect();
        let general = ["NMT", "SYNC", "TIME", "LSS", "EMCY", "SDO", "heartbeat", "TPDO", "RPDO"];
        let all = signals
            .iter()
            .copied()
            .chain(general)
            .chain(of_nodes.iter().map(String::as_str))
            .collect::<Vec<_>>();
        let near = nearest(name, all).map(|near| format!("did you mean '{near}'?\n")).unwrap_or_default();
        let listed = if listed.is_empty() { "none".to_owned() } else { listed.join(", ") };
        format!(
            "{near}names in this stack: {listed}{more}\nnames of CANopen: NMT, SYNC, TIME, LSS; with a node or without: EMCY 5, TPDO1 5, RPDO1 5, SDO 5, SDO request 5, SDO answer 5, heartbeat 5, node 5; nodes in this stack: {known}"
        )
    }

    /// Name and value of everything in a frame. A value is missing when the frame is too short for it, or when the
    /// name is the frame's own.
    pub fn describe(&self, bus: &str, frame: &CanFrame) -> Vec<(String, Option<String>)> {
        if frame.is_error() {
            return Vec::new();
        }
        let id = frame.id() | (frame.can_id & id_flag::EFF);
        let value =
            |s: &Signal| s.codec.filter(|_| !frame.is_remote()).and_then(|c| value_text(&c, frame.payload()));
        let told =
            |signals: &[Signal]| signals.iter().map(|s| (s.name.clone(), value(s))).collect::<Vec<_>>();
        if let Some(signals) = self.signals.get(&(id, bus.to_owned())) {
            return told(signals);
        }
        let Some((name, signals)) = self.canopen.get(bus).and_then(|network| network.name(id)) else {
            return Vec::new();
        };
        let mut named = vec![(name, None)];
        named.extend(told(signals));
        named
    }

    /// [`Self::describe`] as every command has it in its JSON: an object, name to value or null.
    pub fn json(&self, bus: &str, frame: &CanFrame) -> serde_json::Value {
        let named = self.describe(bus, frame).into_iter().map(|(name, value)| (name, value.into()));
        serde_json::Value::Object(named.collect())
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
        assert_eq!(names.find("COMMAND"), Ids::from([("can0".to_owned(), BTreeSet::from([0x210]))]));
        assert_eq!(names.unknown("x"), "names in this stack: %IB2, Command, Door, Speed");
    }

    /// A stack's worth: `can-io` and a CANopen network on the same bus.
    fn mixed() -> Names {
        let mut names = Names::of_table(&[("can0", 0x1A0, "Speed"), ("can1", 0x8000_0001, "Level")]);
        let config: MasterConfig = serde_json::from_value(json!({
            "node": [{ "id": 5, "eds": "io401.eds", "map": [
                { "object": "6000:01", "to": "%IB0", "symbol": "Buttons" },
                { "object": "6401:01", "to": "%IW2", "symbol": "Pressure" },
            ] }],
        }))
        .unwrap();
        let dir = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("stacks/canopen-io");
        names.canopen.entry("can0".to_owned()).or_default().add_master(&config, &dir);
        names
    }

    #[test]
    fn canopen_frames_have_their_objects_with_values() {
        let names = mixed();
        assert_eq!(names.text("can0", &CanFrame::classic(0x185, &[7])), "TPDO1 5 Buttons=7");
        assert_eq!(names.text("can0", &CanFrame::classic(0x285, &[0xFE, 0xFF])), "TPDO2 5 Pressure=-2");
        assert_eq!(names.text("can0", &CanFrame::classic(0x285, &[])), "TPDO2 5 Pressure");
        assert_eq!(names.text("can0", &CanFrame::classic(0x586, &[])), "SDO answer 6");
        // A signal of can-io says more than the predefined connection set.
        assert_eq!(names.text("can0", &CanFrame::classic(0x1A0, &[])), "Speed");
        assert_eq!(names.text("can1", &CanFrame::classic(0x185, &[7])), "");
        assert_eq!(
            names.json("can0", &CanFrame::classic(0x185, &[7])),
            json!({ "TPDO1 5": null, "Buttons": "7" })
        );
        assert_eq!(names.json("can0", &CanFrame::classic(0x7FF, &[])), json!({}));
    }

    #[test]
    fn what_is_shown_is_found() {
        let names = mixed();
        let found = |text: &str| {
            let ids = names.find(text);
            let text = |(bus, ids): (&String, &BTreeSet<u32>)| match ids.len() {
                0..=4 => format!("{bus} {ids:X?}"),
                n => format!("{bus} {n} identifiers"),
            };
            ids.iter().map(text).collect::<Vec<_>>().join(", ")
        };
        for (typed, ids) in [
            ("speed", "can0 {1A0}"),
            ("Level", "can1 {80000001}"),
            ("Buttons", "can0 {185}"),
            ("TPDO1 5", "can0 {185}"),
            ("sdo node 5", "can0 {585, 605}"),
            ("SDO request 5", "can0 {605}"),
            ("heartbeat 5", "can0 {705}"),
            ("heartbeat", "can0 127 identifiers"),
            ("SYNC", "can0 {80}"),
            ("node 5", "can0 12 identifiers"),
            // 1A0 is named Speed, not TPDO1 32.
            ("TPDO1 32", ""),
            ("heartbeet 5", ""),
        ] {
            assert_eq!(found(typed), ids, "{typed}");
        }
        // Whatever is shown can be filtered by.
        for id in (0..0x800).step_by(31).chain([0x80, 0x185, 0x285, 0x705, 0x7E5]) {
            let frame = CanFrame::classic(id, &[]);
            for (name, _) in names.describe("can0", &frame) {
                assert!(names.find(&name)["can0"].contains(&id), "{name}");
            }
        }
    }

    #[test]
    fn unknown_names_bring_the_nearest() {
        let names = mixed();
        let said: Vec<String> = ["Presure", "heartbeet 5", "TPDO1 nod 7", "xyzzy"]
            .iter()
            .map(|name| names.unknown(name).lines().next().unwrap_or_default().to_owned())
            .collect();
        insta::assert_snapshot!(said.join("\n"), @r#"
did you mean 'Pressure'?
did you mean 'heartbeat 5'?
did you mean 'TPDO'?
names in this stack: Buttons, Level, Pressure, Speed
"#);
        insta::assert_snapshot!(names.unknown("xyzzy"), @r#"
names in this stack: Buttons, Level, Pressure, Speed
names of CANopen: NMT, SYNC, TIME, LSS; with a node or without: EMCY 5, TPDO1 5, RPDO1 5, SDO 5, SDO request 5, SDO answer 5, heartbeat 5, node 5; nodes in this stack: 1, 5
"#);
        assert!(Names::default().unknown("x").starts_with("the stack gives no names to frames"));
        let many: Vec<String> = (0..=MAX_LISTED).map(|i| format!("Signal{i}")).collect();
        let many: Vec<(&str, u32, &str)> = many.iter().map(|name| ("can0", 1, name.as_str())).collect();
        assert!(Names::of_table(&many).unknown("x").ends_with(" and 1 more"));
    }
}
