//! `dinrail can sniff`.

use super::args::SniffArgs;
use super::ended_by;
use super::filter::Filter;
use super::listen::{LOOK, Listener};
use super::names::Names;
use super::screen::Page;
use super::show::{Paint, ascii, flag_words, id_text};
use crate::commands::DATA_LOSS;
use ipc_types::clock;
use ipc_types::payload::CanFrame;
use ipc_types::reactor::Reactor;
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::io::IsTerminal;
use std::process::ExitCode;
use std::time::{Duration, Instant};

const REFRESH: Duration = Duration::from_millis(200);
/// How long a byte that changed stays marked on a screen.
const MARKED_NS: u64 = 1_000_000_000;
/// Identifiers that are followed; further ones are counted.
const MAX_IDS: usize = 4096;

#[derive(Debug, Clone)]
struct Row {
    frame: CanFrame,
    frames: u64,
    period_ns: Option<u64>,
    /// When each byte changed last; 0: never.
    changed_ns: [u64; 64],
    names: String,
}

/// What was seen last of each identifier. Sans-I/O.
#[derive(Debug, Default)]
struct Sniffer {
    rows: BTreeMap<(bool, u32), Row>,
    beyond: u64,
}

/// What a frame told.
#[derive(Debug, PartialEq, Eq)]
enum News {
    /// The first of its identifier.
    First,
    /// These bytes are not what they were, or the length or kind is another.
    Changed(Vec<usize>),
    /// The same again.
    Same,
}

impl Sniffer {
    fn take(&mut self, bus: &str, frame: &CanFrame, names: &Names) -> News {
        if frame.is_error() {
            return News::Same;
        }
        let key = (frame.is_extended(), frame.id());
        let full = self.rows.len() >= MAX_IDS;
        let Some(row) = self.rows.get_mut(&key) else {
            if full {
                self.beyond += 1;
                return News::Same;
            }
            let names = names.text(bus, frame);
            self.rows
                .insert(key, Row { frame: *frame, frames: 1, period_ns: None, changed_ns: [0; 64], names });
            return News::First;
        };
        let t_ns = frame.stamp.t_ns;
        row.period_ns = Some(t_ns.saturating_sub(row.frame.stamp.t_ns));
        row.frames += 1;
        let (old, new) = (row.frame.payload(), frame.payload());
        let changed: Vec<usize> = (0..new.len()).filter(|i| old.get(*i) != new.get(*i)).collect();
        let same = changed.is_empty()
            && (row.frame.len, row.frame.fd_flags, row.frame.is_remote())
                == (frame.len, frame.fd_flags, frame.is_remote());
        for &i in &changed {
            row.changed_ns[i] = t_ns.max(1);
        }
        row.frame = *frame;
        if same {
            return News::Same;
        }
        row.names = names.text(bus, frame);
        News::Changed(changed)
    }

    /// A line of one identifier; `marked`: which bytes stand out.
    fn line(row: &Row, paint: &Paint, marked: impl Fn(usize) -> bool) -> String {
        let mut line = String::with_capacity(160);
        let period = row.period_ns.map_or("-".to_owned(), |ns| format!("{:.3}", ns as f64 / 1e6));
        let _ = write!(
            line,
            "{}{period:>11}{}  {:>8}  [{:>2}] ",
            paint.dim,
            paint.off,
            id_text(&row.frame),
            row.frame.len
        );
        let flags = flag_words(&row.frame);
        if !flags.is_empty() {
            let _ = write!(line, " {}{flags}{}", paint.cyan, paint.off);
        }
        line.push(' ');
        let mut width = 0;
        for (i, byte) in row.frame.payload().iter().enumerate() {
            let (on, off, plain) = match (marked(i), paint.mark.is_empty()) {
                (true, false) => (paint.mark, paint.off, ' '),
                // Without colours an asterisk stands behind what changed.
                (true, true) => ("", "", '*'),
                (false, _) => ("", "", ' '),
            };
            let _ = write!(line, "{on}{byte:02X}{off}{plain}");
            width += 3;
        }
        let _ = write!(
            line,
            "{:pad$} {}{}{}",
            "",
            paint.dim,
            ascii(row.frame.payload()),
            paint.off,
            pad = 24usize.saturating_sub(width)
        );
        if !row.names.is_empty() {
            let _ = write!(line, "  {}{}{}", paint.green, row.names, paint.off);
        }
        line.truncate(line.trim_end().len());
        line
    }

