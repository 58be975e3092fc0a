//! What CANopen calls the frames of a bus: the PDOs that a master has planned, and for everything else the predefined
//! connection set of CiA 301.

use super::names::Signal;
use dinrail_can_io::protocol::signal::{ByteOrder, Signal as Place};
use dinrail_can_io::protocol::value::{Codec, IecType, Raw};
use dinrail_canopen::config::{Map, MasterConfig, Node, SlaveConfig};
use dinrail_canopen::device::Device;
use dinrail_canopen::master::plan::{Direction, Pdo, plan};
use dinrail_canopen::protocol::cob_id::CobId;
use dinrail_canopen::protocol::data_type::DataType;
use dinrail_canopen::service::load::devices;
use dinrail_iec::Addressing;
use ipc_types::payload::id_flag;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// Numbers of PDOs that the predefined connection set has.
const PREDEFINED_PDOS: u16 = 4;
/// SYNC of the predefined connection set.
const SYNC: u32 = 0x80;

/// What is known of the network on a bus.
#[derive(Debug, Clone)]
pub struct Network {
    sync: u32,
    /// Node-ids that the stack file names.
    pub nodes: BTreeSet<u8>,
    /// Name and symbols of planned PDOs, by identifier with its flag.
    pdos: BTreeMap<u32, (String, Vec<Signal>)>,
    /// Identifiers of the predefined connection set whose PDO is elsewhere.
    moved: BTreeSet<u32>,
}

impl Default for Network {
    fn default() -> Self {
        Self { sync: SYNC, nodes: BTreeSet::new(), pdos: BTreeMap::new(), moved: BTreeSet::new() }
    }
}

impl Network {
    /// Adds what a slave's table says.
    pub fn add_slave(&mut self, config: &SlaveConfig) {
        self.nodes.insert(config.node_id);
    }

    /// Adds what a master plans. What cannot be read of the EDS files is left out.
    pub fn add_master(&mut self, config: &MasterConfig, dir: &Path) {
        self.sync = u32::from(config.sync_cob_id);
        self.nodes.insert(config.node_id);
        let (devices, _) = devices(config, dir);
        let plan = plan(config, &devices, Addressing::default(), "");
        for node in &config.nodes {
            self.nodes.insert(node.id);
            let Some(planned) = plan.nodes.iter().find(|n| n.settings.plan.id == node.id) else { continue };
            for pdo in planned.pdos.iter().filter(|pdo| pdo.is_active()) {
                self.add_pdo(node, pdo, devices.get(&node.id));
            }
        }
    }

    fn add_pdo(&mut self, node: &Node, pdo: &Pdo, device: Option<&Device>) {
        let cob = CobId(pdo.cob_id);
        let id = cob.id() | if cob.is_extended() { id_flag::EFF } else { 0 };
        if let Some(usual) = predefined_pdo(pdo.direction, pdo.number, node.id).filter(|usual| *usual != id) {
            self.moved.insert(usual);
        }
        let wanted = |map: &&Map| match pdo.direction {
            Direction::Tpdo => map.to.is_some(),
            Direction::Rpdo => map.from.is_some(),
        };
        let signals = node.map.iter().filter(wanted).filter_map(|map| symbol(map, pdo, device?));
        let name = format!("{}{} {}", pdo.direction.name(), pdo.number, node.id);
        self.pdos.insert(id, (name, signals.collect()));
    }

    /// Name and symbols of an identifier with its flag.
    pub fn name(&self, id: u32) -> Option<(String, &[Signal])> {
        if let Some((name, signals)) = self.pdos.get(&id) {
            return Some((name.clone(), signals));
        }
        let plain = |name: String| (name, &[][..]);
        if id == self.sync {
            return Some(plain("SYNC".to_owned()));
        }
        if id & id_flag::EFF != 0 || id == SYNC || self.moved.contains(&id) {
            return None;
        }
        predefined(id).map(plain)
    }

    /// Every identifier with a name, whether or not there is such a node.
    pub fn ids(&self) -> impl Iterator<Item = u32> + '_ {
        (0..=id_flag::SFF_MASK).chain(self.pdos.keys().copied().filter(|id| id & id_flag::EFF != 0))
    }

    /// Symbols of planned PDOs with their identifiers.
    pub fn symbols(&self) -> impl Iterator<Item = (u32, &str)> + '_ {
        self.pdos.iter().flat_map(|(id, (_, signals))| signals.iter().map(|s| (*id, s.name.as_str())))
    }
}

