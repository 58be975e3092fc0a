//! What a device's author should mend in an EDS, beyond what the reader had to mend itself.

use super::{Diag, Eds, EdsEntry, List, Severity, unsigned_of};
use crate::protocol::data_type::{DataType, Number};
use crate::protocol::od::ObjectCode;

/// Objects every device has (CiA 301 V4.2, 7.4.2 and 7.5.2).
const MANDATORY: [(u16, &str); 3] =
    [(0x1000, "device type"), (0x1001, "error register"), (0x1018, "identity")];

/// Types of communication objects that masters rely on (CiA 301 V4.2, 7.5.2): object, sub-index, type.
const TYPES: &[(u16, u8, DataType)] = &[
    (0x1000, 0, DataType::Unsigned32),
    (0x1001, 0, DataType::Unsigned8),
    (0x1002, 0, DataType::Unsigned32),
    (0x1003, 0, DataType::Unsigned8),
    (0x1003, 1, DataType::Unsigned32),
    (0x1005, 0, DataType::Unsigned32),
    (0x1006, 0, DataType::Unsigned32),
    (0x1007, 0, DataType::Unsigned32),
    (0x100C, 0, DataType::Unsigned16),
    (0x100D, 0, DataType::Unsigned8),
    (0x1010, 1, DataType::Unsigned32),
    (0x1011, 1, DataType::Unsigned32),
    (0x1012, 0, DataType::Unsigned32),
    (0x1014, 0, DataType::Unsigned32),
    (0x1015, 0, DataType::Unsigned16),
    (0x1016, 1, DataType::Unsigned32),
    (0x1017, 0, DataType::Unsigned16),
    (0x1018, 1, DataType::Unsigned32),
    (0x1018, 2, DataType::Unsigned32),
    (0x1018, 3, DataType::Unsigned32),
    (0x1018, 4, DataType::Unsigned32),
    (0x1019, 0, DataType::Unsigned8),
    (0x1020, 1, DataType::Unsigned32),
    (0x1020, 2, DataType::Unsigned32),
    (0x1029, 1, DataType::Unsigned8),
];

impl Eds {
    /// Everything worth mending, in order of lines: the reader's warnings, missing and mistyped objects, defaults
    /// outside their limits, PDO mappings that no device could use.
    pub fn check(&self) -> Vec<Diag> {
        let mut diags = self.warnings.clone();
        self.check_objects(&mut diags);
        self.check_values(&mut diags);
        self.check_pdos(&mut diags);
        diags.sort_by_key(|diag| (diag.line, diag.severity));
        super::thin_out(diags)
    }

    fn check_objects(&self, diags: &mut Vec<Diag>) {
        for (index, what) in MANDATORY {
            if !self.objects.contains_key(&index) {
                let text = format!("the {what} is missing: every device has it (CiA 301, 7.5.2)");
                diags.push(Diag::error(0, &format!("{index:04X}"), "", text));
            }
        }
        for &(index, sub, data_type) in TYPES {
            if let Some(entry) = self.entry(index, sub)
                && entry.data_type != data_type
            {
                let text = format!("is a {}, the standard says {data_type}", entry.data_type);
                diags.push(Diag::error(entry.line, &section_name(self, index, sub), "DataType", text));
            }
        }
        for (base, count, key) in
            [(0x1400u16, self.device.rx_pdos, "NrOfRXPDO"), (0x1800, self.device.tx_pdos, "NrOfTXPDO")]
        {
            let described = self.objects.range(base..=base + 0x1FF).count();
            if described != usize::from(count) && self.device.compact_pdo == 0 {
                let section = self.section("DeviceInfo");
                let line = section.map_or(0, |s| s.get(key).map_or(s.line, |key| key.line));
                let text = format!("{count} PDOs are announced, {described} are described");
                diags.push(Diag::warning(line, "DeviceInfo", key, text));
            }
        }
        if self.device.baud_rates.is_empty() && self.section("DeviceInfo").is_some() {
            let line = self.section("DeviceInfo").map_or(0, |section| section.line);
            diags.push(Diag::warning(line, "DeviceInfo", "", "no BaudRate_... is supported".to_owned()));
        }
        for (&index, object) in &self.objects {
            let fits = match object.list {
                List::Mandatory => MANDATORY.iter().any(|mandatory| mandatory.0 == index),
                List::Manufacturer => (0x2000..=0x5FFF).contains(&index),
                List::Optional => !(0x2000..=0x5FFF).contains(&index),
                List::None => true,
            };
            if !fits {
                let text =
                    format!("is in the list of {:?} objects, where its index does not belong", object.list);
                diags.push(Diag::warning(object.line, &format!("{index:04X}"), "", text));
            }
        }
    }

