//! The service's table of the stack file, and its lines and routes.

use super::cache::CacheRange;
use super::core::{LineSetup, MAX_LINES, Rules};
use crate::client::line::{MAX_JOBS, Settings, UnitSettings};
pub use crate::client::plan::Mistake;
use crate::client::port::SEND_LIMIT_NS;
use crate::config::Tcp;
use crate::protocol::pdu::{MAX_READ_BITS, MAX_READ_WORDS};
use crate::server::Table;
use ipc_types::units::Span;
use serde::{Deserialize, Serialize};

/// Most `cache` ranges.
pub const MAX_CACHE: usize = 256;

/// How frames look on a serial line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Mode {
    #[default]
    Rtu,
    Ascii,
}

/// What a master gets for a broadcast.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Broadcast {
    /// Nothing, as on the line.
    #[default]
    Silent,
    /// The confirmation that a unit would have given.
    Answer,
}

/// One `[[service.port]]`: a line besides, or instead of, `serial`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Port {
    /// The serial service.
    pub serial: String,
    #[serde(default)]
    pub mode: Mode,
    #[serde(default)]
    pub response_timeout: Option<Span>,
}

/// One entry of `units`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Unit {
    /// Unit id that masters use.
    pub tcp: u8,
    /// Address on the line. Default: the same.
    #[serde(default)]
    pub line: Option<u8>,
    /// Serial service. Default: `serial`.
    #[serde(default)]
    pub port: Option<String>,
}

/// One entry of `cache`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CacheEntry {
    /// Unit id that masters use.
    pub unit: u8,
    pub table: Table,
    pub at: u16,
    pub count: u16,
    #[serde(default = "second")]
    pub period: Span,
    /// Older values are read from the unit. Default: three periods.
    #[serde(default)]
    pub max_age: Option<Span>,
}

fn second() -> Span {
    Span::from_ms(1000)
}

/// A service of kind `modbus-gateway`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    pub tcp: Tcp,
    /// The serial service whose units have the same ids on both sides.
    pub serial: Option<String>,
    pub mode: Mode,
    /// More lines.
    pub port: Vec<Port>,
    /// Ids that differ, or lie on another line.
    pub units: Vec<Unit>,
    /// Only `units` are reached.
    pub only_units: bool,
    pub response_timeout: Span,
    pub retries: u8,
    pub turnaround: Span,
    /// Requests of all masters that may wait for a line.
    pub queue: u32,
    pub max_wait: Span,
    pub broadcast: Broadcast,
    pub probe_min: Span,
    pub probe_max: Span,
    pub cache: Vec<CacheEntry>,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            tcp: Tcp::default(),
            serial: None,
            mode: Mode::Rtu,
            port: Vec::new(),
            units: Vec::new(),
            only_units: false,
            response_timeout: Span::from_ms(1000),
            retries: 0,
            turnaround: Span::from_ms(200),
            queue: 32,
            max_wait: Span::from_ms(5000),
            broadcast: Broadcast::Silent,
            probe_min: Span::from_ms(1000),
            probe_max: Span::from_ms(60_000),
            cache: Vec::new(),
        }
    }
}

/// A line of the gateway.
#[derive(Debug, Clone)]
pub struct PortPlan {
    pub serial: String,
    /// Where the stack file names it.
    pub key: String,
    pub ascii: bool,
    pub setup: LineSetup,
}

/// Everything the service does.
#[derive(Debug, Clone)]
pub struct Plan {
    pub ports: Vec<PortPlan>,
    /// Line and address there, by unit id of the masters.
    pub routes: [Option<(u8, u8)>; 256],
    pub cache: Vec<CacheRange>,
    pub rules: Rules,
    /// Empty: the plan can run.
    pub mistakes: Vec<Mistake>,
}

impl Config {
    /// Resolves the table; entries with a mistake are left out.
    pub fn plan(&self) -> Plan {
        let rules =
            Rules { max_wait_ns: self.max_wait.ns(), answer_broadcasts: self.broadcast == Broadcast::Answer };
        let mut plan =
            Plan { ports: Vec::new(), routes: [None; 256], cache: Vec::new(), rules, mistakes: Vec::new() };
        self.check_whole(&mut plan);
        if let Some(serial) = &self.serial {
            plan.ports.push(self.port_plan(serial, "serial", self.mode, None));
            if !self.only_units {
                // 248 to 255 are reserved on serial lines (V1.02, 2.2).
                for unit in 0..248u8 {
                    plan.routes[usize::from(unit)] = Some((0, unit));
                }
            }
        }
        for (i, port) in self.port.iter().take(MAX_LINES).enumerate() {
            let key = format!("port[{i}].serial");
            if plan.ports.iter().any(|other| other.serial == port.serial) {
                plan.wrong(key, format!("'{}' is a line of the gateway already", port.serial), "remove it");
                continue;
            }
            plan.ports.push(self.port_plan(&port.serial, &key, port.mode, port.response_timeout));
        }
        for (i, unit) in self.units.iter().enumerate() {
            self.route(i, unit, &mut plan);
        }
        for (i, entry) in self.cache.iter().take(MAX_CACHE).enumerate() {
            cached(i, entry, &mut plan);
        }
        plan
    }

