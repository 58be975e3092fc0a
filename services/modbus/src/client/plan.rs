//! From the stack file to lines, requests and ranges: every address and unit resolved, every mistake named.
//!
//! Reads of the same unit, table and period whose gaps are at most `max_gap` become one request of at most
//! `max_batch` registers. When the unit answers that request by exception 02 or 03, which gaps may cause, its ranges
//! are read one by one from then on ([`Batch::alone`]).

use super::config::{
    Config, Function, MAX_LINES, MAX_READS, MAX_UNITS, MAX_WRITES, Mode, OnBad, Read, UnitRef, Write,
};
use super::line::UnitSettings;
use super::order::Order;
use crate::map_config::area_of;
use crate::protocol::pdu::{MAX_READ_BITS, MAX_READ_WORDS, MAX_WRITE_BITS, MAX_WRITE_WORDS};
use crate::server::Table;
use dinrail_iec::{AddressSize, Addressing, LocatedAddress, parse_address};
use ipc_types::units::Span;
use ipc_types::wiring::Area;
use std::net::SocketAddr;

/// Something wrong in the service's table.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Mistake {
    /// Path of the key: `read[2].to`.
    pub key: String,
    pub message: String,
    pub help: String,
}

/// Where a line goes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Target {
    /// Through a serial service of the stack.
    Serial { service: String, ascii: bool },
    /// Modbus TCP.
    Tcp(SocketAddr),
    /// RTU frames on a TCP connection.
    RtuOverTcp(SocketAddr),
}

impl std::fmt::Display for Target {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Serial { service, ascii: false } => write!(f, "{service} (RTU)"),
            Self::Serial { service, ascii: true } => write!(f, "{service} (ASCII)"),
            Self::Tcp(address) => write!(f, "tcp://{address}"),
            Self::RtuOverTcp(address) => write!(f, "rtu-over-tcp://{address}"),
        }
    }
}

/// A unit on its line.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UnitPlan {
    pub unit: u8,
    pub name: Option<String>,
    pub settings: UnitSettings,
}

/// A line with its units and requests.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LinePlan {
    pub target: Target,
    pub units: Vec<UnitPlan>,
    pub batches: Vec<Batch>,
}

/// A read request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Batch {
    pub unit: u8,
    pub table: Table,
    pub at: u16,
    pub count: u16,
    pub period_ns: u64,
    /// Ranges in it: index of [`Plan::reads`], entries from the batch's begin.
    pub members: Vec<(usize, u16)>,
    /// Batches of the line to use instead when the unit does not like this one.
    pub alone: Vec<usize>,
    /// False: only after the batch that it is a part of was refused.
    pub enabled: bool,
}

/// What is read into %I.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ReadRange {
    /// Of its `[[service.read]]`.
    pub index: usize,
    pub line: usize,
    pub unit: u8,
    pub table: Table,
    pub at: u16,
    /// Bits or registers.
    pub count: u16,
    /// First byte of %I.
    pub byte: u32,
    /// A single bit.
    pub bit: Option<u8>,
    /// Bytes of %I.
    pub bytes: u32,
    /// Registers of a value: 1, 2, 4.
    pub group: usize,
    pub order: Order,
    pub period_ns: u64,
    pub timeout_ns: u64,
    pub on_bad: OnBad,
    pub status_byte: Option<u32>,
}

/// What is written from %Q or %M.
#[derive(Debug, Clone, PartialEq)]
pub struct WriteRange {
    pub index: usize,
    pub line: usize,
    pub unit: u8,
    pub table: Table,
    pub at: u16,
    pub count: u16,
    pub area: Area,
    pub byte: u32,
    /// First bit, for coils.
    pub bit: u8,
    pub bytes: u32,
    pub group: usize,
    pub order: Order,
    pub on_change: bool,
    pub period_ns: Option<u64>,
    pub multiple: bool,
    /// Values of the safe state as they go on the wire; `None`: nothing is written.
    pub safe: Option<Vec<u8>>,
}

/// Everything the service does.
#[derive(Debug, Clone, Default)]
pub struct Plan {
    pub lines: Vec<LinePlan>,
    pub reads: Vec<ReadRange>,
    pub writes: Vec<WriteRange>,
    /// Empty: the plan can run.
    pub mistakes: Vec<Mistake>,
}

