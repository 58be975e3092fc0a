//! One scan, from its stamps to its record.

use super::*;

impl Engine {
    /// Opens the next scan.
    pub fn begin(&mut self, stamps: Stamps) {
        self.scan += 1;
        self.stamps = stamps;
        self.forces_changed = false;
        self.triggered = None;
        self.head = Head { state_before: self.state as u8, ..Head::default() };
        self.writer.begin();
    }

    /// Applies a command. A force beyond [`MAX_FORCES`] is ignored: whoever hands it in counts first.
    pub fn control(&mut self, source: &Source, command: &Command<'_>) {
        self.writer.control(source, command);
        match command {
            Command::Stop => {
                if matches!(self.state, PlcState::Run | PlcState::Starting) {
                    self.state = PlcState::Stop;
                }
            }
            Command::Start(kind) => self.start(*kind),
            Command::Force { patch, path } => self.force(patch, path),
            Command::Unforce { patch, .. } => {
                if let Some(i) = self.forces.iter().position(|f| f.same_place(patch)) {
                    self.forces.remove(i);
                    self.force_paths.remove(i);
                    self.forces_changed = true;
                }
            }
            Command::UnforceAll => {
                self.forces.clear();
                self.force_paths.clear();
                self.forces_changed = true;
            }
            Command::Set { patch, .. } => {
                let _ = patch.apply(self.body.memory_mut());
                let input = self.image.input;
                if let Some(at) = patch.offset.checked_sub(input.offset).filter(|at| *at < input.bytes) {
                    let _ = Patch { offset: at, ..*patch }.apply(&mut self.field);
                }
            }
            Command::Load { .. } => {}
        }
    }

    fn force(&mut self, patch: &Patch, path: &str) {
        self.forces_changed = true;
        if let Some(i) = self.forces.iter().position(|f| f.same_place(patch)) {
            self.forces[i] = *patch;
        } else if self.forces.len() < MAX_FORCES {
            self.forces.push(*patch);
            self.force_paths.push(path.to_owned());
        }
    }

    fn start(&mut self, kind: Start) {
        if let Body::Machine(machine) = &mut self.body
            && let Err(error) = machine.renew()
        {
            tracing::error!("the program cannot be started again: {error}");
            self.state = PlcState::Fault;
            return;
        }
        let (retain, state_end) = (span(self.retain), self.state_end() as usize);
        let memory = self.body.memory_mut();
        match kind {
            Start::Cold => memory.copy_from_slice(&self.initial),
            Start::Warm => {
                memory[..retain.start].copy_from_slice(&self.initial[..retain.start]);
                memory[retain.end..].copy_from_slice(&self.initial[retain.end..]);
            }
            Start::Hot => {
                memory[sys::TRAP_ID as usize..sys::TRAP_REAL as usize + 8].fill(0);
                // Temporaries are no state: what a killed task left there must not matter.
                memory[state_end..].copy_from_slice(&self.initial[state_end..]);
            }
        }
        self.schedule.start(self.stamps.plc_time_ns);
        self.fault = None;
        self.state = PlcState::Run;
        self.head.start = kind as u8;
        if kind != Start::Hot {
            self.head.flags |= flag::FIRST_SCAN;
        }
    }

    /// Opens the message of an input's owner.
    pub fn input_begin(&mut self, source: &Source) -> usize {
        self.writer.input_begin(source)
    }

    /// One range of it: its quality, and bytes from `start` of the range on, which count unless the owner
    /// is dead.
    pub fn input_range(&mut self, range: u16, quality: u8, start: u32, bytes: &[u8]) {
        let index = usize::from(range);
        let Some(spec) = self.setup.inputs.get(index) else { return };
        let quality_changed = self.quality[index] != quality;
        // A living owner has its own idea of what a bad value shows; `on_bad` is for the dead.
        let alive = quality < Quality::OwnerDead as u8;
        let zero = !alive && spec.on_bad == OnBad::Zero;
        let (place, bit) = ((spec.byte as usize, spec.bytes as usize), spec.bit);
        if quality_changed {
            self.show_quality(index, quality);
        }
        let target = match self.field.get_mut(place.0..place.0 + place.1) {
            Some(target) if alive || zero => target,
            _ => {
                if quality_changed {
                    self.writer.input_range(range, quality, 0, &[]);
                }
                return;
            }
        };
        if let Some(bit) = bit {
            let old = target[0] >> bit & 1;
            let new = u8::from(alive && bytes.first().map_or(old != 0, |b| *b != 0));
            target[0] = (target[0] & !(1 << bit)) | (new << bit);
            if alive && old != new {
                self.writer.input_range(range, quality, 0, &[new]);
            } else if quality_changed {
                self.writer.input_range(range, quality, 0, &[]);
            }
            return;
        }
        if zero {
            target.fill(0);
            if quality_changed {
                self.writer.input_range(range, quality, 0, &[]);
            }
            return;
        }
        let start = (start as usize).min(target.len());
        let target = &mut target[start..];
        let bytes = &bytes[..bytes.len().min(target.len())];
        let first = bytes.iter().zip(&*target).position(|(new, old)| new != old);
        let last = bytes.iter().zip(&*target).rposition(|(new, old)| new != old);
        if let (Some(first), Some(last)) = (first, last) {
            target[first..=last].copy_from_slice(&bytes[first..=last]);
            self.writer.input_range(range, quality, (start + first) as u32, &bytes[first..=last]);
        } else if quality_changed {
            self.writer.input_range(range, quality, 0, &[]);
        }
    }

