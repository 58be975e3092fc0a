//! EMCY: codec, producer with error register (1001h), history (1003h) and inhibit time (1015h), and consumer
//! (CiA 301 V4.2, 7.2.7).

use ipc_types::payload::CanFrame;

use super::cob_id::CobId;
use super::io::Outbox;

/// Emergency error codes that the stack itself raises (CiA 301 V4.2, 7.2.7.1, table 26).
pub mod code {
    /// Error reset or no error.
    pub const NO_ERROR: u16 = 0x0000;
    /// Data set: non-volatile storage failed.
    pub const STORAGE: u16 = 0x6300;
    /// Communication, generic: SYNC stays away.
    pub const COMMUNICATION: u16 = 0x8100;
    /// CAN overrun (objects lost).
    pub const OVERRUN: u16 = 0x8110;
    /// CAN in error passive mode.
    pub const ERROR_PASSIVE: u16 = 0x8120;
    /// Life guard error or heartbeat error.
    pub const HEARTBEAT: u16 = 0x8130;
    /// Recovered from bus off.
    pub const BUS_OFF_RECOVERED: u16 = 0x8140;
    /// CAN-ID collision.
    pub const ID_COLLISION: u16 = 0x8150;
    /// PDO not processed due to length error.
    pub const PDO_TOO_SHORT: u16 = 0x8210;
    /// PDO length exceeded.
    pub const PDO_TOO_LONG: u16 = 0x8220;
    /// Unexpected SYNC data length.
    pub const SYNC_LENGTH: u16 = 0x8240;
    /// RPDO timeout.
    pub const RPDO_TIMEOUT: u16 = 0x8250;
}

/// Bits of the error register 1001h (CiA 301 V4.2, 7.5.2.2, table 50).
pub mod register {
    /// Set while any error is there.
    pub const GENERIC: u8 = 1;
    pub const CURRENT: u8 = 1 << 1;
    pub const VOLTAGE: u8 = 1 << 2;
    pub const TEMPERATURE: u8 = 1 << 3;
    /// Overrun, error state, heartbeat, PDO length.
    pub const COMMUNICATION: u8 = 1 << 4;
    pub const PROFILE: u8 = 1 << 5;
    pub const MANUFACTURER: u8 = 1 << 7;
}

/// Names of the bits of the error register (CiA 301 V4.2, 7.5.2.2, table 50).
const REGISTER_BITS: [&str; 8] = [
    "generic",
    "current",
    "voltage",
    "temperature",
    "communication",
    "device profile",
    "reserved",
    "manufacturer",
];

/// The bits of an error register that are set, in words.
pub fn register_bits(register: u8) -> Vec<&'static str> {
    (0..8).filter(|bit| register >> bit & 1 != 0).map(|bit| REGISTER_BITS[bit]).collect()
}

/// One EMCY message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Emcy {
    /// Emergency error code; 0 = error reset.
    pub code: u16,
    /// Value of 1001h.
    pub register: u8,
    /// Manufacturer-specific error field.
    pub info: [u8; 5],
}

impl Emcy {
    /// Code, register, 5 bytes (CiA 301 V4.2, 7.2.7.3.1, figure 33).
    pub fn encode(&self) -> [u8; 8] {
        let [low, high] = self.code.to_le_bytes();
        let [a, b, c, d, e] = self.info;
        [low, high, self.register, a, b, c, d, e]
    }
    /// None unless 8 bytes.
    pub fn decode(data: &[u8]) -> Option<Self> {
        let &[low, high, register, a, b, c, d, e] = data else { return None };
        Some(Self { code: u16::from_le_bytes([low, high]), register, info: [a, b, c, d, e] })
    }
    /// The 32 bits that 1003h keeps: code below, the first two bytes of the error field above (7.5.2.4, figure 53).
    pub fn history_value(&self) -> u32 {
        u32::from(self.code) | u32::from(self.info[0]) << 16 | u32::from(self.info[1]) << 24
    }
    /// The group of the code, in words (table 26).
    pub fn class(&self) -> &'static str {
        match self.code {
            0x0000..=0x00FF => "error reset or no error",
            0x1000..=0x10FF => "generic error",
            0x2000..=0x2FFF => "current",
            0x3000..=0x3FFF => "voltage",
            0x4000..=0x4FFF => "temperature",
            0x5000..=0x50FF => "device hardware",
            0x6000..=0x6FFF => "device software",
            0x7000..=0x70FF => "additional modules",
            0x8130 => "life guard or heartbeat error",
            0x8210 => "PDO not processed due to length error",
            0x8220 => "PDO length exceeded",
            0x8240 => "unexpected SYNC data length",
            0x8250 => "RPDO timeout",
            0x8100..=0x81FF => "communication",
            0x8200..=0x82FF => "protocol error",
            0x9000..=0x90FF => "external error",
            0xF000..=0xF0FF => "additional functions",
            0xFF00..=0xFFFF => "device specific",
            _ => "unknown",
        }
    }
}

