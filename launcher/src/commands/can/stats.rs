//! `dinrail can stats`.

use super::args::StatsArgs;
use super::ended_by;
use super::filter::Filter;
use super::listen::{LOOK, Listener};
use super::names::Names;
use super::screen::Page;
use super::show::id_text;
use super::to_frame;
use crate::commands::{DATA_LOSS, table};
use dinrail_can::protocol::busload::{Stuffing, bits};
use ipc_types::payload::{CanFrame, can_flag, id_flag};
use ipc_types::reactor::Reactor;
use ipc_types::stack::Stack;
use ipc_types::units::BitRate;
use std::collections::BTreeMap;
use std::io::IsTerminal;
use std::process::ExitCode;
use std::time::{Duration, Instant};

/// How long a report without a terminal looks.
const ONCE: Duration = Duration::from_secs(2);
const REFRESH: Duration = Duration::from_millis(500);
/// Identifiers that are told apart, all buses together; further ones count for their bus alone.
const MAX_IDS: usize = 16_384;

#[derive(Debug, Clone, Default)]
struct Row {
    frames: u64,
    sent: u64,
    first_ns: u64,
    last_ns: u64,
    min_ns: u64,
    max_ns: u64,
    shortest: u8,
    longest: u8,
    /// Without their values: many frames, many values.
    names: Vec<String>,
}

impl Row {
    fn add(&mut self, frame: &CanFrame) {
        let t_ns = frame.stamp.t_ns;
        if self.frames == 0 {
            (self.first_ns, self.shortest, self.min_ns) = (t_ns, frame.len, u64::MAX);
        } else {
            let period = t_ns.saturating_sub(self.last_ns);
            self.min_ns = self.min_ns.min(period);
            self.max_ns = self.max_ns.max(period);
        }
        self.last_ns = t_ns;
        self.frames += 1;
        self.sent += u64::from(frame.flags & can_flag::TX_ECHO != 0);
        self.shortest = self.shortest.min(frame.len);
        self.longest = self.longest.max(frame.len);
    }

    /// Shortest, mean and longest time between two frames, in ms.
    fn periods(&self) -> Option<[f64; 3]> {
        let gaps = self.frames.checked_sub(1).filter(|n| *n > 0)?;
        let mean = self.last_ns.saturating_sub(self.first_ns) as f64 / gaps as f64;
        Some([self.min_ns as f64, mean, self.max_ns as f64].map(|ns| ns / 1e6))
    }
}

#[derive(Debug, Clone, Default)]
struct Bus {
    name: String,
    /// Nominal and data bit rate, where the stack says them.
    rates: Option<(u32, u32)>,
    frames: u64,
    sent: u64,
    remote: u64,
    fd: u64,
    errors: u64,
    busy_ns: u64,
    lost: u64,
}

/// Counts. Sans-I/O.
#[derive(Debug, Clone, Default)]
struct Stats {
    buses: Vec<Bus>,
    rows: BTreeMap<(usize, bool, u32), Row>,
    uncounted_ids: bool,
}

impl Stats {
    fn new(stack: &Stack, names: &[String]) -> Self {
        let bus = |name: &String| Bus { name: name.clone(), rates: rates(stack, name), ..Bus::default() };
        Self { buses: names.iter().map(bus).collect(), ..Self::default() }
    }

    fn add(&mut self, at: usize, message: &CanFrame, names: &Names) {
        let Some(bus) = self.buses.get_mut(at) else { return };
        if message.is_error() {
            bus.errors += 1;
            return;
        }
        bus.frames += 1;
        bus.sent += u64::from(message.flags & can_flag::TX_ECHO != 0);
        bus.remote += u64::from(message.is_remote());
        bus.fd += u64::from(message.is_fd());
        if let Some((nominal, data)) = bus.rates {
            bus.busy_ns += bits(&to_frame(message), Stuffing::Exact).time_ns(nominal, data);
        }
        let key = (at, message.is_extended(), message.id());
        if let Some(row) = self.rows.get_mut(&key) {
            row.add(message);
        } else if self.rows.len() < MAX_IDS {
            let described = names.describe(&bus.name, message);
            let names = described.into_iter().map(|(name, _)| name).collect();
            let mut row = Row { names, ..Row::default() };
            row.add(message);
            self.rows.insert(key, row);
        } else {
            self.uncounted_ids = true;
        }
    }

