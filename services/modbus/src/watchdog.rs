//! Watches that clients go on writing: a client that drives outputs and disappears must not leave them as they
//! are. Sans-I/O.

use ipc_types::image_write::Builder;

/// State of a [`Watchdog`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum WatchdogState {
    /// No client has written yet.
    Waiting,
    /// A client writes.
    Armed,
    /// The values were sent; the next write arms it again.
    Fired,
}

/// Fires once when no write has come for its time.
pub struct Watchdog {
    limit_ns: u64,
    values: Builder,
    state: WatchdogState,
    last_write_ns: u64,
    cleared: bool,
}

impl Watchdog {
    /// Not armed before the first write, except in a restarted service (`armed`): what its predecessor's
    /// clients wrote may still be there.
    pub fn new(limit_ns: u64, values: Builder, armed: bool, now_ns: u64) -> Self {
        let state = if armed { WatchdogState::Armed } else { WatchdogState::Waiting };
        Self { limit_ns, values, state, last_write_ns: now_ns, cleared: false }
    }

    /// The values it sends.
    pub fn values(&self) -> &Builder {
        &self.values
    }

    /// The state.
    pub fn state(&self) -> WatchdogState {
        self.state
    }

    /// A client's write was carried out.
    pub fn written(&mut self, now_ns: u64) {
        self.cleared |= self.state == WatchdogState::Fired;
        self.state = WatchdogState::Armed;
        self.last_write_ns = now_ns;
    }

    /// Whether the values are to be sent now.
    pub fn is_due(&self, now_ns: u64) -> bool {
        self.state == WatchdogState::Armed && now_ns.saturating_sub(self.last_write_ns) >= self.limit_ns
    }

    /// The values were sent.
    pub fn fired(&mut self) {
        self.state = WatchdogState::Fired;
    }

    /// Whether a write has ended the fired state since the last call.
    pub fn take_cleared(&mut self) -> bool {
        std::mem::take(&mut self.cleared)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_waits_for_the_first_write_fires_once_and_is_armed_again() {
        let mut dog = Watchdog::new(100, Builder::default(), false, 0);
        assert!(!dog.is_due(1_000_000));
        dog.written(50);
        assert!(!dog.is_due(149) && dog.is_due(150));
        dog.fired();
        assert!(!dog.is_due(1000) && !dog.take_cleared());
        dog.written(1000);
        assert!(dog.take_cleared() && !dog.take_cleared());
        assert!(dog.is_due(1100));
    }

    #[test]
    fn a_restarted_service_watches_at_once() {
        let dog = Watchdog::new(100, Builder::default(), true, 7);
        assert!(!dog.is_due(106) && dog.is_due(107));
    }
}
