//! Tests of the SLCAN client without a device.
#![allow(clippy::panic, reason = "a test may end like this")]

use super::super::candump::parse as frame;
use super::super::frame::tests::any_frame;
use super::*;
use proptest::prelude::*;

const MS: u64 = 1_000_000;

fn channel() -> Channel {
    Channel { rate_code: 6, data_rate_code: None, timestamps: false, restart_ns: 100 * MS }
}

struct Talk {
    client: Client,
    out: Vec<u8>,
    heard: Vec<Heard>,
    now_ns: u64,
}

impl Talk {
    fn new(channel: Channel) -> Self {
        let mut talk = Self { client: Client::new(channel), out: Vec::new(), heard: Vec::new(), now_ns: 0 };
        talk.client.connected(0, &mut talk.out);
        talk
    }
    fn open(channel: Channel) -> Self {
        let mut talk = Self::new(channel);
        for _ in 0..20 {
            talk.answer();
            if talk.heard.contains(&Heard::Up) {
                break;
            }
        }
        talk.said();
        talk.told();
        talk
    }
    fn hear(&mut self, bytes: &[u8]) {
        self.client.receive(bytes, self.now_ns, &mut self.out, &mut |h| self.heard.push(h));
    }
    fn answer(&mut self) {
        self.hear(b"\r");
        self.wait(SETTLE_NS);
    }
    fn wait(&mut self, ns: u64) {
        self.now_ns += ns;
        self.client.tick(self.now_ns, &mut self.out, &mut |h| self.heard.push(h));
    }
    fn send(&mut self, text: &str) {
        self.client.send(&frame(text).unwrap(), self.now_ns, &mut self.out, &mut |h| self.heard.push(h));
    }
    fn said(&mut self) -> String {
        String::from_utf8(std::mem::take(&mut self.out)).unwrap().replace('\r', ";")
    }
    fn told(&mut self) -> Vec<Heard> {
        std::mem::take(&mut self.heard)
    }
}

#[test]
fn opens_step_by_step() {
    let mut talk = Talk::new(Channel { data_rate_code: Some(2), timestamps: true, ..channel() });
    assert_eq!(talk.said(), ";;;C;");
    // Already closed: BEL is no fault, the empty line's answer is enough.
    talk.hear(b"\r\r\r");
    talk.hear(b"\x07");
    assert_eq!(talk.said(), "");
    talk.wait(SETTLE_NS);
    for expected in ["S6;", "Y2;", "Z1;", "O;"] {
        assert_eq!(talk.said(), expected);
        talk.hear(b"\r");
    }
    assert_eq!(talk.told(), [Heard::Up]);
}

#[test]
fn an_adapter_that_says_nothing_is_served_too() {
    let mut talk = Talk::new(channel());
    for expected in [";;;C;", "S6;", "O;"] {
        assert_eq!(talk.said(), expected);
        talk.wait(STEP_NS);
    }
    assert!(matches!(&talk.told()[..], [Heard::Note(_), Heard::Up]));
    talk.send("123#01");
    assert_eq!((talk.said().as_str(), talk.told()), ("t123101;", vec![Heard::Sent]));
}

#[test]
fn acknowledged_refused_and_status() {
    let mut talk = Talk::open(channel());
    talk.send("123#01");
    talk.send("00000123#R4");
    assert_eq!(talk.said(), "t123101;R000001234;");
    talk.hear(b"z\rt7FF0\r\x07");
    assert_eq!(talk.told(), [Heard::Sent, Heard::Frame(frame("7FF#").unwrap(), talk.now_ns), Heard::Refused]);
    talk.wait(POLL_NS);
    assert_eq!(talk.said(), "F;");
    talk.hear(b"F24\r");
    assert_eq!(talk.told(), [Heard::State(ControllerState::Passive, "error warning; error passive".into())]);
    talk.wait(POLL_NS);
    talk.hear(b"F00\r");
    assert_eq!(talk.told(), [Heard::State(ControllerState::Active, "error active".into())]);
    // The same state again is no news; an adapter that does not know the question is not asked again.
    talk.wait(POLL_NS);
    talk.hear(b"\x07");
    talk.said();
    talk.wait(10 * POLL_NS);
    assert_eq!((talk.said().as_str(), talk.told()), ("", vec![]));
}

#[test]
fn commands_are_answered_but_frames_are_not() {
    let mut talk = Talk::open(channel());
    talk.send("123#01");
    assert_eq!(talk.told(), []);
    talk.wait(ACK_NS);
    talk.send("123#02");
    assert_eq!(talk.told(), [Heard::Sent, Heard::Sent]);
}

