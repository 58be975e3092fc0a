//! `dinrail can replay`: a log or a recording onto a bus, every frame, in its order.

use super::args::ReplayArgs;
use super::filter::Filter;
use super::flight::Order;
use super::from_frame;
use super::names::Names;
use super::sender::{Counts, Sender};
use super::source::{Contents, Source, contents};
use crate::commands::{DATA_LOSS, UsageError};
use crate::stackfile::nearest;
use ipc_types::payload::{CanFrame, can_flag};
use ipc_types::reactor::{Reactor, Wake};
use std::collections::BTreeMap;
use std::path::Path;
use std::process::ExitCode;
use std::time::{Duration, Instant};

/// Bounds of `--speed`.
const SPEED: std::ops::RangeInclusive<f64> = 0.001..=1000.0;
/// With `--no-wait` and several rounds: from the end of one to the next, when the file has no duration of its own.
const LEAST_ROUND: Duration = Duration::from_millis(1);

pub fn run(args: &ReplayArgs, json: bool) -> anyhow::Result<ExitCode> {
    if !SPEED.contains(&args.speed) {
        return Err(UsageError(format!(
            "--speed {} must lie between 0.001 and 1000; --no-wait is as fast as possible",
            args.speed
        ))
        .into());
    }
    // Before anything is sent: a file with a mistake in it sends nothing.
    let contents = contents(&args.file)?;
    let mut ctx = super::join(args.which.stack.as_deref())?;
    let names = Names::of(&ctx.stack);
    let filter = Filter::parse(&args.filter.filter, &names)?;
    direction_is_told(args, &contents, &filter)?;
    let targets = targets(&contents, &super::all_buses(&ctx), args.bus.as_deref(), &args.map)?;
    let mut senders: Vec<(String, Sender)> = Vec::new();
    for bus in targets.values() {
        if !senders.iter().any(|(name, _)| name == bus) {
            senders.push((bus.clone(), Sender::new(&mut ctx, bus, Order::Exact)?));
        }
    }
    let mut reactor = Reactor::new()?;
    let stop = reactor.add(ctx.shutdown_fd())?;
    let clock = Clock::new(args, &contents);
    let mut player = Player {
        args,
        filter,
        targets,
        senders,
        reactor,
        stop,
        clock,
        left_out: LeftOut::default(),
        looks: 0,
    };
    let begin = Instant::now();
    let played = player.play()?;
    let mut why = match played {
        Played::Stalled(why) => Some(why),
        Played::Whole | Played::Stopped => None,
    };
    for (_, sender) in &mut player.senders {
        if why.is_none() {
            why = sender.finish();
        }
    }
    Ok(player.report(begin.elapsed(), why.as_deref(), json))
}

/// Refuses to tell sent frames from received ones where the file does not.
fn direction_is_told(args: &ReplayArgs, contents: &Contents, filter: &Filter) -> Result<(), UsageError> {
    let asked = match () {
        () if args.received_only => "--received-only",
        () if filter.asks_direction() => "--filter #tx or #rx",
        () => return Ok(()),
    };
    if contents.undirected == 0 {
        return Ok(());
    }
    Err(UsageError(format!(
        "{} does not tell sent frames from received ones ({} of its {} frames have no direction), so {asked} cannot be applied: recordings of a stack and ASC files tell it, and candump logs made by `dinrail can dump --direction` or `candump -x`",
        args.file.display(),
        contents.undirected,
        contents.frames
    )))
}

