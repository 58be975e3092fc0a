//! Replay with proof: a recording's scans are computed again and compared with what was recorded.
//!
//! Fed with the joined contents of `<plc>/scan` and `<plc>/keyframe` in about their order (keyframes and records
//! may be a few thousand contents apart). Nothing else is needed but the program, which a provider hands over by
//! its hash. What cannot be verified (records lost, before the first keyframe) is listed, never passed over.
//!
//! With [`Verifier::compare`] a second, changed program runs beside the recorded one on the same inputs.

mod account;
mod compare;
mod diff;
#[cfg(test)]
mod tests;

pub use diff::VarDiff;
pub(crate) use diff::{bytes_of, common};

use crate::engine::{Engine, EngineError, Program, Runtime, RuntimeError, ScanOutcome, Stamps, write_result};
use crate::setup::Setup;
use compare::compare_record;
use diff::differences;
use dinrail_iec::artifact::TrapId;
use ipc_types::scan_record::{Content, Head, Kind, Reason, Section, flag};
use serde::Serialize;
use std::collections::VecDeque;
use std::sync::Arc;
use xxhash_rust::xxh3::xxh3_64;

/// Records that wait for a keyframe that may still come.
const WAITING_RECORDS: usize = 4096;
/// Differing variables listed beside the first.
const OTHERS: usize = 8;
/// Spans listed; beyond that they are only counted.
const MAX_SPANS: usize = 1000;
/// Doubts listed.
const MAX_DOUBTS: usize = 100;

/// Hands over the program with this hash, compiled for this setup.
pub type Provider<'a> = Box<dyn FnMut(u64, &Setup) -> Option<Arc<Program>> + 'a>;

/// The first difference.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Difference {
    pub generation: u32,
    pub scan: u64,
    pub plc_time_ns: i64,
    pub utc_ns: i64,
    /// Path of the variable, `%QB3`, or what else differs.
    pub variable: String,
    /// As recorded; when a changed program is compared: by the recorded program.
    pub expected: String,
    pub got: String,
    /// More variables that differ in the same scan.
    pub others: Vec<VarDiff>,
}

/// Scans that could not be verified.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Unverifiable {
    pub generation: u32,
    pub from: u64,
    pub to: u64,
    pub reason: String,
}

/// What came out.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct Report {
    /// Scans in the recording, those that are missing in gaps included.
    pub scans: u64,
    pub scans_verified: u64,
    /// Nothing differed.
    pub exact: bool,
    /// Scans that differed before the next keyframe let verification start anew.
    pub scans_different: u64,
    pub first_difference: Option<Difference>,
    pub unverifiable: Vec<Unverifiable>,
    /// Why more scans may have been than could be looked at: the recording is cut off, damaged, or messages were lost. Each is
    /// a sentence.
    pub incomplete: Vec<String>,
    pub keyframes_checked: u64,
}

impl Report {
    /// 0 exact and complete, 1 different, 3 exact but with unverifiable spans, or incomplete.
    pub fn exit_code(&self) -> u8 {
        match (self.exact, self.unverifiable.is_empty() && self.incomplete.is_empty()) {
            (false, _) => 1,
            (true, true) => 0,
            (true, false) => 3,
        }
    }
}

/// Why nothing can be verified at all.
#[derive(Debug, thiserror::Error)]
pub enum VerifyError {
    #[error("{0}")]
    Runtime(#[from] RuntimeError),
    #[error("program {hash:016x}: {source}")]
    Engine { hash: u64, source: EngineError },
    #[error("the changed program: {0}")]
    Other(EngineError),
}

struct Position {
    engine: Engine,
    /// The changed program, in compare mode.
    other: Option<Engine>,
    generation: u32,
    /// Memory after the last scan.
    before: Vec<u8>,
}

struct Waiting {
    generation: u32,
    scan: u64,
    bytes: Vec<u8>,
}

/// Verifies one recording of one plc service.
pub struct Verifier<'a> {
    runtime: Runtime,
    provider: Provider<'a>,
    compare: Option<Arc<Program>>,
    position: Option<Position>,
    /// Why there is no position.
    reason: String,
    pending: Option<Waiting>,
    waiting: VecDeque<Waiting>,
    /// Newest scan that was verified, found different or listed: what is newer must still be accounted for.
    reached: Option<(u32, u64)>,
    /// First scan accounted for.
    begin: Option<(u32, u64)>,
    /// Messages that are missing by their numbers.
    gaps: u64,
    spans_left_out: u64,
    report: Report,
}

