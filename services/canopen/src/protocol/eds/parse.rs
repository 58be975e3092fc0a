//! From sections to objects (CiA 306-1 V1.4, 6.6 and 7).

use super::ini::{self, Ini, Key, Section};
use super::made::{compact_communication, compact_mapping, made};
use super::value;
use super::{Commissioning, DeviceInfo, Diag, Eds, EdsEntry, EdsError, EdsObject, List, Value, limit};
use crate::protocol::data_type::{DataType, Number};
use crate::protocol::od::{self, Access, ObjectCode};
use std::collections::BTreeMap;
use std::collections::btree_map::Entry;

/// Most mapping entries of a PDO that the file leaves out, for a granularity of bytes and of bits.
const MAPPING_BYTES: u8 = 8;
const MAPPING_BITS: u8 = 64;

pub(super) fn parse(bytes: &[u8]) -> Result<Eds, EdsError> {
    if bytes.len() > limit::FILE {
        return Err(EdsError::TooLarge(bytes.len()));
    }
    let mut diags = Vec::new();
    let text = ini::decode(bytes, &mut diags);
    if text.trim_start_matches('\u{FEFF}').trim_start().starts_with("<?xml") {
        return Err(EdsError::Xml { line: 1 });
    }
    let ini = Ini::parse(&text, &mut diags)?;
    let mut parser = Parser { ini: &ini, diags, objects: BTreeMap::new(), entries: 0 };
    let device = parser.device();
    let commissioning = parser.commissioning();
    let comments = parser.comments();
    let dummies = parser.dummies();
    parser.objects()?;
    parser.lists();
    parser.compact_pdos(&device);
    parser.modules();
    if parser.objects.is_empty() {
        return Err(EdsError::NoObjects);
    }
    let (mut warnings, objects) = (parser.diags, parser.objects);
    warnings.sort_by_key(|diag| diag.line);
    let mut warnings = super::thin_out(warnings);
    if warnings.len() > limit::WARNINGS {
        let more = warnings.len() - limit::WARNINGS;
        warnings.truncate(limit::WARNINGS);
        warnings.push(Diag::warning(0, "", "", format!("{more} more warnings are not shown")));
    }
    Ok(Eds { device, commissioning, comments, dummies, objects, warnings, ini })
}

struct Parser<'a> {
    ini: &'a Ini,
    diags: Vec<Diag>,
    objects: BTreeMap<u16, EdsObject>,
    entries: usize,
}

/// What a section's name stands for.
enum Kind {
    Object(u16),
    Sub(u16, u8),
    /// As a sub-object's, with a number that is none.
    NoSub,
    /// `Name`, `Value`, `Denotation`: one key for each sub-object of a `CompactSubObj`.
    Compact(u16),
    Other,
}

fn kind(name: &str) -> Kind {
    let name = ini::fold(name);
    if !name.is_char_boundary(4) || name.len() < 4 || name.starts_with('+') {
        return Kind::Other;
    }
    let (index, rest) = name.split_at(4);
    let Ok(index) = u16::from_str_radix(index, 16) else { return Kind::Other };
    match rest {
        "" => Kind::Object(index),
        "name" | "value" | "denotation" => Kind::Compact(index),
        _ => match rest.strip_prefix("sub").map(|sub| u8::from_str_radix(sub, 16)) {
            Some(Ok(sub)) => Kind::Sub(index, sub),
            Some(Err(_)) => Kind::NoSub,
            None => Kind::Other,
        },
    }
}

