//! Electronic data sheets (EDS) and device configuration files (DCF): CiA 306-1; concise DCF: CiA 302-3.
//!
//! The reader takes what real files contain: whatever is wrong but harmless becomes a warning with its line, and
//! only what makes the file useless is an error. It must never panic, whatever the file, and never read another
//! file (`UploadFile` and `DownloadFile` are kept as names).
//!
//! [`Eds::parse`] reads both kinds, [`Eds::builder`] makes an object dictionary of it, [`Eds::dcf`] writes a DCF,
//! [`Eds::check`] says what a device's author should mend.

mod build;
mod check;
pub mod concise;
mod dcf;
mod ini;
mod made;
mod parse;
#[cfg(test)]
mod rough_tests;
#[cfg(test)]
mod tests;
pub mod value;

pub use build::BuildOptions;
pub use dcf::{DcfError, DcfOptions};
pub use ini::{Ini, Key, Section};
pub use value::Value;

use super::data_type::{DataType, Number, unsigned as unsigned_of};
use super::od::{Access, ObjectCode};
use std::collections::{BTreeMap, HashMap};
use std::fmt;

/// Limits of a file.
pub mod limit {
    /// Longest file, in bytes.
    pub const FILE: usize = 32 << 20;
    /// Longest line, in bytes.
    pub const LINE: usize = 1 << 20;
    /// Most lines.
    pub const LINES: usize = 4_000_000;
    /// Most warnings that are kept; the next one says that there are more.
    pub const WARNINGS: usize = 1000;
}

/// Why a file is no use. Names section and key where there are any.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum EdsError {
    #[error("the file has {0} bytes, more than {max}: is it an EDS?", max = limit::FILE)]
    TooLarge(usize),
    #[error("line {line}: longer than {max} bytes: is the file an EDS?", max = limit::LINE)]
    LineTooLong { line: u32 },
    #[error("the file has more than {max} lines: is it an EDS?", max = limit::LINES)]
    TooManyLines,
    #[error("the file describes no object: it has no section like [1000]; is it an EDS or DCF?")]
    NoObjects,
    #[error(
        "line {line}: the file is XML (XDD or XDC), which is not supported: ask the maker for the EDS, or convert it"
    )]
    Xml { line: u32 },
    #[error("the file describes more than {max} sub-objects: is it an EDS?", max = super::od::limit::ENTRIES)]
    TooManyEntries,
}

/// How serious a finding is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Severity {
    /// The file was read; what it says there was mended or left out.
    Warning,
    /// The device's author has to mend it: masters will stumble.
    Error,
}

/// A finding in a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Diag {
    /// Line in the file, from 1; 0: of no line.
    pub line: u32,
    pub severity: Severity,
    /// Section without brackets, may be empty.
    pub section: String,
    /// Key, may be empty.
    pub key: String,
    pub text: String,
}

impl Diag {
    pub(super) fn warning(line: u32, section: &str, key: &str, text: String) -> Self {
        Self { line, severity: Severity::Warning, section: section.to_owned(), key: key.to_owned(), text }
    }
    pub(super) fn error(line: u32, section: &str, key: &str, text: String) -> Self {
        Self { severity: Severity::Error, ..Self::warning(line, section, key, text) }
    }
}

/// Findings of one kind that are kept one by one; the others are told with the first of them.
const ALIKE: usize = 5;

/// A tool writes its peculiarity hundreds of times: of findings with one text only [`ALIKE`] are kept, and one more
/// that says how many there are and up to which line.
fn thin_out(diags: Vec<Diag>) -> Vec<Diag> {
    let mut kinds: HashMap<(String, String), (usize, u32)> = HashMap::new();
    for diag in &diags {
        let kind = kinds.entry((diag.key.clone(), diag.text.clone())).or_default();
        *kind = (kind.0 + 1, kind.1.max(diag.line));
    }
    let mut seen: HashMap<(String, String), usize> = HashMap::new();
    diags
        .into_iter()
        .filter_map(|mut diag| {
            let kind = (diag.key.clone(), diag.text.clone());
            let (count, last) = kinds.get(&kind).copied().unwrap_or_default();
            let at = seen.entry(kind).or_default();
            *at += 1;
            if count <= ALIKE + 1 || *at <= ALIKE {
                return Some(diag);
            }
            let more = count - *at;
            diag.text = format!("{} (so {more} times more, up to line {last})", diag.text);
            (*at == ALIKE + 1).then_some(diag)
        })
        .collect()
}

impl fmt::Display for Diag {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.line != 0 {
            write!(f, "line {}: ", self.line)?;
        }
        match (self.section.is_empty(), self.key.is_empty()) {
            (true, true) => {}
            (true, false) => write!(f, "{}: ", self.key)?,
            (false, true) => write!(f, "[{}]: ", self.section)?,
            (false, false) => write!(f, "[{}] {}: ", self.section, self.key)?,
        }
        f.write_str(&self.text)
    }
}

/// Section `[DeviceInfo]` (CiA 306-1 V1.4, 6.5).
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct DeviceInfo {
    pub vendor_name: String,
    pub vendor_number: u32,
    pub product_name: String,
    pub product_number: u32,
    pub revision_number: u32,
    pub order_code: String,
    /// Bit rates in kbit/s the device supports.
    pub baud_rates: Vec<u16>,
    pub simple_boot_up_master: bool,
    pub simple_boot_up_slave: bool,
    /// Smallest mappable unit in bits, 1-64; 0: mapping is fixed.
    pub granularity: u8,
    pub group_messaging: bool,
    pub rx_pdos: u16,
    pub tx_pdos: u16,
    pub lss_supported: bool,
    /// Bit n: sub-index n + 1 of the communication parameters of PDOs that the file does not describe.
    pub compact_pdo: u8,
}