    /// Closes the message opened at `at`.
    pub fn input_end(&mut self, at: usize) {
        self.writer.input_end(at);
    }

    pub(super) fn show_quality(&mut self, range: usize, quality: u8) {
        self.quality[range] = quality;
        let status = self.setup.inputs[range].status_byte;
        if let Some(byte) = status.and_then(|at| self.field.get_mut(at as usize)) {
            *byte = quality;
        }
    }

    /// Applies a write request whole or not at all. `judged` is what is already known against it, else
    /// [`write_result::APPLIED`]. Returns the result.
    pub fn write(&mut self, source: &Source, judged: u32, tail: &[u8]) -> u32 {
        let result = if judged == write_result::APPLIED { self.apply_write(tail) } else { judged };
        self.writer.write(source, result, tail);
        result
    }

    fn apply_write(&mut self, tail: &[u8]) -> u32 {
        let Ok(ops) = image_write::parse(tail) else { return write_result::MALFORMED };
        let (output, marker) = (self.image.output, self.image.marker);
        for op in ops {
            let room = match op.area() {
                ImageArea::Output => output.bytes,
                ImageArea::Marker => marker.bytes,
                // %I belongs to the field services.
                ImageArea::Input => 0,
            };
            if (op.offset() as usize).saturating_add(op.len()) > room as usize {
                return write_result::OUTSIDE;
            }
        }
        let Ok(ops) = image_write::parse(tail) else { return write_result::MALFORMED };
        let memory = self.body.memory_mut();
        for op in ops {
            let area = if op.area() == ImageArea::Output { output } else { marker };
            let _ = op.apply(&mut memory[span(area)]);
        }
        write_result::APPLIED
    }

    /// The event came that the tasks without INTERVAL and SINGLE wait for, or is overdue.
    pub fn trigger(&mut self, trigger: &Trigger) {
        self.writer.trigger(trigger);
        self.triggered = Some(trigger.missed);
    }

    /// Runs the scan and closes its record.
    pub fn finish(&mut self) -> ScanOutcome {
        self.finish_with(None)
    }

    /// As [`Self::finish`], but a task that the record says the watchdog killed is not run.
    pub fn finish_with(&mut self, killed: Option<&Fault<'_>>) -> ScanOutcome {
        self.stamp();
        let input = span(self.image.input);
        let field = std::mem::take(&mut self.field);
        self.body.memory_mut()[input].copy_from_slice(&field);
        self.field = field;
        self.apply_forces();
        self.move_routes(true);
        let mut result = ScanOutcome { outcome: Outcome::Idle, fault: None, skipped: 0, used_inputs: false };
        if self.state == PlcState::Run {
            result.outcome = Outcome::Ok;
            self.run_tasks(killed, &mut result);
            result.used_inputs = self.program.is_none() || self.head.tasks_ran != 0;
        }
        if self.state == PlcState::Run {
            self.move_routes(false);
        }
        self.apply_forces();
        self.close_record(result.outcome);
        result
    }

    fn stamp(&mut self) {
        let (stamps, scan) = (self.stamps, self.scan);
        let first = u8::from(self.head.flags & flag::FIRST_SCAN != 0);
        let memory = self.body.memory_mut();
        memory[sys::STAMP_NS as usize..][..8].copy_from_slice(&stamps.plc_time_ns.to_le_bytes());
        memory[sys::SCAN as usize..][..8].copy_from_slice(&scan.to_le_bytes());
        memory[sys::UTC_NS as usize..][..8].copy_from_slice(&stamps.utc_ns.to_le_bytes());
        memory[sys::FIRST_SCAN as usize] = first;
    }

