//! CRC-16 of Modbus RTU frames.
//!
//! Polynomial 8005h reflected (A001h), start value FFFFh, no final inversion; the low byte goes first on the line
//! (Modbus over serial line V1.02, 6.2.2).

const TABLE: [u16; 256] = table();

const fn table() -> [u16; 256] {
    let mut table = [0u16; 256];
    let mut i = 0;
    while i < 256 {
        let mut crc = i as u16;
        let mut bit = 0;
        while bit < 8 {
            crc = if crc & 1 == 1 { (crc >> 1) ^ 0xA001 } else { crc >> 1 };
            bit += 1;
        }
        table[i] = crc;
        i += 1;
    }
    table
}

/// Start value of a running CRC; see [`add`].
pub const START: u16 = 0xFFFF;

/// One more byte on a running CRC. Over a whole frame, its own CRC included, the result is 0.
#[inline]
pub const fn add(crc: u16, byte: u8) -> u16 {
    (crc >> 8) ^ TABLE[((crc ^ byte as u16) & 0xFF) as usize]
}

/// CRC of `bytes`; append it as `crc.to_le_bytes()`.
pub fn crc16(bytes: &[u8]) -> u16 {
    bytes.iter().fold(START, |crc, byte| add(crc, *byte))
}

/// Whether `frame` ends with its own CRC. Frames below 4 bytes (unit, function, CRC) never do.
pub fn fits(frame: &[u8]) -> bool {
    frame.len() >= 4 && crc16(frame) == 0
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The definition, bit by bit.
    fn slow(bytes: &[u8]) -> u16 {
        let mut crc = 0xFFFFu16;
        for byte in bytes {
            crc ^= u16::from(*byte);
            for _ in 0..8 {
                crc = if crc & 1 == 1 { (crc >> 1) ^ 0xA001 } else { crc >> 1 };
            }
        }
        crc
    }

    #[test]
    fn known_frames() {
        // The check value of CRC-16/MODBUS, and the example of V1.02, appendix B (02 07 -> 41 12).
        assert_eq!(crc16(b"123456789"), 0x4B37);
        assert_eq!(crc16(&[0x02, 0x07]).to_le_bytes(), [0x41, 0x12]);
        assert_eq!(crc16(&[]), 0xFFFF);
        assert!(fits(&[0x01, 0x03, 0x00, 0x00, 0x00, 0x0A, 0xC5, 0xCD]));
        assert!(!fits(&[0x01, 0x03, 0x00, 0x00, 0x00, 0x0A, 0xCD, 0xC5]));
        assert!(!fits(&[0xFF, 0xFF]));
    }

    proptest! {
        #[test]
        fn the_table_is_the_definition(bytes in proptest::collection::vec(any::<u8>(), 0..300)) {
            let crc = crc16(&bytes);
            prop_assert_eq!(crc, slow(&bytes));
            let mut frame = bytes;
            frame.extend(crc.to_le_bytes());
            prop_assert_eq!(crc16(&frame), 0);
        }
    }
}
