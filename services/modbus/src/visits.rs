//! Which connections are worth a line in the log: masters that connect anew for every request would fill it.
//!
//! The first connection of an address is told, later ones at most once a minute with the number of those left out.

use std::net::IpAddr;

/// An address is told again after this time.
pub const PAUSE_NS: u64 = 60_000_000_000;
/// Addresses remembered; beyond it the one told longest ago is forgotten.
const MAX_ADDRESSES: usize = 64;

struct Visitor {
    address: IpAddr,
    told_ns: u64,
    untold: u32,
}

/// See the module.
#[derive(Default)]
pub struct Visits {
    known: Vec<Visitor>,
}

impl Visits {
    /// Somebody connects: `Some` if that is to be told, with the number of connections of this address that were not
    /// told before it.
    pub fn arrives(&mut self, address: IpAddr, now_ns: u64) -> Option<u32> {
        let address = address.to_canonical();
        let Some(visitor) = self.known.iter_mut().find(|v| v.address == address) else {
            if self.known.len() >= MAX_ADDRESSES
                && let Some(oldest) = (0..self.known.len()).min_by_key(|&i| self.known[i].told_ns)
            {
                self.known.swap_remove(oldest);
            }
            self.known.push(Visitor { address, told_ns: now_ns, untold: 0 });
            return Some(0);
        };
        if now_ns.saturating_sub(visitor.told_ns) < PAUSE_NS {
            visitor.untold = visitor.untold.saturating_add(1);
            return None;
        }
        visitor.told_ns = now_ns;
        Some(std::mem::take(&mut visitor.untold))
    }
}

/// Whether the end of a connection is to be told: of one whose begin was, unless it stands for many short ones, and of
/// one that lasted.
pub fn leaving_is_told(arrival: Option<u32>, lasted_ns: u64) -> bool {
    arrival == Some(0) || lasted_ns >= PAUSE_NS
}

/// What a message about an arrival says of those before it.
pub fn untold_words(untold: u32) -> String {
    match untold {
        0 => String::new(),
        1 => " (1 more connection of this address in between)".to_owned(),
        n => format!(" ({n} more connections of this address in between)"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_line_a_minute_and_address() {
        let mut visits = Visits::default();
        let ip = |last: u8| IpAddr::from([10, 0, 0, last]);
        let mut told = Vec::new();
        for second in 0..130 {
            told.extend(visits.arrives(ip(1), second * 1_000_000_000).map(|untold| (second, untold)));
        }
        assert_eq!(told, [(0, 0), (60, 59), (120, 59)]);
        assert_eq!(visits.arrives(ip(2), 130_000_000_000), Some(0));
        // The same address on a socket for both families.
        assert_eq!(visits.arrives("::ffff:10.0.0.2".parse().unwrap(), 131_000_000_000), None);
        assert_eq!(visits.arrives(ip(2), 190_000_000_000), Some(1));
        assert_eq!(untold_words(1), " (1 more connection of this address in between)");
        assert!(leaving_is_told(Some(0), 0) && leaving_is_told(None, PAUSE_NS));
        assert!(!leaving_is_told(Some(59), 1) && !leaving_is_told(None, 1));
    }

    #[test]
    fn only_so_many_addresses_are_remembered() {
        let mut visits = Visits::default();
        for n in 0..1000_u32 {
            assert_eq!(visits.arrives(IpAddr::from(n.to_be_bytes()), u64::from(n)), Some(0));
        }
        assert_eq!(visits.known.len(), MAX_ADDRESSES);
        assert_eq!(visits.arrives(IpAddr::from(999_u32.to_be_bytes()), 1000), None);
    }
}
