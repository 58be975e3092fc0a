//! `dinrail recordings import`: a log as a recording that everything here reads.

use super::convert::{ImportArgs, create, renamed};
use crate::commands::can::source::{Contents, DIRECTION, DIRECTION_UNKNOWN, Source, contents};
use crate::commands::println;
use anyhow::Context as _;
use dinrail_recorder::config::Compression;
use dinrail_recorder::file::RecordingFile;
use dinrail_recorder::format::{META_CLOCK, META_RECORDING, channel, clock_metadata, host_name};
use ipc_types::payload::{CanFrame, Stamp, as_bytes, can_flag};
use ipc_types::stack::TopicEntry;
use ipc_types::topic::TopicKind;
use mcap::records::MessageHeader;
use std::collections::BTreeMap;
use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;

pub fn run(args: &ImportArgs, json: bool) -> anyhow::Result<ExitCode> {
    let contents = contents(&args.file)?;
    let mut source = Source::open(&args.file)?;
    if source.is_recording() {
        anyhow::bail!(
            "{} is a recording already; `dinrail recordings info` shows what is in it",
            args.file.display()
        );
    }
    let names = renamed(&args.bus, &contents.order)?;
    // Only now: a log with a mistake in it leaves no file behind.
    let file = create(&args.output, &args.file, args.force)?;
    let result = write(&mut source, file, &names, &contents, &args.file);
    let frames = result.with_context(|| format!("writing {}", args.output.display()))?;
    let buses: Vec<&str> = names.iter().map(|(_, to)| to.as_str()).collect();
    if json {
        println(&serde_json::json!({ "file": args.output.display().to_string(), "frames": frames, "buses": buses }).to_string());
    } else {
        println(&format!("{}: {frames} frames of {}", args.output.display(), buses.join(", ")));
    }
    Ok(ExitCode::SUCCESS)
}

/// A bus as its driver would have declared it.
fn topic(bus: &str) -> TopicEntry {
    let kind = TopicKind::CanRx;
    TopicEntry {
        name: kind.of(bus),
        kind,
        depth: kind.row().depth,
        max_tail: kind.row().max_tail,
        writers: vec![bus.to_owned()],
        readers: Vec::new(),
        wakes: Vec::new(),
        max_publishers: 1,
        max_subscribers: 1,
    }
}

fn write(
    source: &mut Source,
    file: std::fs::File,
    names: &[(String, String)],
    contents: &Contents,
    log: &Path,
) -> anyhow::Result<u64> {
    let mut out = RecordingFile::new(Arc::new(file), Compression::Zstd, true)?;
    out.metadata(META_RECORDING, about(log, contents))?;
    // A log has one clock: its stamps are taken for both.
    out.metadata(META_CLOCK, clock_metadata(0, contents.first_ns, "imported"))?;
    let mut ports: BTreeMap<&str, (u16, u32, u64)> = BTreeMap::new();
    let mut ids: BTreeMap<&str, u16> = BTreeMap::new();
    for (i, (from, to)) in names.iter().enumerate() {
        let id = match ids.get(to.as_str()) {
            Some(id) => *id,
            None => out.add_channel(&channel(&topic(to)))?,
        };
        ids.insert(to, id);
        ports.insert(from, (id, i as u32 + 1, 0));
    }
    out.close_chunk()?;
    let mut frames = 0;
    while let Some(logged) = source.next_frame()? {
        let Some((channel_id, writer, seq)) = ports.get_mut(logged.bus.as_str()) else { continue };
        *seq += 1;
        frames += 1;
        let frame = CanFrame {
            stamp: Stamp { seq: *seq, t_ns: logged.t_ns, generation: 1, writer: *writer },
            can_id: logged.frame.can_id,
            len: logged.frame.len,
            fd_flags: logged.frame.fd,
            flags: if logged.tx { can_flag::TX_ECHO } else { 0 },
            data: logged.frame.data,
            ..CanFrame::default()
        };
        let head = MessageHeader {
            channel_id: *channel_id,
            sequence: *seq as u32,
            log_time: logged.t_ns,
            publish_time: logged.t_ns,
        };
        out.message_chunked(&head, as_bytes(&frame))?;
    }
    out.finish()?;
    Ok(frames)
}

/// A log of which no frame tells its direction makes a recording that does not, either.
fn about(log: &Path, contents: &Contents) -> BTreeMap<String, String> {
    let name = log.file_name().map(|name| name.to_string_lossy().into_owned());
    let mut about = BTreeMap::from([
        ("stack".to_owned(), "import".to_owned()),
        ("imported_from".to_owned(), name.unwrap_or_default()),
        ("imported_as".to_owned(), contents.what.to_owned()),
        ("version".to_owned(), env!("CARGO_PKG_VERSION").to_owned()),
        ("host".to_owned(), host_name()),
    ]);
    if contents.undirected > 0 {
        about.insert(DIRECTION.to_owned(), DIRECTION_UNKNOWN.to_owned());
    }
    about
}
