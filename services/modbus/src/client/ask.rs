//! One request of any function, as JSON in and JSON out: jobs on the rail, and the command line.
//!
//! A job names what it wants by `do`, and the unit by `unit`:
//!
//! | `do` | keys | function |
//! |---|---|---|
//! | `read` | `table`, `at`, `count` (1) | 1-4 |
//! | `write` | `table`, `at`, `values`, `multiple` (false) | 5, 6, 15, 16 |
//! | `mask` | `at`, `and`, `or` | 22 |
//! | `read_write` | `at`, `count`, `write_at`, `values` | 23 |
//! | `exception_status` | | 7 |
//! | `diagnostics` | `sub`, `data` (0) | 8 |
//! | `event_counter`, `event_log` | | 11, 12 |
//! | `server_id` | | 17 |
//! | `read_file` | `file`, `record`, `count` | 20 |
//! | `write_file` | `file`, `record`, `values` | 21 |
//! | `read_fifo` | `at` | 24 |
//! | `identification` | `code` (1), `object` (0) | 43/14 |
//! | `raw` | `pdu` ("03 00 00 00 01") | any |

use super::image::read_request;
use crate::protocol::client_fit::{Fit, fit};
use crate::protocol::pdu::{
    COIL_ON, Exception, MAX_PDU, MAX_READ_BITS, MAX_READ_WORDS, MAX_READ_WRITE_WORDS, MAX_WRITE_BITS,
    MAX_WRITE_WORDS, function_name,
};
use crate::server::Table;
use serde_json::{Value, json};

/// Every `do`.
pub const KNOWN: &str = "read, write, mask, read_write, exception_status, diagnostics, event_counter, event_log, server_id, read_file, write_file, read_fifo, identification, raw, status";

/// A request that cannot be made.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum AskError {
    #[error("a modbus-client does not know the job '{0}'; it knows {KNOWN}")]
    Unknown(String),
    #[error("the job lacks \"{key}\" ({what})")]
    Lacks { key: &'static str, what: &'static str },
    #[error("\"{key}\": {value} is not {low} to {high}")]
    Range { key: &'static str, value: i64, low: i64, high: i64 },
    #[error("{table} cannot be written; coils and holding_registers can")]
    ReadOnly { table: &'static str },
    #[error("\"pdu\": '{0}' is no list of 1 to 253 hexadecimal bytes")]
    Pdu(String),
}

/// A request PDU.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Ask {
    pdu: [u8; MAX_PDU],
    len: usize,
}

impl Ask {
    fn new(parts: &[&[u8]]) -> Self {
        let mut ask = Self { pdu: [0; MAX_PDU], len: 0 };
        for part in parts {
            let room = part.len().min(MAX_PDU - ask.len);
            ask.pdu[ask.len..ask.len + room].copy_from_slice(&part[..room]);
            ask.len += room;
        }
        ask
    }

    /// Its bytes.
    pub fn pdu(&self) -> &[u8] {
        &self.pdu[..self.len]
    }

    /// The request of a job.
    pub fn from_json(job: &Value) -> Result<Self, AskError> {
        let what =
            job.get("do").and_then(Value::as_str).ok_or(AskError::Lacks { key: "do", what: "a text" })?;
        let at = |key| number(job, key, 0, 65_535, None).map(|n| (n as u16).to_be_bytes());
        Ok(match what {
            "read" => {
                let table = table(job)?;
                let most = if table.is_bits() { MAX_READ_BITS } else { MAX_READ_WORDS };
                let count = number(job, "count", 1, i64::from(most), Some(1))? as u16;
                let at = u16::from_be_bytes(at("at")?);
                Self::new(&[&read_request(table, at, count)])
            }
            "write" => write(job)?,
            "mask" => Self::new(&[&[22], &at("at")?, &at("and")?, &at("or")?]),
            "read_write" => {
                let count = number(job, "count", 1, i64::from(MAX_READ_WORDS), Some(1))? as u16;
                let words = words(job, MAX_READ_WRITE_WORDS)?;
                let quantity = (words.len() as u16 / 2).to_be_bytes();
                let head: [&[u8]; 6] = [
                    &[23],
                    &at("at")?,
                    &count.to_be_bytes(),
                    &at("write_at")?,
                    &quantity,
                    &[words.len() as u8],
                ];
                Self::new(&[head[0], head[1], head[2], head[3], head[4], head[5], &words])
            }
            "exception_status" => Self::new(&[&[7]]),
            "diagnostics" => {
                let data = number(job, "data", 0, 65_535, Some(0))? as u16;
                Self::new(&[&[8], &at("sub")?, &data.to_be_bytes()])
            }
            "event_counter" => Self::new(&[&[11]]),
            "event_log" => Self::new(&[&[12]]),
            "server_id" => Self::new(&[&[17]]),
            "read_file" => {
                let count = (number(job, "count", 1, 123, Some(1))? as u16).to_be_bytes();
                Self::new(&[&[20, 7, 6], &at("file")?, &at("record")?, &count])
            }
            "write_file" => {
                let words = words(job, 122)?;
                let count = (words.len() as u16 / 2).to_be_bytes();
                let len = [21, words.len() as u8 + 7, 6];
                Self::new(&[&len, &at("file")?, &at("record")?, &count, &words])
            }
            "read_fifo" => Self::new(&[&[24], &at("at")?]),
            "identification" => {
                let code = number(job, "code", 1, 4, Some(1))? as u8;
                let object = number(job, "object", 0, 255, Some(0))? as u8;
                Self::new(&[&[43, 14, code, object]])
            }
            "raw" => {
                let text = job
                    .get("pdu")
                    .and_then(Value::as_str)
                    .ok_or(AskError::Lacks { key: "pdu", what: "hexadecimal bytes" })?;
                let bytes = hex(text).filter(|b| (1..=MAX_PDU).contains(&b.len()));
                Self::new(&[&bytes.ok_or_else(|| AskError::Pdu(text.to_owned()))?])
            }
            other => return Err(AskError::Unknown(other.to_owned())),
        })
    }

