//! The role of the slave: a device whose objects are ranges of the process image, or a simulated one. Sans-I/O.

pub mod fleet;
pub mod image_map;
pub mod simulation;

use crate::protocol::cob_id::CobId;
use crate::protocol::io::Outbox;
use crate::protocol::node::Node;
use ipc_types::payload::{CanFrame, can_flag};

/// Whether a frame is a SYNC whose window (1007h) is over already: the process was late, or the bus was.
pub fn is_late_sync(node: &Node, frame: &CanFrame, now_ns: u64) -> bool {
    let window_ns = u64::from(node.od().u32(0x1007, 0).unwrap_or(0)) * 1000;
    window_ns > 0
        && now_ns > frame.stamp.t_ns.saturating_add(window_ns)
        && node.od().u32(0x1005, 0).is_some_and(|cob| CobId(cob).matches(frame))
}

/// Cyclic synchronous PDOs of a SYNC whose window is over are not sent (CiA 301 V4.2, clause 7.5.2.7): behind the next
/// SYNC they would be taken for its own. Those of type 0 tell of an event and stay.
pub fn drop_synchronous(out: &mut Outbox) {
    out.retain(|frame| frame.flags & can_flag::NEWEST == 0);
}
