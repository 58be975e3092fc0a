//! Error frames of SocketCAN in words.
//!
//! A controller tells what went wrong as a frame with [`ERR_FLAG`](super::frame::ERR_FLAG): its class in the identifier,
//! details in eight bytes. Source: Linux `include/uapi/linux/can/error.h`, the meaning of each bit.

use super::frame::{EFF_MASK, Frame};

/// State of a CAN controller (ISO 11898-1 12.1.4).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum ControllerState {
    /// Both error counters below 96.
    Active,
    /// An error counter is at 96 or above.
    Warning,
    /// An error counter is at 128 or above: it sends no dominant error flags any more.
    Passive,
    /// The transmit error counter went above 255: off the bus until restarted.
    BusOff,
}

impl ControllerState {
    /// The state that two error counters mean.
    pub fn of_counters(tec: u16, rec: u16) -> Self {
        match tec.max(rec) {
            _ if tec > 255 => Self::BusOff,
            0..=95 => Self::Active,
            96..=127 => Self::Warning,
            _ => Self::Passive,
        }
    }

    /// As users of the field say it.
    pub fn words(self) -> &'static str {
        match self {
            Self::Active => "error active",
            Self::Warning => "error warning",
            Self::Passive => "error passive",
            Self::BusOff => "bus-off",
        }
    }
}

const CLASS_TX_TIMEOUT: u32 = 0x001;
const CLASS_LOST_ARBITRATION: u32 = 0x002;
const CLASS_CONTROLLER: u32 = 0x004;
const CLASS_PROTOCOL: u32 = 0x008;
const CLASS_TRANSCEIVER: u32 = 0x010;
const CLASS_NO_ACK: u32 = 0x020;
const CLASS_BUS_OFF: u32 = 0x040;
const CLASS_BUS_ERROR: u32 = 0x080;
const CLASS_RESTARTED: u32 = 0x100;
const CLASS_COUNTERS: u32 = 0x200;

/// What an error frame says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ErrorFrame {
    class: u32,
    data: [u8; 8],
}

impl ErrorFrame {
    /// Takes a frame apart; `None` unless it is an error frame.
    pub fn of(frame: &Frame) -> Option<Self> {
        let mut data = [0; 8];
        data.copy_from_slice(&frame.data[..8]);
        frame.is_error().then_some(Self { class: frame.can_id & EFF_MASK, data })
    }

    fn has(&self, class: u32) -> bool {
        self.class & class != 0
    }

    /// State that the controller is in after it, if it says so.
    pub fn state(&self) -> Option<ControllerState> {
        if self.has(CLASS_BUS_OFF) {
            return Some(ControllerState::BusOff);
        }
        if self.has(CLASS_RESTARTED) {
            return Some(ControllerState::Active);
        }
        if !self.has(CLASS_CONTROLLER) {
            return None;
        }
        match self.data[1] {
            status if status & 0x30 != 0 => Some(ControllerState::Passive),
            status if status & 0x0C != 0 => Some(ControllerState::Warning),
            status if status & 0x40 != 0 => Some(ControllerState::Active),
            _ => None,
        }
    }

    /// Transmit and receive error counters. Older drivers fill them in without the class bit that says so, but only
    /// in frames about the controller.
    pub fn counters(&self) -> Option<(u8, u8)> {
        let given = self.has(CLASS_COUNTERS) || (self.has(CLASS_CONTROLLER) && self.data[6..] != [0, 0]);
        given.then_some((self.data[6], self.data[7]))
    }

    /// The controller was restarted after bus-off.
    pub fn is_restart(&self) -> bool {
        self.has(CLASS_RESTARTED)
    }

    /// A frame of ours was not acknowledged by anybody.
    pub fn is_no_ack(&self) -> bool {
        self.has(CLASS_NO_ACK) || (self.has(CLASS_PROTOCOL) && matches!(self.data[3], 0x19 | 0x1B))
    }

