//! Which frames a kernel interface hands to the driver: key `filters`.
//!
//! Filters work in the kernel, so that frames nobody wants cost this process nothing. What they keep back is not on the
//! rail: neither recorder nor `dinrail can dump` sees it. So there is none unless the stack file asks for it.

use std::collections::BTreeSet;

use ipc_types::Stack;
use ipc_types::topic::TopicKind;
use serde::{Deserialize, Deserializer, Serialize, Serializer, de};
use thiserror::Error;

use crate::protocol::frame::{EFF_FLAG, EFF_MASK, SFF_MASK};

/// Most filters of one socket (`CAN_RAW_FILTER_MAX` of Linux).
pub const MAX_FILTERS: usize = 512;

/// A frame passes when the bits of its identifier under the mask are those of the filter. 11-bit and 29-bit identifiers
/// are never mistaken for each other; remote frames pass like data frames, error frames always.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Filter {
    id: u32,
    mask: u32,
}

/// What is wrong with the text of a filter.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum FilterError {
    /// Not hex digits, or too many.
    #[error(
        "filter '{0}' must be 3 hex digits (11 bits) or 8 (29 bits), with a mask as \"1A0:7F0\" or \"18FEF100:1FFFFF00\""
    )]
    Text(String),
    /// A bit of the identifier is under no bit of the mask.
    #[error("filter '{text}' never matches: identifier bits {bits:X} are not in the mask")]
    Never {
        /// As written.
        text: String,
        /// The bits.
        bits: u32,
    },
}

impl Filter {
    /// One identifier.
    pub fn exact(id: u32, extended: bool) -> Self {
        let (flag, mask) = if extended { (EFF_FLAG, EFF_MASK) } else { (0, SFF_MASK) };
        Self { id: id & mask | flag, mask: mask | EFF_FLAG }
    }

    /// Reads `1A0`, `1A0:7F0`, `18FEF100` or `18FEF100:1FFFFF00`.
    pub fn parse(text: &str) -> Result<Self, FilterError> {
        let wrong = || FilterError::Text(text.to_owned());
        let (id, mask) = text.split_once(':').map_or((text, None), |(id, mask)| (id, Some(mask)));
        let (digits, largest, flag) = match id.len() {
            3 => (3, SFF_MASK, 0),
            8 => (8, EFF_MASK, EFF_FLAG),
            _ => return Err(wrong()),
        };
        let number = |text: &str| {
            let hex = text.len() == digits && text.bytes().all(|c| c.is_ascii_hexdigit());
            let number = hex.then(|| u32::from_str_radix(text, 16).ok()).flatten();
            number.filter(|&n| n <= largest).ok_or_else(wrong)
        };
        let id = number(id)?;
        let mask = mask.map_or(Ok(largest), number)?;
        if id & !mask != 0 {
            return Err(FilterError::Never { text: text.to_owned(), bits: id & !mask });
        }
        Ok(Self { id: id | flag, mask: mask | EFF_FLAG })
    }

    /// Whether a frame with this identifier (flags as in [`crate::protocol::Frame::can_id`]) passes.
    pub fn passes(self, can_id: u32) -> bool {
        can_id & self.mask == self.id
    }

    /// As the kernel takes it: identifier and mask.
    pub fn raw(self) -> (u32, u32) {
        (self.id, self.mask)
    }
}

impl std::fmt::Display for Filter {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (width, largest) = if self.id & EFF_FLAG == 0 { (3, SFF_MASK) } else { (8, EFF_MASK) };
        write!(f, "{:0width$X}", self.id & largest)?;
        match self.mask & largest {
            mask if mask == largest => Ok(()),
            mask => write!(f, ":{mask:0width$X}"),
        }
    }
}

/// Key `filters`.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub enum Filters {
    /// Every frame.
    #[default]
    None,
    /// What the readers of the bus say they need, as far as they do.
    Auto,
    /// These.
    List(Vec<Filter>),
}

