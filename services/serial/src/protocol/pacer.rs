//! Gives received bytes of a pseudo-terminal the time they would take on a line.

/// Bytes that may be on the imagined line.
pub const MAX_BYTES: usize = 4096;

/// A queue whose bytes arrive one character time after the other.
#[derive(Debug)]
pub struct Pacer {
    bytes: Box<[u8; MAX_BYTES]>,
    head: usize,
    len: usize,
    /// When the first byte of the queue has arrived whole.
    head_ns: u64,
    last_ns: u64,
    char_ns: u64,
}

impl Pacer {
    /// `char_ns` is the time of one character.
    pub fn new(char_ns: u64) -> Self {
        Self { bytes: Box::new([0; MAX_BYTES]), head: 0, len: 0, head_ns: 0, last_ns: 0, char_ns }
    }

    /// Bytes that fit.
    pub fn room(&self) -> usize {
        MAX_BYTES - self.len
    }

    /// Whether nothing is on the line.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Bytes whose first bit begins now, or behind those that are on the line. What does not fit is lost; returns
    /// how many were taken.
    pub fn push(&mut self, now_ns: u64, bytes: &[u8]) -> usize {
        if self.len == 0 && !bytes.is_empty() {
            self.head_ns = now_ns.max(self.last_ns) + self.char_ns;
        }
        let taken = bytes.len().min(self.room());
        for (i, byte) in bytes[..taken].iter().enumerate() {
            self.bytes[(self.head + self.len + i) % MAX_BYTES] = *byte;
        }
        self.len += taken;
        taken
    }

    /// Takes what has arrived. Returns how many bytes, and when the last of them had arrived.
    pub fn take(&mut self, now_ns: u64, out: &mut [u8]) -> (usize, u64) {
        if self.len == 0 || now_ns < self.head_ns {
            return (0, self.last_ns);
        }
        let due = (now_ns - self.head_ns) / self.char_ns.max(1) + 1;
        let n = self.len.min(out.len()).min(usize::try_from(due).unwrap_or(usize::MAX));
        for (i, slot) in out[..n].iter_mut().enumerate() {
            *slot = self.bytes[(self.head + i) % MAX_BYTES];
        }
        self.head = (self.head + n) % MAX_BYTES;
        self.len -= n;
        self.last_ns = self.head_ns + self.char_ns * (n as u64).saturating_sub(1);
        self.head_ns += self.char_ns * n as u64;
        (n, self.last_ns)
    }

    /// When the last byte of the queue will have arrived.
    pub fn deadline(&self) -> Option<u64> {
        (self.len > 0).then(|| self.head_ns + self.char_ns * (self.len as u64 - 1))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn bytes_take_their_time() {
        let mut pacer = Pacer::new(100);
        let mut out = [0; 16];
        pacer.push(1000, b"abc");
        assert_eq!(pacer.deadline(), Some(1300));
        assert_eq!(pacer.take(1099, &mut out).0, 0);
        assert_eq!(pacer.take(1250, &mut out), (2, 1200));
        pacer.push(1260, b"d");
        assert_eq!(pacer.deadline(), Some(1400), "behind the one before");
        assert_eq!(pacer.take(5000, &mut out), (2, 1400));
        assert_eq!(&out[..2], b"cd");
        assert!(pacer.is_empty());
    }

    proptest! {
        #[test]
        fn order_and_rate(steps in proptest::collection::vec((0u64..500, 0usize..40), 1..60)) {
            let mut pacer = Pacer::new(10);
            let (mut now, mut next, mut seen) = (0u64, 0u8, 0u8);
            let mut begun = None;
            let mut count = 0u64;
            for (wait, n) in steps {
                now += wait;
                let mut out = [0; 64];
                let (taken, _) = pacer.take(now, &mut out);
                for byte in &out[..taken] {
                    prop_assert_eq!(*byte, seen);
                    seen = seen.wrapping_add(1);
                }
                count += taken as u64;
                let bytes: Vec<u8> = (0..n).map(|i| next.wrapping_add(i as u8)).collect();
                next = next.wrapping_add(pacer.push(now, &bytes) as u8);
                begun.get_or_insert(now);
                prop_assert!(count * 10 <= now - begun.unwrap() + 10);
            }
        }
    }
}
