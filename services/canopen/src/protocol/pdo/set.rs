//! All PDOs of a device.

use super::rpdo::Rpdo;
use super::tpdo::Tpdo;
use super::{Direction, PDOS, PdoEvent, role, sub};
use crate::protocol::io::Outbox;
use crate::protocol::od::ObjectDictionary;
use ipc_types::payload::{CanFrame, id_flag};

/// All PDOs of a device, those in the dictionary when it was made.
#[derive(Debug, Clone)]
pub struct Pdos {
    rpdos: Vec<Rpdo>,
    tpdos: Vec<Tpdo>,
    /// `can_id` -> position, ascending; active ones only.
    by_rx_id: Vec<(u32, u16)>,
    by_tx_id: Vec<(u32, u16)>,
    /// `index << 8 | sub` of a mapped object -> position of the TPDO, ascending.
    by_object: Vec<(u32, u16)>,
    operational: bool,
    /// 1019h is not 0.
    counted: bool,
}

fn object_key(index: u16, sub: u8) -> u32 {
    u32::from(index) << 8 | u32::from(sub)
}

fn matching<K: Ord + Copy>(list: &[(K, u16)], key: K) -> &[(K, u16)] {
    let from = list.partition_point(|entry| entry.0 < key);
    let to = list.partition_point(|entry| entry.0 <= key);
    &list[from..to]
}

