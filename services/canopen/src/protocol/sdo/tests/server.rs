//! The server frame by frame. Frames are written as in the logs of CiA's conformance test tool.

use super::super::*;
use crate::protocol::abort::Abort;
#[allow(clippy::enum_glob_use)]
use crate::protocol::data_type::DataType::*;
use crate::protocol::data_type::Number;
use crate::protocol::io::Outbox;
use crate::protocol::od::{Access, EntryDef, NoHooks, ObjectDictionary, OdBuilder};
use ipc_types::payload::{CanFrame, id_flag};
use proptest::prelude::*;

pub fn dictionary() -> ObjectDictionary {
    let mut b = OdBuilder::new();
    b.var(0x1000, EntryDef::new(Unsigned32, Access::Ro).value(0x000F_0191))
        .var(0x1003, EntryDef::new(Unsigned8, Access::Rw))
        .var(0x1008, EntryDef::new(VisibleString, Access::Const).bytes(b"CANopenDemoPIC32"))
        .var(0x1017, EntryDef::new(Unsigned16, Access::Rw))
        .var(0x2000, EntryDef::new(Domain, Access::Rw).capacity(2000))
        .var(0x2001, EntryDef::new(Unsigned64, Access::Rw).limits(Number::Int(0), Number::Int(0xFFFF)))
        .var(0x2002, EntryDef::new(VisibleString, Access::Rw).capacity(10))
        .var(0x2003, EntryDef::new(Unsigned16, Access::Wo))
        .record(
            0x1201,
            Access::Const,
            vec![
                (1, EntryDef::new(Unsigned32, Access::Rw).value(0x8000_0000)),
                (2, EntryDef::new(Unsigned32, Access::Rw).value(0x8000_0000)),
                (3, EntryDef::new(Unsigned8, Access::Rw)),
            ],
        );
    b.build(4).unwrap()
}

fn frame(hex: &str) -> CanFrame {
    let bytes: Vec<u8> =
        (0..hex.len() / 2).map(|at| u8::from_str_radix(&hex[2 * at..2 * at + 2], 16).unwrap()).collect();
    CanFrame::classic(0x604, &bytes)
}

struct Bench {
    od: ObjectDictionary,
    server: SdoServer,
    t_ns: u64,
}

impl Bench {
    fn new() -> Self {
        let od = dictionary();
        let server = SdoServer::new(server_channel(&od, 0).unwrap(), ServerConfig::default(), &od);
        Self { od, server, t_ns: 0 }
    }
    /// Sends a frame, returns the answers.
    fn ask(&mut self, hex: &str) -> Vec<String> {
        let mut out = Outbox::default();
        self.t_ns += 1_000_000;
        assert!(self.server.on_frame(self.t_ns, &frame(hex), &mut self.od, &mut NoHooks, &mut out));
        words(&out)
    }
    /// Waits until the server does something by itself.
    fn wait(&mut self) -> Vec<String> {
        let mut out = Outbox::default();
        self.t_ns = self.server.next_deadline().unwrap();
        self.server.on_time(self.t_ns, &mut out);
        words(&out)
    }
    /// Steps of request and answers; `-` waits.
    fn talk(&mut self, steps: &[(&str, &[&str])]) {
        for (at, (request, answers)) in steps.iter().enumerate() {
            let got = if *request == "-" { self.wait() } else { self.ask(request) };
            assert_eq!(got, *answers, "step {at}: {request}");
        }
        assert!(!self.server.is_busy());
        assert_eq!(self.server.next_deadline(), None);
    }
}

fn words(out: &Outbox) -> Vec<String> {
    out.frames()
        .iter()
        .map(|frame| {
            assert_eq!((frame.can_id, frame.len), (0x584, 8));
            format!("{:016X}", u64::from_be_bytes(frame.data[..8].try_into().unwrap()))
        })
        .collect()
}

