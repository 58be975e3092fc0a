//! The recorder's process: the drain thread, which has the rail and never waits for the disk.

use crate::batch::{Batch, Pool, QUEUE};
use crate::config::Config;
use crate::disk;
use crate::format;
use crate::writer::{Notice, Progress, Shared, ToWriter, Writer};
use ipc_types::event::{EventKind, Level};
use ipc_types::payload::{Event, HealthState, Job, event_flag, from_bytes};
use ipc_types::port::{Publisher, RawSubscriber, ReadCounters};
use ipc_types::rail::RailError;
use ipc_types::reactor::Reactor;
use ipc_types::topic::TopicKind;
use ipc_types::{Context, clock};
use serde::Serialize;
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, channel, sync_channel};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// Time between two looks at the topics.
const DRAIN_PERIOD: Duration = Duration::from_millis(5);
/// Looks between two heartbeats: 50 ms.
const BEAT_EVERY: u32 = 10;
const STATUS_PERIOD: Duration = Duration::from_secs(1);
/// Time between two requests for a keyframe that does not come.
const KEYFRAME_PERIOD_NS: u64 = 500_000_000;
/// UTC against CLOCK_MONOTONIC moved by more than this: a jump. Below it is the noise of two clock readings.
const CLOCK_JUMP_NS: u64 = 1_000_000;
/// What `run` waits for the writer to finish the file when the stack ends.
const FINISH_LIMIT: Duration = Duration::from_millis(900);

/// What of it the topics may take to be emptied, when the disk is slow.
const DRAIN_LIMIT: Duration = Duration::from_millis(400);

/// Why the recorder ended.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    #[error(transparent)]
    Rail(#[from] RailError),
    #[error("recorder: {0}")]
    System(#[from] std::io::Error),
    #[error("recorder: the writer thread ended; the log has its reason; restart the service")]
    WriterDied,
    #[error("recorder: the file was not finished within {FINISH_LIMIT:?}; the next start makes it whole")]
    NotFinished,
}

struct Source {
    name: String,
    port: Box<dyn RawSubscriber>,
    /// Largest message.
    max_message: usize,
    /// Since when it hears, CLOCK_MONOTONIC.
    since_ns: u64,
    /// `stack/events`.
    events: bool,
}

/// Whether an event was said before, when a recorder was not there.
fn is_again(header: &[u8]) -> bool {
    from_bytes::<Event>(header).is_some_and(|event| event.flags & event_flag::AGAIN != 0)
}

struct Recorder {
    ctx: Context,
    config: Config,
    sources: Vec<Source>,
    keyframe_jobs: Vec<Publisher<Job>>,
    asked_at_ns: u64,
    shared: Arc<Shared>,
    to_writer: SyncSender<ToWriter>,
    notices: Receiver<Notice>,
    batch: Option<Batch>,
    /// When the first message of the batch was taken.
    batch_since: Option<Instant>,
    utc_offset_ns: i64,
    /// Looks at which no buffer was free.
    stalls: u64,
    stalls_told: u64,
    missed_told: u64,
    last: Option<(Instant, Progress)>,
}

/// Counters of a topic in the status.
#[derive(Serialize)]
struct Status<'a> {
    #[serde(flatten)]
    progress: &'a Progress,
    messages_per_s: u64,
    mb_per_h: f64,
    /// Lost, malformed or dropped, all topics, since start.
    missed: u64,
    /// Topics with losses.
    losses: BTreeMap<&'a str, ReadCounters>,
    /// Free buffers between the two threads.
    buffers_free: usize,
    stalls: u64,
}

