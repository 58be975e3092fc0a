//! `dinrail replay --verify`: a recording's scans, computed again and compared.

use super::{UsageError, println};
use anyhow::Context as _;
use dinrail_iec::Artifact;
use dinrail_plc::engine::Program;
use dinrail_plc::program::{compile_sources, load};
use dinrail_plc::setup::Setup;
use dinrail_plc::verify::{Report, Verifier};
use dinrail_recorder::scan::{OwnedAttachment, ScanMessage, attachments, scanned_services};
use dinrail_recorder::scan_contents;
use ipc_types::scan_record::{Joiner, MAX_KEYFRAME_BYTES, MAX_RECORD_BYTES};
use std::cell::RefCell;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;

/// Combinations of recorded versions of the program's files that are tried for one hash.
const COMBINATIONS_MAX: usize = 64;

/// What is to be verified.
pub struct Verify<'a> {
    pub file: &'a Path,
    /// A changed program to compare; empty = the recorded one alone.
    pub program: &'a [PathBuf],
    pub service: Option<&'a str>,
}

/// Exit code 0: exact, and the recording is whole; 1: different, the first difference is printed; 3: exact as far as it could
/// be verified, the rest is listed, or what makes that more is missing than can be listed.
pub fn verify(what: &Verify<'_>, json: bool) -> anyhow::Result<ExitCode> {
    let (service, report, missing) = run(what)?;
    for program in missing {
        eprintln!(
            "dinrail: program {program} is not in the recording as it ran: its scans cannot be verified"
        );
    }
    if json {
        let mut value = serde_json::to_value(&report)?;
        value["service"] = service.into();
        value["exit_code"] = report.exit_code().into();
        println(&value.to_string());
    } else {
        println(&text_of(&report, &service, what.program.is_empty()));
    }
    Ok(ExitCode::from(report.exit_code()))
}

/// Verifies; the service, what came out, and the programs that were not to be had.
fn run(what: &Verify<'_>) -> anyhow::Result<(String, Report, Vec<String>)> {
    let shown = what.file.display();
    let service = choose(what.file, what.service)?;
    let files = attachments(what.file)?;
    let missing = RefCell::new(Vec::<String>::new());
    let mut known: Vec<(u64, Option<Arc<Program>>)> = Vec::new();
    let provider = |hash: u64, setup: &Setup| {
        if let Some((_, program)) = known.iter().find(|(h, _)| *h == hash) {
            return program.clone();
        }
        let found = find_program(&files, hash, setup);
        if found.is_none() {
            missing.borrow_mut().push(format!("{hash:016x} ({})", setup.files.join(", ")));
        }
        known.push((hash, found.clone()));
        found
    };
    let mut verifier = Verifier::new(Box::new(provider))?;
    if !what.program.is_empty() {
        let setup = recorded_setup(what.file, &service)?
            .with_context(|| format!("{shown}: no keyframe of '{service}', so no program can be compared"))?;
        let other = load(Path::new(""), what.program, &setup)?;
        if let Some(warnings) = &other.warnings {
            eprintln!("{warnings}");
        }
        verifier = verifier.compare(other.program);
    }
    feed(&mut verifier, what.file, &service)?;
    let report = verifier.finish()?;
    Ok((service, report, missing.into_inner()))
}

/// The plc service meant: the one named, or the only one in the recording.
fn choose(file: &Path, named: Option<&str>) -> anyhow::Result<String> {
    let list = scanned_services(file)?;
    let has = list.join(", ");
    match (named, list.as_slice()) {
        (_, []) => anyhow::bail!("{}: no scans of a plc service in it", file.display()),
        (Some(name), list) if list.iter().any(|s| s == name) => Ok(name.to_owned()),
        (Some(name), _) => anyhow::bail!("{}: no plc service '{name}' in it; it has {has}", file.display()),
        (None, [only]) => Ok(only.clone()),
        (None, _) => {
            Err(UsageError(format!("several plc services: {has}; say which one with --service NAME")).into())
        }
    }
}

/// Joins parts to contents and hands them over, with every doubt about the file being whole.
fn feed(verifier: &mut Verifier<'_>, file: &Path, service: &str) -> anyhow::Result<()> {
    let mut contents = scan_contents(file, service)?;
    let (mut scans, mut keyframes) = (Joiner::new(MAX_RECORD_BYTES), Joiner::new(MAX_KEYFRAME_BYTES));
    let mut half = None;
    for message in contents.by_ref() {
        let ScanMessage { keyframe, header, tail, .. } = message?;
        let step = if keyframe { keyframes.push(&header, &tail) } else { scans.push(&header, &tail) };
        if !keyframe {
            half = step.whole.is_none().then_some(header.scan);
            if let Some(gap) = step.gap {
                verifier.gap(gap.messages);
            }
        }
        if let Some(whole) = step.whole {
            verifier.push(whole.generation, whole.bytes)?;
        }
    }
    if let Some(scan) = half {
        verifier.doubt(format!("the last record, of scan {scan}, is not whole"));
    }
    for doubt in contents.integrity().doubts(contents.end(), service) {
        verifier.doubt(doubt);
    }
    Ok(())
}

