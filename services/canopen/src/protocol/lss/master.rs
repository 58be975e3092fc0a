//! LSS master: one service at a time, with inhibit time between frames and a timeout for answers.

use ipc_types::payload::CanFrame;

use super::{LssAddress, LssState, command_u32, cs, frame, parse, u32_of};
use crate::protocol::cob_id::predefined;
use crate::protocol::error_control::MS;
use crate::protocol::io::Outbox;

/// Times of the master.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LssTimes {
    /// How long to wait for an answer. CiA 305 gives none; 100 ms is what masters in the field use.
    pub timeout_ms: u16,
    /// Least time between two frames of the master: slaves may be slow to take them.
    pub inhibit_ms: u16,
    /// Fastscan: after an answer, how long other slaves may answer too, before the next question.
    pub settle_ms: u16,
}

impl Default for LssTimes {
    fn default() -> Self {
        Self { timeout_ms: 100, inhibit_ms: 1, settle_ms: 5 }
    }
}

/// What to ask of an inquiry.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Inquiry {
    Vendor = cs::INQUIRE_VENDOR,
    Product = cs::INQUIRE_PRODUCT,
    Revision = cs::INQUIRE_REVISION,
    Serial = cs::INQUIRE_SERIAL,
    NodeId = cs::INQUIRE_NODE_ID,
}

/// Revision and serial as ranges.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LssRange {
    pub vendor: u32,
    pub product: u32,
    pub revision: (u32, u32),
    pub serial: (u32, u32),
}

/// What fastscan knows beforehand: a part that is given is taken as it is and only confirmed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FastscanHint {
    pub vendor: Option<u32>,
    pub product: Option<u32>,
    pub revision: Option<u32>,
    pub serial: Option<u32>,
}

/// A service.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LssRequest {
    /// All slaves; never answered.
    SwitchGlobal(LssState),
    /// The slave with this address enters configuration.
    SwitchSelective(LssAddress),
    /// Of the one slave in configuration. 1-127, or FFh.
    ConfigureNodeId(u8),
    /// Index in table 0.
    ConfigureBitTiming(u8),
    /// Never answered.
    ActivateBitTiming {
        delay_ms: u16,
    },
    Store,
    Inquire(Inquiry),
    /// Does any slave lie in this range?
    Identify(LssRange),
    /// Is there any slave without node-id?
    IdentifyNonConfigured,
    /// Finds one slave without node-id and leaves it in configuration.
    Fastscan(FastscanHint),
}

/// How a service ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LssResult {
    /// Done; answered where the service is answered.
    Done,
    /// The value asked for.
    Value(u32),
    /// Fastscan: this slave is in configuration now.
    Found(LssAddress),
    /// No answer in time: there is no such slave.
    Nobody,
    /// The slave refused: error code and specific error (CiA 305 V3.0, 6.4: 1 = out of range or not supported,
    /// FFh = the slave's own).
    Refused { code: u8, specific: u8 },
    /// Fastscan: slaves answered, but none to the whole address: frames were lost, or a slave is faulty. Try again.
    Lost,
}

/// The master is busy with another service.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the LSS master is busy with another service; wait for its result")]
pub struct Busy;

/// Frames that a service sends before it waits.
const SCRIPT: usize = 6;

#[derive(Debug, Clone, Copy)]
struct Scan {
    hint: [Option<u32>; 4],
    found: [u32; 4],
    sub: u8,
    /// Bit under test; 32: the first question, who is there.
    bit: u8,
    /// The whole part is being confirmed.
    confirm: bool,
}

#[derive(Debug, Clone, Copy)]
enum Wait {
    /// Frames of the script are still to go.
    Sending,
    /// Until the answer or the time.
    Answer,
    /// Fastscan: somebody answered, others may, until then at the latest.
    Settle { until_ns: u64 },
}

#[derive(Debug, Clone)]
struct Job {
    request: LssRequest,
    script: [CanFrame; SCRIPT],
    len: usize,
    at: usize,
    wait: Wait,
    due_ns: u64,
    scan: Option<Scan>,
}

/// One LSS master.
#[derive(Debug, Clone)]
pub struct LssMaster {
    times: LssTimes,
    job: Option<Job>,
    free_at_ns: u64,
}