/// Records until the stack ends.
pub fn run(ctx: Context) -> Result<(), RunError> {
    let config: Config = ctx.config()?;
    let mut reactor = Reactor::new()?;
    let tick = reactor.add_timer(DRAIN_PERIOD)?;
    let stop = reactor.add(ctx.shutdown_fd())?;
    let (mut recorder, writer, inbox) = Recorder::join(ctx, config)?;
    let (done, finished) = channel::<()>();
    let thread = std::thread::Builder::new().name("rec-writer".into()).spawn(move || {
        writer.run(&inbox);
        drop(done);
    })?;
    recorder.clock_event("start");
    recorder.ctx.ready();
    let mut ticks = 0u32;
    'work: loop {
        for wake in reactor.wait(None)? {
            if *wake == stop {
                break 'work;
            }
            if *wake == tick {
                ticks = ticks.wrapping_add(1);
            }
        }
        recorder.look();
        recorder.ask_for_keyframes();
        if ticks.is_multiple_of(BEAT_EVERY) {
            recorder.ctx.beat();
            recorder.tell();
        }
        if thread.is_finished() {
            return Err(RunError::WriterDied);
        }
    }
    recorder.stop(&finished)
}

impl Recorder {
    fn join(mut ctx: Context, config: Config) -> Result<(Self, Writer, Receiver<ToWriter>), RunError> {
        let stack = Arc::new((*ctx.stack).clone());
        // Subscribed before anything else: what is sent from now on waits in the queues.
        let mut sources = Vec::new();
        for topic in format::recorded_topics(&stack, &config.exclude) {
            sources.push(Source {
                name: topic.name.clone(),
                port: ctx.raw_subscriber(&topic.name)?,
                since_ns: clock::mono_ns(),
                events: topic.kind == TopicKind::Events,
                max_message: topic.kind.header_bytes() + topic.max_tail as usize,
            });
        }
        let mut keyframe_jobs = Vec::new();
        for service in stack.services.iter().filter(|s| s.kind == "plc") {
            let topic = TopicKind::Jobs.of(&service.name);
            if stack.topic(&topic).is_some() {
                keyframe_jobs.push(ctx.publisher::<Job>(&topic)?);
            }
        }
        let largest = sources.iter().map(|s| s.max_message).max().unwrap_or(0);
        let shared = Arc::new(Shared {
            pool: Pool::new(QUEUE, sources.len(), largest),
            progress: Mutex::new(Progress::default()),
            keyframe_wanted: AtomicBool::new(false),
        });
        // One place more than there are batches, for the last word: sending never waits.
        let (to_writer, inbox) = sync_channel(QUEUE + 1);
        let (notice, notices) = channel();
        let utc_offset_ns = clock::utc_offset_ns();
        let (generation, to_write) = (ctx.generation, shared.clone());
        let writer =
            Writer::new(config.clone(), stack, &ctx.service, generation, to_write, notice, utc_offset_ns);
        let recorder = Self {
            ctx,
            config,
            sources,
            keyframe_jobs,
            asked_at_ns: 0,
            shared,
            to_writer,
            notices,
            batch: None,
            batch_since: None,
            utc_offset_ns,
            stalls: 0,
            stalls_told: 0,
            missed_told: 0,
            last: None,
        };
        Ok((recorder, writer, inbox))
    }

    /// Takes what waits in the topics, until they are empty or no buffer is free; whether they are empty.
    fn look(&mut self) -> bool {
        // Bounded: a flood must not keep the heartbeat waiting. What is left waits on the rail.
        for _ in 0..QUEUE {
            let Some(mut batch) = self.batch.take().or_else(|| self.shared.pool.take()) else {
                self.stalls += 1;
                return false;
            };
            let (first, began_ns) = (batch.entries.len(), clock::mono_ns());
            let more = self.fill(&mut batch);
            if !batch.entries.is_empty() && self.batch_since.is_none() {
                self.batch_since = Some(Instant::now());
            }
            self.batch = Some(batch);
            let aged =
                self.batch_since.is_some_and(|at| at.elapsed() >= self.config.flush_interval.duration());
            let full = self.batch.as_ref().is_some_and(|b| b.is_full());
            if (full || aged) && !self.hand_over(first, began_ns) {
                self.stalls += u64::from(full);
                return !more;
            }
            if !more {
                return true;
            }
        }
        false
    }

