//! What is due with the heartbeat waits for a SYNC that is near, but not for ever.

use ipc_types::turns::Turn;

/// Longest wait: turns that take most of a SYNC period always end near the next one, and a service without heartbeat is
/// taken for dead.
const LONGEST_NS: u64 = 10_000_000;

/// See the module.
#[derive(Debug, Default)]
pub(super) struct Later {
    turn: Turn,
    since_ns: Option<u64>,
}

impl Later {
    /// What is to be done now, of what is `due` and of what waited.
    pub(super) fn take(&mut self, due: Turn, near: bool, now_ns: u64) -> Turn {
        self.turn.beat |= due.beat;
        self.turn.status |= due.status;
        if self.turn == Turn::default() {
            return self.turn;
        }
        let since_ns = *self.since_ns.get_or_insert(now_ns);
        if near && now_ns.saturating_sub(since_ns) < LONGEST_NS {
            return Turn::default();
        }
        self.since_ns = None;
        std::mem::take(&mut self.turn)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sync_that_is_always_near_does_not_silence_the_heartbeat() {
        const MS: u64 = 1_000_000;
        let (none, beat) = (Turn::default(), Turn { beat: true, ..Turn::default() });
        let status = Turn { beat: true, status: true, ..Turn::default() };
        let mut later = Later::default();
        assert_eq!(later.take(none, true, 0), none);
        assert_eq!(later.take(beat, false, MS), beat);
        // It waits for one SYNC, and both are done behind it.
        assert_eq!(later.take(beat, true, 50 * MS), none);
        assert_eq!(later.take(status, true, 51 * MS), none);
        assert_eq!(later.take(none, false, 52 * MS), status);
        assert_eq!(later.take(none, false, 53 * MS), none);
        // Every turn ends near the next SYNC.
        let done: Vec<u64> = (100..200)
            .filter(|ms| later.take(if ms % 50 == 0 { beat } else { none }, true, ms * MS) != none)
            .collect();
        assert_eq!(done, [110, 160]);
    }
}
