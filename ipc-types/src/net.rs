//! What every TCP service of a stack shares: who may connect, and how failing accepts are told.

use serde::{Deserialize, Serialize};
use std::net::{IpAddr, Ipv4Addr};

/// Which IPv4 addresses may connect: allowed iff `start <= ip <= end` and `ip & mask == start & mask`.
/// Checked before a byte is read. Loopback is always allowed. IPv6 peers are refused while a filter is set,
/// except IPv4-mapped ones, which are judged as the IPv4 address they carry.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct IpFilter {
    pub mask: Ipv4Addr,
    pub start: Ipv4Addr,
    pub end: Ipv4Addr,
}

impl IpFilter {
    /// Whether this peer may connect.
    pub fn allows(&self, peer: IpAddr) -> bool {
        let ip = match peer {
            IpAddr::V4(ip) => ip,
            IpAddr::V6(ip) => match ip.to_ipv4_mapped() {
                Some(ip) => ip,
                None => return ip.is_loopback(),
            },
        };
        if ip.is_loopback() {
            return true;
        }
        let (ip, start, end, mask) =
            (u32::from(ip), u32::from(self.start), u32::from(self.end), u32::from(self.mask));
        start <= ip && ip <= end && ip & mask == start & mask
    }

    /// What is wrong with the filter itself, if anything.
    pub fn fault(&self) -> Option<String> {
        if u32::from(self.start) > u32::from(self.end) {
            return Some(format!(
                "filter: start {} lies behind end {}: nobody could connect",
                self.start, self.end
            ));
        }
        None
    }
}

/// Tells a failure that comes again and again at most once per 10 s: an accept without descriptors fails ten times
/// a second for as long as they lack. Sans-I/O: the time comes in.
#[derive(Debug, Clone, Copy, Default)]
pub struct Seldom {
    told_ns: Option<u64>,
    untold: u64,
}

impl Seldom {
    /// Shortest time between two messages.
    pub const EVERY_NS: u64 = 10_000_000_000;

    /// One more failure. `Some(n)`: tell it now, and that `n` failures since the last message were not told.
    pub fn failed(&mut self, now_ns: u64) -> Option<u64> {
        if self.told_ns.is_some_and(|told_ns| now_ns.saturating_sub(told_ns) < Self::EVERY_NS) {
            self.untold += 1;
            return None;
        }
        self.told_ns = Some(now_ns);
        Some(std::mem::take(&mut self.untold))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flood_of_failures_is_told_every_10_s() {
        let mut seldom = Seldom::default();
        let told: Vec<_> =
            (0..=250_u64).filter_map(|n| seldom.failed(n * 100_000_000).map(|untold| (n, untold))).collect();
        assert_eq!(told, [(0, 0), (100, 99), (200, 99)]);
        assert_eq!(seldom.failed(60_000_000_000), Some(50));
    }

    #[test]
    fn the_filter_is_range_and_mask() {
        let filter = IpFilter {
            mask: "255.255.255.0".parse().unwrap(),
            start: "192.168.1.10".parse().unwrap(),
            end: "192.168.1.99".parse().unwrap(),
        };
        for (peer, allowed) in [
            ("192.168.1.10", true),
            ("192.168.1.99", true),
            ("192.168.1.9", false),
            ("192.168.1.100", false),
            ("192.168.2.50", false),
            ("127.0.0.1", true),
            ("::1", true),
            ("::ffff:192.168.1.20", true),
            ("::ffff:10.0.0.1", false),
            ("fe80::1", false),
        ] {
            assert_eq!(filter.allows(peer.parse().unwrap()), allowed, "{peer}");
        }
    }
}
