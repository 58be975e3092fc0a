//! Removes the bytes we sent from what comes back on a two-wire RS-485 line.
//!
//! Bytes that differ mean that somebody else was sending: a collision. From there on everything is handed over.

use ipc_types::payload::CHUNK_BYTES;

/// Counters of [`Echo`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize)]
pub struct EchoCounters {
    /// Bytes of our own that came back and were removed.
    pub removed: u64,
    /// Transmissions that came back changed.
    pub collisions: u64,
    /// Transmissions that did not come back whole in time.
    pub missing: u64,
}

/// See the module.
#[derive(Debug)]
pub struct Echo {
    sent: Box<[u8; CHUNK_BYTES]>,
    len: usize,
    at: usize,
    until_ns: u64,
    counters: EchoCounters,
}

impl Default for Echo {
    fn default() -> Self {
        Self {
            sent: Box::new([0; CHUNK_BYTES]),
            len: 0,
            at: 0,
            until_ns: 0,
            counters: EchoCounters::default(),
        }
    }
}

impl Echo {
    /// These bytes go out and are expected back until `until_ns`. Longer ones than a chunk are cut.
    pub fn expect(&mut self, bytes: &[u8], until_ns: u64) {
        self.close();
        let n = bytes.len().min(CHUNK_BYTES);
        self.sent[..n].copy_from_slice(&bytes[..n]);
        (self.len, self.at, self.until_ns) = (n, 0, until_ns);
    }

    /// What has not come back by then will not.
    pub fn end_at(&mut self, until_ns: u64) {
        self.until_ns = until_ns;
    }

    /// Says how many bytes at the beginning of `bytes` are our own.
    pub fn filter(&mut self, bytes: &[u8], now_ns: u64) -> usize {
        self.turn(now_ns);
        let open = &self.sent[self.at..self.len];
        let same = open.iter().zip(bytes).take_while(|(a, b)| a == b).count();
        self.at += same;
        self.counters.removed += same as u64;
        if self.at < self.len && same < bytes.len() {
            self.counters.collisions += 1;
            self.len = 0;
            self.at = 0;
        }
        same
    }

    /// Gives up what did not come back in time.
    pub fn turn(&mut self, now_ns: u64) {
        if now_ns > self.until_ns {
            self.close();
        }
    }

    fn close(&mut self) {
        if self.at < self.len {
            self.counters.missing += 1;
        }
        self.len = 0;
        self.at = 0;
    }

    /// How it went so far.
    pub fn counters(&self) -> EchoCounters {
        self.counters
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn what_comes_back_is_removed() {
        let mut echo = Echo::default();
        echo.expect(b"abcd", 100);
        assert_eq!(echo.filter(b"ab", 10), 2);
        assert_eq!(echo.filter(b"cdANSWER", 20), 2);
        assert_eq!(echo.filter(b"abcd", 30), 0, "nothing is expected any more");
        assert_eq!(echo.counters(), EchoCounters { removed: 4, collisions: 0, missing: 0 });
        echo.expect(b"abcd", 100);
        assert_eq!(echo.filter(b"abX", 40), 2);
        assert_eq!(echo.filter(b"d", 50), 0);
        assert_eq!(echo.counters().collisions, 1);
        echo.expect(b"abcd", 100);
        assert_eq!(echo.filter(b"a", 60), 1);
        assert_eq!(echo.filter(b"bcd", 101), 0);
        assert_eq!(echo.counters().missing, 1);
    }

    proptest! {
        #[test]
        fn any_parts(sent in proptest::collection::vec(any::<u8>(), 1..300), at in 1usize..20,
                     answer in proptest::collection::vec(any::<u8>(), 0..50)) {
            let mut echo = Echo::default();
            echo.expect(&sent, 1000);
            let line = [sent, answer.clone()].concat();
            let mut rest = Vec::new();
            for part in line.chunks(at) {
                let own = echo.filter(part, 1);
                rest.extend_from_slice(&part[own..]);
            }
            prop_assert_eq!(rest, answer);
            prop_assert_eq!(echo.counters().collisions, 0);
        }
    }
}
