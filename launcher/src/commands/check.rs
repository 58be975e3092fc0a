//! `dinrail check STACK`: everything that can be found wrong without starting.

use super::print;
use crate::stackfile::{LoadError, Loaded, Located, free_shared_memory, load, readable_size, shared_memory};
use serde_json::json;
use std::path::Path;
use std::process::ExitCode;

/// Checks a stack file or the folder of one. Exit 0: it can be started, perhaps with warnings; 1: it cannot.
pub fn run(path: &Path, as_json: bool) -> ExitCode {
    let result = load(path);
    if as_json {
        print(&format!("{:#}\n", to_json(&result)));
    } else {
        match &result {
            Ok(loaded) => {
                report(&loaded.findings);
                print(&format!("{}\n", summary(loaded)));
            }
            Err(error) => {
                report(&error.findings);
                eprintln!("{}", verdict(error));
            }
        }
    }
    if result.is_ok() { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// Findings on stderr, a blank line between two.
pub fn report(findings: &[Located]) {
    for finding in findings {
        eprintln!("{finding}\n");
    }
}

fn verdict(error: &LoadError) -> String {
    let errors = error.errors();
    let warnings = error.findings.len() - errors;
    let also = match warnings {
        0 => String::new(),
        n => format!(" and {}", count(n, "warning")),
    };
    format!("{}{also}; the stack cannot be started", count(errors, "error"))
}

fn count(n: usize, what: &str) -> String {
    format!("{n} {what}{}", if n == 1 { "" } else { "s" })
}

fn summary(loaded: &Loaded) -> String {
    let stack = &loaded.stack;
    let need = readable_size(shared_memory(stack));
    let free = free_shared_memory().map(|f| format!(" of {} free", readable_size(f))).unwrap_or_default();
    let mut text = format!(
        "stack '{}': {}, {}, at most {need} of shared memory{free}",
        stack.name,
        count(stack.services.len(), "service"),
        count(stack.topics.len(), "topic"),
    );
    if !loaded.settings.description.is_empty() {
        text += &format!("\n  {}", loaded.settings.description);
    }
    for service in &stack.services {
        text += &format!("\n  {:<16} {}", service.name, service.kind);
        for listener in &service.wiring.listeners {
            text += &format!("  {} {}", listener.name, listener.address);
        }
    }
    text += match loaded.findings.len() {
        0 => "\nno mistakes found".to_owned(),
        n => format!("\n{}, no errors", count(n, "warning")),
    }
    .as_str();
    text
}

fn to_json(result: &Result<Loaded, LoadError>) -> serde_json::Value {
    let list = |findings: &[Located]| findings.iter().map(Located::json).collect::<Vec<_>>();
    match result {
        Err(error) => json!({ "ok": false, "findings": list(&error.findings) }),
        Ok(loaded) => {
            let stack = &loaded.stack;
            json!({
                "ok": true,
                "stack": stack.name,
                "file": stack.file,
                "build_id": stack.build_id,
                "services": stack.services.iter().map(|s| json!({
                    "name": s.name,
                    "kind": s.kind,
                    "listeners": s.wiring.listeners.iter()
                        .map(|l| json!({ "name": l.name, "address": l.address })).collect::<Vec<_>>(),
                })).collect::<Vec<_>>(),
                "topics": stack.topics.iter().map(|t| json!({
                    "name": t.name, "payload": t.kind.row().payload, "depth": t.depth,
                    "writers": t.writers, "readers": t.readers, "bytes": t.bytes(),
                })).collect::<Vec<_>>(),
                "shared_memory_bytes": shared_memory(stack),
                "findings": list(&loaded.findings),
            })
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stackfile::real_tests::{Folder, STACK};

    #[test]
    fn a_right_stack_is_summed_up() {
        let folder = Folder::new("check");
        let text = STACK.replacen("name = \"real\"", "name = \"real\"\ndescription = \"One of all.\"", 1);
        let loaded = folder.load(&text).unwrap();
        let shown = summary(&loaded);
        assert!(shown.starts_with("stack 'real': 5 services, "), "{shown}");
        assert!(shown.contains("\n  One of all.\n  can0 "), "{shown}");
        assert!(shown.contains("modbus-server  tcp 127.0.0.1:1502"), "{shown}");
        assert!(shown.ends_with("no mistakes found"), "{shown}");
        let json = to_json(&Ok(loaded));
        assert_eq!(json["ok"], true);
        assert_eq!(json["services"][3]["listeners"][0]["address"], "127.0.0.1:1502");
        assert!(json["shared_memory_bytes"].as_u64().unwrap() > 1 << 20);
    }

    #[test]
    fn a_wrong_stack_is_told_with_its_places() {
        let folder = Folder::new("check-wrong");
        let error = folder.load(&STACK.replacen("kind = \"plc\"", "kind = \"pcl\"", 1)).unwrap_err();
        assert_eq!(verdict(&error), "1 error; the stack cannot be started");
        let json = to_json(&Err(error));
        assert_eq!((json["ok"].as_bool(), json["findings"][0]["line"].as_u64()), (Some(false), Some(30)));
        assert_eq!(json["findings"][0]["severity"], "error");
    }
}
