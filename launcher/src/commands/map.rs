//! `dinrail map STACK`: every point of the process image in all its notations, so that nobody counts bytes.

use crate::commands::{print, table};
use crate::stackfile::{LoadError, exchangers, load, percent};
use anyhow::Context as _;
use dinrail_iec::artifact::{AreaKind, Storage, VarKind};
use dinrail_iec::{Addressing, LocatedAddress};
use dinrail_modbus::map::RegisterMap;
use dinrail_modbus::map_config::{MapConfig, MapRow, WordOrder, traditional_number};
use dinrail_modbus::server::Table;
use dinrail_modbus::service::addressing_of;
use dinrail_plc::program;
use ipc_types::stack::ServiceEntry;
use ipc_types::wiring::{Area, AreaSizes, ImageRange, OnBad};
use ipc_types::{Stack, plc_table};
use serde::Serialize;
use std::path::Path;

/// One point of an image.
#[derive(Debug, Serialize)]
struct Point {
    plc: String,
    /// `%IW0` counted in elements (CODESYS), absent when the bytes are no whole element.
    element: Option<String>,
    /// `%IW0` counted in bytes (OpenPCS, Siemens).
    byte: Option<String>,
    /// Always: `%IB0 to %IB1`.
    bytes: String,
    #[serde(rename = "type")]
    type_name: Option<String>,
    symbol: Option<String>,
    modbus: Vec<Register>,
    /// What it is on the field side.
    field: String,
    service: String,
    role: Role,
    /// %IB that shows its quality.
    status: Option<String>,
}

/// What the service does with a point.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
enum Role {
    /// Delivers it into %I.
    Owns,
    /// Sends it to the field.
    Reads,
    /// Has a program variable there.
    Declares,
}

/// Where a Modbus client finds a point.
#[derive(Debug, Serialize)]
struct Register {
    /// The modbus-server; absent = the stack has none and this is where the default map would show it.
    server: Option<String>,
    /// Absent = the map of all units without one of their own.
    #[serde(skip_serializing_if = "Option::is_none")]
    unit: Option<u8>,
    table: &'static str,
    /// From 0, as on the wire.
    address: u16,
    /// From 1, with the digit of the table: 40001.
    number: String,
    /// For a bit that only a register shows: its number there, 0 to 15.
    #[serde(skip_serializing_if = "Option::is_none")]
    bit: Option<u8>,
    /// For values of more than one register: the order of their bytes, A the most significant. CDAB is low word first.
    #[serde(skip_serializing_if = "Option::is_none")]
    order: Option<&'static str>,
}

/// Registers of one server, or of one of its units, for what no field service exchanges.
#[derive(Debug, Serialize)]
struct ServerMap {
    server: String,
    /// Absent = all units without a map of their own.
    #[serde(skip_serializing_if = "Option::is_none")]
    unit: Option<u8>,
    plc: String,
    ranges: Vec<MapRow>,
}

/// Prints the points of a stack, all or those with `filter` in one of their columns.
pub fn run(path: &Path, filter: Option<&str>, as_json: bool) -> anyhow::Result<()> {
    let loaded = match load(path) {
        Ok(loaded) => loaded,
        Err(LoadError { findings }) => {
            super::check::report(&findings);
            anyhow::bail!("{}: only a stack without errors has a map", path.display());
        }
    };
    let (points, servers) = collect(&loaded.stack)?;
    let needle = filter.map(str::to_lowercase);
    let points: Vec<Point> = points
        .into_iter()
        .filter(|p| needle.as_ref().is_none_or(|n| row(p).join("\t").to_lowercase().contains(n)))
        .collect();
    if as_json {
        print(&format!("{:#}\n", serde_json::json!({ "points": points, "registers": servers })));
        return Ok(());
    }
    print(&text(&points, if filter.is_some() { &[] } else { &servers }));
    Ok(())
}

