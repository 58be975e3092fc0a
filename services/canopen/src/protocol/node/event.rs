//! What a node tells its owner.

use std::collections::VecDeque;

use crate::protocol::emcy::Emcy;
use crate::protocol::error_control::guarding::LifeEvent;
use crate::protocol::error_control::heartbeat::HeartbeatEvent;
use crate::protocol::lss::slave::LssSlaveEvent;
use crate::protocol::nmt::NmtState;
use crate::protocol::pdo::PdoEvent;
use crate::protocol::time_stamp::TimeOfDay;

/// Events that wait; the owner takes them after every call.
pub const EVENTS: usize = 2048;

/// What happened.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NodeEvent {
    /// The node was reset. `application`: reset node, its writable objects have their defaults or stored values again;
    /// otherwise reset communication, only 1000h-1FFFh have. Comes before the change of state.
    Reset {
        application: bool,
    },
    State {
        from: NmtState,
        to: NmtState,
    },
    /// The values of this RPDO (0-based) are in the dictionary.
    Received {
        number: u16,
    },
    /// Something was wrong, or is right again, with an RPDO.
    Rpdo(PdoEvent),
    /// A SYNC was received or produced, and all that hangs on it is done: synchronous RPDOs are in the dictionary,
    /// synchronous TPDOs in the outbox. `counter` is 0 without SYNC counter.
    Sync {
        counter: u8,
    },
    /// SYNC stays away.
    SyncTimeout,
    SyncResolved,
    Time(TimeOfDay),
    Heartbeat(HeartbeatEvent),
    /// Life guarding.
    Life(LifeEvent),
    /// An EMCY message of this node.
    EmcyRaised(Emcy),
    /// An EMCY message of a consumed node (1028h).
    EmcyReceived {
        node_id: u8,
        emcy: Emcy,
    },
    /// The network wrote this object by SDO.
    Written {
        index: u16,
        sub: u8,
    },
    /// What is stored changed: keep [`Node::store_image`](super::Node::store_image).
    StoreChanged,
    Lss(LssSlaveEvent),
    /// Another device uses this node-id.
    DuplicateNodeId {
        node_id: u8,
    },
}

/// Queue of events with a limit.
#[derive(Debug, Clone)]
pub struct Events {
    queue: VecDeque<NodeEvent>,
    /// Events that found the queue full.
    pub dropped: u64,
}

impl Default for Events {
    fn default() -> Self {
        Self { queue: VecDeque::with_capacity(EVENTS), dropped: 0 }
    }
}

impl Events {
    pub fn push(&mut self, event: NodeEvent) {
        if self.queue.len() < EVENTS {
            self.queue.push_back(event);
        } else {
            self.dropped += 1;
        }
    }
    pub fn next(&mut self) -> Option<NodeEvent> {
        self.queue.pop_front()
    }
}
