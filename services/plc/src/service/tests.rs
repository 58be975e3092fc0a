use super::*;
use ipc_types::wiring::{Area, ImageRange, OnBad};
use serde_json::json;

fn range(area: Area, byte: u32, bytes: u32, symbol: Option<&str>) -> ImageRange {
    ImageRange {
        area,
        byte,
        bit: None,
        bytes,
        type_name: None,
        symbol: symbol.map(str::to_owned),
        label: format!("id 123h at byte {byte}"),
        key: "in[0].to".into(),
        on_bad: OnBad::Hold,
        status_byte: None,
    }
}

/// A stack of a plc with this table and one field service with these ranges.
fn stack(dir: &std::path::Path, ranges: Vec<ImageRange>) -> Stack {
    let entry = |name: &str, kind: &str, index: u32, wiring: Wiring| ServiceEntry {
        name: name.into(),
        kind: kind.into(),
        index,
        config: serde_json::Value::Null,
        wiring,
    };
    let field = Wiring { plc: Some("plc".into()), inputs: ranges, ..Wiring::default() };
    Stack {
        name: "test".into(),
        file: dir.join("stack.toml"),
        dir: dir.to_owned(),
        text: String::new(),
        build_id: String::new(),
        root: dir.to_owned(),
        prefix: String::new(),
        services: vec![entry("io", "can-io", 1, field), entry("plc", "plc", 2, Wiring::default())],
        topics: Vec::new(),
    }
}

fn found(config: serde_json::Value, program: &str, ranges: Vec<ImageRange>) -> Vec<String> {
    static NUMBER: std::sync::atomic::AtomicU32 = std::sync::atomic::AtomicU32::new(0);
    let n = NUMBER.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
    let dir = std::env::temp_dir().join(format!("dinrail-plc-check-{}-{n}", std::process::id()));
    std::fs::create_dir_all(&dir).unwrap();
    std::fs::write(dir.join("main.st"), program).unwrap();
    let stack = stack(&dir, ranges);
    let config: Config = serde_json::from_value(config).unwrap();
    let findings = check(&config, &stack, &stack.services[1]);
    std::fs::remove_dir_all(&dir).unwrap();
    findings.iter().map(|f| format!("{}.{}: {}", f.service, f.key, f.message)).collect()
}

const GOOD: &str = "PROGRAM main VAR n AT %QW0 : UINT; END_VAR n := Level; END_PROGRAM";

#[test]
fn a_right_table_has_no_findings_and_symbols_are_globals() {
    let level = range(Area::Input, 2, 2, Some("Level"));
    assert_eq!(found(json!({ "program": ["main.st"], "cycle": "10ms" }), GOOD, vec![level]), [""; 0]);
}

