//! The shared case files: one program, the value of every output in every scan.

use std::path::PathBuf;

use dinrail_iec::artifact::{ElemType, TrapId};
use dinrail_iec::{Options, Source};

use crate::host::{Host, Value};

/// Folder of the case files, or `None` with a loud line; a failure when DINRAIL_NO_SKIP=1.
fn folder() -> Option<PathBuf> {
    let root = std::env::var_os("DINRAIL_CASES").map_or_else(
        || PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../../shared/cases"),
        PathBuf::from,
    );
    let dir = root.join("iec");
    if dir.is_dir() {
        return Some(dir);
    }
    let text = format!("SKIPPED: no case files in {} (set DINRAIL_CASES)", dir.display());
    assert!(std::env::var("DINRAIL_NO_SKIP").as_deref() != Ok("1"), "{text}");
    eprintln!("{text}");
    None
}

fn load(name: &str) -> Option<Host> {
    let path = folder()?.join(format!("{name}.st"));
    let text = std::fs::read_to_string(&path).unwrap();
    let sources = [Source { name: format!("{name}.st"), text }];
    Some(Host::from_sources(&sources, &Options::default()))
}

/// Inputs and outputs of a case lie in its one program; TIME in ms.
fn run(name: &str) {
    let Some(mut host) = load(name) else { return };
    let text = std::fs::read_to_string(folder().unwrap().join(format!("{name}.case.json"))).unwrap();
    let case: serde_json::Value = serde_json::from_str(&text).unwrap();
    let scans = case["scans"].as_array().unwrap();
    assert!(!scans.is_empty());
    for scan in scans {
        let n = &scan["scan"];
        for (var, value) in scan["in"].as_object().into_iter().flatten() {
            let v = value_of(&host, var, value);
            host.set(var, v);
        }
        host.scan_at(scan["t_ms"].as_i64().unwrap() * 1_000_000)
            .unwrap_or_else(|f| panic!("{name} scan {n}: {f:?}"));
        for (var, value) in scan["out"].as_object().unwrap() {
            let expected = value_of(&host, var, value);
            let got = host.get(var);
            let same = match (expected, got) {
                (Value::Real(e), Value::Real(g)) => (e - g).abs() <= 1e-9 * e.abs().max(1.0),
                (e, g) => e == g,
            };
            assert!(same, "{name} scan {n} {var}: expected {expected:?}, got {got:?}");
        }
    }
}

fn value_of(host: &Host, var: &str, json: &serde_json::Value) -> Value {
    let symbol = host.artifact.map.symbol(var).unwrap_or_else(|| panic!("no variable {var}"));
    match symbol.elem {
        ElemType::Bool => Value::from(json.as_bool().unwrap()),
        ElemType::Time => Value::Int(i128::from(json.as_i64().unwrap()) * 1_000_000),
        ElemType::Real | ElemType::Lreal => Value::Real(json.as_f64().unwrap()),
        _ => Value::Int(i128::from(json.as_i64().unwrap())),
    }
}

macro_rules! cases {
    ($($name:ident),* $(,)?) => {$(#[test] fn $name() { run(stringify!($name)); })*};
}
cases!(bubble1000, fb_counters, fb_timers, math100k, st_arith_conv, st_for_bounds, st_for_limits);

#[test]
fn st_runtime_faults() {
    let Some(mut host) = load("st_runtime_faults") else { return };
    host.run();
    assert_eq!(host.int("alive"), 1);
    for (sel, fault) in [(1, TrapId::DivisionByZero), (3, TrapId::IndexOutOfBounds)] {
        let mut host = load("st_runtime_faults").unwrap();
        host.set("sel", Value::Int(sel));
        let f = host.scan_at(0).unwrap_err();
        assert_eq!(f.id, fault);
        let line = if sel == 1 { 18 } else { 20 };
        assert!(f.place.starts_with(&format!("st_runtime_faults.st:{line}:")), "{}", f.place);
        let value = if sel == 1 { 100 } else { 10 };
        assert_eq!(f.value, value);
        assert_eq!(host.artifact.map.instance_at(f.instance).unwrap().path, "prg");
    }
    host.set("sel", Value::Int(2));
    host.run();
    assert_eq!(host.int("r"), 0);
    assert_eq!(host.u32(dinrail_iec::artifact::sys::WARNINGS), 1);
    host.set("sel", Value::Int(6));
    host.run();
    assert_eq!(host.int("r"), -2_147_483_648);
}

/// Languages that are not there yet are refused in so many words.
#[test]
fn other_languages_are_refused() {
    let Some(dir) = folder() else { return };
    for (file, code) in [
        ("il_ctu.il", "E0902"),
        ("il_operators.il", "E0902"),
        ("il_sr.il", "E0902"),
        ("il_boolean_set_reset.il", "E0902"),
        ("sfc_counter_five_lang.sfc.st", "E0902"),
        ("sfc_simultaneous.sfc.st", "E0902"),
        ("sfc_qualifiers_set_reset_time.sfc.st", "E0902"),
        ("xml_fbd_en_eno.plc.xml", "E0903"),
    ] {
        let text = std::fs::read_to_string(dir.join(file)).unwrap();
        let sources = [Source { name: file.to_owned(), text }];
        let d = dinrail_iec::compile(&sources, &Options::default()).unwrap_err();
        assert!(d.items().iter().any(|i| i.code == code), "{file}: {}", d.render(false));
        assert_eq!(d.error_count(), 1, "{file}: {}", d.render(false));
    }
}