    fn text(&self, seconds: f64) -> String {
        let share = |bus: &Bus| match bus.rates {
            Some(_) => format!("{:.1} %", bus.busy_ns as f64 / 1e7 / seconds),
            None => "-".to_owned(),
        };
        let buses: Vec<Vec<String>> = self
            .buses
            .iter()
            .map(|b| {
                let rate = b.frames as f64 / seconds;
                let counts = [b.frames, b.sent, b.remote, b.fd, b.errors, b.lost].map(|n| n.to_string());
                let [frames, sent, remote, fd, errors, lost] = counts;
                vec![b.name.clone(), frames, format!("{rate:.1}"), share(b), sent, remote, fd, errors, lost]
            })
            .collect();
        let head = ["bus", "frames", "frames/s", "load", "sent by us", "RTR", "FD", "errors", "not seen"];
        let mut text = table(&head, &buses);
        let ids: Vec<Vec<String>> = self
            .rows
            .iter()
            .map(|((bus, extended, id), row)| {
                let periods = row
                    .periods()
                    .map_or(["-", "-", "-"].map(str::to_owned), |p| p.map(|ms| format!("{ms:.3}")));
                let [min, mean, max] = periods;
                let rate = format!("{:.1}", row.frames as f64 / seconds);
                let len = lengths(row);
                vec![
                    self.buses[*bus].name.clone(),
                    id_of(*extended, *id),
                    row.frames.to_string(),
                    rate,
                    min,
                    mean,
                    max,
                    len,
                    row.names.join(" "),
                ]
            })
            .collect();
        if !ids.is_empty() {
            let head = ["bus", "id", "frames", "frames/s", "min ms", "mean ms", "max ms", "len", "names"];
            text += "\n";
            text += &table(&head, &ids);
        }
        if self.uncounted_ids {
            text += &format!("more than {MAX_IDS} identifiers: the others are not listed; use --filter\n");
        }
        text
    }

    fn json(&self, seconds: f64) -> serde_json::Value {
        let buses: Vec<_> = self
            .buses
            .iter()
            .map(|b| {
                serde_json::json!({
                    "bus": b.name, "frames": b.frames, "frames_per_s": b.frames as f64 / seconds,
                    "load_percent": b.rates.map(|_| b.busy_ns as f64 / 1e7 / seconds), "bitrate": b.rates.map(|r| r.0),
                    "sent": b.sent, "rtr": b.remote, "fd": b.fd, "errors": b.errors, "lost": b.lost,
                })
            })
            .collect();
        let ids: Vec<_> = self
            .rows
            .iter()
            .map(|((bus, extended, id), row)| {
                let periods = row.periods();
                serde_json::json!({
                    "bus": self.buses[*bus].name, "id": id, "id_text": id_of(*extended, *id), "extended": extended,
                    "frames": row.frames, "sent": row.sent, "frames_per_s": row.frames as f64 / seconds,
                    "period_min_ms": periods.map(|p| p[0]), "period_mean_ms": periods.map(|p| p[1]),
                    "period_max_ms": periods.map(|p| p[2]),
                    "len_min": row.shortest, "len_max": row.longest,
                    "names": row.names.iter().map(|n| (n.clone(), None)).collect::<BTreeMap<String, Option<String>>>(),
                })
            })
            .collect();
        serde_json::json!({ "seconds": seconds, "buses": buses, "ids": ids, "ids_complete": !self.uncounted_ids })
    }
}

fn lengths(row: &Row) -> String {
    if row.shortest == row.longest {
        row.longest.to_string()
    } else {
        format!("{}-{}", row.shortest, row.longest)
    }
}

fn id_of(extended: bool, id: u32) -> String {
    id_text(&CanFrame { can_id: id | if extended { id_flag::EFF } else { 0 }, ..CanFrame::default() })
}

/// The bit rates that the stack file gives a bus, or its driver's default.
fn rates(stack: &Stack, bus: &str) -> Option<(u32, u32)> {
    let service = stack.service(bus).filter(|s| s.kind == "can")?;
    let rate = |key: &str, default| match service.config.get(key) {
        Some(value) => serde_json::from_value::<BitRate>(value.clone()).ok().map(|rate| rate.0),
        None => Some(default),
    };
    Some((rate("bitrate", 500_000)?, rate("data_bitrate", 2_000_000)?))
}

pub fn run(args: &StatsArgs, json: bool) -> anyhow::Result<ExitCode> {
    let ctx = super::join(args.which.stack.as_deref())?;
    let names = Names::of(&ctx.stack);
    let filter = Filter::parse(&args.filter.filter, &names)?;
    let buses = super::buses(&ctx, &args.buses)?;
    let mut stats = Stats::new(&ctx.stack, &buses);
    let mut listener = Listener::new(&ctx, buses.clone())?;
    let mut reactor = Reactor::new()?;
    reactor.add_timer(LOOK)?;
    let stop = reactor.add(ctx.shutdown_fd())?;
    let live = std::io::stdout().is_terminal() && !json;
    let page = live.then(Page::open);
    let (begin, mut drawn) = (Instant::now(), Instant::now());
    let mut ended = false;
    while !ended {
        ended = reactor.wait(Some(LOOK * 4))?.contains(&stop)
            || ended_by(begin, args.duration)
            || (!live && args.duration.is_none() && begin.elapsed() >= ONCE);
        listener.look(ended, |bus, message| {
            if filter.takes(&buses[bus], message) {
                stats.add(bus, message, &names);
            }
            true
        });
        for (bus, lost) in stats.buses.iter_mut().zip(listener.lost()) {
            bus.lost = lost;
        }
        if let Some(page) = &page
            && (drawn.elapsed() >= REFRESH || ended)
        {
            drawn = Instant::now();
            let text = stats.text(begin.elapsed().as_secs_f64());
            page.draw(&text.lines().map(str::to_owned).collect::<Vec<_>>());
        }
    }
    drop(page);
    let seconds = begin.elapsed().as_secs_f64();
    if json {
        super::put(&format!("{}\n", stats.json(seconds)));
    } else {
        super::put(&stats.text(seconds));
    }
    if let Some(text) = listener.loss_text() {
        eprintln!("dinrail: {text}");
        return Ok(ExitCode::from(DATA_LOSS));
    }
    Ok(ExitCode::SUCCESS)
}

