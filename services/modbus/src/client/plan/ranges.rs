//! `[[service.read]]` and `[[service.write]]`.

use super::super::config::{Config, Function, IecType, Read, Write};
use super::place::{Wanted, place};
use super::units::unit_of;
use super::{Plan, ReadRange, Target, WriteRange};
use crate::map_config::area_of;
use crate::protocol::pdu::{MAX_READ_BITS, MAX_READ_WORDS, MAX_WRITE_BITS, MAX_WRITE_WORDS};
use crate::server::Table;
use dinrail_iec::{AddressSize, Addressing, parse_address};
use ipc_types::units::Span;
use ipc_types::wiring::Area;

pub(super) fn plan_read(
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

pub(super) fn plan_write(
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
fn safe_bytes(range: &WriteRange, iec: Option<IecType>, values: &[f64]) -> Result<Vec<u8>, String> {
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
