//! Bits a frame takes on the wire and the load they make of a bus.
//!
//! Classic frames are counted with the stuff bits their own bits need (the CRC is computed), FD frames likewise
//! up to the CRC, whose stuff bits are fixed. Source: ISO 11898-1:2015 10.4 and 10.5.

use super::frame::{FD_BRS, Frame};

/// Bits of one frame on the wire, by the rate they run at. Interframe space (3 bits) is included.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct FrameBits {
    /// Bits at the nominal bit rate.
    pub nominal: u32,
    /// Bits at the data bit rate; 0 unless the frame switches (BRS).
    pub data: u32,
}

impl FrameBits {
    /// Time on the wire in nanoseconds. Rates in bit/s; 0 counts as 1.
    pub fn time_ns(&self, bitrate: u32, data_bitrate: u32) -> u64 {
        let nominal = u64::from(self.nominal) * 1_000_000_000 / u64::from(bitrate.max(1));
        nominal + u64::from(self.data) * 1_000_000_000 / u64::from(data_bitrate.max(1))
    }
}

/// How stuff bits are counted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stuffing {
    /// None: the shortest time a frame of this shape can take.
    None,
    /// As many as the frame's own bits need.
    Exact,
    /// The most a frame of this shape can need.
    Worst,
}

/// End of every frame: ACK, ACK delimiter, 7 bits end of frame, 3 bits interframe space.
const TRAILER: u32 = 12;

/// Bits of `frame` on the wire.
pub fn bits(frame: &Frame, stuffing: Stuffing) -> FrameBits {
    if frame.is_fd() { fd_bits(frame, stuffing) } else { classic_bits(frame, stuffing) }
}

fn classic_bits(frame: &Frame, stuffing: Stuffing) -> FrameBits {
    let data_bits = 8 * frame.payload().len() as u32;
    // Start of frame to CRC without delimiter; only these are stuffed.
    let stuffed = if frame.is_extended() { 54 } else { 34 } + data_bits;
    let stuff = match stuffing {
        Stuffing::None => 0,
        Stuffing::Worst => (stuffed - 1) / 4,
        Stuffing::Exact => {
            let mut wire = Wire::default();
            header(&mut wire, frame);
            wire.push(u32::from(frame.len), 4);
            for &byte in frame.payload() {
                wire.push(u32::from(byte), 8);
            }
            wire.push(u32::from(wire.crc), 15);
            wire.stuff
        }
    };
    FrameBits { nominal: stuffed + stuff + 1 + TRAILER, data: 0 }
}

/// Start of frame to the last bit before the data length code.
fn header(wire: &mut Wire, frame: &Frame) {
    let remote = u32::from(frame.is_remote());
    wire.push(0, 1);
    if frame.is_extended() {
        wire.push(frame.id() >> 18, 11);
        wire.push(0b11, 2);
        wire.push(frame.id() & 0x3_FFFF, 18);
        if frame.is_fd() {
            wire.push(0b010, 3);
        } else {
            wire.push(remote << 2, 3);
        }
    } else {
        wire.push(frame.id(), 11);
        if frame.is_fd() {
            wire.push(0b0010, 4);
        } else {
            wire.push(remote << 2, 3);
        }
    }
}

