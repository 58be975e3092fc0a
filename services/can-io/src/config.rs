//! The service's table of the stack file.

use ipc_types::outputs::{self, STALE_AFTER, StopWord};
use ipc_types::units::Span;
use serde::{Deserialize, Deserializer, Serialize, de};

pub use ipc_types::outputs::SafeOn;

use crate::protocol::signal::ByteOrder;
use crate::protocol::value::IecType;

/// Most `[[service.in]]` of one service.
pub const MAX_INPUTS: usize = 1024;
/// Most `[[service.out]]` of one service.
pub const MAX_OUTPUTS: usize = 256;
/// Most signals of one frame sent.
pub const MAX_SIGNALS: usize = 64;

/// A service of kind `can-io`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// The can service. Default: the only one of the stack.
    #[serde(default)]
    pub bus: Option<String>,
    /// The plc service. Default: the only one of the stack.
    #[serde(default)]
    pub plc: Option<String>,
    /// Take frames that the stack itself sent. Default false.
    #[serde(default)]
    pub echo: bool,
    /// Age of the image above which outputs go to their safe state. Default 200ms.
    #[serde(default = "default_stale_after")]
    pub stale_after: Span,
    /// States of the plc in which outputs go to their safe state. Default: all three. A stale image always does.
    #[serde(default = "default_safe_on")]
    pub safe_on: Vec<SafeOn>,
    /// Signals taken from the bus.
    #[serde(default, rename = "in")]
    pub inputs: Vec<Input>,
    /// Frames sent.
    #[serde(default, rename = "out")]
    pub outputs: Vec<Output>,
}

/// An identifier: a number, or hex text such as `"0x123"` or `"18FEF100"`. Eight digits mean 29 bits.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Id {
    /// Bare identifier.
    pub value: u32,
    /// Written with eight hex digits, or above 7FF.
    pub extended: bool,
}

impl<'de> Deserialize<'de> for Id {
    fn deserialize<D: Deserializer<'de>>(d: D) -> Result<Self, D::Error> {
        #[derive(Deserialize)]
        #[serde(untagged, expecting = "an identifier such as 0x123 or \"18FEF100\"")]
        enum Form {
            Number(u32),
            Text(String),
            // What a serialized `Id` looks like in the resolved stack.
            Resolved { value: u32, extended: bool },
        }
        match Form::deserialize(d)? {
            Form::Number(value) => Ok(Self { value, extended: value > 0x7FF }),
            Form::Resolved { value, extended } => Ok(Self { value, extended }),
            Form::Text(text) => {
                let digits = text.strip_prefix("0x").or_else(|| text.strip_prefix("0X")).unwrap_or(&text);
                let hex =
                    !digits.is_empty() && digits.len() <= 8 && digits.bytes().all(|c| c.is_ascii_hexdigit());
                let value = hex.then(|| u32::from_str_radix(digits, 16).ok()).flatten();
                let value = value.ok_or_else(|| {
                    de::Error::custom(format!("identifier '{text}' must be 1 to 8 hex digits"))
                })?;
                Ok(Self { value, extended: digits.len() == 8 || value > 0x7FF })
            }
        }
    }
}

/// One `[[service.in]]`: a signal taken from the bus.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Input {
    /// Identifier of the frame.
    pub id: Id,
    /// True: 29 bits. Default: by the identifier.
    #[serde(default)]
    pub ext: Option<bool>,
    /// First bit in DBC numbering.
    pub start: u32,
    /// Length in bits, 1 - 64.
    pub len: u32,
    /// Default "intel".
    #[serde(default)]
    pub order: ByteOrder,
    /// Two's complement. Default false.
    #[serde(default)]
    pub signed: bool,
    /// IEEE 754 with 32 or 64 bits. Default false.
    #[serde(default)]
    pub float: bool,
    /// Value = raw * scale + offset. Default 1.
    #[serde(default = "one")]
    pub scale: f64,
    /// Default 0.
    #[serde(default)]
    pub offset: f64,
    /// Place in %I.
    pub to: String,
    /// Default: by the width of `to` and `signed`.
    #[serde(default, rename = "type")]
    pub iec: Option<IecType>,
    /// Name of a global variable for the program.
    #[serde(default)]
    pub symbol: Option<String>,
    /// Older values are bad. Default: never.
    #[serde(default)]
    pub timeout: Option<Span>,
    /// Value while bad. Default "hold".
    #[serde(default)]
    pub on_bad: OnBadValue,
    /// %IB that shows the quality to the program.
    #[serde(default)]
    pub status_to: Option<String>,
}

