//! Runs a case of the log and compares by meaning:
//!
//! - An SDO answer must be there at once and equal the log's. Abort codes may be any that the tool's note of the step
//!   calls valid. The values of objects that no EDS default gives (counters) only have to be readable.
//! - Heartbeats, SYNCs, PDOs and EMCYs are waited for in virtual time, in any order between each other. An EMCY fits by
//!   its code. Those that the log's device sends of its own accord when SYNC is missing need not come.
//! - A PDO, SDO answer or boot-up that the log does not have is a failure.
//! - The log has no times. Frames of the tool come 1 ms apart, SYNCs 10 ms, heartbeats of other nodes 900 ms: shorter
//!   than the consumer time of 1 s, unless the log shows in between that the consumer missed one.

use crate::device::{Device, MS, Sent};
use crate::{eds, own};
use serde::Deserialize;

/// How long an answer of the device may be away.
const LIMIT_MS: u64 = 30_000;
const HEARTBEAT_MS: u64 = 900;

#[derive(Debug, Deserialize)]
pub struct Case {
    pub id: String,
    pub name: String,
    pub info: String,
    pub result: Option<String>,
    pub steps: Vec<Vec<String>>,
}

#[derive(Debug, Clone, PartialEq)]
pub enum Verdict {
    Passed,
    Failed(String),
    /// The device has nothing that the case could test.
    NotApplicable(&'static str),
}

#[derive(Debug, Clone)]
pub struct Outcome {
    pub id: String,
    pub name: String,
    pub info: String,
    /// What the tool said of the log's device.
    pub reference: String,
    pub verdict: Verdict,
    /// Run from steps of our own.
    pub own: bool,
}

impl Outcome {
    /// The log's device passed, ours does not.
    pub fn is_regression(&self) -> bool {
        self.reference == "Passed" && self.verdict != Verdict::Passed
    }
}

/// All cases, one after the other on one device, as the tool does.
pub fn run_all(cases: &[Case], text: &str) -> Vec<Outcome> {
    let mut device = Device::new(eds::builder(text).build(crate::device::NODE_ID).unwrap());
    cases
        .iter()
        .map(|case| {
            let reference = case.result.clone().unwrap_or_else(|| "-".into());
            let replayed = Run::new(&mut device).case(case);
            let own = own::find(&case.id).filter(|_| reference != "Passed");
            let verdict = match (own, replayed) {
                (_, Err(why)) => Verdict::Failed(why),
                (Some(own), Ok(())) => own.run(text),
                (None, Ok(())) => Verdict::Passed,
            };
            Outcome {
                id: case.id.clone(),
                name: case.name.clone(),
                info: case.info.trim_end_matches('.').to_string(),
                reference,
                verdict,
                own: own.is_some_and(own::Own::is_own),
            }
        })
        .collect()
}

struct Run<'a> {
    device: &'a mut Device,
    /// Abort codes that the tool's last note about them calls valid.
    valid: Vec<u32>,
    request: Vec<u8>,
    beat_ns: Option<u64>,
    /// Object of the running upload.
    object: u32,
    sync_ns: u64,
    /// A reset or stop was sent last: SYNCs of before may still arrive.
    in_flight: bool,
    /// Step that was sent before its turn.
    sent_early: Option<usize>,
    /// TPDOs 1 and 2 that the log has, where a case counts them.
    counted: [usize; 2],
}

fn bytes(hex: &str) -> Vec<u8> {
    (0..hex.len() / 2).map(|at| u8::from_str_radix(&hex[2 * at..2 * at + 2], 16).unwrap()).collect()
}

fn hex(data: &[u8]) -> String {
    data.iter().fold(String::new(), |text, byte| text + &format!("{byte:02X}"))
}

fn abort_code(data: &[u8]) -> Option<u32> {
    (data.len() == 8 && data[0] == 0x80).then(|| u32::from_le_bytes([data[4], data[5], data[6], data[7]]))
}

/// Codes in "Valid abort codes are 06010000h, 06010002h or 08000000h", "Allowing error codes 0x06010000, ...".
fn codes(note: &str) -> Option<Vec<u32>> {
    let list = ["Valid abort code", "Allowing error code"].iter().find_map(|words| note.split_once(words))?.1;
    let words = list.split(|c: char| !c.is_ascii_alphanumeric());
    let found = words
        .map(|word| word.trim_start_matches("0x").trim_end_matches('h'))
        .filter(|word| word.len() == 8)
        .filter_map(|word| u32::from_str_radix(word, 16).ok());
    Some(found.collect())
}

