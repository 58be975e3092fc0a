//! RETAIN memory that outlives the process, and its copy on disk.
//!
//! The launcher holds a memfd for the service's whole life. It has two slots; a commit writes the older one, data
//! first, then a header with the next number and a checksum over both. So whatever the moment of the engine's
//! death, the newest slot with a right checksum is a state that some finished scan left. A helper thread copies
//! the newest slot to disk (write, fsync, rename) within a second of a change, off the scan's path.

mod file;
mod shm;

pub use file::{CopyNews, DiskCopy, read_file};
pub use shm::Mapping;

use xxhash_rust::xxh3::Xxh3;

/// Most bytes of RETAIN variables.
pub const MAX_RETAIN_BYTES: usize = 65_536;
/// Bytes of a slot's header.
pub const HEADER_BYTES: usize = 64;
/// Bytes of a slot.
pub const SLOT_BYTES: usize = HEADER_BYTES + MAX_RETAIN_BYTES;
/// Bytes of the memory that the launcher must hold.
pub const MEMORY_BYTES: usize = 2 * SLOT_BYTES;
/// First bytes of every slot.
const MAGIC: [u8; 8] = *b"dinrail1";

/// What a slot says.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Kept {
    /// Number of the commit, from 1.
    pub seq: u64,
    /// `Engine::retain_layout` of the program.
    pub layout: u64,
    /// PLC time of the last finished scan.
    pub plc_time_ns: i64,
    pub bytes: Vec<u8>,
}

fn checksum(header: &[u8], data: &[u8]) -> u64 {
    let mut hash = Xxh3::new();
    hash.update(header);
    hash.update(data);
    hash.digest()
}

/// Encodes a header: magic, seq, layout, plc time, length, checksum.
fn header(seq: u64, layout: u64, plc_time_ns: i64, data: &[u8]) -> [u8; HEADER_BYTES] {
    let mut out = [0u8; HEADER_BYTES];
    out[..8].copy_from_slice(&MAGIC);
    out[8..16].copy_from_slice(&seq.to_le_bytes());
    out[16..24].copy_from_slice(&layout.to_le_bytes());
    out[24..32].copy_from_slice(&plc_time_ns.to_le_bytes());
    out[32..40].copy_from_slice(&(data.len() as u64).to_le_bytes());
    let sum = checksum(&out[..40], data);
    out[40..48].copy_from_slice(&sum.to_le_bytes());
    out
}

fn u64_at(bytes: &[u8], at: usize) -> Option<u64> {
    Some(u64::from_le_bytes(bytes.get(at..at + 8)?.try_into().ok()?))
}

/// Reads a slot; `None` when it was never written or not written to its end.
pub fn decode_slot(slot: &[u8]) -> Option<Kept> {
    if slot.get(..8)? != MAGIC {
        return None;
    }
    let len = usize::try_from(u64_at(slot, 32)?).ok().filter(|len| *len <= MAX_RETAIN_BYTES)?;
    let data = slot.get(HEADER_BYTES..HEADER_BYTES + len)?;
    if checksum(&slot[..40], data) != u64_at(slot, 40)? {
        return None;
    }
    Some(Kept {
        seq: u64_at(slot, 8)?,
        layout: u64_at(slot, 16)?,
        plc_time_ns: u64_at(slot, 24)? as i64,
        bytes: data.to_vec(),
    })
}

/// The newest valid slot of a memory.
pub fn newest(memory: &[u8]) -> Option<Kept> {
    memory.chunks(SLOT_BYTES).filter_map(decode_slot).max_by_key(|kept| kept.seq)
}

/// Writes into the two slots in turn.
#[derive(Debug)]
pub struct Committer {
    seq: u64,
    /// Slot of the next commit.
    slot: usize,
}

impl Committer {
    /// For a memory as it is found.
    pub fn new(memory: &[u8]) -> Self {
        let seq_of = |slot: usize| {
            memory.get(slot * SLOT_BYTES..(slot + 1) * SLOT_BYTES).and_then(decode_slot).map(|kept| kept.seq)
        };
        let (first, second) = (seq_of(0), seq_of(1));
        Self { seq: first.max(second).unwrap_or(0), slot: usize::from(first > second) }
    }

    /// Writes one state. Longer data than [`MAX_RETAIN_BYTES`] and a memory that is too small are ignored.
    pub fn commit(&mut self, memory: &mut [u8], layout: u64, plc_time_ns: i64, data: &[u8]) {
        let start = self.slot * SLOT_BYTES;
        let Some(slot) = memory.get_mut(start..start + SLOT_BYTES) else { return };
        if data.len() > MAX_RETAIN_BYTES {
            return;
        }
        slot[HEADER_BYTES..HEADER_BYTES + data.len()].copy_from_slice(data);
        // The header must not become visible before the data: death comes between any two instructions.
        std::sync::atomic::fence(std::sync::atomic::Ordering::SeqCst);
        self.seq += 1;
        slot[..HEADER_BYTES].copy_from_slice(&header(self.seq, layout, plc_time_ns, data));
        std::sync::atomic::fence(std::sync::atomic::Ordering::SeqCst);
        self.slot = 1 - self.slot;
    }
}

#[cfg(test)]
mod tests;