fn collect(stack: &Stack) -> anyhow::Result<(Vec<Point>, Vec<ServerMap>)> {
    let mut points = Vec::new();
    let mut servers = Vec::new();
    for plc in stack.services.iter().filter(|s| s.kind == "plc") {
        let maps = maps_of(stack, plc, plc_table::areas(&plc.config))?;
        for Shown { server, unit, map } in &maps {
            if let Some(server) = server {
                let (server, plc) = (server.clone(), plc.name.clone());
                servers.push(ServerMap { server, unit: *unit, plc, ranges: map.rows(Addressing::Element) });
            }
        }
        let mut ranges: Vec<(&ServiceEntry, ImageRange, Role)> = Vec::new();
        for (entry, wiring) in exchangers(stack, &plc.name) {
            ranges.extend(wiring.inputs.iter().map(|r| (entry, r.clone(), Role::Owns)));
            ranges.extend(wiring.outputs.iter().map(|r| (entry, r.clone(), Role::Reads)));
        }
        ranges.extend(variables(stack, plc)?.into_iter().map(|r| (plc, r, Role::Declares)));
        ranges.sort_by_key(|(entry, r, role)| (r.area, r.byte, r.bit, *role, entry.index));
        points.extend(ranges.iter().map(|(entry, range, role)| point(plc, entry, range, *role, &maps)));
    }
    Ok((points, servers))
}

/// The variables of the program that have a %-address, but for those that the stack file's symbols made.
fn variables(stack: &Stack, plc: &ServiceEntry) -> anyhow::Result<Vec<ImageRange>> {
    let config: dinrail_plc::Config = serde_json::from_value(plc.config.clone())
        .with_context(|| format!("configuration of service '{}'", plc.name))?;
    if config.program.is_empty() {
        return Ok(Vec::new());
    }
    let setup = program::setup(&config, stack, &plc.name);
    let compiled = program::load(&stack.dir, &config.program, &setup)
        .with_context(|| format!("program of service '{}'", plc.name))?;
    let map = &compiled.program.artifact.map;
    let mut found = Vec::new();
    for symbol in map.symbols.iter().filter(|s| s.address.is_some() && s.kind != VarKind::Mapped) {
        let (area, memory) = match symbol.area {
            AreaKind::Input => (Area::Input, map.layout.input),
            AreaKind::Output => (Area::Output, map.layout.output),
            AreaKind::Marker => (Area::Marker, map.layout.marker),
            AreaKind::Retain | AreaKind::Data => continue,
        };
        let Some(byte) = symbol.offset.checked_sub(memory.offset) else { continue };
        let (bit, bytes) = match symbol.storage {
            Storage::Bit(bit) => (Some(bit), 1),
            Storage::Millis32 => (None, 4),
            Storage::Plain => (None, symbol.elem.bytes().saturating_mul(symbol.elements() as u32)),
        };
        let file = map.files.get(symbol.file as usize).map_or("program", String::as_str);
        found.push(ImageRange {
            area,
            byte,
            bit,
            bytes,
            type_name: Some(match symbol.dims.len() {
                0 => symbol.elem.name().to_owned(),
                _ => format!("{} x {}", symbol.elements(), symbol.elem.name()),
            }),
            symbol: Some(symbol.path.clone()),
            label: format!("{file}:{}", symbol.line),
            key: String::new(),
            on_bad: OnBad::Hold,
            status_byte: None,
        });
    }
    Ok(found)
}

/// A register map over the image of a plc.
struct Shown {
    /// `None`: the default map of a stack without a server.
    server: Option<String>,
    /// `None`: of all units without a map of their own.
    unit: Option<u8>,
    map: RegisterMap,
}

/// The register maps over the image of a plc; the default map when there is no server.
fn maps_of(stack: &Stack, plc: &ServiceEntry, sizes: AreaSizes) -> anyhow::Result<Vec<Shown>> {
    let mut maps = Vec::new();
    let addressing = addressing_of(Some(plc));
    let servers = stack.services.iter().filter(|s| s.kind == "modbus-server");
    for server in servers.filter(|s| s.wiring.plc.as_deref() == Some(&plc.name)) {
        let config: dinrail_modbus::Config = serde_json::from_value(server.config.clone())
            .with_context(|| format!("configuration of service '{}'", server.name))?;
        let units = std::iter::once(None).chain(config.unit.iter().map(|unit| Some(unit.id)));
        for (unit, map) in units.zip(config.maps()) {
            let mut map = map
                .build(AreaSizes::MAX, addressing)
                .with_context(|| format!("map of service '{}'", server.name))?;
            map.set_sizes(sizes);
            maps.push(Shown { server: Some(server.name.clone()), unit, map });
        }
    }
    if maps.is_empty() {
        let map = MapConfig::default().build(sizes, addressing).context("default map")?;
        maps.push(Shown { server: None, unit: None, map });
    }
    Ok(maps)
}

