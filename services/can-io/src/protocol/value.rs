//! Values of signals as values of the process image: type, scale, saturation.
//!
//! Physical value = raw * scale + offset. With scale 1 and offset 0 integers go through exactly, without floating
//! point. What does not fit is brought to the nearest value that does, in both directions; fractions are rounded to
//! the nearest, ties to even, as IEC 61131-3 converts REAL to integers. Bit strings (BYTE to LWORD) without scale
//! carry the bits as they are.

use serde::{Deserialize, Serialize};

use super::signal::Signal;

/// Type of a value in the process image.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "UPPERCASE")]
pub enum IecType {
    /// One bit.
    Bool,
    /// i8.
    Sint,
    /// i16.
    Int,
    /// i32.
    Dint,
    /// i64.
    Lint,
    /// u8.
    Usint,
    /// u16.
    Uint,
    /// u32.
    Udint,
    /// u64.
    Ulint,
    /// f32.
    Real,
    /// f64.
    Lreal,
    /// 8 bits.
    Byte,
    /// 16 bits.
    Word,
    /// 32 bits.
    Dword,
    /// 64 bits.
    Lword,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Bool,
    Signed,
    Unsigned,
    Bits,
    Float,
}

impl IecType {
    /// Bits in the image: 1, 8, 16, 32 or 64.
    pub fn bits(self) -> u32 {
        match self {
            Self::Bool => 1,
            Self::Sint | Self::Usint | Self::Byte => 8,
            Self::Int | Self::Uint | Self::Word => 16,
            Self::Dint | Self::Udint | Self::Dword | Self::Real => 32,
            Self::Lint | Self::Ulint | Self::Lword | Self::Lreal => 64,
        }
    }

    /// Bytes in the image; a BOOL counts as one.
    pub fn bytes(self) -> usize {
        self.bits().div_ceil(8) as usize
    }

    /// Name in the language.
    pub fn name(self) -> &'static str {
        match self {
            Self::Bool => "BOOL",
            Self::Sint => "SINT",
            Self::Int => "INT",
            Self::Dint => "DINT",
            Self::Lint => "LINT",
            Self::Usint => "USINT",
            Self::Uint => "UINT",
            Self::Udint => "UDINT",
            Self::Ulint => "ULINT",
            Self::Real => "REAL",
            Self::Lreal => "LREAL",
            Self::Byte => "BYTE",
            Self::Word => "WORD",
            Self::Dword => "DWORD",
            Self::Lword => "LWORD",
        }
    }

    fn kind(self) -> Kind {
        match self {
            Self::Bool => Kind::Bool,
            Self::Sint | Self::Int | Self::Dint | Self::Lint => Kind::Signed,
            Self::Usint | Self::Uint | Self::Udint | Self::Ulint => Kind::Unsigned,
            Self::Byte | Self::Word | Self::Dword | Self::Lword => Kind::Bits,
            Self::Real | Self::Lreal => Kind::Float,
        }
    }
}

/// How the bits of a signal are a number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Raw {
    /// Unsigned integer.
    Unsigned,
    /// Two's complement.
    Signed,
    /// IEEE 754, 32 or 64 bits by the signal's length.
    Float,
}

/// A signal with everything needed to turn it into a value of the image and back.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Codec {
    /// Where it lies.
    pub signal: Signal,
    /// What its bits are. [`Raw::Float`] only with 32 or 64 bits.
    pub raw: Raw,
    /// Finite, not 0.
    pub scale: f64,
    /// Finite.
    pub offset: f64,
    /// Type in the image.
    pub iec: IecType,
}

#[derive(Debug, Clone, Copy)]
enum Number {
    Exact(i128),
    Real(f64),
}

impl Codec {
    fn is_scaled(&self) -> bool {
        self.scale != 1.0 || self.offset != 0.0
    }

    /// The value as little-endian bytes of the image (the first [`IecType::bytes`] count); a BOOL is 0 or 1.
    /// `None`: the frame is too short.
    pub fn decode(&self, frame: &[u8]) -> Option<[u8; 8]> {
        let raw = self.signal.extract(frame)?;
        let number = match self.raw {
            Raw::Unsigned => Number::Exact(i128::from(raw)),
            Raw::Signed => Number::Exact(i128::from(self.signal.extract_signed(frame)?)),
            Raw::Float if self.signal.len() == 32 => Number::Real(f64::from(f32::from_bits(raw as u32))),
            Raw::Float => Number::Real(f64::from_bits(raw)),
        };
        Some(self.image_bytes(self.physical(number)))
    }

    fn physical(&self, number: Number) -> Number {
        if !self.is_scaled() {
            return number;
        }
        Number::Real(real(number) * self.scale + self.offset)
    }

    /// A physical value as bytes of the image, for substitutes.
    pub fn substitute(&self, value: f64) -> [u8; 8] {
        self.image_bytes(Number::Real(value))
    }

