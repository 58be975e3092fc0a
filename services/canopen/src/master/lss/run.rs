//! One call, service by service, to its end.

use super::call::LssCall;
use crate::protocol::cob_id::predefined;
use crate::protocol::error_control::MS;
use crate::protocol::io::Outbox;
use crate::protocol::lss::master::{FastscanHint, Inquiry, LssMaster, LssRequest, LssResult, LssTimes};
use crate::protocol::lss::{LssAddress, LssState, UNCONFIGURED};
use ipc_types::payload::CanFrame;
use serde_json::{Value, json};
use std::collections::VecDeque;
use thiserror::Error;

/// Lost frames of a fastscan are made good by another one.
const SCAN_TRIES: u8 = 3;

/// Why a call failed.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum LssError {
    #[error("{0}")]
    Wrong(String),
    #[error(
        "no device has vendor {:#010X}, product {:#010X}, revision {:#010X}, serial {:#010X}: is it powered, and does it support LSS?",
        .0.vendor, .0.product, .0.revision, .0.serial
    )]
    NoDevice(LssAddress),
    #[error("{0}: the device did not answer")]
    Silent(&'static str),
    /// A single service.
    #[error("{0}: no device in the state configuration answered")]
    Nobody(&'static str),
    #[error("{what}: the device refused: {}", reason(.what, *.code, *.specific))]
    Refused { what: &'static str, code: u8, specific: u8 },
    #[error(
        "several devices answer, and nothing says which one is meant (--sole; a job without `address`): `dinrail canopen lss fastscan --from NODE` gives the devices without node-id one each; --vendor, --product, --revision and --serial (`address`) name one"
    )]
    Several,
    #[error("devices answer, but none to its whole identity: frames are lost, or one is faulty")]
    Lost,
    #[error("no node-id is left for the device with serial {:#010X}", .0.serial)]
    NoNodeId(LssAddress),
    #[error(
        "the device with serial {:#010X} was given node-id {node_id} and says that it has none: two devices with one identity, or a faulty one",
        .address.serial
    )]
    Again { address: LssAddress, node_id: u8 },
    #[error("the time of the job was over before the devices had answered")]
    Late,
    #[error("the bus is off")]
    BusOff,
}

const STORING: &str = "storing";

/// Error codes of CiA 305 V3.0, 6.4.
fn reason(what: &str, code: u8, specific: u8) -> String {
    match code {
        1 if what == STORING => "it cannot store".to_owned(),
        2 if what == STORING => "its memory failed".to_owned(),
        1 => "out of range, or not supported by it".to_owned(),
        0xFF => format!("its own error {specific}"),
        other => format!("error {other}"),
    }
}

/// A device that was found.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Found {
    address: LssAddress,
    node_id: Option<u8>,
}

impl Found {
    fn json(&self) -> Value {
        let mut value = json!(self.address);
        if let Some(node_id) = self.node_id {
            value["node_id"] = json!(node_id);
        }
        value
    }
}

/// How a call ended.
#[derive(Debug, Clone, PartialEq)]
pub struct LssOutcome {
    /// What the job's result says.
    pub result: Result<Value, LssError>,
    /// Devices that got their node-id before an `assign` failed.
    found: Vec<Found>,
}

impl LssOutcome {
    pub(super) fn late() -> Self {
        Self::failed(LssError::Late)
    }

    fn failed(error: LssError) -> Self {
        Self { result: Err(error), found: Vec::new() }
    }

    /// The body of an error: the sentence, and what was done before.
    pub fn error_body(&self, error: &LssError) -> Value {
        let mut body = json!({ "error": error.to_string() });
        if !self.found.is_empty() {
            body["found"] = self.found.iter().map(Found::json).collect();
        }
        body
    }
}

#[derive(Debug)]
struct Run {
    call: LssCall,
    request: LssRequest,
    steps: VecDeque<LssRequest>,
    deadline_ns: u64,
    identity: [u32; 5],
    found: Vec<Found>,
    /// The device that is being given a node-id.
    current: Option<Found>,
    lost: u8,
    answered: bool,
    /// A device answered; until then others may, and must not.
    listen_ns: Option<u64>,
    /// How it ended; the devices are being sent back to waiting.
    end: Option<LssOutcome>,
}

/// See the module.
#[derive(Debug)]
pub struct LssLine {
    master: LssMaster,
    run: Option<Run>,
}

impl Default for LssLine {
    fn default() -> Self {
        Self { master: LssMaster::new(LssTimes::default()), run: None }
    }
}

impl LssLine {
    pub fn is_busy(&self) -> bool {
        self.run.is_some()
    }

