//! Replay with proof: a recording's scans are computed again and compared with what was recorded.
//!
//! Fed with the joined contents of `<plc>/scan` and `<plc>/keyframe` in about their order (keyframes and records
//! may be a few thousand contents apart). Nothing else is needed but the program, which a provider hands over by
//! its hash. What cannot be verified (records lost, before the first keyframe) is listed, never passed over.
//!
//! With [`Verifier::compare`] a second, changed program runs beside the recorded one on the same inputs.

mod diff;
#[cfg(test)]
mod tests;

pub use diff::VarDiff;
pub(crate) use diff::{bytes_of, common};

use crate::engine::{Engine, EngineError, Program, Runtime, RuntimeError, ScanOutcome, Stamps, write_result};
use crate::setup::Setup;
use diff::differences;
use dinrail_iec::artifact::TrapId;
use ipc_types::scan_record::{Content, Fault, Head, Kind, Outcome, Patch, Reason, Section, flag};
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
    pub keyframes_checked: u64,
}

impl Report {
    /// 0 exact, 1 different, 3 exact but with unverifiable spans.
    pub fn exit_code(&self) -> u8 {
        match (self.exact, self.unverifiable.is_empty()) {
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
    last: (u32, u64),
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
            last: (0, 0),
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

    /// Messages are missing here. Not necessary for correctness: numbers tell as well; it names the reason.
    pub fn gap(&mut self, messages: u64) {
        if self.position.is_none() && self.waiting.is_empty() {
            self.reason = format!("{messages} messages of the recording are lost");
        }
    }

    /// Takes the next content.
    pub fn push(&mut self, generation: u32, bytes: &[u8]) -> Result<(), VerifyError> {
        let content = match Content::parse(bytes) {
            Ok(content) => content,
            Err(error) => {
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
        if let Some(pending) = self.pending.take()
            && let Ok(content) = Content::parse(&pending.bytes)
        {
            self.keyframe_now(pending.generation, &content)?;
        }
        while let Some(record) = self.waiting.pop_front() {
            self.unverifiable(record.generation, record.scan, record.scan);
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
            if same && head.scan < position.engine.scan() {
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
        let waiting = std::mem::take(&mut self.waiting);
        for record in waiting {
            if (record.generation, record.scan) <= (generation, head.scan) {
                self.unverifiable(record.generation, record.scan, record.scan);
            } else if let Ok(content) = Content::parse(&record.bytes) {
                self.record(record.generation, &content)?;
            }
        }
        Ok(())
    }

    // --- records --------------------------------------------------------------------------------------

    fn record(&mut self, generation: u32, content: &Content<'_>) -> Result<(), VerifyError> {
        let scan = content.head.scan;
        if let Some(pending) = &self.pending
            && (pending.generation, pending.scan) < (generation, scan)
            && let Some(pending) = self.pending.take()
            && let Ok(keyframe) = Content::parse(&pending.bytes)
        {
            let reached = self.position.as_ref().map_or(0, |p| p.engine.scan());
            if reached < pending.scan {
                self.missing(pending.generation, reached + 1, pending.scan);
                self.position = None;
            }
            self.keyframe_now(pending.generation, &keyframe)?;
        }
        let next = match &self.position {
            Some(p) if p.generation == generation => p.engine.scan() + 1,
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
            return Ok(());
        }
        if scan > next {
            self.missing(generation, next, scan - 1);
            self.lose("records before it are lost".to_owned());
            self.wait(generation, content);
            return Ok(());
        }
        self.note(generation, scan);
        if content.head.flags & flag::INCOMPLETE != 0 {
            self.reason = "the record was longer than its limit".to_owned();
            self.unverifiable_now(generation, scan, scan);
            self.lose("after a record that was longer than its limit".to_owned());
            return Ok(());
        }
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

    // --- what cannot be verified ----------------------------------------------------------------------

    fn lose(&mut self, reason: String) {
        self.position = None;
        self.reason = reason;
    }

    /// Holds a record back until a keyframe comes, for a while.
    fn wait(&mut self, generation: u32, content: &Content<'_>) {
        if self.waiting.len() == WAITING_RECORDS
            && let Some(oldest) = self.waiting.pop_front()
        {
            self.unverifiable(oldest.generation, oldest.scan, oldest.scan);
        }
        self.waiting.push_back(Waiting {
            generation,
            scan: content.head.scan,
            bytes: content.bytes().to_vec(),
        });
    }

    fn missing(&mut self, generation: u32, from: u64, to: u64) {
        self.report.scans += to + 1 - from;
        let reason = std::mem::replace(&mut self.reason, "lost".to_owned());
        self.unverifiable_now(generation, from, to);
        self.reason = reason;
    }

    fn unverifiable(&mut self, generation: u32, from: u64, to: u64) {
        self.note(generation, from);
        // After a difference everything up to the next keyframe differs: that is no gap.
        if self.reason == "after a difference" {
            self.report.scans_different += 1;
            return;
        }
        self.unverifiable_now(generation, from, to);
    }

    fn unverifiable_now(&mut self, generation: u32, from: u64, to: u64) {
        if let Some(last) = self.report.unverifiable.last_mut()
            && last.generation == generation
            && last.to + 1 >= from
        {
            last.to = last.to.max(to);
            return;
        }
        if self.report.unverifiable.len() == MAX_SPANS {
            self.spans_left_out += 1;
            return;
        }
        let reason = self.reason.clone();
        self.report.unverifiable.push(Unverifiable { generation, from, to, reason });
    }

    fn note(&mut self, generation: u32, scan: u64) {
        if (generation, scan) > self.last {
            self.last = (generation, scan);
            self.report.scans += 1;
        }
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

type Found = (String, Vec<VarDiff>);

/// What of the record the engine's own record contradicts.
fn compare_record(position: &Position, recorded: &Content<'_>) -> Option<Found> {
    let engine = &position.engine;
    let Ok(own) = Content::parse(engine.record()) else {
        return Some(("the verifier's own record".to_owned(), Vec::new()));
    };
    if own.head == recorded.head && forces(&own) == forces(recorded) && changes_equal(&own, recorded) {
        return None;
    }
    let row = |variable: &str, expected: String, got: String| {
        Some((variable.to_owned(), vec![VarDiff { variable: variable.to_owned(), expected, got }]))
    };
    let (a, b) = (&recorded.head, &own.head);
    let rows = memory_rows(position, recorded);
    if !rows.is_empty() {
        return Some(("memory".to_owned(), rows));
    }
    if let (Some(expected), Some(got)) = (forces(recorded), forces(&own))
        && let Some((e, g)) = first_unequal(&expected, &got)
    {
        let at = e.or(g).map_or(0, |p| p.offset);
        let (name, _) = crate::engine::value::name_of(engine.map(), engine.image(), at);
        let text = |p: Option<Patch>| {
            p.map_or("not forced".to_owned(), |p| format!("forced to {:?}", &p.value[..usize::from(p.len)]))
        };
        return row(&name, text(e), text(g));
    }
    if a.outcome != b.outcome {
        let text = |o: u8, c: &Content<'_>| match (o, fault_of(c)) {
            (o, Some(fault)) if o == Outcome::Trap as u8 => format!("fault: {}", fault.text),
            (o, _) if o == Outcome::Ok as u8 => "no fault".to_owned(),
            _ => "no task ran".to_owned(),
        };
        return row("outcome of the scan", text(a.outcome, recorded), text(b.outcome, &own));
    }
    if a.tasks_ran != b.tasks_ran {
        return row("tasks that ran", format!("{:#b}", a.tasks_ran), format!("{:#b}", b.tasks_ran));
    }
    if (a.state_before, a.state_after) != (b.state_before, b.state_after) {
        let text = |h: &Head| format!("{} then {}", h.state_before, h.state_after);
        return row("state of the PLC", text(a), text(b));
    }
    if a.warnings != b.warnings {
        return row("warnings of the program", a.warnings.to_string(), b.warnings.to_string());
    }
    if a.program_hash != b.program_hash {
        return row("program", format!("{:016x}", a.program_hash), format!("{:016x}", b.program_hash));
    }
    if a.memory_hash != b.memory_hash && a.flags & flag::DATA_CUT == 0 {
        // Every recorded byte agrees: what is left is the stamp in front of the image.
        let got = format!("PLC time {} ns, UTC {} ns", b.plc_time_ns, b.utc_ns);
        return row("the scan's stamp", "another".to_owned(), got);
    }
    row(
        "a variable beyond the recorded changes",
        format!("{:016x}", a.memory_hash),
        format!("{:016x}", b.memory_hash),
    )
}

fn fault_of<'c>(content: &Content<'c>) -> Option<Fault<'c>> {
    content.sections().find_map(|s| match s {
        Section::Fault(fault) => Some(fault),
        _ => None,
    })
}

fn forces(content: &Content<'_>) -> Option<Vec<Patch>> {
    content.sections().find_map(|s| match s {
        Section::Forces(table) => Some(table),
        _ => None,
    })
}

fn first_unequal(a: &[Patch], b: &[Patch]) -> Option<(Option<Patch>, Option<Patch>)> {
    (0..a.len().max(b.len())).map(|i| (a.get(i).copied(), b.get(i).copied())).find(|(a, b)| a != b)
}

fn changes_equal(a: &Content<'_>, b: &Content<'_>) -> bool {
    let list = |c: &Content<'_>| -> Option<Vec<(u32, Vec<u8>)>> {
        c.sections().find_map(|s| match s {
            Section::Changes(changes) => Some(changes.map(|(at, bytes)| (at, bytes.to_vec())).collect()),
            _ => None,
        })
    };
    list(a) == list(b)
}

/// Variables that differ between memory as recorded (before + changes) and as computed.
fn memory_rows(position: &Position, recorded: &Content<'_>) -> Vec<VarDiff> {
    let engine = &position.engine;
    let mut expected = position.before.clone();
    let mut known_to = 0u32;
    for section in recorded.sections() {
        let Section::Changes(changes) = section else { continue };
        for (at, bytes) in changes {
            if let Some(target) = expected.get_mut(at as usize..at as usize + bytes.len()) {
                target.copy_from_slice(bytes);
            }
            known_to = at + bytes.len() as u32;
        }
    }
    let cut = recorded.head.flags & flag::DATA_CUT != 0;
    let (from, to) = engine.searched();
    let data = engine.data_offset();
    let known = |at: u32| at < to && (!cut || at < data.max(known_to));
    let end = engine.state_end() as usize;
    differences(engine, &expected[..end], &engine.memory()[..end], from, known, OTHERS + 1)
}