impl Plan {
    fn wrong(&mut self, key: impl Into<String>, message: impl Into<String>, help: impl Into<String>) {
        self.mistakes.push(Mistake { key: key.into(), message: message.into(), help: help.into() });
    }
}

/// The service's own line, if it has one.
fn own_target(config: &Config) -> Option<Target> {
    match (&config.serial, config.tcp) {
        (Some(service), _) => {
            Some(Target::Serial { service: service.clone(), ascii: config.mode == Some(Mode::Ascii) })
        }
        (None, Some(address)) => Some(tcp_target(config, address)),
        (None, None) => None,
    }
}

fn tcp_target(config: &Config, address: SocketAddr) -> Target {
    if config.mode == Some(Mode::Rtu) && config.serial.is_none() {
        Target::RtuOverTcp(address)
    } else {
        Target::Tcp(address)
    }
}

/// Resolves the table; its addresses count as those of the plc. Entries with a mistake are left out.
pub fn plan(config: &Config, addressing: Addressing) -> Plan {
    let mut plan = Plan::default();
    check_whole(config, &mut plan);
    if let Some(target) = own_target(config) {
        plan.lines.push(LinePlan { target, units: Vec::new(), batches: Vec::new() });
    }
    for (i, unit) in config.units.iter().take(MAX_UNITS).enumerate() {
        plan_unit(config, i, unit, &mut plan);
    }
    for (index, read) in config.reads.iter().take(MAX_READS).enumerate() {
        if let Some(range) = plan_read(config, addressing, index, read, &mut plan) {
            plan.reads.push(range);
        }
    }
    for (index, write) in config.writes.iter().take(MAX_WRITES).enumerate() {
        if let Some(range) = plan_write(config, addressing, index, write, &mut plan) {
            plan.writes.push(range);
        }
    }
    overlaps(&mut plan);
    for line in 0..plan.lines.len() {
        plan.lines[line].batches = batches(config, &plan.reads, line);
    }
    plan
}

fn check_whole(config: &Config, plan: &mut Plan) {
    let limits = [
        ("read", config.reads.len(), MAX_READS),
        ("write", config.writes.len(), MAX_WRITES),
        ("unit", config.units.len(), MAX_UNITS),
    ];
    for (what, count, limit) in limits {
        if count > limit {
            let message = format!("{count} entries: a modbus-client has at most {limit}");
            plan.wrong(what, message, "split them over two modbus-client services");
        }
    }
    match (&config.serial, config.tcp, config.mode) {
        (Some(_), Some(_), _) => {
            plan.wrong("tcp", "the service has a serial line and a connection", "remove serial or tcp");
        }
        (Some(_), None, Some(Mode::Tcp)) => {
            plan.wrong(
                "mode",
                "mode \"tcp\" is for connections",
                "use \"rtu\" or \"ascii\" on a serial line",
            );
        }
        (None, _, Some(Mode::Ascii)) => {
            let help = "use \"tcp\", or \"rtu\" for a converter that passes RTU frames on";
            plan.wrong("mode", "mode \"ascii\" is for serial lines", help);
        }
        (None, None, _) if config.units.iter().all(|unit| unit.tcp.is_none()) => {
            let help = "add serial = \"NAME\", or tcp = \"ADDRESS:502\"";
            plan.wrong("", "the service has no line: neither serial nor tcp", help);
        }
        _ => {}
    }
    let words = 1..=MAX_READ_WORDS;
    if !words.contains(&config.max_batch) {
        plan.wrong(
            "max_batch",
            format!("max_batch = {} is not 1 to 125", config.max_batch),
            "125 is the default",
        );
    }
    for (key, span) in [("response_timeout", config.response_timeout), ("probe_min", config.probe_min)] {
        if span < Span::from_ms(1) {
            plan.wrong(key, format!("{key} = {span} is too short"), "use at least 1ms; 1s is the default");
        }
    }
    if config.probe_max < config.probe_min {
        plan.wrong("probe_max", "probe_max is shorter than probe_min", "exchange them, or leave them out");
    }
}

fn settings(config: &Config) -> UnitSettings {
    UnitSettings {
        response_timeout_ns: config.response_timeout.ns(),
        retries: config.retries,
        probe_min_ns: config.probe_min.ns(),
        probe_max_ns: config.probe_max.ns(),
    }
}