/// Section `[DeviceComissioning]` of a DCF, misspelt by the standard (CiA 306-1 V1.4, 7.3.5).
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Commissioning {
    /// 1-127; 0: not given.
    pub node_id: u8,
    pub node_name: String,
    /// kbit/s; 0: not given.
    pub baud_rate: u16,
    pub net_number: u32,
    pub network_name: String,
    pub manager: bool,
    pub lss_serial_number: u32,
}

/// Which list names an object (CiA 306-1 V1.4, 6.6.3.1).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum List {
    Mandatory,
    Optional,
    Manufacturer,
    /// The file describes the object but lists it nowhere, or the reader made it (`CompactPDO`).
    None,
}

/// An object of the file.
#[derive(Clone, Debug, PartialEq)]
pub struct EdsObject {
    pub name: String,
    pub code: ObjectCode,
    pub list: List,
    /// Line of its section, 0 if it was made by the reader.
    pub line: u32,
    /// Elements of a `CompactSubObj`, 0: none.
    pub compact: u8,
    pub subs: BTreeMap<u8, EdsEntry>,
}

/// A sub-object of the file; of a VAR the object itself.
#[derive(Clone, Debug, PartialEq)]
pub struct EdsEntry {
    pub name: String,
    pub data_type: DataType,
    pub access: Access,
    pub mappable: bool,
    /// `DefaultValue`.
    pub default: Option<Value>,
    /// `ParameterValue` of a DCF: what the device is to be configured with.
    pub parameter: Option<Value>,
    pub low: Option<Number>,
    pub high: Option<Number>,
    /// `ObjFlags` bit 0: not to be written when the configuration is downloaded.
    pub no_download: bool,
    /// `ObjFlags` bit 1: not to be read when the device is scanned.
    pub no_scan: bool,
    /// `Denotation` of a DCF: the name the user gave it.
    pub denotation: String,
    /// File a domain is read into.
    pub upload_file: String,
    /// File a domain is written from.
    pub download_file: String,
    /// Line of its section, 0 if it was made by the reader.
    pub line: u32,
}

/// An EDS or DCF.
#[derive(Clone, Debug, PartialEq)]
pub struct Eds {
    pub device: DeviceInfo,
    /// Of a DCF.
    pub commissioning: Option<Commissioning>,
    /// Lines of `[Comments]`.
    pub comments: Vec<String>,
    /// Bit n: dummy object 000n may be mapped (`[DummyUsage]`).
    pub dummies: u8,
    pub objects: BTreeMap<u16, EdsObject>,
    /// What was wrong with the file, in order of lines.
    pub warnings: Vec<Diag>,
    /// The file as it was, for [`Eds::dcf`].
    ini: Ini,
}

impl Eds {
    /// Reads the bytes of an EDS or DCF.
    pub fn parse(bytes: &[u8]) -> Result<Self, EdsError> {
        parse::parse(bytes)
    }
    /// A sub-object.
    pub fn entry(&self, index: u16, sub: u8) -> Option<&EdsEntry> {
        self.objects.get(&index)?.subs.get(&sub)
    }
    /// Name of a sub-object for people: the object's, and of ARRAY and RECORD also the sub-object's.
    pub fn name(&self, index: u16, sub: u8) -> Option<String> {
        let object = self.objects.get(&index)?;
        let entry = object.subs.get(&sub)?;
        Some(if object.code.has_subs() {
            format!("{}, {}", object.name, entry.name)
        } else {
            object.name.clone()
        })
    }
    /// Index, sub-index and name of every sub-object, ascending.
    pub fn names(&self) -> impl Iterator<Item = (u16, u8, String)> + '_ {
        self.objects.iter().flat_map(move |(&index, object)| {
            object.subs.keys().filter_map(move |&sub| Some((index, sub, self.name(index, sub)?)))
        })
    }
    /// Every sub-object, ascending.
    pub fn entries(&self) -> impl Iterator<Item = (u16, u8, &EdsEntry)> {
        self.objects
            .iter()
            .flat_map(|(&index, object)| object.subs.iter().map(move |(&sub, entry)| (index, sub, entry)))
    }
    /// What a DCF configures: index, sub-index and `ParameterValue` of everything that may be written and downloaded,
    /// with the node-id (1-127) in `$NODEID` values.
    pub fn parameter_values(&self, node_id: u8) -> Vec<(u16, u8, Vec<u8>)> {
        self.entries()
            .filter(|(_, _, entry)| entry.access.writable() && !entry.no_download)
            .filter_map(|(index, sub, entry)| Some((index, sub, entry.parameter.as_ref()?.resolve(node_id))))
            .collect()
    }
    /// A section of the file as it stands there, whatever the case of its name.
    pub fn section(&self, name: &str) -> Option<&Section> {
        self.ini.get(name)
    }
}

impl Value {
    /// The bytes with the node-id added where it belongs.
    pub fn resolve(&self, node_id: u8) -> Vec<u8> {
        if !self.node_relative {
            return self.bytes.clone();
        }
        let len = self.bytes.len().min(8);
        let sum = unsigned_of(&self.bytes).wrapping_add(u64::from(node_id));
        sum.to_le_bytes()[..len].to_vec()
    }
}