    fn page(&self, bus: &str, paint: &Paint, now_ns: u64) -> Vec<String> {
        let frames: u64 = self.rows.values().map(|row| row.frames).sum();
        let mut lines = vec![format!("{bus}: {} identifiers, {frames} frames; Ctrl-C ends", self.rows.len())];
        lines.push("  period ms        id  len   data".to_owned());
        for row in self.rows.values() {
            let since = now_ns.saturating_sub(MARKED_NS);
            lines.push(Self::line(row, paint, |i| row.changed_ns[i] != 0 && row.changed_ns[i] >= since));
        }
        if self.beyond > 0 {
            lines.push(format!(
                "{} frames of further identifiers: more than {MAX_IDS}; use --filter",
                self.beyond
            ));
        }
        lines
    }
}

pub fn run(args: &SniffArgs, json: bool) -> anyhow::Result<ExitCode> {
    let ctx = super::join(args.which.stack.as_deref())?;
    let names = Names::of(&ctx.stack);
    let filter = Filter::parse(&args.filter.filter, &names)?;
    let bus = super::one_bus(&ctx, args.bus.as_deref())?;
    let mut listener = Listener::new(&ctx, vec![bus.clone()])?;
    let mut reactor = Reactor::new()?;
    reactor.add_timer(LOOK)?;
    let stop = reactor.add(ctx.shutdown_fd())?;
    let terminal = std::io::stdout().is_terminal();
    let paint = Paint::choose(args.color, terminal, std::env::var_os("NO_COLOR").as_deref());
    let page = (terminal && !json).then(Page::open);
    let (begin, mut drawn) = (Instant::now(), Instant::now());
    let mut sniffer = Sniffer::default();
    let mut ended = false;
    while !ended {
        ended = reactor.wait(Some(LOOK * 4))?.contains(&stop) || ended_by(begin, args.duration);
        let mut text = String::new();
        listener.look(ended, |_, message| {
            if filter.takes(&bus, message) {
                let news = sniffer.take(&bus, message, &names);
                if page.is_none() && news != News::Same {
                    text += &news_line(&sniffer, &bus, message, &news, &paint, json.then_some(&names));
                    text.push('\n');
                }
            }
            true
        });
        ended |= !text.is_empty() && !super::put(&text);
        if let Some(page) = &page
            && drawn.elapsed() >= REFRESH
        {
            drawn = Instant::now();
            page.draw(&sniffer.page(&bus, &paint, clock::mono_ns()));
        }
    }
    drop(page);
    if let Some(text) = listener.loss_text() {
        eprintln!("dinrail: {text}");
        return Ok(ExitCode::from(DATA_LOSS));
    }
    Ok(ExitCode::SUCCESS)
}

fn news_line(
    sniffer: &Sniffer,
    bus: &str,
    frame: &CanFrame,
    news: &News,
    paint: &Paint,
    json: Option<&Names>,
) -> String {
    let Some(row) = sniffer.rows.get(&(frame.is_extended(), frame.id())) else { return String::new() };
    let none = Vec::new();
    let changed = if let News::Changed(changed) = news { changed } else { &none };
    if let Some(names) = json {
        let mut value = super::show::as_json(bus, frame, Some(names));
        value["changed"] = changed.as_slice().into();
        value["first"] = (*news == News::First).into();
        value["period_ms"] = row.period_ns.map(|ns| ns as f64 / 1e6).into();
        value["frames"] = row.frames.into();
        return value.to_string();
    }
    Sniffer::line(row, paint, |i| changed.contains(&i))
}

