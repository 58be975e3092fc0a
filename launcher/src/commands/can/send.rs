//! `dinrail can send`.

use super::args::SendArgs;
use super::flight::Order;
use super::from_frame;
use super::sender::Sender;
use super::show::{Form, Paint, Printer, Time};
use crate::commands::UsageError;
use dinrail_can::protocol::candump;
use ipc_types::clock;
use ipc_types::payload::CanFrame;
use ipc_types::reactor::Reactor;
use std::process::ExitCode;
use std::time::{Duration, Instant};

pub fn run(args: &SendArgs, json: bool) -> anyhow::Result<ExitCode> {
    // Before anything else: a misspelt frame sends nothing, not even those before it.
    let mut frames = Vec::new();
    for text in &args.frames {
        let frame = candump::parse(text).map_err(|e| UsageError(e.to_string()))?;
        if frame.is_error() {
            return Err(UsageError(format!(
                "{text} is an error frame: a controller makes them, nobody can send one"
            ))
            .into());
        }
        frames.push(from_frame(&frame));
    }
    let mut ctx = super::join(args.which.stack.as_deref())?;
    let mut sender = Sender::new(&mut ctx, &args.bus, Order::Exact)?;
    let form = if json { Form::Json } else { Form::Log };
    let mut printer = Printer::new(form, Time::Day, false, Paint::PLAIN, None, 0);
    let mut reactor = Reactor::new()?;
    let stop = reactor.add(ctx.shutdown_fd())?;
    let every = args.every.map_or(Duration::ZERO, |every| every.duration());
    let begin = Instant::now();
    for round in 0..args.count {
        let due = every.saturating_mul(u32::try_from(round).unwrap_or(u32::MAX));
        loop {
            let left = due.saturating_sub(begin.elapsed());
            if reactor.wait(Some(left))?.contains(&stop) {
                return Ok(ExitCode::SUCCESS);
            }
            if left.is_zero() {
                break;
            }
        }
        for frame in &frames {
            send_one(&mut sender, frame, |seen| {
                let utc_ns = (seen.stamp.t_ns as i64 + clock::utc_offset_ns()).max(0) as u64;
                super::put(&(printer.line(&args.bus, seen, utc_ns) + "\n"));
            })?;
        }
    }
    Ok(ExitCode::SUCCESS)
}

/// Stays until the frame was on the bus: what a vanished writer left unread may be lost with it.
fn send_one(sender: &mut Sender, frame: &CanFrame, mut seen: impl FnMut(&CanFrame)) -> anyhow::Result<()> {
    let mut offered = false;
    loop {
        if !offered {
            offered = sender.offer(frame)?;
        }
        let busy = sender.look_at(&mut seen);
        if offered && !sender.is_waiting() {
            return Ok(());
        }
        if let Some(why) = sender.stalled() {
            anyhow::bail!(why);
        }
        sender.rest(busy);
    }
}