    /// Everything it says, for people: "bus-off; no acknowledgement; TEC 248, REC 0".
    pub fn words(&self) -> String {
        let mut parts: Vec<String> = Vec::new();
        let mut say = |text: &str| parts.push(text.to_owned());
        if self.has(CLASS_TX_TIMEOUT) {
            say("transmission timed out");
        }
        if self.has(CLASS_LOST_ARBITRATION) {
            match self.data[0] {
                0 => say("lost arbitration"),
                bit => say(&format!("lost arbitration in bit {bit}")),
            }
        }
        if self.has(CLASS_CONTROLLER) {
            named(self.data[1], &CONTROLLER, "controller problem", &mut say);
        }
        if self.has(CLASS_PROTOCOL) {
            named(self.data[2], &PROTOCOL, "protocol violation", &mut say);
            if let Some(place) = place(self.data[3]) {
                say(&format!("in {place}"));
            }
        }
        if self.has(CLASS_TRANSCEIVER) {
            transceiver(self.data[4], &mut say);
        }
        for (class, text) in [
            (CLASS_NO_ACK, "no acknowledgement"),
            (CLASS_BUS_OFF, "bus-off"),
            (CLASS_BUS_ERROR, "bus error"),
            (CLASS_RESTARTED, "controller restarted"),
        ] {
            if self.has(class) {
                say(text);
            }
        }
        let unknown = self.class & !0x3FF;
        if unknown != 0 {
            say(&format!("unknown class {unknown:X}h"));
        }
        if let Some((tec, rec)) = self.counters() {
            say(&format!("TEC {tec}, REC {rec}"));
        }
        if parts.is_empty() { "error without a reason".to_owned() } else { parts.join("; ") }
    }
}

const CONTROLLER: [(u8, &str); 7] = [
    (0x01, "receive buffer overflow"),
    (0x02, "transmit buffer overflow"),
    (0x04, "error warning by receive errors"),
    (0x08, "error warning by transmit errors"),
    (0x10, "error passive by receive errors"),
    (0x20, "error passive by transmit errors"),
    (0x40, "error active again"),
];

const PROTOCOL: [(u8, &str); 8] = [
    (0x01, "bit error"),
    (0x02, "form error"),
    (0x04, "stuff error"),
    (0x08, "cannot send a dominant bit"),
    (0x10, "cannot send a recessive bit"),
    (0x20, "bus overload"),
    (0x40, "active error flag"),
    (0x80, "while sending"),
];

fn named(bits: u8, table: &[(u8, &str)], unspecified: &str, say: &mut impl FnMut(&str)) {
    if bits == 0 {
        say(unspecified);
    }
    for (bit, text) in table {
        if bits & bit != 0 {
            say(text);
        }
    }
}

fn place(code: u8) -> Option<&'static str> {
    Some(match code {
        0x03 => "start of frame",
        0x02 | 0x06 | 0x07 | 0x0E | 0x0F => "the identifier",
        0x04 => "the substitute remote bit",
        0x05 => "the identifier extension bit",
        0x0C => "the remote bit",
        0x0D | 0x09 => "a reserved bit",
        0x0B => "the data length code",
        0x0A => "the data",
        0x08 => "the CRC",
        0x18 => "the CRC delimiter",
        0x19 => "the acknowledge slot",
        0x1B => "the acknowledge delimiter",
        0x1A => "the end of frame",
        0x12 => "the intermission",
        _ => return None,
    })
}

/// CANH in the low half of the code, CANL in the high half; both may have a fault.
fn transceiver(code: u8, say: &mut impl FnMut(&str)) {
    if code == 0 {
        say("transceiver: unspecified fault");
    }
    for (wire, fault) in [("CANH", code & 0x0F), ("CANL", code >> 4)] {
        let what = match fault {
            0 => continue,
            4 => "has no wire",
            5 => "shorted to battery",
            6 => "shorted to VCC",
            7 => "shorted to ground",
            8 if wire == "CANL" => "shorted to CANH",
            _ => "unspecified fault",
        };
        say(&format!("transceiver: {wire} {what}"));
    }
}

