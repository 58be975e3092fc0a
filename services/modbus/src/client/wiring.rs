//! What the service declares and checks without starting.

use super::config::{Config, Mode, OnBad as OnBadWord, UnitRef};
use super::image::InputTable;
use super::order::Order;
use super::plan::{Plan, ReadRange, Target, plan};
use crate::map_config::traditional_number;
use dinrail_iec::{Addressing, parse_address};
use ipc_types::stack::ServiceEntry;
use ipc_types::topic::TopicKind;
use ipc_types::wiring::{Area, ImageRange, Neighbours, OnBad, TopicDecl};
use ipc_types::{Finding, Stack, Wiring, plc_table};

/// What the service needs of the launcher.
pub fn topics(config: &Config, neighbours: &Neighbours) -> Wiring {
    let plc = neighbours.resolve("plc", config.plc.as_deref());
    let addressing = Addressing::from_name(neighbours.addressing(plc.as_deref())).unwrap_or_default();
    let Plan { lines, reads, writes, .. } = plan(config, addressing);
    let mut wiring = Wiring { plc, ..Wiring::default() };
    if !reads.is_empty() {
        let tail = InputTable::new(&reads).tail().len() as u32;
        wiring.topics.push(TopicDecl::new(TopicKind::Inputs).max_tail(tail.max(1)));
    }
    wiring.own(TopicKind::Jobs).own(TopicKind::Results);
    let me = &neighbours.name;
    wiring.read(TopicKind::Jobs.of(me), true, "");
    if let Some(plc) = wiring.plc.clone().filter(|_| !writes.is_empty()) {
        wiring.read(TopicKind::Image.of(&plc), true, "plc");
    }
    for line in &lines {
        if let Target::Serial { service, .. } = &line.target {
            wiring.read(TopicKind::SerialRx.of(service), true, "serial");
            wiring.write(TopicKind::SerialTx.of(service), "serial");
        }
    }
    wiring.inputs = reads.iter().map(|range| input_range(config, range)).collect();
    for range in &writes {
        let write = &config.writes[range.index];
        wiring.outputs.push(ImageRange {
            area: range.area,
            byte: range.byte,
            bit: (range.table.is_bits() && range.count == 1).then_some(range.bit),
            bytes: range.bytes,
            type_name: type_name(&write.from, write.iec, write.symbol.is_some(), addressing),
            symbol: write.symbol.clone(),
            label: format!(
                "to unit {}, {}{}",
                range.unit,
                points(range.table, range.at, range.count),
                order(range.group, range.order)
            ),
            key: format!("write[{}].from", range.index),
            on_bad: OnBad::Hold,
            status_byte: None,
        });
    }
    wiring
}

/// Entries in words: `holding_registers 0-1 (40001...)`.
pub(super) fn points(table: crate::server::Table, at: u16, count: u16) -> String {
    let first = traditional_number(table, at);
    if count == 1 {
        format!("{} {at} ({first})", table.name())
    } else {
        format!("{} {at}-{} ({first}...)", table.name(), u32::from(at) + u32::from(count) - 1)
    }
}

/// The order of values of several registers.
fn order(group: usize, order: Order) -> String {
    if group > 1 { format!(" {}", order.name()) } else { String::new() }
}

/// IEC type of a symbol: as given, or by the width of its address.
fn type_name(
    address: &str,
    iec: Option<super::config::IecType>,
    symbol: bool,
    addressing: Addressing,
) -> Option<String> {
    if let Some(iec) = iec {
        return Some(iec.name().to_owned());
    }
    let bits = parse_address(address, addressing).ok().filter(|_| symbol)?.size.bits();
    let name = match bits {
        1 => "BOOL",
        8 => "BYTE",
        16 => "WORD",
        32 => "DWORD",
        _ => "LWORD",
    };
    Some(name.to_owned())
}

fn input_range(config: &Config, range: &ReadRange) -> ImageRange {
    let read = &config.reads[range.index];
    // The width of an address does not depend on how it counts.
    let type_name = type_name(&read.to, read.iec, read.symbol.is_some(), Addressing::default());
    ImageRange {
        area: Area::Input,
        byte: range.byte,
        bit: range.bit,
        bytes: range.bytes,
        type_name,
        symbol: read.symbol.clone(),
        label: format!(
            "from unit {}, {}{}",
            range.unit,
            points(range.table, range.at, range.count),
            order(range.group, range.order)
        ),
        key: format!("read[{}].to", range.index),
        on_bad: match range.on_bad {
            OnBadWord::Hold => OnBad::Hold,
            OnBadWord::Zero => OnBad::Zero,
        },
        status_byte: range.status_byte,
    }
}

/// The plc service whose image is exchanged, and how its addresses count.
pub(super) fn plc_of<'a>(stack: &'a Stack, wiring: &Wiring) -> (Option<&'a ServiceEntry>, Addressing) {
    let plc = stack.plc_of(wiring);
    let addressing = plc.and_then(|plc| Addressing::from_name(plc_table::addressing(&plc.config)));
    (plc, addressing.unwrap_or_default())
}

