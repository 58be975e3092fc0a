//! Jobs of a device: the errors of its application, as a PLC reports them.

use super::Service;
use crate::protocol::emcy::register;
use crate::protocol::io::Outbox;
use crate::protocol::node::Node;
use crate::service::job_port::{Answer, taken};
use crate::service::jobs::{FAILED, LATE, NOT_SUPPORTED, from_hex};
use ipc_types::clock;
use serde::Deserialize;
use serde_json::{Value, json};

/// Keeps errors of jobs apart from those of the device itself, which may have the same code.
const SOURCE: u16 = 0xFFFF;
/// Errors of jobs that can be there at once; more are refused.
pub(super) const MAX_ERRORS: usize = 32;

/// What a job asks for.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(tag = "do", rename_all = "snake_case", deny_unknown_fields)]
enum Request {
    /// An error has come.
    Emcy {
        /// Emergency error code, 0100h or more.
        code: u16,
        /// Bits of the error register; bit 0 is always set.
        #[serde(default)]
        register: u8,
        /// Up to 5 manufacturer-specific bytes, in hex.
        #[serde(default)]
        data: String,
    },
    /// The error of this code is gone; without code: all that jobs reported.
    EmcyReset {
        #[serde(default)]
        code: Option<u16>,
    },
}

/// Errors that jobs reported and that are not gone.
#[derive(Debug, Default)]
pub(super) struct Errors {
    codes: Vec<u16>,
}

impl Errors {
    /// Carries out a job.
    pub fn job(
        &mut self,
        t_ns: u64,
        text: &[u8],
        node: &mut Node,
        out: &mut Outbox,
    ) -> Result<Value, (u32, String)> {
        match parse(text)? {
            Request::Emcy { code, register, data } => {
                let info = info_of(&data).map_err(|text| (FAILED, text))?;
                self.raise(code).map_err(|text| (FAILED, text))?;
                node.raise(t_ns, code, SOURCE, register | register::GENERIC, info, out);
                Ok(json!({ "error_register": node.error_register() }))
            }
            Request::EmcyReset { code } => {
                let gone: Vec<u16> = match code {
                    Some(code) => self.codes.iter().copied().filter(|&c| c == code).collect(),
                    None => self.codes.clone(),
                };
                if let (Some(code), []) = (code, &gone[..]) {
                    return Err((
                        FAILED,
                        format!("no job reported emergency {code:04X}h, or it is gone already"),
                    ));
                }
                for &code in &gone {
                    node.clear(t_ns, code, SOURCE, out);
                }
                self.codes.retain(|code| !gone.contains(code));
                Ok(json!({ "reset": gone.len(), "error_register": node.error_register() }))
            }
        }
    }

    fn raise(&mut self, code: u16) -> Result<(), String> {
        match code {
            0x0000..=0x00FF => {
                return Err(format!("emergency {code:04X}h is an error reset; take the job emcy_reset"));
            }
            _ if self.codes.contains(&code) => {
                return Err(format!("emergency {code:04X}h is there already: an error is sent once"));
            }
            _ if self.codes.len() >= MAX_ERRORS => {
                return Err(format!("{MAX_ERRORS} errors are there already; reset one"));
            }
            _ => {}
        }
        self.codes.push(code);
        Ok(())
    }

    /// The device was reset: it has no errors.
    pub fn forget(&mut self) {
        self.codes.clear();
    }
}

fn parse(text: &[u8]) -> Result<Request, (u32, String)> {
    let job: Value =
        serde_json::from_slice(text).map_err(|e| (FAILED, format!("the job is no JSON: {e}")))?;
    let what = job.get("do").and_then(Value::as_str).unwrap_or_default().to_owned();
    if !["emcy", "emcy_reset"].contains(&what.as_str()) {
        let text = format!("a canopen-slave does not know the job '{what}'; it knows emcy, emcy_reset");
        return Err((NOT_SUPPORTED, text));
    }
    serde_json::from_value(job).map_err(|e| (FAILED, format!("the job '{what}': {e}")))
}

fn info_of(hex: &str) -> Result<[u8; 5], String> {
    let bytes = from_hex(hex).ok_or_else(|| format!("'{hex}' is no even number of hex digits"))?;
    let mut info = [0; 5];
    if bytes.len() > info.len() {
        return Err(format!("{} bytes of data: an emergency has 5", bytes.len()));
    }
    info[..bytes.len()].copy_from_slice(&bytes);
    Ok(info)
}

