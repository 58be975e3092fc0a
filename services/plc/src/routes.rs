//! Routes: moves inside the process image, so that a gateway needs no program.
//!
//! Pure: bytes in, bytes out. A route from %I runs before the tasks, one from %Q or %M after them.

use dinrail_iec::artifact::{AreaKind, ElemType};
use dinrail_iec::{AddressSize, Addressing, LocatedAddress, parse_address};
use serde::{Deserialize, Serialize};

/// Most routes of a plc service.
pub const MAX_ROUTES: usize = 1024;

/// `on_bad` of a route: what it moves while its input is bad.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, Default)]
#[serde(rename_all = "snake_case")]
pub enum RouteOnBad {
    /// Nothing: the target keeps its value.
    #[default]
    Hold,
    /// Zero.
    Zero,
    /// This value, in units of the target, not scaled.
    Value(f64),
}

/// One `[[service.route]]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RouteConfig {
    /// %-address it reads: `%IW0`, `%QX0.1`, `%MD4`.
    pub from: String,
    /// %-address in %Q or %M that it writes.
    pub to: String,
    /// Type of the source; default by the size of `from` (BOOL, USINT, UINT, UDINT, ULINT).
    #[serde(rename = "type", default, skip_serializing_if = "Option::is_none")]
    pub type_name: Option<String>,
    /// Type of the target; default: that of the source, in the size of `to`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub to_type: Option<String>,
    /// `to = from * scale + offset`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scale: Option<f64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub offset: Option<f64>,
    /// Reverses the bytes of the source first: values that are big-endian on their bus.
    #[serde(default)]
    pub swap: bool,
    /// `"hold"`, `"zero"` or `{ value = 5.0 }`: what is moved while the input is bad.
    #[serde(default)]
    pub on_bad: RouteOnBad,
}

/// Why a route cannot be.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum RouteError {
    #[error("{0}")]
    Address(String),
    #[error("'{0}' lies in %I, which belongs to the field services; a route writes %Q or %M")]
    IntoInput(String),
    #[error(
        "'{0}' is no type of a route; write one of BOOL, BYTE, WORD, DWORD, LWORD, SINT, INT, DINT, LINT, USINT, UINT, UDINT, ULINT, REAL, LREAL"
    )]
    Type(String),
    #[error("'{address}' has {has} bytes, {type_name} needs {needs}")]
    Size { address: String, has: u32, type_name: &'static str, needs: u32 },
    #[error("'{address}' reaches beyond the {bytes} bytes of its area")]
    Beyond { address: String, bytes: u32 },
    #[error("a BOOL is moved as it is: leave scale, offset and swap out")]
    ScaledBool,
}

/// One end of a route, as offsets of memory.
#[derive(Debug, Clone, Copy, PartialEq)]
struct End {
    at: usize,
    bit: Option<u8>,
    elem: ElemType,
}

/// A route ready to run.
#[derive(Debug, Clone, PartialEq)]
pub struct Route {
    from: End,
    to: End,
    scale: f64,
    offset: f64,
    scaled: bool,
    swap: bool,
    on_bad: RouteOnBad,
    /// Runs before the tasks.
    pub before_tasks: bool,
    /// Indices of the input ranges that the source lies in.
    pub ranges: Vec<u16>,
}

/// First byte and size of an area: offset in memory, bytes.
pub type AreaAt = (u32, u32);

/// Where the areas lie in memory.
#[derive(Debug, Clone, Copy)]
pub struct RoutePlan<'a> {
    pub addressing: Addressing,
    pub input: AreaAt,
    pub output: AreaAt,
    pub marker: AreaAt,
    /// `(first byte in %I, bytes)` of each input range.
    pub input_ranges: &'a [(u32, u32)],
}

/// The type of this name; TIME and STRING cannot be routed.
pub fn elem_type(name: &str) -> Option<ElemType> {
    use ElemType::{
        Bool, Byte, Dint, Dword, Int, Lint, Lreal, Lword, Real, Sint, Udint, Uint, Ulint, Usint, Word,
    };
    [Bool, Byte, Word, Dword, Lword, Sint, Int, Dint, Lint, Usint, Uint, Udint, Ulint, Real, Lreal]
        .into_iter()
        .find(|t| t.name().eq_ignore_ascii_case(name))
}

fn default_type(size: AddressSize) -> ElemType {
    match size {
        AddressSize::Bit => ElemType::Bool,
        AddressSize::Byte => ElemType::Usint,
        AddressSize::Word => ElemType::Uint,
        AddressSize::Dword => ElemType::Udint,
        AddressSize::Lword => ElemType::Ulint,
    }
}

