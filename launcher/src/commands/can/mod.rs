//! `dinrail can`: what candump, cansend, cangen, canplayer, canbusload and cansniffer do, on the buses of a stack.
//!
//! [`args`] the arguments; [`filter`], [`names`], [`canopen_names`], [`merge`], [`show`] which frames and how they look;
//! [`listen`] reading buses; [`flight`] and [`sender`] sending without loss; [`source`] logs and recordings; one module
//! a verb.

pub mod args;
mod canopen_names;
mod dump;
mod filter;
mod flight;
mod generate;
mod listen;
mod merge;
mod names;
mod pattern;
mod replay;
mod screen;
mod send;
mod sender;
mod show;
mod sniff;
pub mod source;
mod stats;

use crate::commands::UsageError;
use crate::stackfile::nearest;
use crate::supervise::client::{find, is_full, observe, with_room};
use crate::terminal::coloured;
use args::CanCommand;
use dinrail_can::protocol::frame::Frame;
use ipc_types::payload::CanFrame;
use ipc_types::rail::RailError;
use ipc_types::topic::TopicKind;
use ipc_types::units::Span;
use ipc_types::{Context, Stack};
use std::io::Write;
use std::process::ExitCode;
use std::time::Instant;

pub fn run(command: CanCommand, json: bool) -> anyhow::Result<ExitCode> {
    match command {
        CanCommand::Dump(args) => dump::run(&args, json),
        CanCommand::Send(args) => send::run(&args, json),
        CanCommand::Gen(args) => generate::run(&args, json),
        CanCommand::Replay(args) => replay::run(&args, json),
        CanCommand::Stats(args) => stats::run(&args, json),
        CanCommand::Sniff(args) => sniff::run(&args, json),
    }
}

/// Joins the stack meant.
fn join(stack: Option<&str>) -> anyhow::Result<Context> {
    let stack = find(stack)?;
    observe(&stack).map_err(|e| if is_full(&e) { crowded(&stack.stack) } else { e.into() })
}

/// Places for tools are few, because every one costs shared memory on every topic.
fn crowded(stack: &str) -> anyhow::Error {
    anyhow::anyhow!(
        "stack '{stack}': too many tools (`can dump`, `top`, ...) look at it at the same time: end one and try again"
    )
}

/// A port on a topic; when it has no place left, in words.
fn place<T>(stack: &Stack, open: impl FnMut() -> Result<T, RailError>) -> anyhow::Result<T> {
    with_room(&stack.root, open).map_err(|e| if is_full(&e) { crowded(&stack.name) } else { e.into() })
}

/// Prints; false when nobody reads any more. Not by ending the process: its place on the rail must be given back.
fn put(text: &str) -> bool {
    let mut out = std::io::stdout().lock();
    out.write_all(coloured(text).as_bytes()).and_then(|()| out.flush()).is_ok()
}

/// Every bus of the stack, in its order.
fn all_buses(ctx: &Context) -> Vec<String> {
    let has =
        |s: &&ipc_types::stack::ServiceEntry| s.wiring.topics.iter().any(|t| t.kind == TopicKind::CanRx);
    ctx.stack.services.iter().filter(has).map(|s| s.name.clone()).collect()
}

/// The buses asked for, each once; all of them for none or `all`.
fn buses(ctx: &Context, asked: &[String]) -> anyhow::Result<Vec<String>> {
    let all = all_buses(ctx);
    if asked.is_empty() || (asked.iter().any(|b| b == "all") && !all.iter().any(|b| b == "all")) {
        anyhow::ensure!(!all.is_empty(), "stack '{}' has no CAN bus", ctx.stack.name);
        return Ok(all);
    }
    let mut chosen: Vec<String> = Vec::new();
    for bus in asked {
        topic(ctx, bus, TopicKind::CanRx)?;
        if !chosen.contains(bus) {
            chosen.push(bus.clone());
        }
    }
    Ok(chosen)
}

/// The bus meant; of one bus it need not be named.
fn one_bus(ctx: &Context, asked: Option<&str>) -> anyhow::Result<String> {
    match asked {
        Some(bus) => topic(ctx, bus, TopicKind::CanRx).map(|_| bus.to_owned()),
        None => match all_buses(ctx).as_slice() {
            [] => anyhow::bail!("stack '{}' has no CAN bus", ctx.stack.name),
            [only] => Ok(only.clone()),
            several => {
                let several = several.join(", ");
                Err(UsageError(format!(
                    "stack '{}' has several CAN buses: name one of {several}",
                    ctx.stack.name
                ))
                .into())
            }
        },
    }
}

/// The topic of a bus, or an error that lists the buses.
fn topic(ctx: &Context, bus: &str, kind: TopicKind) -> anyhow::Result<String> {
    let name = kind.of(bus);
    if ctx.stack.topic(&name).is_some_and(|t| t.kind == kind) {
        return Ok(name);
    }
    let buses = all_buses(ctx);
    if buses.is_empty() {
        anyhow::bail!("stack '{}' has no CAN bus", ctx.stack.name);
    }
    let near = nearest(bus, buses.iter().map(String::as_str));
    let near = near.map(|near| format!(" (did you mean '{near}'?)")).unwrap_or_default();
    anyhow::bail!("stack '{}' has no CAN bus '{bus}'{near}; it has {}", ctx.stack.name, buses.join(", "))
}

fn ended_by(begin: Instant, limit: Option<Span>) -> bool {
    limit.is_some_and(|limit| begin.elapsed() >= limit.duration())
}

/// A frame of the rail as the codecs have it.
fn to_frame(message: &CanFrame) -> Frame {
    let mut data = [0u8; 64];
    let payload = message.payload();
    data[..payload.len()].copy_from_slice(payload);
    Frame { can_id: message.can_id, len: message.len, fd: message.fd_flags, data }
}

/// A frame of the codecs as the rail has it.
fn from_frame(frame: &Frame) -> CanFrame {
    CanFrame {
        can_id: frame.can_id,
        len: frame.len,
        fd_flags: frame.fd,
        data: frame.data,
        ..CanFrame::default()
    }
}