    /// What an answer says. A broadcast has none.
    pub fn explain(&self, answer: &[u8]) -> Result<Value, String> {
        if answer.is_empty() {
            return Ok(json!({ "broadcast": true }));
        }
        match fit(self.pdu(), answer) {
            Fit::Exception(code) => Err(exception_words(code, self.pdu[0])),
            Fit::No => Err("the answer does not fit the request".to_owned()),
            Fit::Answer => Ok(explain(self.pdu(), answer)),
        }
    }
}

/// Bytes written as `03 00 0A`, with or without spaces.
pub fn hex(text: &str) -> Option<Vec<u8>> {
    let digits: Vec<u8> = text.bytes().filter(|b| !b.is_ascii_whitespace()).collect();
    if !digits.len().is_multiple_of(2) {
        return None;
    }
    digits
        .chunks(2)
        .map(|pair| {
            let pair = std::str::from_utf8(pair).ok().filter(|p| p.bytes().all(|b| b.is_ascii_hexdigit()))?;
            u8::from_str_radix(pair, 16).ok()
        })
        .collect()
}

/// `03 00 0A`.
pub fn hex_text(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02X}")).collect::<Vec<_>>().join(" ")
}

/// An exception in words, with what usually causes it.
pub fn exception_words(code: u8, function: u8) -> String {
    let name = function_name(function & 0x7F).map_or(String::new(), |name| format!(" ({name})"));
    let meaning = match Exception::from_code(code) {
        Some(Exception::IllegalFunction) => "the unit does not support this function",
        Some(Exception::IllegalDataAddress) => "the unit has no such address, or not so many of them",
        Some(Exception::IllegalDataValue) => "the unit does not accept the quantity or value",
        Some(Exception::ServerDeviceFailure) => "the unit failed to carry it out",
        Some(Exception::Acknowledge) => "accepted, the unit needs long for it",
        Some(Exception::ServerDeviceBusy) => "the unit or gateway is busy, try again",
        Some(Exception::MemoryParityError) => "the unit found a damaged file record",
        Some(Exception::GatewayPathUnavailable) => "the gateway has no path to this unit",
        Some(Exception::GatewayTargetFailedToRespond) => "the unit behind the gateway does not answer",
        _ => "not a code of the standard",
    };
    format!("exception {code:02X} to function {}{name}: {meaning}", function & 0x7F)
}

fn number(
    job: &Value,
    key: &'static str,
    low: i64,
    high: i64,
    default: Option<i64>,
) -> Result<i64, AskError> {
    let value = match job.get(key) {
        None => default,
        Some(value) => value.as_i64(),
    };
    let value = value.ok_or(AskError::Lacks { key, what: "a whole number" })?;
    if (low..=high).contains(&value) { Ok(value) } else { Err(AskError::Range { key, value, low, high }) }
}

fn table(job: &Value) -> Result<Table, AskError> {
    let value = job.get("table").cloned().unwrap_or(Value::Null);
    let what = "coils, discrete_inputs, input_registers or holding_registers";
    serde_json::from_value(value).map_err(|_| AskError::Lacks { key: "table", what })
}

/// Values as registers; negative ones as two's complement.
fn words(job: &Value, most: u16) -> Result<Vec<u8>, AskError> {
    let lacks = AskError::Lacks { key: "values", what: "a list of numbers" };
    let values = job.get("values").and_then(Value::as_array).ok_or(lacks.clone())?;
    let count = values.len() as i64;
    if count == 0 || count > i64::from(most) {
        return Err(AskError::Range { key: "values", value: count, low: 1, high: i64::from(most) });
    }
    let mut words = Vec::with_capacity(values.len() * 2);
    for value in values {
        let value = value.as_i64().ok_or(lacks.clone())?;
        if !(-32_768..=65_535).contains(&value) {
            return Err(AskError::Range { key: "values", value, low: -32_768, high: 65_535 });
        }
        words.extend((value as u16).to_be_bytes());
    }
    Ok(words)
}

