//! Screens as text, and what the model's tests are fed with.

use super::draw::draw;
use super::feed::{Point, Shot, Snapshot, Told};
use super::model::{Key, Model};
use crate::supervise::control::{LogLine, ServiceRow, StackStatus};
use ipc_types::event::{EventBody, EventKind, Level};
use ipc_types::payload::PlcState;
use ratatui::Terminal;
use ratatui::backend::TestBackend;
use serde_json::{Value, json};

const S: u64 = 1_000_000_000;
/// 12:00:00 UTC.
const NOON: i64 = 1_700_049_600_000_000_000;

pub fn row(service: &str, kind: &str) -> ServiceRow {
    ServiceRow {
        service: service.into(),
        kind: kind.into(),
        state: "running".into(),
        health: "ready".into(),
        pid: 4242,
        generation: 1,
        restarts: 0,
        uptime_ms: 185_000,
        cpu_percent: 1.25,
        rss_bytes: 5 << 20,
        deaths: 0,
        unstable: false,
    }
}

fn statuses(second: u64) -> Vec<(&'static str, Value)> {
    vec![
        (
            "rec",
            json!({ "file": "/x/recordings/demo-1.mcap", "bytes": 3 << 20, "mb_per_h": 18.9, "messages_per_s": 127,
                    "missed": 0, "dropped": 0 }),
        ),
        (
            "can0",
            json!({ "backend": "virtual", "load_permille": 437, "rx": 10_000 + 2000 * second, "tx": 10 * second,
                    "bus": { "client_drops": 3 }, "tx_queue": { "refused": 0 }, "tx_invalid": 0 }),
        ),
        (
            "can1",
            json!({ "backend": "socketcan", "load_permille": 0, "rx": 0, "tx": 0,
                    "link": { "up": true, "state": "bus_off", "tec": 255, "rec": 0, "kernel_drops": 0, "bus_off": 2,
                              "trouble": "nobody acknowledges: termination, bit rate, partner?" },
                    "wire": { "errors": 17 } }),
        ),
        (
            "line",
            json!({ "device": "/dev/ttyUSB0", "rx_bytes": 100 * second, "tx_bytes": 7, "framing_errors": 0 }),
        ),
        (
            "plc",
            json!({ "state": "run", "scan": 100 * second, "program": ["main.st"], "scan_us": { "average": 12.4,
                    "max": 80.2 }, "periods_skipped": 1, "forces": ["Main.Limit"], "faults": 0 }),
        ),
        (
            "modbus",
            json!({ "client_list": [
                { "address": "192.168.1.20", "port": 50123, "connected_s": 65, "idle_s": 0, "requests": 812,
                  "exceptions": 2, "last_unit": 1, "last_function": 3 },
                { "address": "fe80::1", "port": 50124, "connected_s": 5, "idle_s": 4, "requests": 1, "exceptions": 0,
                  "last_unit": 1, "last_function": 16 } ] }),
        ),
    ]
}

/// A stack at a second of its life.
pub fn snapshot(second: u64) -> Snapshot {
    let mut rows = vec![
        row("rec", "recorder"),
        row("can0", "can"),
        row("can1", "can"),
        row("line", "serial"),
        row("plc", "plc"),
        row("modbus", "modbus-server"),
    ];
    rows[2].health = "degraded".into();
    rows[4].generation = 3;
    rows[4].restarts = 2;
    rows[5].state = "back-off".into();
    rows[5].pid = 0;
    let told = |(service, body): (&str, Value)| Told {
        service: service.to_owned(),
        generation: 1,
        t_ns: S + second * S,
        body,
    };
    let point = |symbol: Option<&str>, address: &str, type_name: &str, value: &str| Point {
        address: address.into(),
        symbol: symbol.map(str::to_owned),
        type_name: type_name.into(),
        service: "io".into(),
        value: value.into(),
    };
    let mut input = vec![0u8; 40];
    (input[0], input[39]) = (0x2A, 0xFF);
    Snapshot {
        t_ns: S + second * S,
        utc_ns: NOON + (second * S) as i64,
        stack: Some(StackStatus {
            stack: "demo".into(),
            pid: 7,
            build_id: "x".into(),
            state: "degraded".into(),
            uptime_ms: 185_000,
            services: 6,
            ready: 4,
            held: vec![],
            unstable: vec![],
            degraded: vec![],
            failed: None,
        }),
        rows,
        told: statuses(second).into_iter().map(told).collect(),
        images: vec![Shot {
            plc: "plc".into(),
            state: PlcState::Run,
            scan: 100 * second,
            points: vec![
                point(Some("Speed"), "%IW0", "UINT", "42"),
                point(Some("Barrier"), "%IX4.0", "BOOL", "FALSE"),
                point(None, "%QW0", "UINT", "65535"),
            ],
            areas: vec![('I', input), ('Q', vec![0xFF, 0xFF]), ('M', vec![])],
        }],
        events: vec![],
    }
}

