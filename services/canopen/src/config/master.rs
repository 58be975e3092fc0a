//! A service of kind `canopen-master`.

use super::value::{Number, ObjectRef};
use ipc_types::outputs::{self, STALE_AFTER, SafeOn, StopWord};
use ipc_types::units::Span;
use serde::{Deserialize, Serialize};

/// Most `[[service.node]]`: the node-ids of CiA 301 clause 7.2.3 less the master's own.
pub const MAX_NODES: usize = 126;
/// Most objects mapped of one node: 512 PDOs of 8 bytes carry more, no real node does.
pub const MAX_MAPS: usize = 512;
/// Most values of a PDO that wait for a scan.
pub const MAX_QUEUE: u32 = 64;
/// Most objects written to a node at boot.
pub const MAX_SDO_WRITES: usize = 1024;

/// The service's table of the stack file, without the launcher's keys.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// The can service. Default: the only one of the stack.
    pub bus: Option<String>,
    /// The plc service. Default: the only one of the stack.
    pub plc: Option<String>,
    /// 1 - 127.
    pub node_id: u8,
    /// Time between two SYNC. Absent: none is sent.
    pub sync_period: Option<Span>,
    /// Time after a SYNC in which synchronous PDOs belong to it (1007h). Default: the whole period.
    pub sync_window: Option<Span>,
    /// The SYNC carries a counter that overflows at this value (1019h), 2 - 240. 0: no counter.
    pub sync_overflow: u8,
    /// COB-ID of the SYNC (1005h).
    pub sync_cob_id: u16,
    /// Time between two TIME messages (1012h). Absent: none is sent.
    pub time_period: Option<Span>,
    /// Time between two heartbeats of the master (1017h). 0: none.
    pub heartbeat: Span,
    /// Start a node as soon as it is booted (1F80h bit 3 = 0).
    pub start_nodes: bool,
    /// Start all nodes at once with one message when every mandatory node is booted (1F80h bit 1).
    pub start_all_nodes: bool,
    /// On an error of a mandatory node, reset all nodes (1F80h bit 4).
    pub reset_all_nodes: bool,
    /// On an error of a mandatory node, stop all nodes (1F80h bit 6).
    pub stop_all_nodes: bool,
    /// How long mandatory nodes may take to boot before that is an error (1F89h). 0: for ever.
    pub boot_time: Span,
    /// Least time between two NMT commands (102Ah).
    pub nmt_inhibit_time: Span,
    /// Longest wait for the answer of an SDO server.
    pub sdo_timeout: Span,
    /// How often an SDO transfer of the boot-up is tried.
    pub sdo_tries: u8,
    /// Age of the image above which outputs go to their safe state.
    pub stale_after: Span,
    /// States of the plc in which outputs go to their safe state. A stale image always does.
    pub safe_on: Vec<SafeOn>,
    /// Safe state of the outputs.
    pub on_stop: OnStop,
    /// The nodes.
    #[serde(rename = "node")]
    pub nodes: Vec<Node>,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            bus: None,
            plc: None,
            node_id: 1,
            sync_period: None,
            sync_window: None,
            sync_overflow: 0,
            sync_cob_id: 0x80,
            time_period: None,
            heartbeat: Span::from_ms(500),
            start_nodes: true,
            start_all_nodes: false,
            reset_all_nodes: false,
            stop_all_nodes: false,
            boot_time: Span::from_ms(10_000),
            nmt_inhibit_time: Span::from_ms(0),
            sdo_timeout: Span::from_ms(500),
            sdo_tries: 3,
            stale_after: STALE_AFTER,
            safe_on: SafeOn::ALL.to_vec(),
            on_stop: OnStop::default(),
            nodes: Vec::new(),
        }
    }
}

/// Safe state: a word, or values of some outputs; the others are zero then.
pub type OnStop = outputs::OnStop<OnStopWord, StopValue>;

/// Words of [`OnStop`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum OnStopWord {
    /// All outputs zero, nodes stay operational.
    #[default]
    Zero,
    /// The last outputs stay.
    Hold,
    /// The nodes are sent to pre-operational.
    Preop,
    /// The nodes are stopped.
    Stop,
}

impl StopWord for OnStopWord {
    const EXPECTED: &'static str = "\"zero\", \"hold\", \"preop\", \"stop\" or { values = [...] }";
}

/// One output of the safe state.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StopValue {
    /// The %-address, as in the map.
    pub from: String,
    pub value: Number,
}