impl Route {
    /// Resolves a route of the stack file.
    pub fn new(config: &RouteConfig, plan: &RoutePlan<'_>) -> Result<Self, RouteError> {
        let parse =
            |text: &str| parse_address(text, plan.addressing).map_err(|e| RouteError::Address(e.to_string()));
        let (from_address, to_address) = (parse(&config.from)?, parse(&config.to)?);
        if to_address.area == AreaKind::Input {
            return Err(RouteError::IntoInput(config.to.clone()));
        }
        let named = |name: &Option<String>| match name {
            None => Ok(None),
            Some(name) => elem_type(name).map(Some).ok_or_else(|| RouteError::Type(name.clone())),
        };
        let from_type = named(&config.type_name)?.unwrap_or_else(|| default_type(from_address.size));
        let to_type = match named(&config.to_type)? {
            Some(given) => given,
            None if from_type.bytes() == to_address.size.bytes()
                && (from_type == ElemType::Bool) == (to_address.size == AddressSize::Bit) =>
            {
                from_type
            }
            None => default_type(to_address.size),
        };
        let scaled = config.scale.is_some() || config.offset.is_some();
        let any_bool = from_type == ElemType::Bool || to_type == ElemType::Bool;
        if any_bool && (scaled || config.swap) {
            return Err(RouteError::ScaledBool);
        }
        let from = end(&config.from, &from_address, from_type, plan)?;
        let to = end(&config.to, &to_address, to_type, plan)?;
        let from_input = from_address.area == AreaKind::Input;
        let bytes = from_address.byte..from_address.byte + from_address.size.bytes();
        let ranges = plan
            .input_ranges
            .iter()
            .enumerate()
            .filter(|(_, (at, len))| from_input && *at < bytes.end && bytes.start < at + len)
            .map(|(i, _)| i as u16)
            .collect();
        Ok(Self {
            from,
            to,
            scale: config.scale.unwrap_or(1.0),
            offset: config.offset.unwrap_or(0.0),
            scaled,
            swap: config.swap,
            on_bad: config.on_bad,
            before_tasks: from_input,
            ranges,
        })
    }

    /// Moves once. `bad` says whether one of [`Self::ranges`] is bad.
    pub fn run(&self, memory: &mut [u8], bad: bool) {
        if bad {
            match self.on_bad {
                RouteOnBad::Hold => return,
                RouteOnBad::Zero => return self.store(memory, Number::Int(0)),
                RouteOnBad::Value(x) => return self.store(memory, Number::Real(x)),
            }
        }
        let value = self.load(memory);
        let value = if self.scaled { Number::Real(value.real() * self.scale + self.offset) } else { value };
        self.store(memory, value);
    }

    fn load(&self, memory: &[u8]) -> Number {
        let end = &self.from;
        if let Some(bit) = end.bit {
            return Number::Int(memory.get(end.at).map_or(0, |byte| i128::from(byte >> bit & 1)));
        }
        let len = end.elem.bytes() as usize;
        let mut all = [0u8; 8];
        if let Some(bytes) = memory.get(end.at..end.at + len) {
            all[..len].copy_from_slice(bytes);
        }
        if self.swap {
            all[..len].reverse();
        }
        let raw = u64::from_le_bytes(all);
        match end.elem {
            ElemType::Bool => Number::Int(i128::from(raw != 0)),
            ElemType::Sint => Number::Int(i128::from(raw as i8)),
            ElemType::Int => Number::Int(i128::from(raw as i16)),
            ElemType::Dint => Number::Int(i128::from(raw as i32)),
            ElemType::Lint => Number::Int(i128::from(raw as i64)),
            ElemType::Real => Number::Real(f64::from(f32::from_bits(raw as u32))),
            ElemType::Lreal => Number::Real(f64::from_bits(raw)),
            _ => Number::Int(i128::from(raw)),
        }
    }

    fn store(&self, memory: &mut [u8], value: Number) {
        let end = &self.to;
        if let Some(bit) = end.bit {
            if let Some(byte) = memory.get_mut(end.at) {
                *byte = (*byte & !(1 << bit)) | (u8::from(value.integer() != 0) << bit);
            }
            return;
        }
        let raw = match end.elem {
            ElemType::Bool => u64::from(value.integer() != 0),
            // The bits of a NaN that arithmetic leaves differ between processors; a replay may run on another.
            ElemType::Real if value.real().is_nan() => u64::from(f32::NAN.to_bits()),
            ElemType::Lreal if value.real().is_nan() => f64::NAN.to_bits(),
            ElemType::Real => u64::from((value.real() as f32).to_bits()),
            ElemType::Lreal => value.real().to_bits(),
            elem => value.fit(elem),
        };
        let len = end.elem.bytes() as usize;
        if let Some(bytes) = memory.get_mut(end.at..end.at + len) {
            bytes.copy_from_slice(&raw.to_le_bytes()[..len]);
        }
    }
}

