//! What is wrong with a configuration, as far as it can be seen without starting.

use super::{KIND, addressing_of};
use crate::admission::Filter;
use crate::buffers::Buffers;
use crate::config::{Config, MAX_CONNECTIONS, MAX_LINES, PlaceError, SerialLine};
use crate::line::Mode;
use crate::map_config::MapError;
use crate::rights::Rights;
use dinrail_iec::Addressing;
use ipc_types::stack::ServiceEntry;
use ipc_types::wiring::AreaSizes;
use ipc_types::{Finding, Stack, plc_table};

/// Every mistake that can be found without starting.
pub fn check(config: &Config, stack: &Stack, me: &ServiceEntry) -> Vec<Finding> {
    let service = me.name.as_str();
    let mut findings = Vec::new();
    check_plc(service, config, stack, &mut findings);
    check_tcp(service, config, &mut findings);
    let plc = chosen_plc(config, stack);
    let addressing = addressing_of(plc);
    let sizes = plc.map_or(AreaSizes::MAX, |plc| plc_table::areas(&plc.config));
    for (i, map) in config.maps().enumerate() {
        if let Err(error) = map.build(sizes, addressing) {
            let help = "see the page on the Modbus server for what a [[service.map]] table takes";
            let key = if i == 0 { map_key(&error) } else { format!("unit[{}].{}", i - 1, map_key(&error)) };
            findings.push(Finding::error(service, &key, error.to_string(), help));
        }
    }
    check_units(service, config, &mut findings);
    check_lines(service, config, stack, &mut findings);
    check_places(service, config, sizes, addressing, &mut findings);
    check_watchdog(service, config, addressing, &mut findings);
    findings
}

fn map_key(error: &MapError) -> String {
    match error.entry() {
        Some(entry) => format!("map[{}]", entry - 1),
        None => "map".to_owned(),
    }
}

fn chosen_plc<'a>(config: &Config, stack: &'a Stack) -> Option<&'a ServiceEntry> {
    let mut plcs = stack.services.iter().filter(|entry| entry.kind == "plc");
    match &config.plc {
        Some(name) => plcs.find(|entry| entry.name == *name),
        None => plcs.next().filter(|_| plcs.next().is_none()),
    }
}

fn check_plc(service: &str, config: &Config, stack: &Stack, findings: &mut Vec<Finding>) {
    let plcs: Vec<&str> =
        stack.services.iter().filter(|s| s.kind == "plc").map(|s| s.name.as_str()).collect();
    let Some(plc) = chosen_plc(config, stack) else {
        let message = match &config.plc {
            Some(name) => format!("there is no plc service '{name}'"),
            None if plcs.is_empty() => "the stack has no plc service whose image could be served".to_owned(),
            None => format!("the stack has {} plc services; which one is served?", plcs.len()),
        };
        let help = if plcs.is_empty() {
            "add a [[service]] with kind = \"plc\"; it works without a program too".to_owned()
        } else {
            format!("set plc to one of: {}", plcs.join(", "))
        };
        findings.push(Finding::error(service, "plc", message, help));
        return;
    };
    findings.extend(plc_table::check_stale_after(service, config.stale_after, plc));
}