#[test]
fn expedited() {
    Bench::new().talk(&[
        ("4000100000000000", &["4300100091010F00"]),
        ("4017100000000000", &["4B17100000000000"]),
        ("2B17100034120000", &["6017100000000000"]),
        ("4017100000000000", &["4B17100034120000"]),
        // without a length: the object's own
        ("2217100078560000", &["6017100000000000"]),
        ("4017100000000000", &["4B17100078560000"]),
        ("2300100091010F00", &["8000100002000106"]), // read-only
        ("4000100100000000", &["8000100111000906"]), // no sub-index
        ("4004100000000000", &["8004100000000206"]), // no object
        ("4003200000000000", &["8003200001000106"]), // write-only
        ("2303100000000000", &["8003100012000706"]), // too long
        ("2F17100080000000", &["8017100013000706"]), // too short
        ("E000100000000000", &["8000100001000405"]), // unknown command
        ("8017100000000000", &[]),                   // an abort is not answered
    ]);
}

#[test]
fn segmented() {
    let mut bench = Bench::new();
    bench.talk(&[
        ("2117100002000000", &["6017100000000000"]),
        ("0B34120000000000", &["2000000000000000"]),
        ("4008100000000000", &["4108100010000000"]),
        ("6000000000000000", &["0043414E6F70656E"]),
        ("7000000000000000", &["1044656D6F504943"]),
        ("6000000000000000", &["0B33320000000000"]),
        // toggle error
        ("4008100000000000", &["4108100010000000"]),
        ("7000000000000000", &["8008100000000305"]),
        ("2102200008000000", &["6002200000000000"]),
        ("1061626364656667", &["8002200000000305"]),
        // segments of no transfer
        ("6000000000000000", &["8002200001000405"]),
        ("0000000000000000", &["8002200001000405"]),
        // the empty string
        ("4002200000000000", &["4102200000000000"]),
        ("6000000000000000", &["0F00000000000000"]),
        // 10 bytes in two segments
        ("2102200009000000", &["6002200000000000"]),
        ("0061626364656667", &["2000000000000000"]),
        ("1B68690000000000", &["3000000000000000"]),
        // announced too long
        ("210220000B000000", &["8002200012000706"]),
        // more, and less than announced
        ("2102200008000000", &["6002200000000000"]),
        ("0061626364656667", &["2000000000000000"]),
        ("1B68690000000000", &["8002200012000706"]),
        ("2102200009000000", &["6002200000000000"]),
        ("0161626364656667", &["8002200013000706"]),
        // without a size: only the object's length holds
        ("2002200000000000", &["6002200000000000"]),
        ("0061626364656667", &["2000000000000000"]),
        ("1061626364656667", &["8002200012000706"]),
        // limits
        ("2101200008000000", &["6001200000000000"]),
        ("0000000100000000", &["2000000000000000"]),
        ("1D00000000000000", &["8001200031000906"]),
    ]);
    assert_eq!(bench.od.u16(0x1017, 0), Some(0x1234));
    assert_eq!(bench.od.text(0x2002, 0), Some("abcdefghi"));
    assert_eq!(bench.server.counters.aborted, 9);
}

#[test]
fn a_silent_client_is_aborted_and_a_new_one_served() {
    Bench::new().talk(&[
        ("4008100000000000", &["4108100010000000"]),
        ("-", &["8008100000000405"]),
        ("4008100000000000", &["4108100010000000"]),
        ("4000100000000000", &["4300100091010F00"]),
        ("A408100003000000", &["C608100010000000"]),
        ("-", &["8008100000000405"]),
        ("C600200004000000", &["A40020007F000000"]),
        ("-", &["8000200000000405"]),
    ]);
}