fn end(
    text: &str,
    address: &LocatedAddress,
    elem: ElemType,
    plan: &RoutePlan<'_>,
) -> Result<End, RouteError> {
    let (start, bytes) = match address.area {
        AreaKind::Input => plan.input,
        AreaKind::Output => plan.output,
        _ => plan.marker,
    };
    let is_bit = address.size == AddressSize::Bit;
    if is_bit != (elem == ElemType::Bool) || (!is_bit && elem.bytes() != address.size.bytes()) {
        return Err(RouteError::Size {
            address: text.to_owned(),
            has: address.size.bytes(),
            type_name: elem.name(),
            needs: elem.bytes(),
        });
    }
    if address.byte.saturating_add(address.size.bytes()) > bytes {
        return Err(RouteError::Beyond { address: text.to_owned(), bytes });
    }
    Ok(End { at: (start + address.byte) as usize, bit: address.bit, elem })
}

#[derive(Debug, Clone, Copy)]
enum Number {
    Int(i128),
    Real(f64),
}

impl Number {
    fn real(self) -> f64 {
        match self {
            Self::Int(n) => n as f64,
            Self::Real(x) => x,
        }
    }
    /// Nearest whole number, half to even; NaN is 0.
    fn integer(self) -> i128 {
        match self {
            Self::Int(n) => n,
            Self::Real(x) => libm::rint(x) as i128,
        }
    }
    /// The value in an integer type; what does not fit becomes the type's limit.
    fn fit(self, elem: ElemType) -> u64 {
        let bits = elem.bytes() * 8;
        let signed = matches!(elem, ElemType::Sint | ElemType::Int | ElemType::Dint | ElemType::Lint);
        let (lo, hi) = if signed {
            (-(1i128 << (bits - 1)), (1i128 << (bits - 1)) - 1)
        } else {
            (0, (1i128 << bits) - 1)
        };
        self.integer().clamp(lo, hi) as u64
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const PLAN: RoutePlan<'_> = RoutePlan {
        addressing: Addressing::Byte,
        input: (0, 16),
        output: (16, 16),
        marker: (32, 16),
        input_ranges: &[(0, 2), (2, 4)],
    };

    fn config(from: &str, to: &str) -> RouteConfig {
        RouteConfig {
            from: from.to_owned(),
            to: to.to_owned(),
            type_name: None,
            to_type: None,
            scale: None,
            offset: None,
            swap: false,
            on_bad: RouteOnBad::Hold,
        }
    }

    #[test]
    fn values_are_moved_scaled_and_kept_in_range() {
        let mut memory = [0u8; 48];
        memory[..6].copy_from_slice(&[0x12, 0x34, 0xFE, 0xFF, 0x03, 0x80]);
        let mut run = |c: RouteConfig| {
            Route::new(&c, &PLAN).unwrap().run(&mut memory, false);
            memory[16..24].to_vec()
        };
        assert_eq!(run(config("%IW0", "%QW0"))[..2], [0x12, 0x34]);
        assert_eq!(run(RouteConfig { swap: true, ..config("%IW0", "%QW0") })[..2], [0x34, 0x12]);
        let int = RouteConfig {
            type_name: Some("INT".into()),
            scale: Some(10.0),
            offset: Some(-1.0),
            ..config("%IW2", "%QW0")
        };
        assert_eq!(run(int.clone())[..2], (-21i16).to_le_bytes());
        // -21 does not fit an unsigned target.
        assert_eq!(run(RouteConfig { to_type: Some("UINT".into()), ..int.clone() })[..2], [0, 0]);
        let real = RouteConfig { to_type: Some("REAL".into()), to: "%QD0".into(), ..int };
        assert_eq!(run(real)[..4], (-21.0f32).to_le_bytes());
        assert_eq!(run(config("%IX4.1", "%QX7.6"))[7], 0x40);
        assert_eq!(run(config("%IX4.2", "%QX7.6"))[7], 0);
    }

