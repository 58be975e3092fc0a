//! The PLC's image as this server sees it: the newest sample, and its own writes that the PLC has not taken yet.
//!
//! A write is answered when it is queued, one scan before the image shows it. Until then the server lays it over
//! the image, so that a client that reads back sees what it wrote. An overlay ends by the PLC's acknowledgement
//! (whatever its result), by a new generation of the PLC, or after `stale_after`. Sans-I/O: time and messages come in.

use crate::map::Memory;
use ipc_types::image_write::{self, Builder, MAX_BYTES};
use ipc_types::payload::{Image, PlcState, acks};
use ipc_types::wiring::{Area, AreaSizes};
use std::collections::VecDeque;

/// Most writes that may wait for their acknowledgement; as deep as the PLC's queue. Then exception 06.
pub const MAX_PENDING: usize = 256;

struct Pending {
    seq: u64,
    t_ns: u64,
    len: usize,
    tail: [u8; MAX_BYTES],
}

/// The three areas, one behind the other.
#[derive(Default)]
struct Areas {
    bytes: Vec<u8>,
    input: usize,
    output: usize,
}

impl Areas {
    fn memory(&self) -> Memory<'_> {
        let (input, rest) = self.bytes.split_at(self.input.min(self.bytes.len()));
        let (output, marker) = rest.split_at(self.output.min(rest.len()));
        Memory { input, output, marker, own_input: &[] }
    }

    fn area_mut(&mut self, area: Area) -> &mut [u8] {
        let len = self.bytes.len();
        let (input, rest) = self.bytes.split_at_mut(self.input.min(len));
        let len = rest.len();
        let (output, marker) = rest.split_at_mut(self.output.min(len));
        match area {
            Area::Input => input,
            Area::Output => output,
            Area::Marker => marker,
        }
    }

    fn copy(&mut self, from: &Areas) {
        self.bytes.clear();
        self.bytes.extend_from_slice(&from.bytes);
        (self.input, self.output) = (from.input, from.output);
    }

    fn apply(&mut self, tail: &[u8]) {
        let Ok(ops) = image_write::parse(tail) else { return };
        for op in ops {
            // What lies outside is refused by the PLC as well, and says so in its acknowledgement.
            let _ = op.apply(self.area_mut(op.area()));
        }
    }
}

/// What the header of the newest image said.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Newest {
    pub t_ns: u64,
    pub generation: u32,
    pub scan: u64,
    pub state: PlcState,
}

/// The newest image and the overlay.
pub struct View {
    writer: u32,
    generation: u32,
    stale_after_ns: u64,
    image: Areas,
    patched: Areas,
    pending: VecDeque<Pending>,
    newest: Option<Newest>,
    malformed: u64,
    refused: u64,
    last_ack: u64,
}

impl View {
    /// A view without an image. `writer` and `generation` are this service's on the rail.
    pub fn new(writer: u32, generation: u32, stale_after_ns: u64) -> Self {
        // Room for the largest areas: nothing is allocated when an image comes.
        let areas = || Areas { bytes: Vec::with_capacity(3 * 65536), ..Areas::default() };
        Self {
            writer,
            generation,
            stale_after_ns,
            image: areas(),
            patched: areas(),
            pending: VecDeque::with_capacity(MAX_PENDING),
            newest: None,
            malformed: 0,
            refused: 0,
            last_ack: 0,
        }
    }

    /// Takes a new image. Returns the sizes of its areas when they differ from the last one's.
    pub fn take(&mut self, header: &Image, tail: &[u8]) -> Option<AreaSizes> {
        if header.areas(tail).is_none() || tail.len() > 3 * 65536 {
            self.malformed += 1;
            return None;
        }
        let before = (self.image.input, self.image.output, self.image.bytes.len());
        self.image.bytes.clear();
        self.image.bytes.extend_from_slice(tail);
        (self.image.input, self.image.output) = (header.input_bytes as usize, header.output_bytes as usize);
        let generation = header.stamp.generation;
        if self.newest.is_some_and(|newest| newest.generation != generation) {
            self.pending.clear();
        }
        self.newest = Some(Newest {
            t_ns: header.stamp.t_ns,
            generation,
            scan: header.scan,
            state: header.plc_state(),
        });
        self.acknowledge(header);
        self.repatch();
        let after = (self.image.input, self.image.output, self.image.bytes.len());
        (before != after).then_some(AreaSizes {
            input: header.input_bytes,
            output: header.output_bytes,
            marker: header.marker_bytes,
        })
    }

    fn acknowledge(&mut self, header: &Image) {
        let mine = acks(header).find(|ack| ack.writer == self.writer && ack.generation == self.generation);
        let Some(ack) = mine else { return };
        if ack.result != 0 && ack.seq > self.last_ack {
            self.refused += 1;
        }
        self.last_ack = self.last_ack.max(ack.seq);
        while self.pending.front().is_some_and(|pending| pending.seq <= ack.seq) {
            self.pending.pop_front();
        }
    }

    fn repatch(&mut self) {
        if self.pending.is_empty() {
            return;
        }
        self.patched.copy(&self.image);
        for pending in &self.pending {
            self.patched.apply(&pending.tail[..pending.len]);
        }
    }

    /// Ends overlays older than `stale_after`.
    pub fn expire(&mut self, now_ns: u64) {
        let before = self.pending.len();
        while self.pending.front().is_some_and(|p| now_ns.saturating_sub(p.t_ns) >= self.stale_after_ns) {
            self.pending.pop_front();
        }
        if self.pending.len() != before {
            self.repatch();
        }
    }

    /// Lays a queued write over the image. Check [`View::is_full`] before queueing it.
    pub fn overlay(&mut self, seq: u64, now_ns: u64, write: &Builder) {
        let mut pending = Pending { seq, t_ns: now_ns, len: write.tail().len(), tail: [0; MAX_BYTES] };
        if let Some(slot) = pending.tail.get_mut(..pending.len) {
            slot.copy_from_slice(write.tail());
        }
        if self.pending.is_empty() {
            self.patched.copy(&self.image);
        }
        if self.pending.len() == MAX_PENDING {
            self.pending.pop_front();
        }
        self.patched.apply(write.tail());
        self.pending.push_back(pending);
    }

    /// Whether no further write may wait.
    pub fn is_full(&self) -> bool {
        self.pending.len() >= MAX_PENDING
    }

    /// The bytes to read from.
    pub fn memory(&self) -> Memory<'_> {
        if self.pending.is_empty() { self.image.memory() } else { self.patched.memory() }
    }

    /// The newest image's header; `None` before the first.
    pub fn newest(&self) -> Option<Newest> {
        self.newest
    }

    /// Whether the newest image is younger than `stale_after`.
    pub fn is_fresh(&self, now_ns: u64) -> bool {
        self.newest.is_some_and(|newest| now_ns.saturating_sub(newest.t_ns) < self.stale_after_ns)
    }

    /// Writes that wait for their acknowledgement.
    pub fn pending(&self) -> usize {
        self.pending.len()
    }

    /// Acknowledgements seen that refused a write (too old, outside the image).
    pub fn refused(&self) -> u64 {
        self.refused
    }

    /// Images dropped because header and tail disagreed.
    pub fn malformed(&self) -> u64 {
        self.malformed
    }
}

#[cfg(test)]
#[path = "view_tests.rs"]
mod tests;
