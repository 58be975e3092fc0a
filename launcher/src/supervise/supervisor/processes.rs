//! Processes of the loop: started, read, reaped, cleaned up after, and what is said about them.

use super::super::child::{Exit, Left};
use super::super::ground;
use super::super::logbook::{self, Line};
use super::super::policy::{Death, Kill, Notice};
use super::super::rail_thread::Order;
use super::{Cleaner, Source, Supervisor};
use crate::stackfile::free_shared_memory;
use ipc_types::clock;
use ipc_types::event::{EventKind, Level};
use ipc_types::payload::HealthState;
use ipc_types::reactor::{Reactor, Wake};
use serde_json::json;
use std::io;
use std::os::fd::{AsFd, BorrowedFd};

/// The clean-up helper is killed after so long.
const CLEAN_LIMIT_NS: u64 = 2_000_000_000;
/// Log lines in a `died` event, bytes of each, and of all.
const EPITAPH_LINES: usize = 20;
const EPITAPH_BYTES: usize = 256;
const EPITAPH_TOTAL_BYTES: usize = 2048;

impl Supervisor {
    pub(super) fn spawn(&mut self, service: usize, generation: u32) {
        if let Err(cause) = self.try_spawn(service, generation) {
            let death = Death { how: format!("could not be started: {cause}"), detail: json!({}) };
            self.policy.died(service, death, clock::mono_ns());
        }
    }