#[cfg(test)]
mod tests {
    use super::*;
    use dinrail_can::protocol::candump::parse;
    use ipc_types::payload::Stamp;

    #[test]
    fn what_changes_stands_out() {
        let names = Names::of_table(&[("can0", 0x123, "Speed")]);
        let mut sniffer = Sniffer::default();
        let (mut lines, mut json) = (Vec::new(), Vec::new());
        for (ms, text) in [
            (1000, "123#4100FF"),
            (1010, "123#4100FF"),
            (1020, "123#4101FE"),
            (1030, "00000123#R2"),
            (1040, "123#41"),
            (1050, "123##14142434445464748494A4B4C"),
            (1060, "20000040#0000000000000000"),
        ] {
            let stamp = Stamp { t_ns: ms * 1_000_000, ..Stamp::default() };
            let frame = CanFrame { stamp, ..super::super::from_frame(&parse(text).unwrap()) };
            let news = sniffer.take("can0", &frame, &names);
            if news != News::Same {
                lines.push(news_line(&sniffer, "can0", &frame, &news, &Paint::PLAIN, None));
                json.push(news_line(&sniffer, "can0", &frame, &news, &Paint::PLAIN, Some(&names)));
            }
        }
        insta::assert_snapshot!(lines.join("\n"), @r#"
     -       123  [ 3]  41 00 FF                 A..  Speed
10.000       123  [ 3]  41 01*FE*                A..  Speed
     -  00000123  [ 2]  RTR
20.000       123  [ 1]  41                       A  Speed
10.000       123  [12]  FD BRS 41 42*43*44*45*46*47*48*49*4A*4B*4C* ABCDEFGHIJKL  Speed
"#);
        insta::assert_snapshot!(json[..2].join("\n"), @r#"
{"brs":false,"bus":"can0","changed":[],"data":"4100FF","echo":false,"esi":false,"extended":false,"fd":false,"first":true,"frame":"123#4100FF","frames":1,"id":291,"id_text":"123","len":3,"names":{"Speed":null},"period_ms":null,"rtr":false}
{"brs":false,"bus":"can0","changed":[1,2],"data":"4101FE","echo":false,"esi":false,"extended":false,"fd":false,"first":false,"frame":"123#4101FE","frames":3,"id":291,"id_text":"123","len":3,"names":{"Speed":null},"period_ms":10.0,"rtr":false}
"#);
        insta::assert_snapshot!(sniffer.page("can0", &Paint::COLOR, 1_100_000_000).join("\n").replace('\x1b', "ESC"), @r#"
can0: 2 identifiers, 6 frames; Ctrl-C ends
  period ms        id  len   data
ESC[2m     10.000ESC[0m       123  [12]  ESC[36mFD BRSESC[0m 41 ESC[1;7m42ESC[0m ESC[1;7m43ESC[0m ESC[1;7m44ESC[0m ESC[1;7m45ESC[0m ESC[1;7m46ESC[0m ESC[1;7m47ESC[0m ESC[1;7m48ESC[0m ESC[1;7m49ESC[0m ESC[1;7m4AESC[0m ESC[1;7m4BESC[0m ESC[1;7m4CESC[0m  ESC[2mABCDEFGHIJKLESC[0m  ESC[32mSpeedESC[0m
ESC[2m          -ESC[0m  00000123  [ 2]  ESC[36mRTRESC[0m                          ESC[2mESC[0m
"#);
    }

    #[test]
    fn identifiers_have_a_limit() {
        let mut sniffer = Sniffer::default();
        for id in 0..=MAX_IDS as u32 {
            let frame = CanFrame { can_id: 0x8000_0000 | id, ..CanFrame::default() };
            sniffer.take("can0", &frame, &Names::default());
        }
        assert_eq!((sniffer.rows.len(), sniffer.beyond), (MAX_IDS, 1));
        assert!(sniffer.page("can0", &Paint::PLAIN, 0).last().unwrap().starts_with("1 frames of further"));
    }
}
