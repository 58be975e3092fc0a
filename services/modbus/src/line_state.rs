//! What functions 8, 11 and 12 tell of one unit on one transport: counters, the log of events, listen-only mode
//! (V1.1b3 clauses 6.8 to 6.10).
//!
//! Every unit has counters of its own, because sub-function 0Ah clears those of the unit it is sent to; what happens on
//! the line is counted for each of them. Counters wrap at 65535 as the registers of the protocol do. The counters
//! of the status are others and never cleared. No clock, no I/O, no allocation.

use crate::protocol::MAX_EVENTS;
use crate::protocol::diagnostics::sub;
use crate::protocol::pdu::Exception;

/// Bits of a log entry (clause 6.10).
mod event {
    /// A request was received ...
    pub const RECEIVE: u8 = 0x80;
    /// ... as broadcast.
    pub const BROADCAST: u8 = 0x40;
    /// Set in both directions while in listen-only mode.
    pub const LISTEN_ONLY: u8 = 0x20;
    /// Characters were lost since the last request.
    pub const OVERRUN: u8 = 0x10;
    /// The line damaged a message since the last request.
    pub const COMMUNICATION_ERROR: u8 = 0x02;
    /// A response was sent, or would have been ...
    pub const SEND: u8 = 0x40;
    /// ... with exception 01 to 03,
    pub const READ_EXCEPTION: u8 = 0x01;
    /// 04,
    pub const ABORT_EXCEPTION: u8 = 0x02;
    /// 05 or 06,
    pub const BUSY_EXCEPTION: u8 = 0x04;
    /// 07.
    pub const NAK_EXCEPTION: u8 = 0x08;
    /// Sub-function 04 put the unit into listen-only mode.
    pub const ENTERED_LISTEN_ONLY: u8 = 0x04;
    /// Sub-function 01 restarted it.
    pub const RESTARTED: u8 = 0x00;
}

/// Bit of the diagnostic register: characters were lost since sub-function 14h or 01.
pub const REGISTER_OVERRUN: u16 = 1;

/// What the line did to a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LineFault {
    /// CRC, LRC, parity, framing, length.
    Damaged,
    /// Characters were lost.
    Overrun,
}

/// What a diagnostic request asks for besides its answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Diagnosed {
    /// Answer with the data of the request.
    Echo,
    /// Answer with this value.
    Value(u16),
    /// No answer.
    Silent,
}

/// Counters and mode of one unit.
#[derive(Clone, Debug)]
pub struct LineState {
    bus_messages: u16,
    communication_errors: u16,
    exceptions: u16,
    server_messages: u16,
    no_responses: u16,
    naks: u16,
    busies: u16,
    overruns: u16,
    events: u16,
    log: [u8; MAX_EVENTS],
    log_next: usize,
    log_len: usize,
    listen_only: bool,
    overrun_flag: bool,
    fault_since_request: u8,
    delimiter: Option<u8>,
}

impl Default for LineState {
    fn default() -> Self {
        Self {
            bus_messages: 0,
            communication_errors: 0,
            exceptions: 0,
            server_messages: 0,
            no_responses: 0,
            naks: 0,
            busies: 0,
            overruns: 0,
            events: 0,
            log: [0; MAX_EVENTS],
            log_next: 0,
            log_len: 0,
            listen_only: false,
            overrun_flag: false,
            fault_since_request: 0,
            delimiter: None,
        }
    }
}

fn count(counter: &mut u16) {
    *counter = counter.wrapping_add(1);
}

impl LineState {
    /// A whole message was on the line, to whomever.
    pub fn bus_message(&mut self) {
        count(&mut self.bus_messages);
    }

    /// The line damaged a message.
    pub fn fault(&mut self, fault: LineFault) {
        match fault {
            LineFault::Damaged => {
                count(&mut self.communication_errors);
                self.fault_since_request |= event::COMMUNICATION_ERROR;
            }
            LineFault::Overrun => {
                count(&mut self.overruns);
                self.overrun_flag = true;
                self.fault_since_request |= event::OVERRUN;
            }
        }
    }

