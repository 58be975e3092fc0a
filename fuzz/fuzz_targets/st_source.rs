//! The compiler: any text is compiled or refused with a message, and what was compiled is a valid module that
//! carries its debug map. The options depend on the length of the text, so that the seeds are plain programs.

#![no_main]

use dinrail_iec::{Addressing, Artifact, ExternalSymbol, ModByZero, Options, RealToInt, Source, compile};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    let text = String::from_utf8_lossy(data).into_owned();
    let bit = |n: usize| data.len() >> n & 1 == 1;
    let options = Options {
        addressing: [Addressing::Element, Addressing::Byte, Addressing::OpenPlc][data.len() % 3],
        debug: bit(0),
        real_to_int: if bit(1) { RealToInt::Clamp } else { RealToInt::Fault },
        mod_by_zero: if bit(2) { ModByZero::Fault } else { ModByZero::Zero },
        implicit_cycle_ns: bit(3).then_some(10_000_000),
        externals: vec![ExternalSymbol {
            name: "Speed".to_owned(),
            address: "%IW1".to_owned(),
            type_name: "UINT".to_owned(),
            origin: "stack.toml:1".to_owned(),
        }],
        ..Options::default()
    };
    let sources = [Source { name: "main.st".to_owned(), text }];
    match compile(&sources, &options) {
        Ok(compiled) => {
            wasmparser::validate(&compiled.artifact.wasm).unwrap();
            assert_eq!(Artifact::from_wasm(&compiled.artifact.wasm).unwrap(), compiled.artifact);
            let _ = compiled.render_warnings(&sources, false);
        }
        Err(diagnostics) => assert!(!diagnostics.render(false).is_empty()),
    }
});