/// A mapped object that has a name in the stack file.
fn symbol(map: &Map, pdo: &Pdo, device: &Device) -> Option<Signal> {
    let name = map.symbol.clone().or_else(|| map.to.clone()).or_else(|| map.from.clone())?;
    let (index, sub) = device.resolve(&map.object).ok()?;
    let first = pdo.bit_of(index, sub)?;
    let bits = pdo.mapping.iter().find(|m| (m.index, m.sub) == (index, sub))?.bits;
    let entry = device.od.find(index, sub).ok().and_then(|at| device.od.entry(at))?;
    let signal = Place::new(u32::from(first), u32::from(bits), ByteOrder::Intel).ok();
    let codec = signal.map(|signal| {
        let (raw, iec) = types(entry.data_type, bits);
        Codec { signal, raw, scale: 1.0, offset: 0.0, iec }
    });
    Some(Signal { name, codec })
}

fn types(data_type: DataType, bits: u8) -> (Raw, IecType) {
    let sized = |of: [IecType; 4]| match bits {
        0..=8 => of[0],
        9..=16 => of[1],
        17..=32 => of[2],
        _ => of[3],
    };
    match data_type {
        _ if bits == 1 => (Raw::Unsigned, IecType::Bool),
        DataType::Real32 if bits == 32 => (Raw::Float, IecType::Real),
        DataType::Real64 if bits == 64 => (Raw::Float, IecType::Lreal),
        other if other.is_signed() => {
            (Raw::Signed, sized([IecType::Sint, IecType::Int, IecType::Dint, IecType::Lint]))
        }
        other if other.is_unsigned() => {
            (Raw::Unsigned, sized([IecType::Usint, IecType::Uint, IecType::Udint, IecType::Ulint]))
        }
        _ => (Raw::Unsigned, sized([IecType::Byte, IecType::Word, IecType::Dword, IecType::Lword])),
    }
}

fn predefined_pdo(direction: Direction, number: u16, node: u8) -> Option<u32> {
    let first = match direction {
        Direction::Tpdo => 0x180,
        Direction::Rpdo => 0x200,
    };
    (1..=PREDEFINED_PDOS).contains(&number).then(|| first + 0x100 * (u32::from(number) - 1) + u32::from(node))
}

