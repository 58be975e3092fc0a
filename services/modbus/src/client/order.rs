//! Order of bytes and registers: registers as they come off the wire, to little-endian values of the image, and back.
//!
//! Modbus sends each register high byte first (V1.1b3 clause 4.2) and says nothing about values of several registers;
//! devices differ, so every range names its order. The letters are the bytes of the value, A the most significant, in
//! the order of the wire: `CDAB` is a 32-bit value whose low word comes first. For 64 bits the same rule goes on:
//! `ABCD` is high word first, `CDAB` low word first, `BADC` and `DCBA` the same with the bytes of each register
//! exchanged.

use serde::{Deserialize, Serialize};

/// See the module.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Serialize, Deserialize)]
pub enum Order {
    /// 16 bits, high byte first.
    AB,
    /// 16 bits, low byte first.
    BA,
    /// High word first, high byte first. The default.
    #[default]
    ABCD,
    /// All bytes reversed.
    DCBA,
    /// High word first, the bytes of each register exchanged.
    BADC,
    /// Low word first, high byte first.
    CDAB,
}

impl Order {
    /// For the command line.
    pub const NAMES: [&'static str; 6] = ["AB", "BA", "ABCD", "DCBA", "BADC", "CDAB"];

    /// From its letters, any case.
    pub fn from_name(name: &str) -> Option<Self> {
        Some(match name.to_ascii_uppercase().as_str() {
            "AB" => Self::AB,
            "BA" => Self::BA,
            "ABCD" => Self::ABCD,
            "DCBA" => Self::DCBA,
            "BADC" => Self::BADC,
            "CDAB" => Self::CDAB,
            _ => return None,
        })
    }

    /// Its letters.
    pub fn name(self) -> &'static str {
        Self::NAMES[self as usize]
    }

    /// Whether it is one for values of this many registers: two letters for one register, four for two and more.
    /// The default is one for all.
    pub fn is_for(self, registers: usize) -> bool {
        match self {
            Self::AB | Self::BA => registers == 1,
            Self::ABCD => true,
            Self::DCBA | Self::BADC | Self::CDAB => registers > 1,
        }
    }

    fn low_word_first(self) -> bool {
        matches!(self, Self::CDAB | Self::DCBA)
    }

    fn exchanged(self) -> bool {
        matches!(self, Self::BA | Self::BADC | Self::DCBA)
    }

    /// Exchanges wire and memory order of values of `registers` (1, 2 or 4) registers, in place; its own inverse.
    /// Bytes behind the last whole value stay as they are.
    pub fn turn(self, registers: usize, bytes: &mut [u8]) {
        let size = registers.max(1) * 2;
        for value in bytes.chunks_exact_mut(size) {
            // From the wire's order to most significant byte last.
            if !self.low_word_first() {
                for i in 0..registers / 2 {
                    let j = registers - 1 - i;
                    value.swap(2 * i, 2 * j);
                    value.swap(2 * i + 1, 2 * j + 1);
                }
            }
            if !self.exchanged() {
                for register in value.chunks_exact_mut(2) {
                    register.swap(0, 1);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn every_order_of_a_known_value() {
        for (order, wire) in [
            (Order::ABCD, [0x11, 0x22, 0x33, 0x44]),
            (Order::CDAB, [0x33, 0x44, 0x11, 0x22]),
            (Order::BADC, [0x22, 0x11, 0x44, 0x33]),
            (Order::DCBA, [0x44, 0x33, 0x22, 0x11]),
        ] {
            let mut bytes = wire;
            order.turn(2, &mut bytes);
            assert_eq!(u32::from_le_bytes(bytes), 0x1122_3344, "{order:?}");
            order.turn(2, &mut bytes);
            assert_eq!(bytes, wire);
        }
        for (order, wire) in
            [(Order::AB, [0x11, 0x22]), (Order::ABCD, [0x11, 0x22]), (Order::BA, [0x22, 0x11])]
        {
            let mut bytes = wire;
            order.turn(1, &mut bytes);
            assert_eq!(u16::from_le_bytes(bytes), 0x1122, "{order:?}");
        }
        for (order, wire) in [
            (Order::ABCD, [1, 2, 3, 4, 5, 6, 7, 8]),
            (Order::CDAB, [7, 8, 5, 6, 3, 4, 1, 2]),
            (Order::BADC, [2, 1, 4, 3, 6, 5, 8, 7]),
            (Order::DCBA, [8, 7, 6, 5, 4, 3, 2, 1]),
        ] {
            let mut bytes = wire;
            order.turn(4, &mut bytes);
            assert_eq!(u64::from_le_bytes(bytes), 0x0102_0304_0506_0708, "{order:?}");
        }
    }

    proptest! {
        #[test]
        fn its_own_inverse(i in 0usize..6, registers in prop::sample::select(&[1usize, 2, 4]), bytes in prop::collection::vec(any::<u8>(), 0..40)) {
            let order = Order::from_name(Order::NAMES[i]).unwrap();
            prop_assert_eq!(order.name(), Order::NAMES[i]);
            let mut turned = bytes.clone();
            order.turn(registers, &mut turned);
            order.turn(registers, &mut turned);
            prop_assert_eq!(turned, bytes);
        }
    }
}
