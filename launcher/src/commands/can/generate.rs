//! `dinrail can gen`.

use super::args::GenArgs;
use super::flight::Order;
use super::pattern::Pattern;
use super::sender::{Counts, Sender};
use super::{ended_by, from_frame};
use crate::commands::DATA_LOSS;
use ipc_types::reactor::Reactor;
use std::process::ExitCode;
use std::time::{Duration, Instant};

pub fn run(args: &GenArgs, json: bool) -> anyhow::Result<ExitCode> {
    let mut pattern = Pattern::of(args)?;
    let mut ctx = super::join(args.which.stack.as_deref())?;
    let order = if args.in_order { Order::Exact } else { Order::ByIdentifier };
    let bus = super::one_bus(&ctx, args.bus.as_deref())?;
    let mut sender = Sender::new(&mut ctx, &bus, order)?;
    let mut reactor = Reactor::new()?;
    let stop = reactor.add(ctx.shutdown_fd())?;
    let (gap, begin) = (args.gap.duration(), Instant::now());
    let mut left = args.count.unwrap_or(u64::MAX);
    let mut next = None;
    let mut due = Duration::ZERO;
    let mut why = None;
    while left > 0 && why.is_none() {
        if reactor.wait(Some(Duration::ZERO))?.contains(&stop) || ended_by(begin, args.duration) {
            break;
        }
        // A turn's worth, so that the end is not overlooked.
        let mut gone = 0;
        while left > 0 && gone < 64 && begin.elapsed() >= due {
            let frame = next.get_or_insert_with(|| from_frame(&pattern.next_frame()));
            if !sender.offer(frame)? {
                break;
            }
            next = None;
            left -= 1;
            gone += 1;
            due += gap;
        }
        let seen = sender.look();
        why = sender.stalled();
        let early = due.saturating_sub(begin.elapsed());
        if gone == 0 && early > Duration::from_millis(2) {
            std::thread::sleep(early.min(Duration::from_millis(50)).saturating_sub(Duration::from_millis(1)));
        } else {
            sender.rest(seen || gone > 0);
        }
    }
    let why = why.or_else(|| sender.finish());
    let code = report(&bus, &sender.counts(), begin.elapsed(), why.as_deref(), args.in_order, json);
    for remark in sender.remarks() {
        eprintln!("dinrail: {remark}");
    }
    Ok(code)
}

/// What was done, and whether all of it was seen.
fn report(
    bus: &str,
    counts: &Counts,
    took: Duration,
    why: Option<&str>,
    in_order: bool,
    json: bool,
) -> ExitCode {
    let whole = counts.echoed == counts.sent && counts.out_of_order == 0;
    let rate = counts.sent as f64 / took.as_secs_f64().max(1e-9);
    if json {
        let mut value = serde_json::to_value(counts).unwrap_or_default();
        value["bus"] = bus.into();
        value["seconds"] = took.as_secs_f64().into();
        super::put(&format!("{value}\n"));
    } else {
        super::put(&(text(bus, counts, took.as_secs_f64(), rate, in_order) + "\n"));
    }
    if let Some(why) = why {
        eprintln!("dinrail: {why}");
    }
    match () {
        () if counts.echoed == 0 => ExitCode::FAILURE,
        () if whole && why.is_none() => ExitCode::SUCCESS,
        () => ExitCode::from(DATA_LOSS),
    }
}

fn text(bus: &str, counts: &Counts, seconds: f64, rate: f64, in_order: bool) -> String {
    let order = match counts.out_of_order {
        0 if in_order => ", in order".to_owned(),
        0 => String::new(),
        n => format!(", {n} out of order"),
    };
    format!(
        "{bus}: {} sent in {seconds:.3} s ({rate:.0}/s), refused {} times for lack of room and sent later, {} seen on the bus{order}",
        counts.sent, counts.refused, counts.echoed
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn summary() {
        let counts = Counts { sent: 1000, refused: 3, echoed: 1000, ..Counts::default() };
        assert_eq!(
            text("can0", &counts, 0.5, 2000.0, true),
            "can0: 1000 sent in 0.500 s (2000/s), refused 3 times for lack of room and sent later, 1000 seen on the bus, in order"
        );
        let lost = Counts { echoed: 999, out_of_order: 2, ..counts };
        assert!(text("can0", &lost, 0.5, 2000.0, true).ends_with("999 seen on the bus, 2 out of order"));
    }
}