/// Where the frames of each logged bus go.
fn targets(
    contents: &Contents,
    stack: &[String],
    bus: Option<&str>,
    map: &[String],
) -> anyhow::Result<BTreeMap<String, String>> {
    let known = |bus: &str| -> anyhow::Result<String> {
        if stack.iter().any(|b| b == bus) {
            return Ok(bus.to_owned());
        }
        let near = nearest(bus, stack.iter().map(String::as_str));
        let near = near.map(|near| format!(" (did you mean '{near}'?)")).unwrap_or_default();
        anyhow::bail!("the stack has no CAN bus '{bus}'{near}; it has {}", stack.join(", "))
    };
    let logged = contents.order.join(", ");
    if let Some(bus) = bus {
        let bus = known(bus)?;
        return Ok(contents.order.iter().map(|from| (from.clone(), bus.clone())).collect());
    }
    let mut targets = BTreeMap::new();
    if !map.is_empty() {
        for entry in map {
            let Some((from, to)) = entry.split_once('=') else {
                return Err(UsageError(format!(
                    "--map '{entry}' must be LOGGED=BUS, for example can0=vcan0"
                ))
                .into());
            };
            if !contents.buses.contains_key(from) {
                let near = nearest(from, contents.order.iter().map(String::as_str));
                let near = near.map(|near| format!(" (did you mean '{near}'?)")).unwrap_or_default();
                anyhow::bail!("no frame of '{from}' in the file{near}; it has frames of {logged}");
            }
            targets.insert(from.to_owned(), known(to)?);
        }
        return Ok(targets);
    }
    match (contents.order.as_slice(), stack) {
        ([only], [bus]) => Ok(BTreeMap::from([(only.clone(), bus.clone())])),
        (from, _) if from.iter().all(|bus| stack.contains(bus)) => {
            Ok(from.iter().map(|bus| (bus.clone(), bus.clone())).collect())
        }
        _ => Err(UsageError(format!(
            "the file has frames of {logged}, the stack has {}: say where they go with --bus BUS or --map LOGGED=BUS",
            stack.join(", ")
        ))
        .into()),
    }
}

/// When frames are due. Sans-I/O.
#[derive(Debug, Clone, PartialEq)]
struct Clock {
    first_ns: u64,
    from_ns: u64,
    to_ns: u64,
    /// `None` does not wait.
    speed: Option<f64>,
    /// From the start of one round to that of the next, in ns of the log.
    round_ns: u64,
    /// Longer pauses are cut to this.
    max_gap_ns: u64,
    /// Cut so far.
    cut_ns: u64,
    /// Round and place of the frame before.
    before: (u64, u64),
    last: Duration,
}

impl Clock {
    fn new(args: &ReplayArgs, contents: &Contents) -> Self {
        let from_ns = args.from.map_or(0, |from| from.ns());
        let to_ns = args.to.map_or(u64::MAX, |to| to.ns());
        let span_ns = (contents.last_ns - contents.first_ns).min(to_ns).saturating_sub(from_ns);
        // The next round begins as long behind the last frame as frames are apart on average.
        let round_ns = span_ns + span_ns / contents.frames.max(1);
        Self {
            first_ns: contents.first_ns,
            from_ns,
            to_ns,
            speed: (!args.no_wait).then_some(args.speed),
            round_ns: round_ns.max(LEAST_ROUND.as_nanos() as u64),
            max_gap_ns: args.max_gap.map_or(u64::MAX, |gap| gap.ns()),
            cut_ns: 0,
            before: (0, from_ns),
            last: Duration::ZERO,
        }
    }

    /// When a frame is due, from the start; `None`: it is left out. Never backwards.
    fn due(&mut self, round: u64, t_ns: u64) -> Option<Duration> {
        let since_ns = t_ns.saturating_sub(self.first_ns);
        if since_ns < self.from_ns || since_ns > self.to_ns {
            return None;
        }
        let Some(speed) = self.speed else { return Some(Duration::ZERO) };
        // The pause behind the last frame of a round is one like any other.
        let place = if round == self.before.0 { self.before.1 } else { self.from_ns };
        self.cut_ns += since_ns.saturating_sub(place).saturating_sub(self.max_gap_ns);
        self.before = (round, place.max(since_ns));
        let ns = (round as f64 * self.round_ns as f64 + (since_ns - self.from_ns) as f64
            - self.cut_ns as f64)
            / speed;
        self.last = self.last.max(Duration::from_nanos(ns as u64));
        Some(self.last)
    }
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
struct LeftOut {
    /// Controllers make them, nobody can send one.
    error_frames: u64,
    /// By --filter, --map, --from, --to, --received-only.
    not_wanted: u64,
}

enum Played {
    Whole,
    Stopped,
    Stalled(String),
}

struct Player<'a> {
    args: &'a ReplayArgs,
    filter: Filter,
    targets: BTreeMap<String, String>,
    senders: Vec<(String, Sender)>,
    reactor: Reactor,
    stop: Wake,
    clock: Clock,
    left_out: LeftOut,
    looks: u32,
}

