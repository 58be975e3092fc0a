//! `dinrail can dump` and `dinrail can send`.

use super::{UsageError, println};
use crate::cli::CanCommand;
use crate::supervise::client::{find, observe};
use dinrail_can::protocol::candump;
use dinrail_can::protocol::frame::Frame;
use ipc_types::payload::{CanFrame, can_flag};
use ipc_types::reactor::Reactor;
use ipc_types::topic::TopicKind;
use ipc_types::{Context, clock};
use std::time::{Duration, Instant};

/// Observers have no inbox: they look this often.
const LOOK: Duration = Duration::from_millis(5);
/// Frames taken at one look.
const BATCH: usize = 4096;
/// A sent frame must be seen on the bus within this time.
const ECHO_LIMIT: Duration = Duration::from_secs(2);

pub fn run(command: CanCommand, json: bool) -> anyhow::Result<()> {
    match command {
        CanCommand::Dump { bus, count, duration, which } => {
            let ctx = observe(&find(which.stack.as_deref())?)?;
            dump(&ctx, &bus, count, duration.map(|d| d.duration()), json)
        }
        CanCommand::Send { bus, frames, which } => {
            // Before anything else: a misspelt frame sends nothing, not even those before it.
            let mut parsed = Vec::new();
            for text in &frames {
                parsed.push(candump::parse(text).map_err(|e| UsageError(e.to_string()))?);
            }
            let mut ctx = observe(&find(which.stack.as_deref())?)?;
            send(&mut ctx, &bus, &parsed, json)
        }
    }
}

/// The topic of a bus, or an error that lists the buses.
fn topic(ctx: &Context, bus: &str, kind: TopicKind) -> anyhow::Result<String> {
    let name = kind.of(bus);
    if ctx.stack.topic(&name).is_some_and(|t| t.kind == kind) {
        return Ok(name);
    }
    let has = |s: &&ipc_types::stack::ServiceEntry| s.wiring.topics.iter().any(|t| t.kind == kind);
    let buses: Vec<&str> = ctx.stack.services.iter().filter(has).map(|s| s.name.as_str()).collect();
    if buses.is_empty() {
        anyhow::bail!("stack '{}' has no CAN bus", ctx.stack.name);
    }
    anyhow::bail!("stack '{}' has no CAN bus '{bus}'; it has {}", ctx.stack.name, buses.join(", "))
}

fn dump(
    ctx: &Context,
    bus: &str,
    count: Option<u64>,
    limit: Option<Duration>,
    json: bool,
) -> anyhow::Result<()> {
    let mut rx = ctx.subscriber::<CanFrame>(&topic(ctx, bus, TopicKind::CanRx)?)?;
    let mut reactor = Reactor::new()?;
    reactor.add_timer(LOOK)?;
    let stop = reactor.add(ctx.shutdown_fd())?;
    let begin = Instant::now();
    let offset_ns = clock::utc_offset_ns();
    let mut left = count.unwrap_or(u64::MAX);
    let mut ended = false;
    while !ended {
        ended = reactor.wait(Some(LOOK * 4))?.contains(&stop) || limit.is_some_and(|l| begin.elapsed() >= l);
        let mut text = String::new();
        while left > 0 {
            let want = usize::try_from(left).unwrap_or(BATCH).min(BATCH);
            let taken = rx.drain(want, |message, _| {
                text += &line(bus, message, offset_ns, json);
                text.push('\n');
                left = left.saturating_sub(1);
            });
            if taken < want {
                break;
            }
        }
        if !text.is_empty() {
            super::print(&text);
        }
        ended |= left == 0;
    }
    let lost = rx.counters().lost;
    if lost > 0 {
        eprintln!("dinrail: {lost} frames were not seen: this terminal is slower than the bus");
    }
    Ok(())
}

fn line(bus: &str, message: &CanFrame, offset_ns: i64, json: bool) -> String {
    let utc_ns = (message.stamp.t_ns as i64 + offset_ns).max(0) as u64;
    let frame = to_frame(message);
    if !json {
        return candump::format_log_line(utc_ns, bus, &frame);
    }
    serde_json::json!({
        "bus": bus, "seq": message.stamp.seq, "utc_ns": utc_ns, "frame": candump::format(&frame),
        "id": message.id(), "extended": message.is_extended(), "len": message.len,
        "echo": message.flags & can_flag::TX_ECHO != 0,
    })
    .to_string()
}

fn to_frame(message: &CanFrame) -> Frame {
    let mut data = [0u8; 64];
    let payload = message.payload();
    data[..payload.len()].copy_from_slice(payload);
    Frame { can_id: message.can_id, len: message.len, fd: message.fd_flags, data }
}

fn send(ctx: &mut Context, bus: &str, frames: &[Frame], json: bool) -> anyhow::Result<()> {
    let mut rx = ctx.subscriber::<CanFrame>(&topic(ctx, bus, TopicKind::CanRx)?)?;
    let mut tx = ctx.publisher::<CanFrame>(&topic(ctx, bus, TopicKind::CanTx)?)?;
    for frame in frames {
        let message = CanFrame {
            can_id: frame.can_id,
            len: frame.len,
            fd_flags: frame.fd,
            data: frame.data,
            ..CanFrame::default()
        };
        tx.send(message)?;
        tx.ring();
        // Staying until the frame was on the bus is more than politeness: what a vanished writer left unread may
        // be lost with it.
        let begin = Instant::now();
        let mut echo = None;
        while echo.is_none() {
            if begin.elapsed() > ECHO_LIMIT {
                anyhow::bail!(
                    "{}: not seen on bus '{bus}' within {} s: nobody acknowledges, or the driver is down (`dinrail ps`)",
                    candump::format(frame),
                    ECHO_LIMIT.as_secs()
                );
            }
            rx.drain(BATCH, |seen, _| {
                let same =
                    seen.can_id == message.can_id && seen.len == message.len && seen.data == message.data;
                if same && seen.flags & can_flag::TX_ECHO != 0 {
                    echo = Some(*seen);
                }
            });
            std::thread::sleep(Duration::from_millis(1));
        }
        if let Some(seen) = echo {
            println(&line(bus, &seen, clock::utc_offset_ns(), json));
        }
    }
    Ok(())
}
