//! A recording in a bus driver's place: a service of kind `replay` owns `<name>/rx` and `<name>/tx` and sends the
//! recorded frames with the recorded spacing. Frames of the stack for the bus are taken and thrown away, counted.
//!
//! It re-stimulates; whether a program behaves as it did is the verifier's question, which needs no rail.

use crate::reader::{End, Item, ReadError, Recording};
use ipc_types::event::{EventKind, Level};
use ipc_types::payload::{CanFrame, HealthState, can_flag, from_bytes};
use ipc_types::port::{Publisher, Subscriber};
use ipc_types::rail::RailError;
use ipc_types::reactor::{Reactor, Wake};
use ipc_types::stack::{Finding, ServiceEntry, Stack};
use ipc_types::topic::TopicKind;
use ipc_types::units::Span;
use ipc_types::wiring::{Neighbours, Wiring};
use ipc_types::{Context, clock};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::time::Duration;

/// How fast.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Speed {
    /// 1.0 as recorded, 2.0 twice as fast.
    Factor(f64),
    Named(NamedSpeed),
}

/// `"max"`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NamedSpeed {
    /// [`MAX_BURST`] frames a millisecond: no reader of the rail is asked to keep up with more.
    Max,
}

/// Frames of one millisecond at `speed = "max"`, and of one wake-up at any speed.
pub const MAX_BURST: usize = 50;
/// Bounds of a speed factor.
pub const SPEED: (f64, f64) = (0.01, 1000.0);

/// Keys of a `replay` service.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// The recording, relative to the stack file.
    pub file: PathBuf,
    /// Topic in the recording; default `<name>/rx`.
    #[serde(default)]
    pub source: Option<String>,
    #[serde(default = "default_speed")]
    pub speed: Speed,
    /// Begins again at the end.
    #[serde(default, rename = "loop")]
    pub repeat: bool,
    /// Skips so much from the first frame on.
    #[serde(default)]
    pub start: Span,
    /// Also sends the frames that were the recorded stack's own.
    #[serde(default = "default_echoes")]
    pub echoes: bool,
}

fn default_speed() -> Speed {
    Speed::Factor(1.0)
}
fn default_echoes() -> bool {
    true
}