/// `"hold"`, `"zero"` or a number.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(untagged, expecting = "\"hold\", \"zero\" or a number")]
pub enum OnBadValue {
    /// A substitute, in the unit of the value.
    Value(f64),
    /// The word.
    Word(OnBadWord),
}

impl Default for OnBadValue {
    fn default() -> Self {
        Self::Word(OnBadWord::Hold)
    }
}

/// Words of [`OnBadValue`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum OnBadWord {
    /// The last value stays.
    Hold,
    /// All bits 0.
    Zero,
}

/// One `[[service.out]]`: a frame sent.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Output {
    /// Identifier of the frame.
    pub id: Id,
    /// True: 29 bits. Default: by the identifier.
    #[serde(default)]
    pub ext: Option<bool>,
    /// Bytes of the frame: 0 - 8, for CAN FD also 12, 16, 20, 24, 32, 48, 64.
    pub dlc: u32,
    /// CAN FD frame. Default: when `dlc` is above 8.
    #[serde(default)]
    pub fd: Option<bool>,
    /// CAN FD with bit rate switch. Default false.
    #[serde(default)]
    pub brs: bool,
    /// When it is sent.
    pub mode: Mode,
    /// For `cyclic`: 1ms or more.
    #[serde(default)]
    pub period: Option<Span>,
    /// For `on_change`: least time between two frames. Default 0.
    #[serde(default = "zero_span")]
    pub inhibit: Span,
    /// Bits that no signal covers: byte 0 - 255. Default 0.
    #[serde(default)]
    pub fill: u8,
    /// Safe state. Default "silent".
    #[serde(default)]
    pub on_stop: OnStop,
    /// Signals in it.
    #[serde(default)]
    pub signals: Vec<OutputSignal>,
}

/// When a frame is sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Mode {
    /// When a bit of it changed after a scan.
    OnChange,
    /// Every `period`.
    Cyclic,
}

/// A signal of a frame sent.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OutputSignal {
    /// First bit in DBC numbering.
    pub start: u32,
    /// Length in bits, 1 - 64.
    pub len: u32,
    /// Default "intel".
    #[serde(default)]
    pub order: ByteOrder,
    /// Two's complement. Default false.
    #[serde(default)]
    pub signed: bool,
    /// IEEE 754 with 32 or 64 bits. Default false.
    #[serde(default)]
    pub float: bool,
    /// Value = raw * scale + offset. Default 1.
    #[serde(default = "one")]
    pub scale: f64,
    /// Default 0.
    #[serde(default)]
    pub offset: f64,
    /// Place in %Q or %M.
    pub from: String,
    /// Default: by the width of `from` and `signed`.
    #[serde(default, rename = "type")]
    pub iec: Option<IecType>,
    /// Name of a global variable for the program.
    #[serde(default)]
    pub symbol: Option<String>,
}

/// Safe state of a frame: a word, or values of the signals, in their order and unit.
pub type OnStop = outputs::OnStop<OnStopWord, f64>;

/// The table form of [`OnStop`]: one number per signal.
pub type StopValues = outputs::StopValues<f64>;

/// Words of [`OnStop`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OnStopWord {
    /// Nothing is sent: the receiver's own timeout fires.
    #[default]
    Silent,
    /// Cyclic frames go on with the last values.
    Hold,
    /// All bits of all signals are 1 (J1939: not available).
    NotAvailable,
}

impl StopWord for OnStopWord {
    const EXPECTED: &'static str = "\"silent\", \"hold\", \"not_available\" or { values = [...] }";
}

