//! `dinrail can dump`.

use super::args::DumpArgs;
use super::ended_by;
use super::filter::Filter;
use super::listen::{LOOK, Listener, widest};
use super::names::Names;
use super::show::{Form, Paint, Printer, Time, log_line};
use crate::commands::{DATA_LOSS, UsageError};
use ipc_types::clock;
use ipc_types::reactor::Reactor;
use std::fs::File;
use std::io::{BufWriter, IsTerminal, Write};
use std::path::Path;
use std::process::ExitCode;
use std::time::{Duration, Instant};

/// After so long without any frame the user is told once.
const QUIET: Duration = Duration::from_secs(5);

pub fn run(args: &DumpArgs, json: bool) -> anyhow::Result<ExitCode> {
    let to_stdout = args.log.as_deref() == Some(Path::new("-"));
    if let Some(refusal) = refusal(args, json, to_stdout) {
        return Err(refusal.into());
    }
    let ctx = super::join(args.which.stack.as_deref())?;
    let names = Names::of(&ctx.stack);
    let filter = Filter::parse(&args.filter.filter, &names)?;
    let buses = super::buses(&ctx, &args.buses)?;
    let mut listener = Listener::new(&ctx, buses.clone())?;
    let mut log = match &args.log {
        Some(path) if !to_stdout => Some(create(path)?),
        _ => None,
    };
    let mut printer = printer(args, json, to_stdout, &names, widest(&buses));
    let mut reactor = Reactor::new()?;
    reactor.add_timer(LOOK)?;
    let stop = reactor.add(ctx.shutdown_fd())?;
    let begin = Instant::now();
    let offset_ns = clock::utc_offset_ns();
    let mut left = args.count.unwrap_or(u64::MAX);
    let mut ended = left == 0;
    let mut told = 0;
    let mut heard = begin;
    let mut quiet = Quiet::default();
    while !ended {
        ended = reactor.wait(Some(LOOK * 4))?.contains(&stop)
            || ended_by(begin, args.duration)
            || ended_by(heard, args.silence);
        let (mut text, mut lines) = (String::new(), String::new());
        listener.look(ended, |bus, message| {
            quiet.heard = true;
            let bus = buses[bus].as_str();
            if filter.takes(bus, message) {
                let utc_ns = (message.stamp.t_ns as i64 + offset_ns).max(0) as u64;
                text += &printer.line(bus, message, utc_ns);
                text.push('\n');
                if log.is_some() {
                    lines += &log_line(utc_ns, bus, message, args.direction);
                    lines.push('\n');
                }
                heard = Instant::now();
                left -= 1;
            }
            left > 0
        });
        ended |= left == 0;
        if let Some(log) = &mut log {
            let flushed = log.write_all(lines.as_bytes()).and_then(|()| log.flush());
            flushed.map_err(|e| anyhow::anyhow!("writing {}: {e}", shown(args)))?;
        }
        ended |= !text.is_empty() && !super::put(&text);
        told = tell_losses(&listener, told, ended);
        if let Some(note) = quiet.note(begin.elapsed()).filter(|_| !ended) {
            eprintln!("dinrail: {note}");
        }
    }
    Ok(if told > 0 { ExitCode::from(DATA_LOSS) } else { ExitCode::SUCCESS })
}

/// Whether the buses are silent from the start, and whether that was told.
#[derive(Default)]
struct Quiet {
    heard: bool,
    told: bool,
}

impl Quiet {
    fn note(&mut self, waited: Duration) -> Option<&'static str> {
        if self.heard || self.told || waited < QUIET {
            return None;
        }
        self.told = true;
        Some(
            "no frame for 5 s: is the bus driver up, is anybody sending? Ctrl-C ends; --for and --silence end by themselves",
        )
    }
}

/// At the first loss and at the end.
fn tell_losses(listener: &Listener, told: u64, ended: bool) -> u64 {
    let lost: u64 = listener.lost().iter().sum();
    if let Some(text) = listener.loss_text()
        && (told == 0 || ended)
    {
        eprintln!("dinrail: {text}");
    }
    lost
}

fn shown(args: &DumpArgs) -> String {
    args.log.as_deref().unwrap_or(Path::new("-")).display().to_string()
}

fn create(path: &Path) -> anyhow::Result<BufWriter<File>> {
    let file = File::create(path);
    Ok(BufWriter::new(file.map_err(|e| anyhow::anyhow!("cannot write the log {}: {e}", path.display()))?))
}

