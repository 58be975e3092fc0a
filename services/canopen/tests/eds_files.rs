//! Every public EDS and DCF is read; those of a folder of one's own (`DINRAIL_EDS_DIR`) are read or refused with a
//! sentence. What is written as a DCF is read back as the same dictionary.
//!
//! With `DINRAIL_EDS_DUMP` = a folder, each dictionary is written there as a table, to be compared with other readers.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use dinrail_canopen::protocol::eds::{BuildOptions, Commissioning, DcfOptions, Eds};
use dinrail_canopen::protocol::od::ObjectDictionary;
use std::fmt::Write;
use std::path::{Path, PathBuf};

const NODE: u8 = 5;

fn folders() -> Vec<PathBuf> {
    let own = PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/cases"));
    let public = std::env::var_os("DINRAIL_CASES").map_or(own, PathBuf::from).join("eds");
    let ours = PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/src/slave"));
    let mut all = vec![ours];
    if public.is_dir() {
        all.push(public);
    } else {
        assert!(
            std::env::var_os("DINRAIL_NO_SKIP").is_none(),
            "the public cases are missing: set DINRAIL_CASES"
        );
        eprintln!("*** SKIPPED the public EDS files: set DINRAIL_CASES to their folder");
    }
    all.extend(std::env::var_os("DINRAIL_EDS_DIR").map(PathBuf::from));
    all
}

fn files(folder: &Path, into: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            files(&path, into);
        } else if path
            .extension()
            .is_some_and(|e| e.eq_ignore_ascii_case("eds") || e.eq_ignore_ascii_case("dcf"))
        {
            into.push(path);
        }
    }
}

/// The dictionary as a table: what an entry is and what it holds.
fn table(od: &ObjectDictionary) -> String {
    od.entries().fold(String::new(), |mut all, (at, entry)| {
        let value = od.get(at).iter().fold(String::new(), |mut hex, byte| {
            let _ = write!(hex, "{byte:02x}");
            hex
        });
        let _ = writeln!(
            all,
            "{:04X}\t{:02X}\t{:04X}\t{}\t{}\t{:?}\t{:?}\t{value}",
            entry.index,
            entry.sub,
            entry.data_type.index(),
            entry.access.word(),
            u8::from(entry.mappable),
            entry.low,
            entry.high,
        );
        all
    })
}

fn dictionary(eds: &Eds, parameter_values: bool) -> Result<ObjectDictionary, String> {
    let options = BuildOptions { parameter_values, ..BuildOptions::default() };
    eds.builder(&options).build(NODE).map_err(|fault| fault.to_string())
}

#[test]
fn every_file_is_read_and_written_back() {
    let mut paths = Vec::new();
    for folder in folders() {
        files(&folder, &mut paths);
    }
    let own = std::env::var_os("DINRAIL_EDS_DIR").map(PathBuf::from);
    paths.sort();
    assert!(!paths.is_empty());
    for path in paths {
        let bytes = std::fs::read(&path).unwrap();
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        let eds = match Eds::parse(&bytes) {
            Ok(eds) => eds,
            Err(fault) => {
                println!("{name}: refused: {fault}");
                assert!(own.as_ref().is_some_and(|own| path.starts_with(own)), "{name}: {fault}");
                assert!(fault.to_string().len() > 20, "{name}: {fault}");
                continue;
            }
        };
        for diag in eds.check() {
            assert!(!diag.text.is_empty() && (diag.line as usize) <= bytes.len(), "{name}: {diag:?}");
        }
        let od = dictionary(&eds, false).unwrap_or_else(|fault| panic!("{name}: {fault}"));
        if let Some(folder) = std::env::var_os("DINRAIL_EDS_DUMP") {
            std::fs::write(PathBuf::from(folder).join(format!("{name}.tsv")), table(&od)).unwrap();
        }
        let options = DcfOptions {
            commissioning: Commissioning { node_id: NODE, ..Commissioning::default() },
            ..DcfOptions::default()
        };
        // Unchanged, and once more with a value of every number that may be written.
        let text = eds.dcf(&options, &[]).unwrap_or_else(|fault| panic!("{name}: {fault}"));
        let back = Eds::parse(text.as_bytes()).unwrap_or_else(|fault| panic!("{name}: {fault}"));
        assert_eq!(table(&od), table(&dictionary(&back, false).unwrap()), "{name}");
        let values: Vec<(u16, u8, Vec<u8>)> = od
            .entries()
            .filter(|(at, entry)| entry.data_type.size() == Some(od.get(*at).len()) && entry.index >= 0x1000)
            .map(|(at, entry)| (entry.index, entry.sub, od.get(at).to_vec()))
            .collect();
        let text = eds.dcf(&options, &values).unwrap_or_else(|fault| panic!("{name}: {fault}"));
        let back = Eds::parse(text.as_bytes()).unwrap_or_else(|fault| panic!("{name}: {fault}"));
        let configured = dictionary(&back, true).unwrap();
        for (index, sub, bytes) in values {
            assert_eq!(configured.bytes(index, sub), Some(&bytes[..]), "{name}: {index:04X}h:{sub:02X}");
        }
    }
}
