//! Writing a DCF (CiA 306-1 V1.4, 7): the file as it was, with the node's identity and its values.

use super::value::{fault, format};
use super::{Commissioning, Eds};
use crate::protocol::od::{OdError, limit};

/// Why a DCF could not be written. Each names the object.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum DcfError {
    #[error("the EDS has no object {index:04X}h:{sub:02X}")]
    NoObject { index: u16, sub: u8 },
    #[error("object {index:04X}h:{sub:02X}: {text}")]
    Value { index: u16, sub: u8, text: String },
    #[error("object {index:04X}h:{sub:02X}: the text cannot stand in one line of a DCF")]
    Text { index: u16, sub: u8 },
    #[error("object {index:04X}h:{sub:02X}: {len} bytes are more than the limit of {max}", max = limit::VALUE)]
    TooLong { index: u16, sub: u8, len: usize },
    #[error("{0} is no node-id: give 1 to 127")]
    NodeId(u8),
    #[error(transparent)]
    Dictionary(#[from] OdError),
}

/// What goes into the DCF beside the values.
#[derive(Clone, Debug, Default)]
pub struct DcfOptions {
    pub commissioning: Commissioning,
    /// Name of the file that is written, for `[FileInfo]`; empty: as in the EDS.
    pub file_name: String,
    /// Name of the EDS, for `LastEDS`; empty: the EDS's `FileName`.
    pub eds_name: String,
}

impl Eds {
    /// The text of a DCF: this file, the commissioning, and `values` (index, sub-index, bytes as they lie in memory)
    /// as `ParameterValue`. A value the file had before and that is not in `values` stays; comment lines (`;`) and what
    /// the reader did not understand as `key=value` are left out.
    pub fn dcf(&self, options: &DcfOptions, values: &[(u16, u8, Vec<u8>)]) -> Result<String, DcfError> {
        let node = &options.commissioning;
        if !(1..=127).contains(&node.node_id) {
            return Err(DcfError::NodeId(node.node_id));
        }
        let od = self.builder(&super::BuildOptions::default()).build(node.node_id)?;
        let mut ini = self.ini.clone();
        {
            let info = ini.get_or_make("FileInfo", None);
            let eds_name = if options.eds_name.is_empty() {
                info.text("FileName").to_owned()
            } else {
                options.eds_name.clone()
            };
            info.set("LastEDS", &eds_name);
            if !options.file_name.is_empty() {
                info.set("FileName", &options.file_name);
            }
        }
        // Spelt as the standard does, unless the file spells it right.
        let right = ini.get("DeviceComissioning").is_none() && ini.get("DeviceCommissioning").is_some();
        let name = if right { "DeviceCommissioning" } else { "DeviceComissioning" };
        let section = ini.get_or_make(name, Some("DeviceInfo"));
        section.set("NodeID", &node.node_id.to_string());
        section.set("NodeName", &line(&node.node_name));
        section.set("Baudrate", &node.baud_rate.to_string());
        section.set("NetNumber", &node.net_number.to_string());
        section.set("NetworkName", &line(&node.network_name));
        section.set("CANopenManager", if node.manager { "1" } else { "0" });
        section.set("LSS_SerialNumber", &node.lss_serial_number.to_string());
        for (index, sub, bytes) in values {
            let (index, sub) = (*index, *sub);
            let entry = od.find(index, sub).ok().and_then(|entry| od.entry(entry));
            let entry = entry.ok_or(DcfError::NoObject { index, sub })?;
            if let Some(text) = fault(entry, bytes) {
                return Err(DcfError::Value { index, sub, text });
            }
            if bytes.len() > limit::VALUE as usize {
                return Err(DcfError::TooLong { index, sub, len: bytes.len() });
            }
            let text = format(entry.data_type, bytes).ok_or(DcfError::Text { index, sub })?;
            self.set(&mut ini, index, sub, &text);
        }
        let mut out = String::new();
        for section in &ini.sections {
            out.push_str(&format!("[{}]\r\n", section.name));
            for key in &section.keys {
                out.push_str(&format!("{}={}\r\n", key.key, key.value));
            }
            out.push_str("\r\n");
        }
        Ok(out)
    }

    /// Puts `ParameterValue` where the file describes the sub-object.
    fn set(&self, ini: &mut super::Ini, index: u16, sub: u8, text: &str) {
        let object = self.objects.get(&index);
        let main = format!("{index:04X}");
        let has_subs = object.is_some_and(|object| object.code.has_subs());
        let own = if has_subs { format!("{main}sub{sub:X}") } else { main.clone() };
        if ini.get(&own).is_some() {
            ini.get_or_make(&own, None).set("ParameterValue", text);
            return;
        }
        if object.is_some_and(|object| object.compact > 0 && sub != 0) {
            let section = ini.get_or_make(&format!("{main}Value"), Some(&main));
            section.set(&sub.to_string(), text);
            let count = section.keys.iter().filter(|key| !key.is("NrOfEntries")).count();
            section.set("NrOfEntries", &count.to_string());
            return;
        }
        // Made by the reader (CompactPDO): describe it whole.
        let Some((object, entry)) = object.and_then(|object| Some((object, object.subs.get(&sub)?))) else {
            return;
        };
        if ini.get(&main).is_none() {
            let section = ini.get_or_make(&main, None);
            section.set("ParameterName", &object.name);
            section.set("ObjectType", &format!("0x{:X}", object.code as u8));
            section.set("SubNumber", &object.subs.len().to_string());
            for (&other, entry) in &object.subs {
                describe(ini, &format!("{main}sub{other:X}"), entry);
            }
        } else {
            describe(ini, &own, entry);
        }
        ini.get_or_make(&own, None).set("ParameterValue", text);
    }
}

fn describe(ini: &mut super::Ini, name: &str, entry: &super::EdsEntry) {
    let section = ini.get_or_make(name, None);
    section.set("ParameterName", &entry.name);
    section.set("ObjectType", "0x7");
    section.set("DataType", &format!("0x{:04X}", entry.data_type.index()));
    section.set("AccessType", entry.access.word());
    section.set("PDOMapping", if entry.mappable { "1" } else { "0" });
    if let Some(default) = &entry.default {
        let formula = if default.node_relative { "$NODEID+" } else { "" };
        if let Some(text) = format(entry.data_type, &default.bytes) {
            section.set("DefaultValue", &format!("{formula}{text}"));
        }
    }
}

/// One line of text.
fn line(text: &str) -> String {
    text.replace(['\r', '\n'], " ")
}