impl Serialize for Filters {
    fn serialize<S: Serializer>(&self, s: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::None => s.serialize_str("none"),
            Self::Auto => s.serialize_str("auto"),
            Self::List(list) => s.collect_seq(list.iter().map(Filter::to_string)),
        }
    }
}

impl<'de> Deserialize<'de> for Filters {
    fn deserialize<D: Deserializer<'de>>(d: D) -> Result<Self, D::Error> {
        struct Visit;
        impl<'de> de::Visitor<'de> for Visit {
            type Value = Filters;
            fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str(
                    "\"none\", \"auto\", or a list such as [\"1A0\", \"280:780\", \"18FEF100:1FFFFF00\"]",
                )
            }
            fn visit_str<E: de::Error>(self, text: &str) -> Result<Filters, E> {
                match text {
                    "none" => Ok(Filters::None),
                    "auto" => Ok(Filters::Auto),
                    _ => Err(E::invalid_value(de::Unexpected::Str(text), &self)),
                }
            }
            fn visit_seq<A: de::SeqAccess<'de>>(self, mut seq: A) -> Result<Filters, A::Error> {
                let mut list = Vec::new();
                while let Some(text) = seq.next_element::<String>()? {
                    list.push(Filter::parse(&text).map_err(de::Error::custom)?);
                }
                Ok(Filters::List(list))
            }
        }
        d.deserialize_any(Visit)
    }
}

/// What `filters = "auto"` means for a bus of this stack: the identifiers that its readers take, or the first reader
/// that takes more than can be listed.
pub fn derived(stack: &Stack, bus: &str) -> Result<Vec<Filter>, String> {
    let readers = stack.topic(&TopicKind::CanRx.of(bus)).map_or(&[][..], |topic| &topic.readers);
    let mut all = BTreeSet::new();
    for reader in readers {
        let Some(service) = stack.services.iter().find(|s| s.name == *reader) else { continue };
        match needs(&service.kind, &service.config) {
            Some(ids) => all.extend(ids),
            None => return Err(format!("'{reader}' ({}) takes every frame", service.kind)),
        }
    }
    if all.len() > MAX_FILTERS {
        return Err(format!(
            "the readers take {} identifiers, the kernel filters at most {MAX_FILTERS}",
            all.len()
        ));
    }
    if all.is_empty() {
        return Err("no reader names an identifier".to_owned());
    }
    Ok(all.into_iter().collect())
}