impl<'a> Verifier<'a> {
    /// A verifier of what the recorded programs did.
    pub fn new(provider: Provider<'a>) -> Result<Self, VerifyError> {
        Ok(Self {
            runtime: Runtime::new()?,
            provider,
            compare: None,
            position: None,
            reason: "no keyframe before it".to_owned(),
            pending: None,
            waiting: VecDeque::new(),
            reached: None,
            begin: None,
            gaps: 0,
            spans_left_out: 0,
            report: Report { exact: true, ..Report::default() },
        })
    }

    /// Runs this program beside the recorded one and compares the variables that both have.
    #[must_use]
    pub fn compare(mut self, other: Arc<Program>) -> Self {
        self.compare = Some(other);
        self
    }

    /// Messages of the scans are missing here. Numbers of scans tell as well, but for those at the end; it names the reason.
    pub fn gap(&mut self, messages: u64) {
        self.gaps = self.gaps.saturating_add(messages.max(1));
        if self.position.is_none() && self.waiting.is_empty() {
            self.reason = format!("{messages} messages of the recording are lost");
        }
    }

    /// The recording may lack more than its own numbers tell; the report says so.
    pub fn doubt(&mut self, why: String) {
        if self.report.incomplete.len() < MAX_DOUBTS {
            self.report.incomplete.push(why);
        }
    }

    /// Takes the next content.
    pub fn push(&mut self, generation: u32, bytes: &[u8]) -> Result<(), VerifyError> {
        let content = match Content::parse(bytes) {
            Ok(content) => content,
            Err(error) => {
                self.doubt(format!("a record is damaged: {error}"));
                self.lose(format!("damaged: {error}"));
                return Ok(());
            }
        };
        match content.head.kind {
            Kind::Keyframe => self.keyframe(generation, &content),
            Kind::Scan => self.record(generation, &content),
        }
    }

    /// No more contents follow.
    pub fn finish(mut self) -> Result<Report, VerifyError> {
        self.take_pending(None)?;
        self.list_waiting(None);
        if self.gaps > 0 && self.report.unverifiable.is_empty() {
            self.doubt(format!("{} messages of the scans are missing", self.gaps));
        }
        if self.report.scans == 0 {
            self.doubt("there is no scan in it".to_owned());
        }
        if self.spans_left_out > 0
            && let Some(last) = self.report.unverifiable.last_mut()
        {
            last.reason = format!("{}; {} more spans are not listed", last.reason, self.spans_left_out);
        }
        Ok(self.report)
    }

    // --- keyframes ------------------------------------------------------------------------------------

    fn keyframe(&mut self, generation: u32, content: &Content<'_>) -> Result<(), VerifyError> {
        self.take_pending(Some((generation, 0)))?;
        let ahead = self
            .position
            .as_ref()
            .is_some_and(|p| p.generation == generation && content.head.scan > p.engine.scan());
        if ahead {
            let (scan, bytes) = (content.head.scan, content.bytes().to_vec());
            self.pending = Some(Waiting { generation, scan, bytes });
            return Ok(());
        }
        self.keyframe_now(generation, content)
    }

