//! The service's table of the stack file.

use super::line::UnitSettings;
use super::order::Order;
use crate::server::Table;
use ipc_types::outputs::{STALE_AFTER, SafeOn};
use ipc_types::units::Span;
use serde::{Deserialize, Serialize};
use std::net::SocketAddr;

/// Most `[[service.read]]` of one service.
pub const MAX_READS: usize = 1024;
/// Most `[[service.write]]` of one service.
pub const MAX_WRITES: usize = 256;
/// Most `[[service.unit]]` of one service.
pub const MAX_UNITS: usize = 247;
/// Most connections of one service.
pub const MAX_LINES: usize = 32;

/// How frames look on the line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Mode {
    /// MBAP header; only on TCP.
    Tcp,
    /// Address and CRC; on a serial line, or on TCP to a converter.
    Rtu,
    /// Hexadecimal with LRC; only on a serial line.
    Ascii,
}

/// A service of kind `modbus-client`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// The plc service. Default: the only one of the stack.
    pub plc: Option<String>,
    /// The serial service whose line is used.
    pub serial: Option<String>,
    /// Or the server to connect to.
    pub tcp: Option<SocketAddr>,
    /// Default: `rtu` on a serial service, `tcp` on TCP.
    pub mode: Option<Mode>,
    pub response_timeout: Span,
    pub retries: u8,
    /// First interval between tries of a unit that does not answer.
    pub probe_min: Span,
    pub probe_max: Span,
    /// Silence after a broadcast.
    pub turnaround: Span,
    /// Registers or bits not asked for that are read along to save a request.
    pub max_gap: u16,
    /// Most registers of one request that was put together; bits: 16 times as many.
    pub max_batch: u16,
    pub connect_timeout: Span,
    /// Age of the image above which writes go to their safe state.
    pub stale_after: Span,
    pub safe_on: Vec<SafeOn>,
    #[serde(rename = "unit")]
    pub units: Vec<Unit>,
    #[serde(rename = "read")]
    pub reads: Vec<Read>,
    #[serde(rename = "write")]
    pub writes: Vec<Write>,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            plc: None,
            serial: None,
            tcp: None,
            mode: None,
            response_timeout: Span::from_ms(1000),
            retries: 1,
            probe_min: Span::from_ms(1000),
            probe_max: Span::from_ms(60_000),
            turnaround: Span::from_ms(200),
            max_gap: 8,
            max_batch: 125,
            connect_timeout: Span::from_ms(2000),
            stale_after: STALE_AFTER,
            safe_on: SafeOn::ALL.to_vec(),
            units: Vec::new(),
            reads: Vec::new(),
            writes: Vec::new(),
        }
    }
}

/// A unit: its number, or the name a `[[service.unit]]` gave it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged, expecting = "a unit id from 0 to 255, or the name of a [[service.unit]]")]
pub enum UnitRef {
    Number(u8),
    Name(String),
}

/// One `[[service.unit]]`: what differs for a unit.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Unit {
    /// Unit id.
    pub id: u8,
    #[serde(default)]
    pub name: Option<String>,
    /// A connection of its own.
    #[serde(default)]
    pub tcp: Option<SocketAddr>,
    #[serde(default)]
    pub response_timeout: Option<Span>,
    #[serde(default)]
    pub retries: Option<u8>,
}

/// IEC types of points.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "UPPERCASE")]
pub enum IecType {
    Bool,
    Byte,
    Usint,
    Sint,
    Word,
    Uint,
    Int,
    Dword,
    Udint,
    Dint,
    Real,
    Lword,
    Ulint,
    Lint,
    Lreal,
}

impl IecType {
    /// As in programs.
    pub fn name(self) -> &'static str {
        match self {
            Self::Bool => "BOOL",
            Self::Byte => "BYTE",
            Self::Usint => "USINT",
            Self::Sint => "SINT",
            Self::Word => "WORD",
            Self::Uint => "UINT",
            Self::Int => "INT",
            Self::Dword => "DWORD",
            Self::Udint => "UDINT",
            Self::Dint => "DINT",
            Self::Real => "REAL",
            Self::Lword => "LWORD",
            Self::Ulint => "ULINT",
            Self::Lint => "LINT",
            Self::Lreal => "LREAL",
        }
    }

    /// 1, 8, 16, 32 or 64.
    pub fn bits(self) -> u32 {
        match self {
            Self::Bool => 1,
            Self::Byte | Self::Usint | Self::Sint => 8,
            Self::Word | Self::Uint | Self::Int => 16,
            Self::Dword | Self::Udint | Self::Dint | Self::Real => 32,
            Self::Lword | Self::Ulint | Self::Lint | Self::Lreal => 64,
        }
    }
}

/// Value while bad.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum OnBad {
    /// The last value stays.
    #[default]
    Hold,
    /// All bits 0.
    Zero,
}

/// One `[[service.read]]`: registers or bits that are read into %I.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Read {
    pub unit: UnitRef,
    pub table: Table,
    /// First address, 0-based as in the PDU.
    pub at: u16,
    /// Number of bits or registers. Default: one value of the width of `to`.
    #[serde(default)]
    pub count: Option<u16>,
    /// Place in %I.
    pub to: String,
    /// Order of bytes on the wire. Default ABCD.
    #[serde(default)]
    pub order: Order,
    /// 0 = as often as the line allows.
    #[serde(default = "default_period")]
    pub period: Span,
    /// Default: by the width of `to`.
    #[serde(default, rename = "type")]
    pub iec: Option<IecType>,
    #[serde(default)]
    pub symbol: Option<String>,
    /// Older values are bad. Default: three periods and a response timeout.
    #[serde(default)]
    pub timeout: Option<Span>,
    #[serde(default)]
    pub on_bad: OnBad,
    /// %IB that shows the quality to the program.
    #[serde(default)]
    pub status_to: Option<String>,
}

/// Which function codes a write uses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Function {
    /// 5 and 6 for one entry, 15 and 16 for several.
    #[default]
    Auto,
    /// 15 and 16 always.
    Multiple,
}

/// One `[[service.write]]`: registers or bits that follow %Q or %M.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Write {
    /// 0 on a serial line is a broadcast.
    pub unit: UnitRef,
    /// `coils` or `holding_registers`.
    pub table: Table,
    pub at: u16,
    #[serde(default)]
    pub count: Option<u16>,
    /// Place in %Q or %M.
    pub from: String,
    #[serde(default)]
    pub order: Order,
    /// Written when it changed. Default true.
    #[serde(default = "yes")]
    pub on_change: bool,
    /// Written at least this often.
    #[serde(default)]
    pub period: Option<Span>,
    #[serde(default)]
    pub function: Function,
    #[serde(default, rename = "type")]
    pub iec: Option<IecType>,
    #[serde(default)]
    pub symbol: Option<String>,
    /// Safe state: nothing is written any more. Or these values, once: one a value of the range.
    #[serde(default)]
    pub safe_values: Option<Vec<f64>>,
}

impl Config {
    /// What is true for every unit that says nothing else.
    pub fn unit_settings(&self) -> UnitSettings {
        UnitSettings {
            response_timeout_ns: self.response_timeout.ns(),
            retries: self.retries,
            probe_min_ns: self.probe_min.ns(),
            probe_max_ns: self.probe_max.ns(),
        }
    }
}

fn default_period() -> Span {
    Span::from_ms(1000)
}
fn yes() -> bool {
    true
}