#[cfg(test)]
mod tests {
    use super::*;
    use dinrail_can::protocol::candump::parse;
    use ipc_types::payload::Stamp;

    #[test]
    fn rates_periods_and_load() {
        let names = Names::of_table(&[("can0", 0x123, "Speed")]);
        let bus = |name: &str, rates| Bus { name: name.into(), rates, ..Bus::default() };
        let mut stats = Stats {
            buses: vec![bus("can0", Some((500_000, 2_000_000))), bus("far", None)],
            ..Stats::default()
        };
        let mut add = |bus, ms: u64, text: &str, flags| {
            let stamp = Stamp { t_ns: ms * 1_000_000, ..Stamp::default() };
            stats.add(
                bus,
                &CanFrame { stamp, flags, ..super::super::from_frame(&parse(text).unwrap()) },
                &names,
            );
        };
        for (i, ms) in [0, 10, 30, 45].into_iter().enumerate() {
            add(0, ms, ["123#11", "123#1122"][i % 2], 0);
        }
        add(0, 50, "00000123#R", can_flag::TX_ECHO);
        add(0, 60, "20000040#0000000000000000", 0);
        add(1, 70, "7FF##1AA", 0);
        insta::assert_snapshot!(stats.text(0.5), @r#"
bus   frames  frames/s  load   sent by us  RTR  FD  errors  not seen
can0  5       10.0      0.1 %  1           1    0   1       0
far   1       2.0       -      0           0    1   0       0

bus   id        frames  frames/s  min ms  mean ms  max ms  len  names
can0  123       4       8.0       10.000  15.000   20.000  1-2  Speed
can0  00000123  1       2.0       -       -        -       0
far   7FF       1       2.0       -       -        -       1
"#);
        insta::assert_snapshot!(format!("{:#}", stats.json(0.5)), @r#"
{
  "buses": [
    {
      "bitrate": 500000,
      "bus": "can0",
      "errors": 1,
      "fd": 0,
      "frames": 5,
      "frames_per_s": 10.0,
      "load_percent": 0.1252,
      "lost": 0,
      "rtr": 1,
      "sent": 1
    },
    {
      "bitrate": null,
      "bus": "far",
      "errors": 0,
      "fd": 1,
      "frames": 1,
      "frames_per_s": 2.0,
      "load_percent": null,
      "lost": 0,
      "rtr": 0,
      "sent": 0
    }
  ],
  "ids": [
    {
      "bus": "can0",
      "extended": false,
      "frames": 4,
      "frames_per_s": 8.0,
      "id": 291,
      "id_text": "123",
      "len_max": 2,
      "len_min": 1,
      "names": {
        "Speed": null
      },
      "period_max_ms": 20.0,
      "period_mean_ms": 15.0,
      "period_min_ms": 10.0,
      "sent": 0
    },
    {
      "bus": "can0",
      "extended": true,
      "frames": 1,
      "frames_per_s": 2.0,
      "id": 291,
      "id_text": "00000123",
      "len_max": 0,
      "len_min": 0,
      "names": {},
      "period_max_ms": null,
      "period_mean_ms": null,
      "period_min_ms": null,
      "sent": 1
    },
    {
      "bus": "far",
      "extended": false,
      "frames": 1,
      "frames_per_s": 2.0,
      "id": 2047,
      "id_text": "7FF",
      "len_max": 1,
      "len_min": 1,
      "names": {},
      "period_max_ms": null,
      "period_mean_ms": null,
      "period_min_ms": null,
      "sent": 0
    }
  ],
  "ids_complete": true,
  "seconds": 0.5
}
"#);
    }

    #[test]
    fn identifiers_have_a_limit() {
        let mut stats =
            Stats { buses: vec![Bus { name: "can0".into(), ..Bus::default() }], ..Stats::default() };
        for id in 0..=MAX_IDS as u32 {
            let frame = CanFrame { can_id: id_flag::EFF | id, ..CanFrame::default() };
            stats.add(0, &frame, &Names::default());
        }
        assert_eq!((stats.rows.len(), stats.buses[0].frames), (MAX_IDS, MAX_IDS as u64 + 1));
        assert!(
            stats
                .text(1.0)
                .ends_with("more than 16384 identifiers: the others are not listed; use --filter\n")
        );
    }
}
