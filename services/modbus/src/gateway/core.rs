//! The gateway without its sockets and ports: requests of many masters in, frames of few lines out, answers back.
//!
//! Virtual time. What a request may get without the line: exception 0A (the unit is not mapped, or the port is
//! gone), 06 (a queue is full, or it waited for longer than `max_wait`), 0B (the unit is known to be silent, or
//! nobody can answer), 03 (no PDU), or a cached answer. What the line makes of it: the unit's answer as it is, or 0B.
//! A damaged frame is no answer; 04 is never the gateway's own.

use super::cache::Cache;
use crate::client::line::{
    Failure, Line, LineCounters, Origin, Settings, SlotKind, Step, UnitNews, UnitSettings, UnitState,
    UnitView,
};
use crate::protocol::pdu::{EXCEPTION_BIT, Exception, MAX_PDU};
use serde::Serialize;

/// Most requests of one master that wait for answers (Guide V1.0b: a server takes 1 to 16 transactions at once).
pub const MAX_PER_CLIENT: usize = 16;
/// Most lines of a gateway.
pub const MAX_LINES: usize = 8;

/// What is true for a line of the gateway.
#[derive(Debug, Clone, Copy)]
pub struct LineSetup {
    pub settings: Settings,
    pub unit: UnitSettings,
    /// Requests that may wait, at most [`crate::client::line::MAX_JOBS`].
    pub queue: usize,
}

/// How the gateway answers for all lines.
#[derive(Debug, Clone, Copy)]
pub struct Rules {
    /// A request that waited for longer gets exception 06.
    pub max_wait_ns: u64,
    /// A broadcast gets the answer that a unit would have given, once it is sent.
    pub answer_broadcasts: bool,
}

/// What the owner has to do.
#[derive(Debug, PartialEq, Eq)]
pub enum GatewayStep<'a> {
    /// Send this on the line.
    Send { unit: u8, pdu: &'a [u8] },
    /// Send this to the client; it may have gone.
    Reply { client: u64, transaction: u16, unit: u8, pdu: &'a [u8] },
    /// Nothing before this time, unless something happens.
    Wait(Option<u64>),
}

/// Counters of the gateway.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct GatewayCounters {
    pub requests: u64,
    /// Answers of units passed on, their exceptions too.
    pub forwarded: u64,
    pub cached: u64,
    pub broadcasts: u64,
    /// Exception 0A: not mapped, or the port is gone.
    pub no_path: u64,
    /// Exception 0B.
    pub no_answer: u64,
    /// Exception 06.
    pub busy: u64,
    /// Answers whose master had gone.
    pub orphaned: u64,
}

struct Ticket {
    /// `None`: gone.
    client: Option<u64>,
    transaction: u16,
    /// As the master named it.
    unit: u8,
    broadcast: bool,
    /// Holds a cached range back while it is under way.
    write: bool,
    pdu: [u8; MAX_PDU],
    len: u8,
    /// Job of the line: place and how often the place was used before.
    used: u32,
    busy: bool,
}

struct Lane {
    line: Line,
    queue: usize,
}

/// See the module.
pub struct Core {
    rules: Rules,
    routes: [Option<(u8, u8)>; 256],
    lanes: Vec<Lane>,
    tickets: Vec<Ticket>,
    cache: Cache,
    /// What [`Core::step`] lends out.
    out: [u8; MAX_PDU],
    counters: GatewayCounters,
}

impl Core {
    /// `routes`: for each unit id of TCP its line and unit there.
    pub fn new(rules: Rules, lines: &[LineSetup], routes: [Option<(u8, u8)>; 256], mut cache: Cache) -> Self {
        let mut lanes: Vec<Lane> = lines
            .iter()
            .map(|setup| Lane { line: Line::new(setup.settings, setup.unit), queue: setup.queue })
            .collect();
        cache.add_slots(|line, unit, pdu, period_ns| {
            lanes.get_mut(line).map(|lane| lane.line.add_slot(unit, SlotKind::Read, pdu, Some(period_ns)))
        });
        Self {
            rules,
            routes,
            lanes,
            tickets: Vec::with_capacity(64),
            cache,
            out: [0; MAX_PDU],
            counters: GatewayCounters::default(),
        }
    }

