//! Cuts what stood between two silences into RTU frames.
//!
//! On a UART that is one frame. A USB adapter may deliver a request and its answer, or what a broken node sent and the
//! next frame, as one: then the CRC finds the frames at the places where they can begin and end.

use super::crc;
use super::length::{self, Length, MAX_RTU};

/// Places where a silence was seen inside of what was received, at most this many; later ones are not noted.
pub const MAX_MARKS: usize = 32;

/// A piece of what was received.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Piece {
    /// First byte.
    pub from: usize,
    /// Byte after the last.
    pub to: usize,
    /// Its CRC fits.
    pub good: bool,
}

/// Cuts `bytes` into pieces, in order and without holes. `marks` are offsets at which a silence was seen, rising.
pub fn cut(bytes: &[u8], marks: &[u16], mut piece: impl FnMut(Piece)) {
    let mut from = 0;
    let mut junk = 0;
    while from < bytes.len() {
        if let Some(to) = frame_at(bytes, marks, from).filter(|to| !is_stolen(bytes, marks, from, *to)) {
            if junk < from {
                piece(Piece { from: junk, to: from, good: false });
            }
            piece(Piece { from, to, good: true });
            (from, junk) = (to, to);
        } else {
            let next = marks.iter().map(|m| usize::from(*m)).find(|m| *m > from && *m < bytes.len());
            from = next.unwrap_or(bytes.len());
        }
    }
    if junk < bytes.len() {
        piece(Piece { from: junk, to: bytes.len(), good: false });
    }
}

/// Whether a frame that reaches over a silence takes bytes of a good frame that begins behind that silence: the one
/// before broke off, and its missing CRC bytes happen to be the first ones of the next.
fn is_stolen(bytes: &[u8], marks: &[u16], from: usize, to: usize) -> bool {
    let mut inside = marks.iter().map(|m| usize::from(*m)).filter(|m| *m > from && *m < to);
    inside.any(|mark| frame_at(bytes, marks, mark).is_some())
}

/// Where the good frame that begins at `from` ends: at the end of all, at the length its function has, or at a silence.
fn frame_at(bytes: &[u8], marks: &[u16], from: usize) -> Option<usize> {
    let rest = &bytes[from..];
    let good = |n: usize| n <= rest.len() && n <= MAX_RTU && crc::fits(&rest[..n]);
    if good(rest.len()) {
        return Some(bytes.len());
    }
    for length in [length::request(rest), length::response(rest)] {
        if let Length::Bytes(n) = length
            && good(n)
        {
            return Some(from + n);
        }
    }
    marks.iter().map(|m| usize::from(*m)).find(|m| *m > from && *m < bytes.len() && good(m - from))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn frame(bytes: &[u8]) -> Vec<u8> {
        let mut frame = bytes.to_vec();
        frame.extend(crc::crc16(bytes).to_le_bytes());
        frame
    }

    fn pieces(bytes: &[u8], marks: &[u16]) -> Vec<(usize, usize, bool)> {
        let mut all = Vec::new();
        cut(bytes, marks, |p| all.push((p.from, p.to, p.good)));
        all
    }

    #[test]
    fn frames_that_came_as_one() {
        let request = frame(&[1, 3, 0, 0, 0, 2]);
        let answer = frame(&[1, 3, 4, 0, 1, 0, 2]);
        assert_eq!(pieces(&request, &[]), [(0, 8, true)]);
        let both = [request.clone(), answer.clone()].concat();
        assert_eq!(pieces(&both, &[]), [(0, 8, true), (8, 17, true)]);
        // A frame that broke off, a silence, a good frame.
        let torn = [&request[..5], &answer[..]].concat();
        assert_eq!(pieces(&torn, &[5]), [(0, 5, false), (5, 14, true)]);
        assert_eq!(pieces(&torn, &[]), [(0, 14, false)]);
        // One that broke off before a byte that the next one happens to begin with.
        let other = frame(&[0x30, 6, 0, 0x50, 0xC3, 0x1B]);
        let next = frame(&[1, 0x16, 0, 0x61, 0xB5, 0xA7, 0x1D, 0xB9]);
        let stolen = [&other[..7], &next[..]].concat();
        assert_eq!((other[7], next[0]), (1, 1));
        assert_eq!(pieces(&stolen, &[7]), [(0, 7, false), (7, 17, true)]);
        // The other way round: in parts, and what stands behind a silence is no frame of its own.
        assert_eq!(pieces(&stolen[..8], &[3, 7]), [(0, 8, true)]);
        // An unknown function between silences.
        let own = frame(&[9, 100, 1, 2, 3]);
        let all = [&own[..], &request[..], &[0xFF]].concat();
        assert_eq!(pieces(&all, &[7]), [(0, 7, true), (7, 15, true), (15, 16, false)]);
    }

    proptest! {
        #[test]
        fn nothing_is_lost(bytes in proptest::collection::vec(any::<u8>(), 0..600),
                           mut marks in proptest::collection::vec(0u16..700, 0..MAX_MARKS)) {
            marks.sort_unstable();
            let mut at = 0;
            cut(&bytes, &marks, |p| {
                assert!(p.from == at && p.to > p.from);
                at = p.to;
            });
            prop_assert_eq!(at, bytes.len());
        }
    }
}