impl Player<'_> {
    fn play(&mut self) -> anyhow::Result<Played> {
        let begin = Instant::now();
        let mut round = 0;
        while self.args.rounds == 0 || round < self.args.rounds {
            let mut source = Source::open(&self.args.file)?;
            while let Some(logged) = source.next_frame()? {
                let mut frame = from_frame(&logged.frame);
                frame.flags = if logged.tx { can_flag::TX_ECHO } else { 0 };
                let Some(target) = self.wanted(&logged.bus, &frame) else { continue };
                let Some(due) = self.clock.due(round, logged.t_ns) else {
                    self.left_out.not_wanted += 1;
                    continue;
                };
                frame.flags = 0;
                if let Some(end) = self.send(target, &frame, begin, due)? {
                    return Ok(end);
                }
            }
            round += 1;
            if let (Some(damage), 1) = (source.damage(), round) {
                eprintln!("dinrail: {damage}");
            }
        }
        Ok(Played::Whole)
    }

    /// Number of the sender that a frame goes to.
    fn wanted(&mut self, bus: &str, frame: &CanFrame) -> Option<usize> {
        let target = self.targets.get(bus);
        let taken = !(self.args.received_only && frame.flags & can_flag::TX_ECHO != 0)
            && self.filter.takes(bus, frame);
        if let (Some(target), true) = (target, taken) {
            if !frame.is_error() {
                return self.senders.iter().position(|(name, _)| name == target);
            }
            self.left_out.error_frames += 1;
        } else {
            self.left_out.not_wanted += 1;
        }
        None
    }

    /// Waits until a frame is due and the bus has room, and hands it over.
    fn send(
        &mut self,
        target: usize,
        frame: &CanFrame,
        begin: Instant,
        due: Duration,
    ) -> anyhow::Result<Option<Played>> {
        loop {
            let early = due.saturating_sub(begin.elapsed());
            if early.is_zero() && self.senders[target].1.offer(frame)? {
                return Ok(None);
            }
            let mut busy = false;
            for (_, sender) in &mut self.senders {
                busy |= sender.look();
                if let Some(why) = sender.stalled() {
                    return Ok(Some(Played::Stalled(why)));
                }
            }
            // Asking for signals costs a system call: not at every look of a short wait.
            self.looks = self.looks.wrapping_add(1);
            let asked = early.min(Duration::from_millis(1)).saturating_sub(Duration::from_micros(100));
            if (!asked.is_zero() || self.looks.is_multiple_of(64))
                && self.reactor.wait(Some(asked))?.contains(&self.stop)
            {
                return Ok(Some(Played::Stopped));
            }
            if early.is_zero() {
                self.senders[target].1.rest(busy);
            }
        }
    }

    fn report(&self, took: Duration, why: Option<&str>, json: bool) -> ExitCode {
        let each: Vec<(&str, Counts)> =
            self.senders.iter().map(|(bus, s)| (bus.as_str(), s.counts())).collect();
        let result = Outcome::of(why.is_some(), each.iter().map(|(_, counts)| counts));
        if json {
            let buses: BTreeMap<&str, serde_json::Value> = self
                .senders
                .iter()
                .map(|(bus, sender)| {
                    let mut value = serde_json::to_value(sender.counts()).unwrap_or_default();
                    value["others"] = sender.others().into();
                    (bus.as_str(), value)
                })
                .collect();
            let value = serde_json::json!({
                "file": self.args.file, "seconds": took.as_secs_f64(), "whole": result == Outcome::Whole,
                "buses": buses, "left_out": self.left_out,
            });
            super::put(&format!("{value}\n"));
        } else {
            for (bus, counts) in &each {
                super::put(&(text(bus, counts, took.as_secs_f64()) + "\n"));
            }
            if self.left_out != LeftOut::default() {
                let LeftOut { error_frames, not_wanted } = self.left_out;
                super::put(&format!(
                    "left out: {error_frames} error frames (controllers make them, nobody can send one), {not_wanted} not asked for\n"
                ));
            }
        }
        for remark in self.senders.iter().flat_map(|(_, sender)| sender.remarks()) {
            eprintln!("dinrail: {remark}");
        }
        if let Some(why) = why {
            eprintln!("dinrail: {why}");
        } else if result == Outcome::Nothing {
            eprintln!("dinrail: {}", nothing(&self.args.file, self.left_out));
        }
        result.exit_code()
    }
}