    #[test]
    fn values_at_the_edges_of_their_types() {
        let run = |from: &[u8], types: (&str, &str), scale: Option<f64>| {
            let mut memory = [0u8; 48];
            memory[..from.len()].copy_from_slice(from);
            let letter = |t: &str| match elem_type(t).unwrap().bytes() {
                1 => 'B',
                2 => 'W',
                4 => 'D',
                _ => 'L',
            };
            let config = RouteConfig {
                type_name: Some(types.0.to_owned()),
                to_type: Some(types.1.to_owned()),
                scale,
                ..config(&format!("%I{}0", letter(types.0)), &format!("%Q{}0", letter(types.1)))
            };
            Route::new(&config, &PLAN).unwrap().run(&mut memory, false);
            u64::from_le_bytes(memory[16..24].try_into().unwrap())
        };
        // Whole numbers without scale are exact, however large.
        assert_eq!(run(&u64::MAX.to_le_bytes(), ("ULINT", "ULINT"), None), u64::MAX);
        assert_eq!(run(&u64::MAX.to_le_bytes(), ("ULINT", "LINT"), None), i64::MAX as u64);
        assert_eq!(run(&i64::MIN.to_le_bytes(), ("LINT", "ULINT"), None), 0);
        assert_eq!(run(&(-129i16).to_le_bytes(), ("INT", "SINT"), None), 0x80);
        for (x, expected) in
            [(2.5f32, 2u64), (3.5, 4), (-0.5, 0), (1e30, 65535), (f32::NAN, 0), (f32::INFINITY, 65535)]
        {
            assert_eq!(run(&x.to_le_bytes(), ("REAL", "UINT"), None), expected, "{x}");
        }
        assert_eq!(run(&f32::NEG_INFINITY.to_le_bytes(), ("REAL", "INT"), None), 0x8000);
        assert_eq!(run(&1e300f64.to_le_bytes(), ("LREAL", "REAL"), None), u64::from(f32::INFINITY.to_bits()));
        // Whatever NaN comes or arises, one goes on.
        for from in [0xFFC1_2345u32, f32::NAN.to_bits()] {
            assert_eq!(run(&from.to_le_bytes(), ("REAL", "REAL"), None), 0x7FC0_0000);
        }
        assert_eq!(run(&f64::INFINITY.to_le_bytes(), ("LREAL", "LREAL"), Some(0.0)), 0x7FF8_0000_0000_0000);
    }

    #[test]
    fn bad_inputs_hold_zero_or_show_a_value() {
        for (on_bad, expected) in
            [(RouteOnBad::Hold, 7u8), (RouteOnBad::Zero, 0), (RouteOnBad::Value(99.0), 99)]
        {
            let mut memory = [0u8; 48];
            (memory[2], memory[16]) = (5, 7);
            let route = Route::new(&RouteConfig { on_bad, ..config("%IB2", "%QB0") }, &PLAN).unwrap();
            assert_eq!(route.ranges, [1]);
            route.run(&mut memory, true);
            assert_eq!(memory[16], expected, "{on_bad:?}");
        }
    }

    #[test]
    fn wrong_routes_say_what_is_meant() {
        let table = [
            (config("%IW0", "%IW2"), "belongs to the field services"),
            (RouteConfig { type_name: Some("TIME".into()), ..config("%ID0", "%QD0") }, "no type of a route"),
            (RouteConfig { type_name: Some("DINT".into()), ..config("%IW0", "%QW0") }, "DINT needs 4"),
            (config("%IW15", "%QW0"), "beyond the 16 bytes"),
            (RouteConfig { scale: Some(2.0), ..config("%IX0.0", "%QX0.0") }, "as it is"),
            (config("%IX0.9", "%QX0.0"), "%IX1.1"),
        ];
        for (config, text) in table {
            let error = Route::new(&config, &PLAN).unwrap_err().to_string();
            assert!(error.contains(text), "{error}");
        }
    }

    proptest! {
        #[test]
        fn any_value_is_moved_without_panic(bytes in any::<[u8; 48]>(), scale in any::<f64>(), a in 0usize..15, b in 0usize..15) {
            let types = ["SINT", "USINT", "INT", "UINT", "DINT", "UDINT", "REAL", "LINT", "ULINT", "LREAL", "BYTE", "WORD", "DWORD", "LWORD", "BYTE"];
            let letter = |t: &str| match elem_type(t).unwrap().bytes() { 1 => 'B', 2 => 'W', 4 => 'D', _ => 'L' };
            let config = RouteConfig {
                type_name: Some(types[a].to_owned()), to_type: Some(types[b].to_owned()), scale: Some(scale),
                ..config(&format!("%I{}0", letter(types[a])), &format!("%Q{}0", letter(types[b])))
            };
            let mut memory = bytes;
            Route::new(&config, &PLAN).unwrap().run(&mut memory, false);
            prop_assert_eq!(&memory[..16], &bytes[..16]);
            prop_assert_eq!(&memory[24..], &bytes[24..]);
        }
    }
}
