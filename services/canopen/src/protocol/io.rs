//! What every protocol machine is handed and hands back: frames with their time in, frames and events out.
//!
//! A machine never sends: it puts frames into the [`Outbox`] of its caller, who passes them on in this order.
//! The outbox never allocates after it was made.

use ipc_types::payload::CanFrame;

/// Frames that one call may produce. A full outbox drops the newest frame and counts it; callers drain after
/// every call, so that only a fault of the program can fill it.
pub const OUTBOX_FRAMES: usize = 512;

/// Frames to send, in order.
#[derive(Debug, Clone)]
pub struct Outbox {
    frames: Vec<CanFrame>,
    /// Frames that found the outbox full.
    pub dropped: u64,
}

impl Default for Outbox {
    fn default() -> Self {
        Self { frames: Vec::with_capacity(OUTBOX_FRAMES), dropped: 0 }
    }
}

impl Outbox {
    /// Adds a frame behind the others.
    pub fn push(&mut self, frame: CanFrame) {
        if self.frames.len() < OUTBOX_FRAMES {
            self.frames.push(frame);
        } else {
            self.dropped += 1;
        }
    }
    /// Takes everything.
    pub fn drain(&mut self) -> impl Iterator<Item = CanFrame> + '_ {
        self.frames.drain(..)
    }
    /// Takes the first `n` frames, or as many as there are.
    pub fn drain_first(&mut self, n: usize) -> impl Iterator<Item = CanFrame> + '_ {
        self.frames.drain(..n.min(self.frames.len()))
    }
    /// Takes frames out again that shall not be sent after all.
    pub fn retain(&mut self, keep: impl FnMut(&CanFrame) -> bool) {
        self.frames.retain(keep);
    }
    pub fn is_empty(&self) -> bool {
        self.frames.is_empty()
    }
    /// The next frame would be dropped: who can send it later had better do so.
    pub fn is_full(&self) -> bool {
        self.frames.len() >= OUTBOX_FRAMES
    }
    pub fn len(&self) -> usize {
        self.frames.len()
    }
    /// The frames that wait.
    pub fn frames(&self) -> &[CanFrame] {
        &self.frames
    }
}