/// Identifiers that a service takes, read from its part of the resolved stack; `None`: any.
fn needs(kind: &str, config: &serde_json::Value) -> Option<Vec<Filter>> {
    if kind != "can-io" {
        return None;
    }
    let inputs = config.get("in").map_or(Some(&[][..]), |list| list.as_array().map(Vec::as_slice))?;
    inputs
        .iter()
        .map(|input| {
            let id = input.get("id")?;
            let value = u32::try_from(id.get("value")?.as_u64()?).ok()?;
            let extended = input.get("ext").and_then(serde_json::Value::as_bool);
            let extended = extended.or_else(|| id.get("extended")?.as_bool())?;
            Some(Filter::exact(value, extended))
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use serde_json::json;

    #[test]
    fn what_passes() {
        let table = [
            ("1A0", 0x1A0, true),
            ("1A0", 0x1A1, false),
            ("1A0", 0x8000_01A0, false),
            ("1A0", 0x4000_01A0, true),
            ("1A0:7F0", 0x1AF, true),
            ("1A0:7F0", 0x1B0, false),
            ("000:000", 0x7FF, true),
            ("000:000", 0x8000_0001, false),
            ("18FEF100:1FFFFF00", 0x98FE_F142, true),
            ("18FEF100:1FFFFF00", 0x98FE_F242, false),
            ("00000000:00000000", 0x9FFF_FFFF, true),
        ];
        for (text, can_id, passes) in table {
            assert_eq!(Filter::parse(text).unwrap().passes(can_id), passes, "{text} {can_id:X}");
        }
    }

    #[test]
    fn mistakes_say_what_is_meant() {
        let said = |value| serde_json::from_value::<Filters>(value).unwrap_err().to_string();
        let all = [
            said(json!("all")),
            said(json!(["1A"])),
            said(json!(["1A0:7FFF"])),
            said(json!(["9A0"])),
            said(json!(["1A0:0F0"])),
            said(json!([416])),
        ];
        insta::assert_snapshot!(all.join("\n"), @r#"
        invalid value: string "all", expected "none", "auto", or a list such as ["1A0", "280:780", "18FEF100:1FFFFF00"]
        filter '1A' must be 3 hex digits (11 bits) or 8 (29 bits), with a mask as "1A0:7F0" or "18FEF100:1FFFFF00"
        filter '1A0:7FFF' must be 3 hex digits (11 bits) or 8 (29 bits), with a mask as "1A0:7F0" or "18FEF100:1FFFFF00"
        filter '9A0' must be 3 hex digits (11 bits) or 8 (29 bits), with a mask as "1A0:7F0" or "18FEF100:1FFFFF00"
        filter '1A0:0F0' never matches: identifier bits 100 are not in the mask
        invalid type: integer `416`, expected a string
        "#);
    }

    fn stack(readers: &[(&str, &str, serde_json::Value)]) -> Stack {
        let mut topic = ipc_types::testing::topic(TopicKind::CanRx, "can0");
        topic.readers = readers.iter().map(|(name, _, _)| (*name).to_owned()).collect();
        let service = |(name, kind, config): &(&str, &str, serde_json::Value)| {
            ipc_types::testing::service(name, kind, config.clone(), ipc_types::Wiring::default())
        };
        Stack {
            name: "t".into(),
            file: "t".into(),
            dir: ".".into(),
            text: String::new(),
            build_id: String::new(),
            root: ".".into(),
            prefix: String::new(),
            services: readers.iter().map(service).collect(),
            topics: vec![topic],
        }
    }

    #[test]
    fn derived_from_the_stack() {
        let io = |ids: &[(u32, bool)]| {
            let of =
                |&(value, extended): &(u32, bool)| json!({ "id": { "value": value, "extended": extended } });
            json!({ "in": ids.iter().map(of).collect::<Vec<_>>() })
        };
        let list = |readers: &[_]| {
            derived(&stack(readers), "can0")
                .map(|all| all.iter().map(Filter::to_string).collect::<Vec<_>>().join(" "))
        };
        let two = [
            ("io", "can-io", io(&[(0x1A0, false), (0x2B0, false), (0x1A0, false)])),
            ("more", "can-io", io(&[(0x18FE_F100, true), (0x1A0, true)])),
        ];
        assert_eq!(list(&two), Ok("1A0 2B0 000001A0 18FEF100".to_owned()));
        assert_eq!(
            list(&[two[0].clone(), ("rec", "recorder", json!({}))]),
            Err("'rec' (recorder) takes every frame".to_owned())
        );
        assert_eq!(list(&[]), Err("no reader names an identifier".to_owned()));
        assert!(list(&[("odd", "can-io", json!({ "in": [{ "id": 5 }] }))]).is_err());
    }

    proptest! {
        #[test]
        fn text_round_trip(id in 0u32..=EFF_MASK, mask in 0u32..=EFF_MASK, extended in any::<bool>()) {
            let (width, largest) = if extended { (8, EFF_MASK) } else { (3, SFF_MASK) };
            let text = format!("{:0width$X}:{:0width$X}", id & mask & largest, mask & largest);
            let filter = Filter::parse(&text).unwrap();
            prop_assert_eq!(Filter::parse(&filter.to_string()), Ok(filter));
            let list = Filters::List(vec![filter]);
            let again: Filters = serde_json::from_value(serde_json::to_value(&list).unwrap()).unwrap();
            prop_assert_eq!(again, list);
        }

        #[test]
        fn never_panics(text in "\\PC{0,20}") {
            let _ = Filter::parse(&text);
        }
    }
}
