//! The service's table of the stack file.

use crate::admission::{Admission, Filter};
use crate::buffers::{FifoEntry, FileEntry};
use crate::identity::IdentityConfig;
use crate::line::Mode;
use crate::map_config::{MapConfig, area_of};
use crate::process_image::BitPlace;
use crate::rights::RightsEntry;
use crate::session::Framing;
use crate::tcp::{Options, WhenFull};
use dinrail_iec::{AddressError, AddressSize, Addressing, parse_address};
use ipc_types::image_write::{Builder, Op};
use ipc_types::units::Span;
use ipc_types::wiring::Area;
use serde::{Deserialize, Deserializer, Serialize, de};
use std::fmt;
use std::net::{IpAddr, Ipv4Addr};
use std::time::Duration;

/// Most connections that may be configured.
pub const MAX_CONNECTIONS: u32 = 1024;

/// What requests get while the PLC does not run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OnStop {
    /// Reads and writes are answered by exception 04.
    #[default]
    Exception,
    /// Reads show the last image; writes are taken as long as the engine lives.
    Hold,
}

/// Most serial lines of a server.
pub const MAX_LINES: usize = 8;

/// The key `tcp`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Tcp {
    pub address: IpAddr,
    pub port: u16,
    pub max_connections: u32,
    pub filter: Option<Filter>,
    /// 0 = never.
    pub idle_timeout: Span,
    pub when_full: WhenFull,
}

impl Default for Tcp {
    fn default() -> Self {
        Self {
            address: IpAddr::V4(Ipv4Addr::UNSPECIFIED),
            port: 502,
            max_connections: 8,
            filter: None,
            idle_timeout: Span::from_ms(60_000),
            when_full: WhenFull::default(),
        }
    }
}

/// One unit identifier or several.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct UnitIds(pub Vec<u8>);

impl Serialize for UnitIds {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self.0.as_slice() {
            [one] => one.serialize(serializer),
            list => list.serialize(serializer),
        }
    }
}

impl<'de> Deserialize<'de> for UnitIds {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Visit;
        impl<'de> de::Visitor<'de> for Visit {
            type Value = UnitIds;
            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("a unit identifier from 1 to 247, or a list of them")
            }
            fn visit_i64<E: de::Error>(self, n: i64) -> Result<UnitIds, E> {
                u8::try_from(n)
                    .map(|n| UnitIds(vec![n]))
                    .map_err(|_| E::invalid_value(de::Unexpected::Signed(n), &self))
            }
            fn visit_u64<E: de::Error>(self, n: u64) -> Result<UnitIds, E> {
                u8::try_from(n)
                    .map(|n| UnitIds(vec![n]))
                    .map_err(|_| E::invalid_value(de::Unexpected::Unsigned(n), &self))
            }
            fn visit_seq<A: de::SeqAccess<'de>>(self, seq: A) -> Result<UnitIds, A::Error> {
                Vec::deserialize(de::value::SeqAccessDeserializer::new(seq)).map(UnitIds)
            }
        }
        deserializer.deserialize_any(Visit)
    }
}

/// The key `rtu_over_tcp`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RtuOverTcp {
    pub port: u16,
    /// Units answered.
    #[serde(default = "unit_one")]
    pub unit: UnitIds,
    /// Whether unit 255 is answered as the first of them.
    #[serde(default)]
    pub answer_255: bool,
    #[serde(default = "any_address")]
    pub address: IpAddr,
    #[serde(default = "eight")]
    pub max_connections: u32,
    #[serde(default)]
    pub filter: Option<Filter>,
    #[serde(default = "one_minute")]
    pub idle_timeout: Span,
    #[serde(default)]
    pub when_full: WhenFull,
}

fn any_address() -> IpAddr {
    Tcp::default().address
}

fn eight() -> u32 {
    Tcp::default().max_connections
}

fn one_minute() -> Span {
    Tcp::default().idle_timeout
}