/// What cannot be had together, beyond what the arguments themselves exclude.
fn refusal(args: &DumpArgs, json: bool, to_stdout: bool) -> Option<UsageError> {
    let laid_out = [
        (args.screen, "--screen"),
        (args.absolute, "--absolute"),
        (args.delta, "--delta"),
        (args.since_start, "--since-start"),
        (args.ascii, "--ascii"),
    ];
    let asked = laid_out.iter().find(|(given, _)| *given).map(|(_, name)| *name);
    match asked {
        Some(asked) if to_stdout => Some(UsageError(format!(
            "--log - prints candump lines, which have no place for {asked}: leave one of them out"
        ))),
        Some(asked) if json => {
            Some(UsageError(format!("--json has its own form: {asked} has no effect with it, leave it out")))
        }
        _ if json && (args.log_lines || to_stdout) => Some(UsageError(
            "--json and candump lines cannot both go to stdout: leave one of them out".to_owned(),
        )),
        _ => None,
    }
}

fn printer<'a>(args: &DumpArgs, json: bool, to_stdout: bool, names: &'a Names, width: usize) -> Printer<'a> {
    let terminal = std::io::stdout().is_terminal();
    let laid_out = args.screen || args.absolute || args.delta || args.since_start || args.ascii;
    let form = match () {
        () if json => Form::Json,
        () if to_stdout || args.log_lines || (args.direction && args.log.is_none()) => Form::Log,
        () if terminal || laid_out => Form::Screen,
        () => Form::Log,
    };
    let time = match () {
        () if args.absolute => Time::Absolute,
        () if args.delta => Time::Delta,
        () if args.since_start => Time::Start,
        () => Time::Day,
    };
    let paint = Paint::choose(args.color, terminal, std::env::var_os("NO_COLOR").as_deref());
    let mut printer = Printer::new(form, time, args.ascii, paint, (!args.no_names).then_some(names), width);
    printer.direction = args.direction;
    printer
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::{Cli, Command};
    use crate::commands::can::args::CanCommand;
    use clap::Parser;

    fn said(words: &str) -> String {
        let words = ["dinrail", "can", "dump"].into_iter().chain(words.split_whitespace());
        let cli = match Cli::try_parse_from(words) {
            Ok(cli) => cli,
            Err(e) => return e.to_string().lines().next().unwrap_or_default().to_owned(),
        };
        let Command::Can(CanCommand::Dump(args)) = cli.command else { panic!() };
        let to_stdout = args.log.as_deref() == Some(Path::new("-"));
        refusal(&args, cli.json, to_stdout).map_or_else(|| "ok".to_owned(), |e| e.to_string())
    }

    #[test]
    fn a_silent_bus_is_told_once() {
        let mut quiet = Quiet::default();
        assert_eq!(quiet.note(Duration::from_millis(4999)), None);
        assert!(quiet.note(QUIET).is_some_and(|note| note.contains("--silence")));
        assert_eq!(quiet.note(QUIET * 2), None);
        assert_eq!(Quiet { heard: true, told: false }.note(QUIET), None);
    }

    #[test]
    fn what_has_no_effect_is_refused() {
        for fine in
            ["", "--lines", "--lines --direction", "--screen --delta --ascii", "--log x --delta", "--json"]
        {
            assert_eq!(said(fine), "ok", "{fine}");
        }
        let said: Vec<String> = [
            "--lines --delta",
            "--lines --ascii",
            "--lines --screen",
            "--delta --since-start",
            "--direction --absolute",
            "--log - --delta",
            "--json --ascii",
            "--json --lines",
        ]
        .iter()
        .map(|words| format!("{words}: {}", said(words)))
        .collect();
        insta::assert_snapshot!(said.join("\n"), @r#"
--lines --delta: error: the argument '--lines' cannot be used with '--delta'
--lines --ascii: error: the argument '--lines' cannot be used with '--ascii'
--lines --screen: error: the argument '--lines' cannot be used with '--screen'
--delta --since-start: error: the argument '--delta' cannot be used with '--since-start'
--direction --absolute: error: the argument '--direction' cannot be used with '--absolute'
--log - --delta: --log - prints candump lines, which have no place for --delta: leave one of them out
--json --ascii: --json has its own form: --ascii has no effect with it, leave it out
--json --lines: --json and candump lines cannot both go to stdout: leave one of them out
"#);
    }
}