/// The predefined connection set of CiA 301 (7.3.5): what a COB-ID means unless a device was told otherwise.
fn predefined(id: u32) -> Option<String> {
    let node = id & 0x7F;
    let of_node = |what: &str| (node != 0).then(|| format!("{what} {node}"));
    match id {
        0 => Some("NMT".to_owned()),
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

/// What somebody typed for names like `TPDO1 5`: words in this order, any of them left out. `node` may stand before
/// the number; `PDO` is any PDO, `TPDO` any transmit PDO.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Wanted(Vec<String>);

impl Wanted {
    /// `None` when it says nothing: a number alone is an identifier, not a node.
    pub fn parse(text: &str) -> Option<Self> {
        let mut said = false;
        let mut words = Vec::new();
        for word in text.split(|c: char| c.is_whitespace() || c == '_').filter(|w| !w.is_empty()) {
            let word = word.to_ascii_lowercase();
            said |= !word.bytes().all(|c| c.is_ascii_digit());
            match word.as_str() {
                "node" => {}
                "emergency" => words.push("emcy".to_owned()),
                "response" | "reply" => words.push("answer".to_owned()),
                "hb" | "bootup" | "boot-up" | "guarding" => words.push("heartbeat".to_owned()),
                _ => words.push(word),
            }
        }
        (said && !words.is_empty()).then_some(Self(words))
    }

    /// Whether a name is meant.
    pub fn is(&self, name: &str) -> bool {
        let mut of_name = name.split(' ');
        self.0.iter().all(|wanted| of_name.any(|word| same(wanted, word)))
    }

    /// The node-id in it.
    pub fn node(&self) -> Option<u8> {
        self.0.last()?.parse().ok().filter(|n| (1..=127).contains(n))
    }
}

fn same(wanted: &str, word: &str) -> bool {
    let bare = word.trim_end_matches(|c: char| c.is_ascii_digit());
    wanted.eq_ignore_ascii_case(word)
        || (!bare.is_empty() && bare.len() < word.len())
            && (wanted.eq_ignore_ascii_case(bare) || wanted == "pdo" && bare.ends_with("PDO"))
}

/// Every name of a node.
pub fn names_of_node(node: u8) -> impl Iterator<Item = String> {
    let pdos = (1..=PREDEFINED_PDOS).flat_map(|n| [format!("TPDO{n}"), format!("RPDO{n}")]);
    let others = ["EMCY", "SDO", "SDO answer", "SDO request", "heartbeat", "node"].map(str::to_owned);
    pdos.chain(others).map(move |what| format!("{what} {node}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn predefined_names() {
        let network = Network::default();
        let name = |id| network.name(id).map(|(name, _)| name);
        for (id, expected) in [
            (0, "NMT"),
            (0x80, "SYNC"),
            (0x85, "EMCY 5"),
            (0x100, "TIME"),
            (0x185, "TPDO1 5"),
            (0x57F, "RPDO4 127"),
            (0x581, "SDO answer 1"),
            (0x601, "SDO request 1"),
            (0x705, "heartbeat 5"),
            (0x7E5, "LSS"),
        ] {
            assert_eq!(name(id).as_deref(), Some(expected));
        }
        for id in [0x700, 0x680, 0x180, id_flag::EFF | 0x185] {
            assert_eq!(name(id), None, "{id:X}");
        }
        assert_eq!(predefined_pdo(Direction::Tpdo, 1, 5), Some(0x185));
        assert_eq!(predefined_pdo(Direction::Rpdo, 4, 127), Some(0x57F));
        assert_eq!(predefined_pdo(Direction::Rpdo, 5, 1), None);
    }

    #[test]
    fn what_people_type() {
        for (typed, name, expected) in [
            ("TPDO1 5", "TPDO1 5", true),
            ("tpdo1 node 5", "TPDO1 5", true),
            ("tpdo1", "TPDO1 5", true),
            ("TPDO 5", "TPDO1 5", true),
            ("PDO", "RPDO4 127", true),
            ("TPDO", "RPDO4 127", false),
            ("TPDO1 5", "TPDO1 55", false),
            ("SDO node 5", "SDO answer 5", true),
            ("SDO response 5", "SDO answer 5", true),
            ("SDO request 5", "SDO answer 5", false),
            ("heartbeat node 5", "heartbeat 5", true),
            ("heartbeat_5", "heartbeat 5", true),
            ("HB", "heartbeat 5", true),
            ("node 5", "EMCY 5", true),
            ("node 5", "EMCY 6", false),
            ("emergency", "EMCY 6", true),
            ("sync", "SYNC", true),
            ("heartbeet 5", "heartbeat 5", false),
        ] {
            assert_eq!(Wanted::parse(typed).unwrap().is(name), expected, "{typed} {name}");
        }
        for nothing in ["", "5", "node", " 12 3 "] {
            assert_eq!(Wanted::parse(nothing), None, "{nothing}");
        }
        assert_eq!(Wanted::parse("heartbeet 5").unwrap().node(), Some(5));
    }

    #[test]
    fn planned_pdos_have_their_symbols_and_places() {
        let config: MasterConfig = serde_json::from_value(json!({
            "sync_period": "10ms", "sync_cob_id": 0x81,
            "node": [{ "id": 2, "eds": "io401.eds", "map": [
                { "object": "6000:01", "to": "%IB0", "symbol": "Buttons" },
                { "object": "6401:01", "to": "%IW2" },
                { "object": "6200:01", "from": "%QB0", "symbol": "Lamps" },
            ] }],
        }))
        .unwrap();
        let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("stacks/canopen-io");
        let mut network = Network::default();
        network.add_master(&config, &dir);
        let shown = |id| {
            let (name, signals) = network.name(id)?;
            let signals: Vec<&str> = signals.iter().map(|s| s.name.as_str()).collect();
            Some(format!("{name}: {}", signals.join(" ")))
        };
        assert_eq!(shown(0x182).as_deref(), Some("TPDO1 2: Buttons"));
        assert_eq!(shown(0x202).as_deref(), Some("RPDO1 2: Lamps"));
        assert_eq!(shown(0x282).as_deref(), Some("TPDO2 2: %IW2"));
        assert_eq!((shown(0x81).as_deref(), shown(0x80)), (Some("SYNC: "), None));
        assert_eq!(network.nodes, BTreeSet::from([1, 2]));
        assert_eq!(network.symbols().count(), 3);
    }

    #[test]
    fn a_pdo_that_was_moved_leaves_its_usual_identifier() {
        let mut network = Network::default();
        let node: Node = serde_json::from_value(json!({ "id": 5 })).unwrap();
        let pdo = Pdo {
            direction: Direction::Tpdo,
            number: 1,
            cob_id: 0x1A5,
            transmission: 255,
            inhibit: 0,
            event: 0,
            sync_start: 0,
            mapping: Vec::new(),
            remapped: false,
            used: true,
        };
        network.add_pdo(&node, &pdo, None);
        assert_eq!(network.name(0x1A5).map(|(name, _)| name).as_deref(), Some("TPDO1 5"));
        assert!(network.name(0x185).is_none());
        let extended = Pdo { number: 6, cob_id: 0x2000_0185, ..pdo };
        network.add_pdo(&node, &extended, None);
        assert_eq!(network.name(id_flag::EFF | 0x185).map(|(name, _)| name).as_deref(), Some("TPDO6 5"));
        assert!(network.ids().any(|id| id == id_flag::EFF | 0x185));
    }
}