#[test]
fn mistakes_are_found_without_starting() {
    let program = json!({ "program": ["main.st"] });
    let level = || range(Area::Input, 2, 2, Some("Level"));
    let table = [
        (json!({ "trigger": "inputs", "cycle": "10ms" }), GOOD, vec![], "plc.cycle: cycle and trigger"),
        (json!({ "cycle": "50us", "route": [] }), GOOD, vec![], "plc.cycle: a cycle of 50us is not possible"),
        (
            json!({ "min_interval": "1s" }),
            GOOD,
            vec![],
            "plc.min_interval: min_interval 1s and max_interval 100ms",
        ),
        (
            json!({ "max_interval": "5s" }),
            GOOD,
            vec![],
            "plc.max_interval: max_interval 5s is longer than 1s",
        ),
        (
            json!({ "input_timeout": "50ms" }),
            GOOD,
            vec![],
            "plc.input_timeout: input_timeout 50ms is shorter",
        ),
        (json!({ "watchdog": "1us" }), GOOD, vec![], "plc.watchdog: a watchdog of 1us is not possible"),
        (
            json!({ "input_bytes": "1MiB" }),
            GOOD,
            vec![],
            "plc.input_bytes: input_bytes = 1MiB is not possible",
        ),
        (
            json!({ "route": [{ "from": "%IW0", "to": "%IW2" }] }),
            GOOD,
            vec![],
            "plc.route[0]: '%IW2' lies in %I",
        ),
        (json!({}), GOOD, vec![], "plc.: neither program nor route"),
        (json!({ "retain_file": "nowhere/a.retain" }), GOOD, vec![], "plc.retain_file: "),
        (json!({ "retain_file": "." }), GOOD, vec![], "plc.retain_file: "),
        (program.clone(), GOOD, vec![], "plc.program: the program does not compile:\nerror["),
        (
            program.clone(),
            GOOD,
            vec![range(Area::Input, 3, 2, Some("Level"))],
            "io.in[0].to: symbol 'Level': byte 3",
        ),
        (
            json!({ "input_bytes": 8 }),
            GOOD,
            vec![range(Area::Input, 7, 2, None)],
            "io.in[0].to: 'id 123h at byte 7' ends at byte 9",
        ),
        (
            program.clone(),
            "PROGRAM main VAR i AT %IB9 : USINT; END_VAR i := 1; END_PROGRAM",
            vec![level()],
            "plc.program: main.st:1:",
        ),
        (
            json!({ "program": ["main.st"], "cycle": "10ms" }),
            "PROGRAM p VAR n : INT; END_VAR n := 1; END_PROGRAM CONFIGURATION c RESOURCE r ON PLC TASK t(INTERVAL := T#10ms, PRIORITY := 0); PROGRAM i WITH t : p; END_RESOURCE END_CONFIGURATION",
            vec![],
            "plc.program: the program does not compile:\nerror[",
        ),
        (
            program.clone(),
            "PROGRAM p VAR n : INT; END_VAR n := 1; END_PROGRAM CONFIGURATION c RESOURCE r ON PLC TASK t(INTERVAL := T#99us, PRIORITY := 0); PROGRAM i WITH t : p; END_RESOURCE END_CONFIGURATION",
            vec![],
            "plc.program: TASK t has an INTERVAL of 99us",
        ),
    ];
    for (config, text, ranges, expected) in table {
        let findings = found(config.clone(), text, ranges);
        assert!(
            findings.iter().any(|f| f.starts_with(expected)),
            "{config}: expected {expected:?} in {findings:#?}"
        );
    }
}

#[test]
fn two_engines_do_not_share_a_retain_file() {
    let dir = std::env::temp_dir();
    let mut stack = stack(&dir, Vec::new());
    let mut other = stack.services[1].clone();
    (other.name, other.index) = ("plc2".into(), 3);
    for (theirs, wrong) in [("a.retain", true), ("b.retain", false)] {
        other.config = json!({ "retain_file": theirs });
        stack.services.truncate(2);
        stack.services.push(other.clone());
        let config: Config = serde_json::from_value(json!({ "retain_file": "a.retain" })).unwrap();
        let findings = check(&config, &stack, &stack.services[1]);
        let said = findings.iter().any(|f| f.key == "retain_file" && f.message.contains("'plc2'"));
        assert_eq!(said, wrong, "{theirs}");
    }
}

#[test]
fn what_it_needs_of_the_rail() {
    let neighbours = Neighbours { name: "plc".into(), ..Neighbours::default() };
    let config: Config =
        serde_json::from_value(json!({ "program": ["a.st"], "marker_bytes": "64KiB" })).unwrap();
    let wiring = topics(&config, &neighbours);
    let kinds: Vec<&str> = wiring.topics.iter().map(|t| t.kind.row().suffix).collect();
    assert_eq!(kinds, ["image", "writes", "scan", "keyframe", "jobs", "results"]);
    assert_eq!(wiring.topics[0].max_tail, 4096 + 4096 + 65536);
    assert_eq!(wiring.retain_bytes as usize, MEMORY_BYTES);
    assert_eq!(wiring.files, [("a.st".into(), "program[0]".to_owned())]);
}

#[test]
fn unknown_keys_and_wrong_units_are_refused() {
    for bad in [json!({ "cylce": "10ms" }), json!({ "cycle": 10 }), json!({ "on_fault": "restart" })] {
        assert!(serde_json::from_value::<Config>(bad.clone()).is_err(), "{bad}");
    }
}

#[test]
fn the_watchdog_follows_the_fastest_task_within_limits() {
    let config = Config::default();
    for (shortest_ns, expected_ms) in
        [(None, 100), (Some(1_000_000), 100), (Some(50_000_000), 500), (Some(1_000_000_000), 1000)]
    {
        assert_eq!(watchdog_limit(&config, shortest_ns), Duration::from_millis(expected_ms));
    }
}

mod any_job {
    use super::*;
    use proptest::prelude::*;

