//! `dinrail replay --as-slave`: a recorded serial line answers again, as a virtual slave.

use super::serial::{LineArgs, open_config, step};
use super::{UsageError, println};
use clap::{Args, ValueEnum};
use dinrail_recorder::format::STACK_TEXT;
use dinrail_recorder::reader::{End, Item, Recording};
use dinrail_recorder::scan::attachments;
use dinrail_serial::Config;
use dinrail_serial::dialog::{Builder, Dialog, Side};
use dinrail_serial::driver::Driver;
use dinrail_serial::protocol::sender::Head;
use ipc_types::clock;
use ipc_types::payload::{CHUNK_BYTES, SerialChunk, from_bytes, serial_flag};
use ipc_types::reactor::Reactor;
use ipc_types::topic::TopicKind;
use ipc_types::units::Span;
use std::collections::{BTreeSet, VecDeque};
use std::path::Path;
use std::process::ExitCode;
use std::time::{Duration, Instant};

/// Longest wait at once, so that a due answer is never missed.
const LOOK: Duration = Duration::from_millis(20);
/// Longest request that is looked up.
const MAX_REQUEST: usize = 65_536;

/// Arguments of a virtual slave.
#[derive(Debug, Clone, Default, Args)]
pub struct SlaveArgs {
    /// Answer on a serial line as the recorded line did
    #[arg(long, conflicts_with_all = ["verify", "program"])]
    pub as_slave: bool,
    /// Port to answer on: a device, pty:/path or socket://host:port; without it a pseudo-terminal is made
    #[arg(long, value_name = "DEVICE", requires = "as_slave")]
    pub device: Option<String>,
    /// Whose frames are the answers; without it the recording decides
    #[arg(long, value_name = "WHO", requires = "as_slave")]
    pub answers: Option<Answers>,
    /// Stop after so long
    #[arg(long = "for", value_name = "DURATION", requires = "as_slave")]
    pub duration: Option<Span>,
    #[command(flatten)]
    pub line: LineArgs,
}

/// Whose frames are the answers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Answers {
    /// The recorded stack was the master
    Others,
    /// The recorded stack was the slave
    Own,
    /// The recorded stack only listened
    Listened,
}

/// Serves until it is ended.
pub fn run(file: &Path, service: Option<&str>, args: &SlaveArgs, json: bool) -> anyhow::Result<ExitCode> {
    let service = choose(file, service)?;
    let side = match args.answers {
        Some(Answers::Others) => Side::Others,
        Some(Answers::Own) => Side::Own,
        Some(Answers::Listened) => Side::Listened,
        None => guess(file, &service)?,
    };
    let (dialog, seen) = build(file, &service, side)?;
    let contents = dialog.contents();
    if contents.requests == 0 {
        anyhow::bail!(
            "{}: no request of '{service}' in {} frames; --answers says whose frames are the answers",
            file.display(),
            seen.0 + seen.1
        );
    }
    let mut config = recorded_config(file, &service).unwrap_or_else(|| Config::of_device(""));
    let made = std::env::temp_dir().join(format!("dinrail-{service}-{}", std::process::id()));
    config.device = args.device.clone().unwrap_or_else(|| format!("pty:{}", made.display()));
    args.line.apply(&mut config)?;
    let (mut driver, mut reactor) = open_config(&config)?;
    let about = serde_json::json!({
        "device": config.device.trim_start_matches("pty:"), "line": config.character().to_string(),
        "requests": contents.requests, "answers": contents.answers, "silent": contents.silent,
        "left_out": contents.left_out,
    });
    if json {
        println(&about.to_string());
    } else {
        println(&format!(
            "{} answers as '{service}', {}: {} requests, {} answers, {} of them silence; {} frames left out",
            config.device.trim_start_matches("pty:"),
            config.character(),
            contents.requests,
            contents.answers,
            contents.silent,
            contents.left_out
        ));
    }
    let end = args.duration.map(|d| Instant::now() + d.duration());
    let served = serve(&mut driver, &mut reactor, dialog, end)?;
    println(&if json {
        serde_json::json!({ "answered": served.0, "unknown": served.1 }).to_string()
    } else {
        format!("{} requests answered, {} unknown", served.0, served.1)
    });
    Ok(ExitCode::SUCCESS)
}

/// Calls `f` with every chunk of a line, in the order of the recording.
fn chunks(file: &Path, service: &str, mut f: impl FnMut(&SerialChunk, &[u8])) -> anyhow::Result<End> {
    let topic = TopicKind::SerialRx.of(service);
    let mut recording = Recording::open(file)?;
    while let Some(item) = recording.next_item()? {
        let Item::Message(message) = item else { continue };
        if message.channel.kind != Some(TopicKind::SerialRx) || message.topic() != topic {
            continue;
        }
        if let Some(header) = from_bytes::<SerialChunk>(message.header) {
            f(&header, message.tail);
        }
    }
    Ok(recording.end().clone())
}

