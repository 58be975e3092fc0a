//! The debug map and the module's outer shape.

use dinrail_iec::artifact::{AreaKind, Artifact, ElemType, MAP_SECTION, Storage, VarKind};
use dinrail_iec::{Addressing, ArtifactError, ExternalSymbol, Options, compile};

use crate::host::{Host, Value, engine, source};
use crate::random::SAMPLE;

#[test]
fn layout_is_in_the_order_of_the_contract() {
    let h = Host::new(
        "VAR_GLOBAL RETAIN a : LINT; b : BOOL; END_VAR PROGRAM p VAR RETAIN c : DINT := 7; END_VAR VAR d : INT; END_VAR END_PROGRAM",
    );
    let l = h.artifact.map.layout;
    assert_eq!((l.input.offset, l.input.bytes), (256, 4096));
    assert_eq!((l.output.offset, l.marker.offset, l.retain.offset), (256 + 4096, 256 + 8192, 256 + 12288));
    assert_eq!(l.retain.bytes, 16);
    assert!(l.data.offset >= l.retain.offset + l.retain.bytes && l.data.offset.is_multiple_of(8));
    assert!(l.temp.offset >= l.data.offset + l.data.bytes && l.temp.offset.is_multiple_of(8));
    for s in &h.artifact.map.symbols {
        let area = if s.retain { l.retain } else { l.data };
        assert!(s.offset >= area.offset && s.offset + s.elem.bytes() <= area.offset + area.bytes, "{s:?}");
        assert_eq!(s.offset % s.elem.bytes(), 0);
        assert_eq!(s.area == AreaKind::Retain, s.retain);
    }
    let odd = Host::with(
        "PROGRAM p END_PROGRAM",
        &Options { input_bytes: 3, output_bytes: 0, marker_bytes: 9, ..Options::default() },
    );
    let l = odd.artifact.map.layout;
    assert_eq!((l.output.offset, l.marker.offset, l.retain.offset), (264, 264, 280));
}

#[test]
fn symbols_of_everything() {
    let h = Host::new(SAMPLE);
    let list: Vec<String> = h
        .artifact
        .map
        .symbols
        .iter()
        .map(|s| {
            let dims: Vec<String> = s.dims.iter().map(|(a, b)| format!("{a}..{b}")).collect();
            format!(
                "{} : {}{} {:?} {:?}{}{} line {}:{}",
                s.path,
                s.elem.name(),
                if dims.is_empty() { String::new() } else { format!("[{}]", dims.join(",")) },
                s.area,
                s.kind,
                if s.retain { " retain" } else { "" },
                s.address.as_ref().map_or_else(String::new, |a| format!(" {a}")),
                s.line,
                s.column
            )
        })
        .collect();
    insta::assert_snapshot!(list.join("\n"));
    assert_eq!(h.artifact.map.instances.iter().filter(|i| i.type_name == "filter").count(), 4);
}

#[test]
fn accesses_to_the_image() {
    let h = Host::new(
        "VAR_GLOBAL q AT %QX1.3 : BOOL; unused AT %QB9 : BYTE; END_VAR
         PROGRAM p VAR i AT %IW4 : INT; m AT %MW0 : ARRAY [0..9] OF INT; n : INT; END_VAR q := i > m[n]; %MB50 := 3; m[2] := 1; END_PROGRAM",
    );
    let map = &h.artifact.map;
    let show = |list: &[dinrail_iec::artifact::Access]| -> Vec<(AreaKind, u32, u32, Option<u8>)> {
        list.iter().map(|a| (a.area, a.byte, a.bytes, a.bit)).collect()
    };
    assert_eq!(
        show(&map.writes),
        [(AreaKind::Output, 1, 1, Some(3)), (AreaKind::Marker, 50, 1, None), (AreaKind::Marker, 4, 2, None)]
    );
    assert_eq!(show(&map.reads), [(AreaKind::Input, 8, 2, None), (AreaKind::Marker, 0, 20, None)]);
    assert_eq!((map.layout.used_input, map.layout.used_output, map.layout.used_marker), (10, 10, 51));
    assert!(map.writes.iter().all(|w| map.place_text(w.statement).starts_with("test.st:2:")));
}