fn fd_bits(frame: &Frame, stuffing: Stuffing) -> FrameBits {
    let switch = frame.fd & FD_BRS != 0;
    // Start of frame up to and with BRS.
    let head = if frame.is_extended() { 36 } else { 17 };
    // ESI, data length code, data.
    let body = 5 + 8 * u32::from(frame.len);
    // Stuff count, CRC, their fixed stuff bits, CRC delimiter.
    let crc = if frame.len > 16 { 4 + 21 + 7 + 1 } else { 4 + 17 + 6 + 1 };
    let (head_stuff, body_stuff) = match stuffing {
        Stuffing::None => (0, 0),
        Stuffing::Worst => ((head - 1) / 4, (head + body - 1) / 4 - (head - 1) / 4),
        Stuffing::Exact => {
            let mut wire = Wire::default();
            header(&mut wire, frame);
            wire.push(u32::from(switch), 1);
            let head_stuff = wire.stuff;
            wire.push(u32::from(frame.fd & super::frame::FD_ESI != 0), 1);
            wire.push(u32::from(frame.dlc()), 4);
            for &byte in frame.payload() {
                wire.push(u32::from(byte), 8);
            }
            (head_stuff, wire.stuff - head_stuff)
        }
    };
    let (slow, fast) = (head + head_stuff + TRAILER, body + body_stuff + crc);
    if switch { FrameBits { nominal: slow, data: fast } } else { FrameBits { nominal: slow + fast, data: 0 } }
}

/// Counts stuff bits and the CRC-15 of what is pushed.
struct Wire {
    last: u32,
    run: u32,
    stuff: u32,
    crc: u16,
}

impl Default for Wire {
    fn default() -> Self {
        Self { last: 1, run: 0, stuff: 0, crc: 0 }
    }
}

impl Wire {
    fn push(&mut self, value: u32, count: u32) {
        for i in (0..count).rev() {
            let bit = (value >> i) & 1;
            // CRC-15 of ISO 11898-1: x15+x14+x10+x8+x7+x4+x3+1.
            let feedback = bit ^ u32::from(self.crc >> 14) & 1;
            self.crc = (self.crc << 1) & 0x7FFF;
            if feedback == 1 {
                self.crc ^= 0x4599;
            }
            if self.run > 0 && bit == self.last {
                self.run += 1;
            } else {
                self.run = 1;
                self.last = bit;
            }
            if self.run == 5 {
                // The stuff bit is of the other value and begins the next run.
                self.stuff += 1;
                self.last ^= 1;
                self.run = 1;
            }
        }
    }
}

/// Slots of [`LoadMeter`]'s window.
const SLOTS: usize = 10;
/// Length of one slot.
const SLOT_NS: u64 = 100_000_000;

/// Load of a bus over the last second, in steps of 100 ms.
#[derive(Debug, Clone)]
pub struct LoadMeter {
    slots: [u64; SLOTS],
    /// Number of the newest slot since time zero.
    newest: u64,
}

impl Default for LoadMeter {
    fn default() -> Self {
        Self { slots: [0; SLOTS], newest: 0 }
    }
}

impl LoadMeter {
    /// Counts a frame that took `wire_ns` and ended at `t_ns`. Time must not go backwards; if it does, the frame
    /// counts for the newest slot.
    pub fn add(&mut self, t_ns: u64, wire_ns: u64) {
        self.advance(t_ns);
        self.slots[(self.newest % SLOTS as u64) as usize] += wire_ns;
    }

    /// Load in per mille of the last nine full slots (900 ms before the current slot). Above 1000 on a virtual
    /// bus that is not held to wire time.
    pub fn permille(&mut self, t_ns: u64) -> u32 {
        self.advance(t_ns);
        let current = (self.newest % SLOTS as u64) as usize;
        let busy: u64 = self.slots.iter().enumerate().filter(|(i, _)| *i != current).map(|(_, ns)| ns).sum();
        u32::try_from(busy / (SLOT_NS * (SLOTS as u64 - 1) / 1000)).unwrap_or(u32::MAX)
    }

    fn advance(&mut self, t_ns: u64) {
        let slot = t_ns / SLOT_NS;
        if slot <= self.newest {
            return;
        }
        for i in 0..(slot - self.newest).min(SLOTS as u64) {
            self.slots[((slot - i) % SLOTS as u64) as usize] = 0;
        }
        self.newest = slot;
    }
}

#[cfg(test)]
mod tests {
    use super::super::frame::tests::any_frame;
    use super::*;
    use proptest::prelude::*;

    fn nominal(frame: &Frame, stuffing: Stuffing) -> u32 {
        bits(frame, stuffing).nominal
    }