    fn check_whole(&self, plan: &mut Plan) {
        if self.serial.is_none() && self.port.is_empty() {
            plan.wrong("serial", "the gateway has no line", "add serial = \"NAME\" of a serial service");
        }
        if self.port.len() + usize::from(self.serial.is_some()) > MAX_LINES {
            plan.wrong("port", format!("more than {MAX_LINES} lines"), "use a second modbus-gateway");
        }
        if self.queue == 0 || self.queue as usize > MAX_JOBS {
            plan.wrong(
                "queue",
                format!("queue = {} is not 1 to {MAX_JOBS}", self.queue),
                "32 is the default",
            );
        }
        if self.cache.len() > MAX_CACHE {
            plan.wrong("cache", format!("more than {MAX_CACHE} ranges"), "join ranges");
        }
        for (key, span) in [("response_timeout", self.response_timeout), ("max_wait", self.max_wait)] {
            if span < Span::from_ms(1) {
                plan.wrong(key, format!("{key} = {span} is too short"), "use at least 1ms");
            }
        }
        if self.probe_max < self.probe_min {
            plan.wrong(
                "probe_max",
                "probe_max is shorter than probe_min",
                "exchange them, or leave them out",
            );
        }
        if self.tcp.max_connections == 0 || self.tcp.max_connections > crate::config::MAX_CONNECTIONS {
            let message =
                format!("{} is not 1 to {}", self.tcp.max_connections, crate::config::MAX_CONNECTIONS);
            plan.wrong("tcp.max_connections", message, "8 is the default");
        }
        if let Some((fault, help)) = self.tcp.filter.as_ref().and_then(|filter| filter.fault()) {
            plan.wrong("tcp.filter", fault, help);
        }
    }

    fn port_plan(&self, serial: &str, key: &str, mode: Mode, timeout: Option<Span>) -> PortPlan {
        let unit = UnitSettings {
            response_timeout_ns: timeout.unwrap_or(self.response_timeout).ns(),
            retries: self.retries,
            probe_min_ns: self.probe_min.ns(),
            probe_max_ns: self.probe_max.ns(),
        };
        let settings = Settings {
            serial: true,
            turnaround_ns: Some(self.turnaround.ns()),
            send_limit_ns: SEND_LIMIT_NS,
        };
        PortPlan {
            serial: serial.to_owned(),
            key: key.to_owned(),
            ascii: mode == Mode::Ascii,
            setup: LineSetup { settings, unit, queue: self.queue as usize },
        }
    }

    fn route(&self, i: usize, unit: &Unit, plan: &mut Plan) {
        let port = match &unit.port {
            Some(port) => plan.ports.iter().position(|p| p.serial == *port),
            None if plan.ports.len() == 1 || self.serial.is_some() => Some(0),
            None => None,
        };
        let Some(port) = port else {
            let names: Vec<&str> = plan.ports.iter().map(|p| p.serial.as_str()).collect();
            let message = match &unit.port {
                Some(port) => format!("'{port}' is no line of the gateway"),
                None => "there are several lines: which one?".to_owned(),
            };
            plan.wrong(
                format!("units[{i}].port"),
                message,
                format!("set it to one of: {}", names.join(", ")),
            );
            return;
        };
        if let Some(other) = self.units[..i].iter().position(|other| other.tcp == unit.tcp) {
            let message = format!("unit {} stands in units[{other}] too", unit.tcp);
            plan.wrong(format!("units[{i}].tcp"), message, "one entry a unit id");
            return;
        }
        let on_line = unit.line.unwrap_or(unit.tcp);
        if on_line > 247 {
            let help = "use 1 to 247, or 0 for a broadcast";
            plan.wrong(format!("units[{i}].line"), format!("{on_line} is no address of a serial line"), help);
            return;
        }
        plan.routes[usize::from(unit.tcp)] = Some((port as u8, on_line));
    }
}

impl Plan {
    fn wrong(&mut self, key: impl Into<String>, message: impl Into<String>, help: impl Into<String>) {
        self.mistakes.push(Mistake { key: key.into(), message: message.into(), help: help.into() });
    }
}