fn check_tcp(service: &str, config: &Config, findings: &mut Vec<Finding>) {
    let tcp = config.tcp().map(|tcp| ("tcp", tcp));
    let rtu = config.rtu_over_tcp.as_ref().map(|rtu| ("rtu_over_tcp", rtu.tcp()));
    for (key, tcp) in tcp.into_iter().chain(rtu) {
        if tcp.max_connections == 0 || tcp.max_connections > MAX_CONNECTIONS {
            let message = format!("max_connections = {} is not 1 to {MAX_CONNECTIONS}", tcp.max_connections);
            let key = format!("{key}.max_connections");
            findings.push(Finding::error(service, &key, message, "8 is the default"));
        }
        if let Some((fault, help)) = tcp.filter.as_ref().and_then(Filter::fault) {
            findings.push(Finding::error(service, &format!("{key}.filter"), fault, help));
        }
        if config.enable && tcp.filter.is_none() && !tcp.address.is_loopback() {
            findings.push(Finding::warning(
                service,
                key,
                "Modbus has no passwords: whoever reaches this port can write outputs and markers",
                "add filter = { mask = ..., start = ..., end = ... }, or address = \"127.0.0.1\"",
            ));
        }
    }
    if config.units.as_ref().is_some_and(Vec::is_empty) && config.unit.is_empty() {
        let help = "leave units out to serve all, or list unit identifiers";
        findings.push(Finding::warning(service, "units", "only units 0 and 255 are served", help));
    }
}

/// Unit identifiers that no device may have, or that stand there twice.
fn check_ids(service: &str, key: &str, ids: &[u8], findings: &mut Vec<Finding>) {
    let help = "units are 1 to 247; 0 is the broadcast, 248 to 255 are reserved";
    if ids.is_empty() {
        findings.push(Finding::error(service, key, "no unit is answered", help));
    }
    if let Some(id) = ids.iter().find(|id| !(1..=247).contains(*id)) {
        findings.push(Finding::error(service, key, format!("unit {id} is no address of a device"), help));
    }
    if let Some((_, id)) = ids.iter().enumerate().find(|(i, id)| ids[..*i].contains(id)) {
        findings.push(Finding::error(service, key, format!("unit {id} stands there twice"), "remove one"));
    }
}

fn check_units(service: &str, config: &Config, findings: &mut Vec<Finding>) {
    for (i, unit) in config.unit.iter().enumerate() {
        let key = format!("unit[{i}].id");
        check_ids(service, &key, &[unit.id], findings);
        if config.unit[..i].iter().any(|other| other.id == unit.id) {
            let message = format!("unit {} has two maps", unit.id);
            findings.push(Finding::error(service, &key, message, "remove one [[service.unit]] table"));
        }
    }
    if let Some(rtu) = &config.rtu_over_tcp {
        check_ids(service, "rtu_over_tcp.unit", &rtu.unit.0, findings);
    }
    if let Err(error) = Rights::new(&config.rights, &config.lines()) {
        let key = error.index().map_or_else(|| "rights".to_owned(), |i| format!("rights[{i}]"));
        let help = "see the page on the Modbus server for what a [[service.rights]] table takes";
        findings.push(Finding::error(service, &key, error.to_string(), help));
    }
    if let Err(error) = config.identity.build() {
        findings.push(Finding::error(service, "identity", error.to_string(), "shorten or correct it"));
    }
}

fn check_lines(service: &str, config: &Config, stack: &Stack, findings: &mut Vec<Finding>) {
    if config.serial.len() > MAX_LINES {
        let message = format!("{} serial lines; at most {MAX_LINES} are allowed", config.serial.len());
        findings.push(Finding::error(service, "serial", message, "use a second modbus-server"));
    }
    for (i, line) in config.serial.iter().enumerate() {
        let key = |key: &str| format!("serial[{i}].{key}");
        check_ids(service, &key("unit"), &line.unit.0, findings);
        if config.serial[..i].iter().any(|other| other.port == line.port) {
            let message = format!("'{}' is served twice", line.port);
            let help = "give the one line all units: unit = [1, 2]";
            findings.push(Finding::error(service, &key("port"), message, help));
        }
        for (other, unit) in answered_too(service, line, stack) {
            let message = format!("unit {unit} on '{}' is answered by '{other}' too", line.port);
            let help = "two answers at once are none: give each unit of a line to one server";
            findings.push(Finding::error(service, &key("unit"), message, help));
        }
        if line.answer_within.ns() == 0 {
            let help = "leave it out (1s)";
            findings.push(Finding::error(service, &key("answer_within"), "no answer could be in time", help));
        }
        // "rtu" is what a serial service has without the key.
        let framing = stack
            .service(&line.port)
            .filter(|port| port.kind == "serial")
            .map(|port| port.config.get("framing").and_then(|framing| framing.as_str()).unwrap_or("rtu"));
        let wanted = match line.mode {
            Mode::Rtu => "rtu",
            Mode::Ascii => "ascii",
        };
        if let Some(framing) = framing.filter(|framing| *framing != wanted) {
            let message =
                format!("'{}' has framing = \"{framing}\", but {wanted} is served on it", line.port);
            let help = format!("set framing = \"{wanted}\" in '{}', or another mode here", line.port);
            findings.push(Finding::error(service, &key("mode"), message, help));
        }
    }
}

