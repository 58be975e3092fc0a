//! Lines and the units on them.

use super::super::config::{Config, MAX_LINES, Mode, Unit, UnitRef};
use super::super::line::UnitSettings;
use super::{LinePlan, Plan, Target, UnitPlan};
use ipc_types::units::Span;
use std::net::SocketAddr;

/// The service's own line, if it has one.
pub(super) fn own_target(config: &Config) -> Option<Target> {
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

pub(super) fn plan_unit(config: &Config, i: usize, unit: &Unit, plan: &mut Plan) {
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
    let base = config.unit_settings();
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
                Err(match names.as_slice() {
                    [] => format!("no unit has the name '{name}', and none has any name"),
                    names => format!("no unit has the name '{name}'; there are: {}", names.join(", ")),
                })
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

/// Whether a unit was declared and left out because it has no line.
fn lacks_line(config: &Config, unit: &UnitRef, plan: &Plan) -> bool {
    match unit {
        UnitRef::Name(name) => config.units.iter().any(|u| u.name.as_ref() == Some(name)),
        UnitRef::Number(number) => {
            let planned = plan.lines.iter().any(|line| line.units.iter().any(|u| u.unit == *number));
            !planned && config.units.iter().any(|u| u.id == *number)
        }
    }
}

pub(super) fn unit_of(config: &Config, unit: &UnitRef, key: &str, plan: &mut Plan) -> Option<(usize, u8)> {
    match find_unit(&plan.lines, unit, own_target(config).is_some()) {
        Ok((line, number)) => {
            if !plan.lines[line].units.iter().any(|u| u.unit == number) {
                let settings = config.unit_settings();
                plan.lines[line].units.push(UnitPlan { unit: number, name: None, settings });
            }
            Some((line, number))
        }
        // What is wrong with its line was told.
        Err(_) if plan.lines.is_empty() || lacks_line(config, unit, plan) => None,
        Err(message) => {
            plan.wrong(format!("{key}.unit"), message, "add a [[service.unit]], or correct the unit");
            None
        }
    }
}
