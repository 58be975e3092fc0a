//! Emergency messages: what nodes reported, kept for whoever asks.

use super::{Event, Network, Sign};
use crate::protocol::emcy::{Emcy, register};
use std::collections::VecDeque;

/// Messages kept of each node; the oldest goes first, and is counted.
pub const KEPT: usize = 16;
/// Emergency code of a device that hears its own identifiers (CiA 301 V4.2, table 26).
const COLLISION: u16 = 0x8150;

/// What ended an error.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum ResetBy {
    /// EMCY 0000h.
    ErrorReset,
    /// The node booted: it begins without errors and reports those that are still there again.
    BootUp,
}

/// One message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EmcyEntry {
    /// When it was on the bus.
    pub t_ns: u64,
    pub emcy: Emcy,
    /// Since when the error is gone, and how that is known.
    pub reset: Option<(u64, ResetBy)>,
}

/// The messages of one node-id.
#[derive(Debug, Clone, Default)]
pub struct NodeEmcys {
    /// Oldest first.
    entries: VecDeque<EmcyEntry>,
    /// Messages since the start of the master, error resets not counted.
    pub seen: u64,
    /// Messages that newer ones pushed out.
    pub dropped: u64,
}

impl NodeEmcys {
    /// Newest first.
    pub fn entries(&self) -> impl Iterator<Item = &EmcyEntry> {
        self.entries.iter().rev()
    }
    /// Errors that are still there, as far as they are kept.
    pub fn active(&self) -> usize {
        self.entries.iter().filter(|e| e.reset.is_none()).count()
    }

    fn take(&mut self, t_ns: u64, emcy: Emcy) {
        self.seen += 1;
        if self.entries.len() == KEPT {
            self.entries.pop_front();
            self.dropped += 1;
        }
        self.entries.push_back(EmcyEntry { t_ns, emcy, reset: None });
    }

    /// EMCY 0000h: with an empty register everything is gone, otherwise what no bit that is left stands for (CiA 301
    /// V4.2, 7.2.7.1), and the error whose code the first two bytes repeat, as slaves of this project do.
    fn error_reset(&mut self, t_ns: u64, emcy: Emcy) {
        let left = emcy.register & !register::GENERIC;
        let named = u16::from_le_bytes([emcy.info[0], emcy.info[1]]);
        for entry in self.entries.iter_mut().filter(|e| e.reset.is_none()) {
            let own = entry.emcy.register & !register::GENERIC;
            let covered = own != 0 && own & left == 0;
            if emcy.register == 0 || covered || entry.emcy.code == named {
                entry.reset = Some((t_ns, ResetBy::ErrorReset));
            }
        }
    }

    fn booted(&mut self, t_ns: u64) {
        for entry in self.entries.iter_mut().filter(|e| e.reset.is_none()) {
            entry.reset = Some((t_ns, ResetBy::BootUp));
        }
    }
}

/// The messages of all node-ids, those of nodes that the stack file does not name too.
#[derive(Debug)]
pub struct EmcyLog {
    nodes: Vec<NodeEmcys>,
}

impl Default for EmcyLog {
    fn default() -> Self {
        // Room for all: nothing is allocated when a message comes.
        let empty = || NodeEmcys { entries: VecDeque::with_capacity(KEPT), ..NodeEmcys::default() };
        Self { nodes: (0..128).map(|_| empty()).collect() }
    }
}

