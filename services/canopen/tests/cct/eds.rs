//! The demo device's dictionary.

use dinrail_canopen::protocol::data_type::{DataType, Number};
use dinrail_canopen::protocol::od::{Access, EntryDef, ObjectCode, ObjectDef, OdBuilder};
use std::collections::BTreeMap;

type Section = BTreeMap<String, String>;

fn sections(text: &str) -> BTreeMap<String, Section> {
    let mut all: BTreeMap<String, Section> = BTreeMap::new();
    let mut name = String::new();
    for line in text.lines().map(str::trim).filter(|line| !line.is_empty() && !line.starts_with(';')) {
        if let Some(section) = line.strip_prefix('[').and_then(|rest| rest.strip_suffix(']')) {
            name = section.to_lowercase();
        } else if let Some((key, value)) = line.split_once('=') {
            all.entry(name.clone()).or_default().insert(key.trim().to_lowercase(), value.trim().to_string());
        }
    }
    all
}

fn number(text: &str) -> i128 {
    let text = text.trim();
    match text.strip_prefix("0x").or_else(|| text.strip_prefix("0X")) {
        Some(hex) => i128::from_str_radix(hex, 16).unwrap_or(0),
        None => text.parse().unwrap_or(0),
    }
}

fn entry(section: &Section) -> EntryDef {
    let get = |key: &str| section.get(key).map_or("", String::as_str);
    let data_type = DataType::from_index(number(get("datatype")) as u16);
    let mut def = EntryDef::new(data_type, Access::from_word(get("accesstype")).unwrap_or(Access::Rw));
    def.mappable = number(get("pdomapping")) != 0;
    let default = get("defaultvalue");
    if let Some(base) = default.strip_prefix("$NODEID") {
        return def.value_plus_node_id(number(base.trim_start_matches('+')) as u32);
    }
    if data_type.is_real() {
        let mut bytes = [0; 8];
        let size = data_type.encode(Number::Real(default.parse().unwrap_or(0.0)), &mut bytes).unwrap();
        def.default = bytes[..size].to_vec();
    } else if data_type == DataType::VisibleString {
        def.default = default.as_bytes().to_vec();
        def.capacity = 1000;
    } else if data_type == DataType::OctetString {
        let digits: Vec<u8> =
            default.bytes().filter_map(|b| char::from(b).to_digit(16)).map(|d| d as u8).collect();
        def.default = digits.chunks(2).map(|pair| pair[0] << 4 | pair.get(1).unwrap_or(&0)).collect();
    } else if !default.is_empty() && data_type.size().is_some() {
        def.default = number(default).to_le_bytes()[..data_type.size().unwrap()].to_vec();
    }
    def
}

/// Reads what the demo device's EDS has: enough for this one file.
pub fn builder(text: &str) -> OdBuilder {
    let all = sections(text);
    let mut builder = OdBuilder::new();
    for (name, section) in &all {
        let Some(index) = u16::from_str_radix(name, 16).ok().filter(|_| name.len() == 4) else { continue };
        let code = section.get("objecttype").map_or(7, |text| number(text) as u8);
        let code = ObjectCode::from_code(code).unwrap();
        let mut subs = Vec::new();
        if code.has_subs() {
            for (name, section) in &all {
                let sub = name.strip_prefix(&format!("{index:04x}sub"));
                if let Some(sub) = sub.and_then(|sub| u8::from_str_radix(sub, 16).ok()) {
                    subs.push((sub, entry(section)));
                }
            }
        } else {
            subs.push((0, entry(section)));
        }
        builder.object(ObjectDef { index, code, subs });
    }
    for dummy in 1..=7 {
        if all
            .get("dummyusage")
            .and_then(|usage| usage.get(&format!("dummy{dummy:04x}")))
            .is_some_and(|v| v == "1")
        {
            builder.dummy(dummy);
        }
    }
    builder
}
