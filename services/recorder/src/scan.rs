//! The messages a verifier needs: scan records and keyframes of one plc, with the programs that stand beside them.

use crate::reader::{End, Item, ReadError, Recording};
use ipc_types::payload::{ScanPart, from_bytes};
use ipc_types::topic::TopicKind;
use std::path::Path;

/// One message of `<plc>/scan` or `<plc>/keyframe`, in the order of the file. Parts are joined by
/// `ipc_types::scan_record`.
#[derive(Debug, Clone, PartialEq)]
pub struct ScanMessage {
    /// From `<plc>/keyframe`.
    pub keyframe: bool,
    pub header: ScanPart,
    pub tail: Vec<u8>,
    /// UTC in ns.
    pub log_time: u64,
}

/// A file that stands in the recording.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OwnedAttachment {
    pub name: String,
    pub media_type: String,
    pub log_time: u64,
    pub data: Vec<u8>,
}

/// Iterator of [`scan_contents`].
pub struct ScanContents {
    recording: Recording,
    scan: String,
    keyframe: String,
    failed: bool,
}

/// Scan records and keyframes of one plc service, in the order of the file.
pub fn scan_contents(path: &Path, service: &str) -> Result<ScanContents, ReadError> {
    Ok(ScanContents {
        recording: Recording::open(path)?,
        scan: TopicKind::Scan.of(service),
        keyframe: TopicKind::Keyframe.of(service),
        failed: false,
    })
}

impl ScanContents {
    /// How the file ended; complete after the last message.
    pub fn end(&self) -> &End {
        self.recording.end()
    }
}

impl Iterator for ScanContents {
    type Item = Result<ScanMessage, ReadError>;

    fn next(&mut self) -> Option<Self::Item> {
        while !self.failed {
            match self.recording.next_item() {
                Ok(Some(Item::Message(message))) => {
                    let keyframe = match message.channel.kind {
                        Some(TopicKind::Scan) if message.topic() == self.scan => false,
                        Some(TopicKind::Keyframe) if message.topic() == self.keyframe => true,
                        _ => continue,
                    };
                    let Some(header) = from_bytes::<ScanPart>(message.header) else { continue };
                    let (tail, log_time) = (message.tail.to_vec(), message.log_time);
                    return Some(Ok(ScanMessage { keyframe, header, tail, log_time }));
                }
                Ok(Some(_)) => {}
                Ok(None) => return None,
                Err(error) => {
                    self.failed = true;
                    return Some(Err(error));
                }
            }
        }
        None
    }
}

/// Services whose scan records stand in the file, in the order of their channels.
pub fn scanned_services(path: &Path) -> Result<Vec<String>, ReadError> {
    let mut recording = Recording::open(path)?;
    while recording.next_item()?.is_some() {}
    let suffix = format!("/{}", TopicKind::Scan.row().suffix);
    let scanned = recording.channels().filter(|c| c.kind == Some(TopicKind::Scan));
    Ok(scanned.filter_map(|c| c.topic.strip_suffix(&suffix)).map(str::to_owned).collect())
}

/// All files that stand in the recording, in its order; one that changed while it was recorded stands twice.
pub fn attachments(path: &Path) -> Result<Vec<OwnedAttachment>, ReadError> {
    let mut recording = Recording::open(path)?;
    let mut found = Vec::new();
    while let Some(item) = recording.next_item()? {
        if let Item::Attachment(a) = item {
            found.push(OwnedAttachment {
                name: a.name.to_owned(),
                media_type: a.media_type.to_owned(),
                log_time: a.log_time,
                data: a.data.to_vec(),
            });
        }
    }
    Ok(found)
}