#[cfg(test)]
mod tests {
    use super::super::candump::parse;
    use super::super::frame::ERR_FLAG;
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn words() {
        let table = [
            ("20000080#0000000000000000", "bus error"),
            ("20000040#0000000000000000", "bus-off"),
            ("20000100#0000000000000000", "controller restarted"),
            ("20000204#0020000000008000", "error passive by transmit errors; TEC 128, REC 0"),
            ("20000004#000400000000005F", "error warning by receive errors; TEC 0, REC 95"),
            ("20000004#0000000000000000", "controller problem"),
            (
                "200000A8#0000801900000000",
                "while sending; in the acknowledge slot; no acknowledgement; bus error",
            ),
            ("20000002#0500000000000000", "lost arbitration in bit 5"),
            ("20000010#0000000007000000", "transceiver: CANH shorted to ground"),
            ("20000010#0000000044000000", "transceiver: CANH has no wire; transceiver: CANL has no wire"),
            ("20000010#0000000080000000", "transceiver: CANL shorted to CANH"),
            ("20000010#0000000000000000", "transceiver: unspecified fault"),
            ("20000001#0000000000000000", "transmission timed out"),
            (
                "20000008#0000FF0A00000000",
                "bit error; form error; stuff error; cannot send a dominant bit; cannot send a recessive bit; bus overload; active error flag; while sending; in the data",
            ),
            (
                "20000004#007F000000000000",
                "receive buffer overflow; transmit buffer overflow; error warning by receive errors; error warning by transmit errors; error passive by receive errors; error passive by transmit errors; error active again",
            ),
            ("20000200#000000000000A1B2", "TEC 161, REC 178"),
            (
                "20000028#0000001B00000000",
                "protocol violation; in the acknowledge delimiter; no acknowledgement",
            ),
            ("20000000#0000000000000000", "error without a reason"),
            ("20001000#0000000000000000", "unknown class 1000h"),
        ];
        for (text, expected) in table {
            let frame = parse(text).unwrap();
            assert_eq!(ErrorFrame::of(&frame).unwrap().words(), expected, "{text}");
        }
        assert_eq!(ErrorFrame::of(&parse("123#00").unwrap()), None);
    }

    #[test]
    fn states() {
        let state = |text: &str| ErrorFrame::of(&parse(text).unwrap()).unwrap().state();
        assert_eq!(state("20000040#0000000000000000"), Some(ControllerState::BusOff));
        assert_eq!(state("20000100#0000000000000000"), Some(ControllerState::Active));
        assert_eq!(state("20000004#0010000000000000"), Some(ControllerState::Passive));
        assert_eq!(state("20000004#0008000000000000"), Some(ControllerState::Warning));
        assert_eq!(state("20000004#0040000000000000"), Some(ControllerState::Active));
        assert_eq!(state("20000004#0001000000000000"), None);
        assert_eq!(state("20000080#0000000000000000"), None);
        let by_counters = [(0, 95), (96, 0), (0, 127), (128, 0), (255, 0), (256, 0), (0, 300)];
        let states = by_counters.map(|(tec, rec)| ControllerState::of_counters(tec, rec).words());
        let expected = [
            "error active",
            "error warning",
            "error warning",
            "error passive",
            "error passive",
            "bus-off",
            "error passive",
        ];
        assert_eq!(states, expected);
    }

    proptest! {
        #[test]
        fn any_frame_has_words(id in 0u32..=EFF_MASK, data in any::<[u8; 8]>()) {
            let mut frame = Frame { can_id: id | ERR_FLAG, len: 8, ..Frame::default() };
            frame.data[..8].copy_from_slice(&data);
            let error = ErrorFrame::of(&frame).unwrap();
            prop_assert!(!error.words().is_empty());
            let _ = (error.state(), error.counters(), error.is_no_ack(), error.is_restart());
        }
    }
}