/// Where a map shows a place: as a bit or a register, else as a bit of a register.
fn registers(shown: &Shown, (area, byte, bit): (Area, u32, Option<u8>)) -> Vec<Register> {
    let map = &shown.map;
    let register = |(table, at): (Table, u16), bit| Register {
        server: shown.server.clone(),
        unit: shown.unit,
        table: table.name(),
        address: at,
        number: traditional_number(table, at),
        bit,
        order: None,
    };
    let direct: Vec<Register> =
        map.entries_at(area, byte, bit).into_iter().map(|entry| register(entry, None)).collect();
    let Some(bit) = bit.filter(|_| direct.is_empty()) else { return direct };
    let rows = map.rows(Addressing::Element);
    let swapped = |(table, at)| {
        rows.iter().any(|r| r.table == table && r.swap_bytes && (r.first..=r.last).contains(&at))
    };
    let bit = (byte % 2) as u8 * 8 + bit;
    let entries = map.entries_at(area, byte & !1, None).into_iter();
    entries.map(|entry| register(entry, Some(if swapped(entry) { bit ^ 8 } else { bit }))).collect()
}

/// Whether the values of a range take more than one register.
fn is_wide(range: &ImageRange) -> bool {
    let Some(name) = range.type_name.as_deref() else { return matches!(range.bytes, 4 | 8) };
    // `10 x REAL`.
    let element = name.rsplit(' ').next().unwrap_or_default();
    let wide = [
        "DWORD",
        "UDINT",
        "DINT",
        "REAL",
        "LWORD",
        "ULINT",
        "LINT",
        "LREAL",
        "TIME",
        "LTIME",
        "DATE",
        "TOD",
        "DT",
        "TIME_OF_DAY",
        "DATE_AND_TIME",
    ];
    wide.contains(&element)
}

/// The order of bytes in which a map shows values of several registers.
fn order(rows: &[MapRow], register: &Register) -> Option<&'static str> {
    let holds =
        |r: &&MapRow| r.table.name() == register.table && (r.first..=r.last).contains(&register.address);
    let row = rows.iter().find(holds).filter(|row| !row.table.is_bits())?;
    // The image has the low word first; single registers show it as it is.
    let high_first = row.word_order == Some(WordOrder::HighFirst);
    Some(match (high_first, row.swap_bytes) {
        (true, false) => "ABCD",
        (true, true) => "BADC",
        (false, false) => "CDAB",
        (false, true) => "DCBA",
    })
}

fn point(plc: &ServiceEntry, entry: &ServiceEntry, range: &ImageRange, role: Role, maps: &[Shown]) -> Point {
    let at = LocatedAddress::new(range.area.letter(), range.byte, range.bit, range.bytes);
    let mut modbus: Vec<Register> = Vec::new();
    for map in maps {
        let first = modbus.len();
        modbus.extend(registers(map, (range.area, range.byte, range.bit)));
        if is_wide(range) {
            let rows = map.map.rows(Addressing::Element);
            modbus[first..].iter_mut().for_each(|register| register.order = order(&rows, register));
        }
    }
    Point {
        plc: plc.name.clone(),
        element: at.and_then(|at| at.text(Addressing::Element)),
        byte: at.and_then(|at| at.text(Addressing::Byte)),
        bytes: percent(range.area, range.byte, range.bit, range.bytes),
        type_name: range.type_name.clone(),
        symbol: range.symbol.clone(),
        modbus,
        field: range.label.clone(),
        service: entry.name.clone(),
        role,
        status: range.status_byte.map(|b| percent(Area::Input, b, None, 1)),
    }
}

