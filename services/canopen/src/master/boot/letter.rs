//! Why a boot-up did not end well.

use std::fmt;

/// Result of a boot-up that did not end well, by the letters of CiA 302-2.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, serde::Serialize)]
pub enum Letter {
    /// The node is not in the list of slaves.
    A,
    /// No answer to 1000h.
    B,
    /// Device type differs.
    C,
    /// Vendor differs.
    D,
    /// The heartbeat never came.
    E,
    /// Node guarding was never answered.
    F,
    /// Software objects missing.
    G,
    /// Software update not allowed.
    H,
    /// Software download failed.
    I,
    /// Configuration failed.
    J,
    /// Heartbeat lost while error control started.
    K,
    /// The node was operational already and was left alone. Not a failure.
    L,
    /// Product code differs.
    M,
    /// Revision differs.
    N,
    /// Serial number differs.
    O,
}

impl Letter {
    /// What it means, as a user is told.
    pub fn text(self) -> &'static str {
        match self {
            Self::A => "the node is not in the list of nodes",
            Self::B => {
                "it does not answer to its device type (1000h): is it powered, is the node-id and the bit rate right?"
            }
            Self::C => {
                "its device type (1000h) is another than expected: a different device has this node-id"
            }
            Self::D => "its vendor (1018h:01) is another than expected: a different device has this node-id",
            Self::E => "its heartbeat never came, though 1017h was set",
            Self::F => "it never answered node guarding: the device or the bus carries no remote frames",
            Self::G => "it has no objects for its software version",
            Self::H => "its software differs and an update is not allowed",
            Self::I => "the download of its software failed",
            Self::J => "its configuration could not be loaded",
            Self::K => "its heartbeat was lost while error control started",
            Self::L => "it was operational already and was left running",
            Self::M => {
                "its product code (1018h:02) is another than expected: a different device has this node-id"
            }
            Self::N => {
                "its revision (1018h:03) is another than expected: check the EDS against the device's firmware"
            }
            Self::O => "its serial number (1018h:04) is another than expected: the device was exchanged",
        }
    }
}

impl fmt::Display for Letter {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{self:?}")
    }
}