/// The line meant: the one named, or the only one in the recording.
fn choose(file: &Path, named: Option<&str>) -> anyhow::Result<String> {
    let mut recording = Recording::open(file)?;
    while recording.next_item()?.is_some() {}
    let lines: BTreeSet<String> = recording
        .channels()
        .filter(|c| c.kind == Some(TopicKind::SerialRx))
        .filter_map(|c| Some(c.topic.rsplit_once('/')?.0.to_owned()))
        .collect();
    let has = lines.iter().cloned().collect::<Vec<_>>().join(", ");
    match named {
        _ if lines.is_empty() => anyhow::bail!("{}: no serial line in it", file.display()),
        Some(name) if lines.contains(name) => Ok(name.to_owned()),
        Some(name) => anyhow::bail!("{}: no serial line '{name}' in it; it has {has}", file.display()),
        None if lines.len() == 1 => Ok(has),
        None => {
            Err(UsageError(format!("several serial lines: {has}; say which one with --service NAME")).into())
        }
    }
}

/// Who sends first is the master; without frames of its own the stack only listened.
fn guess(file: &Path, service: &str) -> anyhow::Result<Side> {
    let (mut first_own, mut own) = (None, 0u64);
    chunks(file, service, |header, _| {
        if header.flags & (serial_flag::NOT_SENT | serial_flag::DAMAGED) == 0 {
            let echo = header.flags & serial_flag::TX_ECHO != 0;
            first_own.get_or_insert(echo);
            own += u64::from(echo);
        }
    })?;
    Ok(match first_own {
        Some(true) => Side::Others,
        Some(false) if own > 0 => Side::Own,
        _ => Side::Listened,
    })
}

fn build(file: &Path, service: &str, side: Side) -> anyhow::Result<(Dialog, (u64, u64))> {
    let mut builder = Builder::new(side);
    let end = chunks(file, service, |header, bytes| builder.push(header, bytes))?;
    if end.damaged > 0 || end.unread > 0 {
        let (bytes, why) = (end.damaged_bytes + end.unread, end.reason.as_deref().unwrap_or("damaged"));
        eprintln!(
            "dinrail: {}: {bytes} bytes could not be read ({why}): answers may be missing",
            file.display()
        );
    }
    let seen = builder.seen();
    Ok((builder.finish(), seen))
}

/// How the recorded line was set, from the stack file in the recording.
fn recorded_config(file: &Path, service: &str) -> Option<Config> {
    let stack = attachments(file).ok()?.into_iter().find(|a| a.name == STACK_TEXT)?;
    let stack: toml::Table = String::from_utf8(stack.data).ok()?.parse().ok()?;
    let tables = stack.get("service")?.as_array()?;
    let table = tables
        .iter()
        .filter_map(toml::Value::as_table)
        .find(|t| t.get("name").and_then(|n| n.as_str()) == Some(service))?;
    let known = crate::explain_keys::SERIAL;
    let own: toml::Table = table
        .iter()
        .filter(|(key, _)| known.iter().any(|doc| doc.key == *key))
        .map(|(key, value)| (key.clone(), value.clone()))
        .collect();
    let mut config: Config = serde_json::from_value(serde_json::to_value(own).ok()?).ok()?;
    // How the recorded port was wired is not how this one is.
    config.rs485 = None;
    config.echo = dinrail_serial::config::EchoMode::Keep;
    Some(config)
}

/// Frames received, whole ones only.
#[derive(Default)]
struct Requests {
    part: Vec<u8>,
    whole: VecDeque<(u64, Vec<u8>)>,
}

impl dinrail_serial::driver::Sink for Requests {
    fn chunk(&mut self, header: SerialChunk, bytes: &[u8], t_ns: u64) {
        if header.flags & serial_flag::TX_ECHO != 0 {
            return;
        }
        self.part.extend_from_slice(bytes);
        if header.flags & serial_flag::END != 0 || self.part.len() > MAX_REQUEST {
            self.whole.push_back((t_ns, std::mem::take(&mut self.part)));
        }
    }
}

/// Answers until `end`; returns how many requests were known and how many not.
fn serve(
    driver: &mut Driver,
    reactor: &mut Reactor,
    mut dialog: Dialog,
    end: Option<Instant>,
) -> anyhow::Result<(u64, u64)> {
    let stop = ipc_types::reactor::signals::descriptor(&[libc::SIGTERM, libc::SIGINT])?;
    let mut requests = Requests::default();
    let mut answer: VecDeque<(u64, Vec<u8>)> = VecDeque::new();
    let (mut known, mut unknown) = (0, 0);
    while end.is_none_or(|end| Instant::now() < end) {
        if ipc_types::reactor::signals::take(&stop).is_some() {
            break;
        }
        if driver.is_idle()
            && let Some((delay_ns, bytes)) = answer.front()
            && clock::mono_ns() >= *delay_ns
        {
            let head = Head { flags: serial_flag::END | serial_flag::AT_ONCE, ..Head::default() };
            driver.load(head, bytes, clock::mono_ns());
            answer.pop_front();
        }
        let due = answer.front().map(|(due, _)| Duration::from_nanos(due.saturating_sub(clock::mono_ns())));
        let until = Instant::now() + due.map_or(LOOK, |due| due.min(LOOK));
        step(driver, reactor, Some(end.map_or(until, |end| end.min(until))), &mut requests)?;
        while let Some((t_ns, request)) = requests.whole.pop_front() {
            let Some(frames) = dialog.answer(&request) else {
                unknown += 1;
                continue;
            };
            known += 1;
            // A new request ends the answer to the one before, as a master would expect.
            answer.clear();
            let mut due_ns = t_ns;
            for frame in frames {
                due_ns = due_ns.saturating_add(frame.delay_ns);
                answer.extend(frame.bytes.chunks(CHUNK_BYTES).map(|part| (due_ns, part.to_vec())));
            }
        }
    }
    Ok((known, unknown))
}
