//! Keyframes, sent a few parts at a time so that no reader's queue overflows.

use super::*;

impl Live {
    /// Sends the next parts of a keyframe, or takes one that is wanted.
    pub(super) fn send_keyframe(&mut self) {
        if self.keyframe_next.is_none() {
            let Some(reason) = self.keyframe_wanted.take() else { return };
            self.engine.take_keyframe(reason);
            self.keyframe_next = Some(0);
            self.keyframe_due_ns = clock::mono_ns() + KEYFRAME_NS;
        }
        let Some(next) = self.keyframe_next else { return };
        let content = self.engine.keyframe();
        let scan = Content::parse(&content[..content.len().min(ipc_types::scan_record::HEAD_BYTES)])
            .map_or(0, |c| c.head.scan);
        let all = parts(content);
        let count = all.len();
        for (i, part) in all.enumerate().skip(next).take(PARTS_PER_TURN) {
            if self.keyframe_port.send_tail(part_header(scan, i, content.len()), part).is_err() {
                self.counters.records_lost += 1;
            }
        }
        self.keyframe_port.ring();
        self.keyframe_next = (next + PARTS_PER_TURN < count).then_some(next + PARTS_PER_TURN);
        if self.keyframe_next.is_none() {
            self.counters.keyframes += 1;
        }
    }
}