impl Service {
    pub(super) fn take_jobs(&mut self) {
        for (job, text) in self.jobs.take() {
            let now_ns = clock::mono_ns();
            let job = taken(&job, &text);
            let result = if job.deadline_ns < now_ns {
                Err((LATE, "the job is older than its deadline".to_owned()))
            } else {
                self.errors.job(now_ns, job.text, &mut self.node, &mut self.out)
            };
            self.jobs.send(&Answer::new(job.by, result));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::Device;
    use crate::protocol::eds::{BuildOptions, Eds};
    use crate::protocol::emcy::Emcy;
    use crate::protocol::node::NodeParams;
    use crate::slave::simulation::CIA_401_EDS;

    struct Bench {
        node: Node,
        out: Outbox,
        errors: Errors,
    }

    impl Bench {
        fn new() -> Self {
            let eds = Eds::parse(CIA_401_EDS.as_bytes()).unwrap();
            let device = Device::from_eds(&eds, 5, &BuildOptions::default()).unwrap();
            let mut bench = Self {
                node: Node::new(device.od, NodeParams::new(5), &[]).unwrap(),
                out: Outbox::default(),
                errors: Errors::default(),
            };
            bench.node.start(0, &mut bench.out);
            bench.out.drain().for_each(drop);
            bench
        }

        /// The answer and the emergencies that went out.
        fn job(&mut self, job: &Value) -> (Result<Value, (u32, String)>, Vec<Emcy>) {
            let answer = self.errors.job(1, job.to_string().as_bytes(), &mut self.node, &mut self.out);
            let sent = self.out.drain().filter(|f| f.can_id == 0x85);
            (answer, sent.filter_map(|f| Emcy::decode(f.payload())).collect())
        }
    }

    #[test]
    fn an_error_is_sent_once_and_reset_once() {
        let mut bench = Bench::new();
        let come = json!({ "do": "emcy", "code": 0x4210, "register": 8, "data": "0102" });
        let (answer, sent) = bench.job(&come);
        assert_eq!(answer, Ok(json!({ "error_register": 9 })));
        assert_eq!(sent, [Emcy { code: 0x4210, register: 9, info: [1, 2, 0, 0, 0] }]);
        assert!(bench.job(&come).0.unwrap_err().1.contains("there already"));
        bench.job(&json!({ "do": "emcy", "code": 0xFF01 })).0.unwrap();
        let (answer, sent) = bench.job(&json!({ "do": "emcy_reset", "code": 0x4210 }));
        assert_eq!(answer, Ok(json!({ "reset": 1, "error_register": 1 })));
        assert_eq!(sent, [Emcy { code: 0, register: 1, info: [0x10, 0x42, 0, 0, 0] }]);
        let (answer, sent) = bench.job(&json!({ "do": "emcy_reset" }));
        assert_eq!(answer, Ok(json!({ "reset": 1, "error_register": 0 })));
        assert_eq!(sent.len(), 1);
        assert_eq!(
            bench.job(&json!({ "do": "emcy_reset" })).0,
            Ok(json!({ "reset": 0, "error_register": 0 }))
        );
    }

    #[test]
    fn what_cannot_be_is_refused_and_the_limit_holds() {
        let mut bench = Bench::new();
        let said: Vec<String> = [
            json!({ "do": "dance" }),
            json!({ "do": "emcy" }),
            json!({ "do": "emcy", "code": 0 }),
            json!({ "do": "emcy", "code": 0x1000, "data": "010203040506" }),
            json!({ "do": "emcy", "code": 0x1000, "data": "x" }),
            json!({ "do": "emcy_reset", "code": 0x1000 }),
        ]
        .iter()
        .map(|job| {
            let (answer, sent) = bench.job(job);
            assert!(sent.is_empty());
            let (code, text) = answer.unwrap_err();
            format!("{code}: {text}")
        })
        .collect();
        insta::assert_snapshot!(said.join("\n"));
        for n in 0..MAX_ERRORS as u16 {
            bench.job(&json!({ "do": "emcy", "code": 0xFF00 + n })).0.unwrap();
        }
        let (answer, _) = bench.job(&json!({ "do": "emcy", "code": 0x1000 }));
        assert_eq!(answer.unwrap_err().1, "32 errors are there already; reset one");
        bench.errors.forget();
        bench.job(&json!({ "do": "emcy", "code": 0x1000 })).0.unwrap();
    }
}