impl RtuOverTcp {
    /// What it has in common with Modbus TCP.
    pub fn tcp(&self) -> Tcp {
        Tcp {
            address: self.address,
            port: self.port,
            max_connections: self.max_connections,
            filter: self.filter.clone(),
            idle_timeout: self.idle_timeout,
            when_full: self.when_full,
        }
    }
}

/// One line of the key `serial`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SerialLine {
    /// The serial service.
    pub port: String,
    #[serde(default)]
    pub mode: Mode,
    /// Units answered on this line.
    #[serde(default = "unit_one")]
    pub unit: UnitIds,
    /// Whether unit 255 is answered as the first of them.
    #[serde(default)]
    pub answer_255: bool,
    /// An answer that could not leave the port for so long is dropped.
    #[serde(default = "answer_within")]
    pub answer_within: Span,
}

impl SerialLine {
    /// Unit identifiers that get an answer on this line.
    pub fn answers(&self) -> impl Iterator<Item = u8> {
        let any = self.answer_255.then_some(crate::device::ANY_UNIT);
        self.unit.0.iter().copied().chain(any)
    }
}

fn unit_one() -> UnitIds {
    UnitIds(vec![1])
}

fn answer_within() -> Span {
    Span::from_ms(1000)
}

/// A `[[service.unit]]` table: a unit with a register map of its own.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct UnitEntry {
    pub id: u8,
    pub map: MapConfig,
}

/// A value to write when no client has written for `write_watchdog`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WatchdogValue {
    /// %-address in %Q or %M.
    pub to: String,
    pub value: Value,
}

/// A boolean or an integer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Value {
    Bool(bool),
    Int(i64),
}

/// The service's table of the stack file, without the launcher's keys.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Whether requests are served, at start.
    pub enable: bool,
    /// %-address of a bit that must be true for requests to be served.
    pub enable_from: Option<String>,
    /// The plc service; the only one by default.
    pub plc: Option<String>,
    /// Absent: the default if there is no other transport, else none.
    pub tcp: Option<Tcp>,
    pub rtu_over_tcp: Option<RtuOverTcp>,
    pub serial: Vec<SerialLine>,
    /// Units served on TCP besides 0 and 255; all when absent.
    pub units: Option<Vec<u8>>,
    pub map: MapConfig,
    pub unit: Vec<UnitEntry>,
    pub rights: Vec<RightsEntry>,
    pub file: Vec<FileEntry>,
    pub fifo: Vec<FifoEntry>,
    pub identity: IdentityConfig,
    /// Function 7: up to eight bits, or one byte.
    pub exception_status: Vec<String>,
    /// Whether functions 7, 8, 11, 12 and 17 are served over Modbus TCP.
    pub serial_codes_on_tcp: bool,
    /// %I address of the list of clients.
    pub clients_to: Option<String>,
    pub on_stop: OnStop,
    /// Age from which the image is not believed.
    pub stale_after: Span,
    /// Absent = no watchdog.
    pub write_watchdog: Option<Span>,
    pub watchdog_values: Vec<WatchdogValue>,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            enable: true,
            enable_from: None,
            plc: None,
            tcp: None,
            rtu_over_tcp: None,
            serial: Vec::new(),
            units: None,
            map: MapConfig::default(),
            unit: Vec::new(),
            rights: Vec::new(),
            file: Vec::new(),
            fifo: Vec::new(),
            identity: IdentityConfig::default(),
            exception_status: Vec::new(),
            serial_codes_on_tcp: true,
            clients_to: None,
            on_stop: OnStop::Exception,
            stale_after: Span::from_ms(200),
            write_watchdog: None,
            watchdog_values: Vec::new(),
        }
    }
}

/// A watchdog value that cannot be written. `entry` counts from 1.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum WatchdogError {
    #[error("watchdog value {entry}: {source}")]
    Address { entry: usize, source: AddressError },
    #[error("watchdog value {entry}: {to} is an input; write a value to %Q or %M")]
    Input { entry: usize, to: String },
    #[error("watchdog value {entry}: {to} is a bit; its value is true or false")]
    NotBool { entry: usize, to: String },
    #[error("watchdog value {entry}: {value} does not fit {to}, which takes {low} to {high}")]
    Range { entry: usize, to: String, value: i64, low: i64, high: i64 },
    #[error("watchdog value {entry}: there are too many; at most 16 values are written at once")]
    TooMany { entry: usize },
}

