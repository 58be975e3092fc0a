//! Store and restore of parameters: 1010h and 1011h (CiA 301 V4.2, 7.5.2.13 and 7.5.2.14).
//!
//! [`Store`] is the non-volatile memory as a byte image with a check sum. It never touches a file: its owner hands the
//! image in at the start and writes it away whenever it changed. Storing is rare and may allocate.

use super::abort::Abort;
use super::od::{Access, Entry, ObjectDictionary};
use std::ops::RangeInclusive;

/// "save", what 1010h wants to be written (figure 57).
pub const SAVE: u32 = 0x6576_6173;
/// "load", what 1011h wants to be written (figure 59).
pub const LOAD: u32 = 0x6461_6F6C;
/// Bit 0 of a sub-index of 1010h: the device stores on command. Of 1011h: it restores.
pub const ON_COMMAND: u32 = 1;

const MAGIC: [u8; 4] = *b"DRCO";
const VERSION: u32 = 1;
/// Magic, version, device type, vendor, product, number of records.
const HEADER: usize = 24;
/// Index, sub-index, reserved, length.
const RECORD: usize = 8;
const CHECKSUM: usize = 4;
/// Longest image that is taken.
pub const IMAGE_BYTES: usize = 16 << 20;

/// Why an image was not taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum StoreError {
    #[error(
        "the stored parameters are {0} bytes long, which no image has; remove the file to start with defaults"
    )]
    Length(usize),
    #[error("this is no file of stored CANopen parameters")]
    Magic,
    #[error("the stored parameters have format {0}, this version reads format {VERSION}")]
    Version(u32),
    #[error(
        "the check sum of the stored parameters is wrong: the file is damaged; remove it to start with defaults"
    )]
    Checksum,
    #[error(
        "the stored parameters are another device's: device type {device_type:08X}h, vendor {vendor:08X}h, \
         product {product:08X}h"
    )]
    OtherDevice { device_type: u32, vendor: u32, product: u32 },
    #[error(
        "the records of the stored parameters do not fit their length; remove the file to start with defaults"
    )]
    Records,
}

/// Objects of sub-index `sub` of 1010h and 1011h: 1 all, 2 communication, 3 application (device profiles), others
/// manufacturer-specific.
pub fn group(sub: u8) -> RangeInclusive<u16> {
    match sub {
        1 => 0x1000..=0xFFFF,
        2 => 0x1000..=0x1FFF,
        3 => 0x6000..=0x9FFF,
        _ => 0x2000..=0x5FFF,
    }
}

/// Values that are states, commands or process data, not parameters: an output that was on when "save" came must not
/// be on at the next power-on. `rww` and `rwr` say that a value belongs to a PDO.
fn is_parameter(entry: &Entry) -> bool {
    let stated =
        matches!(entry.index, 0x1001..=0x1003 | 0x1010 | 0x1011 | 0x1013 | 0x1023..=0x1025 | 0x1F50..=0x1F5F);
    let process = entry.mappable && matches!(entry.access, Access::Rww | Access::Rwr);
    entry.access.writable() && entry.access != Access::Wo && !stated && !process
}

/// CRC-32 (ISO-HDLC, as in zip and Ethernet).
pub fn crc32(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(u32::MAX, |crc, &byte| {
        (0..8).fold(
            crc ^ u32::from(byte),
            |crc, _| if crc & 1 != 0 { crc >> 1 ^ 0xEDB8_8320 } else { crc >> 1 },
        )
    })
}

fn identity(od: &ObjectDictionary) -> [u32; 3] {
    [od.u32(0x1000, 0), od.u32(0x1018, 1), od.u32(0x1018, 2)].map(|value| value.unwrap_or(0))
}

fn word(bytes: &[u8], at: usize) -> Option<u32> {
    Some(u32::from_le_bytes(bytes.get(at..at + 4)?.try_into().ok()?))
}

struct Record<'a> {
    index: u16,
    sub: u8,
    value: &'a [u8],
}

/// Records behind the header; None where they do not fit.
fn records(bytes: &[u8]) -> impl Iterator<Item = Option<Record<'_>>> {
    let mut rest = bytes;
    std::iter::from_fn(move || {
        if rest.is_empty() {
            return None;
        }
        let record = word(rest, 0).zip(word(rest, 4)).and_then(|(object, len)| {
            let value = rest.get(RECORD..RECORD.checked_add(len as usize)?)?;
            Some(Record { index: object as u16, sub: (object >> 16) as u8, value })
        });
        rest = record.as_ref().map_or(&[], |record| &rest[RECORD + record.value.len()..]);
        Some(record)
    })
}

