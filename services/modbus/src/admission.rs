//! Which addresses may connect: one range, or a list of ranges each of which admits or refuses.

use ipc_types::net::IpFilter;
use serde::{Deserialize, Deserializer, Serialize, de};
use std::fmt;
use std::net::{IpAddr, Ipv4Addr};

/// Most rules of a list.
pub const MAX_RULES: usize = 64;

/// One rule of a list.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FilterRule {
    /// 0.0.0.0 leaves the range alone to decide.
    #[serde(default = "no_mask")]
    pub mask: Ipv4Addr,
    pub start: Ipv4Addr,
    pub end: Ipv4Addr,
    /// Whether the addresses are admitted or refused.
    #[serde(default = "yes")]
    pub allow: bool,
}

fn no_mask() -> Ipv4Addr {
    Ipv4Addr::UNSPECIFIED
}

fn yes() -> bool {
    true
}

impl FilterRule {
    fn range(&self) -> IpFilter {
        IpFilter { mask: self.mask, start: self.start, end: self.end }
    }
}

/// The key `filter`: a range, or rules of which the first that matches decides. What no rule matches is refused.
/// Loopback may always connect; other IPv6 addresses may not, except IPv4-mapped ones, which count as IPv4.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(untagged)]
pub enum Filter {
    One(IpFilter),
    Rules(Vec<FilterRule>),
}

impl<'de> Deserialize<'de> for Filter {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Visit;
        impl<'de> de::Visitor<'de> for Visit {
            type Value = Filter;
            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("{ mask, start, end }, or a list of { mask, start, end, allow }")
            }
            fn visit_map<A: de::MapAccess<'de>>(self, map: A) -> Result<Filter, A::Error> {
                IpFilter::deserialize(de::value::MapAccessDeserializer::new(map)).map(Filter::One)
            }
            fn visit_seq<A: de::SeqAccess<'de>>(self, seq: A) -> Result<Filter, A::Error> {
                Vec::deserialize(de::value::SeqAccessDeserializer::new(seq)).map(Filter::Rules)
            }
        }
        deserializer.deserialize_any(Visit)
    }
}

impl Filter {
    /// What is wrong with it, if anything, and the remedy.
    pub fn fault(&self) -> Option<(String, &'static str)> {
        match self {
            Self::One(range) => range.fault().map(|fault| (fault, "exchange start and end, or correct them")),
            Self::Rules(rules) if rules.len() > MAX_RULES => Some((
                format!("filter: {} rules; at most {MAX_RULES} are allowed", rules.len()),
                "join ranges",
            )),
            Self::Rules(rules) if !rules.iter().any(|rule| rule.allow) => Some((
                "filter: no rule admits anybody".to_owned(),
                "end the list with { start = \"0.0.0.0\", end = \"255.255.255.255\" } to admit the rest",
            )),
            Self::Rules(rules) => rules
                .iter()
                .find_map(|rule| rule.range().fault())
                .map(|fault| (fault, "exchange start and end, or correct them")),
        }
    }
}

/// A filter in use; the default admits everybody.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Admission {
    rules: Option<Vec<FilterRule>>,
}

impl Admission {
    /// From the key.
    pub fn new(filter: Option<&Filter>) -> Self {
        let rules = filter.map(|filter| match filter {
            Filter::One(range) => {
                vec![FilterRule { mask: range.mask, start: range.start, end: range.end, allow: true }]
            }
            Filter::Rules(rules) => rules.clone(),
        });
        Self { rules }
    }

    /// Whether this peer may connect.
    pub fn allows(&self, peer: IpAddr) -> bool {
        let Some(rules) = &self.rules else { return true };
        let peer = peer.to_canonical();
        peer.is_loopback()
            || rules.iter().find(|rule| rule.range().allows(peer)).is_some_and(|rule| rule.allow)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_rule_that_matches_decides() {
        let filter: Filter = serde_json::from_str(
            r#"[ { "start": "192.168.1.13", "end": "192.168.1.13", "allow": false },
                 { "mask": "255.255.255.0", "start": "192.168.1.10", "end": "192.168.1.99" },
                 { "start": "10.0.0.0", "end": "10.255.255.255" } ]"#,
        )
        .unwrap();
        assert_eq!(filter.fault(), None);
        let admission = Admission::new(Some(&filter));
        for (peer, allowed) in [
            ("192.168.1.12", true),
            ("192.168.1.13", false),
            ("::ffff:192.168.1.13", false),
            ("192.168.1.100", false),
            ("10.9.9.9", true),
            ("127.0.0.1", true),
            ("::1", true),
            ("fe80::1", false),
        ] {
            assert_eq!(admission.allows(peer.parse().unwrap()), allowed, "{peer}");
        }
        assert!(Admission::default().allows("8.8.8.8".parse().unwrap()));
    }

    #[test]
    fn filters_that_admit_nobody_or_say_too_much() {
        let fault = |json: &str| serde_json::from_str::<Filter>(json).unwrap().fault().unwrap().0;
        insta::assert_snapshot!(fault(r#"[ { "start": "10.0.0.0", "end": "10.0.0.1", "allow": false } ]"#), @"filter: no rule admits anybody");
        insta::assert_snapshot!(fault("[]"), @"filter: no rule admits anybody");
        insta::assert_snapshot!(fault(r#"[ { "start": "10.0.0.9", "end": "10.0.0.1" } ]"#), @"filter: start 10.0.0.9 lies behind end 10.0.0.1: nobody could connect");
        let error = serde_json::from_str::<Filter>("7").unwrap_err().to_string();
        insta::assert_snapshot!(error, @"invalid type: integer `7`, expected { mask, start, end }, or a list of { mask, start, end, allow } at line 1 column 1");
    }
}