    fn check_values(&self, diags: &mut Vec<Diag>) {
        for (index, sub, entry) in self.entries() {
            for (key, value) in [("DefaultValue", &entry.default), ("ParameterValue", &entry.parameter)] {
                let Some(value) = value.as_ref().filter(|value| !value.node_relative) else { continue };
                if let Some(text) = outside(entry, &value.bytes) {
                    let line = self.line_of(index, sub, key, entry.line);
                    diags.push(Diag::warning(line, &section_name(self, index, sub), key, text));
                }
            }
            if entry.mappable && entry.data_type.bits().is_none() && !entry.data_type.is_string() {
                let line = self.line_of(index, sub, "PDOMapping", entry.line);
                let text = format!("a {} has no fixed length and cannot be mapped", entry.data_type);
                diags.push(Diag::warning(line, &section_name(self, index, sub), "PDOMapping", text));
            }
        }
        for (&index, object) in &self.objects {
            let highest = object.subs.keys().next_back().copied().unwrap_or(0);
            let told =
                object.subs.get(&0).and_then(|entry| entry.default.as_ref()).map(|v| unsigned_of(&v.bytes));
            let counts =
                object.code.has_subs() && !matches!(index, 0x1003 | 0x1600..=0x17FF | 0x1A00..=0x1BFF);
            if let Some(told) = told.filter(|&told| counts && told != u64::from(highest)) {
                let line = self.line_of(index, 0, "DefaultValue", object.line);
                let text = format!("says the highest sub-index is {told}, it is {highest}");
                diags.push(Diag::warning(line, &section_name(self, index, 0), "DefaultValue", text));
            }
        }
    }

    fn line_of(&self, index: u16, sub: u8, key: &str, otherwise: u32) -> u32 {
        let section = self.section(&section_name(self, index, sub));
        section.and_then(|section| section.get(key)).map_or(otherwise, |key| key.line)
    }

    /// Default mappings (CiA 301 V4.2, 7.5.2.36 and 7.5.2.38): what is mapped exists, is mappable in this
    /// direction, has the length given, and all of it has 64 bits at most.
    fn check_pdos(&self, diags: &mut Vec<Diag>) {
        for (&index, object) in self.objects.range(0x1600..=0x1BFF) {
            let receive = index < 0x1800;
            if !receive && index < 0x1A00 {
                continue;
            }
            let count = object.subs.get(&0).and_then(|entry| entry.default.as_ref());
            let count = count.map_or(0, |value| unsigned_of(&value.bytes)).min(64) as u8;
            let (mut bits, mut empty) = (0, 0);
            for sub in 1..=count {
                let Some(entry) = object.subs.get(&sub) else { continue };
                let mapped = entry.default.as_ref().map_or(0, |value| unsigned_of(&value.bytes)) as u32;
                if mapped == 0 {
                    empty += 1;
                    continue;
                }
                bits += mapped & 0xFF;
                if let Some(text) = self.mapping_fault(mapped, receive) {
                    let line = self.line_of(index, sub, "DefaultValue", entry.line);
                    diags.push(Diag::error(line, &section_name(self, index, sub), "DefaultValue", text));
                }
            }
            if empty > 0 {
                let line = self.line_of(index, 0, "DefaultValue", object.line);
                let text = format!(
                    "says {count} objects are mapped, of which {empty} are 0: nobody can use the PDO"
                );
                diags.push(Diag::error(line, &section_name(self, index, 0), "DefaultValue", text));
            }
            if bits > 64 {
                let text = format!("the mapped objects have {bits} bits, a PDO has 64");
                diags.push(Diag::error(object.line, &format!("{index:04X}"), "", text));
            }
        }
    }

    fn mapping_fault(&self, mapped: u32, receive: bool) -> Option<String> {
        let (index, sub, bits) = ((mapped >> 16) as u16, (mapped >> 8) as u8, mapped as u8);
        let named = format!("{index:04X}h:{sub:02X}");
        if receive && (1..=7).contains(&index) {
            let allowed = self.dummies & 1 << index != 0;
            return (!allowed).then(|| format!("dummy object {named} is not in [DummyUsage]"));
        }
        let Some(entry) = self.entry(index, sub) else {
            return Some(format!("maps {named}, which does not exist"));
        };
        if !entry.mappable {
            return Some(format!("maps {named}, which has PDOMapping=0"));
        }
        let direction = if receive { entry.access.in_rpdo() } else { entry.access.in_tpdo() };
        if !direction {
            let what = if receive { "an RPDO" } else { "a TPDO" };
            return Some(format!(
                "maps {named} into {what}, which its access '{}' forbids",
                entry.access.word()
            ));
        }
        match entry.data_type.bits() {
            Some(length) if length != bits => {
                Some(format!("maps {bits} bits of {named}, which has {length}"))
            }
            _ => None,
        }
    }

    /// How many findings there are of each kind: warnings, errors.
    pub fn count(diags: &[Diag]) -> (usize, usize) {
        let errors = diags.iter().filter(|diag| diag.severity == Severity::Error).count();
        (diags.len() - errors, errors)
    }
}

/// The section a sub-object stands in.
fn section_name(eds: &Eds, index: u16, sub: u8) -> String {
    match eds.objects.get(&index) {
        Some(object) if object.code.has_subs() && object.code != ObjectCode::Var => {
            format!("{index:04X}sub{sub:X}")
        }
        _ => format!("{index:04X}"),
    }
}

fn outside(entry: &EdsEntry, bytes: &[u8]) -> Option<String> {
    let value = entry.data_type.number(bytes)?;
    let beyond = |limit: Option<Number>, wrong| limit.filter(|&limit| value.compare(limit) == Some(wrong));
    if let Some(high) = beyond(entry.high, std::cmp::Ordering::Greater) {
        return Some(format!("{value} is above the high limit {high}"));
    }
    beyond(entry.low, std::cmp::Ordering::Less).map(|low| format!("{value} is below the low limit {low}"))
}