    fn keyframe_now(&mut self, generation: u32, content: &Content<'_>) -> Result<(), VerifyError> {
        let head = content.head;
        let load = head.start == Reason::Load as u8;
        if let Some(position) = &mut self.position {
            let same = position.generation == generation;
            if generation < position.generation || (same && head.scan < position.engine.scan()) {
                return Ok(());
            }
            if same && head.scan == position.engine.scan() && !load {
                self.report.keyframes_checked += 1;
                let state_end = position.engine.state_end() as usize;
                let memory = &position.engine.memory()[..state_end];
                if xxh3_64(memory) == head.memory_hash {
                    return Ok(());
                }
                let expected = memory_of(content).unwrap_or(&[]);
                let rows = differences(&position.engine, expected, memory, 0, |_| true, OTHERS + 1);
                self.different(generation, &head, rows, "memory at the keyframe");
            }
        }
        self.restart(generation, content)
    }

    /// Verification starts, or starts anew, at a keyframe.
    fn restart(&mut self, generation: u32, content: &Content<'_>) -> Result<(), VerifyError> {
        self.position = None;
        let head = content.head;
        // Whatever becomes of the keyframe: what lies before it and was not verified never will be.
        self.list_up_to(generation, head.scan);
        if memory_of(content).is_none_or(|memory| xxh3_64(memory) != head.memory_hash) {
            self.doubt(format!(
                "the keyframe after scan {} of generation {generation} is damaged",
                head.scan
            ));
            self.lose("the keyframe is damaged".to_owned());
            return Ok(());
        }
        let setup = content.sections().find_map(|s| match s {
            Section::Setup(json) => serde_json::from_slice::<Setup>(json).ok(),
            _ => None,
        });
        let Some(setup) = setup else {
            self.lose("the keyframe's setup is not readable by this version".to_owned());
            return Ok(());
        };
        let program = if head.program_hash == 0 {
            None
        } else if let Some(program) = (self.provider)(head.program_hash, &setup) {
            Some(program)
        } else {
            self.lose(format!("program {:016x} is not in the recording", head.program_hash));
            return Ok(());
        };
        let setup = Arc::new(setup);
        let hash = head.program_hash;
        let mut engine = Engine::new(&self.runtime, program, setup.clone())
            .map_err(|source| VerifyError::Engine { hash, source })?;
        if let Err(error) = engine.restore_any(content) {
            self.lose(error.to_string());
            return Ok(());
        }
        let other = match &self.compare {
            None => None,
            Some(program) => {
                let mut other =
                    Engine::new(&self.runtime, Some(program.clone()), setup).map_err(VerifyError::Other)?;
                other.adopt(&engine);
                Some(other)
            }
        };
        let before = engine.memory().to_vec();
        self.position = Some(Position { engine, other, generation, before });
        self.pending = None;
        for record in std::mem::take(&mut self.waiting) {
            if let Ok(content) = Content::parse(&record.bytes) {
                self.record(record.generation, &content)?;
            }
        }
        Ok(())
    }

    /// A keyframe that waits for the records before it is taken when none of them can come any more: when a newer one
    /// does, or nothing.
    fn take_pending(&mut self, newer: Option<(u32, u64)>) -> Result<(), VerifyError> {
        if let Some(pending) = &self.pending
            && newer.is_none_or(|newer| (pending.generation, pending.scan) < newer)
            && let Some(pending) = self.pending.take()
            && let Ok(keyframe) = Content::parse(&pending.bytes)
        {
            let reached = self.position.as_ref().map_or(0, |p| p.engine.scan());
            if reached < pending.scan
                || self.position.as_ref().is_some_and(|p| p.generation != pending.generation)
            {
                self.position = None;
                self.reason = "lost".to_owned();
            }
            self.keyframe_now(pending.generation, &keyframe)?;
        }
        Ok(())
    }

    // --- records --------------------------------------------------------------------------------------

