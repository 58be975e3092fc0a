//! What a client is told, and what it tells: settings, choices for a transfer, its end.

use super::frame::MAX_BLOCK;
use crate::protocol::abort::Abort;
use std::fmt;

/// How a client behaves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ClientConfig {
    /// Silence of the server in ns after which the transfer is aborted with 0504 0000h.
    pub timeout_ns: u64,
    /// Segments of a sub-block that the client takes in a block upload, 1-127.
    pub block_size: u8,
    /// Time of one frame on the bus in ns; added to the timeout for each segment of a sub-block. 0: unknown.
    pub frame_ns: u64,
    /// Longest value that is transferred, in bytes.
    pub max_value: usize,
    /// [`Mode::Auto`] writes values of at least this many bytes by block transfer.
    pub auto_block: usize,
}

impl Default for ClientConfig {
    fn default() -> Self {
        Self {
            timeout_ns: 500_000_000,
            block_size: MAX_BLOCK,
            frame_ns: 0,
            max_value: 1 << 20,
            auto_block: 128,
        }
    }
}

/// Which protocol a transfer uses.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum Mode {
    /// Write: up to 4 bytes expedited, long values by block, the others segmented. Read: as the server likes.
    #[default]
    Auto,
    /// Never block transfer; up to 4 bytes expedited.
    Segmented,
    /// Block transfer; segmented if the server has none.
    Block,
    /// Block transfer or nothing.
    BlockOnly,
}

/// Choices for one transfer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Options {
    pub mode: Mode,
    /// Block transfer with CRC, if the server has it.
    pub crc: bool,
    /// Protocol switch threshold of a block read (CiA 301 V4.2, 7.2.4.3.12): the server may answer values of up
    /// to so many bytes without block transfer. 0: never.
    pub threshold: u8,
}

impl Default for Options {
    fn default() -> Self {
        Self { mode: Mode::Auto, crc: true, threshold: 0 }
    }
}

/// Why a transfer could not be started.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Busy {
    #[error("a transfer is going on: wait until it has ended, or cancel it")]
    Busy,
    #[error("the value has {len} bytes, the limit is {max}: raise max_value")]
    TooLong { len: usize, max: usize },
}

/// Direction of a transfer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Direction {
    Read,
    Write,
}

/// Who ended a transfer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum By {
    Client,
    Server,
}

/// A transfer that was aborted. A timeout is [`Abort::TIMEOUT`] by the client.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Failure {
    pub abort: Abort,
    pub by: By,
}

impl Failure {
    /// The server did not answer.
    pub fn is_timeout(&self) -> bool {
        *self == Self { abort: Abort::TIMEOUT, by: By::Client }
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.by {
            By::Client if self.is_timeout() => f.write_str("the node did not answer in time"),
            By::Client => write!(f, "ended here with {}", self.abort),
            By::Server => write!(f, "the node answered {}", self.abort),
        }
    }
}

impl std::error::Error for Failure {}

/// A transfer has ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Finished {
    pub index: u16,
    pub sub: u8,
    pub direction: Direction,
    /// Bytes that were transferred. Of a read, they are [`SdoClient::data`].
    pub result: Result<usize, Failure>,
}

/// What a client has seen.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ClientCounters {
    /// Answers that belong to no transfer of now: of one that was given up, or repeated by the bus.
    pub stale: u64,
    /// Frames that are no SDO frames: not 8 bytes long.
    pub ignored: u64,
    /// Transfers that fell back from block to segmented.
    pub fallbacks: u64,
}
