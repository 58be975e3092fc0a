//! Where the mapped objects are in the process image.

use super::One;
use super::pdo::{Direction, Pdo, PdoPlanner};
use crate::config::{MAX_QUEUE, Map, OnBadWord};
use crate::device::Device;
use crate::master::exchange::{Field, RxPdo, TxPdo, transmission};
use crate::place::{self, iec_type};
use crate::protocol::cob_id::CobId;
use crate::protocol::data_type::DataType;
use dinrail_iec::artifact::AreaKind;
use dinrail_iec::{LocatedAddress, parse_address};
use ipc_types::wiring::{Area, ImageRange, OnBad};

/// One `map` entry, resolved.
pub(super) struct Placed {
    pdo: (Direction, u16),
    object: (u16, u8),
    at: LocatedAddress,
    bits: u16,
    data_type: DataType,
    symbol: Option<String>,
    on_bad: OnBad,
    status: Option<u32>,
    /// Values that can wait; 0 = the newest counts.
    queue: u8,
    key: String,
}

impl One<'_> {
    /// Finds place and PDO of one `map` entry.
    pub(super) fn place(
        &mut self,
        device: &Device,
        planner: &mut PdoPlanner<'_>,
        map: &Map,
        key: &str,
    ) -> Option<Placed> {
        let object = match device.resolve(&map.object) {
            Ok(object) => object,
            Err(message) => {
                self.mistakes.add(&format!("{key}.object"), message, "map one of those");
                return None;
            }
        };
        let (direction, text, end) = match (&map.to, &map.from) {
            (Some(to), None) => (Direction::Tpdo, to, "to"),
            (None, Some(from)) => (Direction::Rpdo, from, "from"),
            _ => {
                let help = "to = \"%IB0\" for what the node sends, from = \"%QB0\" for what it receives";
                self.mistakes.add(key, "an object goes to %I or comes from %Q or %M", help);
                return None;
            }
        };
        let end = format!("{key}.{end}");
        let at = match parse_address(text, self.addressing) {
            Ok(at) => at,
            Err(e) => {
                self.mistakes.add(&end, e.to_string(), "write an address like %IB0 or %QX1.0");
                return None;
            }
        };
        let is_input = at.area == AreaKind::Input;
        if is_input != (direction == Direction::Tpdo) {
            let (message, help) = if is_input {
                (
                    format!("{text} is an input; a node receives what comes from %Q or %M"),
                    "use to = for what it sends",
                )
            } else {
                (
                    format!("{text} is no input; what a node sends goes to %I"),
                    "use from = for what it receives",
                )
            };
            self.mistakes.add(&end, message, help);
            return None;
        }
        let number = planner.place(direction, object, &format!("{key}.object"), self.mistakes)?;
        let entry = device.od.find(object.0, object.1).ok().and_then(|e| device.od.entry(e))?;
        if let Err(message) = place::fits(entry, at, text) {
            self.mistakes.add(&end, message, "take a larger place: B has 8 bits, W 16, D 32, L 64");
            return None;
        }
        let bits = u32::from(entry.pdo_bits().unwrap_or(0));
        let queue = self.queue(map, direction, key);
        let status =
            map.status_to.as_ref().and_then(|text| self.status_byte(text, &format!("{key}.status_to")));
        Some(Placed {
            pdo: (planner.pdos[number].direction, planner.pdos[number].number),
            object,
            at,
            bits: bits as u16,
            data_type: entry.data_type,
            symbol: map.symbol.clone(),
            on_bad: if map.on_bad == OnBadWord::Zero { OnBad::Zero } else { OnBad::Hold },
            status,
            queue,
            key: end,
        })
    }

    fn queue(&mut self, map: &Map, direction: Direction, key: &str) -> u8 {
        let Some(queue) = map.queue else { return 0 };
        let key = format!("{key}.queue");
        if direction != Direction::Tpdo {
            let help = "leave it out: a node receives the newest value";
            self.mistakes.add(&key, "queue is for what a node sends", help);
        } else if !(1..=MAX_QUEUE).contains(&queue) {
            let message = format!("a queue of {queue} values is not possible");
            self.mistakes.add(&key, message, format!("take 1 to {MAX_QUEUE}, or leave it out"));
        }
        queue.clamp(1, MAX_QUEUE) as u8
    }

    /// The queue that all points of a PDO agree on; 0 = none.
    fn queue_of(&mut self, pdo: &Pdo, points: &[&Placed]) -> u8 {
        let queue = points.iter().map(|p| p.queue).max().unwrap_or(0);
        let Some(other) = points.iter().find(|p| p.queue != queue) else { return queue };
        let with = points.iter().find(|p| p.queue == queue).map_or(other.key.as_str(), |p| p.key.as_str());
        let what = format!("{} {} of node {}", pdo.direction.name(), pdo.number, self.node.id);
        let message = if other.queue == 0 {
            format!("{what} has points with and without queue, and a PDO moves whole")
        } else {
            format!("{what} has points with queue = {} and {queue}, and a PDO moves whole", other.queue)
        };
        let key = format!("{}.queue", with.trim_end_matches(".to"));
        let help = "give all points of the PDO the same queue, or map those without it in another PDO";
        self.mistakes.add(&key, message, help);
        queue
    }

    pub(super) fn status_byte(&mut self, text: &str, key: &str) -> Option<u32> {
        match parse_address(text, self.addressing) {
            Ok(at) if at.area == AreaKind::Input && at.size.bits() == 8 => Some(at.byte),
            _ => {
                let message = format!("{text} is no byte of %I");
                self.mistakes.add(key, message, "write an address like %IB10");
                None
            }
        }
    }

    /// `status_to` of the node: its NMT state as a range of %I.
    pub(super) fn state_range(&mut self) {
        let Some(text) = &self.node.status_to else { return };
        let key = format!("{}.status_to", self.key);
        let Some(byte) = self.status_byte(text, &key) else { return };
        let range = self.plan.inputs.len() as u16;
        let at = self.plan.exchange.input_bytes.iter().map(|&n| u32::from(n)).sum();
        self.plan.exchange.states.push((self.node.id, at, range));
        self.plan.exchange.input_bytes.push(1);
        self.plan.inputs.push(ImageRange {
            area: Area::Input,
            byte,
            bit: None,
            bytes: 1,
            type_name: Some("USINT".to_owned()),
            symbol: None,
            label: format!("{} node {} NMT state", self.me, self.node.id),
            key,
            on_bad: OnBad::Zero,
            status_byte: None,
        });
    }

    /// Puts the placed objects into the exchange and the wiring.
    pub(super) fn fields(&mut self, device: &Device, pdos: &[Pdo], placed: &[Placed]) {
        for pdo in pdos.iter().filter(|p| p.used && p.is_active()) {
            let mut fields = Vec::new();
            let points: Vec<&Placed> =
                placed.iter().filter(|p| p.pdo == (pdo.direction, pdo.number)).collect();
            for placed in &points {
                let Some(bit) = pdo.bit_of(placed.object.0, placed.object.1) else { continue };
                fields.push(self.field(device, pdo, placed, bit));
            }
            if fields.is_empty() {
                continue;
            }
            let queue = self.queue_of(pdo, &points);
            let cob_id = CobId(pdo.cob_id).can_id();
            let event_ns = Some(u64::from(pdo.event) * 1_000_000).filter(|&ns| ns > 0);
            if pdo.direction == Direction::Tpdo {
                if queue > 0 {
                    self.plan.exchange.queues.push((self.plan.exchange.rx.len() as u16, queue));
                }
                let polled = matches!(pdo.transmission, transmission::RTR | transmission::SYNC_RTR);
                self.plan.exchange.rx.push(RxPdo {
                    cob_id,
                    node: self.node.id,
                    length: pdo.bytes(),
                    transmission: pdo.transmission,
                    // An event-driven PDO with an event timer must come at least that often.
                    deadline_ns: event_ns
                        .filter(|_| pdo.transmission >= transmission::EVENT_MANUFACTURER)
                        .map(|ns| 3 * ns),
                    poll_ns: if polled { event_ns.or(Some(100_000_000)) } else { None },
                    fields,
                });
            } else {
                self.plan.exchange.tx.push(TxPdo {
                    cob_id,
                    node: self.node.id,
                    length: pdo.bytes(),
                    transmission: pdo.transmission,
                    inhibit_ns: u64::from(pdo.inhibit) * 100_000,
                    event_ns,
                    fields,
                });
            }
        }
    }

    pub(super) fn field(&mut self, device: &Device, pdo: &Pdo, placed: &Placed, pdo_bit: u16) -> Field {
        let bytes = placed.at.size.bytes() as u8;
        let (index, sub) = placed.object;
        let name = device.name_of(index, sub).unwrap_or("object");
        let mut what = format!(
            "node {} {index:04X}:{sub:02X} {name}, {} {}",
            self.node.id,
            pdo.direction.name(),
            pdo.number
        );
        if placed.queue > 0 {
            what.push_str(&format!(", queue of {}", placed.queue));
        }
        let range = ImageRange {
            area: match placed.at.area {
                AreaKind::Input => Area::Input,
                AreaKind::Output => Area::Output,
                AreaKind::Marker | AreaKind::Retain | AreaKind::Data => Area::Marker,
            },
            byte: placed.at.byte,
            bit: placed.at.bit,
            bytes: placed.at.size.bytes(),
            type_name: Some(iec_type(placed.data_type, placed.at).to_owned()),
            symbol: placed.symbol.clone(),
            label: what,
            key: placed.key.clone(),
            on_bad: placed.on_bad,
            status_byte: placed.status,
        };
        let signed = placed.data_type.is_signed();
        if pdo.direction == Direction::Tpdo {
            let at = self.plan.exchange.input_bytes.iter().map(|&n| u32::from(n)).sum();
            let number = self.plan.inputs.len() as u16;
            self.plan.exchange.input_bytes.push(bytes);
            self.plan.inputs.push(range);
            Field { pdo_bit, bits: placed.bits, at, bytes, signed, range: number }
        } else {
            let at = self.plan.exchange.output_bytes as u32;
            self.plan.exchange.output_bytes += usize::from(bytes);
            self.plan.outputs.push(range);
            Field { pdo_bit, bits: placed.bits, at, bytes, signed, range: 0 }
        }
    }
}