/// Errors that can be active at once: three of each of 512 RPDOs, one of each of 127 nodes, and the application's.
/// Beyond: neither message nor entry, but a count, since an error that is not kept could not be told from a new one.
pub const ACTIVE: usize = 2048;
/// Messages that can wait for the inhibit time. Beyond: the message is dropped and counted, the history has it.
pub const WAITING: usize = 64;
/// Sub-indices of 1003h (CiA 301 V4.2, 7.5.2.4).
pub const HISTORY: usize = 254;

/// Nanoseconds of the unit of inhibit times, 100 us.
pub const INHIBIT_UNIT_NS: u64 = 100_000;

#[derive(Debug, Clone, Copy)]
struct ActiveError {
    code: u16,
    /// Tells errors of one code apart, e.g. the RPDO or node.
    source: u16,
    register: u8,
}

/// Producer.
#[derive(Debug, Clone)]
pub struct EmcyProducer {
    cob: CobId,
    inhibit_ns: u64,
    active: Vec<ActiveError>,
    waiting: Vec<Emcy>,
    free_at_ns: u64,
    history: [u32; HISTORY],
    history_len: usize,
    history_limit: usize,
    /// Messages that were not sent because [`WAITING`] others waited or [`ACTIVE`] errors were there.
    pub dropped: u64,
}