impl LssMaster {
    pub fn new(times: LssTimes) -> Self {
        Self { times, job: None, free_at_ns: 0 }
    }
    /// Other times, from the next wait on.
    pub fn set_times(&mut self, times: LssTimes) {
        self.times = times;
    }
    pub fn is_busy(&self) -> bool {
        self.job.is_some()
    }
    /// Gives the present service up, without result.
    pub fn cancel(&mut self) {
        self.job = None;
    }
    /// Starts a service. Its result comes from [`Self::on_frame`] or [`Self::on_time`].
    pub fn start(&mut self, t_ns: u64, request: LssRequest) -> Result<(), Busy> {
        if self.job.is_some() {
            return Err(Busy);
        }
        let mut script = [CanFrame::default(); SCRIPT];
        let len = write_script(&request, &mut script);
        let scan = match request {
            LssRequest::Fastscan(hint) => Some(Scan {
                hint: [hint.vendor, hint.product, hint.revision, hint.serial],
                found: [0; 4],
                sub: 0,
                bit: 32,
                confirm: false,
            }),
            _ => None,
        };
        let due_ns = t_ns.max(self.free_at_ns);
        self.job = Some(Job { request, script, len, at: 0, wait: Wait::Sending, due_ns, scan });
        Ok(())
    }
    pub fn next_deadline(&self) -> Option<u64> {
        self.job.as_ref().map(|job| job.due_ns)
    }
    /// Sends what is due, or ends a wait.
    pub fn on_time(&mut self, t_ns: u64, out: &mut Outbox) -> Option<LssResult> {
        let times = self.times;
        let job = self.job.as_mut().filter(|job| t_ns >= job.due_ns)?;
        match job.wait {
            Wait::Sending => {
                out.push(job.script[job.at]);
                job.at += 1;
                self.free_at_ns = t_ns.saturating_add(u64::from(times.inhibit_ms) * MS);
                job.due_ns = self.free_at_ns;
                if job.at < job.len {
                    return None;
                }
                if !is_answered(&job.request) {
                    return self.finish(LssResult::Done);
                }
                job.wait = Wait::Answer;
                job.due_ns = t_ns.saturating_add(u64::from(times.timeout_ms.max(1)) * MS);
                None
            }
            Wait::Answer if job.scan.is_some() => self.scan_step(t_ns, false),
            Wait::Settle { .. } => self.scan_step(t_ns, true),
            Wait::Answer => self.finish(LssResult::Nobody),
        }
    }
    fn finish(&mut self, result: LssResult) -> Option<LssResult> {
        self.job = None;
        Some(result)
    }
    /// A frame of the bus.
    pub fn on_frame(&mut self, t_ns: u64, frame: &CanFrame) -> Option<LssResult> {
        let data = parse(frame, predefined::LSS_SLAVE)?;
        let times = self.times;
        let job = self.job.as_mut().filter(|job| !matches!(job.wait, Wait::Sending))?;
        let wanted = match job.request {
            LssRequest::SwitchSelective(_) => cs::SWITCH_SELECTIVE_ANSWER,
            LssRequest::ConfigureNodeId(_) => cs::CONFIGURE_NODE_ID,
            LssRequest::ConfigureBitTiming(_) => cs::CONFIGURE_BIT_TIMING,
            LssRequest::Store => cs::STORE,
            LssRequest::Inquire(inquiry) => inquiry as u8,
            LssRequest::IdentifyNonConfigured => cs::NON_CONFIGURED_ANSWER,
            LssRequest::Identify(_) | LssRequest::Fastscan(_) => cs::IDENTIFY_ANSWER,
            LssRequest::SwitchGlobal(_) | LssRequest::ActivateBitTiming { .. } => return None,
        };
        if data[0] != wanted {
            return None;
        }
        match job.request {
            LssRequest::Fastscan(_) => {
                // Answers of slower devices would be taken for those to the next question: the last one counts.
                let until_ns = match job.wait {
                    Wait::Settle { until_ns } => until_ns,
                    _ => t_ns.saturating_add(u64::from(times.timeout_ms.max(1)) * MS),
                };
                job.wait = Wait::Settle { until_ns };
                job.due_ns = t_ns.saturating_add(u64::from(times.settle_ms) * MS).min(until_ns);
                None
            }
            LssRequest::ConfigureNodeId(_) | LssRequest::ConfigureBitTiming(_) | LssRequest::Store => self
                .finish(match data[1] {
                    0 => LssResult::Done,
                    code => LssResult::Refused { code, specific: data[2] },
                }),
            LssRequest::Inquire(Inquiry::NodeId) => self.finish(LssResult::Value(u32::from(data[1]))),
            LssRequest::Inquire(_) => self.finish(LssResult::Value(u32_of(&data))),
            _ => self.finish(LssResult::Done),
        }
    }
    /// One step of fastscan (CiA 305 V3.0, 6.7, figure 46): `yes` if any slave answered the last question.
    fn scan_step(&mut self, t_ns: u64, yes: bool) -> Option<LssResult> {
        let job = self.job.as_mut()?;
        let scan = job.scan.as_mut()?;
        let part = usize::from(scan.sub) & 3;
        if scan.bit == 32 && !scan.confirm {
            if !yes {
                return self.finish(LssResult::Nobody);
            }
            scan.begin_part();
        } else if scan.confirm {
            if !yes {
                // With a part given beforehand: nobody has it. Otherwise the answers did not agree.
                let given = scan.hint[part].is_some();
                return self.finish(if given { LssResult::Nobody } else { LssResult::Lost });
            }
            if scan.sub == 3 {
                let address = LssAddress::from_parts(scan.found);
                return self.finish(LssResult::Found(address));
            }
            scan.sub += 1;
            scan.begin_part();
        } else {
            // The question was: is the bit 0? Silence says that it is 1 in all that are left.
            if !yes {
                scan.found[part] |= 1 << (scan.bit & 31);
            }
            match scan.bit.checked_sub(1) {
                Some(bit) => scan.bit = bit,
                None => scan.confirm = true,
            }
        }
        let question = scan.question();
        job.script[0] = question;
        (job.len, job.at, job.wait) = (1, 0, Wait::Sending);
        job.due_ns = t_ns.max(self.free_at_ns);
        None
    }
}

