//! What is written to a node at its boot-up before its PDOs.

use super::value::encode;
use super::{CONSUMER_FACTOR, One, RESTART_MS};
use crate::config::MAX_SDO_WRITES;
use crate::device::Device;
use crate::master::boot::{ErrorControl, Write};

impl One<'_> {
    /// What is written before the PDOs: the DCF's values, the stack file's, error control.
    pub(super) fn own_writes(&mut self, device: &Device) -> Vec<Write> {
        let node = self.node;
        let mut writes: Vec<Write> = device
            .values
            .iter()
            .map(|(index, sub, data)| Write { index: *index, sub: *sub, data: data.clone() })
            .collect();
        if node.sdo.len() > MAX_SDO_WRITES {
            let message = format!("{} objects are written, the limit is {MAX_SDO_WRITES}", node.sdo.len());
            self.mistakes.add(&format!("{}.sdo", self.key), message, "put them into a DCF");
        }
        for (i, sdo) in node.sdo.iter().take(MAX_SDO_WRITES).enumerate() {
            let key = format!("{}.sdo[{i}]", self.key);
            match device.resolve(&sdo.object) {
                Ok((index, sub)) => writes.extend(self.sdo_write(device, index, sub, &sdo.value, &key)),
                Err(message) => self.mistakes.add(&format!("{key}.object"), message, "write one of those"),
            }
        }
        self.sync_writes(device, &mut writes);
        writes.extend(self.error_control_writes(device));
        writes
    }

    /// What a consumer of the SYNC must know: its COB-ID where it is not the device's own (1005h), whether it has a
    /// counter (1019h), and how long its window is (1007h).
    pub(super) fn sync_writes(&mut self, device: &Device, writes: &mut Vec<Write>) {
        let config = self.config;
        if config.sync_period.is_none() {
            return;
        }
        let writable = |index| {
            let entry = device.od.find(index, 0).ok().and_then(|e| device.od.entry(e));
            entry.is_some_and(|e| e.access.writable())
        };
        let by_hand = |index| {
            self.node.sdo.iter().any(|w| matches!(w.object.number(), Some((written, _)) if written == index))
        };
        let listens_to = device.od.u32(0x1005, 0).and_then(|default| self.sync_cob_id_default(default));
        if let Some(id) = listens_to.filter(|_| !by_hand(0x1005)) {
            if writable(0x1005) {
                writes.push(Write { index: 0x1005, sub: 0, data: id.to_le_bytes().to_vec() });
            } else {
                let message = format!(
                    "node {} does not hear a SYNC of {id:X}h: its EDS lacks a writable 1005h",
                    self.node.id
                );
                let help = "leave sync_cob_id out: devices listen to 080h";
                self.mistakes.warn(&format!("{}.eds", self.key), message, help);
            }
        }
        if let Some(window) = config.sync_window
            && writable(0x1007)
            && !by_hand(0x1007)
        {
            let us = u32::try_from(window.ns() / 1000).unwrap_or(u32::MAX);
            writes.push(Write { index: 0x1007, sub: 0, data: us.to_le_bytes().to_vec() });
        }
        if config.sync_overflow == 0 || by_hand(0x1019) {
            return;
        }
        if writable(0x1019) {
            writes.push(Write { index: 0x1019, sub: 0, data: vec![config.sync_overflow] });
        } else {
            let message =
                format!("node {} knows no SYNC counter: its EDS lacks a writable 1019h", self.node.id);
            let help = "it answers a SYNC with counter by emergency 8240h; leave sync_overflow out";
            self.mistakes.warn(&format!("{}.eds", self.key), message, help);
        }
    }

    pub(super) fn sdo_write(
        &mut self,
        device: &Device,
        index: u16,
        sub: u8,
        value: &crate::config::Number,
        key: &str,
    ) -> Option<Write> {
        let entry = device.od.find(index, sub).ok().and_then(|e| device.od.entry(e))?;
        if !entry.access.writable() {
            let message = format!("{index:04X}:{sub:02X} has access '{}'", entry.access.word());
            self.mistakes.add(&format!("{key}.object"), message, "leave it out: it cannot be written");
            return None;
        }
        match encode(value, entry, self.node.id) {
            Ok(data) => {
                self.check_cob_id(index, sub, &data, key);
                Some(Write { index, sub, data })
            }
            Err(message) => {
                self.mistakes.add(&format!("{key}.value"), message, "write a value of the object's type");
                None
            }
        }
    }

    pub(super) fn error_control_writes(&mut self, device: &Device) -> Vec<Write> {
        let mut writes = Vec::new();
        let has = |index, sub| {
            device
                .od
                .find(index, sub)
                .ok()
                .and_then(|e| device.od.entry(e))
                .is_some_and(|e| e.access.writable())
        };
        let ms = |ns: u64| (ns / 1_000_000).min(u64::from(u16::MAX)) as u16;
        match self.error_control() {
            ErrorControl::Heartbeat { .. } => {
                let period = self.node.heartbeat.map_or(0, |h| ms(h.ns()));
                if has(0x1017, 0) {
                    writes.push(Write { index: 0x1017, sub: 0, data: period.to_le_bytes().to_vec() });
                } else {
                    let help = "leave heartbeat out, or use guarding = { time = \"100ms\", factor = 3 }";
                    let message =
                        format!("node {} has no heartbeat: its EDS lacks a writable 1017h", self.node.id);
                    self.mistakes.add(&format!("{}.heartbeat", self.key), message, help);
                }
                self.consumer_write(device, &mut writes);
            }
            ErrorControl::Guarding { guard_ns, factor } => {
                if has(0x100C, 0) && has(0x100D, 0) {
                    writes.push(Write { index: 0x100C, sub: 0, data: ms(guard_ns).to_le_bytes().to_vec() });
                    writes.push(Write { index: 0x100D, sub: 0, data: vec![factor] });
                } else {
                    let message =
                        format!("node {} has no guarding: its EDS lacks 100Ch or 100Dh", self.node.id);
                    self.mistakes.add(
                        &format!("{}.guarding", self.key),
                        message,
                        "use heartbeat = \"100ms\"",
                    );
                }
            }
            ErrorControl::None => {}
        }
        let written = |w: &&crate::config::SdoWrite| matches!(w.object.number(), Some((0x1016, _)));
        for sdo in self.node.sdo.iter().filter(written) {
            let time = sdo.value.integer(self.node.id).unwrap_or(0) & 0xFFFF;
            if time > 0 && (time as u64) < RESTART_MS {
                let message = format!(
                    "node {} waits {time} ms for a heartbeat (1016h), shorter than a restart of the master ({RESTART_MS} ms)",
                    self.node.id
                );
                let help = "a restarted master would find it in its error state: set 500 ms or more";
                self.mistakes.warn(&format!("{}.sdo", self.key), message, help);
            }
        }
        writes
    }

    /// The node watches the master, unless the stack file sets 1016h itself.
    pub(super) fn consumer_write(&mut self, device: &Device, writes: &mut Vec<Write>) {
        let by_hand = self.node.sdo.iter().any(|w| matches!(w.object.number(), Some((0x1016, _))));
        let heartbeat_ms = self.config.heartbeat.ns() / 1_000_000;
        let entry = device.od.find(0x1016, 1).ok().and_then(|e| device.od.entry(e));
        if by_hand || heartbeat_ms == 0 || entry.is_none_or(|e| !e.access.writable()) {
            return;
        }
        let wait_ms = (heartbeat_ms * CONSUMER_FACTOR).clamp(RESTART_MS, u64::from(u16::MAX)) as u32;
        let value = u32::from(self.config.node_id) << 16 | wait_ms;
        writes.push(Write { index: 0x1016, sub: 1, data: value.to_le_bytes().to_vec() });
    }
}