/// What the recorded engine was set up with, from the first keyframe.
fn recorded_setup(file: &Path, service: &str) -> anyhow::Result<Option<Setup>> {
    let seen = RefCell::new(None);
    let mut scout = Verifier::new(Box::new(|_, setup: &Setup| {
        seen.borrow_mut().get_or_insert_with(|| setup.clone());
        None
    }))?;
    let mut keyframes = Joiner::new(MAX_KEYFRAME_BYTES);
    for message in scan_contents(file, service)? {
        let ScanMessage { keyframe: true, header, tail, .. } = message? else { continue };
        if let Some(whole) = keyframes.push(&header, &tail).whole {
            scout.push(whole.generation, whole.bytes)?;
        }
        if seen.borrow().is_some() {
            break;
        }
    }
    // A keyframe may wait for the records before it.
    scout.finish()?;
    Ok(seen.into_inner())
}

/// The program with this hash: a module that stands in the recording, or its sources compiled as they were then.
fn find_program(files: &[OwnedAttachment], hash: u64, setup: &Setup) -> Option<Arc<Program>> {
    let module = files
        .iter()
        .filter(|a| a.data.starts_with(b"\0asm"))
        .filter_map(|a| Artifact::from_wasm(&a.data).ok())
        .find(|artifact| artifact.hash() == hash);
    if let Some(artifact) = module {
        return Some(Arc::new(Program { artifact, sources: Vec::new() }));
    }
    // A file that was changed while it was recorded stands more than once: newest versions first.
    let versions: Vec<Vec<&OwnedAttachment>> =
        setup.files.iter().map(|name| files.iter().rev().filter(|a| a.name == *name).collect()).collect();
    let recorded = combinations(&versions).into_iter().find_map(|chosen| {
        let sources = chosen
            .iter()
            .map(|a| {
                let text = String::from_utf8(a.data.clone()).ok()?;
                Some(dinrail_iec::Source { name: a.name.clone(), text })
            })
            .collect::<Option<Vec<_>>>()?;
        let compiled = compile_sources(sources, setup).ok()?;
        (compiled.program.artifact.hash() == hash).then_some(compiled.program)
    });
    // A program that was loaded from elsewhere (`plc load`) is named with its whole path; it may still be there.
    let elsewhere = || {
        let files: Vec<PathBuf> = setup.files.iter().map(PathBuf::from).collect();
        let whole = !files.is_empty() && files.iter().all(|file| file.is_absolute());
        let compiled = whole.then(|| load(Path::new("/"), &files, setup).ok())??;
        (compiled.program.artifact.hash() == hash).then_some(compiled.program)
    };
    recorded.or_else(elsewhere)
}

/// One of each, in all combinations up to a limit; none when a list is empty.
fn combinations<'a, T>(lists: &[Vec<&'a T>]) -> Vec<Vec<&'a T>> {
    if lists.is_empty() {
        return Vec::new();
    }
    let mut all: Vec<Vec<&T>> = vec![Vec::new()];
    for list in lists {
        all = all
            .iter()
            .flat_map(|begun| list.iter().map(move |item| begun.iter().chain([item]).copied().collect()))
            .take(COMBINATIONS_MAX)
            .collect();
    }
    all
}

fn text_of(report: &Report, service: &str, recorded_program: bool) -> String {
    let mut text = format!(
        "{service}: {} of {} scans verified, {} keyframes checked",
        report.scans_verified, report.scans, report.keyframes_checked
    );
    if let Some(d) = &report.first_difference {
        let (expected, got) = if recorded_program {
            ("expected", "got")
        } else {
            ("the recorded program", "the changed program")
        };
        text += &format!(
            "\nfirst difference: scan {}, {}: {expected} {}, {got} {}",
            d.scan, d.variable, d.expected, d.got
        );
        text += &format!(
            "\n  generation {}, PLC time {:.6} s, UTC {}",
            d.generation,
            d.plc_time_ns as f64 / 1e9,
            dinrail_recorder::utc::iso(d.utc_ns.max(0) as u64)
        );
        for other in &d.others {
            text += &format!(
                "\n  in the same scan {}: {expected} {}, {got} {}",
                other.variable, other.expected, other.got
            );
        }
        text += &format!("\n{} scans differ until the next keyframe", report.scans_different);
    }
    for span in &report.unverifiable {
        text += &format!(
            "\nnot verifiable: scans {} to {} of generation {}: {}",
            span.from, span.to, span.generation, span.reason
        );
    }
    for why in &report.incomplete {
        text += &format!("\nnot complete: {why}");
    }
    text += match report.exit_code() {
        0 => "\nexact",
        1 => "\ndifferent",
        _ => "\nexact, as far as it could be verified",
    };
    text
}

#[cfg(test)]
mod tests;
