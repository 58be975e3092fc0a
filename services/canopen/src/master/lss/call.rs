//! What can be asked of an LSS master, as jobs and the command line say it.

use crate::protocol::lss::master::{FastscanHint, Inquiry, LssRange, LssRequest, LssTimes};
use crate::protocol::lss::{BIT_TIMING_KBIT, LssAddress, LssState, UNCONFIGURED};
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;

/// Devices that one `assign` gives node-ids; its result has to fit into a message of the rail.
pub const MAX_ASSIGNED: u8 = 32;
/// Longest wait for an answer that can be asked for.
const MAX_TIMEOUT_MS: u16 = 5000;

/// A call. The single services do what CiA 305 says and leave the devices in the state they come to; the others leave
/// all devices waiting.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "call", rename_all = "snake_case", deny_unknown_fields)]
pub enum LssCall {
    /// All devices; nobody answers.
    SwitchGlobal { state: LssState },
    /// The device with this identity enters configuration.
    SwitchSelective { address: LssAddress },
    /// Of the device in configuration: 1 to 127, or 255 for none.
    ConfigureNodeId { node_id: u8 },
    /// Of the device in configuration.
    ConfigureBitTiming { kbit: u16 },
    /// All devices in configuration: they fall silent for `delay_ms`, change over, and are silent for as long again.
    ActivateBitTiming { delay_ms: u16 },
    /// Of the device in configuration.
    Store {},
    /// Identity and node-id of the device in configuration.
    Inquire {},
    /// Is there a device with this vendor and product, and revision and serial number within these bounds?
    Identify { vendor: u32, product: u32, revision: (u32, u32), serial: (u32, u32) },
    /// Is there a device without node-id?
    IdentifyNonConfigured {},
    /// Finds one device without node-id.
    Fastscan {
        /// What is known of its identity beforehand.
        #[serde(default)]
        hint: FastscanHint,
        /// Leaves it in configuration.
        #[serde(default)]
        hold: bool,
        /// How long each question waits for an answer.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        timeout_ms: Option<u16>,
    },
    /// Finds the devices without node-id one after the other and gives them node-ids from `from` on.
    Assign {
        from: u8,
        #[serde(default)]
        store: bool,
        /// At most so many devices.
        #[serde(default = "max_assigned")]
        max: u8,
        #[serde(default, skip_serializing_if = "Option::is_none")]
        timeout_ms: Option<u16>,
    },
    /// Without address, as in the next two: the only device of the bus. When several answer nothing is done.
    SetNodeId {
        node_id: u8,
        #[serde(default)]
        address: Option<LssAddress>,
        #[serde(default)]
        store: bool,
    },
    SetBitrate {
        kbit: u16,
        #[serde(default)]
        address: Option<LssAddress>,
        #[serde(default)]
        store: bool,
        /// Activates it with this delay.
        #[serde(default)]
        activate_ms: Option<u16>,
    },
    /// Identity and node-id of a device.
    InquireDevice {
        #[serde(default)]
        address: Option<LssAddress>,
    },
}

fn max_assigned() -> u8 {
    MAX_ASSIGNED
}

fn index_of(kbit: u16) -> Option<u8> {
    BIT_TIMING_KBIT.iter().position(|&k| k == kbit && k != 0).map(|at| at as u8)
}

/// The serial number first: of several devices it is what differs, and none is asked more before they are found out.
const INQUIRIES: [Inquiry; 5] =
    [Inquiry::Serial, Inquiry::Vendor, Inquiry::Product, Inquiry::Revision, Inquiry::NodeId];

impl LssCall {
    /// What is wrong with its values, for the user.
    pub fn check(&self) -> Result<(), String> {
        let node = |id: u8, none: bool| match id {
            1..=127 => Ok(()),
            UNCONFIGURED if none => Ok(()),
            _ => Err(format!("node-id {id} does not exist; node-ids are 1 to 127")),
        };
        match *self {
            Self::ConfigureNodeId { node_id } | Self::SetNodeId { node_id, .. } => node(node_id, true),
            Self::ConfigureBitTiming { kbit } | Self::SetBitrate { kbit, .. } => {
                index_of(kbit).map(|_| ()).ok_or_else(|| {
                    format!(
                        "LSS has no bit rate of {kbit} kbit/s; it has 10, 20, 50, 125, 250, 500, 800, 1000"
                    )
                })
            }
            Self::Assign { from, max, .. } => {
                node(from, false)?;
                match max {
                    1..=MAX_ASSIGNED => self.check_timeout(),
                    _ => Err(format!("max is {max}: one job gives node-ids to 1 to {MAX_ASSIGNED} devices")),
                }
            }
            Self::Fastscan { .. } => self.check_timeout(),
            _ => Ok(()),
        }
    }