    fn engine() -> Engine {
        let setup = Setup { cycle_ns: Some(10_000_000), ..Setup::default() };
        let text = "PROGRAM main VAR a : ARRAY [-3..3, 1..2] OF INT; t : TIME; b AT %QX0.1 : BOOL; r : LREAL; END_VAR ; END_PROGRAM";
        let sources = vec![dinrail_iec::Source { name: "a.st".into(), text: text.into() }];
        let program = program::compile_sources(sources, &setup).unwrap().program;
        Engine::new(&Runtime::new().unwrap(), Some(program), std::sync::Arc::new(setup)).unwrap()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn is_answered_without_panic(
            jobs in prop::collection::vec((
                "(run|stop|force|unforce|read|write|load|x)?",
                "(main\\.)?(a|t|b|r|%Q[XBWDL]?|é)(\\[?-?[0-9]{0,20},?-?[0-9]{0,3}\\]?)?(\\.[0-9]{0,9})?",
                prop_oneof![any::<i64>().prop_map(|n| json!(n)), any::<f64>().prop_map(|x| json!(x)),
                            "\\PC{0,12}".prop_map(|s| json!(s)), Just(json!(null)), Just(json!([1])), Just(json!(true))],
            ), 1..40),
            bytes in prop::collection::vec(any::<u8>(), 0..60),
        ) {
            let engine = engine();
            prop_assert!(jobs::parse(&bytes, &engine, &[]).is_err());
            for (what, var, value) in jobs {
                let job = json!({ "do": what, "var": var, "value": value, "path": var });
                let _ = jobs::parse(&serde_json::to_vec(&job).unwrap(), &engine, &[]);
                let job = json!({ "do": what, "set": [job, value] });
                let _ = jobs::parse(&serde_json::to_vec(&job).unwrap(), &engine, &[]);
            }
        }
    }
}

mod event_trigger {
    use super::*;
    use ipc_types::stack::Severity;
    use ipc_types::wiring::ServiceEvent;

