//! The key `on_stop` of the stack file: a word, or a table with values.

use serde::de::{self, Deserialize, Deserializer};
use serde::{Deserialize as Derive, Serialize};
use std::fmt;
use std::marker::PhantomData;

/// The words that a service's `on_stop` knows.
pub trait StopWord: de::DeserializeOwned {
    /// Every form of the key, for the message about a wrong one: `"hold" or { values = [...] }`.
    const EXPECTED: &'static str;
}

/// The safe state of outputs: one of the words `W`, or `{ values = [...] }` with values `V`.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(untagged)]
pub enum OnStop<W, V> {
    Word(W),
    Values(StopValues<V>),
}

/// The table form of [`OnStop`].
#[derive(Debug, Clone, PartialEq, Serialize, Derive)]
#[serde(deny_unknown_fields)]
pub struct StopValues<V> {
    pub values: Vec<V>,
}

impl<W: Default, V> Default for OnStop<W, V> {
    fn default() -> Self {
        Self::Word(W::default())
    }
}

impl<'de, W: StopWord, V: Deserialize<'de>> Deserialize<'de> for OnStop<W, V> {
    fn deserialize<D: Deserializer<'de>>(d: D) -> Result<Self, D::Error> {
        struct Visit<W, V>(PhantomData<(W, V)>);
        impl<'de, W: StopWord, V: Deserialize<'de>> de::Visitor<'de> for Visit<W, V> {
            type Value = OnStop<W, V>;
            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(W::EXPECTED)
            }
            fn visit_str<E: de::Error>(self, text: &str) -> Result<Self::Value, E> {
                W::deserialize(de::value::StrDeserializer::<E>::new(text))
                    .map(OnStop::Word)
                    .map_err(|_| E::invalid_value(de::Unexpected::Str(text), &self))
            }
            // A derived untagged enum would swallow which key of the table is unknown.
            fn visit_map<A: de::MapAccess<'de>>(self, map: A) -> Result<Self::Value, A::Error> {
                StopValues::deserialize(de::value::MapAccessDeserializer::new(map)).map(OnStop::Values)
            }
        }
        d.deserialize_any(Visit(PhantomData))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Derive)]
    #[serde(rename_all = "snake_case")]
    enum Word {
        #[default]
        Zero,
        NotAvailable,
    }

    impl StopWord for Word {
        const EXPECTED: &'static str = "\"zero\", \"not_available\" or { values = [...] }";
    }

    type Key = OnStop<Word, f64>;

    #[test]
    fn both_forms_are_read_again_as_written() {
        assert_eq!(Key::default(), OnStop::Word(Word::Zero));
        for (text, value) in [
            (json!("not_available"), OnStop::Word(Word::NotAvailable)),
            (json!({ "values": [1.5, -2.0] }), OnStop::Values(StopValues { values: vec![1.5, -2.0] })),
        ] {
            assert_eq!(serde_json::from_value::<Key>(text.clone()).unwrap(), value);
            assert_eq!(serde_json::to_value(&value).unwrap(), text);
        }
    }

    #[test]
    fn a_wrong_one_is_named() {
        let said = |value| serde_json::from_value::<Key>(value).unwrap_err().to_string();
        let forms = Word::EXPECTED;
        for (value, message) in [
            (json!("off"), format!("invalid value: string \"off\", expected {forms}")),
            (json!(0), format!("invalid type: integer `0`, expected {forms}")),
            (json!({ "valeus": [1] }), "unknown field `valeus`, expected `values`".to_owned()),
            (json!({}), "missing field `values`".to_owned()),
            (json!({ "values": ["x"] }), "invalid type: string \"x\", expected f64".to_owned()),
        ] {
            assert_eq!(said(value), message);
        }
    }
}