fn plan_unit(config: &Config, i: usize, unit: &super::config::Unit, plan: &mut Plan) {
    let target = match unit.tcp {
        Some(address) => Some(tcp_target(config, address)),
        None => own_target(config),
    };
    let Some(target) = target else {
        let help = "give it tcp = \"ADDRESS:502\", or give the service a line";
        plan.wrong(format!("unit[{i}]"), format!("unit {} has no line", unit.id), help);
        return;
    };
    if let Some(name) = &unit.name {
        let before = config.units[..i].iter().position(|other| other.name.as_ref() == Some(name));
        if let Some(other) = before {
            let help = "give every unit a name of its own";
            plan.wrong(format!("unit[{i}].name"), format!("unit[{other}] has the name '{name}' too"), help);
        }
    }
    if unit.response_timeout.is_some_and(|t| t < Span::from_ms(1)) {
        plan.wrong(format!("unit[{i}].response_timeout"), "this is too short", "use at least 1ms");
    }
    let line = plan.lines.iter().position(|line| line.target == target).unwrap_or_else(|| {
        plan.lines.push(LinePlan { target, units: Vec::new(), batches: Vec::new() });
        plan.lines.len() - 1
    });
    if plan.lines.len() > MAX_LINES {
        let help = "split the units over two modbus-client services";
        plan.wrong(format!("unit[{i}].tcp"), format!("more than {MAX_LINES} connections"), help);
    }
    if plan.lines[line].units.iter().any(|other| other.unit == unit.id) {
        let help = "one [[service.unit]] a unit and line";
        plan.wrong(format!("unit[{i}].id"), format!("unit {} stands twice on its line", unit.id), help);
        return;
    }
    let base = settings(config);
    plan.lines[line].units.push(UnitPlan {
        unit: unit.id,
        name: unit.name.clone(),
        settings: UnitSettings {
            response_timeout_ns: unit.response_timeout.map_or(base.response_timeout_ns, |t| t.ns()),
            retries: unit.retries.unwrap_or(base.retries),
            ..base
        },
    });
}

/// Line and unit that a key means.
pub fn find_unit(lines: &[LinePlan], unit: &UnitRef, has_own: bool) -> Result<(usize, u8), String> {
    let all = || lines.iter().enumerate().flat_map(|(i, line)| line.units.iter().map(move |u| (i, u)));
    match unit {
        UnitRef::Name(name) => match all().find(|(_, u)| u.name.as_ref() == Some(name)) {
            Some((line, unit)) => Ok((line, unit.unit)),
            None => {
                let names: Vec<&str> = all().filter_map(|(_, u)| u.name.as_deref()).collect();
                Err(format!("no unit has the name '{name}'; there are: {}", names.join(", ")))
            }
        },
        UnitRef::Number(number) => {
            let found: Vec<usize> = all().filter(|(_, u)| u.unit == *number).map(|(line, _)| line).collect();
            match found.as_slice() {
                [line] => Ok((*line, *number)),
                [] if has_own => Ok((0, *number)),
                [] => Err(format!(
                    "no [[service.unit]] has the id {number}, and the service has no line of its own"
                )),
                _ => Err(format!(
                    "{} units have the id {number}; call the one you mean by its name",
                    found.len()
                )),
            }
        }
    }
}

fn unit_of(config: &Config, unit: &UnitRef, key: &str, plan: &mut Plan) -> Option<(usize, u8)> {
    match find_unit(&plan.lines, unit, own_target(config).is_some()) {
        Ok((line, number)) => {
            if !plan.lines[line].units.iter().any(|u| u.unit == number) {
                let settings = settings(config);
                plan.lines[line].units.push(UnitPlan { unit: number, name: None, settings });
            }
            Some((line, number))
        }
        Err(message) => {
            plan.wrong(format!("{key}.unit"), message, "add a [[service.unit]], or correct the unit");
            None
        }
    }
}

/// Where a range lies in the image, and how many entries it has.
struct Place {
    address: LocatedAddress,
    count: u16,
    bytes: u32,
    group: usize,
}

struct Wanted<'a> {
    key: &'a str,
    address_key: &'a str,
    address: &'a str,
    areas: &'a [Area],
    table: Table,
    at: u16,
    count: Option<u16>,
    order: Order,
    iec: Option<super::config::IecType>,
    symbol: Option<&'a str>,
    most: u16,
}