    fn try_spawn(&mut self, service: usize, generation: u32) -> Result<(), String> {
        let entry = &self.stack.services[service];
        // Closed by a hold: `restart` opens them again.
        for (slot, declared) in self.listeners[service].iter_mut().zip(&entry.wiring.listeners) {
            if slot.1.is_none() {
                slot.1 = Some(ground::listen(&entry.name, declared).map_err(|e| e.to_string())?);
            }
        }
        let mut fds: Vec<(String, BorrowedFd<'_>)> = self.listeners[service]
            .iter()
            .filter_map(|(name, listener)| Some((name.clone(), listener.as_ref()?.as_fd())))
            .collect();
        if let Some(retain) = &self.retain[service] {
            fds.push(("retain".to_owned(), retain.as_fd()));
        }
        let options = &self.services[service].options;
        let child = self
            .executable
            .spawn_service(&self.stack.root, &entry.name, generation, options, &fds)
            .map_err(|e| e.to_string())?;
        let watch = |reactor: &mut Reactor| -> io::Result<(Wake, Wake)> {
            Ok((reactor.add(child.pidfd())?, reactor.add(child.output())?))
        };
        let (death, output) = match watch(&mut self.reactor) {
            Ok(wakes) => wakes,
            Err(e) => {
                child.end();
                return Err(e.to_string());
            }
        };
        self.sources.insert(death, Source::Death(service));
        self.sources.insert(output, Source::Output(service));
        let pid = child.pid;
        let slot = &mut self.services[service];
        slot.sources = vec![death, output];
        slot.health = HealthState::Starting;
        slot.cpu_ticks = 0;
        slot.cpu_at = clock::mono_ns();
        slot.cpu_percent = 0.0;
        slot.child = Some(child);
        self.policy.started(service, pid);
        Ok(())
    }

    pub(super) fn on_death(&mut self, service: usize) {
        let Some(child) = &self.services[service].child else { return };
        let exit = match child.reap() {
            Ok(Some(exit)) => exit,
            Ok(None) => return,
            Err(_) => Exit::Code(-1),
        };
        self.read_rest(service);
        if let Some(line) = self.logbook.flush(service, clock::utc_ns()) {
            self.show(&line);
        }
        let Some(child) = self.services[service].child.take() else { return };
        let _ = self.reactor.remove(child.pidfd());
        let _ = self.reactor.remove(child.output());
        for wake in std::mem::take(&mut self.services[service].sources) {
            self.sources.remove(&wake);
        }
        let mut detail = exit.json();
        detail["pid"] = child.pid.into();
        detail["log"] = self.epitaph(service).into();
        self.policy.died(service, Death { how: exit.to_string(), detail }, clock::mono_ns());
    }

    /// The last lines of a service that fit into an event.
    fn epitaph(&self, service: usize) -> Vec<String> {
        let mut room = EPITAPH_TOTAL_BYTES;
        let last = self.logbook.tail(Some(service), EPITAPH_LINES);
        let mut lines: Vec<String> = last
            .iter()
            .rev()
            .map(|line| cut(&line.text, EPITAPH_BYTES))
            .take_while(|text| {
                room = room.saturating_sub(text.len() + 4);
                room > 0
            })
            .collect();
        lines.reverse();
        lines
    }

    pub(super) fn read_output(&mut self, service: usize) {
        let Some(child) = &self.services[service].child else { return };
        let mut lines = Vec::new();
        let logbook = &mut self.logbook;
        let utc_ns = clock::utc_ns();
        let left = child.read(&mut [0u8; 8192], |bytes| {
            logbook.feed(service, bytes, utc_ns, |line| lines.push(line.clone()));
        });
        if left == Left::End {
            // It closed its output but lives on: nothing more comes, and an ended pipe would wake for ever.
            let _ = self.reactor.remove(child.output());
        }
        for line in lines {
            self.show(&line);
        }
    }

    /// All that a dead one still had to say.
    fn read_rest(&mut self, service: usize) {
        let Some(child) = &self.services[service].child else { return };
        let mut lines = Vec::new();
        let logbook = &mut self.logbook;
        let utc_ns = clock::utc_ns();
        child.read_rest(&mut [0u8; 8192], |bytes| {
            logbook.feed(service, bytes, utc_ns, |line| lines.push(line.clone()));
        });
        for line in lines {
            self.show(&line);
        }
    }

    /// A log line goes to the foreground and to those who follow.
    pub(super) fn show(&mut self, line: &Line) {
        let name = &self.stack.services[line.service].name;
        self.console.err(format!("{} {name:<10} | {}", line.clock(), line.text));
        for id in self.control.publish(line, name) {
            self.drop_client(id);
        }
    }

    pub(super) fn tell(&mut self, notice: Notice) {
        let (name, utc_ns) = match notice.service {
            Some(service) => (self.stack.services[service].name.clone(), clock::utc_ns()),
            None => ("stack".to_owned(), clock::utc_ns()),
        };
        if let Some(service) = notice.service {
            let line = self.logbook.note(service, &format!("== {}", notice.message), utc_ns);
            self.show(&line);
        } else {
            self.console.err(format!("{} {name:<10} | == {}", logbook::clock(utc_ns), notice.message));
        }
        if let Some(notify) = &self.notify {
            match notice.kind {
                EventKind::Stopping => notify.send("STOPPING=1\nSTATUS=stopping"),
                EventKind::StackFailed | EventKind::Held | EventKind::Unstable => {
                    notify.send(&format!("STATUS={name}: {}", notice.message.replace('\n', " ")));
                }
                _ => {}
            }
        }
        let Notice { kind, level, message, detail, .. } = notice;
        if !self.rail.order(Order::Tell { service: name, kind, level, message, detail })
            && level == Level::Fault
        {
            self.console.err("stack      | == the rail thread does not take events any more");
        }
    }

    pub(super) fn start_cleaner(&mut self) {
        let started = self.executable.spawn_cleaner(&self.stack.root).and_then(|child| {
            match self.reactor.add(child.pidfd()) {
                Ok(wake) => Ok((child, wake)),
                Err(e) => {
                    child.end();
                    Err(e)
                }
            }
        });
        match started {
            Ok((child, wake)) => {
                self.sources.insert(wake, Source::CleanerDeath);
                let kill_at = clock::mono_ns() + CLEAN_LIMIT_NS;
                self.cleaner = Some(Cleaner { child, wake, kill_at, timed_out: false });
            }
            Err(e) => self.policy.clean_done(Err(format!("could not be started: {e}")), clock::mono_ns()),
        }
    }

    pub(super) fn limit_cleaner(&mut self, now: u64) {
        if let Some(cleaner) = &mut self.cleaner
            && now >= cleaner.kill_at
            && !std::mem::replace(&mut cleaner.timed_out, true)
        {
            cleaner.child.signal(Kill::Now);
        }
    }

    pub(super) fn on_cleaner_death(&mut self) {
        let Some(cleaner) = self.cleaner.take() else { return };
        let exit = match cleaner.child.reap() {
            Ok(None) => {
                self.cleaner = Some(cleaner);
                return;
            }
            Ok(Some(exit)) => exit,
            Err(_) => Exit::Code(-1),
        };
        let _ = self.reactor.remove(cleaner.child.pidfd());
        self.sources.remove(&cleaner.wake);
        let mut text = Vec::new();
        cleaner.child.read(&mut [0u8; 1024], |bytes| text.extend_from_slice(bytes));
        let result = if cleaner.timed_out {
            Err(format!("no answer within {} s", CLEAN_LIMIT_NS / 1_000_000_000))
        } else if exit == Exit::Code(0) {
            Ok(())
        } else {
            Err(format!("{exit}: {}", cut(String::from_utf8_lossy(&text).trim(), EPITAPH_BYTES)))
        };
        if result.is_err() && free_shared_memory().is_some_and(|free| free < ROOM_BYTES) {
            self.policy.clean_has_no_room(clock::mono_ns());
            return;
        }
        if let Err(cause) = &result {
            self.console.err(format!("stack      | == clean-up after dead processes failed: {cause}"));
        }
        self.policy.clean_done(result, clock::mono_ns());
    }
}

/// Below this /dev/shm counts as full: a node and the ports of a service need about as much.
const ROOM_BYTES: u64 = 1 << 20;

/// At most so many bytes of a text.
fn cut(text: &str, bytes: usize) -> String {
    text[..text.floor_char_boundary(bytes)].to_owned()
}