    /// A request to this unit or to all.
    pub fn received(&mut self, broadcast: bool) {
        let mut entry = event::RECEIVE | std::mem::take(&mut self.fault_since_request);
        if broadcast {
            entry |= event::BROADCAST;
        }
        self.push(entry);
    }

    /// The request was processed. `poll`: it only asked for the event counter or log, which counts no event.
    pub fn processed(&mut self, exception: Option<Exception>, poll: bool, answered: bool) {
        count(&mut self.server_messages);
        let mut entry = event::SEND;
        match exception {
            None if !poll => count(&mut self.events),
            None => {}
            Some(exception) => {
                count(&mut self.exceptions);
                entry |= match exception {
                    Exception::IllegalFunction
                    | Exception::IllegalDataAddress
                    | Exception::IllegalDataValue => event::READ_EXCEPTION,
                    Exception::Acknowledge | Exception::ServerDeviceBusy => event::BUSY_EXCEPTION,
                    Exception::NegativeAcknowledge => event::NAK_EXCEPTION,
                    _ => event::ABORT_EXCEPTION,
                };
                match exception {
                    Exception::ServerDeviceBusy => count(&mut self.busies),
                    Exception::NegativeAcknowledge => count(&mut self.naks),
                    _ => {}
                }
            }
        }
        if answered {
            self.push(entry);
        } else {
            count(&mut self.no_responses);
        }
    }

    /// A request to this unit was not processed: it is in listen-only mode.
    pub fn only_listened(&mut self) {
        count(&mut self.no_responses);
    }

    /// Whether the unit only listens.
    pub fn is_listen_only(&self) -> bool {
        self.listen_only
    }

    /// The delimiter that sub-function 03 set since the last call.
    pub fn take_delimiter(&mut self) -> Option<u8> {
        self.delimiter.take()
    }

    fn push(&mut self, entry: u8) {
        let entry = if self.listen_only && entry & (event::RECEIVE | event::SEND) != 0 {
            entry | event::LISTEN_ONLY
        } else {
            entry
        };
        self.log[self.log_next] = entry;
        self.log_next = (self.log_next + 1) % MAX_EVENTS;
        self.log_len = (self.log_len + 1).min(MAX_EVENTS);
    }

    /// Events counted (function 11).
    pub fn event_count(&self) -> u16 {
        self.events
    }

    /// Messages on the line (functions 8/0Bh and 12).
    pub fn message_count(&self) -> u16 {
        self.bus_messages
    }

    /// Writes the log, newest first, and returns its length.
    pub fn copy_log(&self, out: &mut [u8; MAX_EVENTS]) -> usize {
        for (i, slot) in out.iter_mut().enumerate().take(self.log_len) {
            *slot = self.log[(self.log_next + MAX_EVENTS - 1 - i) % MAX_EVENTS];
        }
        self.log_len
    }

    fn clear_counters(&mut self) {
        let Self { log, log_next, log_len, listen_only, overrun_flag, delimiter, .. } = self.clone();
        *self = Self { log, log_next, log_len, listen_only, overrun_flag, delimiter, ..Self::default() };
    }