    /// Fills a batch; `true` when it is full and topics may have more.
    fn fill(&mut self, batch: &mut Batch) -> bool {
        for (i, source) in self.sources.iter_mut().enumerate() {
            loop {
                let room = batch.room(source.max_message).min(512);
                if room == 0 {
                    return true;
                }
                let (events, since_ns) = (source.events, source.since_ns);
                let taken = source.port.drain_raw(room, &mut |stamp, header, tail| {
                    // Said again for another recorder: this one was there.
                    if events && is_again(header) && stamp.t_ns >= since_ns {
                        return;
                    }
                    // `room` made sure that it fits.
                    let _ = batch.push(i as u16, stamp, header, tail);
                });
                if taken < room {
                    break;
                }
                if batch.is_full() {
                    return true;
                }
            }
        }
        false
    }

    /// Gives the batch to the writer when another buffer is free to go on with.
    fn hand_over(&mut self, first: usize, until_ns: u64) -> bool {
        let Some(mut next) = self.shared.pool.take() else { return false };
        let Some(mut batch) = self.batch.take() else { return false };
        batch.carry(first, until_ns, &mut next);
        self.batch_since = (!next.entries.is_empty()).then(Instant::now);
        self.batch = Some(next);
        self.send(batch)
    }

    fn send(&mut self, mut batch: Batch) -> bool {
        for (counters, source) in batch.counters.iter_mut().zip(&self.sources) {
            *counters = source.port.counters();
        }
        batch.utc_offset_ns = self.utc_offset_ns;
        // Never full: there are fewer batches than places.
        self.to_writer.try_send(ToWriter::Batch(batch)).is_ok()
    }

    fn ask_for_keyframes(&mut self) {
        if !self.shared.keyframe_wanted.load(Ordering::Relaxed) {
            return;
        }
        let now = clock::mono_ns();
        if now < self.asked_at_ns + KEYFRAME_PERIOD_NS {
            return;
        }
        self.asked_at_ns = now;
        for port in &mut self.keyframe_jobs {
            let job = Job { deadline_t_ns: now + KEYFRAME_PERIOD_NS, ..Job::default() };
            // A plc that is down makes a keyframe when it starts.
            if port.send_tail(job, br#"{"do":"keyframe"}"#).is_ok() {
                port.ring();
            }
        }
    }

    fn missed(&self, dropped: u64) -> u64 {
        let on_rail: u64 = self.sources.iter().map(|s| s.port.counters()).map(|c| c.lost + c.malformed).sum();
        on_rail + dropped
    }

    /// Notices of the other threads; once a second status, losses and the clock.
    fn tell(&mut self) {
        while let Ok(notice) = self.notices.try_recv() {
            let level = if notice.fault { Level::Fault } else { Level::Info };
            self.ctx.event(EventKind::RecorderFault, level, notice.message, notice.detail);
        }
        let now = Instant::now();
        let Some(elapsed) = self.last.as_ref().map(|(at, _)| now - *at) else {
            self.last = Some((now, Progress::default()));
            return;
        };
        if elapsed < STATUS_PERIOD {
            return;
        }
        let progress = self.shared.progress.lock().map(|p| p.clone()).unwrap_or_default();
        let was_paused = self.last.as_ref().is_some_and(|(_, p)| p.paused.is_some());
        if progress.paused.is_some() != was_paused {
            self.ctx.set_state(if was_paused { HealthState::Ready } else { HealthState::Degraded });
        }
        self.status(&progress, elapsed);
        self.tell_losses(progress.dropped);
        self.follow_clock();
        self.last = Some((now, progress));
    }

