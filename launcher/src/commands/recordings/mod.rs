//! `dinrail recordings info|cat|recover|export|import`.

pub mod convert;
mod export;
mod import;

use super::{DATA_LOSS, println};
use crate::cli::RecordingsCommand;
use crate::terminal::Guarded;
use anyhow::Context as _;
use dinrail_recorder::{CatError, Filter, Format, cat, info, recover};
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

pub fn run(command: RecordingsCommand, json: bool) -> anyhow::Result<ExitCode> {
    match command {
        RecordingsCommand::Info { files } => {
            for (i, file) in files.iter().enumerate() {
                let info = info(file)?;
                if json {
                    println(&serde_json::to_string(&info)?);
                } else {
                    println(&format!("{}{info}", if i > 0 { "\n" } else { "" }));
                }
            }
            Ok(ExitCode::SUCCESS)
        }
        RecordingsCommand::Cat { file, topic, count, candump } => {
            let filter = Filter { topics: topic, limit: count, ..Filter::default() };
            print(&file, &filter, if candump { Format::Candump } else { Format::Json })
        }
        RecordingsCommand::Recover { files } => make_whole(&files, json),
        RecordingsCommand::Export(args) => export::run(&args, json),
        RecordingsCommand::Import(args) => import::run(&args, json),
    }
}

/// Exit code 3 when the recording has places that could not be read.
fn print(file: &Path, filter: &Filter, format: Format) -> anyhow::Result<ExitCode> {
    let mut out = BufWriter::new(Guarded::stdout());
    match cat(file, filter, format, &mut out) {
        Ok(printed) if printed.end.damaged > 0 || printed.end.unread > 0 => {
            let end = &printed.end;
            let bytes = end.damaged_bytes + end.unread;
            let why = end.reason.as_deref().unwrap_or("damaged");
            eprintln!("dinrail: {}: {bytes} bytes could not be read ({why})", file.display());
            Ok(ExitCode::from(DATA_LOSS))
        }
        Ok(_) => Ok(ExitCode::SUCCESS),
        // The reader has seen enough.
        Err(CatError::Write(e)) if e.kind() == std::io::ErrorKind::BrokenPipe => Ok(ExitCode::SUCCESS),
        Err(e) => Err(e.into()),
    }
}

/// Exit code 3 when something was lost.
fn make_whole(files: &[PathBuf], json: bool) -> anyhow::Result<ExitCode> {
    let mut lost = false;
    for file in files {
        let report = recover(file).with_context(|| file.display().to_string())?;
        lost |= report.bytes_lost > 0 || report.damaged > 0;
        if json {
            println(&serde_json::json!({ "file": file.display().to_string(), "report": report }).to_string());
        } else {
            println(&format!("{}: {report}", file.display()));
        }
    }
    Ok(if lost { ExitCode::from(DATA_LOSS) } else { ExitCode::SUCCESS })
}
