//! What clients of the control socket ask, answered from the loop.

use super::super::child;
use super::super::control::{LogLine, Reply, Request, ServiceRow, StackStatus};
use super::super::policy::{Phase, Slot};
use super::{MS, Source, Supervisor};
use ipc_types::clock;

/// `restart` waits so long for the new process to be ready.
const RESTART_WAIT_NS: u64 = 15_000_000_000;
/// A client that waits for a restart.
pub(super) struct Waiter {
    client: u64,
    service: usize,
    generation: u32,
    since: u64,
}

impl Supervisor {
    pub(super) fn take_clients(&mut self) {
        let accepted = self.control.accept();
        for id in accepted.ids {
            let Some(fd) = self.control.client_fd(id) else { continue };
            match self.reactor.add(fd) {
                Ok(wake) => drop(self.sources.insert(wake, Source::Client(id))),
                Err(_) => self.control.drop_client(id),
            }
        }
        let why = match accepted.stuck {
            Some(cause) => {
                // It stays readable: waiting for it now would only turn the loop.
                if let Some(wake) = self.control_wake.take() {
                    let _ = self.reactor.remove(self.control.fd());
                    self.sources.remove(&wake);
                }
                format!("no client can be taken: {cause}")
            }
            None if accepted.turned_away > 0 => {
                "clients are turned away: the launcher has no file descriptor left (ulimit -n)".to_owned()
            }
            None => return,
        };
        if self.turned_away.failed(clock::mono_ns()).is_some() {
            self.console.err(format!("stack      | == {why}"));
        }
    }

    /// Once a tick: the control socket is waited for again after nobody could be taken.
    pub(super) fn listen_again(&mut self) {
        if self.control_wake.is_none()
            && let Ok(wake) = self.reactor.add(self.control.fd())
        {
            self.sources.insert(wake, Source::Control);
            self.control_wake = Some(wake);
        }
    }

    pub(super) fn serve(&mut self, id: u64, request: Result<Request, String>) {
        let now = clock::mono_ns();
        match request {
            Err(cause) => self.reply(id, &Reply::Error(cause)),
            Ok(Request::Ps {}) => {
                let rows = (0..self.services.len()).map(|i| self.row(i, now)).collect();
                self.reply(id, &Reply::Ps(rows));
            }
            Ok(Request::Status {}) => {
                let status = self.status(now);
                self.reply(id, &Reply::Status(status));
            }
            Ok(Request::Down {}) => {
                self.reply(id, &Reply::Stopping { pid: std::process::id() });
                // Asked twice by whomever, it is still one orderly end; signals may hurry it.
                if !self.policy.stopping() {
                    self.policy.stop("`down` was asked for", now);
                }
            }
            Ok(Request::Logs { service, lines, follow }) => {
                self.serve_logs(id, service.as_deref(), lines, follow);
            }
            Ok(Request::Restart { service }) => {
                let result = self.index_of(&service).and_then(|i| Ok((i, self.policy.restart(i, now)?)));
                match result {
                    Ok((service, generation)) => {
                        self.waiters.push(Waiter { client: id, service, generation, since: now });
                    }
                    Err(cause) => self.reply(id, &Reply::Error(cause)),
                }
            }
        }
    }

    fn serve_logs(&mut self, id: u64, service: Option<&str>, lines: u32, follow: bool) {
        let index = match service.map(|s| self.index_of(s)).transpose() {
            Ok(index) => index,
            Err(cause) => return self.reply(id, &Reply::Error(cause)),
        };
        let replies: Vec<Reply> = self
            .logbook
            .tail(index, lines as usize)
            .into_iter()
            .map(|line| {
                Reply::Log(LogLine {
                    utc_ns: line.utc_ns,
                    service: self.stack.services[line.service].name.clone(),
                    line: line.text.clone(),
                })
            })
            .collect();
        for reply in replies {
            self.reply(id, &reply);
        }
        if follow {
            self.control.follow(id, index);
        } else {
            self.reply(id, &Reply::End);
        }
    }

