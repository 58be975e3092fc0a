//! The account of every scan: verified, different or listed with the reason. None may be passed over, and none counts twice.

use super::{MAX_SPANS, Unverifiable, Verifier, WAITING_RECORDS, Waiting};
use ipc_types::scan_record::Content;
use std::collections::VecDeque;

impl Verifier<'_> {
    pub(super) fn lose(&mut self, reason: String) {
        self.position = None;
        self.reason = reason;
    }

    /// Holds a record back until a keyframe comes, for a while.
    pub(super) fn wait(&mut self, generation: u32, content: &Content<'_>) {
        if self.waiting.len() == WAITING_RECORDS
            && let Some(oldest) = self.waiting.pop_front()
        {
            self.list(oldest.generation, oldest.scan, oldest.scan);
        }
        self.waiting.push_back(Waiting {
            generation,
            scan: content.head.scan,
            bytes: content.bytes().to_vec(),
        });
    }

    /// Lists what waited, up to a scan, or all of it.
    pub(super) fn list_waiting(&mut self, up_to: Option<(u32, u64)>) {
        let mut kept = VecDeque::new();
        for record in std::mem::take(&mut self.waiting) {
            if up_to.is_none_or(|up_to| (record.generation, record.scan) <= up_to) {
                self.list(record.generation, record.scan, record.scan);
            } else {
                kept.push_back(record);
            }
        }
        self.waiting = kept;
    }

    /// A keyframe stands for the scans up to this one: those that were not verified are listed, whether they are there or not.
    pub(super) fn list_up_to(&mut self, generation: u32, scan: u64) {
        self.list_waiting(Some((generation, scan)));
        match self.reached {
            Some((before, _)) if before < generation && scan > 0 => {
                self.reason = "its engine's first keyframe is missing".to_owned();
                self.list(generation, scan, scan);
            }
            Some((before, _)) if before == generation => self.list(generation, scan, scan),
            _ => {}
        }
        if self.reached.is_none_or(|reached| reached < (generation, scan)) {
            self.reached = Some((generation, scan));
            self.begin.get_or_insert((generation, scan.saturating_add(1)));
        }
    }

    /// A record that comes when its turn is over: nothing to list when it was accounted for.
    pub(super) fn list_late(&mut self, generation: u32, scan: u64) {
        match self.reached {
            Some((newer, _)) if newer > generation => {
                self.doubt(format!(
                    "scan {scan} of generation {generation} stands behind those of its successor"
                ));
            }
            Some((same, reached)) if same == generation && reached >= scan => {
                if self.begin.is_some_and(|begin| (generation, scan) < begin) {
                    self.doubt(format!("scan {scan} of generation {generation} stands behind later ones"));
                }
            }
            _ => {
                let reason = std::mem::replace(&mut self.reason, "no keyframe before it".to_owned());
                self.list(generation, scan, scan);
                self.reason = reason;
            }
        }
    }

    /// These scans are not verified, for the reason that stands; nor are those between the last one accounted for and them.
    pub(super) fn list(&mut self, generation: u32, from: u64, to: u64) {
        let from = match self.reached {
            Some((before, reached)) if before == generation => reached.saturating_add(1),
            // An engine that started anew counts from 1.
            Some((before, _)) if before < generation => 1,
            Some(_) => return,
            None => from,
        };
        if from > to {
            return;
        }
        self.begin.get_or_insert((generation, from));
        self.reached = Some((generation, to));
        let scans = (to - from).saturating_add(1);
        self.report.scans = self.report.scans.saturating_add(scans);
        // After a difference everything up to the next keyframe differs: that is no gap.
        if self.reason == "after a difference" {
            self.report.scans_different = self.report.scans_different.saturating_add(scans);
            return;
        }
        if let Some(last) = self.report.unverifiable.last_mut()
            && last.generation == generation
            && last.to.saturating_add(1) >= from
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
}
