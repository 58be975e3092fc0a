//! The inputs half of a field service: its part of %I on `<svc>/inputs`.

use crate::clock;
use crate::payload::Inputs;
use crate::port::Publisher;

/// The inputs are repeated when they are older than this, so that a plc that comes late gets them: history is handed
/// over only when its owner sends. Looked at with every heartbeat, that makes 100 ms.
const REPEAT_NS: u64 = 90_000_000;

/// The topic `<svc>/inputs`. A service without inputs has none; then nothing is published.
pub struct InputsPort {
    port: Option<Publisher<Inputs>>,
    published_ns: u64,
}

impl InputsPort {
    pub fn new(port: Option<Publisher<Inputs>>) -> Self {
        Self { port, published_ns: 0 }
    }

    /// Whether the service has inputs.
    pub fn is_open(&self) -> bool {
        self.port.is_some()
    }

    /// Publishes all inputs. `fresh`: news, so the plc is woken; otherwise a repetition. Returns when they were with
    /// their readers at the latest (CLOCK_MONOTONIC in ns); `None`: they are not.
    pub fn publish(&mut self, header: Inputs, tail: &[u8], fresh: bool) -> Option<u64> {
        let port = self.port.as_mut()?;
        let sent = port.send_tail(header, tail);
        self.published_ns = clock::mono_ns();
        if let Err(e) = &sent {
            tracing::warn!("inputs: {e}");
        }
        if fresh {
            port.ring();
        }
        sent.ok().map(|_| self.published_ns)
    }

    /// Whether it is time for a repetition.
    pub fn is_due(&self, now_ns: u64) -> bool {
        self.port.is_some() && now_ns.saturating_sub(self.published_ns) >= REPEAT_NS
    }
}