#[test]
fn block_upload() {
    Bench::new().talk(&[
        ("A000100014000000", &["C600100004000000"]),
        ("A300000000000000", &["8191010F00000000"]),
        ("A201140000000000", &["CD00000000000000"]),
        ("A100000000000000", &[]),
        ("A408100014000000", &["C608100010000000"]),
        ("A300000000000000", &["0143414E6F70656E", "0244656D6F504943", "8333320000000000"]),
        ("A203140000000000", &["D5F3430000000000"]),
        ("A100000000000000", &[]),
        // blocks of two; the second segment is lost
        ("A408100002000000", &["C608100010000000"]),
        ("A300000000000000", &["0143414E6F70656E", "0244656D6F504943"]),
        ("A201020000000000", &["0144656D6F504943", "8233320000000000"]),
        ("A202020000000000", &["D5F3430000000000"]),
        ("A100000000000000", &[]),
        // the empty string
        ("A402200014000000", &["C602200000000000"]),
        ("A300000000000000", &["8100000000000000"]),
        ("A201140000000000", &["DD00000000000000"]),
        ("A100000000000000", &[]),
        // short enough for the other protocol (pst)
        ("A400100014040000", &["4300100091010F00"]),
        ("A408100014100000", &["4108100010000000"]),
        ("6000000000000000", &["0043414E6F70656E"]),
        ("8008100000000008", &[]),
        // wrong block size, wrong sequence number, wrong order
        ("A000100080000000", &["8000100002000405"]),
        ("A000100000000000", &["8000100002000405"]),
        ("A000100014000000", &["C600100004000000"]),
        ("A300000000000000", &["8191010F00000000"]),
        ("A280140000000000", &["8000100003000405"]),
        ("A000100014000000", &["C600100004000000"]),
        ("A201140000000000", &["8000100001000405"]),
        ("A003200014000000", &["8003200001000106"]),
    ]);
}

#[test]
fn block_download() {
    let mut bench = Bench::new();
    bench.talk(&[
        ("C217100002000000", &["A41710007F000000"]),
        ("8155660000000000", &["A2017F0000000000"]),
        ("D500000000000000", &["A100000000000000"]),
        // a wrong CRC
        ("C617100002000000", &["A41710007F000000"]),
        ("8100010000000000", &["A2017F0000000000"]),
        ("D500000000000000", &["8017100004000405"]),
        // a gap: only the first is confirmed; the rest comes again
        ("C40220000A000000", &["A40220007F000000"]),
        ("0161626364656667", &[]),
        ("8368690000000000", &["A2017F0000000000"]),
        ("8168690000000000", &["A2017F0000000000"]),
        ("D500000000000000", &["8002200004000405"]),
        ("C202200009000000", &["A40220007F000000"]),
        ("0161626364656667", &[]),
        // the end is lost: the server says how far it came
        ("-", &["A2017F0000000000"]),
        ("8168690000000000", &["A2017F0000000000"]),
        ("D500000000000000", &["A100000000000000"]),
        // refused at the start
        ("C20220000B000000", &["8002200012000706"]),
        ("C200100004000000", &["8000100002000106"]),
        // without a size: refused when it gets too long
        ("C002200000000000", &["A40220007F000000"]),
        ("0161626364656667", &[]),
        ("0261626364656667", &[]),
        ("0361626364656667", &["8002200012000706"]),
        // sequence numbers that are none
        ("C002200000000000", &["A40220007F000000"]),
        ("0000000000000000", &["8002200003000405"]),
        // less than announced; an abort
        ("C202200009000000", &["A40220007F000000"]),
        ("8161626364656667", &["A2017F0000000000"]),
        ("C100000000000000", &["8002200013000706"]),
        ("C202200009000000", &["A40220007F000000"]),
        ("8002200000000008", &[]),
    ]);
    assert_eq!(bench.od.u16(0x1017, 0), Some(0x6655));
    assert_eq!(bench.od.text(0x2002, 0), Some("abcdefghi"));
}

#[test]
fn frames_of_other_kinds_are_passed_over() {
    let mut bench = Bench::new();
    let mut out = Outbox::default();
    let mut ask = |frame: CanFrame| bench.server.on_frame(0, &frame, &mut bench.od, &mut NoHooks, &mut out);
    assert!(!ask(CanFrame::classic(0x605, &[0x40, 0, 0x10, 0, 0, 0, 0, 0])));
    let request = frame("4000100000000000");
    assert!(!ask(CanFrame { can_id: 0x604 | id_flag::RTR, ..request }));
    assert!(!ask(CanFrame { can_id: 0x604 | id_flag::EFF, ..request }));
    assert!(ask(CanFrame { len: 7, ..request }));
    assert!(ask(CanFrame { len: 200, ..request }));
    assert!(out.is_empty());
    assert_eq!(bench.server.counters.ignored, 2);
}