impl EmcyProducer {
    /// `history_limit`: sub-indices that 1003h has, 0-254.
    pub fn new(history_limit: usize) -> Self {
        Self {
            cob: CobId(super::cob_id::BIT_31),
            inhibit_ns: 0,
            active: Vec::with_capacity(ACTIVE),
            waiting: Vec::with_capacity(WAITING),
            free_at_ns: 0,
            history: [0; HISTORY],
            history_len: 0,
            history_limit: history_limit.min(HISTORY),
            dropped: 0,
        }
    }
    /// Takes 1014h and 1015h.
    pub fn configure(&mut self, cob: CobId, inhibit_100us: u16) {
        self.cob = cob;
        self.inhibit_ns = u64::from(inhibit_100us) * INHIBIT_UNIT_NS;
    }
    /// Value of 1001h.
    pub fn register(&self) -> u8 {
        self.active.iter().fold(0, |register, error| register | error.register | register::GENERIC)
    }
    /// 1003h, newest first.
    pub fn history(&self) -> &[u32] {
        &self.history[..self.history_len]
    }
    /// A 0 was written to 1003h sub 0.
    pub fn clear_history(&mut self) {
        self.history_len = 0;
    }
    /// Initialisation: no error, nothing waits; the history stays (it is cleared at power-on only).
    pub fn reset(&mut self) {
        self.active.clear();
        self.waiting.clear();
    }
    pub fn is_active(&self, code: u16, source: u16) -> bool {
        self.active.iter().any(|error| error.code == code && error.source == source)
    }
    /// A source that has this error now.
    pub fn first_source(&self, code: u16) -> Option<u16> {
        self.active.iter().find(|error| error.code == code).map(|error| error.source)
    }
    /// An error has come. Tells the message, if the error is new: an error that is already there is not sent again
    /// (CiA 301 V4.2, 7.2.7.1: once per error event).
    pub fn raise(&mut self, code: u16, source: u16, register: u8, info: [u8; 5]) -> Option<Emcy> {
        if self.is_active(code, source) {
            return None;
        }
        if self.active.len() >= ACTIVE {
            self.dropped += 1;
            return None;
        }
        self.active.push(ActiveError { code, source, register });
        let emcy = Emcy { code, register: self.register() | register | register::GENERIC, info };
        self.remember(&emcy);
        Some(self.queue(emcy))
    }
    /// An event that is over at once, like a lost frame: a message and an entry, no lasting error.
    pub fn report(&mut self, code: u16, register: u8, info: [u8; 5]) -> Emcy {
        let emcy = Emcy { code, register: self.register() | register | register::GENERIC, info };
        self.remember(&emcy);
        self.queue(emcy)
    }
    /// The error has gone: "error reset" with what is left in the register; the error field names the code that
    /// went. None if it was not there.
    pub fn clear(&mut self, code: u16, source: u16) -> Option<Emcy> {
        let at = self.active.iter().position(|error| error.code == code && error.source == source)?;
        self.active.swap_remove(at);
        let [low, high] = code.to_le_bytes();
        let emcy = Emcy { code: code::NO_ERROR, register: self.register(), info: [low, high, 0, 0, 0] };
        Some(self.queue(emcy))
    }
    fn remember(&mut self, emcy: &Emcy) {
        if self.history_limit == 0 {
            return;
        }
        let kept = self.history_len.min(self.history_limit - 1);
        self.history.copy_within(..kept, 1);
        self.history[0] = emcy.history_value();
        self.history_len = kept + 1;
    }
    fn queue(&mut self, emcy: Emcy) -> Emcy {
        if self.waiting.len() < WAITING {
            self.waiting.push(emcy);
        } else {
            self.dropped += 1;
        }
        emcy
    }
    /// When the next waiting message may go; None if none waits. `allowed`: the NMT state lets EMCY out.
    pub fn next_deadline(&self, allowed: bool) -> Option<u64> {
        (allowed && !self.waiting.is_empty()).then_some(self.free_at_ns)
    }
    /// Sends what waits, as far as the inhibit time lets it. While `allowed` is false (stopped) messages wait. Without
    /// a valid 1014h they are dropped: the history has them.
    pub fn on_time(&mut self, t_ns: u64, allowed: bool, out: &mut Outbox) {
        if !self.cob.exists() {
            self.waiting.clear();
            return;
        }
        if !allowed {
            return;
        }
        let mut sent = 0;
        while sent < self.waiting.len() && t_ns >= self.free_at_ns {
            out.push(self.cob.frame(&self.waiting[sent].encode()));
            self.free_at_ns = if self.inhibit_ns > 0 { t_ns.saturating_add(self.inhibit_ns) } else { 0 };
            sent += 1;
        }
        self.waiting.drain(..sent);
    }
}

/// Consumer: 1028h sub n is the COB-ID of node n's EMCY (CiA 301 V4.2, 7.5.2.31).
#[derive(Debug, Clone)]
pub struct EmcyConsumer {
    cobs: [CobId; 128],
}

impl Default for EmcyConsumer {
    fn default() -> Self {
        Self { cobs: [CobId(super::cob_id::BIT_31); 128] }
    }
}