fn event(second: i64, level: Level, service: &str, message: &str) -> EventBody {
    let body = EventBody::now(EventKind::Died, level, service, message, Value::Null);
    EventBody { utc_ns: NOON + second * S as i64, ..body }
}

fn model() -> Model {
    let mut model = Model::new("demo");
    let mut first = snapshot(0);
    first.events = vec![
        event(-70, Level::Info, "plc", "program main.st loaded"),
        event(-3, Level::Fault, "modbus", "ended by signal 9 (SIGKILL)"),
        event(-2, Level::Warning, "modbus", "starting again in 400 ms"),
    ];
    model.take(first);
    model.take(snapshot(1));
    model
}

fn screen(model: &Model, width: u16, height: u16) -> String {
    let mut terminal = Terminal::new(TestBackend::new(width, height)).unwrap();
    terminal.draw(|frame| draw(model, frame)).unwrap();
    terminal.backend().to_string()
}

#[test]
fn wide() {
    insta::assert_snapshot!(screen(&model(), 130, 44));
}

#[test]
fn the_classic_terminal() {
    insta::assert_snapshot!(screen(&model(), 80, 24));
}

#[test]
fn a_narrow_and_low_one() {
    insta::assert_snapshot!(screen(&model(), 40, 9));
}

#[test]
fn views() {
    let mut model = model();
    model.key(Key::Char('e'));
    insta::assert_snapshot!("events", screen(&model, 80, 8));
    model.key(Key::Char('i'));
    insta::assert_snapshot!("image", screen(&model, 80, 12));
    model.key(Key::Char('?'));
    insta::assert_snapshot!("help", screen(&model, 64, 16));
    model.key(Key::Char('q'));
    model.key(Key::Char('G'));
    model.key(Key::Char('l'));
    let line =
        |n: i64| LogLine { utc_ns: NOON + n, service: "modbus".into(), line: format!("line {n}\x1b[2J") };
    model.take_log("modbus", (0..30).map(line).collect());
    model.key(Key::Up);
    insta::assert_snapshot!("log", screen(&model, 60, 6));
}

#[test]
fn a_question_and_a_stack_that_went_down() {
    let mut model = model();
    model.key(Key::Char('r'));
    assert!(screen(&model, 80, 24).contains("restart rec? y/n"));
    model.lose("stack 'demo' is down; waiting for it to come back, q ends".into());
    let shown = screen(&model, 80, 24);
    assert!(
        shown.contains("is down; waiting") && !shown.contains("4242") && !shown.contains("y/n"),
        "{shown}"
    );
}

#[test]
fn before_the_first_look_and_with_nonsense_in_it() {
    let empty = Model::new("demo");
    assert!(screen(&empty, 80, 24).contains("stack demo"));
    let mut odd = snapshot(3);
    for told in &mut odd.told {
        told.body = json!({ "link": 5, "program": {}, "client_list": [7, {}], "file": [], "load_permille": "x",
                            "forces": null, "scan": -1, "note": "a\u{1b}b" });
    }
    let mut model = model();
    model.take(odd);
    assert!(screen(&model, 120, 50).contains("no program"));
    for (width, height) in [(1, 1), (3, 2), (19, 50), (20, 3), (21, 4), (500, 3), (25, 200)] {
        for key in ['e', 'i', '?', 'q', 'l'] {
            model.key(Key::Char(key));
            screen(&model, width, height);
        }
        model.key(Key::Escape);
    }
    assert_eq!(screen(&model, 10, 2), "\"10 x 2 is \"\n\"          \"\n");
}
