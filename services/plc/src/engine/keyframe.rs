//! The whole state of an engine as a keyframe, and an engine continued from one.

use super::*;
use ipc_types::scan_record::{Content, HEAD_BYTES, Kind, Reason, SECTION_BYTES, Section};

/// Why an engine cannot continue from a keyframe.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum RestoreError {
    #[error("this is a scan record, no keyframe")]
    NotAKeyframe,
    #[error("the keyframe is of program {0:016x}, the engine runs {1:016x}")]
    OtherProgram(u64, u64),
    #[error("the keyframe's memory does not fit the program's layout")]
    Memory,
    #[error("the keyframe is incomplete")]
    Incomplete,
}

impl Engine {
    /// The state after the last scan. Allocates the first time only.
    pub fn take_keyframe(&mut self, reason: Reason) -> &[u8] {
        let state_end = self.state_end();
        let need = HEAD_BYTES
            + SECTION_BYTES * (8 + self.schedule.len())
            + self.setup_json.len()
            + state_end as usize
            + self.field.len()
            + self.quality.len()
            + MAX_FORCES * 24
            + self.schedule.len() * 16;
        let writer = self.keyframe.get_or_insert_with(|| Writer::new(need + 64));
        let memory = self.body.memory();
        writer.begin();
        writer.setup(&self.setup_json);
        writer.memory(0, &memory[..state_end as usize]);
        writer.field(&self.field);
        writer.forces(&self.forces);
        for task in self.schedule.states() {
            writer.schedule(&task);
        }
        writer.quality(&self.quality);
        let head = Head {
            kind: Kind::Keyframe,
            state_before: self.state as u8,
            state_after: self.state as u8,
            start: reason as u8,
            scan: self.scan,
            plc_time_ns: self.stamps.plc_time_ns,
            t_ns: self.stamps.t_ns,
            utc_ns: self.stamps.utc_ns,
            program_hash: self.program_hash,
            memory_hash: xxh3_64(&memory[..state_end as usize]),
            hash_offset: 0,
            hash_len: state_end,
            warnings: machine::u32_at(memory, sys::WARNINGS),
            ..Head::default()
        };
        writer.finish(&head)
    }

    /// The keyframe taken last.
    pub fn keyframe(&self) -> &[u8] {
        self.keyframe.as_ref().map_or(&[], Writer::content)
    }

    /// Continues from a keyframe of the same program and setup.
    pub fn restore(&mut self, keyframe: &Content<'_>) -> Result<(), RestoreError> {
        if keyframe.head.program_hash != self.program_hash {
            return Err(RestoreError::OtherProgram(keyframe.head.program_hash, self.program_hash));
        }
        self.restore_any(keyframe)
    }

    /// As [`Self::restore`], also for a program with the same layout.
    pub fn restore_any(&mut self, keyframe: &Content<'_>) -> Result<(), RestoreError> {
        let head = &keyframe.head;
        if head.kind != Kind::Keyframe {
            return Err(RestoreError::NotAKeyframe);
        }
        if head.flags & flag::INCOMPLETE != 0 {
            return Err(RestoreError::Incomplete);
        }
        if let Body::Machine(machine) = &mut self.body {
            machine.renew().map_err(|_| RestoreError::Memory)?;
        }
        let state_end = self.state_end() as usize;
        let mut whole = false;
        for section in keyframe.sections() {
            match section {
                Section::Memory { offset: 0, bytes } if bytes.len() == state_end => {
                    let memory = self.body.memory_mut();
                    memory[..state_end].copy_from_slice(bytes);
                    memory[state_end..].copy_from_slice(&self.initial[state_end..]);
                    whole = true;
                }
                Section::Memory { .. } => return Err(RestoreError::Memory),
                Section::Field(bytes) if bytes.len() == self.field.len() => self.field.copy_from_slice(bytes),
                Section::Field(_) => return Err(RestoreError::Memory),
                Section::Forces(table) => {
                    self.force_paths.clear();
                    self.forces.clear();
                    for patch in table.iter().take(MAX_FORCES) {
                        let (path, _) = value::name_of(self.map(), &self.image, patch.offset);
                        self.forces.push(*patch);
                        self.force_paths.push(path);
                    }
                }
                Section::Schedule(task) => self.schedule.restore(&task),
                Section::Quality(ranges) if ranges.len() == self.quality.len() => {
                    self.quality.copy_from_slice(ranges);
                }
                _ => {}
            }
        }
        if !whole {
            return Err(RestoreError::Incomplete);
        }
        self.scan = head.scan;
        self.state = PlcState::from_u32(u32::from(head.state_after));
        self.stamps = Stamps { t_ns: head.t_ns, plc_time_ns: head.plc_time_ns, utc_ns: head.utc_ns };
        let base = self.image.input.offset as usize;
        let len = self.prev.len();
        self.prev.copy_from_slice(&self.body.memory()[base..base + len]);
        Ok(())
    }

    /// Takes over another engine's moment: all of it when the layout is the same, else image and the variables
    /// that both programs have, by path and type.
    pub fn adopt(&mut self, other: &Engine) {
        self.scan = other.scan;
        self.state = other.state;
        self.stamps = other.stamps;
        if self.field.len() == other.field.len() && self.quality.len() == other.quality.len() {
            self.field.copy_from_slice(&other.field);
            self.quality.copy_from_slice(&other.quality);
        }
        let same = self.same_layout(other);
        if same {
            let end = self.state_end() as usize;
            self.body.memory_mut()[..end].copy_from_slice(&other.memory()[..end]);
        } else {
            let pairs: Vec<(u32, u32, usize)> = crate::verify::common(other, self)
                .into_iter()
                .map(|(symbol, offset)| (symbol.offset, offset, crate::verify::bytes_of(symbol)))
                .collect();
            let from = self.image.input.offset as usize;
            let image = other.image_bytes();
            let memory = self.body.memory_mut();
            memory[from..from + image.len()].copy_from_slice(image);
            for (there, here, len) in pairs {
                if let (Some(source), Some(target)) = (
                    other.memory().get(there as usize..there as usize + len),
                    memory.get_mut(here as usize..here as usize + len),
                ) {
                    target.copy_from_slice(source);
                }
            }
        }
        self.forces.clear();
        self.force_paths.clear();
        for (path, patch) in other.forces() {
            let offset = if same { Ok(patch.offset) } else { self.resolve(path).map(|cell| cell.offset) };
            if let Ok(offset) = offset {
                self.forces.push(Patch { offset, ..*patch });
                self.force_paths.push(path.to_owned());
            }
        }
        for task in other.schedule.states() {
            self.schedule.restore(&task);
        }
        let base = self.image.input.offset as usize;
        let len = self.prev.len();
        self.prev.copy_from_slice(&self.body.memory()[base..base + len]);
    }
}