impl EmcyConsumer {
    /// Takes 1028h sub `node_id` (1-127).
    pub fn configure(&mut self, node_id: u8, cob: CobId) {
        if let Some(slot) = self.cobs.get_mut(usize::from(node_id)).filter(|_| node_id > 0) {
            *slot = cob;
        }
    }
    /// Node and message, if the frame is an EMCY of a consumed node.
    pub fn on_frame(&self, frame: &CanFrame) -> Option<(u8, Emcy)> {
        if frame.is_remote() || frame.len != 8 {
            return None;
        }
        let node_id = self.cobs.iter().position(|cob| cob.exists() && cob.matches(frame))?;
        Some((node_id as u8, Emcy::decode(frame.payload())?))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn producer(inhibit: u16) -> EmcyProducer {
        let mut producer = EmcyProducer::new(3);
        producer.configure(CobId(0x84), inhibit);
        producer
    }

    #[test]
    fn errors_come_once_and_go_once() {
        let mut out = Outbox::default();
        let mut emcy = producer(0);
        assert!(emcy.raise(code::HEARTBEAT, 5, register::COMMUNICATION, [5, 0, 0, 0, 0]).is_some());
        assert!(emcy.raise(code::HEARTBEAT, 5, register::COMMUNICATION, [5, 0, 0, 0, 0]).is_none());
        assert!(emcy.raise(0x3100, 0, register::VOLTAGE, [0; 5]).is_some());
        assert_eq!(emcy.register(), 0x15);
        assert!(emcy.clear(code::HEARTBEAT, 5).is_some());
        assert!(emcy.clear(code::HEARTBEAT, 5).is_none());
        emcy.clear(0x3100, 0);
        emcy.on_time(0, true, &mut out);
        let sent: Vec<_> = out.drain().filter_map(|frame| Emcy::decode(frame.payload())).collect();
        let seen: Vec<_> = sent.iter().map(|message| (message.code, message.register)).collect();
        assert_eq!(seen, [(0x8130, 0x11), (0x3100, 0x15), (0, 0x05), (0, 0)]);
        assert_eq!(sent[2].info, [0x30, 0x81, 0, 0, 0]);
        assert_eq!(emcy.history(), [0x3100, 0x0005_8130]);
    }

    #[test]
    fn inhibit_time_holds_messages_back_in_order() {
        let mut out = Outbox::default();
        let mut emcy = producer(1000);
        for source in 0..3 {
            emcy.raise(0x8250, source, register::COMMUNICATION, [source as u8, 0, 0, 0, 0]);
        }
        let mut at = Vec::new();
        let mut t = 5;
        while let Some(due) = emcy.next_deadline(true) {
            t = t.max(due);
            emcy.on_time(t, true, &mut out);
            at.extend(out.drain().map(|frame| (t, frame.data[3])));
        }
        assert_eq!(at, [(5, 0), (100_000_005, 1), (200_000_005, 2)]);
    }

    #[test]
    fn stopped_keeps_messages_and_an_invalid_cob_id_drops_them() {
        let mut out = Outbox::default();
        let mut emcy = producer(0);
        emcy.report(code::PDO_TOO_SHORT, register::COMMUNICATION, [0; 5]);
        assert_eq!(emcy.next_deadline(false), None);
        emcy.on_time(1, false, &mut out);
        assert!(out.is_empty());
        emcy.on_time(1, true, &mut out);
        assert_eq!(out.drain().count(), 1);
        emcy.configure(CobId(0x8000_0084), 0);
        emcy.report(code::PDO_TOO_SHORT, register::COMMUNICATION, [0; 5]);
        emcy.on_time(2, true, &mut out);
        assert!(out.is_empty() && emcy.next_deadline(true).is_none());
    }

    #[test]
    fn limits_hold() {
        let mut emcy = EmcyProducer::new(254);
        emcy.configure(CobId(0x84), 0);
        for n in 0..4000u16 {
            emcy.raise(
                0xFF00,
                n,
                register::MANUFACTURER,
                n.to_le_bytes().iter().copied().chain([0; 3]).collect::<Vec<_>>().try_into().unwrap(),
            );
        }
        assert_eq!((emcy.history().len(), emcy.dropped), (254, 4000 - WAITING as u64));
        assert_eq!(emcy.history()[0], 0x07FF_FF00);
        // An error that is not kept is none that comes anew each time.
        assert!(emcy.raise(0xFF00, 3999, register::MANUFACTURER, [0; 5]).is_none());
        assert!(emcy.clear(0xFF00, 5).is_some() && emcy.clear(0xFF00, 3999).is_none());
        let mut none = EmcyProducer::new(0);
        none.report(1, 1, [0; 5]);
        assert!(none.history().is_empty());
    }

    #[test]
    fn consumer_knows_the_node() {
        let mut consumer = EmcyConsumer::default();
        consumer.configure(5, CobId(0x85));
        consumer.configure(0, CobId(0x80));
        consumer.configure(200, CobId(0x86));
        let emcy = Emcy { code: 0x8130, register: 0x11, info: [1, 2, 3, 4, 5] };
        let frame = CobId(0x85).frame(&emcy.encode());
        assert_eq!(consumer.on_frame(&frame), Some((5, emcy)));
        assert_eq!(consumer.on_frame(&CobId(0x86).frame(&emcy.encode())), None);
        assert_eq!(consumer.on_frame(&CobId(0x85).frame(&[1, 2])), None);
        assert_eq!(consumer.on_frame(&CobId(0x85).remote(8)), None);
    }
}
