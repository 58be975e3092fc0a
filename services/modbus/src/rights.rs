//! Who may do what: rules by peer, unit and function. The first rule that matches decides; what no rule matches is
//! allowed. A refused request gets exception 01.

use crate::protocol::pdu::function;
use serde::{Deserialize, Serialize};
use std::net::IpAddr;

/// Most rules.
pub const MAX_RULES: usize = 64;

/// Where a request came from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Peer {
    /// Over TCP.
    Ip(IpAddr),
    /// On the serial line of this index in the key `serial`.
    Line(usize),
}

/// What a rule grants.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Allow {
    /// Nothing.
    Nothing,
    /// Functions that change nothing.
    Read,
    /// Everything.
    All,
}

/// One `[[service.rights]]` table.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RightsEntry {
    /// An address, a network `10.0.0.0/8`, or the name of a serial service; everybody when absent.
    #[serde(default)]
    pub peer: Option<String>,
    /// Every unit when absent.
    #[serde(default)]
    pub units: Option<Vec<u8>>,
    /// Every function when absent.
    #[serde(default)]
    pub functions: Option<Vec<u8>>,
    pub allow: Allow,
}

/// Rules that cannot be used. `entry` counts from 1.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum RightsError {
    #[error(
        "rights {entry}: '{peer}' is no IP address, no network like 192.168.1.0/24 and no serial port of this server"
    )]
    Peer { entry: usize, peer: String },
    #[error("rights {entry}: /{prefix} is longer than the address")]
    Prefix { entry: usize, prefix: u8 },
    #[error("there are {got} rules; at most {MAX_RULES} are allowed")]
    TooMany { got: usize },
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum PeerRule {
    Any,
    Net { address: IpAddr, prefix: u8 },
    Line(usize),
}

#[derive(Clone, Debug, PartialEq, Eq)]
struct Rule {
    peer: PeerRule,
    units: Option<[u64; 4]>,
    functions: Option<[u64; 4]>,
    allow: Allow,
}

/// The rules in their order.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Rights {
    rules: Vec<Rule>,
}

fn set_of(numbers: &[u8]) -> [u64; 4] {
    let mut set = [0; 4];
    for n in numbers {
        set[usize::from(n / 64)] |= 1 << (n % 64);
    }
    set
}

fn holds(set: &Option<[u64; 4]>, n: u8) -> bool {
    set.is_none_or(|set| set[usize::from(n / 64)] >> (n % 64) & 1 == 1)
}

/// Functions that change neither registers nor the state of the server.
fn is_read_only(code: u8, pdu: &[u8]) -> bool {
    use crate::protocol::diagnostics::sub;
    match code {
        function::WRITE_SINGLE_COIL
        | function::WRITE_SINGLE_REGISTER
        | function::WRITE_MULTIPLE_COILS
        | function::WRITE_MULTIPLE_REGISTERS
        | function::WRITE_FILE_RECORD
        | function::MASK_WRITE_REGISTER
        | function::READ_WRITE_MULTIPLE_REGISTERS => false,
        function::DIAGNOSTICS => {
            let changes = [
                sub::RESTART_COMMUNICATIONS,
                sub::CHANGE_ASCII_DELIMITER,
                sub::FORCE_LISTEN_ONLY,
                sub::CLEAR_COUNTERS,
                sub::CLEAR_OVERRUN,
            ];
            !matches!(pdu, &[_, high, low, ..] if changes.contains(&u16::from_be_bytes([high, low])))
        }
        _ => true,
    }
}

impl PeerRule {
    fn parse(text: Option<&str>, lines: &[&str], entry: usize) -> Result<Self, RightsError> {
        let Some(text) = text else { return Ok(Self::Any) };
        if let Some(line) = lines.iter().position(|name| *name == text) {
            return Ok(Self::Line(line));
        }
        let wrong = || RightsError::Peer { entry, peer: text.to_owned() };
        let (address, prefix) = match text.split_once('/') {
            Some((address, prefix)) => (address, Some(prefix.parse::<u8>().map_err(|_| wrong())?)),
            None => (text, None),
        };
        let address: IpAddr = address.parse().map_err(|_| wrong())?;
        let bits = if address.is_ipv4() { 32 } else { 128 };
        let prefix = prefix.unwrap_or(bits);
        if prefix > bits {
            return Err(RightsError::Prefix { entry, prefix });
        }
        Ok(Self::Net { address: address.to_canonical(), prefix })
    }

    fn matches(self, peer: &Peer) -> bool {
        match (self, peer) {
            (Self::Any, _) => true,
            (Self::Line(line), Peer::Line(other)) => line == *other,
            (Self::Net { address, prefix }, Peer::Ip(ip)) => match (address, ip.to_canonical()) {
                (IpAddr::V4(a), IpAddr::V4(b)) => {
                    let mask = u32::MAX.checked_shl(32 - u32::from(prefix)).unwrap_or(0);
                    u32::from(a) & mask == u32::from(b) & mask
                }
                (IpAddr::V6(a), IpAddr::V6(b)) => {
                    let mask = u128::MAX.checked_shl(128 - u32::from(prefix)).unwrap_or(0);
                    u128::from(a) & mask == u128::from(b) & mask
                }
                _ => false,
            },
            _ => false,
        }
    }
}

