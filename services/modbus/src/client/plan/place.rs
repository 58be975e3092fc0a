//! Where a range lies in the image, and whether it fits there.

use super::super::config::IecType;
use super::super::order::Order;
use super::Plan;
use crate::map_config::area_of;
use crate::server::Table;
use dinrail_iec::{AddressSize, Addressing, LocatedAddress, parse_address};
use ipc_types::wiring::Area;

/// Where a range lies in the image, and how many entries it has.
pub(super) struct Place {
    pub(super) address: LocatedAddress,
    pub(super) count: u16,
    pub(super) bytes: u32,
    pub(super) group: usize,
}

/// What a range asks for.
pub(super) struct Wanted<'a> {
    pub(super) key: &'a str,
    pub(super) address_key: &'a str,
    pub(super) address: &'a str,
    pub(super) areas: &'a [Area],
    pub(super) table: Table,
    pub(super) at: u16,
    pub(super) count: Option<u16>,
    pub(super) order: Order,
    pub(super) iec: Option<IecType>,
    pub(super) symbol: Option<&'a str>,
    pub(super) most: u16,
}

/// What does not go together: count, address, order, type, symbol.
fn misfits(wanted: &Wanted<'_>, address: LocatedAddress, count: u16, group: usize, plan: &mut Plan) {
    let (key, bits) = (wanted.key, wanted.table.is_bits());
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
}

/// Resolves a range; `None` after its mistakes were told.
pub(super) fn place(addressing: Addressing, wanted: &Wanted<'_>, plan: &mut Plan) -> Option<Place> {
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
    misfits(wanted, address, count, group, plan);
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