fn place(addressing: Addressing, wanted: &Wanted<'_>, plan: &mut Plan) -> Option<Place> {
    let (key, address_key) = (wanted.key, format!("{}.{}", wanted.key, wanted.address_key));
    let address = match parse_address(wanted.address, addressing) {
        Ok(address) => address,
        Err(e) => {
            plan.wrong(
                address_key,
                e.to_string(),
                "the plc service's `addressing` says how numbers are counted",
            );
            return None;
        }
    };
    let before = plan.mistakes.len();
    if !wanted.areas.contains(&area_of(address)) {
        let (message, help) = if wanted.areas == [Area::Input] {
            (format!("{} is no input: what is read goes to %I", wanted.address), "write %I...")
        } else {
            (
                format!("{} is no output: what is written comes from %Q or %M", wanted.address),
                "write %Q... or %M...",
            )
        };
        plan.wrong(address_key.clone(), message, help);
    }
    let bits = wanted.table.is_bits();
    let group = if bits { 1 } else { (address.size.bytes() / 2).max(1) as usize };
    let fits = match address.size {
        AddressSize::Bit => bits,
        AddressSize::Byte => true,
        AddressSize::Word | AddressSize::Dword | AddressSize::Lword => !bits,
    };
    if !fits {
        let help =
            if bits { "use X or B addresses for bits" } else { "use B, W, D or L addresses for registers" };
        plan.wrong(address_key, format!("{} does not hold {}", wanted.address, wanted.table.name()), help);
        return None;
    }
    let default = match (bits, address.size) {
        (true, AddressSize::Byte) => 8,
        (true, _) => 1,
        (false, _) => group as u16,
    };
    let count = wanted.count.unwrap_or(default);
    if count == 0 || count > wanted.most {
        let message =
            format!("{count} {} in one range: 1 to {} are possible", wanted.table.name(), wanted.most);
        plan.wrong(format!("{key}.count"), message, "split the range");
    } else if u32::from(wanted.at) + u32::from(count) > 65_536 {
        plan.wrong(format!("{key}.at"), "the range ends behind address 65535", "lower at or count");
    }
    if !usize::from(count).is_multiple_of(group) {
        let message = format!("count {count} splits a value of {group} registers");
        plan.wrong(format!("{key}.count"), message, "D needs a multiple of 2, L of 4");
    }
    if bits && count > 1 && address.bit.unwrap_or(0) != 0 && wanted.areas == [Area::Input] {
        plan.wrong(
            format!("{key}.{}", wanted.address_key),
            "several bits begin in the middle of a byte",
            "begin at bit 0, or read them one by one",
        );
    }
    if !wanted.order.is_for(group) || (bits && wanted.order != Order::default()) {
        let message = format!("order {} is not possible here", wanted.order.name());
        let help =
            "AB and BA are for single registers, ABCD, DCBA, BADC, CDAB for %xD and %xL; bits have none";
        plan.wrong(format!("{key}.order"), message, help);
    }
    let single = if bits { count == 1 } else { usize::from(count) == group };
    if wanted.symbol.is_some() && !(single && address.size != AddressSize::Byte) {
        let help = "give the symbol to a range of one value, or declare a VAR AT in the program";
        plan.wrong(format!("{key}.symbol"), "a symbol names one value, and this range has several", help);
    }
    if let Some(iec) = wanted.iec.filter(|iec| iec.bits() != address.size.bits()) {
        let message =
            format!("{} has {} bits, {} has {}", wanted.address, address.size.bits(), iec.name(), iec.bits());
        plan.wrong(format!("{key}.type"), message, "use X for BOOL, B, W, D, L for 8, 16, 32, 64 bits");
    }
    if plan.mistakes.len() > before {
        return None;
    }
    let bytes = if bits {
        (u32::from(address.bit.unwrap_or(0)) + u32::from(count)).div_ceil(8)
    } else {
        u32::from(count) * 2
    };
    if address.byte + bytes > 65_536 {
        let message = format!("{} and {bytes} bytes reach beyond 65536 bytes", wanted.address);
        plan.wrong(format!("{key}.{}", wanted.address_key), message, "lower the address or count");
        return None;
    }
    Some(Place { address, count, bytes, group })
}