impl Pdos {
    /// Finds the PDOs of a dictionary: those with communication and mapping parameter.
    pub fn new(od: &ObjectDictionary) -> Self {
        let has = |way: Direction, number: u16| {
            od.object(way.communication(number)).is_some() && od.object(way.mapping(number)).is_some()
        };
        let rpdos: Vec<_> =
            (0..PDOS).filter(|&n| has(Direction::Receive, n)).map(|n| Rpdo::new(od, n)).collect();
        let tpdos: Vec<_> =
            (0..PDOS).filter(|&n| has(Direction::Transmit, n)).map(|n| Tpdo::new(od, n)).collect();
        let objects = tpdos.len() * super::mapping::ENTRIES;
        let mut pdos = Self {
            by_rx_id: Vec::with_capacity(rpdos.len()),
            by_tx_id: Vec::with_capacity(tpdos.len()),
            by_object: Vec::with_capacity(objects),
            rpdos,
            tpdos,
            operational: false,
            counted: false,
        };
        pdos.index(od);
        pdos
    }
    pub fn rpdos(&self) -> &[Rpdo] {
        &self.rpdos
    }
    pub fn tpdos(&self) -> &[Tpdo] {
        &self.tpdos
    }
    fn index(&mut self, od: &ObjectDictionary) {
        self.by_rx_id.clear();
        self.by_tx_id.clear();
        self.by_object.clear();
        for (at, rpdo) in self.rpdos.iter().enumerate().filter(|(_, rpdo)| rpdo.is_active()) {
            self.by_rx_id.push((rpdo.communication.cob.can_id(), at as u16));
        }
        for (at, tpdo) in self.tpdos.iter().enumerate().filter(|(_, tpdo)| tpdo.is_active()) {
            self.by_tx_id.push((tpdo.communication.cob.can_id(), at as u16));
            for entry in tpdo.mapping.entries().filter_map(|entry| od.entry(entry)) {
                self.by_object.push((object_key(entry.index, entry.sub), at as u16));
            }
        }
        self.by_rx_id.sort_unstable();
        self.by_tx_id.sort_unstable();
        self.by_object.sort_unstable();
    }
    /// Reads everything again: after a reset.
    pub fn reload(&mut self, od: &ObjectDictionary) {
        for rpdo in &mut self.rpdos {
            rpdo.load(od);
            rpdo.quiet();
        }
        for tpdo in &mut self.tpdos {
            tpdo.load(od);
            tpdo.quiet();
        }
        self.index(od);
    }
    /// 1019h is in use: SYNC start values count.
    pub fn set_counted(&mut self, counted: bool) {
        self.counted = counted;
    }
    /// A PDO parameter was written.
    pub fn after_write(&mut self, t_ns: u64, od: &ObjectDictionary, index: u16, sub: u8, out: &mut Outbox) {
        let Some((direction, number, is_mapping)) = role(index) else { return };
        match direction {
            Direction::Receive => {
                let Some(rpdo) = self.rpdos.iter_mut().find(|rpdo| rpdo.number == number) else { return };
                rpdo.load(od);
            }
            Direction::Transmit => {
                let operational = self.operational;
                let counted = self.counted;
                let Some(tpdo) = self.tpdos.iter_mut().find(|tpdo| tpdo.number == number) else { return };
                let was_active = tpdo.is_active();
                tpdo.load(od);
                if operational && tpdo.is_active() {
                    if !was_active || (!is_mapping && sub == sub::TRANSMISSION_TYPE) {
                        tpdo.start(t_ns, od, counted, out);
                    } else if !is_mapping && sub == sub::EVENT_TIMER {
                        tpdo.rearm(t_ns);
                    }
                } else {
                    tpdo.quiet();
                }
            }
        }
        self.index(od);
    }
    /// Has this RPDO (0-based) timed out?
    pub fn is_overdue(&self, number: u16) -> bool {
        self.rpdos.iter().any(|rpdo| rpdo.number == number && rpdo.is_overdue())
    }
    /// The node became operational.
    pub fn start(&mut self, t_ns: u64, od: &ObjectDictionary, out: &mut Outbox) {
        self.operational = true;
        for rpdo in &mut self.rpdos {
            rpdo.quiet();
        }
        for tpdo in &mut self.tpdos {
            tpdo.start(t_ns, od, self.counted, out);
        }
    }
    /// The node left operational.
    pub fn stop(&mut self) {
        self.operational = false;
        self.rpdos.iter_mut().for_each(Rpdo::quiet);
        self.tpdos.iter_mut().for_each(Tpdo::quiet);
    }
    /// A frame of the bus: an RPDO, or a request for a TPDO. Tells whether it was one.
    pub fn on_frame(
        &mut self,
        t_ns: u64,
        od: &mut ObjectDictionary,
        frame: &CanFrame,
        in_window: bool,
        out: &mut Outbox,
        event: &mut dyn FnMut(PdoEvent),
    ) -> bool {
        if !self.operational || frame.is_error() {
            return false;
        }
        let id = frame.can_id & !id_flag::RTR;
        if frame.is_remote() {
            let found = matching(&self.by_tx_id, id);
            for &(_, at) in found {
                self.tpdos[usize::from(at)].on_request(t_ns, od, out);
            }
            return !found.is_empty();
        }
        let found = matching(&self.by_rx_id, id);
        for &(_, at) in found {
            self.rpdos[usize::from(at)].on_frame(t_ns, od, frame, in_window, event);
        }
        !found.is_empty()
    }
    /// A SYNC: first the synchronous RPDOs that came before it take effect, then synchronous TPDOs are sampled and
    /// sent.
    pub fn on_sync(
        &mut self,
        t_ns: u64,
        od: &mut ObjectDictionary,
        counter: u8,
        out: &mut Outbox,
        event: &mut dyn FnMut(PdoEvent),
    ) {
        if !self.operational {
            return;
        }
        for rpdo in &mut self.rpdos {
            rpdo.on_sync(od, event);
        }
        for tpdo in self.tpdos.iter_mut().filter(|tpdo| tpdo.is_active()) {
            tpdo.on_sync(t_ns, od, counter, out);
        }
    }
    /// An object changed: TPDOs of type 0, 254 and 255 that map it have their event.
    pub fn object_changed(
        &mut self,
        t_ns: u64,
        od: &ObjectDictionary,
        index: u16,
        sub: u8,
        out: &mut Outbox,
    ) {
        if !self.operational {
            return;
        }
        for &(_, at) in matching(&self.by_object, object_key(index, sub)) {
            self.tpdos[usize::from(at)].trigger(t_ns, od, out);
        }
    }
    /// Several objects changed as one: every TPDO that maps any of them has one event, and goes out once.
    pub fn objects_changed(
        &mut self,
        t_ns: u64,
        od: &ObjectDictionary,
        objects: &[(u16, u8)],
        out: &mut Outbox,
    ) {
        if !self.operational || objects.is_empty() {
            return;
        }
        for &(index, sub) in objects {
            for &(_, at) in matching(&self.by_object, object_key(index, sub)) {
                self.tpdos[usize::from(at)].mark();
            }
        }
        for tpdo in &mut self.tpdos {
            tpdo.trigger_marked(t_ns, od, out);
        }
    }
    /// The application's event for one TPDO (0-based).
    pub fn trigger(&mut self, t_ns: u64, od: &ObjectDictionary, number: u16, out: &mut Outbox) {
        if !self.operational {
            return;
        }
        let found = self.tpdos.iter_mut().find(|tpdo| tpdo.number == number);
        if let Some(tpdo) = found.filter(|tpdo| tpdo.is_active()) {
            tpdo.trigger(t_ns, od, out);
        }
    }
    pub fn next_deadline(&self) -> Option<u64> {
        if !self.operational {
            return None;
        }
        let rpdos = self.rpdos.iter().filter_map(Rpdo::deadline);
        rpdos.chain(self.tpdos.iter().filter(|tpdo| tpdo.is_active()).filter_map(Tpdo::deadline)).min()
    }
    pub fn on_time(
        &mut self,
        t_ns: u64,
        od: &ObjectDictionary,
        out: &mut Outbox,
        event: &mut dyn FnMut(PdoEvent),
    ) {
        if !self.operational {
            return;
        }
        for rpdo in &mut self.rpdos {
            rpdo.on_time(t_ns, event);
        }
        for tpdo in self.tpdos.iter_mut().filter(|tpdo| tpdo.is_active()) {
            tpdo.on_time(t_ns, od, out);
        }
    }
}