impl EmcyLog {
    pub fn of(&self, node: u8) -> Option<&NodeEmcys> {
        self.nodes.get(usize::from(node)).filter(|_| node > 0)
    }
    /// Forgets what a node reported, 0: what all did. Tells how many messages that were.
    pub fn clear(&mut self, node: u8) -> usize {
        let all = self.nodes.iter_mut().enumerate().filter(|(id, _)| node == 0 || *id == usize::from(node));
        all.map(|(_, log)| {
            let n = log.entries.len();
            log.entries.clear();
            (log.seen, log.dropped) = (0, 0);
            n
        })
        .sum()
    }
    pub(super) fn booted(&mut self, t_ns: u64, node: u8) {
        if let Some(log) = self.nodes.get_mut(usize::from(node)) {
            log.booted(t_ns);
        }
    }
    fn take(&mut self, t_ns: u64, node: u8, emcy: Emcy) {
        let Some(log) = self.nodes.get_mut(usize::from(node)) else { return };
        match emcy.code {
            0x0000..=0x00FF => log.error_reset(t_ns, emcy),
            _ => log.take(t_ns, emcy),
        }
    }
}

impl Network {
    pub(super) fn on_emcy(&mut self, t_ns: u64, id: u8, payload: &[u8]) {
        let &[low, high, register, ref vendor @ ..] = payload else { return };
        let mut info = [0; 5];
        let n = vendor.len().min(5);
        info[..n].copy_from_slice(&vendor[..n]);
        let code = u16::from_le_bytes([low, high]);
        self.emcys.take(t_ns, id, Emcy { code, register, info });
        let Some(i) = self.find(id) else { return };
        let node = &mut self.nodes[i];
        node.emcys += 1;
        node.last_emcy = Some((code, register));
        self.tell(Event::Emcy { node: id, code, register, vendor: info });
        if code == COLLISION {
            self.tell_duplicate(i, Sign::Emcy);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn emcy(code: u16, register: u8, info: [u8; 5]) -> Emcy {
        Emcy { code, register, info }
    }

    fn states(log: &EmcyLog, node: u8) -> Vec<(u16, Option<ResetBy>)> {
        log.of(node).unwrap().entries().map(|e| (e.emcy.code, e.reset.map(|(_, by)| by))).collect()
    }

    #[test]
    fn an_error_reset_ends_what_the_register_no_longer_has() {
        let mut log = EmcyLog::default();
        log.take(1, 5, emcy(0x2310, register::GENERIC | register::CURRENT, [0; 5]));
        log.take(2, 5, emcy(0x4210, register::GENERIC | register::TEMPERATURE, [0; 5]));
        log.take(3, 5, emcy(0xFF10, register::GENERIC, [0; 5]));
        // Current is over, temperature is not; what has no bit of its own may be either.
        log.take(4, 5, emcy(0, register::GENERIC | register::TEMPERATURE, [0; 5]));
        assert_eq!(states(&log, 5), [(0xFF10, None), (0x4210, None), (0x2310, Some(ResetBy::ErrorReset))]);
        // The message names the code.
        log.take(5, 5, emcy(0, register::GENERIC | register::TEMPERATURE, [0x10, 0xFF, 0, 0, 0]));
        assert_eq!(log.of(5).unwrap().active(), 1);
        log.take(6, 5, emcy(0, 0, [0; 5]));
        assert_eq!(log.of(5).unwrap().active(), 0);
        assert_eq!((log.of(5).unwrap().seen, log.of(6).unwrap().seen), (3, 0));
        assert!(log.of(0).is_none() && log.of(200).is_none());
    }

    #[test]
    fn a_boot_up_ends_everything_and_the_list_is_bounded() {
        let mut log = EmcyLog::default();
        for n in 0..20u16 {
            log.take(u64::from(n), 7, emcy(0xFF00 + n, 1, [0; 5]));
        }
        let of = log.of(7).unwrap();
        assert_eq!((of.entries().count(), of.seen, of.dropped, of.active()), (KEPT, 20, 4, KEPT));
        assert_eq!(of.entries().next().map(|e| (e.t_ns, e.emcy.code)), Some((19, 0xFF13)));
        log.booted(30, 7);
        assert!(log.of(7).unwrap().entries().all(|e| e.reset == Some((30, ResetBy::BootUp))));
        assert_eq!((log.clear(6), log.clear(0), log.clear(7)), (0, KEPT, 0));
        assert_eq!(log.of(7).unwrap().seen, 0);
    }
}