impl Parser<'_> {
    fn warn(&mut self, section: &Section, key: &str, text: String) {
        let line = section.get(key).map_or(section.line, |key| key.line);
        self.diags.push(Diag::warning(line, &section.name, key, text));
    }
    /// A number of a key; `None` if the key is missing, empty or no number.
    fn number(&mut self, section: &Section, key: &str) -> Option<u64> {
        let found = section.get(key)?;
        if found.value.is_empty() {
            return None;
        }
        match value::unsigned(&found.value) {
            Ok((number, remark)) => {
                if let Some(remark) = remark {
                    self.warn(section, key, remark);
                }
                Some(number)
            }
            Err(fault) => {
                self.warn(section, key, format!("{fault}: ignored"));
                None
            }
        }
    }
    /// As [`number`](Self::number), within the type.
    fn small<T: TryFrom<u64> + Default>(&mut self, section: &Section, key: &str) -> T {
        let Some(number) = self.number(section, key) else { return T::default() };
        T::try_from(number).unwrap_or_else(|_| {
            self.warn(section, key, format!("{number} is too large: ignored"));
            T::default()
        })
    }
    fn flag(&mut self, section: &Section, key: &str) -> bool {
        match section.text(key).to_ascii_lowercase().as_str() {
            "true" | "yes" => true,
            "false" | "no" => false,
            _ => self.number(section, key).is_some_and(|number| number != 0),
        }
    }

    fn device(&mut self) -> DeviceInfo {
        let Some(section) = self.ini.get("DeviceInfo") else {
            self.diags.push(Diag::warning(0, "DeviceInfo", "", "the section is missing".to_owned()));
            return DeviceInfo { granularity: 8, ..DeviceInfo::default() };
        };
        let rates = [10, 20, 50, 125, 250, 500, 800, 1000];
        DeviceInfo {
            vendor_name: section.text("VendorName").to_owned(),
            vendor_number: self.small(section, "VendorNumber"),
            product_name: section.text("ProductName").to_owned(),
            product_number: self.small(section, "ProductNumber"),
            revision_number: self.small(section, "RevisionNumber"),
            order_code: section.text("OrderCode").to_owned(),
            baud_rates: rates
                .into_iter()
                .filter(|rate| self.flag(section, &format!("BaudRate_{rate}")))
                .collect(),
            simple_boot_up_master: self.flag(section, "SimpleBootUpMaster"),
            simple_boot_up_slave: self.flag(section, "SimpleBootUpSlave"),
            granularity: section.get("Granularity").map_or(8, |_| self.small(section, "Granularity")),
            group_messaging: self.flag(section, "GroupMessaging"),
            rx_pdos: self.small(section, "NrOfRXPDO"),
            tx_pdos: self.small(section, "NrOfTXPDO"),
            lss_supported: self.flag(section, "LSS_Supported"),
            compact_pdo: self.small(section, "CompactPDO"),
        }
    }

    fn commissioning(&mut self) -> Option<Commissioning> {
        let section = self.ini.get("DeviceComissioning").or_else(|| self.ini.get("DeviceCommissioning"))?;
        let mut node_id: u8 = self.small(section, "NodeID");
        if node_id > 127 {
            self.warn(section, "NodeID", format!("{node_id} is no node-id (1-127): ignored"));
            node_id = 0;
        }
        Some(Commissioning {
            node_id,
            node_name: section.text("NodeName").to_owned(),
            baud_rate: self.small(section, "Baudrate"),
            net_number: self.small(section, "NetNumber"),
            network_name: section.text("NetworkName").to_owned(),
            manager: self.flag(section, "CANopenManager"),
            lss_serial_number: self.small(section, "LSS_SerialNumber"),
        })
    }

    fn comments(&mut self) -> Vec<String> {
        let Some(section) = self.ini.get("Comments") else { return Vec::new() };
        let lines = self.number(section, "Lines").unwrap_or(0).min(section.keys.len() as u64);
        (1..=lines).filter_map(|n| Some(section.get(&format!("Line{n}"))?.value.clone())).collect()
    }

    fn dummies(&mut self) -> u8 {
        let Some(section) = self.ini.get("DummyUsage") else { return 0 };
        (1..=7).fold(0, |mask, n| mask | u8::from(self.flag(section, &format!("Dummy{n:04X}"))) << n)
    }

    fn objects(&mut self) -> Result<(), EdsError> {
        for section in &self.ini.sections {
            if let Kind::Object(index) = kind(&section.name) {
                let object = self.object(section);
                self.objects.insert(index, object);
            }
        }
        for section in &self.ini.sections {
            match kind(&section.name) {
                Kind::Sub(index, sub) => self.sub(section, index, sub),
                Kind::Compact(index) => self.compact(section, index),
                Kind::NoSub => {
                    let text = "no sub-index (hexadecimal, 0 to FE) behind 'sub': the section is left out";
                    self.warn(section, "", text.to_owned());
                }
                Kind::Object(_) | Kind::Other => {}
            }
            if self.entries > od::limit::ENTRIES {
                return Err(EdsError::TooManyEntries);
            }
        }
        let indices: Vec<u16> = self.objects.keys().copied().collect();
        for index in indices {
            self.complete(index);
        }
        Ok(())
    }

    fn object(&mut self, section: &Section) -> EdsObject {
        let has_count = section.get("SubNumber").is_some() || section.get("CompactSubObj").is_some();
        let usual = if has_count { ObjectCode::Record } else { ObjectCode::Var };
        let mut code = match self.number(section, "ObjectType") {
            None => {
                if section.get("ObjectType").is_none() && section.get("DataType").is_none() {
                    self.warn(section, "ObjectType", format!("missing: taken as {}", usual.name()));
                }
                usual
            }
            Some(number) => u8::try_from(number).ok().and_then(ObjectCode::from_code).unwrap_or_else(|| {
                self.warn(
                    section,
                    "ObjectType",
                    format!("{number} is no object code: taken as {}", usual.name()),
                );
                usual
            }),
        };
        if !code.has_subs() && self.number(section, "SubNumber").is_some_and(|count| count > 0) {
            let text = format!("a {} has no sub-objects: taken as RECORD", code.name());
            self.warn(section, "SubNumber", text);
            code = ObjectCode::Record;
        }
        let name = self.parameter_name(section);
        let compact = if code.has_subs() { self.small(section, "CompactSubObj") } else { 0 };
        let mut object =
            EdsObject { name, code, list: List::None, line: section.line, compact, subs: BTreeMap::new() };
        if !code.has_subs() {
            let entry = self.entry(section, code, &object.name);
            object.subs.insert(0, entry);
            self.entries += 1;
        } else if compact > 0 {
            self.compact_subs(section, &mut object);
        }
        object
    }

    fn parameter_name(&mut self, section: &Section) -> String {
        let name = section.text("ParameterName").trim_matches('"').to_owned();
        if name.is_empty() {
            self.warn(section, "ParameterName", "missing: the index is the name".to_owned());
            return section.name.to_ascii_uppercase();
        }
        name
    }

    /// `CompactSubObj`: sub-index 0 and so many elements like the object itself (CiA 306-1).
    fn compact_subs(&mut self, section: &Section, object: &mut EdsObject) {
        let count = object.compact.min(0xFE);
        let element = self.entry(section, ObjectCode::Var, &object.name);
        let mut highest = made("Highest sub-index supported", DataType::Unsigned8, Access::Const);
        highest.default = Some(Value { bytes: vec![count], node_relative: false });
        object.subs.insert(0, highest);
        for sub in 1..=count {
            let name = format!("{}{sub}", object.name);
            object.subs.insert(sub, EdsEntry { name, parameter: None, ..element.clone() });
        }
        self.entries += usize::from(count) + 1;
    }

    /// `[iiiiName]`, `[iiiiValue]`, `[iiiiDenotation]` of a `CompactSubObj`.
    fn compact(&mut self, section: &Section, index: u16) {
        if !self.objects.contains_key(&index) {
            self.warn(section, "", format!("there is no object [{index:04X}]: ignored"));
            return;
        }
        let what = ini::fold(&section.name);
        for key in &section.keys {
            if key.is("NrOfEntries") {
                continue;
            }
            let sub = value::unsigned(&key.key).ok().and_then(|(sub, _)| u8::try_from(sub).ok());
            let entry = sub.and_then(|sub| self.objects.get_mut(&index)?.subs.get_mut(&sub));
            let Some(entry) = entry else {
                let text = "no sub-index of the object: ignored".to_owned();
                self.diags.push(Diag::warning(key.line, &section.name, &key.key, text));
                continue;
            };
            match what.as_str() {
                _ if what.ends_with("name") => entry.name.clone_from(&key.value),
                _ if what.ends_with("value") => match value::parse(&key.value, entry.data_type) {
                    Ok((value, _)) => entry.parameter = value,
                    Err(fault) => {
                        let text = format!("{fault}: ignored");
                        self.diags.push(Diag::warning(key.line, &section.name, &key.key, text));
                    }
                },
                _ => entry.denotation.clone_from(&key.value),
            }
        }
    }

    fn sub(&mut self, section: &Section, index: u16, sub: u8) {
        let Some(object) = self.objects.get(&index) else {
            let text = format!("there is no section [{index:04X}]: the object is taken as a RECORD");
            self.warn(section, "", text);
            let object = EdsObject {
                name: format!("{index:04X}"),
                code: ObjectCode::Record,
                list: List::None,
                line: section.line,
                compact: 0,
                subs: BTreeMap::new(),
            };
            self.objects.insert(index, object);
            return self.sub(section, index, sub);
        };
        if !object.code.has_subs() && sub != 0 {
            let text = format!("the object is a {} without sub-objects: ignored", object.code.name());
            return self.warn(section, "", text);
        }
        if sub == 0xFF {
            return self.warn(section, "", "sub-index FFh is the standard's own: ignored".to_owned());
        }
        let name = self.parameter_name(section);
        let entry = self.entry(section, ObjectCode::Var, &name);
        if let Some(object) = self.objects.get_mut(&index) {
            let old = object.subs.insert(sub, entry);
            if old.is_some_and(|old| old.line != 0 && object.compact == 0) {
                self.warn(section, "", "the sub-object is there twice: the last counts".to_owned());
            }
            self.entries += 1;
        }
    }

    fn entry(&mut self, section: &Section, code: ObjectCode, name: &str) -> EdsEntry {
        let (data_type, own) = self.data_type(section, code);
        let flags = self.number(section, "ObjFlags").unwrap_or(0);
        let low = self.limit(section, "LowLimit", data_type).or_else(|| self.type_limit(own, 2, data_type));
        let high = self.limit(section, "HighLimit", data_type).or_else(|| self.type_limit(own, 3, data_type));
        let (low, high) = self.limits(section, low, high);
        EdsEntry {
            name: name.to_owned(),
            data_type,
            access: self.access(section),
            mappable: self.flag(section, "PDOMapping"),
            default: self.value(section, "DefaultValue", data_type),
            parameter: self.value(section, "ParameterValue", data_type),
            low,
            high,
            no_download: flags & 1 != 0,
            no_scan: flags & 2 != 0,
            denotation: section.text("Denotation").to_owned(),
            upload_file: section.text("UploadFile").to_owned(),
            download_file: section.text("DownloadFile").to_owned(),
            line: section.line,
        }
    }

    /// The type, and its index if the file itself describes it.
    fn data_type(&mut self, section: &Section, code: ObjectCode) -> (DataType, Option<u16>) {
        let word = section.text("DataType");
        if let Some(named) = DataType::all().find(|known| known.name().eq_ignore_ascii_case(word)) {
            let text = format!("'{word}' is no number: taken as {:04X}h", named.index());
            self.warn(section, "DataType", text);
            let index = Some(named.index());
            return (self.standard_type(section, code, index), None);
        }
        let number = self.number(section, "DataType");
        let found = number.and_then(|number| u16::try_from(number).ok()).filter(|&index| index != 0);
        if let Some(index) = found
            && let Some(base) = self.type_field(index, 1).and_then(|base| value::unsigned(&base.value).ok())
            && let Ok(base) = u16::try_from(base.0).map(DataType::from_index)
            && base.size().is_some()
        {
            return (base, Some(index));
        }
        let data_type = self.standard_type(section, code, found);
        (data_type, None)
    }

    /// Sub-object `sub` of a type that the file describes itself, as CANFestival's editor does for a type with limits:
    /// section `[A0]` (two digits, so no object's), its sub-objects 1 base type, 2 lowest, 3 highest value.
    fn type_field(&self, index: u16, sub: u8) -> Option<&Key> {
        let ini = self.ini;
        (0x24..0x1000)
            .contains(&index)
            .then(|| ini.get(&format!("{index:X}sub{sub:X}")))??
            .get("DefaultValue")
    }

    fn type_limit(&self, own: Option<u16>, sub: u8, data_type: DataType) -> Option<Number> {
        let limit = self.type_field(own?, sub)?;
        value::limit(&limit.value, data_type).ok()?.0
    }

    fn standard_type(&mut self, section: &Section, code: ObjectCode, found: Option<u16>) -> DataType {
        match found.map(DataType::from_index) {
            Some(record) if record.is_record() => {
                self.warn(section, "DataType", format!("{record} is a record type: taken as DOMAIN"));
                DataType::Domain
            }
            Some(data_type) => data_type,
            None if matches!(code, ObjectCode::Domain | ObjectCode::Null) => DataType::Domain,
            // The standard's own type objects: their value is a length in bits.
            None if matches!(code, ObjectCode::DefType | ObjectCode::DefStruct) => DataType::Unsigned32,
            None => {
                self.warn(section, "DataType", "missing or not valid: taken as DOMAIN".to_owned());
                DataType::Domain
            }
        }
    }

    fn access(&mut self, section: &Section) -> Access {
        let word = section.text("AccessType").split([';', '#']).next().unwrap_or("").trim();
        if let Some(access) = Access::from_word(word) {
            return access;
        }
        let what = match word {
            "" => "missing".to_owned(),
            _ => format!("'{}' is none of ro, wo, rw, rwr, rww, const", ini::short(word)),
        };
        self.warn(section, "AccessType", format!("{what}: taken as ro"));
        Access::Ro
    }

    fn value(&mut self, section: &Section, key: &str, data_type: DataType) -> Option<Value> {
        let text = &section.get(key)?.value;
        match value::parse(text, data_type) {
            Ok((value, remark)) => {
                if let Some(remark) = remark {
                    self.warn(section, key, remark);
                }
                value
            }
            Err(fault) => {
                self.warn(section, key, format!("{fault}: ignored"));
                None
            }
        }
    }

    fn limit(&mut self, section: &Section, key: &str, data_type: DataType) -> Option<Number> {
        match value::limit(&section.get(key)?.value, data_type) {
            Ok((limit, remark)) => {
                if let Some(remark) = remark {
                    self.warn(section, key, remark);
                }
                limit
            }
            Err(fault) => {
                self.warn(section, key, format!("{fault}: no limit"));
                None
            }
        }
    }

    /// Limits that leave no value are none; both zero is how some tools write "no limits".
    fn limits(
        &mut self,
        section: &Section,
        low: Option<Number>,
        high: Option<Number>,
    ) -> (Option<Number>, Option<Number>) {
        let zero = |limit| matches!(limit, Some(Number::Int(0))) || limit == Some(Number::Real(0.0));
        if zero(low) && zero(high) && !matches!(section.text("DefaultValue"), "0" | "0x0" | "0x00") {
            self.warn(section, "HighLimit", "both limits are 0: taken as no limits".to_owned());
            return (None, None);
        }
        if let (Some(from), Some(to)) = (low, high)
            && !from.compare(to).is_some_and(|order| order.is_le())
        {
            self.warn(section, "HighLimit", format!("{to} is below the low limit {from}: no limits"));
            return (None, None);
        }
        (low, high)
    }

    /// Sub-index 0 and the announced number of sub-objects.
    fn complete(&mut self, index: u16) {
        let Some(object) = self.objects.get_mut(&index) else { return };
        if !object.code.has_subs() {
            return;
        }
        let last = object.subs.keys().next_back().copied().unwrap_or(0);
        let (line, count, compact) = (object.line, object.subs.len(), object.compact);
        let named = format!("{index:04X}");
        if let Entry::Vacant(zero) = object.subs.entry(0) {
            let mut highest = made("Highest sub-index supported", DataType::Unsigned8, Access::Const);
            highest.default = Some(Value { bytes: vec![last], node_relative: false });
            zero.insert(highest);
            self.entries += 1;
            let text = format!("sub-index 00 is missing: made with the value {last}");
            self.diags.push(Diag::warning(line, &named, "", text));
        }
        let Some(section) = self.ini.get(&named) else { return };
        if compact == 0
            && let Some(announced) = self.number(section, "SubNumber")
            && announced != count as u64
        {
            let text = format!("{announced} sub-objects are announced, {count} are described");
            self.warn(section, "SubNumber", text);
        }
    }

    fn lists(&mut self) {
        let lists = [
            ("MandatoryObjects", List::Mandatory),
            ("OptionalObjects", List::Optional),
            ("ManufacturerObjects", List::Manufacturer),
        ];
        for (name, list) in lists {
            let Some(section) = self.ini.get(name) else { continue };
            let mut count = 0u64;
            for key in &section.keys {
                if key.is("SupportedObjects") {
                    continue;
                }
                count += 1;
                let index = value::unsigned(&key.value).ok().and_then(|(index, _)| u16::try_from(index).ok());
                match index.and_then(|index| self.objects.get_mut(&index)) {
                    Some(object) => object.list = list,
                    None => {
                        let text = format!(
                            "object {} is listed but has no section: left out",
                            ini::short(&key.value)
                        );
                        self.diags.push(Diag::warning(key.line, &section.name, &key.key, text));
                    }
                }
            }
            let announced = self.number(section, "SupportedObjects").unwrap_or(0);
            if announced != count {
                let text = format!("{announced} objects are announced, {count} are listed");
                self.warn(section, "SupportedObjects", text);
            }
        }
        let unlisted: Vec<(u16, u32)> = self
            .objects
            .iter()
            // The standard's data types (below 1000h) are listed nowhere.
            .filter(|(index, object)| **index >= 0x1000 && object.list == List::None)
            .map(|(&index, object)| (index, object.line))
            .collect();
        for (index, line) in unlisted {
            let text = "in none of the lists of objects: taken nevertheless".to_owned();
            self.diags.push(Diag::warning(line, &format!("{index:04X}"), "", text));
        }
    }

    /// Modular devices (CiA 306-1 V1.4, 8): their modules' objects are nobody's until a device is put together.
    fn modules(&mut self) {
        let Some(section) = self.ini.get("SupportedModules") else { return };
        let count = self.number(section, "NrOfEntries").unwrap_or(0);
        if count > 0 {
            let text =
                format!("the objects of the {count} modules are not read, only those of the device itself");
            self.warn(section, "", text);
        }
    }

    /// `CompactPDO`: PDOs the file counts but does not describe (CiA 306-1).
    fn compact_pdos(&mut self, device: &DeviceInfo) {
        if device.compact_pdo == 0 {
            return;
        }
        let entries = if device.granularity >= 8 { MAPPING_BYTES } else { MAPPING_BITS };
        for (base, mapping, count, cob_id) in
            [(0x1400u16, 0x1600u16, device.rx_pdos, 0x200u32), (0x1800, 0x1A00, device.tx_pdos, 0x180)]
        {
            for n in 0..count.min(512) {
                let what = if base == 0x1400 { "RPDO" } else { "TPDO" };
                let communication = compact_communication(what, device.compact_pdo, n, cob_id);
                self.objects.entry(base + n).or_insert(communication);
                self.objects.entry(mapping + n).or_insert_with(|| compact_mapping(what, entries));
            }
        }
    }
}