/// What is stored: the values that differ from the defaults.
#[derive(Debug, Clone, Default)]
pub struct Store {
    image: Vec<u8>,
    /// Records that the dictionary did not take: object gone or of another length.
    pub skipped: u64,
}

impl Store {
    /// Takes an image. An empty one is that of a new device.
    pub fn load(od: &ObjectDictionary, image: &[u8]) -> Result<Self, StoreError> {
        if image.is_empty() {
            return Ok(Self::default());
        }
        let end =
            image.len().checked_sub(CHECKSUM).filter(|&end| end >= HEADER && image.len() <= IMAGE_BYTES);
        let end = end.ok_or(StoreError::Length(image.len()))?;
        if image[..4] != MAGIC {
            return Err(StoreError::Magic);
        }
        let field = |at: usize| word(image, at).unwrap_or(0);
        if field(4) != VERSION {
            return Err(StoreError::Version(field(4)));
        }
        if field(end) != crc32(&image[..end]) {
            return Err(StoreError::Checksum);
        }
        let [device_type, vendor, product] = [field(8), field(12), field(16)];
        if [device_type, vendor, product] != identity(od) {
            return Err(StoreError::OtherDevice { device_type, vendor, product });
        }
        let mut count = 0;
        for record in records(&image[HEADER..end]) {
            record.ok_or(StoreError::Records)?;
            count += 1;
        }
        if count != field(20) {
            return Err(StoreError::Records);
        }
        Ok(Self { image: image.to_vec(), skipped: 0 })
    }
    /// The image to keep. Empty: nothing is stored, remove the file.
    pub fn image(&self) -> &[u8] {
        &self.image
    }
    fn body(&self) -> &[u8] {
        let end = self.image.len().saturating_sub(CHECKSUM);
        self.image.get(HEADER..end).unwrap_or(&[])
    }
    /// Gives stored values of the objects in `range` to the dictionary: after the defaults, at a reset.
    pub fn apply(&mut self, od: &mut ObjectDictionary, range: &RangeInclusive<u16>) {
        let mut skipped = 0;
        for record in records(self.body()).flatten().filter(|record| range.contains(&record.index)) {
            if od.set_bytes(record.index, record.sub, record.value).is_err() {
                skipped += 1;
            }
        }
        self.skipped += skipped;
    }
    /// "save" was written to sub-index `sub` of 1010h.
    pub fn save(&mut self, od: &ObjectDictionary, sub: u8) {
        let range = group(sub);
        self.rebuild(od, &range, true);
    }
    /// "load" was written to sub-index `sub` of 1011h: the defaults are valid from the next reset on.
    pub fn restore(&mut self, od: &ObjectDictionary, sub: u8) {
        let range = group(sub);
        self.rebuild(od, &range, false);
    }
    fn rebuild(&mut self, od: &ObjectDictionary, range: &RangeInclusive<u16>, save: bool) {
        let mut image = Vec::with_capacity(self.image.len() + 1024);
        image.extend_from_slice(&MAGIC);
        image.extend_from_slice(&VERSION.to_le_bytes());
        for field in identity(od) {
            image.extend_from_slice(&field.to_le_bytes());
        }
        image.extend_from_slice(&[0; 4]);
        let mut count = 0u32;
        let mut add = |index: u16, sub: u8, value: &[u8]| {
            image.extend_from_slice(&(u32::from(index) | u32::from(sub) << 16).to_le_bytes());
            image.extend_from_slice(&(value.len() as u32).to_le_bytes());
            image.extend_from_slice(value);
            count += 1;
        };
        for record in records(self.body()).flatten().filter(|record| !range.contains(&record.index)) {
            add(record.index, record.sub, record.value);
        }
        if save {
            for (at, entry) in od.entries() {
                let changed = od.get(at) != od.default_of(at);
                if range.contains(&entry.index) && is_parameter(entry) && changed {
                    add(entry.index, entry.sub, od.get(at));
                }
            }
        }
        if count == 0 {
            self.image.clear();
            return;
        }
        image[20..24].copy_from_slice(&count.to_le_bytes());
        let sum = crc32(&image);
        image.extend_from_slice(&sum.to_le_bytes());
        self.image = image;
    }
}

