//! SDO transfers as jobs.

use super::super::book::Book;
use super::{Answer, Asker, Begun, failed};
use crate::config::Number;
use crate::master::network::Network;
use crate::master::plan::encode;
use crate::master::transfers::{JobEnd, Owner, Request as Wanted};
use crate::protocol::data_type::DataType;
use crate::protocol::io::Outbox;
use crate::protocol::sdo::{Direction, Mode, Options};
use crate::service::jobs::{self, FAILED, MAX_FILE, MAX_INLINE, SdoRead, SdoWrite, Transfer};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Transfers under way; more are refused.
const MAX_JOBS: usize = 64;
/// Values of up to so many bytes are not worth a block transfer (protocol switch threshold).
const SHORT: u8 = 21;

/// Transfers and who waits for them.
pub(super) struct SdoJobs {
    timeout_ns: u64,
    asked: BTreeMap<u64, (Asker, Option<PathBuf>)>,
    next_job: u64,
}

impl SdoJobs {
    pub fn new(timeout_ns: u64) -> Self {
        Self { timeout_ns, asked: BTreeMap::new(), next_job: 0 }
    }

    pub fn read(
        &mut self,
        now_ns: u64,
        by: Asker,
        read: SdoRead,
        book: &Book,
        network: &mut Network,
        out: &mut Outbox,
    ) -> Begun {
        let SdoRead { node, object, mode, file } = read;
        let (index, sub) = book.resolve(node, &object).map_err(failed)?;
        let options = read_options(book, node, (index, sub), mode);
        let wanted = Wanted { index, sub, data: None, owner: Owner::Boot, options };
        self.transfer(now_ns, node, wanted, (by, file), network, out)
    }

    pub fn write(
        &mut self,
        now_ns: u64,
        by: Asker,
        write: SdoWrite,
        book: &Book,
        network: &mut Network,
        out: &mut Outbox,
    ) -> Begun {
        let node = write.node;
        let (index, sub) = book.resolve(node, &write.object).map_err(failed)?;
        let options = Options { mode: write.mode.mode(), ..Options::default() };
        let data = data_of(book, (index, sub), write).map_err(failed)?;
        let wanted = Wanted { index, sub, data: Some(data), owner: Owner::Boot, options };
        self.transfer(now_ns, node, wanted, (by, None), network, out)
    }

    fn transfer(
        &mut self,
        now_ns: u64,
        node: u8,
        wanted: Wanted,
        asked: (Asker, Option<PathBuf>),
        network: &mut Network,
        out: &mut Outbox,
    ) -> Begun {
        if self.asked.len() >= MAX_JOBS {
            return Err(failed(format!("{MAX_JOBS} transfers are under way already; try again")));
        }
        network.transfers.add(node, self.timeout_ns);
        self.next_job += 1;
        let request = Wanted { owner: Owner::Job(self.next_job), ..wanted };
        if !network.transfers.ask(now_ns, node, request, out) {
            return Err(failed(format!("too many transfers wait for node {node} already; try again")));
        }
        self.asked.insert(self.next_job, asked);
        Ok(None)
    }

    /// The answer to the job whose transfer ended.
    pub fn ended(&mut self, end: &JobEnd, book: &Book) -> Option<Answer> {
        let (to, file) = self.asked.remove(&end.job)?;
        Some(match value(book, end, file.as_deref()) {
            Ok(value) => Answer { to, code: 0, body: json!({ "ok": value }) },
            Err(body) => Answer { to, code: FAILED, body },
        })
    }
}

/// Long values are read by block, where the EDS says that the value may be long: asking every device for block
/// transfer of four bytes would cost the others an abort.
fn read_options(book: &Book, node: u8, object: (u16, u8), mode: Transfer) -> Options {
    let long = book.entry(node, object).is_some_and(|e| e.data_type.size().is_none());
    match mode {
        Transfer::Auto if long => Options { mode: Mode::Block, threshold: SHORT, ..Options::default() },
        _ => Options { mode: mode.mode(), ..Options::default() },
    }
}

fn data_of(book: &Book, object: (u16, u8), write: SdoWrite) -> Result<Vec<u8>, String> {
    match (write.data, write.value, write.file) {
        (Some(hex), None, None) => {
            jobs::from_hex(&hex).ok_or_else(|| format!("'{hex}' is no even number of hex digits"))
        }
        (None, Some(value), None) => typed(book, write.node, object, &value),
        (None, None, Some(file)) => {
            let told = |e: std::io::Error| format!("{}: {e}", file.display());
            let size = std::fs::metadata(&file).map_err(told)?.len();
            if size > MAX_FILE {
                return Err(format!("{}: {size} bytes, the limit is {MAX_FILE}", file.display()));
            }
            std::fs::read(&file).map_err(told)
        }
        _ => Err("a write has one of \"data\", \"value\" and \"file\"".to_owned()),
    }
}

fn typed(book: &Book, node: u8, (index, sub): (u16, u8), value: &Number) -> Result<Vec<u8>, String> {
    let Some(entry) = book.entry(node, (index, sub)) else {
        return Err(format!(
            "no EDS says what type {index:04X}:{sub:02X} has: write the value with its type, or the bytes in hex"
        ));
    };
    encode(value, entry, node)
}

fn value(book: &Book, end: &JobEnd, file: Option<&Path>) -> Result<Value, Value> {
    let object = book.object(end.node, end.index, end.sub);
    let data = match &end.result {
        Ok(data) => data,
        Err(failure) => {
            let text = format!("node {}, {object}: {failure}", end.node);
            return Err(json!({ "error": text, "abort": failure.abort.0, "timeout": failure.is_timeout() }));
        }
    };
    let mut value = json!({ "object": object, "bytes": end.bytes });
    if end.direction == Direction::Write {
        return Ok(value);
    }
    if let Some(file) = file {
        if let Err(e) = std::fs::write(file, data) {
            return Err(json!({ "error": format!("{}: {e}", file.display()) }));
        }
    } else if data.len() > MAX_INLINE {
        let text = format!("the value has {} bytes: give a file for more than {MAX_INLINE}", data.len());
        return Err(json!({ "error": text }));
    } else {
        value["data"] = json!(jobs::to_hex(data));
    }
    if let Some(entry) = book.entry(end.node, (end.index, end.sub)) {
        value["type"] = json!(entry.data_type.name());
        if let Some(number) = entry.data_type.number(data) {
            value["value"] = json!(number.to_string());
        } else if entry.data_type == DataType::VisibleString {
            value["value"] = json!(String::from_utf8_lossy(data));
        }
    }
    Ok(value)
}