    fn index_of(&self, name: &str) -> Result<usize, String> {
        let names: Vec<&str> = self.stack.services.iter().map(|s| s.name.as_str()).collect();
        names
            .iter()
            .position(|n| *n == name)
            .ok_or_else(|| format!("this stack has no service '{name}'; it has {}", names.join(", ")))
    }

    fn row(&self, index: usize, now: u64) -> ServiceRow {
        let (entry, service, slot) =
            (&self.stack.services[index], &self.services[index], &self.policy.slots()[index]);
        let pid = service.child.as_ref().map_or(0, |c| c.pid);
        ServiceRow {
            service: entry.name.clone(),
            kind: entry.kind.clone(),
            state: slot.phase.word().to_owned(),
            health: format!("{:?}", service.health).to_lowercase(),
            pid,
            generation: slot.generation,
            restarts: slot.generation.saturating_sub(1),
            uptime_ms: if pid == 0 { 0 } else { (now - slot.since) / MS },
            cpu_percent: if pid == 0 { 0.0 } else { service.cpu_percent },
            rss_bytes: child::usage(pid).map_or(0, |u| u.rss_bytes),
            deaths: slot.deaths(),
            unstable: slot.unstable(),
        }
    }

    pub(super) fn held(&self) -> Vec<String> {
        let held = |s: &&Slot| s.phase == Phase::Held;
        self.policy.slots().iter().filter(held).map(|s| s.name.clone()).collect()
    }

    fn status(&self, now: u64) -> StackStatus {
        let held = self.held();
        let unstable = self.policy.slots().iter().filter(|s| s.unstable()).map(|s| s.name.clone());
        let unstable: Vec<String> = unstable.filter(|name| !held.contains(name)).collect();
        let ready = self.policy.slots().iter().filter(|s| s.phase == Phase::Running).count();
        let state = match () {
            () if self.policy.failed().is_some() => "failed",
            () if self.policy.stopping() => "stopping",
            () if !held.is_empty() || !unstable.is_empty() => "degraded",
            () if ready == self.services.len() => "running",
            () if self.all_ready => "degraded",
            () => "starting",
        };
        StackStatus {
            stack: self.stack.name.clone(),
            pid: std::process::id(),
            build_id: self.stack.build_id.clone(),
            state: state.to_owned(),
            uptime_ms: (now - self.began) / MS,
            services: self.services.len() as u32,
            ready: ready as u32,
            held,
            unstable,
            degraded: self.degraded(),
            failed: self.policy.failed().map(str::to_owned),
        }
    }

    /// Tells clients whose restart is done, or will not be.
    pub(super) fn answer_waiters(&mut self, now: u64) {
        for waiter in std::mem::take(&mut self.waiters) {
            let slot = &self.policy.slots()[waiter.service];
            let name = slot.name.clone();
            let reply = if slot.generation >= waiter.generation && slot.phase == Phase::Running {
                Reply::Restarted {
                    service: name,
                    generation: slot.generation,
                    after_ms: (now - waiter.since) / MS,
                }
            } else if slot.phase == Phase::Held {
                Reply::Error(format!(
                    "service '{name}' does not stay up and is held; see `dinrail logs {name}`"
                ))
            } else if self.policy.stopping() {
                Reply::Error("the stack is stopping".into())
            } else if now - waiter.since > RESTART_WAIT_NS {
                Reply::Error(format!("service '{name}' is not ready after 15 s; see `dinrail logs {name}`"))
            } else {
                self.waiters.push(waiter);
                continue;
            };
            self.reply(waiter.client, &reply);
        }
    }

    fn reply(&mut self, id: u64, reply: &Reply) {
        if !self.control.answer(id, reply) {
            self.drop_client(id);
        }
    }

    pub(super) fn flush(&mut self) {
        let (waits, broken) = self.control.flush();
        self.output_waits = waits;
        for id in broken {
            self.drop_client(id);
        }
    }

    pub(super) fn drop_client(&mut self, id: u64) {
        if let Some(fd) = self.control.client_fd(id) {
            let _ = self.reactor.remove(fd);
        }
        self.sources.retain(|_, s| !matches!(s, Source::Client(client) if *client == id));
        self.waiters.retain(|w| w.client != id);
        self.control.drop_client(id);
    }
}