const HEAD: [&str; 8] = ["ELEMENT", "BYTE", "BYTES", "TYPE", "SYMBOL", "MODBUS", "FIELD", "SERVICE"];

fn row(point: &Point) -> Vec<String> {
    let several = point.modbus.iter().any(|r| r.server != point.modbus[0].server);
    let registers: Vec<String> = point
        .modbus
        .iter()
        .map(|r| {
            let server = r.server.as_ref().filter(|_| several).map(|s| format!("{s}: ")).unwrap_or_default();
            let unit = r.unit.map(|unit| format!("unit {unit} ")).unwrap_or_default();
            let bit = r.bit.map(|b| format!("bit {b} of ")).unwrap_or_default();
            let order = r.order.map(|order| format!(" {order}")).unwrap_or_default();
            format!("{server}{unit}{bit}{} {} ({}){order}", r.table, r.address, r.number)
        })
        .collect();
    let or_dash = |text: &Option<String>| text.clone().unwrap_or_else(|| "-".to_owned());
    let status = point.status.as_ref().map(|s| format!(", quality in {s}")).unwrap_or_default();
    let arrow = match point.role {
        Role::Owns => "from",
        Role::Reads => "to",
        Role::Declares => "in",
    };
    vec![
        or_dash(&point.element),
        or_dash(&point.byte),
        point.bytes.clone(),
        or_dash(&point.type_name),
        or_dash(&point.symbol),
        if registers.is_empty() { "-".to_owned() } else { registers.join(", ") },
        format!("{}{status}", point.field),
        format!("{arrow} {}", point.service),
    ]
}

