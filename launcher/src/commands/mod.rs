//! The commands, one module each. They parse nothing and supervise nothing: arguments come from [`crate::cli`],
//! stacks from [`crate::stackfile`], processes from [`crate::supervise`].

pub mod bench;
mod build;
pub mod can;
pub mod canopen;
mod check;
pub mod completion;
mod down;
mod explain;
mod logs;
mod map;
pub mod modbus;
mod new;
mod plc;
mod plc_write;
mod ps;
pub mod recordings;
mod replay;
pub mod replay_slave;
mod restart;
pub mod serial;
pub mod sources;
mod status;
mod top;
pub mod trace;
mod up;

use crate::cli::{Cli, Command};
use crate::supervise::service_main;
use std::process::ExitCode;

/// Exit code of a command that did its work, but with data loss.
pub const DATA_LOSS: u8 = 3;
/// Exit code for arguments that make no sense; the same as clap's.
pub const USAGE: u8 = 2;

/// An error of usage: exit code 2.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct UsageError(pub String);

/// Runs a command and says how it went.
pub fn run(cli: Cli) -> ExitCode {
    let json = cli.json;
    let done = |result: anyhow::Result<()>| result.map(|()| ExitCode::SUCCESS);
    let result = match cli.command {
        Command::Up { stack, duration } => up::up(&stack, duration, json),
        Command::Demo { duration, dir } => up::demo(&dir, duration, json),
        Command::Down(which) => done(down::run(&which, json)),
        Command::Ps(which) => done(ps::run(&which, json)),
        Command::Status { services, watch, which } => {
            status::run(&which, &status::Wanted { services: &services, watch, json })
        }
        Command::Top { every, which } => done(top::run(which.stack.as_deref(), every.duration())),
        Command::Logs { service, follow, lines, which } => {
            done(logs::run(service.as_deref(), lines, follow, &which, json))
        }
        Command::Restart { service, which } => done(restart::run(&service, &which, json)),
        Command::Modbus(command) => done(modbus::run(command, json)),
        Command::Serial(command) => done(serial::run(command, json)),
        Command::Can(command) => can::run(command, json),
        Command::Canopen(command) => canopen::run(command, json),
        Command::Plc { service, stack, command } => {
            done(plc::run(service.as_deref(), stack.as_deref(), command, json))
        }
        Command::Build { program, output } => done(build::run(&program, &output, json)),
        Command::Recordings(command) => recordings::run(command, json),
        Command::Trace(args) => trace::run(&args, json),
        Command::Replay { ref file, ref service, ref slave, .. } if slave.as_slave => {
            replay_slave::run(file, service.as_deref(), slave, json)
        }
        Command::Replay { file, program, service, .. } => {
            let what = replay::Verify { file: &file, program: &program, service: service.as_deref() };
            replay::verify(&what, json)
        }
        Command::Check { stack } => return check::run(&stack, json),
        Command::Map { stack, filter } => done(map::run(&stack, filter.as_deref(), json)),
        Command::New { from: Some(from), dir } => done(new::run(&from, dir.as_deref())),
        Command::New { from: None, .. } => {
            print(&new::list());
            Ok(ExitCode::SUCCESS)
        }
        Command::Explain { key } => done(explain::run(key.as_deref(), json)),
        Command::Schema => {
            print(&format!("{:#}\n", explain::schema()));
            Ok(ExitCode::SUCCESS)
        }
        Command::Completion { shell } => {
            completion::completion(shell);
            Ok(ExitCode::SUCCESS)
        }
        Command::Man { folder } => done(completion::man(&folder)),
        Command::Bench(args) => bench::run(&args, json),
        Command::Service(args) => return service_main::run(&args),
        Command::Clean { root, parent } => return service_main::clean(&root, parent),
    };
    match result {
        Ok(code) => code,
        Err(e) => {
            let text = error_text(&e);
            if json {
                println(&serde_json::json!({ "error": text }).to_string());
            }
            eprintln!("dinrail: {text}");
            if e.is::<UsageError>() { ExitCode::from(USAGE) } else { ExitCode::FAILURE }
        }
    }
}

pub use crate::terminal::{error_text, print};

/// [`print`] with a line end.
pub fn println(text: &str) {
    print(&format!("{text}\n"));
}

/// A table with aligned columns; numbers are the caller's to format.
pub fn table(head: &[&str], rows: &[Vec<String>]) -> String {
    let mut widths: Vec<usize> = head.iter().map(|h| h.len()).collect();
    for row in rows {
        for (width, cell) in widths.iter_mut().zip(row) {
            *width = (*width).max(cell.chars().count());
        }
    }
    let line = |cells: Vec<&str>| {
        let padded: Vec<String> = cells.iter().zip(&widths).map(|(c, w)| format!("{c:<w$}")).collect();
        padded.join("  ").trim_end().to_owned() + "\n"
    };
    let mut text = line(head.to_vec());
    for row in rows {
        text += &line(row.iter().map(String::as_str).collect());
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_aligned() {
        let text = table(&["a", "long"], &[vec!["xyz".into(), "1".into()], vec!["q".into(), String::new()]]);
        assert_eq!(text, "a    long\nxyz  1\nq\n");
    }

    #[test]
    fn the_command_line_is_consistent() {
        use clap::CommandFactory;
        Cli::command().debug_assert();
    }
}