/// Why a replay ended.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    #[error(transparent)]
    Rail(#[from] RailError),
    #[error(transparent)]
    Read(#[from] ReadError),
    #[error("replay: {0}")]
    System(#[from] std::io::Error),
}

impl Config {
    fn source(&self, name: &str) -> String {
        self.source.clone().unwrap_or_else(|| TopicKind::CanRx.of(name))
    }
}

/// Owns the bus as its driver would.
pub fn topics(_config: &Config, _neighbours: &Neighbours) -> Wiring {
    let mut wiring = Wiring::default();
    wiring.own(TopicKind::CanRx).own(TopicKind::CanTx);
    wiring
}

/// Opens the recording and looks for the topic.
pub fn check(config: &Config, stack: &Stack, me: &ServiceEntry) -> Vec<Finding> {
    let mut findings = Vec::new();
    if let Speed::Factor(factor) = config.speed
        && !(SPEED.0..=SPEED.1).contains(&factor)
    {
        let message = format!("speed = {factor} lies outside {} .. {}", SPEED.0, SPEED.1);
        findings.push(Finding::error(&me.name, "speed", message, "1.0 is as recorded; or \"max\""));
    }
    let source = config.source(&me.name);
    match find_topic(&stack.dir.join(&config.file), &source) {
        Ok(None) => {}
        Ok(Some(there)) => {
            let key = if config.source.is_some() { "source" } else { "file" };
            let message = format!("{} has no CAN frames of '{source}'", config.file.display());
            let help = format!("name one with `source`; it has: {}", there.join(", "));
            findings.push(Finding::error(&me.name, key, message, help));
        }
        Err(error) => {
            let help = "name a recording, relative to the stack file";
            findings.push(Finding::error(&me.name, "file", error.to_string(), help));
        }
    }
    findings
}

/// `None` when the topic has a frame; else the CAN topics that are there.
fn find_topic(path: &Path, source: &str) -> Result<Option<Vec<String>>, ReadError> {
    let mut recording = Recording::open(path)?;
    while let Some(item) = recording.next_item()? {
        if let Item::Message(m) = item
            && m.channel.kind == Some(TopicKind::CanRx)
            && m.topic() == source
        {
            return Ok(None);
        }
    }
    let can = recording.channels().filter(|c| c.kind == Some(TopicKind::CanRx));
    Ok(Some(can.map(|c| c.topic.clone()).collect()))
}

/// The frames of one topic of a recording, one after the other. Sans-I/O but for the file.
pub struct Frames {
    recording: Recording,
    source: String,
    echoes: bool,
}

impl Frames {
    /// Opens the recording.
    pub fn open(path: &Path, source: &str, echoes: bool) -> Result<Self, ReadError> {
        Ok(Self { recording: Recording::open(path)?, source: source.to_owned(), echoes })
    }

    /// How the recording ended, once there is no next frame: what of it could not be read is not played.
    pub fn end(&self) -> &End {
        self.recording.end()
    }

    /// The next frame.
    pub fn next_frame(&mut self) -> Result<Option<CanFrame>, ReadError> {
        while let Some(item) = self.recording.next_item()? {
            let Item::Message(message) = item else { continue };
            if message.channel.kind != Some(TopicKind::CanRx) || message.topic() != self.source {
                continue;
            }
            let Some(frame) = from_bytes::<CanFrame>(message.header) else { continue };
            let echo = frame.flags & can_flag::TX_ECHO != 0;
            // What was recorded is as little trusted as what is on the rail.
            if (self.echoes || !echo) && frame.fault().is_none() {
                return Ok(Some(frame));
            }
        }
        Ok(None)
    }
}

/// When frames are due, by their recorded stamps: ns from the start of the replay. Never backwards: frames that
/// were recorded with equal or falling stamps keep the order of the file.
#[derive(Debug, Clone)]
pub struct Pace {
    speed: Speed,
    skip_ns: u64,
    first_t_ns: Option<u64>,
    last_ns: u64,
    sent: u64,
}

impl Pace {
    /// `start` is left out of what is replayed.
    pub fn new(speed: Speed, start: Span) -> Self {
        Self { speed, skip_ns: start.ns(), first_t_ns: None, last_ns: 0, sent: 0 }
    }

    /// When a frame is due; `None` when it lies before the start.
    pub fn due(&mut self, t_ns: u64) -> Option<u64> {
        let first = *self.first_t_ns.get_or_insert(t_ns);
        let since = t_ns.saturating_sub(first);
        if since < self.skip_ns {
            return None;
        }
        let due = match self.speed {
            Speed::Factor(factor) => ((since - self.skip_ns) as f64 / factor.clamp(SPEED.0, SPEED.1)) as u64,
            Speed::Named(NamedSpeed::Max) => self.sent / MAX_BURST as u64 * 1_000_000,
        };
        self.sent += 1;
        self.last_ns = self.last_ns.max(due);
        Some(self.last_ns)
    }
}

#[derive(Serialize)]
struct Status<'a> {
    file: String,
    source: &'a str,
    frames: u64,
    rounds: u64,
    ended: bool,
    /// Frames of the stack for the bus that were thrown away.
    discarded: u64,
}

struct Player {
    ctx: Context,
    config: Config,
    path: PathBuf,
    source: String,
    rx: Publisher<CanFrame>,
    tx: Subscriber<CanFrame>,
    alarm: Wake,
    frames: Frames,
    pace: Pace,
    /// CLOCK_MONOTONIC in ns of the start of this round.
    base_ns: u64,
    /// The next frame and when it is due.
    next: Option<(CanFrame, u64)>,
    sent: u64,
    sent_in_round: u64,
    rounds: u64,
    discarded: u64,
}

/// Replays until the stack ends. At the end of the recording it says so and stays.
pub fn run(mut ctx: Context) -> Result<(), RunError> {
    let config: Config = ctx.config()?;
    let source = config.source(&ctx.service);
    let path = ctx.stack.dir.join(&config.file);
    let mut reactor = Reactor::new()?;
    let stop = reactor.add(ctx.shutdown_fd())?;
    let tick = reactor.add_timer(Duration::from_millis(50))?;
    let alarm = reactor.add_alarm()?;
    let (rx_topic, tx_topic) = (TopicKind::CanRx.of(&ctx.service), TopicKind::CanTx.of(&ctx.service));
    let (rx, tx) = (ctx.publisher(&rx_topic)?, ctx.subscriber(&tx_topic)?);
    let frames = Frames::open(&path, &source, config.echoes)?;
    let pace = Pace::new(config.speed, config.start);
    let base_ns = clock::mono_ns();
    let mut player = Player {
        ctx,
        config,
        path,
        source,
        rx,
        tx,
        alarm,
        frames,
        pace,
        base_ns,
        next: None,
        sent: 0,
        sent_in_round: 0,
        rounds: 0,
        discarded: 0,
    };
    player.fetch()?;
    player.ctx.ready();
    player.arm(&mut reactor)?;
    let mut ticks = 0u32;
    loop {
        for wake in reactor.wait(None)?.to_vec() {
            if wake == stop {
                player.ctx.set_state(HealthState::Stopping);
                return Ok(());
            }
            if wake == tick {
                ticks = ticks.wrapping_add(1);
                player.ctx.beat();
                player.discard();
                if ticks.is_multiple_of(20) {
                    player.status();
                }
            }
            if wake == alarm {
                player.send_due()?;
                player.arm(&mut reactor)?;
            }
        }
    }
}

impl Player {
    /// Sets the alarm to the next frame.
    fn arm(&self, reactor: &mut Reactor) -> Result<(), RunError> {
        if let Some((_, due)) = self.next {
            reactor.set_alarm(self.alarm, self.base_ns.saturating_add(due))?;
        }
        Ok(())
    }

    /// Sends what is due. At most [`MAX_BURST`] frames, so that the heartbeat gets its turn.
    fn send_due(&mut self) -> Result<(), RunError> {
        let now = clock::mono_ns().saturating_sub(self.base_ns);
        let mut sent = 0;
        while let Some((frame, due)) = self.next.filter(|(_, due)| *due <= now && sent < MAX_BURST) {
            // Stamped when it was due: the spacing of the recording, not that of this machine's wake-ups.
            let _ = self.rx.send_at(frame, &[], self.base_ns + due);
            self.sent += 1;
            self.sent_in_round += 1;
            sent += 1;
            self.fetch()?;
        }
        if sent > 0 {
            self.rx.ring();
        }
        Ok(())
    }

    /// Finds the next frame; at the end begins again or says that it is over.
    fn fetch(&mut self) -> Result<(), RunError> {
        loop {
            if let Some(frame) = self.frames.next_frame()? {
                if let Some(due) = self.pace.due(frame.stamp.t_ns) {
                    self.next = Some((frame, due));
                    return Ok(());
                }
                continue;
            }
            self.next = None;
            self.rounds += 1;
            // A round without a frame would go round for ever.
            let again = self.config.repeat && self.sent_in_round > 0;
            if !again {
                self.over();
                return Ok(());
            }
            self.sent_in_round = 0;
            self.frames = Frames::open(&self.path, &self.source, self.config.echoes)?;
            self.base_ns = self.base_ns.saturating_add(self.pace.last_ns).saturating_add(1_000_000);
            self.pace = Pace::new(self.config.speed, self.config.start);
        }
    }

    fn over(&mut self) {
        let end = self.frames.end();
        let unread = end.damaged_bytes + end.unread;
        let lost = if unread > 0 { format!("; {unread} bytes could not be read") } else { String::new() };
        let (path, sent) = (self.path.display(), self.sent);
        let message = format!("replay of {path} ended: {sent} frames of '{}'{lost}", self.source);
        let detail = serde_json::json!({ "file": self.path.display().to_string(), "source": self.source, "frames": self.sent, "bytes_unread": unread });
        let level = if unread > 0 { Level::Warning } else { Level::Info };
        self.ctx.event(EventKind::BusState, level, message, detail);
        self.status();
    }

    fn discard(&mut self) {
        self.discarded += self.tx.drain(1024, |_, _| {}) as u64;
    }

    fn status(&mut self) {
        let status = Status {
            file: self.path.display().to_string(),
            source: &self.source,
            frames: self.sent,
            rounds: self.rounds,
            ended: self.next.is_none(),
            discarded: self.discarded,
        };
        self.ctx.status(&status);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_keys_are_read() {
        let config: Config = serde_json::from_str(r#"{"file":"a.mcap"}"#).unwrap();
        assert_eq!(config.speed, Speed::Factor(1.0));
        assert!(config.echoes && !config.repeat);
        let config: Config =
            serde_json::from_str(r#"{"file":"a.mcap","speed":"max","loop":true,"start":"10s"}"#).unwrap();
        assert_eq!((config.speed, config.repeat), (Speed::Named(NamedSpeed::Max), true));
        assert!(serde_json::from_str::<Config>(r#"{"file":"a","speed":"fast"}"#).is_err());
    }

    #[test]
    fn spacing_is_that_of_the_recording() {
        let mut pace = Pace::new(Speed::Factor(2.0), Span(100));
        let dues: Vec<_> = [1000, 1050, 1100, 1300, 1250, 1400].map(|t| pace.due(t)).into();
        // The first 100 ns are skipped; a stamp that falls keeps its place.
        assert_eq!(dues, [None, None, Some(0), Some(100), Some(100), Some(150)]);
    }

    #[test]
    fn at_full_speed_bursts_are_a_millisecond_apart() {
        let mut pace = Pace::new(Speed::Named(NamedSpeed::Max), Span(0));
        let dues: Vec<_> = (0..120).map(|_| pace.due(5).unwrap()).collect();
        assert_eq!((dues[0], dues[49], dues[50], dues[119]), (0, 0, 1_000_000, 2_000_000));
    }
}
