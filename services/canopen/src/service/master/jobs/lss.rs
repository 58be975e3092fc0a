//! LSS as jobs: who waits for which call.

use super::{Answer, Asker, Begun, failed};
use crate::master::lss::{LssCall, LssError, LssOutcome};
use crate::master::network::Network;
use crate::service::jobs::{FAILED, LATE};
use serde_json::json;
use std::collections::BTreeMap;

/// See the module. The network's queue bounds it.
#[derive(Default)]
pub(super) struct LssAskers {
    asked: BTreeMap<u64, Asker>,
    next_job: u64,
}

impl LssAskers {
    pub fn ask(&mut self, by: Asker, call: LssCall, deadline_ns: u64, network: &mut Network) -> Begun {
        call.check().map_err(failed)?;
        if network.is_bus_off() {
            return Err(failed(LssError::BusOff.to_string()));
        }
        self.next_job += 1;
        network.lss.ask(self.next_job, call, deadline_ns).map_err(|full| failed(full.to_string()))?;
        self.asked.insert(self.next_job, by);
        Ok(None)
    }

    pub fn ended(&mut self, job: u64, outcome: &LssOutcome) -> Option<Answer> {
        let to = self.asked.remove(&job)?;
        Some(match &outcome.result {
            Ok(value) => Answer { to, code: 0, body: json!({ "ok": value }) },
            Err(error) => {
                let code = if *error == LssError::Late { LATE } else { FAILED };
                Answer { to, code, body: outcome.error_body(error) }
            }
        })
    }
}
