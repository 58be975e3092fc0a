//! `dinrail can dump`.

use super::args::DumpArgs;
use super::filter::Filter;
use super::listen::{LOOK, Listener, widest};
use super::names::Names;
use super::show::{Form, Paint, Printer, Time};
use super::{ended_by, to_frame};
use crate::commands::DATA_LOSS;
use dinrail_can::protocol::candump;
use ipc_types::clock;
use ipc_types::reactor::Reactor;
use std::fs::File;
use std::io::{BufWriter, IsTerminal, Write};
use std::path::Path;
use std::process::ExitCode;
use std::time::Instant;

pub fn run(args: &DumpArgs, json: bool) -> anyhow::Result<ExitCode> {
    let ctx = super::join(args.which.stack.as_deref())?;
    let names = Names::of(&ctx.stack);
    let filter = Filter::parse(&args.filter.filter, &names)?;
    let buses = super::buses(&ctx, &args.buses)?;
    let mut listener = Listener::new(&ctx, buses.clone())?;
    let to_stdout = args.log.as_deref() == Some(Path::new("-"));
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
    while !ended {
        ended = reactor.wait(Some(LOOK * 4))?.contains(&stop) || ended_by(begin, args.duration);
        let (mut text, mut lines) = (String::new(), String::new());
        listener.look(ended, |bus, message| {
            let bus = buses[bus].as_str();
            if filter.takes(bus, message) {
                let utc_ns = (message.stamp.t_ns as i64 + offset_ns).max(0) as u64;
                text += &printer.line(bus, message, utc_ns);
                text.push('\n');
                if log.is_some() {
                    lines += &candump::format_log_line(utc_ns, bus, &to_frame(message));
                    lines.push('\n');
                }
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
    }
    Ok(if told > 0 { ExitCode::from(DATA_LOSS) } else { ExitCode::SUCCESS })
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

fn printer<'a>(args: &DumpArgs, json: bool, to_stdout: bool, names: &'a Names, width: usize) -> Printer<'a> {
    let terminal = std::io::stdout().is_terminal();
    let laid_out = args.screen || args.absolute || args.delta || args.ascii;
    let form = match () {
        () if json => Form::Json,
        () if to_stdout || args.log_lines => Form::Log,
        () if terminal || laid_out => Form::Screen,
        () => Form::Log,
    };
    let time = match () {
        () if args.absolute => Time::Absolute,
        () if args.delta => Time::Delta,
        () => Time::Day,
    };
    let paint = Paint::choose(args.color, terminal, std::env::var_os("NO_COLOR").as_deref());
    Printer::new(form, time, args.ascii, paint, (!args.no_names).then_some(names), width)
}