/// Units of a line that a server before this one in the stack file answers as well, the first of each server.
fn answered_too(me: &str, line: &SerialLine, stack: &Stack) -> Vec<(String, u8)> {
    let before = stack.services.iter().take_while(|other| other.name != me);
    let servers = before.filter(|other| other.kind == KIND).filter_map(|other| {
        let config: Config = serde_json::from_value(other.config.clone()).ok()?;
        let lines = config.serial.iter().filter(|theirs| theirs.port == line.port);
        let mut theirs = lines.flat_map(SerialLine::answers);
        let both = theirs.find(|unit| line.answers().any(|mine| mine == *unit))?;
        Some((other.name.clone(), both))
    });
    servers.collect()
}

fn check_places(
    service: &str,
    config: &Config,
    sizes: AreaSizes,
    addressing: Addressing,
    findings: &mut Vec<Finding>,
) {
    let mut place = |error: PlaceError| {
        let help = "see the page on the Modbus server";
        findings.push(Finding::error(service, error.key(), error.to_string(), help));
    };
    let _ = config.enable_bit(addressing).map_err(&mut place);
    let _ = config.exception_bits(addressing).map_err(&mut place);
    let list = config.client_list(addressing).map_err(&mut place).ok().flatten();
    if let Some((byte, bytes)) = list
        && byte + bytes > sizes.input
    {
        let message =
            format!("the list of clients reaches byte {} of %I, which has {}", byte + bytes, sizes.input);
        let help = "take an earlier place, lower max_connections, or raise input_bytes of the plc service";
        findings.push(Finding::error(service, "clients_to", message, help));
    }
    if let Err(error) = Buffers::new(&config.file, &config.fifo, sizes, addressing) {
        let help = "see the page on the Modbus server for files and queues";
        findings.push(Finding::error(service, &error.key(), error.to_string(), help));
    }
}

fn check_watchdog(service: &str, config: &Config, addressing: Addressing, findings: &mut Vec<Finding>) {
    if let Err(error) = config.watchdog_write(addressing) {
        let key = format!("watchdog_values[{}]", error.index());
        findings.push(Finding::error(service, &key, error.to_string(), "correct or remove the value"));
    }
    let owns = config
        .maps()
        .any(|map| map.build(AreaSizes::MAX, addressing).is_ok_and(|map| !map.own_inputs().is_empty()));
    match config.write_watchdog {
        None if !config.watchdog_values.is_empty() => {
            let help = "set write_watchdog, e.g. \"2s\", or remove the values";
            findings.push(Finding::error(service, "watchdog_values", "values without write_watchdog", help));
        }
        Some(_) if config.watchdog_values.is_empty() && !owns => {
            let help = "add watchdog_values = [ { to = \"%QW0\", value = 0 } ]";
            findings.push(Finding::error(
                service,
                "write_watchdog",
                "the watchdog has nothing to write",
                help,
            ));
        }
        Some(limit) if limit.ns() < 100_000_000 => {
            let help = "set at least \"100ms\", and twice the clients' period";
            let message = format!("write_watchdog = {limit} is shorter than it is looked at");
            findings.push(Finding::error(service, "write_watchdog", message, help));
        }
        _ => {}
    }
}
