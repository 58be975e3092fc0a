//! The server on one transport: which units it has there, what each of them may be asked by whom, and what the
//! functions for serial lines tell of them.
//!
//! All transports of a service share one image; the state of functions 8, 11 and 12 belongs to a unit on a
//! transport, because it tells of a line. Sans-I/O: a PDU and its sender in, a PDU out.

use crate::identity::Identity;
use crate::line_state::{LineFault, LineState};
use crate::protocol::pdu::{Exception, MAX_PDU, function};
use crate::protocol::rtu::BROADCAST;
use crate::rights::{Peer, Rights};
use crate::server::{Image, Outcome, Unit, answer, refuse};
use std::rc::Rc;

/// The unit identifier that device L and many panels take for "whoever you are".
pub const ANY_UNIT: u8 = 255;
const NO_UNIT: u16 = u16::MAX;

/// What all transports of a server share.
#[derive(Clone, Debug, Default)]
pub struct Shared {
    pub identity: Rc<Identity>,
    pub rights: Rc<Rights>,
    /// Whether functions 7, 8, 11, 12 and 17 are served over Modbus TCP.
    pub serial_codes_on_tcp: bool,
}

impl Shared {
    /// The usual: default identity, everybody may everything, serial codes on TCP.
    pub fn open() -> Self {
        Self { serial_codes_on_tcp: true, ..Self::default() }
    }
}

/// One unit.
#[derive(Clone, Debug)]
struct UnitState {
    /// Its own identifier; `None`: the device itself on TCP, which has many.
    id: Option<u8>,
    map: usize,
    line: LineState,
    /// Carried out the broadcast that is being served.
    took: bool,
}

impl UnitState {
    fn new(id: Option<u8>, map: usize) -> Self {
        Self { id, map, line: LineState::default(), took: false }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Rules {
    /// Units 0 and 255 are the device itself and answered; unknown units get exception 0A (Guide V1.0b).
    Tcp,
    /// Unit 0 is a broadcast, unknown units are somebody else's (V1.02).
    Line { answer_255: bool },
}

/// The server on one transport.
#[derive(Clone, Debug)]
pub struct Device {
    rules: Rules,
    /// Index into `units` by unit identifier.
    slots: Box<[u16; 256]>,
    units: Vec<UnitState>,
    shared: Shared,
}

/// What became of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Served {
    /// It is for another unit on the line.
    NotOurs,
    /// It was for us and is not answered: broadcast, listen-only mode.
    Silent(Option<Outcome>),
    /// The answer is in the caller's buffer.
    Answer(Outcome),
}

impl Device {
    /// A device on TCP. Units of `own` have register maps of their own (unit, index of the map); the device itself
    /// has map 0 and is units 0, 255 and those of `only`, or all others when that is `None`.
    pub fn tcp(only: Option<&[u8]>, own: &[(u8, usize)], shared: Shared) -> Self {
        let mut device = Self::new(Rules::Tcp, shared);
        device.units.push(UnitState::new(None, 0));
        match only {
            None => device.slots.fill(0),
            Some(only) => {
                for &unit in only.iter().chain(&[BROADCAST, ANY_UNIT]) {
                    device.slots[usize::from(unit)] = 0;
                }
            }
        }
        device.add(own);
        device
    }

    /// A device on a serial line, or on a stream that stands for one, with these units and maps. `answer_255`:
    /// unit 255 is the first of them, too.
    pub fn line(units: &[(u8, usize)], answer_255: bool, shared: Shared) -> Self {
        let mut device = Self::new(Rules::Line { answer_255 }, shared);
        device.add(units);
        device
    }

    fn new(rules: Rules, shared: Shared) -> Self {
        Self { rules, slots: Box::new([NO_UNIT; 256]), units: Vec::new(), shared }
    }

    fn add(&mut self, units: &[(u8, usize)]) {
        for &(unit, map) in units {
            self.slots[usize::from(unit)] = self.units.len() as u16;
            self.units.push(UnitState::new(Some(unit), map));
        }
    }

    fn slot(&self, unit: u8) -> Option<usize> {
        if unit == ANY_UNIT && self.rules == (Rules::Line { answer_255: true }) {
            return (!self.units.is_empty()).then_some(0);
        }
        let slot = self.slots[usize::from(unit)];
        (slot != NO_UNIT).then_some(usize::from(slot))
    }

    /// Whether a request to this unit is carried out here.
    pub fn serves(&self, unit: u8) -> bool {
        self.slot(unit).is_some() || self.is_broadcast(unit)
    }

    fn is_broadcast(&self, unit: u8) -> bool {
        unit == BROADCAST && self.rules != Rules::Tcp
    }

    /// The line damaged a message or lost characters.
    pub fn fault(&mut self, fault: LineFault) {
        for unit in &mut self.units {
            unit.line.fault(fault);
        }
    }