#[test]
fn symbols_of_the_stack_file_are_globals() {
    let external = |name: &str, address: &str, type_name: &str| ExternalSymbol {
        name: name.to_owned(),
        address: address.to_owned(),
        type_name: type_name.to_owned(),
        origin: "stack.toml:12".to_owned(),
    };
    let options = Options {
        externals: vec![
            external("Buttons", "%IB0", "BYTE"),
            external("Lamp", "%QX0.1", "BOOL"),
            external("Spare", "%QW7", "INT"),
        ],
        implicit_cycle_ns: Some(1_000_000),
        ..Options::default()
    };
    let mut h = Host::with(
        "PROGRAM p VAR_EXTERNAL buttons : BYTE; END_VAR lamp := buttons = 16#05; END_PROGRAM",
        &options,
    );
    h.set("Buttons", Value::Int(5));
    h.run();
    assert_eq!(h.int("lamp"), 1);
    let s = h.artifact.map.symbol("Lamp").unwrap();
    assert_eq!((s.kind, s.storage, s.area), (VarKind::Mapped, Storage::Bit(1), AreaKind::Output));
    assert_eq!(h.artifact.map.layout.used_output, 16);
    assert_eq!(h.artifact.map.tasks[0].interval_ns, Some(1_000_000));
    let wrong =
        compile(&source("PROGRAM p VAR_EXTERNAL buttons : INT; END_VAR END_PROGRAM"), &options).unwrap_err();
    assert!(wrong.render(false).contains("stack.toml:12"));
}