#[test]
fn bus_off_is_met_by_close_and_open_with_back_off() {
    let mut talk = Talk::open(channel());
    let mut pauses = Vec::new();
    for _ in 0..8 {
        for _ in 0..REFUSALS {
            talk.send("123#01");
        }
        talk.said();
        talk.hear(&[7; REFUSALS as usize]);
        assert_eq!(talk.said(), "C;");
        let told = talk.told();
        assert_eq!(told.iter().filter(|h| **h == Heard::Refused).count(), REFUSALS as usize);
        assert!(told.iter().any(|h| matches!(h, Heard::State(ControllerState::BusOff, _))));
        let State::Restart(until_ns) = talk.client.state else { panic!("{:?}", talk.client.state) };
        pauses.push((until_ns - talk.now_ns) / MS);
        talk.wait(until_ns - talk.now_ns);
        for expected in [";;;C;", "S6;", "O;"] {
            assert_eq!(talk.said(), expected);
            talk.answer();
        }
        assert_eq!(talk.told(), [Heard::Up]);
    }
    assert_eq!(pauses, [100, 200, 400, 800, 1600, 3200, 5000, 5000]);
    // One frame that goes through ends the back-off.
    talk.send("123#01");
    talk.hear(b"z\r");
    assert_eq!(talk.client.restarts, 0);

    let mut never = Talk::open(Channel { restart_ns: 0, ..channel() });
    for _ in 0..REFUSALS {
        never.send("123#01");
    }
    never.hear(&[7; REFUSALS as usize]);
    assert!(matches!(never.told().last(), Some(Heard::Restarting(_))));
}

#[test]
fn who_is_no_adapter_is_told() {
    let fault = |bytes: &[u8], first: bool| {
        let mut talk = if first { Talk::new(channel()) } else { Talk::open(channel()) };
        talk.hear(bytes);
        talk.told().into_iter().map(|h| format!("{h:?}")).collect::<Vec<_>>().join("\n")
    };
    let refused_rate = {
        let mut talk = Talk::new(channel());
        talk.answer();
        talk.hear(b"\x07");
        format!("{:?}", talk.told())
    };
    let refused_open = {
        let mut talk = Talk::new(channel());
        talk.answer();
        talk.answer();
        talk.hear(b"\x07");
        format!("{:?}", talk.told())
    };
    let all = [
        fault(
            b"$GPGGA,1,2,3\r\n$GPGSA,A\r\n$GPGSV\r\n$GPRMC\r\n$GPVTG\r\n$GPGGA\r\n$GPGSA\r\n$GPGSV\r\n",
            true,
        ),
        refused_rate,
        refused_open,
    ];
    insta::assert_snapshot!(all.join("\n"), @r#"
    Fault("what answers is no SLCAN adapter: nothing but nonsense came; check `interface` and `baud`")
    [Fault("the adapter refuses the bit rate (BEL): choose one that it has")]
    [Fault("the adapter refuses to open its channel (BEL): is another program using it?")]
    "#);
    // A line of noise among good ones is none.
    assert_eq!(fault(b"t12#\r\xFF\xFE\r", false), "");
}

#[test]
fn bit_rates() {
    assert_eq!(
        [10_000, 125_000, 500_000, 750_000, 800_000, 1_000_000, 5_000].map(rate_code),
        [Some(0), Some(4), Some(6), Some(7), Some(7), Some(8), None]
    );
    assert_eq!(
        [2_000_000, 5_000_000, 2_500_000, 500_000].map(data_rate_code),
        [Some(2), Some(5), None, None]
    );
}

#[test]
fn stamps_become_time_of_this_machine() {
    let mut map = StampMap::default();
    let base = 1_000_000 * MS;
    // The adapter's clock is at 59,990 ms and wraps; the way to us takes 1 to 9 ms.
    let table = [(59_990, 5, 5), (59_995, 6, 6), (0, 14, 11), (5, 17, 16), (10, 30, 21)];
    for (ms, arrived_ms, expected_ms) in table {
        let at = map.map(ms, base + arrived_ms * MS);
        let error = at.abs_diff(base + expected_ms * MS);
        assert!(error < MS / 100, "{ms}: {} us off", error / 1000);
    }
    // After a long silence it starts anew.
    assert_eq!(map.map(10, base + 100_000 * MS), base + 100_000 * MS);
}

proptest! {
    #[test]
    fn reads_what_our_server_writes(f in any_frame(false), stamp in prop::option::of(0u64..60_000)) {
        let mut text = [0; MAX_TEXT];
        let n = slcan::encode(&f, stamp, &mut text);
        let mut rest = &text[..n];
        prop_assert_eq!(Decoder::default().next(&mut rest), Some(Answer::Frame(f, stamp.map(|ms| ms as u16))));
    }

    #[test]
    fn never_panics(pieces in prop::collection::vec((prop::collection::vec(prop_oneof![any::<u8>(), prop::sample::select(b"tTrRzZF0123\r\x07".to_vec())], 0..60), 0u64..2_000_000_000, any::<bool>()), 0..40)) {
        let mut talk = Talk::new(Channel { timestamps: true, ..channel() });
        for (bytes, wait, send) in pieces {
            talk.hear(&bytes);
            talk.wait(wait);
            if send && talk.client.state == State::Open && talk.client.pending.len() < FLIGHT {
                talk.send("123#0102");
            }
            prop_assert!(talk.client.pending.len() <= FLIGHT + 1);
        }
    }

    #[test]
    fn stamps_never_lie_in_the_future(steps in prop::collection::vec((any::<u16>(), 0u64..100_000_000_000), 0..50)) {
        let (mut map, mut now) = (StampMap::default(), 0);
        for (ms, step) in steps {
            now += step;
            prop_assert!(map.map(ms, now) <= now);
        }
    }
}
