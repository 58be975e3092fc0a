//! Objects that a file does not describe one by one (`CompactPDO`, a missing sub-index 0).

use super::{EdsEntry, EdsObject, List, Value};
use crate::protocol::data_type::DataType;
use crate::protocol::od::{Access, ObjectCode};
use std::collections::BTreeMap;

/// An entry that no section describes.
pub(super) fn made(name: &str, data_type: DataType, access: Access) -> EdsEntry {
    EdsEntry {
        name: name.to_owned(),
        data_type,
        access,
        mappable: false,
        default: None,
        parameter: None,
        low: None,
        high: None,
        no_download: false,
        no_scan: false,
        denotation: String::new(),
        upload_file: String::new(),
        download_file: String::new(),
        line: 0,
    }
}

fn made_object(name: String, subs: BTreeMap<u8, EdsEntry>) -> EdsObject {
    EdsObject { name, code: ObjectCode::Record, list: List::None, line: 0, compact: 0, subs }
}

/// PDO communication parameters (CiA 301 V4.2, 7.5.2.35 and 7.5.2.37) with the sub-indices of the mask.
pub(super) fn compact_communication(what: &str, mask: u8, n: u16, cob_id: u32) -> EdsObject {
    let fields = [
        (1, "COB-ID", DataType::Unsigned32),
        (2, "Transmission type", DataType::Unsigned8),
        (3, "Inhibit time", DataType::Unsigned16),
        (4, "Reserved", DataType::Unsigned8),
        (5, "Event timer", DataType::Unsigned16),
        (6, "SYNC start value", DataType::Unsigned8),
    ];
    let mut subs = BTreeMap::new();
    let mut highest = 0;
    for (sub, name, data_type) in fields {
        if mask & 1 << (sub - 1) == 0 {
            continue;
        }
        let mut entry = made(name, data_type, Access::Rw);
        if sub == 1 {
            // The first four follow the predefined connection set, the others do not exist yet (7.3.5).
            let (id, node_relative) =
                if n < 4 { (cob_id + 0x100 * u32::from(n), true) } else { (1 << 31, false) };
            entry.default = Some(Value { bytes: id.to_le_bytes().to_vec(), node_relative });
        } else if sub == 2 {
            entry.default = Some(Value { bytes: vec![0xFF], node_relative: false });
        }
        subs.insert(sub, entry);
        highest = sub;
    }
    let mut zero = made("Highest sub-index supported", DataType::Unsigned8, Access::Const);
    zero.default = Some(Value { bytes: vec![highest], node_relative: false });
    subs.insert(0, zero);
    made_object(format!("{what} {} communication parameter", n + 1), subs)
}

/// PDO mapping parameters (CiA 301 V4.2, 7.5.2.36 and 7.5.2.38), nothing mapped.
pub(super) fn compact_mapping(what: &str, entries: u8) -> EdsObject {
    let mut subs = BTreeMap::new();
    subs.insert(0, made("Number of mapped objects", DataType::Unsigned8, Access::Rw));
    for sub in 1..=entries {
        subs.insert(sub, made(&format!("Mapped object {sub}"), DataType::Unsigned32, Access::Rw));
    }
    made_object(format!("{what} mapping parameter"), subs)
}