#[test]
fn tasks_of_a_configuration() {
    let h = Host::new(
        "VAR_GLOBAL go AT %IX0.0 : BOOL; END_VAR PROGRAM a VAR x : INT; END_VAR x := x + 1; END_PROGRAM PROGRAM b END_PROGRAM
         CONFIGURATION c VAR_GLOBAL k : INT; END_VAR RESOURCE r ON x
           TASK fast(INTERVAL := T#1ms, PRIORITY := 1); TASK once(SINGLE := go, PRIORITY := 0); TASK idle(PRIORITY := 9);
           PROGRAM a1 WITH fast : a; PROGRAM b1 WITH once : b; PROGRAM a2 WITH fast : a; PROGRAM loose : b; PROGRAM z WITH idle : b;
         END_RESOURCE END_CONFIGURATION",
    );
    let t: Vec<_> = h
        .artifact
        .map
        .tasks
        .iter()
        .map(|t| (t.name.as_str(), t.priority, t.interval_ns, t.single.as_deref(), t.programs.join(",")))
        .collect();
    assert_eq!(
        t,
        [
            ("fast", 1, Some(1_000_000), None, "a1,a2".to_owned()),
            ("once", 0, None, Some("go"), "b1".to_owned()),
            ("idle", 9, None, None, "z".to_owned()),
            ("main", 65_535, None, None, "loose".to_owned()),
        ]
    );
    assert!(
        h.artifact.map.symbol("a1.x").is_some()
            && h.artifact.map.symbol("a2.x").is_some()
            && h.artifact.map.symbol("k").is_some()
    );
    let plain = Host::new("PROGRAM Alpha END_PROGRAM PROGRAM beta END_PROGRAM");
    let task = &plain.artifact.map.tasks[0];
    assert_eq!(
        (task.name.as_str(), task.interval_ns, task.programs.join(",")),
        ("main", None, "Alpha,beta".to_owned())
    );
    assert!(plain.artifact.map.call_depth >= 2);
}

#[test]
fn addressing_of_the_three_kinds() {
    for (addressing, byte) in [(Addressing::Element, 4), (Addressing::Byte, 2), (Addressing::OpenPlc, 1028)] {
        let options = Options { addressing, ..Options::default() };
        let h = Host::with("PROGRAM p VAR w AT %QW2 : INT; END_VAR w := 1; END_PROGRAM", &options);
        let s = h.artifact.map.symbol("w").unwrap();
        assert_eq!(s.offset - h.artifact.map.layout.output.offset, byte);
        assert_eq!(s.elem, ElemType::Int);
    }
}

/// A trap that wasm itself raises (the watchdog stops code anywhere) is found by its offset in the function.
#[test]
fn lines_of_functions_match_what_the_engine_reports() {
    let text = "PROGRAM p VAR i : INT; n : DINT; END_VAR\nn := 1;\nn := n + 2;\nWHILE n > 0 DO\n  i := i + 1;\nEND_WHILE;\nEND_PROGRAM";
    let artifact = compile(&source(text), &Options::default()).unwrap().artifact;
    let mut config = wasmtime::Config::new();
    config.consume_fuel(true);
    let engine = wasmtime::Engine::new(&config).unwrap();
    let module = wasmtime::Module::new(&engine, &artifact.wasm).unwrap();
    let mut store = wasmtime::Store::new(&engine, ());
    store.set_fuel(100_000).unwrap();
    let instance = wasmtime::Instance::new(&mut store, &module, &[]).unwrap();
    let f = instance.get_typed_func::<(), ()>(&mut store, "task.main").unwrap();
    let error = f.call(&mut store, ()).unwrap_err();
    let trace = error.downcast_ref::<wasmtime::WasmBacktrace>().unwrap();
    let frame = &trace.frames()[0];
    let lines = artifact.map.functions.iter().find(|f| f.function == frame.func_index()).unwrap();
    let offset = frame.func_offset().unwrap() as u32;
    let statement = lines.lines.iter().rev().find(|(at, _)| *at <= offset).unwrap().1;
    let place = artifact.map.place_text(statement);
    assert!(["test.st:4:1", "test.st:5:3"].contains(&place.as_str()), "{place}");
    assert!(lines.lines.windows(2).all(|w| w[0].0 < w[1].0));
}

#[test]
fn artefacts_come_back_from_their_bytes() {
    let a = compile(&source(SAMPLE), &Options::default()).unwrap().artifact;
    assert_eq!(Artifact::from_wasm(&a.wasm).unwrap(), a);
    assert_eq!(
        a.hash(),
        compile(&source(SAMPLE), &Options::default()).unwrap().artifact.hash(),
        "the same sources give the same bytes"
    );
    assert!(matches!(Artifact::from_wasm(b"hello"), Err(ArtifactError::NotWasm)));
    assert!(matches!(Artifact::from_wasm(b"\0asm\x01\0\0\0"), Err(ArtifactError::NoMap)));
    for cut in 0..a.wasm.len() {
        assert!(Artifact::from_wasm(&a.wasm[..cut]).is_err(), "cut at {cut}");
    }
    let text = String::from_utf8_lossy(&a.wasm).into_owned();
    assert!(text.contains(MAP_SECTION));
    let at = a.wasm.windows(11).position(|w| w == b"\"version\":1").unwrap();
    let mut other = a.wasm.clone();
    other[at + 10] = b'9';
    assert!(matches!(Artifact::from_wasm(&other), Err(ArtifactError::Version { found: 9 })));
    assert!(wasmtime::Module::new(engine(), &a.wasm).is_ok());
}

proptest::proptest! {
    #[test]
    fn from_wasm_never_panics(bytes in proptest::collection::vec(proptest::num::u8::ANY, 0..200)) {
        let _ = Artifact::from_wasm(&bytes);
        let mut framed = b"\0asm\x01\0\0\0".to_vec();
        framed.extend(&bytes);
        let _ = Artifact::from_wasm(&framed);
    }
}

/// A bound that comes by way of VAR_EXTERNAL is known when the array is declared, in every kind of POU.
#[test]
fn constants_by_way_of_var_external() {
    let h = Host::new(
        "VAR_GLOBAL CONSTANT n : INT := 3; m : INT := n * 2; END_VAR
         FUNCTION_BLOCK f VAR_EXTERNAL n : INT; END_VAR VAR a : ARRAY [1..n] OF INT; END_VAR a[n] := 1; END_FUNCTION_BLOCK
         PROGRAM p VAR_EXTERNAL CONSTANT m : INT; END_VAR VAR CONSTANT k : INT := m + 1; END_VAR VAR b : ARRAY [0..k] OF INT; x : f; END_VAR x(); b[m] := 2; END_PROGRAM",
    );
    assert_eq!(h.artifact.map.symbol("p.b").unwrap().dims, [(0, 7)]);
    assert_eq!(h.artifact.map.symbol("p.x.a").unwrap().dims, [(1, 3)]);
}

#[test]
fn values_of_enumerations_have_names() {
    let h = Host::new(
        "TYPE Mode : (Off, Manual := 5, Auto); END_TYPE
         PROGRAM p VAR m : Mode := Manual; all : ARRAY [0..2] OF Mode; n : INT; END_VAR n := n + 1; END_PROGRAM",
    );
    let map = &h.artifact.map;
    let of = |path: &str| {
        let enumeration = map.symbol(path).unwrap().enumeration;
        enumeration.map(|e| map.enumerations[e as usize].name.as_str())
    };
    assert_eq!((of("p.m"), of("p.all"), of("p.n")), (Some("Mode"), Some("Mode"), None));
    let values: Vec<(&str, i64)> = map.enumerations[0].values.iter().map(|(n, v)| (n.as_str(), *v)).collect();
    assert_eq!(values, [("Off", 0), ("Manual", 5), ("Auto", 6)]);
    // A program without any is the same module as ever.
    let plain = Host::new("PROGRAM p VAR n : INT; END_VAR n := n + 1; END_PROGRAM");
    assert!(!serde_json::to_string(&plain.artifact.map).unwrap().contains("enumeration"));
}
