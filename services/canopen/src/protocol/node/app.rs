//! The owner's side of a node: values, errors, states.

use super::{Node, NodeEvent};
use crate::protocol::abort::Abort;
use crate::protocol::emcy::{self, Emcy};
use crate::protocol::io::Outbox;
use crate::protocol::nmt::NmtState;
use crate::protocol::od::{EntryRef, ObjectDictionary};
use crate::protocol::pdo::Pdos;
use crate::protocol::time_stamp::TimeOfDay;

impl Node {
    pub fn node_id(&self) -> u8 {
        self.com.node_id
    }
    pub fn state(&self) -> NmtState {
        self.com.nmt.state()
    }
    /// The dictionary, to look up objects.
    pub fn od(&self) -> &ObjectDictionary {
        &self.od
    }
    /// The PDOs, to show them.
    pub fn pdos(&self) -> &Pdos {
        &self.com.pdos
    }
    /// The next event.
    pub fn next_event(&mut self) -> Option<NodeEvent> {
        self.com.events.next()
    }
    /// Events lost because the owner did not take them.
    pub fn events_dropped(&self) -> u64 {
        self.com.events.dropped
    }
    /// A value, whatever its access.
    pub fn read(&self, index: u16, sub: u8) -> Result<&[u8], Abort> {
        Ok(self.od.get(self.od.find(index, sub)?))
    }
    /// A value by its handle.
    pub fn get(&self, entry: EntryRef) -> &[u8] {
        self.od.get(entry)
    }
    /// Writes as the device itself, read-only objects too. A value that changed is the event of TPDOs that map it
    /// (types 0, 254, 255); objects of the communication profile take effect.
    pub fn write(
        &mut self,
        t_ns: u64,
        index: u16,
        sub: u8,
        data: &[u8],
        out: &mut Outbox,
    ) -> Result<(), Abort> {
        let entry = self.od.find(index, sub)?;
        self.set(t_ns, entry, data, out)
    }
    /// [`Self::write`] by handle.
    pub fn set(&mut self, t_ns: u64, entry: EntryRef, data: &[u8], out: &mut Outbox) -> Result<(), Abort> {
        if self.od.get(entry) == data {
            return self.od.check_length(entry, data.len());
        }
        self.od.set(entry, data)?;
        let Some((index, sub)) = self.od.entry(entry).map(|entry| (entry.index, entry.sub)) else {
            return Ok(());
        };
        let communication = (0x1000..=0x1FFF).contains(&index);
        if communication && (self.state() != NmtState::Initialising || index == super::object::IDENTITY) {
            self.apply(t_ns, index, sub, out);
            self.flush(t_ns, out);
        }
        self.com.pdos.object_changed(t_ns, &self.od, index, sub, out);
        Ok(())
    }
    /// Sets a value without an event: several values that shall go out as one PDO are set like this, then
    /// [`Self::changed`] is called once.
    pub fn set_quietly(&mut self, entry: EntryRef, data: &[u8]) -> Result<(), Abort> {
        self.od.set(entry, data)
    }
    /// One event of the TPDOs that map any of these objects, whether their values changed or not: a TPDO that maps
    /// several of them goes out once.
    pub fn changed(&mut self, t_ns: u64, objects: &[(u16, u8)], out: &mut Outbox) {
        self.com.pdos.objects_changed(t_ns, &self.od, objects, out);
    }
    /// The event of one TPDO (0-based).
    pub fn trigger_tpdo(&mut self, t_ns: u64, number: u16, out: &mut Outbox) {
        self.com.pdos.trigger(t_ns, &self.od, number, out);
    }
    /// An error of the application has come: EMCY, 1001h, 1003h. `source` tells errors of one code apart; codes of
    /// the stack itself (81xxh, 82xxh) are better left to it. Nothing happens if it is already there.
    pub fn raise(
        &mut self,
        t_ns: u64,
        code: u16,
        source: u16,
        register: u8,
        info: [u8; 5],
        out: &mut Outbox,
    ) {
        self.com.raise(code, source, register, info);
        self.flush(t_ns, out);
    }
    /// The error has gone.
    pub fn clear(&mut self, t_ns: u64, code: u16, source: u16, out: &mut Outbox) {
        self.com.clear(code, source);
        self.flush(t_ns, out);
    }
    /// What the bus driver says of the controller: EMCY 8120h while error passive.
    pub fn error_passive(&mut self, t_ns: u64, passive: bool, out: &mut Outbox) {
        if passive {
            self.raise(t_ns, emcy::code::ERROR_PASSIVE, 0, emcy::register::COMMUNICATION, [0; 5], out);
        } else {
            self.clear(t_ns, emcy::code::ERROR_PASSIVE, 0, out);
        }
    }
    /// The controller was bus-off and is back: the error behaviour of 1029h, then EMCY 8140h.
    pub fn bus_off_recovered(&mut self, t_ns: u64, out: &mut Outbox) {
        self.communication_error(t_ns, out);
        let message =
            self.com.emcy.report(emcy::code::BUS_OFF_RECOVERED, emcy::register::COMMUNICATION, [0; 5]);
        self.com.events.push(NodeEvent::EmcyRaised(message));
        self.flush(t_ns, out);
    }
    /// The device itself failed, e.g. its outputs cannot be served: the error behaviour of 1029h sub 2 (output error in
    /// CiA 401), or of sub 1 where the device has no other. The EMCY is raised apart.
    pub fn device_failed(&mut self, t_ns: u64, out: &mut Outbox) {
        let sub = if self.od.find(super::object::ERROR_BEHAVIOUR, 2).is_ok() { 2 } else { 1 };
        self.error_behaviour(t_ns, sub, out);
        self.flush(t_ns, out);
    }
    /// The stored image could not be kept: EMCY 6300h until it could.
    pub fn store_failed(&mut self, t_ns: u64, failed: bool, out: &mut Outbox) {
        if failed {
            self.raise(t_ns, emcy::code::STORAGE, 0, emcy::register::GENERIC, [0; 5], out);
        } else {
            self.clear(t_ns, emcy::code::STORAGE, 0, out);
        }
    }
    /// What is stored by 1010h; empty: nothing.
    pub fn store_image(&self) -> &[u8] {
        self.com.store.image()
    }
    /// Error register 1001h.
    pub fn error_register(&self) -> u8 {
        self.com.emcy.register()
    }
    /// 1003h, newest first.
    pub fn error_history(&self) -> &[u32] {
        self.com.emcy.history()
    }
    /// Sends TIME, if 1012h says that the device produces it and the state lets it. Tells whether it did.
    pub fn send_time(&self, time: TimeOfDay, out: &mut Outbox) -> bool {
        self.state().communicates() && self.com.time.produce(time, out)
    }
    /// State of a node that 1016h watches; None: lost, never heard, or not watched.
    pub fn state_of(&self, node_id: u8) -> Option<NmtState> {
        self.com.consumer.state(node_id)
    }
    /// Last EMCY that would be sent for the history's newest entry: its code, 0 if there is none.
    pub fn last_error(&self) -> Option<Emcy> {
        let value = *self.error_history().first()?;
        let [a, b, c, d] = value.to_le_bytes();
        Some(Emcy {
            code: u16::from_le_bytes([a, b]),
            register: self.error_register(),
            info: [c, d, 0, 0, 0],
        })
    }
}
