//! The elementary types.

use crate::artifact::ElemType;
use ElemType::*;

/// What the compiler asks about an elementary type.
pub trait ElemExt: Copy {
    fn bits(self) -> u32;
    fn is_int(self) -> bool;
    fn is_signed(self) -> bool;
    fn is_real(self) -> bool;
    /// BYTE to LWORD, not BOOL.
    fn is_bits(self) -> bool;
    /// BOOL, BYTE to LWORD.
    fn is_any_bit(self) -> bool;
    /// ANY_NUM: integers and reals.
    fn is_num(self) -> bool;
    /// Least and greatest value of an integer, bit string or BOOL; TIME in ns.
    fn range(self) -> (i128, i128);
    /// Carried as a 64-bit integer.
    fn is_wide(self) -> bool;
}

impl ElemExt for ElemType {
    fn bits(self) -> u32 {
        if self == Bool { 1 } else { self.bytes() * 8 }
    }
    fn is_int(self) -> bool {
        matches!(self, Sint | Int | Dint | Lint | Usint | Uint | Udint | Ulint)
    }
    fn is_signed(self) -> bool {
        matches!(self, Sint | Int | Dint | Lint | Time)
    }
    fn is_real(self) -> bool {
        matches!(self, Real | Lreal)
    }
    fn is_bits(self) -> bool {
        matches!(self, Byte | Word | Dword | Lword)
    }
    fn is_any_bit(self) -> bool {
        self == Bool || self.is_bits()
    }
    fn is_num(self) -> bool {
        self.is_int() || self.is_real()
    }
    fn range(self) -> (i128, i128) {
        if self.is_real() {
            return (0, 0);
        }
        let bits = self.bits();
        if self.is_signed() { (-(1 << (bits - 1)), (1 << (bits - 1)) - 1) } else { (0, (1 << bits) - 1) }
    }
    fn is_wide(self) -> bool {
        matches!(self, Lint | Ulint | Lword | Time)
    }
}

/// The elementary type with this keyword. LTIME is TIME.
pub fn elementary(name: &str) -> Option<ElemType> {
    let mut upper = [0_u8; 5];
    let bytes = name.as_bytes();
    if bytes.len() > upper.len() {
        return None;
    }
    for (to, from) in upper.iter_mut().zip(bytes) {
        *to = from.to_ascii_uppercase();
    }
    Some(match &upper[..bytes.len()] {
        b"BOOL" => Bool,
        b"BYTE" => Byte,
        b"WORD" => Word,
        b"DWORD" => Dword,
        b"LWORD" => Lword,
        b"SINT" => Sint,
        b"INT" => Int,
        b"DINT" => Dint,
        b"LINT" => Lint,
        b"USINT" => Usint,
        b"UINT" => Uint,
        b"UDINT" => Udint,
        b"ULINT" => Ulint,
        b"REAL" => Real,
        b"LREAL" => Lreal,
        b"TIME" | b"LTIME" => Time,
        _ => return None,
    })
}

/// True when a value of `from` becomes one of `to` without being asked (IEC 61131-3 Ed. 3, figure 12): no value
/// is ever lost.
pub fn widens(from: ElemType, to: ElemType) -> bool {
    if from == to {
        return true;
    }
    if from.is_int() && to.is_int() {
        let (flo, fhi) = from.range();
        let (tlo, thi) = to.range();
        return flo >= tlo && fhi <= thi;
    }
    if from.is_int() && to.is_real() {
        let mantissa = if to == Real { 24 } else { 53 };
        return from.bits() <= mantissa;
    }
    if from.is_any_bit() && to.is_any_bit() {
        return from.bits() < to.bits();
    }
    from == Real && to == Lreal
}

/// The smallest type both widen to.
pub fn common_type(a: ElemType, b: ElemType) -> Option<ElemType> {
    if widens(a, b) {
        return Some(b);
    }
    if widens(b, a) {
        return Some(a);
    }
    [Int, Dint, Lint, Real, Lreal].into_iter().find(|t| widens(a, *t) && widens(b, *t))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn widening_never_loses_a_value() {
        assert!(widens(Sint, Int) && widens(Usint, Int) && widens(Uint, Dint) && widens(Udint, Lint));
        assert!(!widens(Uint, Int) && !widens(Ulint, Lint) && !widens(Int, Uint) && !widens(Dint, Real));
        assert!(widens(Int, Real) && widens(Uint, Real) && widens(Dint, Lreal) && !widens(Lint, Lreal));
        assert!(widens(Bool, Byte) && widens(Byte, Lword) && !widens(Word, Byte) && !widens(Byte, Usint));
        assert!(widens(Real, Lreal) && !widens(Lreal, Real));
        assert!(!widens(Time, Lint) && !widens(Dint, Time));
    }

    #[test]
    fn common_types() {
        assert_eq!(common_type(Int, Uint), Some(Dint));
        assert_eq!(common_type(Dint, Real), Some(Lreal));
        assert_eq!(common_type(Sint, Usint), Some(Int));
        assert_eq!(common_type(Udint, Int), Some(Lint));
        assert_eq!(common_type(Ulint, Int), None);
        assert_eq!(common_type(Lint, Real), None);
        assert_eq!(common_type(Bool, Int), None);
    }
}
