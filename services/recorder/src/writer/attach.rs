//! Files that go with the recording: those of the stack, and the programs that run.

use super::Notice;
use crate::file::RecordingFile;
use crate::format::{self, AttachedFile};
use ipc_types::clock;
use ipc_types::stack::Stack;
use mcap::McapResult;
use std::collections::BTreeSet;
use std::sync::mpsc::Sender;

/// Adds what changed on disk since it was added last.
pub(super) fn attach_changed(
    mcap: &mut RecordingFile,
    files: &mut [AttachedFile],
    notices: &Sender<Notice>,
) -> McapResult<()> {
    let utc = clock::utc_ns().max(0) as u64;
    for file in files {
        match file.read_if_changed() {
            Some(Ok(data)) => mcap.attach(&file.name, format::media_type(&file.name), utc, &data)?,
            Some(Err(message)) => {
                let detail = serde_json::Value::Null;
                let _ = notices.send(Notice { fault: true, message, detail });
            }
            None => {}
        }
    }
    Ok(())
}

/// Adds the compiled programs that the file lacks. One that cannot be read is told, once a file.
pub(super) fn attach_modules(
    mcap: &mut RecordingFile,
    stack: &Stack,
    there: &mut BTreeSet<String>,
    notices: &Sender<Notice>,
) -> McapResult<()> {
    let utc = clock::utc_ns().max(0) as u64;
    for (name, path) in format::modules(stack) {
        if !there.insert(name.clone()) {
            continue;
        }
        match format::read_attachment(&path) {
            Ok(data) => mcap.attach(&name, format::media_type(&name), utc, &data)?,
            Err(message) => {
                let _ = notices.send(Notice { fault: true, message, detail: serde_json::Value::Null });
            }
        }
    }
    Ok(())
}