    fn apply_forces(&mut self) {
        if !self.forces.is_empty() {
            let memory = self.body.memory_mut();
            for force in &self.forces {
                let _ = force.apply(memory);
            }
        }
    }

    fn move_routes(&mut self, before_tasks: bool) {
        if self.routes.is_empty() {
            return;
        }
        let memory = self.body.memory_mut();
        for route in self.routes.iter().filter(|r| r.before_tasks == before_tasks) {
            let bad = route.ranges.iter().any(|r| self.quality[usize::from(*r)] != Quality::Good as u8);
            route.run(memory, bad);
        }
        // A force wins over a route.
        self.apply_forces();
    }

    fn run_tasks(&mut self, killed: Option<&Fault<'_>>, result: &mut ScanOutcome) {
        let Some(program) = self.program.clone() else { return };
        let map = &program.artifact.map;
        let keep = self.kept_on_kill();
        self.before.copy_from_slice(&self.body.memory()[keep]);
        for place in 0..self.schedule.len() {
            let (now_ns, memory) = (self.stamps.plc_time_ns, self.body.memory());
            let Some(due) = self.schedule.due(place, now_ns, self.triggered, memory) else { continue };
            if due.skipped > 0 {
                self.writer.skipped(due.task as u16, due.skipped);
                result.skipped += due.skipped;
            }
            if self.state != PlcState::Run {
                // A higher task faulted; this one's period is over all the same.
                continue;
            }
            self.apply_forces();
            self.head.tasks_ran |= 1 << due.task;
            let Body::Machine(machine) = &mut self.body else { return };
            let ran = match killed {
                Some(fault) if usize::from(fault.task) == due.task => Err(RawTrap {
                    trap: fault.trap,
                    statement: fault.statement,
                    instance: fault.instance,
                    value: fault.value,
                    real: fault.real,
                }),
                _ => machine.run(due.task, map),
            };
            if let Err(raw) = ran {
                self.trap(&raw, due.task, &program);
                result.outcome = Outcome::Trap;
                result.fault.clone_from(&self.fault);
            }
        }
    }

    /// %I to RETAIN.
    fn kept_on_kill(&self) -> std::ops::Range<usize> {
        self.image.input.offset as usize..(self.retain.offset + self.retain.bytes) as usize
    }

    fn trap(&mut self, raw: &RawTrap, task: usize, program: &Program) {
        let report = FaultReport::new(raw, task, &program.artifact.map, self.body.memory(), &program.sources);
        self.writer.fault(&Fault {
            task: task as u8,
            trap: raw.trap,
            statement: raw.statement,
            instance: raw.instance,
            value: raw.value,
            real: raw.real,
            text: &report.message,
        });
        self.state = PlcState::Fault;
        self.fault = Some(Box::new(report));
        if raw.trap == TrapId::Watchdog as u32 {
            // Nobody knows how far the task came: what the field and RETAIN see goes back to before the
            // tasks, DATA to its initial values.
            let keep = self.kept_on_kill();
            let data = span(self.data);
            let memory = self.body.memory_mut();
            memory[keep].copy_from_slice(&self.before);
            memory[data.clone()].copy_from_slice(&self.initial[data]);
            memory[sys::WARNINGS as usize..][..4].fill(0);
        }
    }

    fn close_record(&mut self, outcome: Outcome) {
        if self.forces_changed {
            self.writer.forces(&self.forces);
        }
        let base = self.image.input.offset as usize;
        let memory = self.body.memory();
        let now = &memory[base..base + self.prev.len()];
        let data_from = self.data.offset as usize - base;
        let cut =
            changes::record(&mut self.writer, &mut self.prev, now, base as u32, data_from, DATA_CHANGES);
        if cut {
            self.head.flags |= flag::DATA_CUT;
        }
        let (hash_offset, hash_len) = hash_range(self.state_end(), self.scan);
        let hashed = &memory[hash_offset as usize..(hash_offset + hash_len) as usize];
        self.head = Head {
            state_after: self.state as u8,
            outcome: outcome as u8,
            scan: self.scan,
            plc_time_ns: self.stamps.plc_time_ns,
            t_ns: self.stamps.t_ns,
            utc_ns: self.stamps.utc_ns,
            program_hash: self.program_hash,
            memory_hash: xxh3_64(hashed),
            hash_offset,
            hash_len,
            warnings: self.warnings(),
            ..self.head
        };
        self.writer.finish(&self.head);
    }
}