#[test]
fn channels_come_and_go() {
    let mut od = dictionary();
    let mut servers = SdoServers::new(&od, ServerConfig::default());
    let numbers = |servers: &SdoServers| servers.iter().map(|(n, _)| n).collect::<Vec<_>>();
    assert_eq!(numbers(&servers), [0]);
    for (sub, value, want) in [
        (1, 0x0000_0640, Err(Abort::INVALID_VALUE)), // restricted
        (1, 0x0000_0800, Err(Abort::INVALID_VALUE)), // 12 bits without the frame bit
        (1, 0x0000_06E0, Err(Abort::INVALID_VALUE)),
        (1, 0x0000_06C0, Ok(())),
        (1, 0x0000_06C1, Err(Abort::INVALID_VALUE)), // changes while it exists
        (1, 0x8000_06C0, Ok(())),
        (1, 0x2000_16C1, Err(Abort::INVALID_VALUE)), // was still another identifier, now invalid: below
        (2, 0x2000_0123, Ok(())),
        (3, 0, Err(Abort::INVALID_VALUE)),
        (3, 9, Ok(())),
    ] {
        let bytes = u32::to_le_bytes(value);
        let data = if sub == 3 { &bytes[..1] } else { &bytes[..] };
        let got = validate_parameter(&od, 0x1201, sub, data);
        if value == 0x2000_16C1 {
            assert_eq!(got, Ok(()), "an invalid COB-ID may change");
            continue;
        }
        assert_eq!(got, want, "{sub} {value:08X}");
        if got.is_ok() {
            od.write(0x1201, sub, data).unwrap();
        }
    }
    od.write(0x1201, 1, &0x6C0u32.to_le_bytes()).unwrap();
    servers.refresh(&od, SdoServers::channel_of(0x1201).unwrap());
    assert_eq!(numbers(&servers), [0, 1]);
    let channel = servers.iter().nth(1).unwrap().1.channel();
    assert_eq!(channel, Channel { request: 0x6C0, response: 0x8000_0123, node_id: 9 });
    let mut out = Outbox::default();
    let request = CanFrame::classic(0x6C0, &[0x40, 0, 0x10, 0, 0, 0, 0, 0]);
    assert!(servers.on_frame(0, &request, &mut od, &mut NoHooks, &mut out));
    assert_eq!(out.frames()[0].can_id, 0x8000_0123);
    od.write(0x1201, 1, &0x8000_06C0u32.to_le_bytes()).unwrap();
    servers.refresh_all(&od);
    assert_eq!(numbers(&servers), [0]);
    assert_eq!(SdoServers::channel_of(0x1280), None);
    assert_eq!(client_channel(&od, 0), None);
}

proptest! {
    /// Whatever comes, the server neither panics nor stays busy for ever, and answers at most a sub-block.
    #[test]
    fn any_frames(frames in prop::collection::vec((any::<[u8; 8]>(), 0u8..40, 0u64..400_000_000), 0..60)) {
        let mut bench = Bench::new();
        let mut out = Outbox::default();
        for (mut bytes, kind, delay) in frames {
            // Make meaningful commands likely.
            if kind < 24 {
                bytes[0] = [0x40, 0x21, 0x20, 0x23, 0x60, 0x70, 0x00, 0x10, 0x01, 0xA0, 0xA4, 0xA3, 0xA2, 0xA1,
                    0xC0, 0xC2, 0xC6, 0xC1, 0xD5, 0x01, 0x02, 0x81, 0x82, 0x80][usize::from(kind)];
            }
            if bytes[1] & 3 != 0 {
                (bytes[1], bytes[2], bytes[3]) = (bytes[1] & 3, 0x20, 0);
                bytes[5] = 0;
                bytes[6] = 0;
                bytes[7] = 0;
            }
            bench.t_ns += delay;
            bench.server.on_time(bench.t_ns, &mut out);
            bench.server.on_frame(bench.t_ns, &CanFrame::classic(0x604, &bytes), &mut bench.od, &mut NoHooks, &mut out);
            prop_assert!(out.len() <= 130);
            for frame in out.drain() {
                prop_assert_eq!((frame.can_id, frame.len), (0x584, 8));
            }
        }
        bench.server.on_time(u64::MAX, &mut out);
        prop_assert!(!bench.server.is_busy());
    }
}