    fn image_bytes(&self, number: Number) -> [u8; 8] {
        let bits = self.iec.bits();
        let raw = match (self.iec.kind(), number) {
            (Kind::Bool, number) => u64::from(match number {
                Number::Exact(n) => n != 0,
                Number::Real(x) => x != 0.0 && !x.is_nan(),
            }),
            (Kind::Float, number) if bits == 32 => u64::from((real(number) as f32).to_bits()),
            (Kind::Float, number) => real(number).to_bits(),
            (Kind::Bits, Number::Exact(n)) => n as u64,
            (Kind::Signed, number) => clamp(number, true, bits) as u64,
            (_, number) => clamp(number, false, bits) as u64,
        };
        raw.to_le_bytes()
    }

    /// Writes the value (little-endian bytes of the image; for a BOOL the bit as 0 or 1) into the frame; false when
    /// the frame is too short.
    pub fn encode(&self, value: [u8; 8], frame: &mut [u8]) -> bool {
        let raw = u64::from_le_bytes(value);
        let unused = 64 - self.iec.bits();
        let low = raw << unused >> unused;
        let number = match self.iec.kind() {
            Kind::Bool | Kind::Unsigned | Kind::Bits => Number::Exact(i128::from(low)),
            Kind::Signed => Number::Exact(i128::from((raw << unused) as i64 >> unused)),
            Kind::Float if self.iec.bits() == 32 => Number::Real(f64::from(f32::from_bits(low as u32))),
            Kind::Float => Number::Real(f64::from_bits(raw)),
        };
        if self.iec.kind() == Kind::Bits && !self.is_scaled() && self.raw != Raw::Float {
            return self.signal.insert(frame, low);
        }
        self.insert(number, frame)
    }

    /// Writes a physical value into the frame, for safe states; false when the frame is too short.
    pub fn encode_physical(&self, value: f64, frame: &mut [u8]) -> bool {
        self.insert(Number::Real(value), frame)
    }

    fn insert(&self, physical: Number, frame: &mut [u8]) -> bool {
        let number = if self.is_scaled() {
            Number::Real((real(physical) - self.offset) / self.scale)
        } else {
            physical
        };
        let raw = match self.raw {
            Raw::Float if self.signal.len() == 32 => u64::from((real(number) as f32).to_bits()),
            Raw::Float => real(number).to_bits(),
            Raw::Signed => clamp(number, true, self.signal.len()) as u64,
            Raw::Unsigned => clamp(number, false, self.signal.len()) as u64,
        };
        self.signal.insert(frame, raw)
    }
}

fn real(number: Number) -> f64 {
    match number {
        Number::Exact(n) => n as f64,
        Number::Real(x) => x,
    }
}

/// The nearest integer of so many bits; not-a-number is 0.
fn clamp(number: Number, signed: bool, bits: u32) -> i128 {
    let (low, high) =
        if signed { (-(1i128 << (bits - 1)), (1i128 << (bits - 1)) - 1) } else { (0, (1i128 << bits) - 1) };
    match number {
        Number::Exact(n) => n.clamp(low, high),
        // The cast saturates and turns NaN into 0.
        Number::Real(x) => (x.round_ties_even() as i128).clamp(low, high),
    }
}

#[cfg(test)]
mod tests {
    use super::super::signal::ByteOrder;
    use super::*;
    use proptest::prelude::*;

    fn codec(start: u32, len: u32, raw: Raw, scale: f64, offset: f64, iec: IecType) -> Codec {
        Codec { signal: Signal::new(start, len, ByteOrder::Intel).unwrap(), raw, scale, offset, iec }
    }

    fn le(n: i64) -> [u8; 8] {
        n.to_le_bytes()
    }

    #[test]
    fn values_from_frames() {
        let frame = [0xFE, 0xFF, 0x00, 0x80, 0, 0, 0x20, 0xC1];
        let table = [
            (codec(0, 16, Raw::Unsigned, 1.0, 0.0, IecType::Uint), le(0xFFFE)),
            (codec(0, 16, Raw::Signed, 1.0, 0.0, IecType::Int), le(-2)),
            (codec(0, 16, Raw::Signed, 1.0, 0.0, IecType::Dint), le(-2)),
            // Does not fit: the nearest that does.
            (codec(0, 16, Raw::Unsigned, 1.0, 0.0, IecType::Int), le(32767)),
            (codec(0, 16, Raw::Signed, 1.0, 0.0, IecType::Uint), le(0)),
            (codec(16, 16, Raw::Signed, 1.0, 0.0, IecType::Sint), le(-128)),
            // Bits as they are.
            (codec(0, 16, Raw::Signed, 1.0, 0.0, IecType::Word), le(-2)),
            (codec(0, 8, Raw::Unsigned, 0.5, -10.0, IecType::Int), le(117)),
            (codec(0, 8, Raw::Unsigned, 0.25, 0.0, IecType::Usint), le(64)),
            (codec(0, 1, Raw::Unsigned, 1.0, 0.0, IecType::Bool), le(0)),
            (codec(1, 1, Raw::Unsigned, 1.0, 0.0, IecType::Bool), le(1)),
            (codec(0, 64, Raw::Unsigned, 1.0, 0.0, IecType::Ulint), u64::from_le_bytes(frame).to_le_bytes()),
            (codec(32, 32, Raw::Float, 1.0, 0.0, IecType::Int), le(-10)),
            (codec(32, 32, Raw::Float, 2.0, 1.0, IecType::Lreal), (-19.0f64).to_le_bytes()),
        ];
        for (codec, expected) in table {
            let bytes = codec.iec.bytes();
            assert_eq!(codec.decode(&frame).unwrap()[..bytes], expected[..bytes], "{codec:?}");
        }
        let real = codec(0, 8, Raw::Unsigned, 0.1, 0.0, IecType::Real).decode(&frame).unwrap();
        assert_eq!(f32::from_le_bytes([real[0], real[1], real[2], real[3]]), 25.4);
        assert_eq!(codec(0, 8, Raw::Unsigned, 1.0, 0.0, IecType::Int).decode(&[]), None);
    }