    #[test]
    fn known_lengths() {
        let eight = [0x55; 8];
        let std = Frame::data(0x555, false, &eight).unwrap();
        let ext = Frame::data(0x1555_5555, true, &eight).unwrap();
        assert_eq!((nominal(&std, Stuffing::None), nominal(&std, Stuffing::Worst)), (111, 135));
        assert_eq!((nominal(&ext, Stuffing::None), nominal(&ext, Stuffing::Worst)), (131, 160));
        let empty = Frame::data(0x555, false, &[]).unwrap();
        assert_eq!(nominal(&empty, Stuffing::None), 47);
        // A remote frame asks for 8 bytes and carries none.
        assert_eq!(nominal(&Frame::remote(0x555, false, 8).unwrap(), Stuffing::None), 47);
        // 111 bits at 1 Mbit/s.
        assert_eq!(bits(&std, Stuffing::None).time_ns(1_000_000, 0), 111_000);
    }

    #[test]
    fn exact_stuffing_by_hand() {
        // 34 zero bits (CRC of zeros is zero): after 5 the stuff bit 1, then each 5 zeros again: 5 10 15 20 25 30.
        let zeros = Frame::data(0, false, &[]).unwrap();
        assert_eq!(nominal(&zeros, Stuffing::Exact), 47 + 6);
        // The CRC-15 of the eight bytes 01.. is part of the count: computed with an independent implementation.
        let mut wire = Wire::default();
        for byte in *b"123456789" {
            wire.push(u32::from(byte), 8);
        }
        // Check value of CRC-15/CAN.
        assert_eq!(wire.crc, 0x059E);
    }

    #[test]
    fn fd_phases() {
        let slow = Frame::fd(0x555, false, 0, &[0x55; 8]).unwrap();
        let fast = Frame::fd(0x555, false, FD_BRS, &[0x55; 8]).unwrap();
        assert_eq!(bits(&slow, Stuffing::None), FrameBits { nominal: 17 + 5 + 64 + 28 + 12, data: 0 });
        assert_eq!(bits(&fast, Stuffing::None), FrameBits { nominal: 29, data: 97 });
        let long = Frame::fd(0x1555_5555, true, FD_BRS, &[0x55; 64]).unwrap();
        assert_eq!(bits(&long, Stuffing::None), FrameBits { nominal: 48, data: 5 + 512 + 33 });
        assert_eq!(bits(&fast, Stuffing::None).time_ns(500_000, 2_000_000), 58_000 + 48_500);
    }

    #[test]
    fn load_over_a_second() {
        let mut meter = LoadMeter::default();
        let start = 5_000_000_000;
        for i in 0..2000u64 {
            meter.add(start + i * 1_000_000, 500_000);
        }
        assert_eq!(meter.permille(start + 2_000_000_000), 500);
        // Of the nine full slots before 2.5 s, four (1.6 s to 2.0 s) were busy half the time.
        assert_eq!(meter.permille(start + 2_500_000_000), 222);
        assert_eq!(meter.permille(start + 9_000_000_000), 0);
        // A step back in time is no reason to fail.
        meter.add(1, 1);
        assert_eq!(meter.permille(start + 9_000_000_000), 0);
    }

    proptest! {
        #[test]
        fn exact_is_between_none_and_worst(frame in any_frame(true)) {
            let [none, exact, worst] =
                [Stuffing::None, Stuffing::Exact, Stuffing::Worst].map(|s| bits(&frame, s));
            prop_assert!(none.nominal <= exact.nominal && none.data <= exact.data);
            prop_assert!(exact.nominal + exact.data <= worst.nominal + worst.data);
        }

        #[test]
        fn meter_never_overflows(steps in prop::collection::vec((any::<u64>(), 0u64..10_000_000), 0..50)) {
            let mut meter = LoadMeter::default();
            for (t, ns) in steps {
                meter.add(t, ns);
                let _ = meter.permille(t);
            }
        }
    }
}