impl Scan {
    fn begin_part(&mut self) {
        let part = usize::from(self.sub) & 3;
        self.found[part] = self.hint[part].unwrap_or(0);
        self.confirm = self.hint[part].is_some();
        self.bit = 31;
    }
    fn question(&self) -> CanFrame {
        let part = usize::from(self.sub) & 3;
        let (bit, next) = if self.confirm { (0, (self.sub + 1) & 3) } else { (self.bit, self.sub) };
        fastscan_frame(self.found[part], bit, self.sub, next)
    }
}

fn fastscan_frame(id: u32, bit_check: u8, sub: u8, next: u8) -> CanFrame {
    let [a, b, c, d] = id.to_le_bytes();
    frame(predefined::LSS_MASTER, cs::FASTSCAN, [a, b, c, d, bit_check, sub, next])
}

fn is_answered(request: &LssRequest) -> bool {
    !matches!(request, LssRequest::SwitchGlobal(_) | LssRequest::ActivateBitTiming { .. })
}

fn write_script(request: &LssRequest, script: &mut [CanFrame; SCRIPT]) -> usize {
    let simple = |cs: u8, a: u8, b: u8| frame(predefined::LSS_MASTER, cs, [a, b, 0, 0, 0, 0, 0]);
    script[0] = match *request {
        LssRequest::SwitchGlobal(state) => simple(cs::SWITCH_GLOBAL, state as u8, 0),
        LssRequest::SwitchSelective(address) => {
            for (at, part) in address.parts().into_iter().enumerate() {
                script[at] = command_u32(cs::SWITCH_SELECTIVE_VENDOR + at as u8, part);
            }
            return 4;
        }
        LssRequest::ConfigureNodeId(node_id) => simple(cs::CONFIGURE_NODE_ID, node_id, 0),
        LssRequest::ConfigureBitTiming(index) => simple(cs::CONFIGURE_BIT_TIMING, 0, index),
        LssRequest::ActivateBitTiming { delay_ms } => {
            let [low, high] = delay_ms.to_le_bytes();
            simple(cs::ACTIVATE_BIT_TIMING, low, high)
        }
        LssRequest::Store => simple(cs::STORE, 0, 0),
        LssRequest::Inquire(inquiry) => simple(inquiry as u8, 0, 0),
        LssRequest::Identify(range) => {
            let values = [
                range.vendor,
                range.product,
                range.revision.0,
                range.revision.1,
                range.serial.0,
                range.serial.1,
            ];
            for (at, value) in values.into_iter().enumerate() {
                script[at] = command_u32(cs::IDENTIFY_VENDOR + at as u8, value);
            }
            return SCRIPT;
        }
        LssRequest::IdentifyNonConfigured => simple(cs::IDENTIFY_NON_CONFIGURED, 0, 0),
        // BitCheck 80h: who is there?
        LssRequest::Fastscan(_) => fastscan_frame(0, 0x80, 0, 0),
    };
    1
}
