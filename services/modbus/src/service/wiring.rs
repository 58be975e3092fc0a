//! What the service declares: topics, listeners, ranges of the image.

use super::{LISTENER, RTU_LISTENER, addressing_named};
use crate::config::Config;
use crate::map_config::{MapConfig, MapEntry, area_of};
use crate::process_image::own_inputs;
use dinrail_iec::{Addressing, parse_address};
use ipc_types::Wiring;
use ipc_types::topic::TopicKind;
use ipc_types::wiring::{Area, AreaSizes, ImageRange, Listener, Neighbours, OnBad, TopicDecl};
use std::net::SocketAddr;

/// Everything the service reads, writes, owns and listens on.
pub fn topics(config: &Config, neighbours: &Neighbours) -> Wiring {
    let mut wiring = Wiring::default();
    if let Some(plc) = neighbours.resolve("plc", config.plc.as_deref()) {
        wiring.read(TopicKind::Image.of(&plc), false, "plc");
        wiring.write(TopicKind::Writes.of(&plc), "plc");
        wiring.plc = Some(plc);
    }
    let addressing = addressing_named(neighbours.addressing(wiring.plc.as_deref()));
    let maps: Result<Vec<_>, _> = config.maps().map(|map| map.build(AreaSizes::MAX, addressing)).collect();
    if let Ok(maps) = maps {
        let own = own_inputs(&maps).into_iter();
        wiring.inputs = own.map(|(byte, bytes)| own_range(config, addressing, byte, bytes)).collect();
        wiring.outputs = shown_ranges(config, addressing);
    }
    // Last, as in the tail of the inputs.
    if let Ok(Some((byte, bytes))) = config.client_list(addressing) {
        let label = "number, addresses and ports of the Modbus clients".to_owned();
        wiring.inputs.push(image_range(byte, bytes, label, "clients_to".to_owned()));
    }
    if !wiring.inputs.is_empty() {
        let tail: u32 = wiring.inputs.iter().map(|range| range.bytes + 1).sum();
        let decl = TopicDecl::new(TopicKind::Inputs);
        let max_tail = decl.max_tail.max(tail);
        wiring.topics.push(decl.max_tail(max_tail));
    }
    wiring.own(TopicKind::Jobs).own(TopicKind::Results);
    if let Some(tcp) = config.tcp() {
        let address = SocketAddr::new(tcp.address, tcp.port);
        wiring.listeners.push(Listener { name: LISTENER.to_owned(), address, key: "tcp.port".to_owned() });
    }
    if let Some(rtu) = &config.rtu_over_tcp {
        let address = SocketAddr::new(rtu.address, rtu.port);
        let (name, key) = (RTU_LISTENER.to_owned(), "rtu_over_tcp.port".to_owned());
        wiring.listeners.push(Listener { name, address, key });
    }
    for (i, line) in config.serial.iter().enumerate() {
        let key = format!("serial[{i}].port");
        wiring.read(TopicKind::SerialRx.of(&line.port), true, &key);
        wiring.write(TopicKind::SerialTx.of(&line.port), &key);
    }
    wiring
}

/// The ranges of %Q and %M that map tables show. The ready maps show all of both, which is not listed.
fn shown_ranges(config: &Config, addressing: Addressing) -> Vec<ImageRange> {
    let shown = table_entries(config).filter_map(|(unit, key, entry)| {
        let address = parse_address(&entry.area, addressing).ok()?;
        let bytes = if entry.table.is_bits() {
            (u32::from(address.bit.unwrap_or(0)) + entry.count).div_ceil(8)
        } else {
            entry.count * 2
        };
        let label = format!("{unit}{} {}-{}", entry.table.name(), entry.at, entry.at + entry.count - 1);
        let area = area_of(address);
        let range = ImageRange { area, ..image_range(address.byte, bytes, label, format!("{key}.area")) };
        (area != Area::Input).then_some(range)
    });
    shown.collect()
}

/// All map tables, each with the unit it belongs to, as it stands in a label, and its key.
fn table_entries(config: &Config) -> impl Iterator<Item = (String, String, &MapEntry)> {
    let common = (String::new(), "map".to_owned(), &config.map);
    let own = config.unit.iter().enumerate();
    let own = own.map(|(i, unit)| (format!("unit {} ", unit.id), format!("unit[{i}].map"), &unit.map));
    std::iter::once(common).chain(own).flat_map(|(unit, key, map)| {
        let entries: &[MapEntry] = match map {
            MapConfig::Tables(entries) => entries,
            MapConfig::Preset(_) => &[],
        };
        let entries = entries.iter().enumerate();
        entries.map(move |(i, entry)| (unit.clone(), format!("{key}[{i}]"), entry))
    })
}

fn image_range(byte: u32, bytes: u32, label: String, key: String) -> ImageRange {
    ImageRange {
        area: Area::Input,
        byte,
        bit: None,
        bytes,
        type_name: None,
        symbol: None,
        label,
        key,
        on_bad: OnBad::Hold,
        status_byte: None,
    }
}

fn own_range(config: &Config, addressing: Addressing, byte: u32, bytes: u32) -> ImageRange {
    // The first table that owns a byte of it; joined neighbours are named by the first.
    let found = table_entries(config).find(|(_, _, entry)| {
        entry.own
            && parse_address(&entry.area, addressing)
                .is_ok_and(|address| area_of(address) == Area::Input && address.byte == byte)
    });
    let (label, key) = found.map_or_else(
        || ("written by Modbus clients".to_owned(), "map".to_owned()),
        |(unit, key, entry)| {
            let label = format!("{unit}{} {}.. written by Modbus clients", entry.table.name(), entry.at);
            (label, format!("{key}.area"))
        },
    );
    image_range(byte, bytes, label, key)
}