fn write(job: &Value) -> Result<Ask, AskError> {
    let table = table(job)?;
    let at = (number(job, "at", 0, 65_535, None)? as u16).to_be_bytes();
    let multiple = job.get("multiple").and_then(Value::as_bool).unwrap_or(false);
    match table {
        Table::Coils => {
            let lacks = AskError::Lacks { key: "values", what: "a list of true and false" };
            let values = job.get("values").and_then(Value::as_array).ok_or(lacks.clone())?;
            let count = values.len() as i64;
            if count == 0 || count > i64::from(MAX_WRITE_BITS) {
                return Err(AskError::Range { key: "values", value: count, low: 1, high: 1968 });
            }
            let mut packed = vec![0; values.len().div_ceil(8)];
            for (i, value) in values.iter().enumerate() {
                let on = match (value.as_bool(), value.as_i64()) {
                    (Some(on), _) => on,
                    (None, Some(n @ (0 | 1))) => n == 1,
                    _ => return Err(lacks),
                };
                packed[i / 8] |= u8::from(on) << (i % 8);
            }
            if values.len() == 1 && !multiple {
                let value = if packed[0] == 1 { COIL_ON } else { 0 };
                return Ok(Ask::new(&[&[5], &at, &value.to_be_bytes()]));
            }
            let count = (values.len() as u16).to_be_bytes();
            Ok(Ask::new(&[&[15], &at, &count, &[packed.len() as u8], &packed]))
        }
        Table::HoldingRegisters => {
            let words = words(job, MAX_WRITE_WORDS)?;
            if words.len() == 2 && !multiple {
                return Ok(Ask::new(&[&[6], &at, &words]));
            }
            let count = (words.len() as u16 / 2).to_be_bytes();
            Ok(Ask::new(&[&[16], &at, &count, &[words.len() as u8], &words]))
        }
        other => Err(AskError::ReadOnly { table: other.name() }),
    }
}

fn registers(bytes: &[u8]) -> Vec<u16> {
    bytes.chunks_exact(2).map(|c| u16::from_be_bytes([c[0], c[1]])).collect()
}

/// Printable ASCII as it is, anything else as `\xNN`.
fn text(bytes: &[u8]) -> String {
    bytes.iter().flat_map(|b| std::ascii::escape_default(*b)).map(char::from).collect()
}

/// An answer that fits. Values of bits are 0 and 1.
fn explain(request: &[u8], answer: &[u8]) -> Value {
    let word = |at: usize| answer.get(at..at + 2).map_or(0, |b| u16::from_be_bytes([b[0], b[1]]));
    match answer[0] {
        1 | 2 => {
            let count = usize::from(u16::from_be_bytes([request[3], request[4]]));
            let values: Vec<u8> = (0..count).map(|i| answer[2 + i / 8] >> (i % 8) & 1).collect();
            json!({ "values": values })
        }
        3 | 4 | 23 => json!({ "values": registers(&answer[2..]) }),
        5 | 6 | 22 => json!({ "written": 1 }),
        15 | 16 => json!({ "written": word(3) }),
        7 => json!({ "status": answer[1] }),
        8 => json!({ "sub": word(1), "data": registers(&answer[3..]) }),
        11 => json!({ "busy": word(1) == 0xFFFF, "events": word(3) }),
        12 if answer.len() >= 8 => {
            json!({ "busy": word(2) == 0xFFFF, "events": word(4), "messages": word(6), "log": hex_text(&answer[8..]) })
        }
        17 => {
            // What is in front of the run indicator depends on the device; most have one byte.
            let data = &answer[2..];
            let run = data.get(1).filter(|b| matches!(b, 0 | 0xFF)).map(|b| *b == 0xFF);
            json!({ "id": data.first(), "running": run, "text": text(data.get(2..).unwrap_or_default()), "bytes": hex_text(data) })
        }
        20 if answer.len() >= 4 => json!({ "values": registers(&answer[4..]) }),
        21 => json!({ "written": (answer.len().saturating_sub(9)) / 2 }),
        24 => json!({ "values": registers(answer.get(5..).unwrap_or_default()) }),
        43 if answer.get(1) == Some(&14) => identification(answer),
        _ => json!({ "pdu": hex_text(answer) }),
    }
}

/// Names of the objects of 43/14 (V1.1b3 clause 6.21).
pub fn object_name(id: u8) -> Option<&'static str> {
    Some(match id {
        0 => "VendorName",
        1 => "ProductCode",
        2 => "MajorMinorRevision",
        3 => "VendorUrl",
        4 => "ProductName",
        5 => "ModelName",
        6 => "UserApplicationName",
        _ => return None,
    })
}

fn identification(answer: &[u8]) -> Value {
    let mut objects = Vec::new();
    let mut at = 7;
    while let Some(&[id, len]) = answer.get(at..at + 2) {
        let Some(value) = answer.get(at + 2..at + 2 + usize::from(len)) else { break };
        objects.push(json!({ "id": id, "name": object_name(id), "text": text(value) }));
        at += 2 + usize::from(len);
    }
    json!({ "conformity": answer[3], "more": answer[4] == 0xFF, "next": answer[5], "objects": objects })
}

#[cfg(test)]
#[path = "ask_tests.rs"]
mod tests;
