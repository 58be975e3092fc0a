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

/// Warns once for each `[[service.map]]` table with such a register.
pub fn check(document: &Document, stack: &Stack, sink: &mut Sink<'_>) {
    for server in stack.services.iter().filter(|s| s.kind == "modbus-server") {
        let Ok(config) = serde_json::from_value::<dinrail_modbus::Config>(server.config.clone()) else {
            continue;
        };
        let MapConfig::Tables(tables) = &config.map else { continue };
        let plc = server.wiring.plc.as_deref().and_then(|p| stack.service(p));
        let addressing = dinrail_modbus::service::addressing_of(plc);
        let Ok(map) = config.map.build(AreaSizes::MAX, addressing) else { continue };
        let mut warned: Vec<usize> = Vec::new();
        for (access, place) in plc.map(|plc| assignments(stack, plc)).unwrap_or_default() {
            for (area, byte, bit) in places(&access) {
                for (table, at) in map.entries_at(area, byte, bit) {
                    let index = tables.iter().position(|t| shows(t, table, at));
                    let Some(index) = index.filter(|i| !warned.contains(i)) else { continue };
                    let read_only = matches!(table, Table::DiscreteInputs | Table::InputRegisters);
                    if read_only || map.check(Access::Write, table, at, 1).is_err() {
                        continue;
                    }
                    warned.push(index);
                    let bytes = if bit.is_some() { 1 } else { 2 };
                    let address = LocatedAddress::new(area.letter(), byte, bit, bytes);
                    let address = address.map(|a| a.text(addressing).unwrap_or_else(|| a.to_string()));
                    let address = address.unwrap_or_default();
                    sink.warning(
                        &document.place(&server.name, &format!("map[{index}]")),
                        format!(
                            "Modbus clients may write {} {at} ({}), but the program assigns {address} too ({place}), and wins",
                            table.name(),
                            traditional_number(table, at)
                        ),
                        "show it as input_registers or discrete_inputs, or let the program leave it alone",
                    );
                }
            }
        }
    }
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