/// How it ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Outcome {
    /// Every frame sent was seen, in order; frames of others do not count.
    Whole,
    /// No frame was sent, or none was seen.
    Nothing,
    Part,
}

impl Outcome {
    fn of<'a>(stalled: bool, each: impl Iterator<Item = &'a Counts> + Clone) -> Self {
        let good = |c: &Counts| c.echoed == c.sent && c.out_of_order == 0;
        match () {
            () if each.clone().all(|c| c.echoed == 0) => Self::Nothing,
            () if !stalled && each.clone().all(good) => Self::Whole,
            () => Self::Part,
        }
    }

    fn exit_code(self) -> ExitCode {
        match self {
            Self::Whole => ExitCode::SUCCESS,
            Self::Nothing => ExitCode::FAILURE,
            Self::Part => ExitCode::from(DATA_LOSS),
        }
    }
}

/// Why nothing was sent.
fn nothing(file: &Path, left_out: LeftOut) -> String {
    let LeftOut { error_frames, not_wanted } = left_out;
    let why = match (not_wanted, error_frames) {
        (0, 0) => "ended before the first frame was due".to_owned(),
        (0, _) => format!("{} holds error frames only, and nobody can send one", file.display()),
        (_, 0) => "every frame was left out by --filter, --map, --from, --to or --received-only".to_owned(),
        _ => "every frame was left out: by --filter, --map, --from, --to or --received-only, or because it is an error frame".to_owned(),
    };
    format!("nothing was sent: {why}")
}