/// Checks a write to 1010h (`signature` = [`SAVE`]) or 1011h ([`LOAD`]): the right word, and an ability.
pub fn check(od: &ObjectDictionary, index: u16, sub: u8, value: u32) -> Result<(), Abort> {
    let signature = if index == 0x1010 { SAVE } else { LOAD };
    let able = od.u32(index, sub).unwrap_or(0) & ON_COMMAND != 0;
    if value == signature && able { Ok(()) } else { Err(Abort::CANNOT_STORE) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::protocol::data_type::DataType;
    use crate::protocol::od::{EntryDef, OdBuilder};

    fn od() -> ObjectDictionary {
        let mut builder = OdBuilder::new();
        let number = |value: i64| EntryDef::new(DataType::Unsigned32, Access::Rw).value(value);
        builder.var(0x1000, EntryDef::new(DataType::Unsigned32, Access::Ro).value(0x191));
        builder.var(0x1017, number(0)).var(0x2000, number(7)).var(0x6000, number(8));
        builder.var(0x1010, number(1));
        builder.build(4).unwrap()
    }

    #[test]
    fn crc_is_the_usual_one() {
        assert_eq!(crc32(b"123456789"), 0xCBF4_3926);
    }

    #[test]
    fn groups_are_stored_and_restored_apart() {
        let mut od = od();
        let mut store = Store::default();
        for index in [0x1017, 0x2000, 0x6000] {
            od.set_uint(index, 0, 99).unwrap();
        }
        store.save(&od, 2);
        let mut store = Store::load(&od, store.image()).unwrap();
        let value_after = |store: &mut Store, index: u16| {
            let mut fresh = super::tests::od();
            store.apply(&mut fresh, &(0..=0xFFFF));
            fresh.u32(index, 0).unwrap()
        };
        assert_eq!(value_after(&mut store, 0x1017), 99);
        assert_eq!(value_after(&mut store, 0x2000), 7);
        store.save(&od, 1);
        assert_eq!([0x1017, 0x2000, 0x6000].map(|index| value_after(&mut store, index)), [99; 3]);
        store.restore(&od, 3);
        assert_eq!([0x1017, 0x2000, 0x6000].map(|index| value_after(&mut store, index)), [99, 99, 8]);
        store.restore(&od, 1);
        assert!(store.image().is_empty());
    }

    #[test]
    fn outputs_are_not_stored() {
        let mut builder = OdBuilder::new();
        let output = |access| EntryDef::new(DataType::Unsigned8, access);
        builder.var(0x6200, output(Access::Rww).mappable()).var(0x6206, output(Access::Rww));
        builder.var(0x6207, output(Access::Rw).mappable());
        let mut od = builder.build(4).unwrap();
        for index in [0x6200, 0x6206, 0x6207] {
            od.set_uint(index, 0, 1).unwrap();
        }
        let mut store = Store::default();
        store.save(&od, 1);
        let mut fresh = builder.build(4).unwrap();
        store.apply(&mut fresh, &(0..=0xFFFF));
        assert_eq!([0x6200, 0x6206, 0x6207].map(|index| fresh.u8(index, 0)), [Some(0), Some(1), Some(1)]);
    }

    #[test]
    fn damage_is_seen() {
        let mut od = od();
        od.set_uint(0x2000, 0, 1).unwrap();
        let mut store = Store::default();
        store.save(&od, 1);
        let good = store.image().to_vec();
        for at in 0..good.len() {
            let mut bad = good.clone();
            bad[at] ^= 1;
            assert!(Store::load(&od, &bad).is_err(), "byte {at}");
            assert!(Store::load(&od, &good[..at]).is_err() || at == 0);
        }
        let mut other = OdBuilder::new();
        other.var(0x1000, EntryDef::new(DataType::Unsigned32, Access::Ro).value(0x192));
        let error = Store::load(&other.build(4).unwrap(), &good).unwrap_err();
        insta::assert_snapshot!(error, @"the stored parameters are another device's: device type 00000191h, vendor 00000000h, product 00000000h");
    }

    #[test]
    fn only_the_right_word_stores() {
        let od = od();
        assert_eq!(check(&od, 0x1010, 0, SAVE), Ok(()));
        assert_eq!(check(&od, 0x1010, 0, LOAD), Err(Abort::CANNOT_STORE));
        assert_eq!(check(&od, 0x1011, 0, LOAD), Err(Abort::CANNOT_STORE));
    }

    proptest::proptest! {
        #[test]
        fn any_bytes_are_refused_or_read(bytes: Vec<u8>) {
            let od = od();
            proptest::prop_assert!(bytes.is_empty() || Store::load(&od, &bytes).is_err());
            // Behind a right frame: records of any shape.
            let mut image = MAGIC.to_vec();
            for field in [VERSION, 0x191, 0, 0, 1] {
                image.extend_from_slice(&field.to_le_bytes());
            }
            image.extend_from_slice(&bytes);
            image.extend_from_slice(&crc32(&image).to_le_bytes());
            if let Ok(mut store) = Store::load(&od, &image) {
                store.apply(&mut od.clone(), &(0..=0xFFFF));
            }
        }
    }
}
