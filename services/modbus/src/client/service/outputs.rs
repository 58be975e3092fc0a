//! What is written: the image's values while a program runs, else the safe ones.

use super::Service;
use super::runner::{drop_write, set_write};
use ipc_types::clock;
use ipc_types::outputs::{Change, Words};

/// How events call the outputs of this service.
const WORDS: Words =
    Words { entered: "writes went to their safe state", left: "writes follow the image again" };

impl Service {
    pub(super) fn take_image(&mut self) {
        let Self { image, writes, runners, write_slots, .. } = self;
        let now_ns = clock::mono_ns();
        let change = image.take(|q, m| {
            writes.image(q, m, now_ns, |i, pdu| set_write(runners, write_slots, i, pdu, now_ns));
        });
        self.follow(change);
    }

    pub(super) fn writes_due(&mut self, now_ns: u64) -> Option<u64> {
        let Self { writes, runners, write_slots, .. } = self;
        writes.due(now_ns, |i, pdu| set_write(runners, write_slots, i, pdu, now_ns))
    }

    /// Does what a change of the safe state asks for, and tells it.
    pub(super) fn follow(&mut self, change: Option<Change>) {
        let Some(change) = change else { return };
        if change.why.is_some() {
            let now_ns = clock::mono_ns();
            let Self { writes, runners, write_slots, .. } = self;
            writes.safe(|i, pdu| {
                drop_write(runners, write_slots, i);
                if let Some(pdu) = pdu {
                    set_write(runners, write_slots, i, pdu, now_ns);
                }
            });
        }
        change.tell(&mut self.ctx, &WORDS);
    }
}