impl Rights {
    /// Reads the rules; `lines` are the serial services of the server.
    pub fn new(entries: &[RightsEntry], lines: &[&str]) -> Result<Self, RightsError> {
        if entries.len() > MAX_RULES {
            return Err(RightsError::TooMany { got: entries.len() });
        }
        let rule = |(i, entry): (usize, &RightsEntry)| {
            Ok(Rule {
                peer: PeerRule::parse(entry.peer.as_deref(), lines, i + 1)?,
                units: entry.units.as_deref().map(set_of),
                functions: entry.functions.as_deref().map(set_of),
                allow: entry.allow,
            })
        };
        Ok(Self { rules: entries.iter().enumerate().map(rule).collect::<Result<_, _>>()? })
    }

    /// Whether this request may be carried out.
    pub fn allow(&self, peer: &Peer, unit: u8, pdu: &[u8]) -> bool {
        let code = pdu.first().copied().unwrap_or(0);
        let rule = self
            .rules
            .iter()
            .find(|rule| rule.peer.matches(peer) && holds(&rule.units, unit) && holds(&rule.functions, code));
        match rule.map(|rule| rule.allow) {
            None | Some(Allow::All) => true,
            Some(Allow::Read) => is_read_only(code, pdu),
            Some(Allow::Nothing) => false,
        }
    }
}

impl RightsError {
    /// Index of the rule, from 0.
    pub fn index(&self) -> Option<usize> {
        match self {
            Self::Peer { entry, .. } | Self::Prefix { entry, .. } => Some(entry - 1),
            Self::TooMany { .. } => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rights(json: &str) -> Result<Rights, RightsError> {
        Rights::new(&serde_json::from_str::<Vec<RightsEntry>>(json).unwrap(), &["com1", "com2"])
    }

    fn ip(text: &str) -> Peer {
        Peer::Ip(text.parse().unwrap())
    }

    #[test]
    fn the_first_rule_that_matches_decides() {
        let rights = rights(
            r#"[ { "peer": "192.168.1.5", "allow": "all" },
                 { "peer": "192.168.1.0/24", "functions": [8], "allow": "nothing" },
                 { "peer": "192.168.1.0/24", "allow": "read" },
                 { "peer": "com2", "units": [7], "allow": "nothing" },
                 { "peer": "fe80::/10", "allow": "nothing" } ]"#,
        )
        .unwrap();
        for (peer, unit, pdu, allowed) in [
            (ip("192.168.1.5"), 1, &[6][..], true),
            (ip("192.168.1.6"), 1, &[6], false),
            (ip("192.168.1.6"), 1, &[3], true),
            (ip("::ffff:192.168.1.6"), 1, &[6], false),
            (ip("192.168.1.6"), 1, &[8, 0, 0], false),
            (ip("192.168.2.6"), 1, &[6], true),
            (ip("fe80::1"), 1, &[3], false),
            (ip("2001::1"), 1, &[3], true),
            (Peer::Line(0), 7, &[6], true),
            (Peer::Line(1), 7, &[3], false),
            (Peer::Line(1), 8, &[6], true),
        ] {
            assert_eq!(rights.allow(&peer, unit, pdu), allowed, "{peer:?} {unit} {pdu:?}");
        }
    }

    #[test]
    fn reading_changes_nothing() {
        let rights = rights(r#"[ { "allow": "read" } ]"#).unwrap();
        let allowed = |pdu: &[u8]| rights.allow(&Peer::Line(0), 1, pdu);
        for code in [1, 2, 3, 4, 7, 11, 12, 17, 20, 24, 43, 99] {
            assert!(allowed(&[code]), "{code}");
        }
        for code in [5, 6, 15, 16, 21, 22, 23] {
            assert!(!allowed(&[code]), "{code}");
        }
        for (sub, read) in
            [(0, true), (1, false), (2, true), (3, false), (4, false), (10, false), (11, true), (20, false)]
        {
            assert_eq!(allowed(&[8, 0, sub, 0, 0]), read, "{sub}");
        }
    }

    #[test]
    fn rules_that_cannot_be_used() {
        let error = |json| rights(json).unwrap_err().to_string();
        insta::assert_snapshot!(error(r#"[ { "peer": "com9", "allow": "read" } ]"#), @"rights 1: 'com9' is no IP address, no network like 192.168.1.0/24 and no serial port of this server");
        insta::assert_snapshot!(error(r#"[ { "peer": "10.0.0.0/33", "allow": "read" } ]"#), @"rights 1: /33 is longer than the address");
    }
}
