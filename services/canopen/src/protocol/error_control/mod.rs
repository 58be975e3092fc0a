//! Error control: heartbeat, node guarding and life guarding (CiA 301 V4.2, 7.2.8.3.2), error behaviour (1029h).

pub mod guarding;
pub mod heartbeat;

use super::nmt::NmtState;

/// Nanoseconds of a millisecond.
pub const MS: u64 = 1_000_000;

/// Values of 1029h sub 1-254 (CiA 301 V4.2, 7.5.2.32, table 70).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ErrorBehaviour {
    /// 0, and the behaviour without the object: operational becomes pre-operational.
    #[default]
    PreOperational,
    /// 1: no change of the NMT state.
    NoChange,
    /// 2: stopped.
    Stopped,
}

impl ErrorBehaviour {
    /// None: reserved or manufacturer specific; such a write is refused.
    pub fn from_object(value: u8) -> Option<Self> {
        Some(match value {
            0 => Self::PreOperational,
            1 => Self::NoChange,
            2 => Self::Stopped,
            _ => return None,
        })
    }
    /// The state that a node in `state` enters on an error, if it changes.
    pub fn target(self, state: NmtState) -> Option<NmtState> {
        match self {
            Self::PreOperational => (state == NmtState::Operational).then_some(NmtState::PreOperational),
            Self::NoChange => None,
            Self::Stopped => state.communicates().then_some(NmtState::Stopped),
        }
    }
}