fn cached(i: usize, entry: &CacheEntry, plan: &mut Plan) {
    let key = format!("cache[{i}]");
    let most = if entry.table.is_bits() { MAX_READ_BITS } else { MAX_READ_WORDS };
    if entry.count == 0 || entry.count > most {
        let message = format!("{} {}: one request reads 1 to {most}", entry.count, entry.table.name());
        return plan.wrong(format!("{key}.count"), message, "split the range");
    }
    if u32::from(entry.at) + u32::from(entry.count) > 65_536 {
        return plan.wrong(format!("{key}.at"), "the range ends behind address 65535", "lower at or count");
    }
    match plan.routes[usize::from(entry.unit)] {
        Some((line, unit)) if unit != 0 => plan.cache.push(CacheRange {
            line: usize::from(line),
            unit,
            table: entry.table,
            at: entry.at,
            count: entry.count,
            period_ns: entry.period.ns(),
            max_age_ns: entry.max_age.map_or(entry.period.ns().saturating_mul(3), |age| age.ns()),
        }),
        _ => {
            plan.wrong(
                format!("{key}.unit"),
                format!("unit {} is on no line", entry.unit),
                "map it in units",
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::{Value, json};

    fn plan(value: Value) -> Plan {
        serde_json::from_value::<Config>(value).unwrap().plan()
    }

    #[test]
    fn routes() {
        let plan = plan(json!({
            "serial": "com1", "port": [{ "serial": "com2", "mode": "ascii", "response_timeout": "300ms" }],
            "units": [{ "tcp": 1, "line": 5, "port": "com2" }, { "tcp": 255, "line": 9 }],
            "cache": [{ "unit": 1, "table": "holding", "at": 0, "count": 10 }],
        }));
        assert_eq!(plan.mistakes, []);
        let routes = |unit: usize| plan.routes[unit];
        assert_eq!(
            (routes(1), routes(2), routes(255), routes(254)),
            (Some((1, 5)), Some((0, 2)), Some((0, 9)), None)
        );
        assert!(plan.ports[1].ascii && plan.ports[1].setup.unit.response_timeout_ns == 300_000_000);
        let range = &plan.cache[0];
        assert_eq!((range.line, range.unit, range.max_age_ns), (1, 5, 3_000_000_000));
        let only = plan_only();
        assert_eq!(only.routes.iter().flatten().count(), 1);
    }

    fn plan_only() -> Plan {
        plan(json!({ "serial": "com1", "only_units": true, "units": [{ "tcp": 3 }] }))
    }

    #[test]
    fn mistakes_are_named() {
        let said = |value: Value| {
            let mistakes = plan(value).mistakes;
            mistakes
                .iter()
                .map(|m| format!("{}: {} -> {}", m.key, m.message, m.help))
                .collect::<Vec<_>>()
                .join("\n")
        };
        let all = [
            said(json!({})),
            said(json!({ "serial": "com1", "queue": 65, "response_timeout": "1us", "probe_max": "1ms" })),
            said(json!({ "serial": "com1", "tcp": { "max_connections": 0 } })),
            said(json!({ "serial": "com1", "port": [{ "serial": "com1" }] })),
            said(
                json!({ "port": [{ "serial": "com1" }, { "serial": "com2" }], "units": [{ "tcp": 1 }, { "tcp": 2, "port": "com3" }] }),
            ),
            said(
                json!({ "serial": "com1", "units": [{ "tcp": 1 }, { "tcp": 1, "line": 2 }, { "tcp": 255 }] }),
            ),
            said(json!({ "serial": "com1", "cache": [
                { "unit": 1, "table": "coils", "at": 0, "count": 2001 }, { "unit": 1, "table": "holding", "at": 65535, "count": 2 },
                { "unit": 250, "table": "holding", "at": 0, "count": 2 }] })),
        ];
        insta::assert_snapshot!(all.join("\n"), @r#"
        serial: the gateway has no line -> add serial = "NAME" of a serial service
        queue: queue = 65 is not 1 to 64 -> 32 is the default
        response_timeout: response_timeout = 1us is too short -> use at least 1ms
        probe_max: probe_max is shorter than probe_min -> exchange them, or leave them out
        tcp.max_connections: 0 is not 1 to 1024 -> 8 is the default
        port[0].serial: 'com1' is a line of the gateway already -> remove it
        units[0].port: there are several lines: which one? -> set it to one of: com1, com2
        units[1].port: 'com3' is no line of the gateway -> set it to one of: com1, com2
        units[1].tcp: unit 1 stands in units[0] too -> one entry a unit id
        units[2].line: 255 is no address of a serial line -> use 1 to 247, or 0 for a broadcast
        cache[0].count: 2001 coils: one request reads 1 to 2000 -> split the range
        cache[1].at: the range ends behind address 65535 -> lower at or count
        cache[2].unit: unit 250 is on no line -> map it in units
        "#);
    }
}
