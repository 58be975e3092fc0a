//! A line with its transport and its requests.

use super::super::config::Config;
use super::super::image::{InputTable, read_request};
use super::super::line::{Failure, Line, Settings, SlotKind};
use super::super::link::{Link, Reports};
use super::super::plan::{Batch, LinePlan, Target};
use super::super::port::{SEND_LIMIT_NS, SerialPort};
use super::{KIND, RunError};
use crate::server::Table;
use ipc_types::Context;
use ipc_types::topic::TopicKind;

pub(super) enum Transport {
    Serial(Box<SerialPort>),
    Tcp(Link),
}

/// What a slot of a line is for.
#[derive(Clone, Copy)]
pub(super) enum Use {
    Batch(usize),
    Write,
}

/// What a slot reads or writes, and whether the unit does it.
pub(super) struct Place {
    pub(super) table: Table,
    pub(super) at: u16,
    pub(super) count: u16,
    /// Function and code of the exception that the last request got.
    pub(super) refused: Option<(u8, u8)>,
}

impl Place {
    pub(super) fn new(table: Table, at: u16, count: u16) -> Self {
        Self { table, at, count, refused: None }
    }

    /// What was not so at the last answer: that it is refused, or no longer.
    pub(super) fn changed(&mut self, refused: Option<(u8, u8)>) -> bool {
        std::mem::replace(&mut self.refused, refused) != refused
    }
}

/// Function and code, if an answer is an exception.
pub(super) fn exception_of(answer: &[u8]) -> Option<(u8, u8)> {
    match *answer {
        [function, code] if function & 0x80 != 0 => Some((function & 0x7F, code)),
        _ => None,
    }
}

pub(super) struct Runner {
    pub(super) plan: LinePlan,
    pub(super) line: Line,
    pub(super) transport: Transport,
    pub(super) uses: Vec<Use>,
    /// Of each slot.
    pub(super) places: Vec<Place>,
    /// Slot of each batch.
    pub(super) batch_slots: Vec<usize>,
    /// Why the link does not work; `None`: it does, or was not needed.
    pub(super) trouble: Option<String>,
    pub(super) connected: bool,
    pub(super) rewrite: Rewrite,
}

/// A server that ends every connection after one answer must not make endless writes of one.
const REWRITE_PAUSE_NS: u64 = 10_000_000_000;

/// When the outputs of a connection are written again because the server may have started again.
#[derive(Default)]
pub(super) struct Rewrite {
    /// It ended the connection, and its outputs have not got their values since.
    pub(super) wanted: bool,
    last_ns: Option<u64>,
}

impl Rewrite {
    /// Whether that is to be done now.
    pub(super) fn take(&mut self, now_ns: u64) -> bool {
        let pause = self.last_ns.is_some_and(|last_ns| now_ns.saturating_sub(last_ns) < REWRITE_PAUSE_NS);
        if !self.wanted || pause {
            return false;
        }
        (self.wanted, self.last_ns) = (false, Some(now_ns));
        true
    }
}

pub(super) fn runner(
    ctx: &mut Context,
    config: &Config,
    i: usize,
    plan: LinePlan,
    reports: &Reports,
) -> Result<Runner, RunError> {
    let turnaround_ns = config.turnaround.ns();
    let (settings, transport) = match &plan.target {
        Target::Serial { service, ascii } => {
            let rx = ctx.subscriber(&TopicKind::SerialRx.of(service))?;
            let tx = ctx.publisher(&TopicKind::SerialTx.of(service))?;
            let port = SerialPort::new(tx, rx, *ascii, ctx.writer, ctx.generation);
            let settings =
                Settings { serial: true, turnaround_ns: Some(turnaround_ns), send_limit_ns: SEND_LIMIT_NS };
            (settings, Transport::Serial(Box::new(port)))
        }
        target => {
            let broadcasts = matches!(target, Target::RtuOverTcp(_));
            let settings = Settings {
                serial: false,
                turnaround_ns: broadcasts.then_some(turnaround_ns),
                send_limit_ns: config.connect_timeout.ns() + 1_000_000_000,
            };
            let link = Link::start(i, target, config.connect_timeout.duration(), reports.clone());
            let Some(link) = link else {
                let message = "it is no connection".to_owned();
                return Err(RunError::Config { kind: KIND, key: "tcp".to_owned(), message });
            };
            (settings, Transport::Tcp(link))
        }
    };
    let mut line = Line::new(settings, config.unit_settings());
    for unit in &plan.units {
        line.set_unit(unit.unit, unit.settings);
    }
    let (mut uses, mut places, mut batch_slots) = (Vec::new(), Vec::new(), Vec::new());
    for (b, batch) in plan.batches.iter().enumerate() {
        let pdu = read_request(batch.table, batch.at, batch.count);
        let slot = line.add_slot(batch.unit, SlotKind::Read, &pdu, Some(batch.period_ns));
        if !batch.enabled {
            line.enable(slot, false, 0);
        }
        batch_slots.push(slot);
        uses.push(Use::Batch(b));
        places.push(Place::new(batch.table, batch.at, batch.count));
    }
    Ok(Runner {
        plan,
        line,
        transport,
        uses,
        places,
        batch_slots,
        trouble: None,
        connected: false,
        rewrite: Rewrite::default(),
    })
}

/// Puts an answer into the inputs. True: the unit does not like the ranges in one request.
pub(super) fn batch_done(
    batch: &Batch,
    result: Result<&[u8], Failure>,
    inputs: &mut InputTable,
    now_ns: u64,
) -> bool {
    let data = match result {
        Ok(&[code, 2 | 3]) if code & 0x80 != 0 && !batch.alone.is_empty() => return true,
        Ok(&[code, _, ref data @ ..]) if code & 0x80 == 0 => Some(data),
        _ => None,
    };
    for &(read, skip) in &batch.members {
        let taken = data.is_some_and(|data| inputs.data(read, data, skip, now_ns));
        if !taken {
            inputs.failed(read);
        }
    }
    false
}

pub(super) fn set_write(runners: &mut [Runner], slots: &[(usize, usize)], i: usize, pdu: &[u8], now_ns: u64) {
    if let Some(&(line, slot)) = slots.get(i) {
        runners[line].line.set_write(slot, pdu, now_ns);
    }
}

pub(super) fn drop_write(runners: &mut [Runner], slots: &[(usize, usize)], i: usize) {
    if let Some(&(line, slot)) = slots.get(i) {
        runners[line].line.drop_write(slot);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_refusal_is_told_once_and_when_it_changes() {
        let mut place = Place::new(Table::HoldingRegisters, 100, 2);
        let said: Vec<bool> = [&[3, 2, 0, 1][..], &[0x83, 2], &[0x83, 2], &[0x83, 3], &[3, 2, 0, 1], &[6, 0]]
            .iter()
            .map(|answer| place.changed(exception_of(answer)))
            .collect();
        assert_eq!(said, [false, true, false, true, true, false]);
        assert_eq!(exception_of(&[0x83, 2]), Some((3, 2)));
    }

    #[test]
    fn outputs_are_written_again_at_once_and_then_not_for_a_while() {
        let mut rewrite = Rewrite::default();
        assert!(!rewrite.take(1));
        rewrite.wanted = true;
        assert!(rewrite.take(1) && !rewrite.take(1));
        rewrite.wanted = true;
        assert!(!rewrite.take(REWRITE_PAUSE_NS));
        assert!(rewrite.take(REWRITE_PAUSE_NS + 1) && !rewrite.take(u64::MAX));
    }
}