/// One `[[service.node]]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Node {
    /// 1 - 127, not the master's.
    pub id: u8,
    /// For messages. Default: the product name of the EDS.
    pub name: Option<String>,
    /// EDS or DCF, relative to the stack file.
    pub eds: Option<String>,
    /// The network does not start without it (1F81h bit 3).
    pub mandatory: bool,
    /// Configure and start it (1F81h bit 2).
    pub boot: bool,
    /// An operational node is not reset at the start of the master (1F81h bit 4).
    pub keep_alive: bool,
    /// Producer heartbeat time (1017h); the master waits three times as long. 0: not monitored by heartbeat.
    pub heartbeat: Option<Span>,
    /// Node guarding instead of heartbeat.
    pub guarding: Option<Guarding>,
    /// What of the identity must be as in the EDS.
    pub check: Vec<Check>,
    /// Overrides of the EDS (1000h, 1018h).
    pub device_type: Option<Number>,
    pub vendor_id: Option<Number>,
    pub product_code: Option<Number>,
    pub revision: Option<Number>,
    pub serial_number: Option<Number>,
    /// Days since 1984-01-01 (1F26h): equal to the node's 1020h:01, its configuration is not loaded again.
    pub config_date: Option<u32>,
    /// Milliseconds since midnight (1F27h).
    pub config_time: Option<u32>,
    /// Restore the node's defaults before its configuration is loaded (1F81h bit 7).
    pub restore: Restore,
    /// Objects written at boot, in this order, before the PDOs.
    pub sdo: Vec<SdoWrite>,
    /// The node's transmit PDOs that differ from the EDS.
    pub tpdo: Vec<Pdo>,
    /// The node's receive PDOs that differ from the EDS.
    pub rpdo: Vec<Pdo>,
    /// What goes to and from the process image.
    pub map: Vec<Map>,
    /// What an error of its error control leads to.
    pub on_error: ErrorPolicy,
    /// Overrides the master's.
    pub sdo_timeout: Option<Span>,
    /// %IB that shows the node's NMT state: 0 unknown, 4 stopped, 5 operational, 127 pre-operational.
    pub status_to: Option<String>,
}

impl Default for Node {
    fn default() -> Self {
        Self {
            id: 0,
            name: None,
            eds: None,
            mandatory: false,
            boot: true,
            keep_alive: false,
            heartbeat: None,
            guarding: None,
            check: vec![Check::DeviceType, Check::Vendor, Check::Product],
            device_type: None,
            vendor_id: None,
            product_code: None,
            revision: None,
            serial_number: None,
            config_date: None,
            config_time: None,
            restore: Restore::No,
            sdo: Vec::new(),
            tpdo: Vec::new(),
            rpdo: Vec::new(),
            map: Vec::new(),
            on_error: ErrorPolicy::Zero,
            sdo_timeout: None,
            status_to: None,
        }
    }
}

/// Node guarding (CiA 301 clause 7.2.8.2.2.1): needs a bus that carries remote frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Guarding {
    /// Guard time (100Ch).
    pub time: Span,
    /// Life time factor (100Dh).
    pub factor: u8,
}

/// Parts of a node's identity.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Check {
    /// 1000h.
    DeviceType,
    /// 1018h:01.
    Vendor,
    /// 1018h:02.
    Product,
    /// 1018h:03.
    Revision,
    /// 1018h:04.
    Serial,
}

/// Sub-index of 1011h that is written before the configuration.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Restore {
    #[default]
    No,
    /// 1011h:01.
    All,
    /// 1011h:02.
    Communication,
    /// 1011h:03.
    Application,
}

/// An object written at boot.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SdoWrite {
    pub object: ObjectRef,
    pub value: Number,
}

/// Transmission type of a PDO (CiA 301 table 69 and 73).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged, expecting = "\"event\", \"rtr\", \"sync_rtr\", \"acyclic\" or 0 - 255")]
pub enum Transmission {
    Number(u8),
    Word(TransmissionWord),
}

/// Words of [`Transmission`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TransmissionWord {
    /// 255.
    Event,
    /// 253.
    Rtr,
    /// 252.
    SyncRtr,
    /// 0.
    Acyclic,
}

impl Transmission {
    /// The number on the wire.
    pub fn number(self) -> u8 {
        match self {
            Self::Number(n) => n,
            Self::Word(TransmissionWord::Event) => 255,
            Self::Word(TransmissionWord::Rtr) => 253,
            Self::Word(TransmissionWord::SyncRtr) => 252,
            Self::Word(TransmissionWord::Acyclic) => 0,
        }
    }
}

