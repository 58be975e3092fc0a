//! What no single service can see: ranges with two owners or beyond the image, symbols and ports used twice,
//! missing files, more shared memory than there is. Then what each service finds by itself.

use super::document::Document;
use super::keypath;
use super::place::Sink;
use super::resolve::{PLC, exchangers};
use dinrail_iec::lexer::TokenKind;
use ipc_types::plc_table;
use ipc_types::stack::{Severity, Stack};
use ipc_types::wiring::{Area, ImageRange};
use std::collections::HashMap;
use std::net::SocketAddr;
use std::path::Path;

/// Key of a plc's table that findings about its program name.
const PROGRAM_KEY: &str = "program";

/// Runs every check; findings go to the sink.
pub fn check(document: &Document, stack: &Stack, free_shm: Option<u64>, sink: &mut Sink<'_>) {
    for plc in stack.services.iter().filter(|s| s.kind == PLC) {
        let points = points_of(document, stack, &plc.name);
        owners(&points, sink);
        inside(&points, &plc.name, &plc.config, sink);
        symbols(&points, sink);
    }
    listeners(document, stack, sink);
    files(document, stack, sink);
    if let Some(free) = free_shm {
        memory(stack, free, sink);
    }
    services(document, stack, sink);
}

/// A point of an image with its place in the file.
struct Point<'a> {
    service: &'a str,
    range: &'a ImageRange,
    /// Owned (inputs) or read (outputs).
    owned: bool,
    place: Span,
    /// Where its symbol stands.
    symbol: Span,
    /// Where its status byte stands.
    status: Span,
}

type Span = std::ops::Range<usize>;

impl Point<'_> {
    /// `'in[2].to' of service 'io' (line 12, id 123h bits 0..15)`.
    fn describe(&self, sink: &Sink<'_>) -> String {
        format!(
            "'{}' of service '{}' (line {}: {})",
            self.range.key,
            self.service,
            sink.source.line(self.place.start),
            self.range.label
        )
    }
}

fn points_of<'a>(document: &Document, stack: &'a Stack, plc: &str) -> Vec<Point<'a>> {
    let mut points = Vec::new();
    for (entry, wiring) in exchangers(stack, plc) {
        for (range, owned) in
            wiring.inputs.iter().map(|r| (r, true)).chain(wiring.outputs.iter().map(|r| (r, false)))
        {
            let place = document.place(&entry.name, &range.key);
            let beside =
                |name| beside(document, &entry.name, &range.key, name).unwrap_or_else(|| place.clone());
            let (symbol, status) = (beside("symbol"), beside("status_to"));
            points.push(Point { service: &entry.name, range, owned, place, symbol, status });
        }
    }
    points
}

/// Where another key of the same table stands, if it is there.
fn beside(document: &Document, service: &str, key: &str, name: &str) -> Option<Span> {
    let table = &document.service(service)?.table;
    let parent = key.rsplit_once('.').map_or("", |(parent, _)| parent);
    let place = keypath::span_of(table, &format!("{parent}.{name}"))?;
    // What is not there leads to the table.
    (Some(&place) != keypath::span_of(table, parent).as_ref()).then_some(place)
}

/// First bit and bit behind the last one.
fn bits(range: &ImageRange) -> (u64, u64) {
    let first = u64::from(range.byte) * 8;
    match range.bit {
        Some(bit) => (first + u64::from(bit), first + u64::from(bit) + 1),
        None => (first, first + u64::from(range.bytes) * 8),
    }
}

/// `%IX0.3`, `%IB4`, `%IB4 to %IB7`: bytes mean the same in every addressing.
pub fn percent(area: Area, byte: u32, bit: Option<u8>, bytes: u32) -> String {
    let letter = area.letter();
    match bit {
        Some(bit) => format!("%{letter}X{byte}.{bit}"),
        None if bytes <= 1 => format!("%{letter}B{byte}"),
        None => format!("%{letter}B{byte} to %{letter}B{}", u64::from(byte) + u64::from(bytes) - 1),
    }
}

fn percent_of(range: &ImageRange) -> String {
    percent(range.area, range.byte, range.bit, range.bytes)
}

