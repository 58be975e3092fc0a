//! Hex and decimal digits to and from byte buffers, without allocation.

/// Value of one hex digit, either case.
pub(super) fn nibble(c: u8) -> Option<u8> {
    match c {
        b'0'..=b'9' => Some(c - b'0'),
        b'a'..=b'f' => Some(c - b'a' + 10),
        b'A'..=b'F' => Some(c - b'A' + 10),
        _ => None,
    }
}

/// A hex number of 1-8 digits.
pub(super) fn number(text: &[u8]) -> Option<u32> {
    if text.is_empty() || text.len() > 8 {
        return None;
    }
    text.iter().try_fold(0u32, |n, &c| Some((n << 4) | u32::from(nibble(c)?)))
}

/// A decimal number of 1-19 digits.
pub(super) fn decimal(text: &[u8]) -> Option<u64> {
    if text.is_empty() || text.len() > 19 {
        return None;
    }
    text.iter().try_fold(0u64, |n, &c| {
        if c.is_ascii_digit() { n.checked_mul(10)?.checked_add(u64::from(c - b'0')) } else { None }
    })
}

/// Pairs of hex digits to bytes; `out` is filled from its start. Returns the number of bytes.
pub(super) fn bytes(text: &[u8], out: &mut [u8]) -> Option<usize> {
    if !text.len().is_multiple_of(2) || text.len() / 2 > out.len() {
        return None;
    }
    for (pair, byte) in text.chunks_exact(2).zip(out.iter_mut()) {
        *byte = (nibble(pair[0])? << 4) | nibble(pair[1])?;
    }
    Some(text.len() / 2)
}

/// Writes text into a fixed buffer; what does not fit is cut (callers size their buffers by the longest text).
pub(super) struct Writer<'a> {
    out: &'a mut [u8],
    len: usize,
}

const UPPER: &[u8; 16] = b"0123456789ABCDEF";

impl<'a> Writer<'a> {
    pub(super) fn new(out: &'a mut [u8]) -> Self {
        Self { out, len: 0 }
    }

    pub(super) fn len(&self) -> usize {
        self.len
    }

    pub(super) fn byte(&mut self, c: u8) {
        if let Some(slot) = self.out.get_mut(self.len) {
            *slot = c;
            self.len += 1;
        }
    }

    pub(super) fn text(&mut self, text: &[u8]) {
        for &c in text {
            self.byte(c);
        }
    }

    /// `value` as exactly `digits` upper-case hex digits.
    pub(super) fn hex(&mut self, value: u32, digits: u32) {
        for i in (0..digits).rev() {
            self.byte(UPPER[((value >> (4 * i)) & 0xF) as usize]);
        }
    }

    pub(super) fn hex_bytes(&mut self, bytes: &[u8]) {
        for &b in bytes {
            self.byte(UPPER[(b >> 4) as usize]);
            self.byte(UPPER[(b & 0xF) as usize]);
        }
    }

    /// `value` in decimal with at least `width` digits.
    pub(super) fn decimal(&mut self, value: u64, width: usize) {
        let mut digits = [b'0'; 20];
        let mut rest = value;
        let mut start = 20;
        while rest > 0 {
            start -= 1;
            digits[start] = b'0' + (rest % 10) as u8;
            rest /= 10;
        }
        let from = start.min(20 - width.clamp(1, 20));
        for &digit in &digits[from..] {
            self.byte(digit);
        }
    }

    /// Seconds with six decimals, the stamp of candump and socketcand.
    pub(super) fn seconds(&mut self, t_ns: u64, width: usize) {
        self.decimal(t_ns / 1_000_000_000, width);
        self.byte(b'.');
        self.decimal(t_ns % 1_000_000_000 / 1000, 6);
    }
}