fn text(bus: &str, counts: &Counts, seconds: f64) -> String {
    let rate = counts.sent as f64 / seconds.max(1e-9);
    let missing = counts.sent.saturating_sub(counts.echoed);
    if counts.sent == 0 {
        return format!("{bus}: no frame sent");
    }
    let echo = match (missing, counts.out_of_order) {
        (0, 0) => "every one was seen on the bus, in order".to_owned(),
        (0, n) => format!("every one was seen on the bus, {n} out of order"),
        (missing, n) => format!("{missing} were not seen on the bus, {n} out of order"),
    };
    let others = match counts.equal_from_others {
        0 => String::new(),
        n => format!("; {n} equal ones came from others"),
    };
    format!("{bus}: {} frames sent in {seconds:.3} s ({rate:.0}/s); {echo}{others}", counts.sent)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::{Cli, Command};
    use crate::commands::can::args::CanCommand;
    use clap::Parser;

    fn contents(buses: &[&str]) -> Contents {
        Contents {
            what: "candump log",
            buses: buses.iter().map(|b| ((*b).to_owned(), 1)).collect(),
            order: buses.iter().map(|b| (*b).to_owned()).collect(),
            frames: 10,
            errors: 0,
            undirected: 0,
            first_ns: 1_000,
            last_ns: 10_000_001_000,
        }
    }

    fn mapped(logged: &[&str], stack: &[&str], bus: Option<&str>, map: &[&str]) -> String {
        let stack: Vec<String> = stack.iter().map(ToString::to_string).collect();
        let map: Vec<String> = map.iter().map(ToString::to_string).collect();
        match targets(&contents(logged), &stack, bus, &map) {
            Ok(targets) => targets.iter().map(|(a, b)| format!("{a}>{b}")).collect::<Vec<_>>().join(" "),
            Err(e) => e.to_string(),
        }
    }

    #[test]
    fn where_frames_go() {
        assert_eq!(mapped(&["vcan0"], &["can0"], None, &[]), "vcan0>can0");
        assert_eq!(mapped(&["can1", "can0"], &["can0", "can1", "x"], None, &[]), "can0>can0 can1>can1");
        assert_eq!(mapped(&["a", "b"], &["can0", "can1"], Some("can1"), &[]), "a>can1 b>can1");
        assert_eq!(mapped(&["a", "b"], &["can0", "can1"], None, &["b=can0"]), "b>can0");
        let said = [
            mapped(&["a", "b"], &["can0"], None, &[]),
            mapped(&["a"], &["can0"], Some("cna0"), &[]),
            mapped(&["vcan0"], &["can0"], None, &["vcan1=can0"]),
            mapped(&["a"], &["can0"], None, &["a=x"]),
            mapped(&["a"], &["can0"], None, &["a"]),
        ];
        insta::assert_snapshot!(said.join("\n"), @r#"
the file has frames of a, b, the stack has can0: say where they go with --bus BUS or --map LOGGED=BUS
the stack has no CAN bus 'cna0' (did you mean 'can0'?); it has can0
no frame of 'vcan1' in the file (did you mean 'vcan0'?); it has frames of vcan0
the stack has no CAN bus 'x'; it has can0
--map 'a' must be LOGGED=BUS, for example can0=vcan0
"#);
    }

    fn clock(args: &str) -> Clock {
        let words = ["dinrail", "can", "replay", "x.log"].into_iter().chain(args.split_whitespace());
        let Command::Can(CanCommand::Replay(args)) = Cli::try_parse_from(words).unwrap().command else {
            panic!()
        };
        Clock::new(&args, &contents(&["a"]))
    }

    #[test]
    fn when_frames_are_due() {
        let mut plain = clock("");
        assert_eq!(plain.due(0, 1_000), Some(Duration::ZERO));
        assert_eq!(plain.due(0, 2_000_001_000), Some(Duration::from_secs(2)));
        // Never backwards.
        assert_eq!(plain.due(0, 1_000_001_000), Some(Duration::from_secs(2)));
        assert_eq!(plain.due(0, 0), Some(Duration::from_secs(2)));
        // Ten frames in ten seconds: the next round begins one second behind the last frame.
        assert_eq!(plain.due(1, 1_000), Some(Duration::from_secs(11)));
        let mut fast = clock("--speed 4 --from 2s --to 6s --loop 2");
        assert_eq!(fast.due(0, 1_000), None);
        assert_eq!(fast.due(0, 4_000_001_000), Some(Duration::from_millis(500)));
        assert_eq!(fast.due(0, 7_000_001_000), None);
        assert_eq!(clock("--no-wait").due(0, 9_000_001_000), Some(Duration::ZERO));
    }

    #[test]
    fn long_pauses_are_cut() {
        let mut cut = clock("--max-gap 1s --loop 2");
        let due = |clock: &mut Clock, round, ms: u64| {
            clock.due(round, 1_000 + ms * 1_000_000).map(|due| due.as_millis() as u64)
        };
        for (round, ms, expected) in [
            (0, 0, 0),
            (0, 500, 500),
            (0, 4_500, 1_500),
            // Not in order: nothing to cut.
            (0, 4_000, 1_500),
            (0, 4_600, 1_600),
            (0, 10_000, 2_600),
            // Eleven seconds of the log lie between the rounds, 3 + 4.4 were cut.
            (1, 0, 3_600),
            (1, 500, 4_100),
            (1, 4_500, 5_100),
        ] {
            assert_eq!(due(&mut cut, round, ms), Some(expected), "{round} {ms}");
        }
        let mut fast = clock("--max-gap 1s --speed 2 --from 4s");
        assert_eq!((due(&mut fast, 0, 4_000), due(&mut fast, 0, 8_000)), (Some(0), Some(500)));
    }

    #[test]
    fn how_it_ends() {
        let whole = Counts { sent: 5, echoed: 5, equal_from_others: 3, ..Counts::default() };
        let swapped = Counts { out_of_order: 1, ..whole };
        let unseen = Counts { sent: 5, ..Counts::default() };
        let of = |stalled, each: &[Counts]| Outcome::of(stalled, each.iter());
        assert_eq!(of(false, &[whole]), Outcome::Whole);
        assert_eq!(of(false, &[whole, Counts::default()]), Outcome::Whole);
        assert_eq!(of(true, &[whole]), Outcome::Part);
        assert_eq!(of(false, &[whole, swapped]), Outcome::Part);
        assert_eq!(of(true, &[unseen]), Outcome::Nothing);
        assert_eq!(of(false, &[Counts::default()]), Outcome::Nothing);
        assert_eq!(Outcome::Nothing.exit_code(), ExitCode::FAILURE);
        let said = [(0, 0), (0, 2), (3, 0), (3, 2)].map(|(not_wanted, error_frames)| {
            nothing(Path::new("a.log"), LeftOut { error_frames, not_wanted })
        });
        insta::assert_snapshot!(said.join("\n"), @r#"
nothing was sent: ended before the first frame was due
nothing was sent: a.log holds error frames only, and nobody can send one
nothing was sent: every frame was left out by --filter, --map, --from, --to or --received-only
nothing was sent: every frame was left out: by --filter, --map, --from, --to or --received-only, or because it is an error frame
"#);
    }

    #[test]
    fn direction_is_not_invented() {
        let said = |words: &str, undirected| {
            let words = ["dinrail", "can", "replay", "x.log"].into_iter().chain(words.split_whitespace());
            let Command::Can(CanCommand::Replay(args)) = Cli::try_parse_from(words).unwrap().command else {
                panic!()
            };
            let filter = Filter::parse(&args.filter.filter, &Names::default()).unwrap();
            let contents = Contents { undirected, ..contents(&["a"]) };
            direction_is_told(&args, &contents, &filter).map_err(|e| e.to_string())
        };
        assert_eq!(said("", 10), Ok(()));
        assert_eq!(said("--received-only", 0), Ok(()));
        let error = said("--received-only", 10).unwrap_err();
        assert!(error.starts_with("x.log does not tell sent frames from received ones (10 of its 10 frames have no direction), so --received-only"), "{error}");
        assert!(said("--filter !#tx", 1).unwrap_err().contains("--filter #tx or #rx cannot be applied"));
    }

    #[test]
    fn summary() {
        let counts = Counts { sent: 100, echoed: 100, ..Counts::default() };
        assert_eq!(
            text("can0", &counts, 2.0),
            "can0: 100 frames sent in 2.000 s (50/s); every one was seen on the bus, in order"
        );
        let lost = Counts { echoed: 98, out_of_order: 1, ..counts };
        assert!(text("can0", &lost, 2.0).ends_with("2 were not seen on the bus, 1 out of order"));
        let shared = Counts { equal_from_others: 7, ..counts };
        assert!(text("can0", &shared, 2.0).ends_with("on the bus, in order; 7 equal ones came from others"));
        assert_eq!(text("can0", &Counts::default(), 2.0), "can0: no frame sent");
    }
}