    pub fn counters(&self) -> GatewayCounters {
        self.counters
    }
    /// Counters of a line.
    pub fn line_counters(&self, line: usize) -> LineCounters {
        self.lanes.get(line).map_or_else(LineCounters::default, |lane| lane.line.counters())
    }
    /// Units of a line that were asked.
    pub fn units(&self, line: usize) -> impl Iterator<Item = UnitView> + '_ {
        self.lanes.get(line).into_iter().flat_map(|lane| lane.line.units())
    }
    /// Requests that wait for a line.
    pub fn waiting(&self, line: usize) -> usize {
        self.lanes.get(line).map_or(0, |lane| lane.line.jobs())
    }
    /// Number of lines.
    pub fn lines(&self) -> usize {
        self.lanes.len()
    }
    /// Requests of a client that wait for answers.
    pub fn outstanding(&self, client: u64) -> usize {
        self.tickets.iter().filter(|t| t.busy && t.client == Some(client)).count()
    }

    fn refuse(&mut self, function: u8, exception: Exception) -> &[u8] {
        *match exception {
            Exception::GatewayPathUnavailable => &mut self.counters.no_path,
            Exception::ServerDeviceBusy => &mut self.counters.busy,
            _ => &mut self.counters.no_answer,
        } += 1;
        self.out[..2].copy_from_slice(&[function | EXCEPTION_BIT, exception.code()]);
        &self.out[..2]
    }

    /// A request of a master. `Some`: the answer is known at once. `None`: it comes by [`Core::step`] of the line,
    /// or never (a broadcast).
    pub fn request(
        &mut self,
        client: u64,
        transaction: u16,
        unit: u8,
        pdu: &[u8],
        now_ns: u64,
    ) -> Option<&[u8]> {
        self.counters.requests += 1;
        let function = pdu.first().copied().unwrap_or(0) & !EXCEPTION_BIT;
        if pdu.is_empty() || pdu.len() > MAX_PDU {
            self.out[..2].copy_from_slice(&[function | EXCEPTION_BIT, Exception::IllegalDataValue.code()]);
            return Some(&self.out[..2]);
        }
        let Some((line, on_line)) = self.routes[usize::from(unit)] else {
            return Some(self.refuse(function, Exception::GatewayPathUnavailable));
        };
        let line = usize::from(line);
        if let Some(len) = self.cache.answer(line, on_line, pdu, now_ns, &mut self.out) {
            self.counters.cached += 1;
            return Some(&self.out[..len]);
        }
        let write = is_write(function);
        let broadcast = on_line == 0;
        if broadcast && !write && function != 8 {
            return Some(self.refuse(function, Exception::GatewayTargetFailedToRespond));
        }
        let Some(lane) = self.lanes.get(line) else {
            return Some(self.refuse(function, Exception::GatewayPathUnavailable));
        };
        if lane.line.jobs() >= lane.queue || self.outstanding(client) >= MAX_PER_CLIENT {
            return Some(self.refuse(function, Exception::ServerDeviceBusy));
        }
        let deadline_ns = now_ns.saturating_add(self.rules.max_wait_ns);
        let ticket = self.ticket(client, transaction, unit, pdu);
        self.tickets[ticket].broadcast = broadcast;
        self.tickets[ticket].write = write;
        let id = self.id(ticket);
        if self.lanes[line].line.push_job(id, on_line, pdu, deadline_ns, true).is_err() {
            self.tickets[ticket].busy = false;
            return Some(self.refuse(function, Exception::ServerDeviceBusy));
        }
        if write {
            self.cache.write_begins(line, on_line);
        }
        None
    }

    fn id(&self, ticket: usize) -> u64 {
        u64::from(self.tickets[ticket].used) << 32 | ticket as u64
    }

    fn ticket(&mut self, client: u64, transaction: u16, unit: u8, pdu: &[u8]) -> usize {
        let mut bytes = [0; MAX_PDU];
        bytes[..pdu.len()].copy_from_slice(pdu);
        let new = Ticket {
            client: Some(client),
            transaction,
            unit,
            broadcast: false,
            write: false,
            pdu: bytes,
            len: pdu.len() as u8,
            used: 0,
            busy: true,
        };
        match self.tickets.iter().position(|t| !t.busy) {
            Some(i) => {
                let used = self.tickets[i].used.wrapping_add(1);
                self.tickets[i] = Ticket { used, ..new };
                i
            }
            None => {
                self.tickets.push(new);
                self.tickets.len() - 1
            }
        }
    }

    /// A master has gone: what it has waiting is forgotten, what is under way goes on unheard.
    pub fn client_gone(&mut self, client: u64) {
        for i in 0..self.tickets.len() {
            if !self.tickets[i].busy || self.tickets[i].client != Some(client) {
                continue;
            }
            self.tickets[i].client = None;
            let id = self.id(i);
            let Some((line, on_line)) = self.routes[usize::from(self.tickets[i].unit)] else { continue };
            if self.lanes[usize::from(line)].line.cancel(id) {
                self.tickets[i].busy = false;
                if self.tickets[i].write {
                    self.cache.write_ends(usize::from(line), on_line);
                }
            }
        }
    }

    /// See [`Line::sent`].
    pub fn sent(&mut self, line: usize, now_ns: u64) {
        if let Some(lane) = self.lanes.get_mut(line) {
            lane.line.sent(now_ns);
        }
    }
    /// See [`Line::answer`].
    pub fn answer(&mut self, line: usize, unit: u8, pdu: &[u8], now_ns: u64) {
        if let Some(lane) = self.lanes.get_mut(line) {
            lane.line.answer(unit, pdu, now_ns);
        }
    }
    /// See [`Line::garbage`].
    pub fn garbage(&mut self, line: usize) {
        if let Some(lane) = self.lanes.get_mut(line) {
            lane.line.garbage();
        }
    }
    /// See [`Line::link_failed`].
    pub fn link_failed(&mut self, line: usize, now_ns: u64) {
        if let Some(lane) = self.lanes.get_mut(line) {
            lane.line.link_failed(now_ns);
        }
    }
    /// See [`Line::unit_news`].
    pub fn unit_news(&mut self, line: usize) -> Option<UnitNews> {
        self.lanes.get_mut(line)?.line.unit_news()
    }
    /// State of a unit of a line.
    pub fn unit_state(&self, line: usize, unit: u8) -> UnitState {
        self.lanes.get(line).map_or(UnitState::Unknown, |lane| lane.line.unit_state(unit))
    }

    /// What is to be done for a line now; to be called until it says [`GatewayStep::Wait`].
    pub fn step(&mut self, line: usize, now_ns: u64) -> GatewayStep<'_> {
        loop {
            let Some(lane) = self.lanes.get_mut(line) else { return GatewayStep::Wait(None) };
            let (origin, on_line, result) = match lane.line.step(now_ns) {
                Step::Wait(until) => return GatewayStep::Wait(until),
                Step::Reset => continue,
                Step::Send { unit, pdu, .. } => {
                    self.out[..pdu.len()].copy_from_slice(pdu);
                    let len = pdu.len();
                    return GatewayStep::Send { unit, pdu: &self.out[..len] };
                }
                Step::Done { origin, unit, result } => {
                    let result = result.map(|pdu| {
                        let len = pdu.len().min(MAX_PDU);
                        self.out[..len].copy_from_slice(&pdu[..len]);
                        len
                    });
                    (origin, unit, result)
                }
            };
            match origin {
                Origin::Slot(slot) => {
                    let data = result.ok().map(|len| &self.out[..len]);
                    self.cache.polled(line, slot, data, now_ns);
                }
                Origin::Job(id) => {
                    let i = (id & 0xFFFF_FFFF) as usize;
                    if self.tickets.get(i).is_none_or(|t| !t.busy || u64::from(t.used) != id >> 32) {
                        continue;
                    }
                    self.tickets[i].busy = false;
                    if self.tickets[i].write {
                        self.cache.write_ends(line, on_line);
                    }
                    let Some(len) = self.settle(i, result) else { continue };
                    let Ticket { client, transaction, unit, .. } = self.tickets[i];
                    let Some(client) = client else {
                        self.counters.orphaned += 1;
                        continue;
                    };
                    return GatewayStep::Reply { client, transaction, unit, pdu: &self.out[..len] };
                }
            }
        }
    }

    /// The answer of a finished request in `out`; `None`: none is given.
    fn settle(&mut self, ticket: usize, result: Result<usize, Failure>) -> Option<usize> {
        let ticket = &self.tickets[ticket];
        let function = ticket.pdu[0] & !EXCEPTION_BIT;
        match result {
            Ok(0) if ticket.broadcast => {
                self.counters.broadcasts += 1;
                if !self.rules.answer_broadcasts {
                    return None;
                }
                // As a unit would have confirmed it: functions 15 and 16 repeat address and quantity, the others all.
                let len = if matches!(function, 15 | 16) { 5 } else { usize::from(ticket.len) };
                self.out[..len].copy_from_slice(&ticket.pdu[..len]);
                Some(len)
            }
            Ok(len) => {
                self.counters.forwarded += 1;
                Some(len)
            }
            Err(failure) => {
                let exception = match failure {
                    Failure::Link => Exception::GatewayPathUnavailable,
                    Failure::Expired => Exception::ServerDeviceBusy,
                    Failure::NoAnswer | Failure::UnitDown | Failure::Mismatch => {
                        Exception::GatewayTargetFailedToRespond
                    }
                };
                Some(self.refuse(function, exception).len())
            }
        }
    }
}

/// Whether a function changes what others may read.
fn is_write(function: u8) -> bool {
    !matches!(function, 1..=4 | 7 | 8 | 11 | 12 | 17 | 20 | 24 | 43)
}

#[cfg(test)]
#[path = "core_tests.rs"]
mod tests;