fn text(points: &[Point], servers: &[ServerMap]) -> String {
    let mut plcs: Vec<&str> = points.iter().map(|p| p.plc.as_str()).collect();
    plcs.dedup();
    let mut out = String::new();
    for plc in &plcs {
        if plcs.len() > 1 {
            out += &format!("image of '{plc}'\n");
        }
        let rows: Vec<Vec<String>> = points.iter().filter(|p| p.plc == *plc).map(row).collect();
        out += &table(&HEAD, &rows);
    }
    if points.is_empty() {
        out += "no points\n";
    }
    for server in servers {
        let unit = server.unit.map(|unit| format!("unit {unit} of ")).unwrap_or_default();
        out += &format!("\nregisters of {unit}'{}' over the image of '{}'\n", server.server, server.plc);
        let rows: Vec<Vec<String>> = server
            .ranges
            .iter()
            .map(|r| {
                let notes = [
                    r.word_order.map(|o| {
                        if o == WordOrder::HighFirst { "high word first" } else { "low word first" }
                    }),
                    r.swap_bytes.then_some("bytes swapped"),
                    Some(if r.writable { "read, write" } else { "read" }),
                ];
                vec![
                    r.table.name().to_owned(),
                    format!("{} to {}", r.first, r.last),
                    format!("{} to {}", r.first_number, r.last_number),
                    format!("{} to {}", r.first_address, r.last_address),
                    notes.into_iter().flatten().collect::<Vec<_>>().join(", "),
                ]
            })
            .collect();
        out += &table(&["TABLE", "ADDRESS", "NUMBER", "ELEMENTS", "ACCESS"], &rows);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stackfile::real_tests::{Folder, STACK};

    #[test]
    fn every_point_is_shown_in_all_notations() {
        let folder = Folder::new("map");
        let loaded = folder.load(STACK).unwrap();
        let (points, servers) = collect(&loaded.stack).unwrap();
        let lines: Vec<String> = points.iter().map(|p| row(p).join(" | ")).collect();
        assert_eq!(
            lines,
            [
                "%IW0 | %IW0 | %IB0 to %IB1 | UINT | Speed | input_registers 0 (30001) | from frame 123h, 16 bits from 0 intel | from io",
                "%QW0 | %QW0 | %QB0 to %QB1 | UINT | Command | holding_registers 32768 (432769) | to frame 210h, 16 bits from 0 intel | to io",
                "%MW0 | %MW0 | %MB0 to %MB1 | UINT | Main.Setpoint | holding_registers 0 (40001) | main.st:3 | in plc",
                "%MW1 | %MW2 | %MB2 to %MB3 | UINT | Main.Shown | holding_registers 1 (40002) | main.st:4 | in plc",
            ]
        );
        assert_eq!(servers.len(), 1);
        let maps = maps_of(&loaded.stack, loaded.stack.service("plc").unwrap(), AreaSizes::MAX).unwrap();
        let found = registers(&maps[0], (Area::Marker, 7, Some(2)));
        assert_eq!((found[0].number.as_str(), found[0].bit), ("40004", Some(10)));
        assert!(text(&points, &servers).contains("registers of 'modbus' over the image of 'plc'"));
        assert_eq!(text(&[], &[]), "no points\n");
    }

    #[test]
    fn addresses_of_every_service_count_as_in_the_plc() {
        let folder = Folder::new("map-addressing");
        let text = STACK
            .replace("kind = \"plc\"", "kind = \"plc\"\naddressing = \"byte\"")
            .replace("%IW0", "%IW2")
            .replace("%QW0", "%QW2");
        let map = "\n[[service.map]]\ntable = \"holding\"\nat = 7\ncount = 1\narea = \"%QW2\"\n";
        let at = text.find("\n[[service]]\nname = \"rec\"").unwrap();
        let loaded = folder.load(&format!("{}{map}{}", &text[..at], &text[at..])).unwrap();
        let (points, servers) = collect(&loaded.stack).unwrap();
        let shown: Vec<_> = points
            .iter()
            .map(|p| (p.service.as_str(), p.element.as_deref(), p.byte.as_deref(), p.modbus.len()))
            .collect();
        for point in [
            ("io", Some("%IW1"), Some("%IW2"), 0),
            ("io", Some("%QW1"), Some("%QW2"), 1),
            ("plc", None, Some("%MW1"), 0),
        ] {
            assert!(shown.contains(&point), "{point:?} in {shown:?}");
        }
        let range = &servers[0].ranges[0];
        assert_eq!((range.first, range.first_address.as_str()), (7, "%QW1"));
    }

    #[test]
    fn units_with_maps_of_their_own_are_shown_too() {
        let folder = Folder::new("map-units");
        let unit = "\n[[service.unit]]\nid = 5\n\n[[service.unit.map]]\ntable = \"holding\"\nat = 7\ncount = 2\narea = \"%MD10\"\norder = \"ABCD\"\n";
        let at = STACK.find("\n[[service]]\nname = \"rec\"").unwrap();
        let loaded = folder.load(&format!("{}{unit}{}", &STACK[..at], &STACK[at..])).unwrap();
        let (points, servers) = collect(&loaded.stack).unwrap();
        let units: Vec<_> = servers.iter().map(|s| (s.unit, s.ranges.len())).collect();
        assert_eq!(units, [(None, 5), (Some(5), 1)]);
        let shown = points.iter().map(|p| row(p).join(" | ")).find(|row| row.contains("%MD10")).unwrap();
        assert_eq!(
            shown,
            "%MD10 | %MD40 | %MB40 to %MB43 | - | - | holding_registers 20 (40021) CDAB, unit 5 holding_registers 7 (40008) ABCD | unit 5 holding_registers 7-8 | to modbus"
        );
        let shown = text(&points, &servers);
        assert!(shown.contains("\nregisters of unit 5 of 'modbus' over the image of 'plc'\n"), "{shown}");
        assert!(shown.contains("7 to 8") && shown.contains("high word first"), "{shown}");
        let json = serde_json::to_value(&points).unwrap().to_string();
        assert!(json.contains(r#""unit":5"#), "{json}");
    }

    #[test]
    fn without_a_server_the_default_map_is_shown() {
        let folder = Folder::new("map-default");
        let at = STACK.find("[[service]]\nname = \"modbus\"").unwrap();
        let loaded = folder.load(&STACK[..at]).unwrap();
        let (points, servers) = collect(&loaded.stack).unwrap();
        assert!(servers.is_empty());
        assert_eq!(
            (points[0].modbus[0].number.as_str(), points[0].modbus[0].server.as_deref()),
            ("30001", None)
        );
    }
}