    /// Starts a call; one under way is given up. After `deadline_ns` it fails.
    pub fn start(&mut self, now_ns: u64, call: LssCall, deadline_ns: u64) -> Result<(), LssOutcome> {
        call.check().map_err(|text| LssOutcome::failed(LssError::Wrong(text)))?;
        self.master.cancel();
        self.master.set_times(call.times());
        let mut steps = call.steps();
        let Some(request) = steps.pop_front() else { return Ok(()) };
        self.run = Some(Run {
            call,
            request,
            steps,
            deadline_ns,
            identity: [0; 5],
            found: Vec::new(),
            current: None,
            lost: 0,
            answered: false,
            listen_ns: None,
            end: None,
        });
        self.begin(now_ns, request);
        Ok(())
    }

    fn begin(&mut self, now_ns: u64, request: LssRequest) {
        if let Some(run) = &mut self.run {
            run.request = request;
            // Nothing else runs: `cancel` or the end of the service before came first.
            let _ = self.master.start(now_ns, request);
        }
    }

    /// Ends the call at once, as when the bus is off: the devices stay as they are.
    pub fn abandon(&mut self, why: LssError) -> Option<LssOutcome> {
        self.master.cancel();
        let run = self.run.take()?;
        Some(run.end.unwrap_or(LssOutcome { result: Err(why), found: run.found }))
    }

    pub fn next_deadline(&self) -> Option<u64> {
        let run = self.run.as_ref()?;
        let late = run.end.is_none().then_some(run.deadline_ns);
        self.master.next_deadline().into_iter().chain(late).chain(run.listen_ns).min()
    }

    /// Sends what is due.
    pub fn on_time(&mut self, now_ns: u64, out: &mut Outbox) -> Option<LssOutcome> {
        if self.run.as_ref().is_some_and(|run| run.end.is_none() && now_ns >= run.deadline_ns) {
            self.master.cancel();
            if let Some(end) = self.fail(now_ns, LssError::Late) {
                return Some(end);
            }
        }
        if self.run.as_mut().and_then(|run| run.listen_ns.take_if(|until| now_ns >= *until)).is_some()
            && let Some(end) = self.go_on(now_ns)
        {
            return Some(end);
        }
        while let Some(result) = self.master.on_time(now_ns, out) {
            if let Some(end) = self.ended(now_ns, result) {
                return Some(end);
            }
        }
        None
    }

    /// A frame of the bus.
    pub fn on_frame(&mut self, t_ns: u64, frame: &CanFrame) -> Option<LssOutcome> {
        if self.run.as_ref().is_some_and(|run| run.listen_ns.is_some()) && is_serial(frame) {
            return self.fail(t_ns, LssError::Several);
        }
        let result = self.master.on_frame(t_ns, frame)?;
        self.ended(t_ns, result)
    }

    /// One service ended.
    fn ended(&mut self, now_ns: u64, result: LssResult) -> Option<LssOutcome> {
        let run = self.run.as_mut()?;
        if let Some(end) = run.end.take() {
            self.run = None;
            return Some(end);
        }
        match run.take(result) {
            Ok(()) => {}
            Err(error) => return self.fail(now_ns, error),
        }
        if run.call.is_sole() && run.request == LssRequest::Inquire(Inquiry::Serial) {
            let wait_ns = u64::from(run.call.times().timeout_ms) * MS;
            run.listen_ns = Some(now_ns.saturating_add(wait_ns));
            return None;
        }
        self.go_on(now_ns)
    }

    fn go_on(&mut self, now_ns: u64) -> Option<LssOutcome> {
        let run = self.run.as_mut()?;
        match run.steps.pop_front() {
            Some(request) => {
                self.begin(now_ns, request);
                None
            }
            None => {
                let value = run.value();
                self.finish(now_ns, Ok(value))
            }
        }
    }

    fn fail(&mut self, now_ns: u64, error: LssError) -> Option<LssOutcome> {
        self.finish(now_ns, Err(error))
    }

    fn finish(&mut self, now_ns: u64, result: Result<Value, LssError>) -> Option<LssOutcome> {
        let run = self.run.as_mut()?;
        run.listen_ns = None;
        let found = if result.is_err() { std::mem::take(&mut run.found) } else { Vec::new() };
        let end = LssOutcome { result, found };
        if !run.call.tidies_up() {
            self.run = None;
            return Some(end);
        }
        run.end = Some(end);
        self.begin(now_ns, LssRequest::SwitchGlobal(LssState::Waiting));
        None
    }
}

