//! What the boot-up of a node is given, what it asks for, and what it is told.

use super::Letter;

/// What a node must be.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Identity {
    pub device_type: Option<u32>,
    pub vendor: Option<u32>,
    pub product: Option<u32>,
    pub revision: Option<u32>,
    pub serial: Option<u32>,
}

/// How a node is watched.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum ErrorControl {
    #[default]
    None,
    /// Its heartbeat must come within this time.
    Heartbeat { consumer_ns: u64 },
    /// It is asked by remote frames.
    Guarding { guard_ns: u64, factor: u8 },
}

/// An object to write.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Write {
    pub index: u16,
    pub sub: u8,
    pub data: Vec<u8>,
}

/// How one node is booted.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Plan {
    pub id: u8,
    pub identity: Identity,
    pub keep_alive: bool,
    /// Sub-index of 1011h.
    pub restore: Option<u8>,
    /// Date and time of the configuration (1F26h, 1F27h).
    pub config_stamp: Option<(u32, u32)>,
    pub writes: Vec<Write>,
    pub error_control: ErrorControl,
    /// Tries of one SDO transfer.
    pub sdo_tries: u8,
}

/// Why a configuration was loaded, by its date and time (1020h).
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
pub struct Loaded {
    /// Those that the node had; `None`: it did not tell them. 0 and 0: it has no configuration.
    pub had: Option<(u32, u32)>,
    pub expected: (u32, u32),
}

/// How an SDO transfer ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum SdoEnd {
    Read(Vec<u8>),
    Written,
    Abort(u32),
    Timeout,
}

/// What the machine asks for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Action {
    Read {
        index: u16,
        sub: u8,
    },
    /// Of [`Plan::writes`], or one of the machine's own.
    Write(Write),
    /// NMT: reset communication (CiA 301 clause 7.2.8.3.1.2).
    ResetCommunication,
    /// Watch the node from now on; answered by [`super::Boot::on_alive`] or by time.
    StartErrorControl,
    /// The node is ready to be started; `kept` when it has been running all the time.
    Done {
        kept: bool,
    },
    /// It failed; the machine tries again by itself.
    Failed(Failure),
}

/// A try that failed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
pub struct Failure {
    pub letter: Letter,
    /// From 1.
    pub attempt: u32,
    /// What was expected, for identity letters.
    pub expected: Option<u32>,
    /// What the node has.
    pub got: Option<u32>,
    /// Object that could not be written.
    pub object: Option<(u16, u8)>,
    /// Abort code of the node.
    pub abort: Option<u32>,
    /// When, since the try began.
    pub after_ns: u64,
}
