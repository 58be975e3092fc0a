//! The messages a verifier needs: scan records and keyframes of one plc, with the programs that stand beside them.

use crate::format::{GAPS_TOPIC, Gaps, META_SEALED};
use crate::reader::{End, Item, ReadError, Recording};
use ipc_types::payload::{ScanPart, from_bytes};
use ipc_types::topic::TopicKind;
use std::collections::BTreeMap;
use std::path::Path;

/// Most bytes, and most, of the attachments that are handed over together.
const MAX_ATTACHED: usize = 256 << 20;
const MAX_ATTACHMENTS: usize = 4096;

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
    integrity: Integrity,
}

/// Scan records and keyframes of one plc service, in the order of the file.
pub fn scan_contents(path: &Path, service: &str) -> Result<ScanContents, ReadError> {
    Ok(ScanContents {
        recording: Recording::open(path)?,
        scan: TopicKind::Scan.of(service),
        keyframe: TopicKind::Keyframe.of(service),
        failed: false,
        integrity: Integrity::default(),
    })
}

impl ScanContents {
    /// How the file ended; complete after the last message.
    pub fn end(&self) -> &End {
        self.recording.end()
    }

    /// What was told about losses so far; complete after the last message.
    pub fn integrity(&self) -> &Integrity {
        &self.integrity
    }
}

impl Iterator for ScanContents {
    type Item = Result<ScanMessage, ReadError>;

    fn next(&mut self) -> Option<Self::Item> {
        while !self.failed {
            match self.recording.next_item() {
                Ok(Some(Item::Message(message))) => {
                    if message.topic() == GAPS_TOPIC {
                        let told = serde_json::from_slice(message.tail).ok();
                        self.integrity.gaps = told.or(self.integrity.gaps.take());
                        continue;
                    }
                    let keyframe = match message.channel.kind {
                        Some(TopicKind::Scan) if message.topic() == self.scan => false,
                        Some(TopicKind::Keyframe) if message.topic() == self.keyframe => true,
                        _ => continue,
                    };
                    let Some(header) = from_bytes::<ScanPart>(message.header) else { continue };
                    self.integrity.scans += u64::from(!keyframe);
                    let (tail, log_time) = (message.tail.to_vec(), message.log_time);
                    return Some(Ok(ScanMessage { keyframe, header, tail, log_time }));
                }
                Ok(Some(Item::Metadata(metadata))) if metadata.name == META_SEALED => {
                    self.integrity.sealed = Some(metadata.entries);
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
    let mut found: Vec<OwnedAttachment> = Vec::new();
    let mut bytes = 0usize;
    while let Some(item) = recording.next_item()? {
        let Item::Attachment(a) = item else { continue };
        if found.iter().any(|f| f.name == a.name && f.data == a.data) {
            continue;
        }
        bytes = bytes.saturating_add(a.data.len());
        if bytes > MAX_ATTACHED || found.len() >= MAX_ATTACHMENTS {
            return Err(ReadError::Attachments { path: path.to_owned(), limit: MAX_ATTACHED });
        }
        found.push(OwnedAttachment {
            name: a.name.to_owned(),
            media_type: a.media_type.to_owned(),
            log_time: a.log_time,
            data: a.data.to_vec(),
        });
    }
    Ok(found)
}

/// What a recording and its recorder tell about its being whole, as far as it concerns one plc service.
#[derive(Debug, Clone, Default)]
pub struct Integrity {
    /// Messages of `<plc>/scan` in the file.
    pub scans: u64,
    /// The recorder's last word, when there is one.
    pub gaps: Option<Gaps>,
    /// [`META_SEALED`], of a file that was cut off and made whole afterwards.
    pub sealed: Option<BTreeMap<String, String>>,
}

impl Integrity {
    /// What is missing, altered or not known to be there, each in a sentence. Empty: every message that the recorder took of
    /// this plc from the file's first to its end is in it as it was.
    pub fn doubts(&self, end: &End, service: &str) -> Vec<String> {
        let mut doubts = Vec::new();
        for damage in &end.damages {
            doubts.push(format!("damaged at byte {}: {}", damage.offset, damage.reason));
        }
        if end.damaged > end.damages.len() as u64 {
            doubts.push(format!("{} more damaged places", end.damaged - end.damages.len() as u64));
        }
        if !end.checked {
            let reason = end.reason.as_deref().unwrap_or("no checksum stands over all of it");
            doubts.push(format!("it ends at byte {}, {} bytes unread: {reason}", end.offset, end.unread));
        }
        if end.unchecked > 0 {
            doubts.push(format!("{} messages stand in it without a checksum", end.unchecked));
        }
        if let Some(sealed) = &self.sealed {
            let of = |key: &str| sealed.get(key).map_or("?", String::as_str);
            doubts.push(format!(
                "it was cut off and made whole afterwards, without {} bytes: {}; what followed is not known",
                of("bytes_lost"),
                of("reason")
            ));
        }
        let Some(gaps) = self.gaps.as_ref().filter(|g| g.last) else {
            if self.sealed.is_none() && end.checked {
                doubts.push("the recorder's last word is missing".to_owned());
            }
            return doubts;
        };
        for topic in [TopicKind::Scan.of(service), TopicKind::Keyframe.of(service)] {
            let missed = gaps.topics.get(&topic).map_or(0, |g| g.missed());
            if missed > 0 {
                doubts.push(format!("the recorder missed {missed} messages of {topic}"));
            }
        }
        let told = gaps.topics.get(&TopicKind::Scan.of(service)).map_or(0, |g| g.recorded);
        if told != self.scans {
            doubts.push(format!(
                "{} messages of the scans stand in it, of {told} that were recorded",
                self.scans
            ));
        }
        doubts
    }
}