    fn status(&mut self, progress: &Progress, elapsed: Duration) {
        let before = self.last.as_ref().map(|(_, p)| p.clone()).unwrap_or_default();
        let seconds = elapsed.as_secs_f64();
        // A chunk can be smaller than its raw messages were: then the file shrinks for once.
        let grown = progress.bytes_total.saturating_sub(before.bytes_total) as f64;
        let losses = self
            .sources
            .iter()
            .map(|s| (s.name.as_str(), s.port.counters()))
            .filter(|(_, c)| c.lost + c.malformed > 0)
            .take(32)
            .collect();
        let status = Status {
            progress,
            messages_per_s: (progress.messages.saturating_sub(before.messages) as f64 / seconds).round()
                as u64,
            mb_per_h: (grown / seconds * 3600.0 / 1e5).round() / 10.0,
            missed: self.missed(progress.dropped),
            losses,
            buffers_free: self.shared.pool.free(),
            stalls: self.stalls,
        };
        self.ctx.status(&status);
    }

    fn tell_losses(&mut self, dropped: u64) {
        let missed = self.missed(dropped) - dropped;
        if self.stalls > self.stalls_told {
            let stalls = self.stalls - self.stalls_told;
            self.stalls_told = self.stalls;
            let message = format!(
                "the disk below {} is too slow: no buffer was free at {stalls} looks; messages wait on the rail \
                 and are lost when its queues are full",
                self.config.folder(&self.ctx.stack.dir).display()
            );
            self.ctx.event(EventKind::RecorderFault, Level::Warning, message, serde_json::Value::Null);
        }
        if missed > self.missed_told {
            let count = missed - self.missed_told;
            self.missed_told = missed;
            let topics: BTreeMap<_, _> = self
                .sources
                .iter()
                .map(|s| (s.name.clone(), s.port.counters()))
                .filter(|(_, c)| c.lost + c.malformed > 0)
                .collect();
            let names: Vec<_> = topics.keys().map(String::as_str).collect();
            let message = format!("{count} messages were not recorded, of {}", names.join(", "));
            let detail = serde_json::json!(topics);
            self.ctx.event(EventKind::RecorderFault, Level::Fault, message, detail);
        }
    }

    fn follow_clock(&mut self) {
        // Three readings: one that was interrupted between its clocks is no jump.
        let jumped = |offset: i64| offset.abs_diff(self.utc_offset_ns) > CLOCK_JUMP_NS;
        let readings = [clock::utc_offset_ns(), clock::utc_offset_ns(), clock::utc_offset_ns()];
        if readings.into_iter().all(jumped) {
            let by = readings[2].saturating_sub(self.utc_offset_ns);
            self.utc_offset_ns = readings[2];
            self.clock_event(&format!("jumped by {:.3} s", by as f64 / 1e9));
        }
    }

    fn clock_event(&mut self, reason: &str) {
        let detail = serde_json::json!({ "utc_offset_ns": self.utc_offset_ns, "reason": reason });
        let message = format!("UTC against CLOCK_MONOTONIC: {reason}");
        self.ctx.event(EventKind::ClockOffset, Level::Info, message, detail);
    }

    /// Takes what is still there and lets the writer finish.
    fn stop(mut self, finished: &Receiver<()>) -> Result<(), RunError> {
        self.ctx.set_state(HealthState::Stopping);
        // Nobody writes any more, but the disk may be behind: what still waits on the rail goes with it.
        let until = Instant::now() + DRAIN_LIMIT;
        while !self.look() && Instant::now() < until {
            std::thread::sleep(DRAIN_PERIOD);
        }
        if let Some(batch) = self.batch.take() {
            self.send(batch);
        }
        if self.to_writer.try_send(ToWriter::Stop).is_err() {
            return Err(RunError::WriterDied);
        }
        // The sender is dropped, never used: a disconnect is the answer.
        match finished.recv_timeout(FINISH_LIMIT) {
            Err(std::sync::mpsc::RecvTimeoutError::Timeout) => Err(RunError::NotFinished),
            _ => Ok(()),
        }
    }
}

/// The folder a running recorder writes to, for tools: files of this stack, oldest first.
pub fn files(config: &Config, stack: &ipc_types::Stack) -> Vec<disk::Found> {
    disk::recordings(&config.folder(&stack.dir), &stack.name)
}