/// What is wrong with the serial service of a key, if anything.
pub(crate) fn check_serial(me: &str, key: &str, service: &str, ascii: bool, stack: &Stack) -> Vec<Finding> {
    let Some(entry) = stack.service(service).filter(|s| s.kind == "serial") else {
        let names: Vec<&str> =
            stack.services.iter().filter(|s| s.kind == "serial").map(|s| s.name.as_str()).collect();
        let help = if names.is_empty() {
            "add a [[service]] with kind = \"serial\"".to_owned()
        } else {
            format!("set it to one of: {}", names.join(", "))
        };
        return vec![Finding::error(me, key, format!("there is no serial service '{service}'"), help)];
    };
    let mut found: Vec<Finding> = Vec::new();
    let framing = entry.config.get("framing").and_then(|f| f.as_str()).unwrap_or("rtu");
    let wanted = if ascii { "ascii" } else { "rtu" };
    if framing != wanted {
        let message = format!("serial service '{service}' has framing \"{framing}\"");
        let help = format!("set framing = \"{wanted}\" there, or change mode here");
        found.push(Finding::error(me, key, message, help));
    }
    let mut before = stack.services.iter().take_while(|other| other.name != me);
    if let Some(other) = before.find(|other| masters(other).any(|line| line == service)) {
        let message = format!("'{}' is a master on the line of '{service}' already", other.name);
        let help = "a line has one master, else requests and answers collide: put the units of both into one service, or use another line";
        found.push(Finding::error(me, key, message, help));
    }
    found
}

/// The serial services on whose lines a service is the master.
fn masters(entry: &ServiceEntry) -> impl Iterator<Item = &str> {
    let is_master = matches!(entry.kind.as_str(), "modbus-client" | "modbus-gateway");
    let own = entry.config.get("serial").and_then(|name| name.as_str());
    let ports = entry.config.get("port").and_then(|ports| ports.as_array()).into_iter().flatten();
    let more = ports.filter_map(|port| port.get("serial").and_then(|name| name.as_str()));
    own.into_iter().chain(more).filter(move |_| is_master)
}

/// Units that only a number names beside others that are declared: each once. They work, and are typing errors.
fn undeclared(config: &Config, me: &str) -> Vec<Finding> {
    if config.units.is_empty() {
        return Vec::new();
    }
    let reads = config.reads.iter().enumerate().map(|(i, read)| (format!("read[{i}].unit"), &read.unit));
    let writes = config.writes.iter().enumerate().map(|(i, write)| (format!("write[{i}].unit"), &write.unit));
    let declared: Vec<String> = config
        .units
        .iter()
        .map(|unit| match &unit.name {
            Some(name) => format!("{} (\"{name}\")", unit.id),
            None => unit.id.to_string(),
        })
        .collect();
    let (mut told, mut found) = (Vec::new(), Vec::new());
    for (key, unit) in reads.chain(writes) {
        // 0 is the broadcast.
        let &UnitRef::Number(number @ 1..) = unit else { continue };
        if config.units.iter().any(|unit| unit.id == number) || told.contains(&number) {
            continue;
        }
        told.push(number);
        let message = format!(
            "unit {number} has no [[service.unit]], as other units have; did you mean {}?",
            declared.join(" or ")
        );
        let help = format!("write the unit meant, or add [[service.unit]] with id = {number}");
        found.push(Finding::warning(me, &key, message, help));
    }
    found
}

/// Every mistake that can be found without starting.
pub fn check(config: &Config, stack: &Stack, me: &ServiceEntry) -> Vec<Finding> {
    let name = &me.name;
    let (plc, addressing) = plc_of(stack, &me.wiring);
    let plan = plan(config, addressing);
    let mut found: Vec<Finding> = plan.mistakes.iter().map(|m| m.finding(name)).collect();
    if config.reads.is_empty() && config.writes.is_empty() {
        let help = "add [[service.read]] or [[service.write]]; jobs of others are carried out in any case";
        found.push(Finding::warning(name, "", "the service has neither read nor write", help));
    }
    for (i, read) in config.reads.iter().enumerate() {
        if let Some(timeout) = read.timeout.filter(|timeout| *timeout <= read.period) {
            let message = format!(
                "timeout = {timeout} is not longer than period = {}: the value turns stale between two reads",
                read.period
            );
            let help =
                "leave it out (three periods and a response timeout), or give it more than two periods";
            found.push(Finding::warning(name, &format!("read[{i}].timeout"), message, help));
        }
    }
    found.extend(undeclared(config, name));
    if let Some(service) = &config.serial {
        found.extend(check_serial(name, "serial", service, config.mode == Some(Mode::Ascii), stack));
    }
    if config.plc.is_none() && plc.is_none() && !(config.reads.is_empty() && config.writes.is_empty()) {
        let count = stack.services.iter().filter(|s| s.kind == "plc").count();
        let (message, help) = if count == 0 {
            (
                "the stack has no plc service",
                "add a [[service]] with kind = \"plc\"; it works without a program too",
            )
        } else {
            ("the stack has several plc services", "say which one: plc = \"NAME\"")
        };
        found.push(Finding::error(name, "plc", message, help));
    }
    if !config.writes.is_empty() {
        found.extend(plc.and_then(|plc| plc_table::check_stale_after(name, config.stale_after, plc)));
    }
    found
}

#[cfg(test)]
#[path = "wiring_tests.rs"]
mod tests;