impl Run {
    /// Takes the result of the present service.
    fn take(&mut self, result: LssResult) -> Result<(), LssError> {
        let what = match self.request {
            LssRequest::SwitchSelective(address) if result == LssResult::Nobody => {
                return Err(LssError::NoDevice(address));
            }
            LssRequest::Identify(_) | LssRequest::IdentifyNonConfigured => {
                self.answered = result == LssResult::Done;
                return Ok(());
            }
            LssRequest::Fastscan(hint) => return self.scanned(hint, result),
            LssRequest::Inquire(Inquiry::Serial) if self.call.is_sole() && self.call.tidies_up() => {
                "asking for the serial number, to be sure that it is the only device"
            }
            LssRequest::Inquire(_) => "asking for identity and node-id",
            LssRequest::ConfigureNodeId(_) => "setting the node-id",
            LssRequest::ConfigureBitTiming(_) => "setting the bit rate",
            LssRequest::Store => STORING,
            _ => "switching",
        };
        match result {
            LssResult::Nobody if self.call.tidies_up() => return Err(LssError::Silent(what)),
            LssResult::Nobody => return Err(LssError::Nobody(what)),
            LssResult::Lost => return Err(LssError::Lost),
            LssResult::Refused { code, specific } => return Err(LssError::Refused { what, code, specific }),
            LssResult::Value(value) => {
                if let LssRequest::Inquire(inquiry) = self.request {
                    self.identity[slot(inquiry)] = value;
                }
            }
            LssResult::Done | LssResult::Found(_) => {}
        }
        if self.steps.is_empty() {
            self.assigned();
        }
        Ok(())
    }

    /// A device of an `assign` has its node-id: on to the next.
    fn assigned(&mut self) {
        let LssCall::Assign { max, .. } = self.call else { return };
        self.found.extend(self.current.take());
        if self.found.len() < usize::from(max) {
            self.steps.push_back(LssRequest::Fastscan(FastscanHint::default()));
        }
    }

    fn scanned(&mut self, hint: FastscanHint, result: LssResult) -> Result<(), LssError> {
        let address = match result {
            LssResult::Found(address) => address,
            LssResult::Lost if self.lost < SCAN_TRIES => {
                self.lost += 1;
                // The answers did not agree: from the beginning.
                self.steps.push_front(LssRequest::Fastscan(hint));
                self.steps.push_front(LssRequest::SwitchGlobal(LssState::Waiting));
                return Ok(());
            }
            LssResult::Lost => return Err(LssError::Lost),
            _ => return Ok(()),
        };
        self.lost = 0;
        let LssCall::Assign { from, store, .. } = self.call else {
            self.found.push(Found { address, node_id: None });
            return Ok(());
        };
        if let Some(Found { node_id: Some(node_id), .. }) = self.found.iter().find(|f| f.address == address) {
            return Err(LssError::Again { address, node_id: *node_id });
        }
        let node_id = usize::from(from) + self.found.len();
        let Some(node_id) = u8::try_from(node_id).ok().filter(|id| *id <= 127) else {
            return Err(LssError::NoNodeId(address));
        };
        self.current = Some(Found { address, node_id: Some(node_id) });
        self.steps.push_back(LssRequest::ConfigureNodeId(node_id));
        self.steps.extend(store.then_some(LssRequest::Store));
        self.steps.push_back(LssRequest::SwitchGlobal(LssState::Waiting));
        Ok(())
    }

    /// The result of the job.
    fn value(&mut self) -> Value {
        match self.call {
            LssCall::SetNodeId { node_id, .. } => json!({ "node_id": node_id }),
            LssCall::SetBitrate { kbit, .. } => json!({ "kbit": kbit }),
            LssCall::Identify { .. } | LssCall::IdentifyNonConfigured {} => {
                json!({ "answered": self.answered })
            }
            LssCall::Inquire {} | LssCall::InquireDevice { .. } => {
                let [vendor, product, revision, serial, node_id] = self.identity;
                let node_id = Some(node_id).filter(|&id| id != u32::from(UNCONFIGURED));
                json!({ "vendor": vendor, "product": product, "revision": revision, "serial": serial, "node_id": node_id })
            }
            LssCall::Fastscan { .. } => json!({ "found": self.found_json() }),
            LssCall::Assign { max, .. } => {
                json!({ "found": self.found_json(), "more": self.found.len() >= usize::from(max) })
            }
            _ => json!(true),
        }
    }

    fn found_json(&self) -> Value {
        self.found.iter().map(Found::json).collect()
    }
}

fn is_serial(frame: &CanFrame) -> bool {
    frame.can_id == predefined::LSS_SLAVE && frame.payload().first() == Some(&(Inquiry::Serial as u8))
}

fn slot(inquiry: Inquiry) -> usize {
    match inquiry {
        Inquiry::Vendor => 0,
        Inquiry::Product => 1,
        Inquiry::Revision => 2,
        Inquiry::Serial => 3,
        Inquiry::NodeId => 4,
    }
}
