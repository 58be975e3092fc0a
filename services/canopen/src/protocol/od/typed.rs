//! Values as Rust numbers and text: the device's own door, without access rights and limits.

use super::{Abort, EntryRef, Number, ObjectDictionary};

impl ObjectDictionary {
    /// The number in a sub-object; `None` for strings and the like.
    pub fn number_at(&self, entry: EntryRef) -> Option<Number> {
        self.entry(entry)?.data_type.number(self.get(entry))
    }
    /// Sets a number: [`Abort::INVALID_VALUE`] if the type cannot hold it, [`Abort::TYPE_MISMATCH`] if it is
    /// none.
    pub fn set_number_at(&mut self, entry: EntryRef, number: Number) -> Result<(), Abort> {
        let data_type = self.entry(entry).ok_or(Abort::INTERNAL)?.data_type;
        if !data_type.is_integer() && !data_type.is_real() {
            return Err(Abort::TYPE_MISMATCH);
        }
        let mut bytes = [0; 8];
        let size = data_type.encode(number, &mut bytes).ok_or(Abort::INVALID_VALUE)?;
        self.set(entry, &bytes[..size])
    }
    /// The number at index and sub-index; `None` if there is none.
    pub fn number(&self, index: u16, sub: u8) -> Option<Number> {
        self.number_at(self.find(index, sub).ok()?)
    }
    fn int<T: TryFrom<i128>>(&self, index: u16, sub: u8) -> Option<T> {
        match self.number(index, sub)? {
            Number::Int(value) => T::try_from(value).ok(),
            Number::Real(_) => None,
        }
    }
    /// An integer or boolean of any size as `bool`: not 0.
    pub fn bool(&self, index: u16, sub: u8) -> Option<bool> {
        self.int::<i128>(index, sub).map(|value| value != 0)
    }
    /// An integer of any size that fits.
    pub fn u8(&self, index: u16, sub: u8) -> Option<u8> {
        self.int(index, sub)
    }
    /// An integer of any size that fits.
    pub fn u16(&self, index: u16, sub: u8) -> Option<u16> {
        self.int(index, sub)
    }
    /// An integer of any size that fits.
    pub fn u32(&self, index: u16, sub: u8) -> Option<u32> {
        self.int(index, sub)
    }
    /// An integer of any size that fits.
    pub fn u64(&self, index: u16, sub: u8) -> Option<u64> {
        self.int(index, sub)
    }
    /// An integer of any size that fits.
    pub fn i64(&self, index: u16, sub: u8) -> Option<i64> {
        self.int(index, sub)
    }
    /// A REAL32 or REAL64.
    pub fn f64(&self, index: u16, sub: u8) -> Option<f64> {
        match self.number(index, sub)? {
            Number::Real(value) => Some(value),
            Number::Int(_) => None,
        }
    }
    /// The bytes of a value, whatever its access.
    pub fn bytes(&self, index: u16, sub: u8) -> Option<&[u8]> {
        Some(self.get(self.find(index, sub).ok()?))
    }
    /// A string up to its first NUL, if it is UTF-8.
    pub fn text(&self, index: u16, sub: u8) -> Option<&str> {
        let bytes = self.bytes(index, sub)?;
        let end = bytes.iter().position(|&byte| byte == 0).unwrap_or(bytes.len());
        std::str::from_utf8(&bytes[..end]).ok()
    }
    /// Sets an integer of any size; [`Abort::INVALID_VALUE`] if it does not fit.
    pub fn set_uint(&mut self, index: u16, sub: u8, value: u64) -> Result<(), Abort> {
        let entry = self.find(index, sub)?;
        self.set_number_at(entry, Number::Int(i128::from(value)))
    }
    /// Sets an integer of any size; [`Abort::INVALID_VALUE`] if it does not fit.
    pub fn set_int(&mut self, index: u16, sub: u8, value: i64) -> Result<(), Abort> {
        let entry = self.find(index, sub)?;
        self.set_number_at(entry, Number::Int(i128::from(value)))
    }
    /// Sets a REAL32 or REAL64.
    pub fn set_f64(&mut self, index: u16, sub: u8, value: f64) -> Result<(), Abort> {
        let entry = self.find(index, sub)?;
        self.set_number_at(entry, Number::Real(value))
    }
    /// Sets the bytes of a value, whatever its access; the length must fit.
    pub fn set_bytes(&mut self, index: u16, sub: u8, data: &[u8]) -> Result<(), Abort> {
        let entry = self.find(index, sub)?;
        self.set(entry, data)
    }
}