    /// Carries out function 8. `first` is the first word of its data, which was checked to be legal.
    pub fn diagnose(&mut self, sub_function: u16, first: u16) -> Diagnosed {
        match sub_function {
            sub::RESTART_COMMUNICATIONS => {
                let was_silent = self.listen_only;
                self.clear_counters();
                (self.listen_only, self.overrun_flag) = (false, false);
                self.delimiter = Some(crate::protocol::ascii::LF);
                if first == 0xFF00 {
                    (self.log_next, self.log_len) = (0, 0);
                }
                self.push(event::RESTARTED);
                return if was_silent { Diagnosed::Silent } else { Diagnosed::Echo };
            }
            sub::RETURN_DIAGNOSTIC_REGISTER => {
                return Diagnosed::Value(if self.overrun_flag { REGISTER_OVERRUN } else { 0 });
            }
            sub::CHANGE_ASCII_DELIMITER => self.delimiter = Some(first.to_be_bytes()[0]),
            sub::FORCE_LISTEN_ONLY => {
                self.listen_only = true;
                self.push(event::ENTERED_LISTEN_ONLY);
                return Diagnosed::Silent;
            }
            sub::CLEAR_COUNTERS => {
                self.clear_counters();
                self.overrun_flag = false;
            }
            sub::BUS_MESSAGE_COUNT => return Diagnosed::Value(self.bus_messages),
            sub::BUS_COMMUNICATION_ERROR_COUNT => return Diagnosed::Value(self.communication_errors),
            sub::BUS_EXCEPTION_ERROR_COUNT => return Diagnosed::Value(self.exceptions),
            sub::SERVER_MESSAGE_COUNT => return Diagnosed::Value(self.server_messages),
            sub::SERVER_NO_RESPONSE_COUNT => return Diagnosed::Value(self.no_responses),
            sub::SERVER_NAK_COUNT => return Diagnosed::Value(self.naks),
            sub::SERVER_BUSY_COUNT => return Diagnosed::Value(self.busies),
            sub::BUS_CHARACTER_OVERRUN_COUNT => return Diagnosed::Value(self.overruns),
            sub::CLEAR_OVERRUN => (self.overruns, self.overrun_flag) = (0, false),
            _ => {}
        }
        Diagnosed::Echo
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn log(state: &LineState) -> Vec<u8> {
        let mut out = [0; MAX_EVENTS];
        let len = state.copy_log(&mut out);
        out[..len].to_vec()
    }

    #[test]
    fn counters_and_log() {
        let mut state = LineState::default();
        state.bus_message();
        state.fault(LineFault::Damaged);
        state.fault(LineFault::Overrun);
        state.received(false);
        state.processed(None, false, true);
        state.received(true);
        state.processed(Some(Exception::ServerDeviceBusy), false, false);
        state.received(false);
        state.processed(None, true, true);
        assert_eq!(log(&state), [0x40, 0x80, 0xC0, 0x40, 0x92]);
        for (sub_function, value) in
            [(0x0B, 1), (0x0C, 1), (0x0D, 1), (0x0E, 3), (0x0F, 1), (0x10, 0), (0x11, 1), (0x12, 1), (2, 1)]
        {
            assert_eq!(state.diagnose(sub_function, 0), Diagnosed::Value(value), "{sub_function:02X}");
        }
        assert_eq!(state.event_count(), 1);
        assert_eq!(state.diagnose(0x14, 0), Diagnosed::Echo);
        assert_eq!(
            (state.diagnose(0x12, 0), state.diagnose(2, 0)),
            (Diagnosed::Value(0), Diagnosed::Value(0))
        );
        assert_eq!(state.diagnose(0x0A, 0), Diagnosed::Echo);
        assert_eq!((state.event_count(), state.message_count(), log(&state).len()), (0, 0, 5));
    }

    #[test]
    fn listen_only_ends_by_restart_alone_and_silently() {
        let mut state = LineState::default();
        assert_eq!(state.diagnose(4, 0), Diagnosed::Silent);
        state.received(false);
        state.only_listened();
        assert!(state.is_listen_only());
        assert_eq!(log(&state), [0xA0, 0x04]);
        assert_eq!(state.diagnose(1, 0), Diagnosed::Silent);
        assert!(!state.is_listen_only());
        assert_eq!(log(&state), [0, 0xA0, 0x04]);
        assert_eq!(state.diagnose(1, 0xFF00), Diagnosed::Echo);
        assert_eq!(log(&state), [0]);
    }

    #[test]
    fn the_log_keeps_the_newest_64() {
        let mut state = LineState::default();
        for n in 0..100 {
            state.received(n % 2 == 0);
        }
        assert_eq!(log(&state).len(), 64);
        assert_eq!(log(&state)[..2], [0x80, 0xC0]);
    }
}
