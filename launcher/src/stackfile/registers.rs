//! Registers that Modbus clients may write and that the program assigns as well: the program wins, so the client
//! writes for nothing. Asked only of tables the stack file writes out; the ready maps show everything on purpose.

use super::document::Document;
use super::place::Sink;
use dinrail_iec::LocatedAddress;
use dinrail_iec::artifact::{self, AreaKind};
use dinrail_modbus::map_config::{MapConfig, MapEntry, traditional_number};
use dinrail_modbus::server::{Access, Table};
use dinrail_plc::program;
use ipc_types::stack::{ServiceEntry, Stack};
use ipc_types::wiring::{Area, AreaSizes};

/// Warns once for each `[[service.map]]` or `[[service.unit.map]]` table with such a register.
pub fn check(document: &Document, stack: &Stack, sink: &mut Sink<'_>) {
    for server in stack.services.iter().filter(|s| s.kind == "modbus-server") {
        let Ok(config) = serde_json::from_value::<dinrail_modbus::Config>(server.config.clone()) else {
            continue;
        };
        if !config.maps().any(|map| matches!(map, MapConfig::Tables(_))) {
            continue;
        }
        let Some(plc) = server.wiring.plc.as_deref().and_then(|p| stack.service(p)) else { continue };
        let assigned = assignments(stack, plc);
        let own = config.unit.iter().enumerate();
        let own = own.map(|(i, unit)| (format!("unit[{i}].map"), format!(" of unit {}", unit.id)));
        let keys = std::iter::once(("map".to_owned(), String::new())).chain(own);
        for ((key, unit), map) in keys.zip(config.maps()) {
            let Some(found) = contested(map, plc, &assigned) else { continue };
            for Contested { index, register, address, place } in found {
                sink.warning(
                    &document.place(&server.name, &format!("{key}[{index}]")),
                    format!(
                        "Modbus clients may write {register}{unit}, but the program assigns {address} too ({place}), and wins"
                    ),
                    "show it as input_registers or discrete_inputs, or let the program leave it alone",
                );
            }
        }
    }
}

/// A register or coil that clients may write and the program assigns.
struct Contested {
    /// Of the table, from 0.
    index: usize,
    register: String,
    address: String,
    /// In the program.
    place: String,
}

/// The first such one of each table; `None` for a ready map and one that cannot be built.
fn contested(
    map: &MapConfig,
    plc: &ServiceEntry,
    assigned: &[(artifact::Access, String)],
) -> Option<Vec<Contested>> {
    let MapConfig::Tables(tables) = map else { return None };
    let addressing = dinrail_modbus::service::addressing_of(Some(plc));
    let built = map.build(AreaSizes::MAX, addressing).ok()?;
    let mut found: Vec<Contested> = Vec::new();
    for (access, place) in assigned {
        for (area, byte, bit) in places(access) {
            for (table, at) in built.entries_at(area, byte, bit) {
                let Some(index) = tables.iter().position(|t| shows(t, table, at)) else { continue };
                let read_only = matches!(table, Table::DiscreteInputs | Table::InputRegisters);
                let warned = found.iter().any(|f| f.index == index);
                if warned || read_only || built.check(Access::Write, table, at, 1).is_err() {
                    continue;
                }
                let bytes = if bit.is_some() { 1 } else { 2 };
                let address = LocatedAddress::new(area.letter(), byte, bit, bytes);
                let address = address.map(|a| a.text(addressing).unwrap_or_else(|| a.to_string()));
                found.push(Contested {
                    index,
                    register: format!("{} {at} ({})", table.name(), traditional_number(table, at)),
                    address: address.unwrap_or_default(),
                    place: place.clone(),
                });
            }
        }
    }
    Some(found)
}

fn shows(entry: &MapEntry, table: Table, at: u16) -> bool {
    entry.table == table && (entry.at..entry.at.saturating_add(entry.count)).contains(&u32::from(at))
}

/// What the program assigns in %Q and %M, each with its place in the source.
fn assignments(stack: &Stack, plc: &ServiceEntry) -> Vec<(artifact::Access, String)> {
    let Ok(config) = serde_json::from_value::<dinrail_plc::Config>(plc.config.clone()) else {
        return Vec::new();
    };
    if config.program.is_empty() {
        return Vec::new();
    }
    let setup = program::setup(&config, stack, &plc.name);
    // What does not compile is the plc's own finding.
    let Ok(compiled) = program::load(&stack.dir, &config.program, &setup) else { return Vec::new() };
    let map = &compiled.program.artifact.map;
    map.writes.iter().map(|access| (access.clone(), map.place_text(access.statement))).collect()
}

/// The bit, or the words, that an assignment touches: area, byte, bit.
fn places(access: &artifact::Access) -> Vec<(Area, u32, Option<u8>)> {
    let area = match access.area {
        AreaKind::Output => Area::Output,
        AreaKind::Marker => Area::Marker,
        AreaKind::Input | AreaKind::Retain | AreaKind::Data => return Vec::new(),
    };
    let first = access.byte & !1;
    let mut list: Vec<_> = access.bit.map(|bit| (area, access.byte, Some(bit))).into_iter().collect();
    let words = (first..access.byte.saturating_add(access.bytes.max(1))).step_by(2);
    list.extend(words.map(|byte| (area, byte, None)));
    list
}
