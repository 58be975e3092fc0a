//! A device's boot-up message goes before everything that the device sends after it. Sans-I/O.
//!
//! The driver sends by CAN identifier, and nearly every other identifier of a device is lower than that of its error
//! control: an SDO answer would overtake the boot-up message, and the master would take the device for one that was
//! reset once more. So frames wait until the message was seen on the bus.

use ipc_types::payload::CanFrame;

/// So long the echo is awaited at most: the driver itself throws frames away after 2 s.
const ECHO_NS: u64 = 1_000_000_000;

/// See the module.
#[derive(Debug, Default)]
pub(super) struct BootUpFirst {
    until_ns: Option<u64>,
}

impl BootUpFirst {
    pub(super) fn is_boot_up(frame: &CanFrame, error_control: u32) -> bool {
        frame.can_id == error_control && frame.payload() == [0]
    }

    /// How many of the device's frames may go now, counted from the first. `error_control`: its identifier.
    pub(super) fn pass(&mut self, now_ns: u64, error_control: u32, frames: &[CanFrame]) -> usize {
        if self.until_ns.is_some_and(|until_ns| now_ns < until_ns) {
            return 0;
        }
        let boot_up = frames.iter().position(|frame| Self::is_boot_up(frame, error_control));
        self.until_ns = boot_up.map(|_| now_ns.saturating_add(ECHO_NS));
        boot_up.map_or(frames.len(), |at| at + 1)
    }

    /// The message was on the bus, or will never be.
    pub(super) fn done(&mut self) {
        self.until_ns = None;
    }

    /// When waiting frames go all the same.
    pub(super) fn next_ns(&self) -> Option<u64> {
        self.until_ns
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const OWN: u32 = 0x705;

    fn frames(ids: &[(u32, u8)]) -> Vec<CanFrame> {
        ids.iter().map(|&(id, byte)| CanFrame::classic(id, &[byte])).collect()
    }

    #[test]
    fn nothing_goes_behind_a_boot_up_message_until_it_was_on_the_bus() {
        let mut first = BootUpFirst::default();
        // A heartbeat, and the boot-up message of another, are none.
        assert_eq!(first.pass(1, OWN, &frames(&[(OWN, 5), (0x706, 0), (0x585, 0)])), 3);
        assert_eq!(first.next_ns(), None);
        assert_eq!(first.pass(2, OWN, &frames(&[(0x185, 1), (OWN, 0), (0x585, 0), (0x85, 0)])), 2);
        assert_eq!(first.next_ns(), Some(2 + ECHO_NS));
        let rest = frames(&[(0x585, 0), (0x85, 0), (OWN, 0), (0x585, 1)]);
        assert_eq!(first.pass(3, OWN, &rest), 0);
        first.done();
        // Reset again meanwhile.
        assert_eq!(first.pass(4, OWN, &rest), 3);
        assert_eq!(first.pass(4 + ECHO_NS - 1, OWN, &rest[3..]), 0);
        // Its echo never came: not for ever.
        assert_eq!(first.pass(4 + ECHO_NS, OWN, &rest[3..]), 1);
        assert_eq!(first.next_ns(), None);
    }

    #[test]
    fn an_empty_outbox_is_nothing_to_wait_for() {
        let mut first = BootUpFirst::default();
        assert_eq!((first.pass(1, OWN, &[]), first.next_ns()), (0, None));
    }
}
