//! Jobs of the command line and of programs: JSON in, requests to the network out.

use crate::config::{Number, ObjectRef};
use crate::master::lss::LssCall;
use crate::protocol::nmt::NmtCommand;
use crate::protocol::sdo::Mode;
use serde::Deserialize;
use serde_json::Value;
use std::path::PathBuf;

/// Longest value that travels inside of a job or its result; longer ones go by a file.
pub const MAX_INLINE: usize = 1024;
/// Longest value of a file.
pub const MAX_FILE: u64 = 1 << 20;

/// Code of a result: failed.
pub const FAILED: u32 = 1;
/// Code of a result: the time of the job was over.
pub const LATE: u32 = 2;
/// Code of a result: the job is not known.
pub const NOT_SUPPORTED: u32 = 3;

/// What a job asks for.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(tag = "do", rename_all = "snake_case", deny_unknown_fields)]
pub enum Request {
    SdoRead(SdoRead),
    SdoWrite(SdoWrite),
    Nmt {
        command: Nmt,
        /// 0 is all.
        node: u8,
    },
    /// Boots a node again from the beginning.
    Boot {
        node: u8,
    },
    /// How the boot-up of a node goes or went; without node-id: of all.
    BootState {
        #[serde(default)]
        node: Option<u8>,
    },
    Lss(LssCall),
    /// What a node reported, newest first; without node-id how many messages there are of each.
    Emcy {
        #[serde(default)]
        node: Option<u8>,
        /// Leaves out as many messages, without node-id all nodes up to this one: a result holds only so much.
        #[serde(default)]
        skip: usize,
    },
    /// Forgets what a node reported; without node-id: what all did.
    EmcyClear {
        #[serde(default)]
        node: Option<u8>,
    },
    /// State of the network, whole.
    Status,
}

/// Reads an object.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SdoRead {
    pub node: u8,
    pub object: ObjectRef,
    #[serde(default)]
    pub mode: Transfer,
    /// Where the value is written to; without it, it is in the result, in hex.
    #[serde(default)]
    pub file: Option<PathBuf>,
}

/// Writes an object.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SdoWrite {
    pub node: u8,
    pub object: ObjectRef,
    /// In hex.
    #[serde(default)]
    pub data: Option<String>,
    /// A value of the object's type, where the EDS says what it is.
    #[serde(default)]
    pub value: Option<Number>,
    #[serde(default)]
    pub file: Option<PathBuf>,
    #[serde(default)]
    pub mode: Transfer,
}

/// How a value is transferred.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Transfer {
    #[default]
    Auto,
    Segmented,
    Block,
}

impl Transfer {
    pub fn mode(self) -> Mode {
        match self {
            Self::Auto => Mode::Auto,
            Self::Segmented => Mode::Segmented,
            Self::Block => Mode::Block,
        }
    }
}

/// NMT commands by the words of the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Nmt {
    Start,
    Stop,
    Preop,
    ResetNode,
    ResetCommunication,
}

impl Nmt {
    pub fn command(self) -> NmtCommand {
        match self {
            Self::Start => NmtCommand::Start,
            Self::Stop => NmtCommand::Stop,
            Self::Preop => NmtCommand::EnterPreOperational,
            Self::ResetNode => NmtCommand::ResetNode,
            Self::ResetCommunication => NmtCommand::ResetCommunication,
        }
    }
}

/// Reads a job; the error is code and text of its result.
pub fn parse(tail: &[u8]) -> Result<Request, (u32, String)> {
    let job: Value =
        serde_json::from_slice(tail).map_err(|e| (FAILED, format!("the job is no JSON: {e}")))?;
    let what = job.get("do").and_then(Value::as_str).unwrap_or_default().to_owned();
    const KNOWN: [&str; 9] =
        ["sdo_read", "sdo_write", "nmt", "boot", "boot_state", "lss", "emcy", "emcy_clear", "status"];
    if !KNOWN.contains(&what.as_str()) {
        let known = KNOWN.join(", ");
        return Err((
            NOT_SUPPORTED,
            format!("a canopen-master does not know the job '{what}'; it knows {known}"),
        ));
    }
    serde_json::from_value(job).map_err(|e| (FAILED, format!("the job '{what}': {e}")))
}

/// Hex digits as bytes.
pub fn from_hex(text: &str) -> Option<Vec<u8>> {
    let digits: Option<Vec<u32>> =
        text.chars().filter(|c| !c.is_whitespace()).map(|c| c.to_digit(16)).collect();
    let digits = digits.filter(|d| d.len() % 2 == 0)?;
    Some(digits.chunks(2).map(|pair| (pair[0] * 16 + pair[1]) as u8).collect())
}

pub fn to_hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn jobs_are_read_and_refused() {
        let ok = |text: &str| parse(text.as_bytes()).unwrap();
        assert_eq!(
            ok(r#"{"do":"sdo_read","node":5,"object":"1018:01"}"#),
            Request::SdoRead(SdoRead {
                node: 5,
                object: "1018:01".parse().unwrap(),
                mode: Transfer::Auto,
                file: None
            })
        );
        assert_eq!(
            ok(r#"{"do":"nmt","node":0,"command":"reset_communication"}"#),
            Request::Nmt { command: Nmt::ResetCommunication, node: 0 }
        );
        let said: String = [
            "x",
            "{}",
            r#"{"do":"dance"}"#,
            r#"{"do":"nmt","node":0,"command":"jump"}"#,
            r#"{"do":"sdo_read","node":5}"#,
            r#"{"do":"sdo_read","node":500,"object":"1018:01"}"#,
        ]
        .iter()
        .map(|text| format!("{:?}\n", parse(text.as_bytes()).unwrap_err()))
        .collect();
        insta::assert_snapshot!(said);
        assert_eq!(from_hex("0a FF"), Some(vec![10, 255]));
        assert_eq!((from_hex("0"), from_hex("xy")), (None, None));
        assert_eq!(to_hex(&[10, 255]), "0aff");
    }
}