/// Every part of %I has one owner.
fn owners(points: &[Point<'_>], sink: &mut Sink<'_>) {
    let mut claims: Vec<(u64, u64, String, &Point<'_>)> = Vec::new();
    for point in points.iter().filter(|p| p.owned) {
        let (from, to) = bits(point.range);
        claims.push((from, to, percent_of(point.range), point));
        if let Some(status) = point.range.status_byte {
            // Points of one service may share their status: they get one quality.
            let shared = claims.iter().any(|c| {
                c.3.service == point.service
                    && c.3.range.status_byte == Some(status)
                    && c.0 == u64::from(status) * 8
            });
            if !shared {
                let first = u64::from(status) * 8;
                claims.push((
                    first,
                    first + 8,
                    format!("{} (status)", percent(Area::Input, status, None, 1)),
                    point,
                ));
            }
        }
    }
    claims.sort_by_key(|(from, to, _, point)| (*from, *to, point.place.start));
    let free = claims.iter().map(|c| c.1.div_ceil(8)).max().unwrap_or(0);
    // The claim that reaches farthest so far: every overlap is one with it.
    let mut farthest = 0;
    for i in 1..claims.len() {
        let (a, b) = (&claims[farthest], &claims[i]);
        if b.0 < a.1 {
            // The later line gets the mark, the earlier one is named.
            let (first, second) = if a.3.place.start <= b.3.place.start { (a, b) } else { (b, a) };
            let message = format!(
                "{} has two owners: {} and {}{}",
                second.2,
                first.3.describe(sink),
                second.3.describe(sink),
                if first.2 == second.2 { String::new() } else { format!("; the first has {}", first.2) },
            );
            sink.error(
                &second.3.place,
                message,
                format!("give one of them another address; %I is free from %IB{free} on"),
            );
        }
        if b.1 >= a.1 {
            farthest = i;
        }
    }
}

/// Points lie inside the image of their plc.
fn inside(points: &[Point<'_>], plc: &str, config: &serde_json::Value, sink: &mut Sink<'_>) {
    for point in points {
        let key = match point.range.area {
            Area::Input => "input_bytes",
            Area::Output => "output_bytes",
            Area::Marker => "marker_bytes",
        };
        let size = u64::from(plc_table::areas(config).of(point.range.area));
        let end = bits(point.range).1.div_ceil(8);
        let status_end = point.range.status_byte.map_or(0, |b| u64::from(b) + 1);
        let letter = point.range.area.letter();
        if end > size {
            sink.error(
                &point.place,
                format!(
                    "{} lies beyond %{letter} of '{plc}', which ends at %{letter}B{}",
                    percent_of(point.range),
                    size.saturating_sub(1)
                ),
                format!(
                    "use a lower address, or set {key} = {} in service '{plc}'",
                    end.next_multiple_of(256)
                ),
            );
        } else if point.owned && status_end > size {
            sink.error(
                &point.status,
                format!(
                    "status %IB{} lies beyond %I of '{plc}', which ends at %IB{}",
                    status_end - 1,
                    size.saturating_sub(1)
                ),
                format!(
                    "use a lower address, or set {key} = {} in service '{plc}'",
                    status_end.next_multiple_of(256)
                ),
            );
        }
    }
}

/// Every symbol is made once.
fn symbols(points: &[Point<'_>], sink: &mut Sink<'_>) {
    let mut seen: HashMap<String, &Point<'_>> = HashMap::new();
    for point in points {
        let Some(symbol) = &point.range.symbol else { continue };
        if let Some(fault) = symbol_fault(symbol) {
            sink.error(
                &point.symbol,
                format!("symbol '{}' {fault}", symbol.escape_debug()),
                "a symbol is a variable of the program: letters, digits and single _, not beginning with a digit",
            );
            continue;
        }
        // IEC names ignore case.
        let Some(first) = seen.insert(symbol.to_ascii_lowercase(), point) else { continue };
        if bits(first.range) == bits(point.range) && first.range.area == point.range.area {
            continue;
        }
        let message = format!(
            "symbol '{symbol}' is made twice: by {} and by {}",
            first.describe(sink),
            point.describe(sink)
        );
        sink.error(
            &point.symbol,
            message,
            "give one of them another name; upper and lower case are the same",
        );
    }
}

/// Why a name cannot be one of the program's variables.
fn symbol_fault(name: &str) -> Option<&'static str> {
    let (tokens, faults) = dinrail_iec::lexer::lex(0, name);
    match tokens.first() {
        Some(token) if !faults.is_empty() || token.start != 0 || token.end as usize != name.len() => {
            Some("is no name of IEC 61131-3")
        }
        Some(token) => match token.kind {
            TokenKind::Word(None) => None,
            TokenKind::Word(Some(_)) => Some("is a word of the language"),
            _ => Some("is no name of IEC 61131-3"),
        },
        None => Some("is no name of IEC 61131-3"),
    }
}

/// No two services listen on one port.
fn listeners(document: &Document, stack: &Stack, sink: &mut Sink<'_>) {
    let mut seen: Vec<(SocketAddr, &str, std::ops::Range<usize>)> = Vec::new();
    for entry in &stack.services {
        for listener in &entry.wiring.listeners {
            let place = document.place(&entry.name, &listener.key);
            let address = listener.address;
            if let Some((_, other, first)) = seen.iter().find(|(a, ..)| collide(*a, address)) {
                let line = sink.source.line(first.start);
                sink.error(
                    &place,
                    format!(
                        "port {} is used twice: by service '{other}' (line {line}) and by service '{}'",
                        address.port(),
                        entry.name
                    ),
                    "give one of them another port, or another address of this machine",
                );
            }
            seen.push((address, &entry.name, place));
        }
    }
}

fn collide(a: SocketAddr, b: SocketAddr) -> bool {
    a.port() == b.port()
        && a.port() != 0
        && (a.ip() == b.ip() || a.ip().is_unspecified() || b.ip().is_unspecified())
}

/// Every file that a service names is there.
fn files(document: &Document, stack: &Stack, sink: &mut Sink<'_>) {
    for entry in &stack.services {
        for (path, key) in &entry.wiring.files {
            let full = stack.dir.join(path);
            let Err(why) = readable(&full) else { continue };
            let place = document.place(&entry.name, key);
            let at =
                if path.is_relative() { "; the path starts at the folder of the stack file" } else { "" };
            sink.error(
                &place,
                format!("key '{key}' of service '{}': {} {why}", entry.name, path.display()),
                format!("put the file there or correct the name{at}"),
            );
        }
    }
}

fn readable(path: &Path) -> Result<(), String> {
    match std::fs::metadata(path) {
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => Err("is not there".to_owned()),
        Err(e) => Err(format!("cannot be read: {e}")),
        Ok(meta) if !meta.is_file() => Err("is no file".to_owned()),
        Ok(_) => match std::fs::File::open(path) {
            Ok(_) => Ok(()),
            Err(e) => Err(format!("cannot be read: {e}")),
        },
    }
}

/// Shared memory that the stack's topics need.
pub fn shared_memory(stack: &Stack) -> u64 {
    stack.topics.iter().map(|t| t.bytes()).sum()
}

/// Bytes free in /dev/shm.
pub fn free_shared_memory() -> Option<u64> {
    let info = rustix::fs::statvfs("/dev/shm").ok()?;
    Some(info.f_bavail.saturating_mul(info.f_frsize))
}

/// A size as people read it.
pub fn readable_size(bytes: u64) -> String {
    match bytes {
        0..1024 => format!("{bytes} B"),
        1024..1_048_576 => format!("{:.1} KiB", bytes as f64 / 1024.0),
        1_048_576..1_073_741_824 => format!("{:.1} MiB", bytes as f64 / 1_048_576.0),
        _ => format!("{:.1} GiB", bytes as f64 / 1_073_741_824.0),
    }
}

fn memory(stack: &Stack, free: u64, sink: &mut Sink<'_>) {
    let need = shared_memory(stack);
    if need <= free / 2 {
        return;
    }
    let mut topics: Vec<(u64, &str)> = stack.topics.iter().map(|t| (t.bytes(), t.name.as_str())).collect();
    topics.sort_by_key(|(bytes, _)| std::cmp::Reverse(*bytes));
    let largest: Vec<String> =
        topics.iter().take(3).map(|(bytes, name)| format!("{name} {}", readable_size(*bytes))).collect();
    sink.error(
        &(0..0),
        format!(
            "the stack needs {} of shared memory; /dev/shm has {} free, of which it may take half",
            readable_size(need),
            readable_size(free)
        ),
        format!(
            "enlarge it (mount -o remount,size=... /dev/shm) or use fewer services; largest: {}",
            largest.join(", ")
        ),
    );
}

/// What the services find by themselves, with places. A plc comes last, for its program sees what all others
/// declare: a symbol that could not be made is not also reported as an undeclared variable.
fn services(document: &Document, stack: &Stack, sink: &mut Sink<'_>) {
    let pairs = || document.services.iter().zip(&stack.services);
    let plcs = pairs().filter(|(_, entry)| entry.kind == PLC);
    for (service, entry) in pairs().filter(|(_, entry)| entry.kind != PLC).chain(plcs) {
        let disturbed = entry.kind == PLC && sink.has_errors();
        for finding in service.config.check(stack, entry) {
            if disturbed && finding.key == PROGRAM_KEY {
                continue;
            }
            let place = document.place(&finding.service, &finding.key);
            let located = sink.source.located(finding.severity, &place, finding.message, finding.help);
            // The same mistake, seen from the stack's side, is already there.
            let known = sink.list.iter().any(|f| {
                f.severity == Severity::Error
                    && located.severity == Severity::Error
                    && !finding.key.is_empty()
                    && (f.line, f.column) == (located.line, located.column)
            });
            if !known {
                sink.push(located);
            }
        }
    }
}