/// A PDO of a node as it shall be.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Pdo {
    /// From 1.
    pub number: u16,
    #[serde(default = "yes")]
    pub enabled: bool,
    /// Default: the EDS's.
    #[serde(default)]
    pub cob_id: Option<Number>,
    /// Default: the EDS's; 1 where the master has a `sync_period`.
    #[serde(default)]
    pub transmission: Option<Transmission>,
    /// Of a transmit PDO, in steps of 100us.
    #[serde(default)]
    pub inhibit_time: Option<Span>,
    /// Of a transmit PDO: event timer. Of a receive PDO: deadline. In steps of 1ms.
    #[serde(default)]
    pub event_timer: Option<Span>,
    /// Of a transmit PDO: SYNC counter value at which it starts.
    #[serde(default)]
    pub sync_start: Option<u8>,
    /// Objects in it. Default: the EDS's.
    #[serde(default)]
    pub mapping: Option<Vec<ObjectRef>>,
}

/// A value of an object to or from the image.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Map {
    pub object: ObjectRef,
    /// Place in %I, for what the node sends.
    #[serde(default)]
    pub to: Option<String>,
    /// Place in %Q or %M, for what the node receives.
    #[serde(default)]
    pub from: Option<String>,
    /// Name of a global variable for the program.
    #[serde(default)]
    pub symbol: Option<String>,
    /// What the PLC makes of an input while the node is not operational.
    #[serde(default)]
    pub on_bad: OnBadWord,
    /// %IB that shows the quality to the program.
    #[serde(default)]
    pub status_to: Option<String>,
    /// Each received value of the PDO reaches one scan, in order; so many wait. Absent: the newest counts.
    #[serde(default)]
    pub queue: Option<u32>,
}

/// Value of an input while it is bad.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum OnBadWord {
    #[default]
    Hold,
    Zero,
}

/// What the loss of a node leads to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ErrorPolicy {
    /// Its inputs turn bad, its outputs are sent as zero until it is booted again.
    #[default]
    Zero,
    /// It is booted again when it returns; its outputs follow the image.
    Ignore,
    /// All nodes are stopped.
    Stop,
}

fn yes() -> bool {
    true
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn what_is_written_is_read_again() {
        let text = json!({
            "bus": "can0", "node_id": 1, "sync_period": "10ms", "on_stop": "hold",
            "node": [{
                "id": 5, "eds": "io.eds", "mandatory": true, "heartbeat": "100ms", "check": ["vendor", "serial"],
                "serial_number": "0x1234", "sdo": [{ "object": "6423:00", "value": true }],
                "tpdo": [{ "number": 1, "transmission": "event", "inhibit_time": "5ms", "mapping": ["6000:01"] }],
                "map": [{ "object": "6000:01", "to": "%IB0", "symbol": "Buttons" },
                        { "object": "Outputs", "from": "%QB0" }],
            }],
        });
        let config: Config = serde_json::from_value(text).unwrap();
        assert_eq!(config.nodes[0].tpdo[0].transmission.map(Transmission::number), Some(255));
        assert!(config.nodes[0].tpdo[0].enabled);
        let again: Config = serde_json::from_value(serde_json::to_value(&config).unwrap()).unwrap();
        assert_eq!(again, config);
    }

    #[test]
    fn safe_states_are_words_or_values() {
        let read = |value| serde_json::from_value::<OnStop>(value);
        assert_eq!(OnStop::default(), read(json!("zero")).unwrap());
        let value = json!({ "values": [{ "from": "%QB0", "value": 5 }] });
        let OnStop::Values(table) = read(value).unwrap() else { panic!("values are a table") };
        assert_eq!(table.values[0].from, "%QB0");
        let said = |value| read(value).unwrap_err().to_string();
        let all = [said(json!("off")), said(json!({ "values": [{ "form": "%QB0", "value": 5 }] }))];
        insta::assert_snapshot!(all.join("\n"), @r#"
        invalid value: string "off", expected "zero", "hold", "preop", "stop" or { values = [...] }
        unknown field `form`, expected `from` or `value`
        "#);
    }

    #[test]
    fn unknown_keys_are_refused() {
        for wrong in [
            json!({ "node": [{ "id": 5, "mandatroy": true }] }),
            json!({ "node": [{ "id": 5, "map": [{ "object": "6000:01", "too": "%IB0" }] }] }),
            json!({ "on_stop": "off" }),
            json!({ "node": [{ "id": 5, "tpdo": [{ "number": 1, "transmission": "often" }] }] }),
        ] {
            assert!(serde_json::from_value::<Config>(wrong.clone()).is_err(), "{wrong}");
        }
    }
}
