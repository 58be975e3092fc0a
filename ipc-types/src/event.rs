//! What happened: the JSON of `stack/events` and of the recording's event channel.

use serde::{Deserialize, Serialize};
use serde_json::Value;

/// How grave an event is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Level {
    Info,
    Warning,
    Fault,
}

/// The kinds of events; the names are what a user greps for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EventKind {
    /// A process was started.
    Started,
    /// A service reported that it works.
    Ready,
    /// A process ended; `detail` has signal or exit code and its last log lines.
    Died,
    /// A service did not beat in time and is killed.
    Hung,
    /// A service will be started again.
    Restarting,
    /// The restart budget is used up; the service is held.
    Held,
    /// A service dies again and again, too seldom to use up its restart budget; as information: it does no longer.
    Unstable,
    /// The stack ends because of a service.
    StackFailed,
    /// /dev/shm is full: what died cannot be cleaned up and started again until there is room, or memory of the stack
    /// could not be set aside.
    NoRoom,
    /// The stack is being stopped.
    Stopping,
    /// An output owner went to its safe state.
    SafeEntered,
    /// ... and left it.
    SafeLeft,
    /// A program was loaded.
    Loaded,
    /// The PLC started, cold, warm or hot.
    PlcStarted,
    /// The PLC was stopped by command.
    PlcStopped,
    /// The program faulted.
    ProgramFault,
    /// Variables are forced, or no longer.
    Forced,
    /// The RETAIN variables cannot be copied to disk, or can again.
    RetainFault,
    /// An input became bad or good.
    InputQuality,
    /// The recorder lost messages or could not write.
    RecorderFault,
    /// UTC against CLOCK_MONOTONIC, at start and when it jumps.
    ClockOffset,
    /// A client connected, left or was refused.
    Client,
    /// A bus changed state.
    BusState,
    /// A node of a CANopen network was booted, lost, returned or refused.
    NodeState,
    /// A CANopen node sent an emergency message.
    Emcy,
}

/// The JSON body of an event.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct EventBody {
    pub event: EventKind,
    pub level: Level,
    /// The service it is about.
    pub service: String,
    /// One sentence for people.
    pub message: String,
    /// UTC in ns.
    pub utc_ns: i64,
    /// CLOCK_MONOTONIC in ns.
    pub t_ns: u64,
    /// More, by kind.
    #[serde(default, skip_serializing_if = "Value::is_null")]
    pub detail: Value,
}

impl EventBody {
    /// An event of now.
    pub fn now(
        event: EventKind,
        level: Level,
        service: &str,
        message: impl Into<String>,
        detail: Value,
    ) -> Self {
        Self {
            event,
            level,
            service: service.to_owned(),
            message: message.into(),
            utc_ns: crate::clock::utc_ns(),
            t_ns: crate::clock::mono_ns(),
            detail,
        }
    }
}

/// So many events a second may go to the rail; the others are counted, so that a storm of them costs one sentence.
#[derive(Debug, Clone, Copy)]
pub struct Budget {
    a_second: u32,
    left: u32,
    left_out: u32,
}

impl Budget {
    pub const fn new(a_second: u32) -> Self {
        Self { a_second, left: a_second, left_out: 0 }
    }

    /// Whether one more event may go now.
    pub fn take(&mut self) -> bool {
        if self.left == 0 {
            self.left_out = self.left_out.saturating_add(1);
            return false;
        }
        self.left -= 1;
        true
    }

    /// Call once a second: how many events were left out in the last one; `None`: none.
    pub fn renew(&mut self) -> Option<u32> {
        let left_out = std::mem::take(&mut self.left_out);
        self.left = self.a_second;
        (left_out > 0).then_some(left_out)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_storm_is_counted() {
        let mut budget = Budget::new(2);
        assert_eq!([(); 5].map(|()| budget.take()), [true, true, false, false, false]);
        assert_eq!(budget.renew(), Some(3));
        assert_eq!([(); 2].map(|()| budget.take()), [true, true]);
        assert_eq!(budget.renew(), None);
    }
}