    /// Kind, table and wiring.
    type Io<'a> = (&'a str, serde_json::Value, Wiring);

    /// What is said about a trigger by such an 'io'.
    fn said(config: serde_json::Value, io: Io<'_>, program: &str) -> Vec<(bool, String)> {
        static NUMBER: std::sync::atomic::AtomicU32 = std::sync::atomic::AtomicU32::new(0);
        let n = NUMBER.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
        let dir = std::env::temp_dir().join(format!("dinrail-plc-event-{}-{n}", std::process::id()));
        std::fs::create_dir_all(&dir).unwrap();
        std::fs::write(dir.join("main.st"), program).unwrap();
        let mut stack = stack(&dir, Vec::new());
        let (kind, table, wiring) = io;
        stack.services[0] =
            ServiceEntry { kind: kind.into(), config: table, wiring, ..stack.services[0].clone() };
        let config: Config = serde_json::from_value(config).unwrap();
        let findings = check(&config, &stack, &stack.services[1]);
        std::fs::remove_dir_all(&dir).unwrap();
        findings
            .iter()
            .map(|f| {
                (
                    f.severity == Severity::Error,
                    format!("{}.{}: {} | {}", f.service, f.key, f.message, f.help),
                )
            })
            .collect()
    }

    fn wiring(plc: Option<&str>, events: &[ServiceEvent]) -> Wiring {
        Wiring { plc: plc.map(str::to_owned), events: events.to_vec(), ..Wiring::default() }
    }

    const PLAIN: &str = "PROGRAM main VAR n : UINT; END_VAR n := n + 1; END_PROGRAM";
    const TIMED: &str = "PROGRAM p VAR n : INT; END_VAR n := 1; END_PROGRAM CONFIGURATION c RESOURCE r ON PLC TASK t(INTERVAL := T#10ms, PRIORITY := 0); PROGRAM i WITH t : p; END_RESOURCE END_CONFIGURATION";

    #[test]
    fn what_can_trigger_is_said() {
        let sync = [ServiceEvent::Sync];
        let event = |service: &str| json!({ "program": ["main.st"], "trigger": { "service": service, "event": "sync" } });
        let master = |period: &str| json!({ "sync_period": period });
        let with = |key: &str, value: &str| {
            let mut config = event("io");
            config[key] = json!(value);
            config
        };
        let table: Vec<(serde_json::Value, Io<'_>, &str, &str)> = vec![
            (event("io"), ("canopen-master", master("10ms"), wiring(Some("plc"), &sync)), PLAIN, ""),
            (
                event("oi"),
                ("canopen-master", master("10ms"), wiring(Some("plc"), &sync)),
                PLAIN,
                "plc.trigger.service: there is no service 'oi' | write service = \"io\"",
            ),
            (
                event("io"),
                ("can", json!({}), wiring(None, &[])),
                PLAIN,
                "plc.trigger.service: 'io' is a can service, which has no event \"sync\" | only a canopen-master with sync_period and synchronous inputs has it; take trigger = \"inputs\" for others",
            ),
            (
                event("io"),
                ("can-io", json!({}), wiring(Some("plc"), &[])),
                PLAIN,
                "plc.trigger.service: 'io' is a can-io service, which has no event \"sync\" | only",
            ),
            (
                event("io"),
                ("canopen-master", master("10ms"), wiring(Some("plc2"), &sync)),
                PLAIN,
                "plc.trigger.service: the inputs of 'io' go to 'plc2', not to 'plc' | move",
            ),
            (
                event("io"),
                ("canopen-master", json!({}), wiring(Some("plc"), &[])),
                PLAIN,
                "plc.trigger.service: 'io' sends no SYNC: it has no sync_period | set sync_period = \"10ms\" in service 'io'",
            ),
            (
                event("io"),
                ("canopen-master", master("10ms"), wiring(Some("plc"), &[])),
                PLAIN,
                "plc.trigger.service: 'io' has no synchronous inputs, so that it publishes no sample at a SYNC | map",
            ),
            (
                event("io"),
                ("canopen-master", master("10ms"), wiring(Some("plc"), &sync)),
                TIMED,
                "plc.trigger: trigger = { service = \"io\", event = \"sync\" } triggers nothing: every TASK of the program has INTERVAL or SINGLE | leave",
            ),
            (
                with("cycle", "10ms"),
                ("canopen-master", master("10ms"), wiring(Some("plc"), &sync)),
                PLAIN,
                "plc.cycle: cycle and trigger = { service = \"io\", event = \"sync\" } exclude each other | leave cycle out",
            ),
            // The key `plc` that the master lacks is told there.
            (event("io"), ("canopen-master", master("10ms"), wiring(None, &sync)), PLAIN, ""),
        ];
        for (config, io, program, expected) in table {
            let found = said(config.clone(), io, program);
            match expected {
                "" => assert_eq!(found, [], "{config}"),
                _ if config.get("cycle").is_some() => {
                    assert!(matches!(&found[..], [(true, text)] if text.starts_with(expected)), "{found:#?}");
                }
                _ => assert!(
                    found.iter().any(|(error, text)| *error && text.starts_with(expected)),
                    "{config}: expected {expected:?} in {found:#?}"
                ),
            }
        }
        for (config, expected) in [
            (
                with("max_interval", "10ms"),
                "plc.max_interval: max_interval = 10ms is not longer than the sync_period",
            ),
            (
                with("min_interval", "11ms"),
                "plc.min_interval: min_interval = 11ms is longer than the sync_period",
            ),
        ] {
            let io = ("canopen-master", master("10ms"), wiring(Some("plc"), &sync));
            let found = said(config, io, PLAIN);
            assert!(matches!(&found[..], [(false, text)] if text.starts_with(expected)), "{found:#?}");
        }
    }

    #[test]
    fn other_forms_are_refused_when_the_table_is_read() {
        for (bad, expected) in [
            (
                json!({ "trigger": "sync" }),
                "expected \"cycle\", \"inputs\" or { service = \"io\", event = \"sync\" }",
            ),
            (
                json!({ "trigger": { "service": "io", "event": "snyc" } }),
                "unknown variant `snyc`, expected `sync`",
            ),
            (json!({ "trigger": { "service": "io" } }), "missing field `event`"),
            (json!({ "trigger": { "service": "io", "event": "sync", "every": 2 } }), "unknown field `every`"),
            (json!({ "trigger": 5 }), "expected \"cycle\", \"inputs\" or"),
        ] {
            let error = serde_json::from_value::<Config>(bad.clone()).unwrap_err().to_string();
            assert!(error.contains(expected), "{bad}: {error}");
        }
        let event: Config =
            serde_json::from_value(json!({ "trigger": { "service": "io", "event": "sync" } })).unwrap();
        let again: Config = serde_json::from_value(serde_json::to_value(&event).unwrap()).unwrap();
        assert_eq!(event, again);
        assert_ne!(event, Config::default());
    }
}