    fn record(&mut self, generation: u32, content: &Content<'_>) -> Result<(), VerifyError> {
        let scan = content.head.scan;
        self.take_pending(Some((generation, scan)))?;
        let next = match &self.position {
            Some(p) if p.generation == generation => p.engine.scan() + 1,
            // Of an engine that is gone: its record was overtaken by its successor's.
            Some(p) if generation < p.generation => {
                self.list_late(generation, scan);
                return Ok(());
            }
            Some(_) => {
                self.lose("the engine started anew and its keyframe is missing".to_owned());
                0
            }
            None => 0,
        };
        if next == 0 {
            self.wait(generation, content);
            return Ok(());
        }
        if scan < next {
            self.list_late(generation, scan);
            return Ok(());
        }
        if scan > next {
            self.lose("lost".to_owned());
            self.list(generation, next, scan - 1);
            self.lose("records before it are lost".to_owned());
            self.wait(generation, content);
            return Ok(());
        }
        if content.head.flags & flag::INCOMPLETE != 0 {
            self.lose("the record was longer than its limit".to_owned());
            self.list(generation, scan, scan);
            self.lose("after a record that was longer than its limit".to_owned());
            return Ok(());
        }
        self.begin.get_or_insert((generation, scan));
        self.reached = Some((generation, scan));
        self.report.scans += 1;
        self.verify(generation, content);
        Ok(())
    }

    fn verify(&mut self, generation: u32, content: &Content<'_>) {
        let Some(position) = &mut self.position else { return };
        replay(&mut position.engine, content);
        let found = compare_record(position, content);
        if let Some((what, rows)) = found {
            let head = content.head;
            self.different(generation, &head, rows, &what);
            self.report.scans_different += 1;
            self.lose("after a difference".to_owned());
            return;
        }
        self.report.scans_verified += 1;
        let Some(position) = &mut self.position else { return };
        let head = content.head;
        let rows = match &mut position.other {
            Some(other) => {
                replay(other, content);
                diff::between(&position.engine, other, OTHERS + 1)
            }
            None => Vec::new(),
        };
        let len = position.before.len();
        position.before.copy_from_slice(&position.engine.memory()[..len]);
        if !rows.is_empty() {
            self.report.scans_different += 1;
            self.different(generation, &head, rows, "memory");
        }
    }

    fn different(&mut self, generation: u32, head: &Head, mut rows: Vec<VarDiff>, what: &str) {
        self.report.exact = false;
        if self.report.first_difference.is_some() {
            return;
        }
        let first = if rows.is_empty() {
            VarDiff { variable: what.to_owned(), expected: "another".to_owned(), got: String::new() }
        } else {
            rows.remove(0)
        };
        self.report.first_difference = Some(Difference {
            generation,
            scan: head.scan,
            plc_time_ns: head.plc_time_ns,
            utc_ns: head.utc_ns,
            variable: first.variable,
            expected: first.expected,
            got: first.got,
            others: rows,
        });
    }
}

fn memory_of<'c>(keyframe: &Content<'c>) -> Option<&'c [u8]> {
    keyframe.sections().find_map(|s| match s {
        Section::Memory { offset: 0, bytes } => Some(bytes),
        _ => None,
    })
}

/// Runs the scan of a record.
pub fn replay(engine: &mut Engine, content: &Content<'_>) -> ScanOutcome {
    let head = content.head;
    engine.begin(Stamps { t_ns: head.t_ns, plc_time_ns: head.plc_time_ns, utc_ns: head.utc_ns });
    let mut killed = None;
    for section in content.sections() {
        match section {
            Section::Control { source, command } => engine.control(&source, &command),
            Section::Input { source, ranges } => {
                let at = engine.input_begin(&source);
                for (range, quality, start, bytes) in ranges {
                    engine.input_range(range, quality, start, bytes);
                }
                engine.input_end(at);
            }
            Section::Write { source, result, tail } => {
                // Age and generation were judged by clocks; form and place are judged again.
                let judged = match result {
                    write_result::TOO_OLD | write_result::OLD_GENERATION => result,
                    _ => write_result::APPLIED,
                };
                engine.write(&source, judged, tail);
            }
            Section::Trigger(trigger) => engine.trigger(&trigger),
            Section::Fault(fault) if fault.trap == TrapId::Watchdog as u32 => killed = Some(fault),
            _ => {}
        }
    }
    engine.finish_with(killed.as_ref())
}
