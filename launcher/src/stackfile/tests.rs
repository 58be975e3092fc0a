//! The sentences of every mistake, and the wiring of a right stack, with kinds made for the tests.

use super::*;
use crate::explain_keys::{Default as KeyDefault, KeyDoc, ValueKind};
use crate::kinds::{Kind, ServiceConfig, accepts, parse};
use ipc_types::stack::{Finding, ServiceEntry};
use ipc_types::topic::TopicKind;
use ipc_types::units::{BitRate, Span};
use ipc_types::wiring::{Area, ImageRange, Listener, Neighbours, OnBad, Wiring};
use proptest::prelude::*;
use serde::Deserialize;
use std::net::SocketAddr;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Bus {
    bitrate: BitRate,
    listen: Option<SocketAddr>,
    file: Option<PathBuf>,
    #[serde(default)]
    #[allow(dead_code, reason = "only read")]
    mode: Mode,
}

#[derive(Debug, Default, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Mode {
    #[default]
    Classic,
    Flexible,
}

impl ServiceConfig for Bus {
    fn topics(&self, _: &Neighbours) -> Wiring {
        let mut wiring = Wiring::default();
        wiring.own(TopicKind::CanRx).own(TopicKind::CanTx);
        if let Some(address) = self.listen {
            wiring.listeners.push(Listener { name: "tcp".into(), address, key: "listen".into() });
        }
        wiring.files.extend(self.file.clone().map(|f| (f, "file".to_owned())));
        wiring
    }
    fn check(&self, _: &Stack, me: &ServiceEntry) -> Vec<Finding> {
        match self.bitrate.0 {
            500_000 => Vec::new(),
            _ => vec![Finding::warning(&me.name, "bitrate", "an unusual rate", "most buses have \"500k\"")],
        }
    }
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Field {
    bus: String,
    plc: Option<String>,
    #[serde(default)]
    cycle: Span,
    #[serde(default, rename = "in")]
    inputs: Vec<FieldPoint>,
    #[serde(default, rename = "out")]
    outputs: Vec<FieldPoint>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct FieldPoint {
    byte: u32,
    bit: Option<u8>,
    #[serde(default = "one")]
    bytes: u32,
    symbol: Option<String>,
    status: Option<u32>,
}

fn one() -> u32 {
    1
}

fn range(area: Area, list: &str, i: usize, point: &FieldPoint) -> ImageRange {
    ImageRange {
        area,
        byte: point.byte,
        bit: point.bit,
        bytes: point.bytes,
        type_name: None,
        symbol: point.symbol.clone(),
        label: format!("id 12{i}h"),
        key: format!("{list}[{i}].byte"),
        on_bad: OnBad::Hold,
        status_byte: point.status,
    }
}

impl ServiceConfig for Field {
    fn topics(&self, neighbours: &Neighbours) -> Wiring {
        let mut wiring = Wiring { plc: neighbours.resolve("plc", self.plc.as_deref()), ..Wiring::default() };
        wiring.read(format!("{}/rx", self.bus), true, "bus").write(format!("{}/tx", self.bus), "bus");
        let all = |area, list: &'static str, points: &[FieldPoint]| {
            points.iter().enumerate().map(|(i, p)| range(area, list, i, p)).collect::<Vec<_>>()
        };
        wiring.inputs = all(Area::Input, "in", &self.inputs);
        wiring.outputs = all(Area::Output, "out", &self.outputs);
        if !self.inputs.is_empty() {
            wiring.own(TopicKind::Inputs);
        }
        wiring
    }
    fn check(&self, _: &Stack, me: &ServiceEntry) -> Vec<Finding> {
        match self.cycle.ns() {
            1..1_000_000 => vec![Finding::error(&me.name, "cycle", "too fast", "at least \"1ms\"")],
            _ => Vec::new(),
        }
    }
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Plc {
    #[allow(dead_code, reason = "read from the JSON")]
    input_bytes: Option<u32>,
}

impl ServiceConfig for Plc {
    fn topics(&self, _: &Neighbours) -> Wiring {
        let mut wiring = Wiring::default();
        wiring.own(TopicKind::Image).own(TopicKind::Writes).own(TopicKind::Scan).own(TopicKind::Keyframe);
        wiring.read(EVENTS.into(), true, "");
        wiring
    }
    fn check(&self, _: &Stack, _: &ServiceEntry) -> Vec<Finding> {
        Vec::new()
    }
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Rec {}

impl ServiceConfig for Rec {
    fn topics(&self, _: &Neighbours) -> Wiring {
        Wiring { records: true, ..Wiring::default() }
    }
    fn check(&self, _: &Stack, _: &ServiceEntry) -> Vec<Finding> {
        Vec::new()
    }
}

use ipc_types::topic::EVENTS;

const BUS_DOC: &[KeyDoc] = &[KeyDoc {
    key: "bitrate",
    value: ValueKind::BitRate,
    default: KeyDefault::Required,
    meaning: "Nominal bit rate.",
}];

const FIELD_DOC: &[KeyDoc] = &[KeyDoc {
    key: "cycle",
    value: ValueKind::Duration,
    default: KeyDefault::Is("\"0ms\""),
    meaning: "Time between two frames.",
}];

macro_rules! kind {
    ($name:literal, $type:ty, $doc:expr) => {
        Kind {
            name: $name,
            about: "for tests",
            parse: parse::<$type>,
            accepts: accepts::<$type>,
            run: |_| Ok(()),
            config_doc: $doc,
        }
    };
}

static TEST_KINDS: &[Kind] = &[
    kind!("can", Bus, BUS_DOC),
    kind!("can-io", Field, FIELD_DOC),
    kind!("plc", Plc, &[]),
    kind!("recorder", Rec, &[]),
];

fn load_with(text: &str, free_shm: Option<u64>) -> Result<Loaded, LoadError> {
    let name = Path::new("stack.toml");
    let loader =
        Loader { kinds: TEST_KINDS, free_shm, ..Loader::new(name, name, Path::new("/nonexistent/demo")) };
    loader.load(text)
}

/// The message that a text gets.
fn refused(text: &str) -> String {
    match load_with(text, None) {
        Err(error) => error.to_string(),
        Ok(_) => panic!("accepted:\n{text}"),
    }
}

/// A right stack of two buses, a field service, a plc and a recorder; `more` is put behind the field service.
fn stack(more: &str) -> String {
    format!(
        "[stack]\nname = \"demo\"\n\n\
         [[service]]\nname = \"can0\"\nkind = \"can\"\nbitrate = \"500k\"\n\n\
         [[service]]\nname = \"plc\"\nkind = \"plc\"\n\n\
         [[service]]\nname = \"io\"\nkind = \"can-io\"\nbus = \"can0\"\n{more}\n\
         [[service]]\nname = \"rec\"\nkind = \"recorder\"\n"
    )
}

fn service(name: &str, kind: &str, more: &str) -> String {
    format!("[[service]]\nname = \"{name}\"\nkind = \"{kind}\"\n{more}\n")
}

/// One snapshot file a test, whatever the crate is called.
macro_rules! snapshot {
    ($name:literal, $text:expr) => {
        insta::with_settings!({ prepend_module_to_snapshot => false, omit_expression => true }, {
            insta::assert_snapshot!($name, $text);
        })
    };
}

/// Every case's title and message, so that one file shows a whole subject.
fn sentences(cases: &[(&str, String)]) -> String {
    cases
        .iter()
        .map(|(title, text)| format!("### {title}\n{}\n", refused(text)))
        .collect::<Vec<_>>()
        .join("\n")
}

#[test]
fn a_right_stack_is_wired() {
    let text =
        stack("plc = \"plc\"\nin = [{ byte = 0, bytes = 2 }, { byte = 2, bit = 3 }]\nout = [{ byte = 0 }]");
    let loaded = load_with(&text, Some(1 << 40)).unwrap();
    assert!(loaded.findings.is_empty());
    let stack = &loaded.stack;
    assert_eq!(stack.services.iter().map(|s| s.index).collect::<Vec<_>>(), [1, 2, 3, 4]);
    assert_eq!(stack.services[2].config["in"][0]["bytes"], 2);
    assert!(stack.services[2].config.get("name").is_none());
    let mut lines = Vec::new();
    for topic in &stack.topics {
        lines.push(format!(
            "{}: {} -> {} wakes [{}] limits {}/{}",
            topic.name,
            topic.writers.join(" "),
            topic.readers.join(" "),
            topic.wakes.join(" "),
            topic.max_publishers,
            topic.max_subscribers
        ));
    }
    snapshot!("wiring", lines.join("\n"));
}

#[test]
fn the_launchers_keys_are_read() {
    let text = stack(
        "restart = { max = 50, within = \"1min\", on_exhausted = \"fail-stack\" }\nhang_timeout = \"3s\"\nnice = -5\n\
         priority = 40\ncpus = [1, 2]\nmemory_limit = \"64MiB\"\ncritical = false\nenv = { A = \"1\" }\nlog_level = \"debug\"",
    );
    let loaded = load_with(&text, None).unwrap();
    let io = &loaded.launch["io"];
    assert_eq!((io.restart.max, io.restart.within.as_secs(), io.hang_timeout.as_secs()), (50, 60, 3));
    assert_eq!(io.restart.on_exhausted, OnExhausted::FailStack);
    assert_eq!((io.nice, io.fifo_priority, io.cpus.as_slice()), (Some(-5), Some(40), [1, 2].as_slice()));
    assert_eq!((io.memory_limit.unwrap().0, io.critical, io.log_level.as_str()), (64 << 20, false, "debug"));
    assert_eq!(io.env["A"], "1");
    assert_eq!(loaded.launch["rec"], LaunchOptions::default());
    assert_eq!(loaded.launch["rec"].restart.backoff_first.as_millis(), 50);
    assert_eq!(loaded.settings, StackSettings::default());
    assert_eq!(loaded.settings.stop_timeout.as_secs(), 2);
}

#[test]
fn warnings_do_not_refuse() {
    let text = stack("").replace("500k", "125k");
    let loaded = load_with(&text, None).unwrap();
    snapshot!("warning", loaded.findings[0].to_string());
}

#[test]
fn keys() {
    let one = |more: &str| stack(more);
    let cases = [
        ("unknown key", stack("").replace("bitrate", "bitrat")),
        ("unknown key, near one of the launcher", one("hang_timeot = \"1s\"")),
        ("two unknown keys in one table", one("cicle = \"1ms\"\nplcs = \"x\"")),
        ("unknown key in an inner table", one("in = [{ byte = 0 }, { byte = 1, symbl = \"x\" }]")),
        ("table below the wrong service", format!("{}[[service.cycle]]\nx = 1\n", stack(""))),
        ("unknown key of the launcher's table", one("restart = { maxx = 3 }")),
        (
            "unknown key in [stack]",
            stack("").replace("name = \"demo\"", "name = \"demo\"\nstop_timout = \"1s\""),
        ),
        ("unknown table", format!("{}\n[[services]]\nname = \"x\"\n", stack(""))),
        ("wrong type", stack("").replace("\"can0\"\n\n", "5\n\n").replace("bus = \"can0\"", "bus = 5")),
        ("number for a rate with a unit", stack("").replace("\"500k\"", "true")),
        ("missing key", stack("").replace("bitrate = \"500k\"\n", "")),
        ("missing key in an inner table", one("in = [{ bit = 1 }]")),
        ("bad duration", one("cycle = \"10\"")),
        ("duration without a unit", one("cycle = 10")),
        ("unknown value", stack("").replace("bitrate = \"500k\"", "bitrate = \"500k\"\nmode = \"clasic\"")),
        ("name of a host", one("").replace("\"500k\"", "\"500k\"\nlisten = \"meter.local:502\"")),
        ("no port", one("").replace("\"500k\"", "\"500k\"\nlisten = \"10.0.0.1\"")),
        ("no address", one("").replace("\"500k\"", "\"500k\"\nlisten = \"COM1\"")),
        ("number out of range", one("in = [{ byte = -1 }]")),
        ("not a number", one("in = [{ byte = inf }]")),
        (
            "launcher values out of range",
            one("nice = 20\npriority = 0\nmemory_limit = \"1KiB\"\nrestart = { within = 0 }"),
        ),
    ];
    snapshot!("keys", sentences(&cases));
}

#[test]
fn names_and_kinds() {
    let cases = [
        ("syntax error", "[stack]\nname = \"demo\n".to_owned()),
        ("key twice", "[stack]\nname = \"a\"\nname = \"b\"\n".to_owned()),
        ("empty file", String::new()),
        ("no [stack]", service("can0", "can", "bitrate = \"500k\"")),
        ("no services", "[stack]\nname = \"demo\"\n".to_owned()),
        (
            "[stack] without a name",
            "[stack]\ndescription = \"x\"\n[[service]]\nname = \"p\"\nkind = \"plc\"".to_owned(),
        ),
        ("[service] with one bracket", "[stack]\nname = \"demo\"\n[service]\nname = \"plc\"\n".to_owned()),
        ("[service] first", stack("").replacen("[[service]]", "[service] # the bus", 1)),
        ("text without quotes", stack("").replacen("\"500k\"", "slow", 1)),
        ("text without quotes, with signs", stack("").replacen("\"500k\"", "/dev/ttyUSB0 # the bus", 1)),
        ("True", stack("").replacen("\"500k\"", "True", 1)),
        ("duration without quotes", stack("").replacen("\"500k\"", "500k", 1)),
        ("hexadecimal without 0x", stack("").replacen("\"500k\"", "1A0", 1)),
        ("typographic quotes", stack("").replacen("\"500k\"", "“500k”", 1)),
        ("a colon", stack("").replacen("bitrate = ", "bitrate: ", 1)),
        ("service without name and kind", format!("{}[[service]]\nbitrate = \"1M\"\n", stack(""))),
        ("bad name", stack("").replace("name = \"io\"", "name = \"I O\"")),
        ("name of the rail", stack("").replace("name = \"io\"", "name = \"stack\"")),
        ("bad stack name", stack("").replace("\"demo\"", "\"\"")),
        ("duplicate name", format!("{}{}", stack(""), service("io", "plc", ""))),
        ("unknown kind", stack("").replace("\"recorder\"", "\"recoder\"")),
        ("kind to come", stack("").replace("\"recorder\"", "\"j1939\"")),
        ("exec", stack("exec = [\"./mine\"]")),
    ];
    snapshot!("names_and_kinds", sentences(&cases));
}

#[test]
fn neighbours() {
    let two_plcs = format!("{}{}", stack("in = [{ byte = 0 }]"), service("plc2", "plc", ""));
    let cases = [
        ("unknown bus", stack("").replace("bus = \"can0\"", "bus = \"cam0\"")),
        ("a bus that is none", stack("").replace("bus = \"can0\"", "bus = \"plc\"")),
        ("several plc and no key", two_plcs),
        ("unknown plc", stack("plc = \"pcl\"\nout = [{ byte = 0 }]")),
        ("a plc that is none", stack("plc = \"can0\"\nin = [{ byte = 0 }]")),
        (
            "no plc at all",
            stack("in = [{ byte = 0 }]").replace("[[service]]\nname = \"plc\"\nkind = \"plc\"\n", ""),
        ),
        ("a service's own finding", stack("cycle = \"1us\"")),
    ];
    snapshot!("neighbours", sentences(&cases));
}

#[test]
fn conflicts() {
    let other = service("io2", "can-io", "bus = \"can0\"\nin = [{ byte = 1 }]");
    let with_other = |more: &str| format!("{}\n{other}", stack(more));
    let bus = |more: &str| {
        format!("{}{}", stack(""), service("can1", "can", &format!("bitrate = \"500k\"\n{more}")))
    };
    let listening = |a: &str, b: &str| {
        bus(&format!("listen = \"{b}\"")).replacen(
            "bitrate = \"500k\"",
            &format!("bitrate = \"500k\"\nlisten = \"{a}\""),
            1,
        )
    };
    let cases = [
        ("range owned twice", with_other("in = [\n  { byte = 0, bytes = 2 },\n]")),
        ("the same byte", with_other("in = [{ byte = 1 }]")),
        ("a bit of another's byte", with_other("in = [{ byte = 1, bit = 7 }]")),
        ("a status in another's byte", with_other("in = [{ byte = 0, status = 1 }]")),
        ("twice in one service", stack("in = [\n  { byte = 4, bit = 1 },\n  { byte = 4, bit = 1 },\n]")),
        ("beyond %I", stack("in = [{ byte = 4095, bytes = 2 }]")),
        (
            "beyond a smaller %I",
            stack("in = [{ byte = 16 }]").replace("kind = \"plc\"", "kind = \"plc\"\ninput_bytes = 16"),
        ),
        ("status beyond %I", stack("in = [{ byte = 0, status = 5000 }]")),
        ("beyond %Q", stack("out = [{ byte = 70000 }]")),
        (
            "symbol twice",
            stack("in = [{ byte = 0, symbol = \"Speed\" }]\nout = [{ byte = 0, symbol = \"SPEED\" }]"),
        ),
        (
            "symbols that are no names",
            stack("in = [{ byte = 0, symbol = \"IF\" }, { byte = 1, symbol = \"volt raw\" }]"),
        ),
        ("port twice", listening("127.0.0.1:502", "127.0.0.1:502")),
        ("port of all addresses", listening("0.0.0.0:502", "127.0.0.1:502")),
        ("missing file", bus("file = \"capture.log\"")),
        ("folder for a file", bus("file = \"/tmp\"")),
    ];
    snapshot!("conflicts", sentences(&cases));
    for right in [
        with_other("in = [{ byte = 0 }, { byte = 2 }]"),
        stack("in = [{ byte = 4, bit = 1 }, { byte = 4, bit = 2 }]"),
        stack("in = [{ byte = 0, status = 8 }, { byte = 1, status = 8 }]"),
        listening("127.0.0.1:502", "127.0.0.2:502"),
        listening("127.0.0.1:0", "127.0.0.1:0"),
        bus("file = \"/etc/passwd\""),
    ] {
        if let Err(error) = load_with(&right, None) {
            panic!("{error}\n{right}");
        }
    }
}

#[test]
fn shared_memory_is_limited_to_half_of_what_is_free() {
    let loaded = load_with(&stack(""), None).unwrap();
    let need = shared_memory(&loaded.stack);
    assert!(load_with(&stack(""), Some(2 * need)).is_ok());
    let error = load_with(&stack(""), Some(2 * need - 1)).unwrap_err().to_string();
    assert!(error.contains("of shared memory; /dev/shm has") && error.contains("largest: "), "{error}");
}

#[test]
fn too_many_services_are_refused() {
    let mut text = stack("");
    for i in 0..document::SERVICES_MAX {
        text += &service(&format!("p{i}"), "recorder", "");
    }
    assert!(refused(&text).contains("at most 48"), "{}", refused(&text));
}

#[test]
fn files_that_are_no_stack_files_are_refused() {
    let dir = std::env::temp_dir().join(format!("dinrail-stackfile-{}", std::process::id()));
    std::fs::create_dir_all(&dir).unwrap();
    let said = |path: &Path| load(path).unwrap_err().to_string();
    assert!(said(&dir).contains("cannot read the stack file: No such file"));
    let file = dir.join("stack.toml");
    std::fs::write(&file, b"\xff\xfe").unwrap();
    assert!(said(&dir).contains("byte 0 is no UTF-8"));
    std::fs::write(&file, vec![b'#'; (FILE_MAX + 1) as usize]).unwrap();
    assert!(said(&file).contains("at most 1048576"));
    std::fs::write(&file, "[stack]\nname = \"x\"\n").unwrap();
    assert!(said(&dir).contains("the stack has no services"));
    std::fs::remove_dir_all(&dir).unwrap();
}

#[test]
fn the_build_is_identified() {
    let (version, hash) = build_id().rsplit_once('-').unwrap();
    assert_eq!(version, env!("CARGO_PKG_VERSION"));
    assert!(hash.len() == 16 && hash != "0000000000000000", "{hash}");
}

/// Parts that stack files are made of, right and wrong.
fn part() -> impl Strategy<Value = String> {
    prop_oneof![
        Just("[stack]\n".to_owned()),
        Just("name = \"x\"\n".to_owned()),
        Just("[[service]]\n".to_owned()),
        Just("kind = \"can-io\"\nbus = \"can0\"\n".to_owned()),
        Just("kind = \"can\"\nbitrate = \"500k\"\n".to_owned()),
        Just("kind = \"plc\"\n".to_owned()),
        "name = \"[a-c]\"\n",
        "in = \\[\\{ byte = [0-9]{1,10}, bytes = [0-9]{1,10}, bit = [0-9]{1,3}, status = [0-9]{1,10} \\}\\]\n",
        "[a-z_]{1,8} = (-?[0-9]{1,4}|\"[a-z0-9%.]{0,6}\"|\\[\\]|\\{\\}|true|inf|1979-05-27)\n",
        "restart = \\{ [a-z]{1,6} = [0-9]{1,3} \\}\n",
        "\\[\\[?service\\.[a-z]{1,4}\\]?\\]\n",
        "[ -~\u{fc}\n\t]{0,12}",
    ]
}

proptest! {
    #[test]
    fn no_text_panics(text in any::<String>()) {
        if let Err(error) = load_with(&text, Some(1 << 30)) {
            prop_assert!(!error.to_string().is_empty());
        }
    }

    #[test]
    fn nothing_made_of_parts_panics(parts in prop::collection::vec(part(), 0..24)) {
        let text: String = parts.concat();
        if let Err(error) = load_with(&text, Some(1 << 30)) {
            prop_assert!(error.errors() > 0);
            prop_assert!(error.findings.iter().all(|f| !f.to_string().is_empty()));
        }
    }

    #[test]
    fn a_right_stack_with_one_change_never_panics(at in 0usize..400, c in any::<char>()) {
        let mut text = stack("in = [{ byte = 0, bytes = 2, symbol = \"a\" }]\nrestart = { max = 3 }");
        let at = text.floor_char_boundary(at.min(text.len()));
        text.insert(at, c);
        let _ = load_with(&text, Some(1 << 30)).map_err(|e| e.to_string());
    }
}