fn plan_read(
    config: &Config,
    addressing: Addressing,
    index: usize,
    read: &Read,
    plan: &mut Plan,
) -> Option<ReadRange> {
    let key = format!("read[{index}]");
    let unit = unit_of(config, &read.unit, &key, plan);
    let wanted = Wanted {
        key: &key,
        address_key: "to",
        address: &read.to,
        areas: &[Area::Input],
        table: read.table,
        at: read.at,
        count: read.count,
        order: read.order,
        iec: read.iec,
        symbol: read.symbol.as_deref(),
        most: if read.table.is_bits() { MAX_READ_BITS } else { MAX_READ_WORDS },
    };
    let place = place(addressing, &wanted, plan);
    let status_byte = read.status_to.as_deref().and_then(|text| {
        let byte = parse_address(text, addressing)
            .ok()
            .filter(|a| area_of(*a) == Area::Input && a.size == AddressSize::Byte)
            .map(|a| a.byte);
        if byte.is_none() {
            let message = format!("'{text}' is no byte of the inputs");
            plan.wrong(format!("{key}.status_to"), message, "write %IB and a number, as %IB10");
        }
        byte
    });
    let ((line, unit), place) = (unit?, place?);
    if unit == 0 && matches!(plan.lines[line].target, Target::Serial { .. } | Target::RtuOverTcp(_)) {
        let help = "read from units 1 to 247";
        plan.wrong(format!("{key}.unit"), "unit 0 is the broadcast: nobody answers", help);
        return None;
    }
    let response_ns = plan.lines[line]
        .units
        .iter()
        .find(|u| u.unit == unit)
        .map_or(0, |u| u.settings.response_timeout_ns * (u64::from(u.settings.retries) + 1));
    let automatic = read.period.ns().max(1_000_000).saturating_mul(3).saturating_add(response_ns);
    Some(ReadRange {
        index,
        line,
        unit,
        table: read.table,
        at: read.at,
        count: place.count,
        byte: place.address.byte,
        bit: place.address.bit.filter(|_| place.count == 1),
        bytes: place.bytes,
        group: place.group,
        order: read.order,
        period_ns: read.period.ns(),
        timeout_ns: read.timeout.map_or(automatic, |t| t.ns()),
        on_bad: read.on_bad,
        status_byte,
    })
}

fn plan_write(
    config: &Config,
    addressing: Addressing,
    index: usize,
    write: &Write,
    plan: &mut Plan,
) -> Option<WriteRange> {
    let key = format!("write[{index}]");
    let unit = unit_of(config, &write.unit, &key, plan);
    if !matches!(write.table, Table::Coils | Table::HoldingRegisters) {
        let help = "use \"coils\" or \"holding_registers\"";
        plan.wrong(format!("{key}.table"), format!("{} cannot be written", write.table.name()), help);
        return None;
    }
    let wanted = Wanted {
        key: &key,
        address_key: "from",
        address: &write.from,
        areas: &[Area::Output, Area::Marker],
        table: write.table,
        at: write.at,
        count: write.count,
        order: write.order,
        iec: write.iec,
        symbol: write.symbol.as_deref(),
        most: if write.table.is_bits() { MAX_WRITE_BITS } else { MAX_WRITE_WORDS },
    };
    let place = place(addressing, &wanted, plan);
    if !write.on_change && write.period.is_none() {
        plan.wrong(key.clone(), "it is written neither on change nor by period", "add period = \"1s\"");
    }
    if write.period.is_some_and(|p| p < Span::from_ms(1)) {
        plan.wrong(format!("{key}.period"), "a period below 1ms is none", "use at least 1ms");
    }
    let ((line, unit), place) = (unit?, place?);
    let mut range = WriteRange {
        index,
        line,
        unit,
        table: write.table,
        at: write.at,
        count: place.count,
        area: area_of(place.address),
        byte: place.address.byte,
        bit: place.address.bit.unwrap_or(0),
        bytes: place.bytes,
        group: place.group,
        order: write.order,
        on_change: write.on_change,
        period_ns: write.period.map(|p| p.ns()),
        multiple: write.function == Function::Multiple,
        safe: None,
    };
    if let Some(values) = &write.safe_values {
        match safe_bytes(&range, write.iec, values) {
            Ok(bytes) => range.safe = Some(bytes),
            Err(message) => {
                plan.wrong(
                    format!("{key}.safe_values"),
                    message,
                    "give one number a value of the range, in its type",
                );
                return None;
            }
        }
    }
    Some(range)
}