fn one() -> f64 {
    1.0
}
fn zero_span() -> Span {
    Span(0)
}
fn default_stale_after() -> Span {
    STALE_AFTER
}
fn default_safe_on() -> Vec<SafeOn> {
    SafeOn::ALL.to_vec()
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn identifiers() {
        let id = |value: serde_json::Value| serde_json::from_value::<Id>(value);
        for (value, expected) in [
            (json!(0x123), (0x123, false)),
            (json!(0x18FE_F100), (0x18FE_F100, true)),
            (json!("0x123"), (0x123, false)),
            (json!("7ff"), (0x7FF, false)),
            (json!("800"), (0x800, true)),
            (json!("00000123"), (0x123, true)),
            (json!("18FEF100"), (0x18FE_F100, true)),
        ] {
            let id = id(value.clone()).unwrap();
            assert_eq!((id.value, id.extended), expected, "{value}");
        }
        for value in [json!(-1), json!("0x"), json!("123456789"), json!("xyz"), json!(1.5), json!([1])] {
            assert!(id(value.clone()).is_err(), "{value}");
        }
    }

    #[test]
    fn what_is_written_is_read_again() {
        let text = json!({
            "bus": "can0",
            "in": [
                { "id": "00000123", "start": 7, "len": 16, "order": "motorola", "signed": true, "scale": 0.1,
                  "to": "%IW0", "type": "INT", "symbol": "T", "timeout": "100ms", "on_bad": 5.5, "status_to": "%IB10" },
                { "id": 1, "start": 0, "len": 1, "to": "%IX2.0", "on_bad": "zero" },
                { "id": 1, "start": 1, "len": 1, "to": "%IX2.1", "on_bad": "hold" },
                { "id": 1, "start": 2, "len": 1, "to": "%IX2.2" },
            ],
            "out": [
                { "id": 2, "dlc": 8, "mode": "cyclic", "period": "10ms", "on_stop": { "values": [1.5] },
                  "signals": [{ "start": 0, "len": 8, "from": "%QB0", "type": "USINT" }] },
                { "id": 3, "dlc": 8, "mode": "on_change", "inhibit": "5ms", "on_stop": "not_available" },
            ],
        });
        let config: Config = serde_json::from_value(text).unwrap();
        assert_eq!(config.stale_after.ns(), 200_000_000);
        assert_eq!(config.inputs[0].on_bad, OnBadValue::Value(5.5));
        assert_eq!(config.outputs[1].on_stop, OnStop::Word(OnStopWord::NotAvailable));
        // The resolved stack holds the table as JSON: reading it again must give the same.
        let again: Config = serde_json::from_value(serde_json::to_value(&config).unwrap()).unwrap();
        assert_eq!(again, config);
    }

    #[test]
    fn a_bad_safe_state_is_named() {
        let said = |value| serde_json::from_value::<OnStop>(value).unwrap_err().to_string();
        let all = [said(json!("off")), said(json!(0)), said(json!({ "valeus": [1] })), said(json!({}))];
        insta::assert_snapshot!(all.join("\n"), @r#"
        invalid value: string "off", expected "silent", "hold", "not_available" or { values = [...] }
        invalid type: integer `0`, expected "silent", "hold", "not_available" or { values = [...] }
        unknown field `valeus`, expected `values`
        missing field `values`
        "#);
    }

    #[test]
    fn unknown_keys_are_refused() {
        for value in [
            json!({ "buss": "can0" }),
            json!({ "in": [{ "id": 1, "start": 0, "len": 1, "to": "%IX0.0", "timout": "1s" }] }),
            json!({ "out": [{ "id": 1, "dlc": 8, "mode": "sometimes" }] }),
            json!({ "out": [{ "id": 1, "dlc": 8, "mode": "cyclic", "on_stop": { "valeus": [1] } }] }),
            json!({ "out": [{ "id": 1, "dlc": 8, "mode": "cyclic", "on_stop": "off" }] }),
            json!({ "in": [{ "id": 1, "start": 0, "len": 1, "to": "%IX0.0", "type": "STRING" }] }),
        ] {
            assert!(serde_json::from_value::<Config>(value.clone()).is_err(), "{value}");
        }
    }
}