/// Values that are the device's state, not its configuration: power-on counter, what the application of the log's
/// device wrote and averaged, its error bits.
fn is_volatile(object: u32) -> bool {
    matches!(object >> 8, 0x1003 | 0x1018 | 0x2106 | 0x2110 | 0x2111 | 0x2112 | 0x2120)
}

impl<'a> Run<'a> {
    fn new(device: &'a mut Device) -> Self {
        Self {
            device,
            valid: Vec::new(),
            request: Vec::new(),
            beat_ns: None,
            object: 0,
            sync_ns: 0,
            in_flight: false,
            sent_early: None,
            counted: [0; 2],
        }
    }
    fn case(mut self, case: &Case) -> Result<(), String> {
        self.device.sent.clear();
        let expected = |id: &str| case.steps.iter().any(|step| step[0] == "Rx" && step[1] == id);
        for (at, step) in case.steps.iter().enumerate() {
            let result = match step[0].as_str() {
                "note" => {
                    self.note(&step[1]);
                    Ok(())
                }
                // The tool's own markers.
                _ if step[1] == "7FF" => Ok(()),
                "Tx" if self.sent_early == Some(at) => {
                    self.sent_early = None;
                    Ok(())
                }
                "Tx" => {
                    self.tx(u32::from_str_radix(&step[1], 16).unwrap(), &bytes(&step[2]));
                    Ok(())
                }
                _ => {
                    let id = u32::from_str_radix(&step[1], 16).unwrap();
                    self.beat_while_waiting(case, at, id, &bytes(&step[2]));
                    self.rx(case, id, &bytes(&step[2]))
                }
            };
            result.map_err(|why| format!("step {at}: {why}"))?;
        }
        // Nothing else comes.
        self.device.wait_ms(5);
        for (id, wanted) in [(0x184, self.counted[0]), (0x284, self.counted[1])] {
            let got = self.device.sent.iter().filter(|sent| sent.id == id).count();
            if wanted > 0 && wanted.abs_diff(got) > 1 {
                return Err(format!("{got} PDOs {id:03X}, expected {wanted}"));
            }
        }
        for sent in &self.device.sent {
            let extra = match sent.id {
                0x584 => true,
                0x704 => sent.data == [0] && !expected("704"),
                0x181..=0x57F => !expected(&format!("{:03X}", sent.id)),
                _ => false,
            };
            if extra {
                return Err(format!("unexpected frame {:03X} {}", sent.id, hex(&sent.data)));
            }
        }
        Ok(())
    }
    /// The log is about to wait for a frame. If a heartbeat of another node comes later in it, that node goes on with its
    /// period meanwhile.
    fn beat_while_waiting(&mut self, case: &Case, at: usize, id: u32, data: &[u8]) {
        if self.device.sent.iter().any(|sent| sent.id == id && sent.data == data) || self.sent_early.is_some()
        {
            return;
        }
        let Some(beat) = self.beat_ns else { return };
        let rest = || case.steps.iter().enumerate().skip(at);
        let other = |step: &Vec<String>| {
            step[0] == "Tx" && step[1].starts_with('7') && step[1] != "704" && step[1] != "7FF"
        };
        // Not behind a loss, and not behind other commands of the tool.
        let stop = |step: &Vec<String>| {
            (step[0] == "Tx" && !other(step)) || (step[1] == "084" && step[2].starts_with("3081"))
        };
        let next = rest().take_while(|(_, step)| !stop(step)).find(|(_, step)| other(step));
        if let Some((next, step)) = next {
            let due = beat + HEARTBEAT_MS * MS;
            while self.device.t_ns < due
                && !self.device.sent.iter().any(|sent| sent.id == id && sent.data == data)
            {
                self.device.wait_ms(1);
            }
            if self.device.t_ns >= due {
                self.tx(u32::from_str_radix(&step[1], 16).unwrap(), &bytes(&step[2]));
                self.sent_early = Some(next);
            }
        }
    }
    fn note(&mut self, note: &str) {
        if let Some(codes) = codes(note) {
            self.valid = codes;
        }
    }
    fn tx(&mut self, id: u32, data: &[u8]) {
        if matches!(id, 0x000 | 0x604) {
            // Another phase of the case.
            self.beat_ns = None;
        }
        self.in_flight = id == 0 && matches!(data[0], 0x02 | 0x81 | 0x82);
        match id {
            0x080 => {
                let next = self.sync_ns + 10 * MS;
                self.device.advance(next.max(self.device.t_ns + MS));
                self.sync_ns = self.device.t_ns;
            }
            0x701..=0x77F if id != 0x704 => {
                if let Some(beat) = self.beat_ns {
                    self.device.advance((beat + HEARTBEAT_MS * MS).max(self.device.t_ns));
                }
                self.beat_ns = Some(self.device.t_ns);
            }
            0x604 => {
                self.device.wait_ms(1);
                self.device.sent.retain(|sent| sent.id != 0x584);
                self.request = data.to_vec();
                if data[0] == 0x40 || data[0] & 0xE0 == 0xA0 {
                    self.object = u32::from(data[2]) << 16 | u32::from(data[1]) << 8 | u32::from(data[3]);
                }
            }
            _ => self.device.wait_ms(1),
        }
        self.device.send(id, data);
    }
    fn rx(&mut self, case: &Case, id: u32, data: &[u8]) -> Result<(), String> {
        match id {
            0x584 => self.sdo(case, data),
            0x080 if self.in_flight => Ok(()),
            // Transmission type 10: which SYNC is the first of ten is not said; the number of PDOs is.
            0x184 | 0x284 if case.id == "6.3" => {
                self.counted[usize::from(id == 0x284)] += 1;
                Ok(())
            }
            0x084 => self.emcy(data),
            // The log's device once sent an EMCY that nothing says anything about.
            0x081 => Ok(()),
            0x704 if data == [0] => {
                // Whatever was sent before the reset is of no interest.
                self.take(id, "boot-up", |sent| sent.data == [0]).map(|_| ())
            }
            _ => {
                let wanted = data.to_vec();
                self.take(id, &hex(data), move |sent| sent.data == wanted).map(|_| ())
            }
        }
    }
    fn take(&mut self, id: u32, what: &str, fits: impl Fn(&Sent) -> bool) -> Result<Sent, String> {
        let found = self.device.take(LIMIT_MS, |sent| sent.id == id && fits(sent));
        if let Some(found) = found {
            // Older frames of this id that did not fit are over.
            self.device.sent.retain(|sent| sent.id != id || sent.t_ns >= found.t_ns);
            return Ok(found);
        }
        let last = self.device.sent.iter().rev().find(|sent| sent.id == id);
        let got = last.map_or("nothing".to_string(), |sent| hex(&sent.data));
        Err(format!("expected {id:03X} {what}, got {got}"))
    }
    fn emcy(&mut self, data: &[u8]) -> Result<(), String> {
        let code = u16::from_le_bytes([data[0], data[1]]);
        // 8100h and its end, with the error bit 18h of the log's device: its own watch on SYNC.
        if data[3] == 0x18 {
            return Ok(());
        }
        let wanted = code.to_le_bytes();
        self.take(0x084, &format!("EMCY {code:04X}"), move |sent| sent.data[..2] == wanted)?;
        if code == 0x8130 {
            self.beat_ns = None;
        }
        Ok(())
    }
    fn sdo(&mut self, case: &Case, data: &[u8]) -> Result<(), String> {
        let got = self.device.take(0, |sent| sent.id == 0x584);
        let request = hex(&self.request);
        let got = got.ok_or_else(|| format!("no answer to {request}"))?.data;
        if got == data || self.same_meaning(case, &got, data) {
            return Ok(());
        }
        Err(format!("{request} was answered {}, expected {}", hex(&got), hex(data)))
    }
    fn same_meaning(&self, case: &Case, got: &[u8], wanted: &[u8]) -> bool {
        match (abort_code(got), abort_code(wanted)) {
            (Some(got), Some(_)) if self.valid.contains(&got) => true,
            (Some(got), Some(wanted)) if got == wanted => true,
            // Random values are written: they only have to be gone after the reset.
            _ if case.id == "9.1" => got[0] == 0x60 || abort_code(got).is_some(),
            // RTR is supported here: transmission type 253 is taken.
            (None, Some(0x0609_0030)) => {
                got[0] == 0x60 && self.request[3] == 2 && matches!(self.request[4], 252 | 253)
            }
            (None, None) => {
                let upload = got[0] & 0xE0 == wanted[0] & 0xE0;
                upload && is_volatile(self.object)
            }
            _ => false,
        }
    }
}