/// The values of a safe state as they go on the wire.
fn safe_bytes(
    range: &WriteRange,
    iec: Option<super::config::IecType>,
    values: &[f64],
) -> Result<Vec<u8>, String> {
    use super::config::IecType;
    let count = usize::from(range.count) / range.group;
    if values.len() != count {
        return Err(format!("{} values for {count}", values.len()));
    }
    if range.table.is_bits() {
        let mut bytes = vec![0; count.div_ceil(8)];
        for (i, value) in values.iter().enumerate() {
            if *value != 0.0 && *value != 1.0 {
                return Err(format!("{value} is no bit"));
            }
            bytes[i / 8] |= u8::from(*value == 1.0) << (i % 8);
        }
        return Ok(bytes);
    }
    let mut bytes = Vec::with_capacity(count * range.group * 2);
    for value in values {
        match iec {
            Some(IecType::Real) => bytes.extend((*value as f32).to_le_bytes()),
            Some(IecType::Lreal) => bytes.extend(value.to_le_bytes()),
            _ => {
                let bits = range.group as i32 * 16;
                let low = -(2f64.powi(bits - 1));
                let high = 2f64.powi(bits) - 1.0;
                if value.fract() != 0.0 || !(low..=high).contains(value) {
                    return Err(format!("{value} is no whole number of {bits} bits"));
                }
                let whole = if *value < 0.0 { *value as i64 as u64 } else { *value as u64 };
                bytes.extend(&whole.to_le_bytes()[..range.group * 2]);
            }
        }
    }
    range.order.turn(range.group, &mut bytes);
    Ok(bytes)
}

/// Two reads on one place; the launcher finds those of two services.
fn overlaps(plan: &mut Plan) {
    let span = |range: &ReadRange| {
        let first = range.byte * 8 + u32::from(range.bit.unwrap_or(0));
        (first, first + if range.bit.is_some() { 1 } else { range.bytes * 8 })
    };
    let mut sorted: Vec<&ReadRange> = plan.reads.iter().collect();
    sorted.sort_by_key(|range| (span(range), range.index));
    let mut found = Vec::new();
    for pair in sorted.windows(2) {
        if let [a, b] = pair
            && span(b).0 < span(a).1
        {
            found.push((a.index.min(b.index), a.index.max(b.index)));
        }
    }
    for (low, high) in found {
        let message = format!("lies over read[{low}].to");
        plan.wrong(format!("read[{high}].to"), message, "give every bit of %I to one read only");
    }
}

/// The requests of a line: big ones first in the list, then those to be used when a unit refuses one.
fn batches(config: &Config, reads: &[ReadRange], line: usize) -> Vec<Batch> {
    let mut mine: Vec<usize> = (0..reads.len()).filter(|&i| reads[i].line == line).collect();
    mine.sort_by_key(|&i| (reads[i].unit, reads[i].table, reads[i].period_ns, reads[i].at, i));
    let mut batches: Vec<Batch> = Vec::new();
    for &i in &mine {
        let range = &reads[i];
        let limit = if range.table.is_bits() {
            (u32::from(config.max_batch) * 16).min(u32::from(MAX_READ_BITS))
        } else {
            u32::from(config.max_batch)
        };
        let end = u32::from(range.at) + u32::from(range.count);
        if let Some(last) = batches.last_mut() {
            let last_end = u32::from(last.at) + u32::from(last.count);
            let same = (last.unit, last.table, last.period_ns) == (range.unit, range.table, range.period_ns);
            let near = u32::from(range.at) <= last_end + u32::from(config.max_gap);
            let whole = last_end.max(end) - u32::from(last.at);
            if same && near && whole <= limit {
                last.members.push((i, range.at - last.at));
                last.count = whole as u16;
                continue;
            }
        }
        batches.push(single(range, i, true));
    }
    let big = batches.len();
    for b in 0..big {
        if batches[b].members.len() > 1 {
            let members: Vec<usize> = batches[b].members.iter().map(|m| m.0).collect();
            for i in members {
                let own = batches.len();
                batches[b].alone.push(own);
                batches.push(single(&reads[i], i, false));
            }
        }
    }
    batches
}

fn single(range: &ReadRange, i: usize, enabled: bool) -> Batch {
    Batch {
        unit: range.unit,
        table: range.table,
        at: range.at,
        count: range.count,
        period_ns: range.period_ns,
        members: vec![(i, 0)],
        alone: Vec::new(),
        enabled,
    }
}

#[cfg(test)]
#[path = "plan_tests.rs"]
mod tests;