    #[test]
    fn values_to_frames() {
        let table = [
            (codec(0, 16, Raw::Signed, 1.0, 0.0, IecType::Int), le(-2), 0xFFFE),
            (codec(0, 8, Raw::Unsigned, 1.0, 0.0, IecType::Int), le(-2), 0),
            (codec(0, 8, Raw::Unsigned, 1.0, 0.0, IecType::Uint), le(300), 255),
            (codec(0, 8, Raw::Signed, 1.0, 0.0, IecType::Int), le(-300), 0x80),
            // Bits as they are: no sign, no saturation.
            (codec(0, 8, Raw::Signed, 1.0, 0.0, IecType::Word), le(0xABFF), 0xFF),
            (codec(0, 16, Raw::Unsigned, 0.1, -40.0, IecType::Real), le(i64::from(25.0f32.to_bits())), 650),
            (codec(0, 16, Raw::Unsigned, 0.1, 0.0, IecType::Real), le(i64::from(f32::NAN.to_bits())), 0),
            (codec(0, 1, Raw::Unsigned, 1.0, 0.0, IecType::Bool), le(1), 1),
            (codec(0, 32, Raw::Float, 1.0, 0.0, IecType::Int), le(-10), 0xC120_0000),
        ];
        for (codec, value, expected) in table {
            let mut frame = [0u8; 8];
            assert!(codec.encode(value, &mut frame));
            assert_eq!(u64::from_le_bytes(frame), expected, "{codec:?}");
        }
        let mut frame = [0u8; 8];
        codec(0, 16, Raw::Unsigned, 0.1, -40.0, IecType::Real).encode_physical(1e9, &mut frame);
        assert_eq!(frame[..3], [0xFF, 0xFF, 0]);
    }

    proptest! {
        /// Without scale, a value that fits comes back as it was, to the last of 64 bits.
        #[test]
        fn integers_are_exact(start in 0u32..64, value in any::<i64>(), len in 1u32..=64) {
            let Ok(signal) = Signal::new(start, len, ByteOrder::Motorola) else { return Ok(()) };
            let unused = 64 - len;
            let mut frame = [0xA5u8; 64];
            let signed = Codec { signal, raw: Raw::Signed, scale: 1.0, offset: 0.0, iec: IecType::Lint };
            let fits = value << unused >> unused;
            prop_assert!(signed.encode(fits.to_le_bytes(), &mut frame));
            prop_assert_eq!(signed.decode(&frame), Some(fits.to_le_bytes()));
            let unsigned = Codec { raw: Raw::Unsigned, iec: IecType::Ulint, ..signed };
            let fits = (value as u64) << unused >> unused;
            prop_assert!(unsigned.encode(fits.to_le_bytes(), &mut frame));
            prop_assert_eq!(unsigned.decode(&frame), Some(fits.to_le_bytes()));
        }

        #[test]
        fn never_panics(
            frame in prop::collection::vec(any::<u8>(), 0..=64),
            (start, len) in (0u32..512, 1u32..=64),
            scale in any::<f64>(),
            offset in any::<f64>(),
            value in any::<[u8; 8]>(),
            which in 0usize..45,
        ) {
            let types = [
                IecType::Bool, IecType::Sint, IecType::Int, IecType::Dint, IecType::Lint, IecType::Usint,
                IecType::Uint, IecType::Udint, IecType::Ulint, IecType::Real, IecType::Lreal, IecType::Byte,
                IecType::Word, IecType::Dword, IecType::Lword,
            ];
            let raw = [Raw::Unsigned, Raw::Signed, Raw::Float][which % 3];
            let len = if raw == Raw::Float { 32 } else { len };
            let Ok(signal) = Signal::new(start, len, ByteOrder::Intel) else { return Ok(()) };
            let codec = Codec { signal, raw, scale, offset, iec: types[which / 3] };
            let _ = codec.decode(&frame);
            let mut frame = frame;
            let _ = codec.encode(value, &mut frame);
            let _ = codec.encode_physical(offset, &mut frame);
        }
    }
}
