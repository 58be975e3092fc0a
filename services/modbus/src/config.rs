//! The service's table of the stack file.

use crate::map_config::{MapConfig, area_of};
use crate::session::UnitRule;
use crate::tcp::{Options, WhenFull};
use dinrail_iec::{AddressError, AddressSize, Addressing, parse_address};
use ipc_types::image_write::{Builder, Op};
use ipc_types::net::IpFilter;
use ipc_types::units::Span;
use ipc_types::wiring::Area;
use serde::{Deserialize, Serialize};
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

/// The key `tcp`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Tcp {
    pub address: IpAddr,
    pub port: u16,
    pub max_connections: u32,
    pub filter: Option<IpFilter>,
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
            when_full: WhenFull::Refuse,
        }
    }
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
    /// Whether connections are accepted.
    pub enable: bool,
    /// The plc service; the only one by default.
    pub plc: Option<String>,
    pub tcp: Tcp,
    /// Units served besides 0 and 255; all when absent.
    pub units: Option<Vec<u8>>,
    pub map: MapConfig,
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
            plc: None,
            tcp: Tcp::default(),
            units: None,
            map: MapConfig::default(),
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

impl Config {
    /// Rules of admission.
    pub fn options(&self) -> Options {
        Options {
            max_connections: self.tcp.max_connections as usize,
            filter: self.tcp.filter,
            units: self.units.as_deref().map_or_else(UnitRule::any, UnitRule::only),
            idle_timeout: (self.tcp.idle_timeout.ns() > 0).then(|| self.tcp.idle_timeout.duration()),
            when_full: self.tcp.when_full,
            min_idle: Duration::from_secs(1),
        }
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
