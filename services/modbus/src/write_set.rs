//! One write request as masked bytes of the process image.
//!
//! Every write is the same operation on each byte it touches: `byte = (byte AND and) OR or`. A register write
//! has `and = 0`, a coil keeps its neighbours by `and`, function 22 brings its own masks. So one request of any
//! kind is one list that is applied whole.

use ipc_types::image_write::{Builder, Op, WriteError};
use ipc_types::wiring::Area;

/// Most bytes one request touches: 123 registers, or 1968 coils from the middle of a byte (247 bytes).
pub const MAX_BYTES: usize = 248;
/// Most runs of bytes one request may touch: the operations of one message to the PLC.
pub const MAX_RUNS: usize = ipc_types::image_write::MAX_OPS;

#[derive(Clone, Copy)]
struct Run {
    area: Area,
    offset: u32,
    start: u16,
    len: u16,
    plain: bool,
}

/// A run of bytes that lie one behind the other in one area. Either all of them are replaced or all are masked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MaskedBytes<'a> {
    pub area: Area,
    /// Offset of the first byte in its area.
    pub offset: u32,
    /// One mask a byte.
    pub and: &'a [u8],
    /// One mask a byte, as long as `and`.
    pub or: &'a [u8],
}

impl MaskedBytes<'_> {
    /// Whether the old content plays no part.
    pub fn is_plain(&self) -> bool {
        self.and.iter().all(|&mask| mask == 0)
    }

    /// The run as an operation of a message to the PLC.
    pub fn op(&self) -> Op<'_> {
        let (area, offset) = (self.area, self.offset);
        if self.is_plain() {
            Op::Set { area, offset, bytes: self.or }
        } else {
            Op::Mask { area, offset, and: self.and, or: self.or }
        }
    }
}

/// The bytes one request changes. Fixed size, reused from request to request.
pub struct WriteSet {
    runs: [Run; MAX_RUNS],
    n_runs: usize,
    and: [u8; MAX_BYTES],
    or: [u8; MAX_BYTES],
    len: usize,
}

impl Default for WriteSet {
    fn default() -> Self {
        Self {
            runs: [Run { area: Area::Marker, offset: 0, start: 0, len: 0, plain: true }; MAX_RUNS],
            n_runs: 0,
            and: [0; MAX_BYTES],
            or: [0; MAX_BYTES],
            len: 0,
        }
    }
}

impl WriteSet {
    /// Empties it.
    pub fn clear(&mut self) {
        self.n_runs = 0;
        self.len = 0;
    }

    /// Whether nothing is written.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Adds one byte; `false` when the set is full ([`MAX_BYTES`], [`MAX_RUNS`]).
    #[must_use]
    pub fn push(&mut self, area: Area, offset: u32, and: u8, or: u8) -> bool {
        if self.len == MAX_BYTES {
            return false;
        }
        let continues = self.n_runs.checked_sub(1).and_then(|i| self.runs.get_mut(i)).filter(|run| {
            run.area == area && run.plain == (and == 0) && run.offset + u32::from(run.len) == offset
        });
        if let Some(run) = continues {
            run.len += 1;
        } else {
            let Some(slot) = self.runs.get_mut(self.n_runs) else { return false };
            *slot = Run { area, offset, start: self.len as u16, len: 1, plain: and == 0 };
            self.n_runs += 1;
        }
        self.and[self.len] = and;
        self.or[self.len] = or;
        self.len += 1;
        true
    }

    /// The set as one message to the PLC, replacing what `builder` held. Cannot fail for sets that a
    /// [`crate::map::RegisterMap`] planned: at most 2 masked bytes at each border of a range.
    pub fn build(&self, builder: &mut Builder) -> Result<(), WriteError> {
        builder.clear();
        self.runs().try_for_each(|run| builder.push(&run.op()))
    }

    /// The runs in the order they were added.
    pub fn runs(&self) -> impl Iterator<Item = MaskedBytes<'_>> {
        self.runs[..self.n_runs].iter().map(|run| {
            let range = usize::from(run.start)..usize::from(run.start + run.len);
            MaskedBytes {
                area: run.area,
                offset: run.offset,
                and: &self.and[range.clone()],
                or: &self.or[range],
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neighbours_join_and_the_limits_hold() {
        let mut set = WriteSet::default();
        assert!(
            set.push(Area::Marker, 4, 0, 1)
                && set.push(Area::Marker, 5, 0, 2)
                && set.push(Area::Output, 6, 0xF0, 3)
        );
        let runs: Vec<_> = set.runs().collect();
        assert_eq!(runs.len(), 2);
        assert_eq!((runs[0].offset, runs[0].or, runs[0].is_plain()), (4, &[1, 2][..], true));
        assert_eq!((runs[1].area, runs[1].is_plain()), (Area::Output, false));
        set.clear();
        assert!(set.is_empty() && set.runs().next().is_none());
        for i in 0..MAX_RUNS as u32 {
            assert!(set.push(Area::Marker, i * 2, 0, 0));
        }
        assert!(!set.push(Area::Marker, 1000, 0, 0), "one run too many");
        set.clear();
        for i in 0..MAX_BYTES as u32 {
            assert!(set.push(Area::Marker, i, 0, 0));
        }
        assert!(!set.push(Area::Marker, MAX_BYTES as u32, 0, 0), "one byte too many");
    }

    #[test]
    fn replaced_and_masked_bytes_are_runs_of_their_own() {
        let mut set = WriteSet::default();
        for (offset, and, or) in [(1, 0xF0, 0x05), (2, 0, 0xAA), (3, 0, 0xBB), (4, 0x7F, 0x80)] {
            assert!(set.push(Area::Marker, offset, and, or));
        }
        let ops: Vec<_> = set.runs().collect();
        assert_eq!(ops.len(), 3);
        assert!(matches!(ops[1].op(), Op::Set { offset: 2, bytes: &[0xAA, 0xBB], .. }));
        let mut bytes = [0xFF; 6];
        for run in set.runs() {
            assert!(run.op().apply(&mut bytes));
        }
        assert_eq!(bytes, [0xFF, 0xF5, 0xAA, 0xBB, 0xFF, 0xFF]);
    }

    #[test]
    fn the_largest_set_fits_one_message() {
        let mut set = WriteSet::default();
        let mut offset = 0;
        for run in 0..MAX_RUNS as u32 {
            // Half of them masked, the rest sharing the remaining bytes.
            let (n, and) = if run % 2 == 0 { (1, 0x0F) } else { (29, 0) };
            for _ in 0..n {
                assert!(set.push(Area::Marker, offset, and, 0));
                offset += 1;
            }
            offset += 1;
        }
        let mut builder = Builder::default();
        set.build(&mut builder).unwrap();
        assert_eq!(builder.ops() as usize, MAX_RUNS);
    }
}