    /// The ASCII delimiter that a request has set since the last call.
    pub fn take_delimiter(&mut self) -> Option<u8> {
        self.units.iter_mut().filter_map(|unit| unit.line.take_delimiter()).last()
    }

    /// Serves one undamaged frame that was seen on the transport, to whomever it is.
    pub fn serve(
        &mut self,
        unit: u8,
        pdu: &[u8],
        peer: &Peer,
        image: &mut dyn Image,
        out: &mut [u8; MAX_PDU],
    ) -> Served {
        self.seen();
        if self.is_broadcast(unit) {
            return self.broadcast(pdu, peer, image, out);
        }
        match self.slot(unit) {
            Some(slot) => self.ask(slot, unit, pdu, peer, image, out),
            None if self.rules == Rules::Tcp => {
                let function = pdu.first().copied().unwrap_or(0);
                Served::Answer(refuse(function, Exception::GatewayPathUnavailable, out))
            }
            None => Served::NotOurs,
        }
    }

    /// A message of another unit was on the line, undamaged: it counts, nothing else.
    pub fn seen(&mut self) {
        for unit in &mut self.units {
            unit.line.bus_message();
        }
    }

    /// Every unit carries it out that the rights allow it; units that show the same map do that once.
    fn broadcast(
        &mut self,
        pdu: &[u8],
        peer: &Peer,
        image: &mut dyn Image,
        out: &mut [u8; MAX_PDU],
    ) -> Served {
        let mut last = None;
        let own = pdu.first() == Some(&function::DIAGNOSTICS);
        for slot in 0..self.units.len() {
            let map = self.units[slot].map;
            let done = self.units[..slot].iter().any(|before| before.map == map && before.took);
            let state = &mut self.units[slot];
            state.took = false;
            state.line.received(true);
            if state.line.is_listen_only() && !is_restart(pdu) {
                state.line.only_listened();
                continue;
            }
            if done && !own {
                let exception = last.and_then(|outcome: Outcome| outcome.exception);
                state.line.processed(exception, false, false);
                continue;
            }
            let took = self.allows(slot, BROADCAST, pdu, peer);
            let outcome = self.execute(slot, BROADCAST, pdu, peer, image, out);
            let state = &mut self.units[slot];
            state.took = took;
            state.line.processed(outcome.exception, false, false);
            last = Some(outcome);
        }
        Served::Silent(last)
    }

    fn ask(
        &mut self,
        slot: usize,
        unit: u8,
        pdu: &[u8],
        peer: &Peer,
        image: &mut dyn Image,
        out: &mut [u8; MAX_PDU],
    ) -> Served {
        let state = &mut self.units[slot];
        state.line.received(false);
        if state.line.is_listen_only() && !is_restart(pdu) {
            state.line.only_listened();
            return Served::Silent(None);
        }
        let outcome = self.execute(slot, unit, pdu, peer, image, out);
        let poll =
            matches!(outcome.function, function::GET_COMM_EVENT_COUNTER | function::GET_COMM_EVENT_LOG);
        let answered = outcome.len > 0;
        self.units[slot].line.processed(outcome.exception, poll, answered);
        if answered { Served::Answer(outcome) } else { Served::Silent(Some(outcome)) }
    }

    /// Whether this request may be carried out by this unit. One that does not come under the unit's own identifier
    /// (a broadcast, 255 as "any") has to be allowed under both.
    fn allows(&self, slot: usize, unit: u8, pdu: &[u8], peer: &Peer) -> bool {
        let rights = &self.shared.rights;
        let own = self.units[slot].id.filter(|id| *id != unit);
        rights.allow(peer, unit, pdu) && own.is_none_or(|id| rights.allow(peer, id, pdu))
    }

    fn execute(
        &mut self,
        slot: usize,
        unit: u8,
        pdu: &[u8],
        peer: &Peer,
        image: &mut dyn Image,
        out: &mut [u8; MAX_PDU],
    ) -> Outcome {
        let code = pdu.first().copied().unwrap_or(0);
        let hidden = self.rules == Rules::Tcp
            && !self.shared.serial_codes_on_tcp
            && function::is_serial_line_only(code);
        if hidden || !self.allows(slot, unit, pdu, peer) {
            return refuse(code, Exception::IllegalFunction, out);
        }
        let state = &mut self.units[slot];
        image.select(state.map);
        answer(pdu, &mut Unit { line: &mut state.line, identity: &self.shared.identity }, image, out)
    }
}

/// Function 8, sub-function 1, the only request that listen-only mode lets through.
fn is_restart(pdu: &[u8]) -> bool {
    matches!(pdu, [function::DIAGNOSTICS, 0, 1, ..])
}

#[cfg(test)]
#[path = "device_tests.rs"]
mod tests;
