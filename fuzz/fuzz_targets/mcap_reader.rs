//! Recordings: any bytes behind MCAP's magic are read to their end; schemas and scan records in them too.

#![no_main]

use dinrail_recorder::reader::Item;
use dinrail_recorder::ros1::Layout;
use dinrail_recorder::{ReadError, Recording};
use ipc_types::payload::{ScanPart, from_bytes};
use ipc_types::scan_record::{Content, Joiner, MAX_KEYFRAME_BYTES};
use ipc_types::topic::TopicKind;
use libfuzzer_sys::fuzz_target;
use std::path::Path;

fuzz_target!(|data: &[u8]| {
    let mut recording = match Recording::from_bytes(Path::new("fuzz.mcap"), data.to_vec()) {
        Ok(recording) => recording,
        Err(ReadError::NotMcap { .. }) => return,
        Err(error) => panic!("memory cannot fail: {error}"),
    };
    let mut joiner = Joiner::new(MAX_KEYFRAME_BYTES);
    while let Some(item) = recording.next_item().unwrap() {
        let Item::Message(message) = item else { continue };
        assert_eq!(message.header.len() + message.tail.len(), message.data.len());
        if let Some(layout) = std::str::from_utf8(&message.channel.schema).ok().and_then(Layout::parse) {
            let _ = layout.decode(message.data);
        }
        if let (Some(TopicKind::Scan), Some(header)) =
            (message.channel.kind, from_bytes::<ScanPart>(message.header))
            && let Some(whole) = joiner.push(&header, message.tail).whole
            && let Ok(content) = Content::parse(whole.bytes)
        {
            content.sections().for_each(drop);
        }
    }
    let end = recording.end();
    assert!(end.offset <= data.len() as u64);
    assert!(end.damages.len() as u64 <= end.damaged);
    assert!(recording.next_item().unwrap().is_none(), "an end is an end");
});