impl WatchdogError {
    /// The value's index, from 0.
    pub fn index(&self) -> usize {
        match self {
            Self::Address { entry, .. }
            | Self::Input { entry, .. }
            | Self::NotBool { entry, .. }
            | Self::Range { entry, .. }
            | Self::TooMany { entry } => entry - 1,
        }
    }
}

/// A place of the image that a key names wrongly.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PlaceError {
    #[error("{key}: {source}")]
    Address { key: &'static str, source: AddressError },
    #[error("{key}: {got} is no bit; write one like %MX0.0")]
    NotBit { key: &'static str, got: String },
    #[error("{key}: {got} is no place for the list of clients; write a byte of %I like %IB100")]
    NotInputByte { key: &'static str, got: String },
    #[error("exception_status: eight bits are shown; give at most eight, or one byte like %QB0")]
    TooManyBits,
}

impl PlaceError {
    /// The key it is about.
    pub fn key(&self) -> &'static str {
        match self {
            Self::Address { key, .. } | Self::NotBit { key, .. } | Self::NotInputByte { key, .. } => key,
            Self::TooManyBits => "exception_status",
        }
    }
}

/// Most clients in the list of `clients_to`.
pub const MAX_CLIENT_SLOTS: u32 = 64;

impl Tcp {
    /// Rules of admission.
    pub fn options(&self, framing: Framing) -> Options {
        Options {
            max_connections: self.max_connections as usize,
            filter: Admission::new(self.filter.as_ref()),
            framing,
            idle_timeout: (self.idle_timeout.ns() > 0).then(|| self.idle_timeout.duration()),
            when_full: self.when_full,
            min_idle: Duration::from_secs(1),
        }
    }
}

impl Config {
    /// Modbus TCP, if it is served.
    pub fn tcp(&self) -> Option<Tcp> {
        let alone = self.serial.is_empty() && self.rtu_over_tcp.is_none();
        self.tcp.clone().or_else(|| alone.then(Tcp::default))
    }

    /// Serial services in the order of the key `serial`.
    pub fn lines(&self) -> Vec<&str> {
        self.serial.iter().map(|line| line.port.as_str()).collect()
    }

    /// Units with maps of their own, as (unit, index of the map).
    pub fn own_units(&self) -> Vec<(u8, usize)> {
        self.unit.iter().enumerate().map(|(i, unit)| (unit.id, i + 1)).collect()
    }

    /// Units of a line with the indexes of their maps.
    pub fn units_of(&self, ids: &UnitIds) -> Vec<(u8, usize)> {
        let own = self.own_units();
        let map_of = |id: u8| own.iter().find(|(unit, _)| *unit == id).map_or(0, |(_, map)| *map);
        ids.0.iter().map(|&id| (id, map_of(id))).collect()
    }

    /// The register maps, the common one first.
    pub fn maps(&self) -> impl Iterator<Item = &MapConfig> {
        std::iter::once(&self.map).chain(self.unit.iter().map(|unit| &unit.map))
    }

    /// The bit of `enable_from`.
    pub fn enable_bit(&self, addressing: Addressing) -> Result<Option<BitPlace>, PlaceError> {
        self.enable_from.as_deref().map(|text| bit_place("enable_from", text, addressing)).transpose()
    }

    /// The bits of `exception_status`, the lowest first.
    pub fn exception_bits(&self, addressing: Addressing) -> Result<[Option<BitPlace>; 8], PlaceError> {
        const KEY: &str = "exception_status";
        let mut bits = [None; 8];
        if let [text] = self.exception_status.as_slice() {
            let address =
                parse_address(text, addressing).map_err(|source| PlaceError::Address { key: KEY, source })?;
            if address.size == AddressSize::Byte {
                let area = area_of(address);
                for (bit, slot) in (0..).zip(&mut bits) {
                    *slot = Some(BitPlace { area, byte: address.byte, bit });
                }
                return Ok(bits);
            }
        }
        if self.exception_status.len() > bits.len() {
            return Err(PlaceError::TooManyBits);
        }
        for (slot, text) in bits.iter_mut().zip(&self.exception_status) {
            *slot = Some(bit_place(KEY, text, addressing)?);
        }
        Ok(bits)
    }

    /// Clients that the list of `clients_to` has room for.
    pub fn client_slots(&self) -> u32 {
        let tcp = self.tcp().map_or(0, |tcp| tcp.max_connections);
        let rtu = self.rtu_over_tcp.as_ref().map_or(0, |rtu| rtu.max_connections);
        tcp.saturating_add(rtu).min(MAX_CLIENT_SLOTS)
    }

    /// Byte of %I and length of the list of clients.
    pub fn client_list(&self, addressing: Addressing) -> Result<Option<(u32, u32)>, PlaceError> {
        const KEY: &str = "clients_to";
        let Some(text) = self.clients_to.as_deref() else { return Ok(None) };
        let address =
            parse_address(text, addressing).map_err(|source| PlaceError::Address { key: KEY, source })?;
        if area_of(address) != Area::Input || address.size == AddressSize::Bit {
            return Err(PlaceError::NotInputByte { key: KEY, got: text.to_owned() });
        }
        Ok(Some((address.byte, crate::process_image::client_list_bytes(self.client_slots()))))
    }

    /// The watchdog's values as one message to the PLC, whose addresses count in this way.
    pub fn watchdog_write(&self, addressing: Addressing) -> Result<Builder, WatchdogError> {
        let mut builder = Builder::default();
        for (i, config) in self.watchdog_values.iter().enumerate() {
            push_value(i + 1, config, addressing, &mut builder)?;
        }
        Ok(builder)
    }
}

fn bit_place(key: &'static str, text: &str, addressing: Addressing) -> Result<BitPlace, PlaceError> {
    let address = parse_address(text, addressing).map_err(|source| PlaceError::Address { key, source })?;
    match (address.size, address.bit) {
        (AddressSize::Bit, Some(bit)) => Ok(BitPlace { area: area_of(address), byte: address.byte, bit }),
        _ => Err(PlaceError::NotBit { key, got: text.to_owned() }),
    }
}

fn push_value(
    entry: usize,
    config: &WatchdogValue,
    addressing: Addressing,
    builder: &mut Builder,
) -> Result<(), WatchdogError> {
    let to = || config.to.clone();
    let address =
        parse_address(&config.to, addressing).map_err(|source| WatchdogError::Address { entry, source })?;
    let (area, offset) = (area_of(address), address.byte);
    if area == Area::Input {
        return Err(WatchdogError::Input { entry, to: to() });
    }
    let pushed = match (address.size, config.value) {
        (AddressSize::Bit, Value::Bool(on)) => {
            let mask = 1_u8 << address.bit.unwrap_or(0);
            builder.push(&Op::Mask { area, offset, and: &[!mask], or: &[if on { mask } else { 0 }] })
        }
        (AddressSize::Bit, Value::Int(_)) => return Err(WatchdogError::NotBool { entry, to: to() }),
        (size, value) => {
            let value = match value {
                Value::Int(n) => n,
                Value::Bool(on) => i64::from(on),
            };
            let bits = size.bits();
            let (low, high) =
                if bits == 64 { (i64::MIN, i64::MAX) } else { (-(1_i64 << (bits - 1)), (1_i64 << bits) - 1) };
            if !(low..=high).contains(&value) {
                return Err(WatchdogError::Range { entry, to: to(), value, low, high });
            }
            let bytes = value.to_le_bytes();
            builder.push(&Op::Set { area, offset, bytes: &bytes[..size.bytes() as usize] })
        }
    };
    pushed.map_err(|_| WatchdogError::TooMany { entry })
}

#[cfg(test)]
#[path = "config_tests.rs"]
mod tests;
