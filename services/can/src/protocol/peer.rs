//! What an adapter or a remote bus looks like to the driver: bytes and time in, bytes and news out.

use super::Frame;
use super::error_frame::ControllerState;

/// News from the other side.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Heard {
    /// It carries frames from now on.
    Up,
    /// A frame of the bus and when it was there, CLOCK_MONOTONIC in ns.
    Frame(Frame, u64),
    /// The oldest frame given to it is on the bus (or as near to it as this protocol tells).
    Sent,
    /// The oldest frame given to it was refused.
    Refused,
    /// State of its controller, with words.
    State(ControllerState, String),
    /// It carries nothing for now: it is being restarted.
    Restarting(String),
    /// Something worth a line.
    Note(String),
    /// It is of no use: end the connection and try again later.
    Fault(String),
}

/// The protocol of an adapter or a remote bus. `out` gets the bytes to write.
pub trait Peer {
    /// The connection stands.
    fn connected(&mut self, now_ns: u64, out: &mut Vec<u8>);
    /// Bytes came.
    fn receive(&mut self, bytes: &[u8], now_ns: u64, out: &mut Vec<u8>, heard: &mut dyn FnMut(Heard));
    /// Time has passed; call at [`Self::deadline_ns`] or later.
    fn tick(&mut self, now_ns: u64, out: &mut Vec<u8>, heard: &mut dyn FnMut(Heard));
    /// When it wants [`Self::tick`].
    fn deadline_ns(&self) -> Option<u64>;
    /// Whether it can carry the frame at all.
    fn fits(&self, frame: &Frame) -> bool;
    /// Gives it a frame; only between [`Heard::Up`] and [`Heard::Restarting`].
    fn send(&mut self, frame: &Frame, now_ns: u64, out: &mut Vec<u8>, heard: &mut dyn FnMut(Heard));
    /// Most frames to give it before the first is confirmed.
    fn flight(&self) -> usize;
    /// What is said before the connection is ended by us.
    fn farewell(&self) -> &'static [u8];
}