    fn check_timeout(&self) -> Result<(), String> {
        match self.timeout_ms() {
            Some(ms) if !(1..=MAX_TIMEOUT_MS).contains(&ms) => {
                Err(format!("a time of {ms} ms: an answer is awaited for 1 to {MAX_TIMEOUT_MS} ms"))
            }
            _ => Ok(()),
        }
    }

    fn timeout_ms(&self) -> Option<u16> {
        match *self {
            Self::Fastscan { timeout_ms, .. } | Self::Assign { timeout_ms, .. } => timeout_ms,
            _ => None,
        }
    }

    /// Who waits longer for an answer has slower devices: then the others' answers are given more time, too.
    pub(super) fn times(&self) -> LssTimes {
        let times = LssTimes::default();
        let timeout_ms = self.timeout_ms().unwrap_or(times.timeout_ms);
        LssTimes { timeout_ms, settle_ms: times.settle_ms.max(timeout_ms / 20), ..times }
    }

    /// Whether it is for the only device, which nobody named: that no other answers has to be made sure first.
    pub(super) fn is_sole(&self) -> bool {
        matches!(
            self,
            Self::SetNodeId { address: None, .. }
                | Self::SetBitrate { address: None, .. }
                | Self::InquireDevice { address: None }
                | Self::Inquire {}
        )
    }

    /// Whether all devices are to be waiting again at its end, however it ends.
    pub(super) fn tidies_up(&self) -> bool {
        match self {
            Self::Fastscan { hold, .. } => !hold,
            Self::Assign { .. }
            | Self::SetNodeId { .. }
            | Self::SetBitrate { .. }
            | Self::InquireDevice { .. } => true,
            _ => false,
        }
    }

    /// The services it begins with.
    pub(super) fn steps(&self) -> VecDeque<LssRequest> {
        let select = |address: &Option<LssAddress>| match address {
            Some(address) => LssRequest::SwitchSelective(*address),
            None => LssRequest::SwitchGlobal(LssState::Configuration),
        };
        // Who asks for the identity anyway finds out by that.
        let alone = |address: &Option<LssAddress>| {
            address.is_none().then_some(LssRequest::Inquire(Inquiry::Serial)).into_iter()
        };
        let bit_timing = |kbit: u16| LssRequest::ConfigureBitTiming(index_of(kbit).unwrap_or(0));
        let store = |store: bool| store.then_some(LssRequest::Store);
        match *self {
            Self::SwitchGlobal { state } => [LssRequest::SwitchGlobal(state)].into(),
            Self::SwitchSelective { address } => [LssRequest::SwitchSelective(address)].into(),
            Self::ConfigureNodeId { node_id } => [LssRequest::ConfigureNodeId(node_id)].into(),
            Self::ConfigureBitTiming { kbit } => [bit_timing(kbit)].into(),
            Self::ActivateBitTiming { delay_ms } => [LssRequest::ActivateBitTiming { delay_ms }].into(),
            Self::Store {} => [LssRequest::Store].into(),
            Self::Inquire {} => INQUIRIES.map(LssRequest::Inquire).into(),
            Self::Identify { vendor, product, revision, serial } => {
                [LssRequest::Identify(LssRange { vendor, product, revision, serial })].into()
            }
            Self::IdentifyNonConfigured {} => [LssRequest::IdentifyNonConfigured].into(),
            Self::Fastscan { hint, .. } => [LssRequest::Fastscan(hint)].into(),
            Self::Assign { .. } => [LssRequest::Fastscan(FastscanHint::default())].into(),
            Self::SetNodeId { node_id, ref address, store: keep } => {
                let set = LssRequest::ConfigureNodeId(node_id);
                [select(address)].into_iter().chain(alone(address)).chain([set]).chain(store(keep)).collect()
            }
            Self::SetBitrate { kbit, ref address, store: keep, activate_ms } => {
                let activate = activate_ms.map(|delay_ms| LssRequest::ActivateBitTiming { delay_ms });
                let steps = [select(address)].into_iter().chain(alone(address)).chain([bit_timing(kbit)]);
                steps.chain(store(keep)).chain(activate).collect()
            }
            Self::InquireDevice { ref address } => {
                [select(address)].into_iter().chain(INQUIRIES.map(LssRequest::Inquire)).collect()
            }
        }
    }
}
