//! Network settings that every TCP service of a stack shares: where it listens and who may connect.

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

#[cfg(test)]
mod tests {
    use super::*;

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
