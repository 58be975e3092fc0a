//! How long characters and silences last.

/// The rate up to which silences follow the rate; above it they are fixed (serial line guide V1.02, 2.5.1.1).
pub const FIXED_ABOVE: u32 = 19_200;
/// 1.5 characters above [`FIXED_ABOVE`], ns.
pub const T15_FIXED_NS: u64 = 750_000;
/// 3.5 characters above [`FIXED_ABOVE`], ns.
pub const T35_FIXED_NS: u64 = 1_750_000;

/// Times of a line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Timing {
    /// One character, start and stop bits included, in ns, rounded up.
    pub char_ns: u64,
    /// A gap above this inside an RTU frame is a fault of its sender, ns.
    pub t15_ns: u64,
    /// Silence that ends an RTU frame, ns.
    pub t35_ns: u64,
}

impl Timing {
    /// `bits` of a character with start, parity and stop bits, 7-12. A `baud` of 0 counts as 1.
    pub fn new(baud: u32, bits: u32) -> Self {
        let baud = u64::from(baud.max(1));
        let char_ns = (u64::from(bits) * 1_000_000_000).div_ceil(baud);
        if baud > u64::from(FIXED_ABOVE) {
            Self { char_ns, t15_ns: T15_FIXED_NS, t35_ns: T35_FIXED_NS }
        } else {
            Self { char_ns, t15_ns: char_ns * 3 / 2, t35_ns: char_ns * 7 / 2 }
        }
    }

    /// Time of `n` characters on the line, ns.
    pub fn of(&self, n: usize) -> u64 {
        self.char_ns.saturating_mul(n as u64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_guide_s_values() {
        let at = |baud| {
            let t = Timing::new(baud, 11);
            (t.char_ns / 1000, t.t15_ns / 1000, t.t35_ns / 1000)
        };
        assert_eq!(at(9600), (1145, 1718, 4010));
        assert_eq!(at(19_200), (572, 859, 2005));
        assert_eq!(at(38_400), (286, 750, 1750));
        assert_eq!(at(115_200), (95, 750, 1750));
        assert_eq!(Timing::new(1200, 11).t35_ns / 1_000_000, 32);
        assert!(Timing::new(0, 12).char_ns > 0);
    }
}
