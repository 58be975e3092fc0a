//! `dinrail canopen eds`: what is in an EDS or DCF, and what is wrong with it.

use super::super::{error_text, println, table};
use anyhow::Context as _;
use dinrail_canopen::protocol::eds::{Eds, Severity};
use serde_json::json;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

fn read(file: &Path) -> anyhow::Result<Eds> {
    let bytes = std::fs::read(file).with_context(|| format!("reading {}", file.display()))?;
    Eds::parse(&bytes).with_context(|| format!("{}", file.display()))
}

/// Exit code 1 when a file has an error.
pub fn check(files: &[PathBuf], as_json: bool) -> anyhow::Result<ExitCode> {
    let mut wrong = false;
    for file in files {
        let eds = match read(file) {
            Ok(eds) => eds,
            Err(e) => {
                wrong = true;
                eprintln!("dinrail: {}", error_text(&e));
                if as_json {
                    println(&json!({ "file": file, "error": error_text(&e) }).to_string());
                }
                continue;
            }
        };
        let found = eds.check();
        let (warnings, errors) = Eds::count(&found);
        wrong |= errors > 0;
        if as_json {
            let list: Vec<_> = found
                .iter()
                .map(|d| {
                    let error = d.severity == Severity::Error;
                    json!({ "line": d.line, "error": error, "section": d.section, "key": d.key, "text": d.text })
                })
                .collect();
            println(&json!({ "file": file, "objects": eds.objects.len(), "findings": list }).to_string());
            continue;
        }
        for diag in &found {
            let word = if diag.severity == Severity::Error { "error" } else { "warning" };
            println(&format!("{}: {word}: {diag}", file.display()));
        }
        println(&format!(
            "{}: {}, {} objects; {warnings} warnings, {errors} errors",
            file.display(),
            if eds.device.product_name.is_empty() { "no product name" } else { &eds.device.product_name },
            eds.objects.len(),
        ));
    }
    Ok(if wrong { ExitCode::FAILURE } else { ExitCode::SUCCESS })
}

/// Fails when nothing matches.
pub fn show(file: &Path, filter: Option<&str>, as_json: bool) -> anyhow::Result<()> {
    let eds = read(file)?;
    let wanted = filter.unwrap_or_default().to_ascii_lowercase();
    let mut rows = Vec::new();
    let mut list = Vec::new();
    for (index, sub, entry) in eds.entries() {
        let object = format!("{index:04X}:{sub:02X}");
        let name = eds.name(index, sub).unwrap_or_default();
        if !format!("{object} {name}").to_ascii_lowercase().contains(&wanted) {
            continue;
        }
        let pdo = if entry.mappable { "yes" } else { "no" };
        let data_type = entry.data_type.name();
        list.push(json!({
            "object": object, "name": name, "type": data_type, "access": entry.access.word(), "pdo": entry.mappable,
        }));
        rows.push(vec![object, data_type.to_owned(), entry.access.word().to_owned(), pdo.to_owned(), name]);
    }
    if list.is_empty()
        && let Some(filter) = filter
    {
        anyhow::bail!("nothing in {} matches '{filter}', by index or name", file.display());
    }
    if as_json {
        println(&json!(list).to_string());
    } else {
        println(table(&["OBJECT", "TYPE", "ACCESS", "PDO", "NAME"], &rows).trim_end());
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_filter_that_nothing_matches_is_an_error() {
        let file = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../services/canopen/src/slave/io401.eds"));
        assert!(show(file, Some("6000"), true).is_ok());
        let error = show(file, Some("zzz"), false).unwrap_err().to_string();
        assert!(error.contains("io401.eds matches 'zzz'"), "{error}");
    }
}
