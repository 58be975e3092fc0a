//! The register map on the rail: what [`crate::server::answer`] reads and writes in a running stack.
//!
//! Reads come from the [`View`]; writes become one [`ipc_types::payload::ImageWrite`] each, or go into the part of %I that the
//! server owns. The rail itself is behind the trait [`Rail`], so that all of this is tested without one.

use crate::buffers::Buffers;
use crate::config::OnStop;
use crate::map::{Destination, Memory, RegisterMap};
use crate::protocol::files::{self, MAX_FIFO};
use crate::protocol::pdu::Exception;
use crate::server::{Access, Image, Table, Write};
use crate::tcp::Backend;
use crate::view::View;
use crate::watchdog::{Watchdog, WatchdogState};
use crate::write_set::WriteSet;
use ipc_types::image_write::Builder;
use ipc_types::payload::{self, PlcState, Quality};
use ipc_types::wiring::Area;
use std::net::{IpAddr, SocketAddr};

/// Owned inputs are sent again after this time, because a late reader only gets them then.
const RESEND_NS: u64 = 100_000_000;

/// Why a write was not queued.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NotQueued {
    /// The PLC's queue is full.
    Full,
    /// Nobody reads the queue, or the rail failed.
    NoReader,
}

/// The ports of the service.
pub trait Rail {
    /// CLOCK_MONOTONIC in ns.
    fn now_ns(&self) -> u64;
    /// Hands over the newest image if there is one not seen yet.
    fn newest(&mut self, take: &mut dyn FnMut(&payload::Image, &[u8]));
    /// Queues a write to the PLC; its `seq`.
    fn write(&mut self, write: &Builder) -> Result<u64, NotQueued>;
    /// Publishes the owned part of %I: bytes of all ranges, then their qualities. `false` when it failed.
    fn publish_inputs(&mut self, ranges: u32, data_t_ns: u64, tail: &[u8]) -> bool;
}

/// Counters of writes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct WriteCounters {
    /// Queued to the PLC.
    pub queued: u64,
    /// Refused with exception 06: queue full.
    pub full: u64,
    /// Refused with exception 04: nobody takes them.
    pub no_reader: u64,
    /// Into the server's own part of %I.
    pub own: u64,
}

/// Bytes before the first client in the list of clients: their number.
const CLIENTS_HEAD: usize = 2;
/// Bytes of one client in the list: its address, its port.
const CLIENT_BYTES: usize = 6;

/// Bytes of a list of so many clients.
pub fn client_list_bytes(slots: u32) -> u32 {
    CLIENTS_HEAD as u32 + slots * CLIENT_BYTES as u32
}

/// A bit of the image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BitPlace {
    pub area: Area,
    pub byte: u32,
    pub bit: u8,
}

/// The part of %I that the server owns.
struct OwnInputs {
    /// Byte offset and length; the ones that clients write first.
    ranges: Vec<(u32, u32)>,
    /// Whether the last range is the list of clients.
    has_list: bool,
    /// All of %I up to the end of the last range, only the ranges used.
    bytes: Vec<u8>,
    tail: Vec<u8>,
    quality: Quality,
    data_t_ns: u64,
    sent_ns: u64,
    dirty: bool,
}

impl OwnInputs {
    fn new(mut ranges: Vec<(u32, u32)>, list: Option<(u32, u32)>) -> Self {
        ranges.extend(list);
        let end = ranges.iter().map(|(start, len)| start + len).max().unwrap_or(0) as usize;
        let tail = ranges.iter().map(|(_, len)| *len as usize + 1).sum();
        Self {
            ranges,
            has_list: list.is_some(),
            bytes: vec![0; end],
            tail: Vec::with_capacity(tail),
            quality: Quality::NoData,
            data_t_ns: 0,
            sent_ns: 0,
            dirty: true,
        }
    }

    fn write(&mut self, set: &WriteSet, now_ns: u64) {
        for run in set.runs() {
            let _ = run.op().apply(&mut self.bytes);
        }
        self.data_t_ns = now_ns;
        self.quality = Quality::Good;
        self.dirty = true;
    }

    /// Writes number, addresses and ports of the clients; of IPv6 the address is 0.0.0.0.
    fn list(&mut self, clients: impl Iterator<Item = SocketAddr>, now_ns: u64) {
        let Some(&(start, len)) = self.ranges.last().filter(|_| self.has_list) else { return };
        let Some(bytes) = self.bytes.get_mut(start as usize..(start + len) as usize) else { return };
        let Some((head, slots)) = bytes.split_first_chunk_mut::<CLIENTS_HEAD>() else { return };
        let (mut count, mut changed) = (0_u16, false);
        let mut slots = slots.chunks_exact_mut(CLIENT_BYTES);
        for peer in clients {
            count = count.saturating_add(1);
            let Some(slot) = slots.next() else { continue };
            let address = match peer.ip().to_canonical() {
                IpAddr::V4(ip) => ip.octets(),
                IpAddr::V6(_) => [0; 4],
            };
            let [low, high] = peer.port().to_le_bytes();
            let [a, b, c, d] = address;
            changed |= replace(slot, &[a, b, c, d, low, high]);
        }
        for slot in slots {
            changed |= replace(slot, &[0; CLIENT_BYTES]);
        }
        changed |= replace(head, &count.to_le_bytes());
        if changed {
            self.data_t_ns = now_ns;
            self.dirty = true;
        }
    }

    fn publish(&mut self, rail: &mut impl Rail, now_ns: u64) {
        if self.ranges.is_empty() {
            return;
        }
        self.tail.clear();
        for (start, len) in &self.ranges {
            let range = *start as usize..(start + len) as usize;
            self.tail.extend_from_slice(self.bytes.get(range).unwrap_or_default());
        }
        for i in 0..self.ranges.len() {
            let is_list = self.has_list && i + 1 == self.ranges.len();
            self.tail.push(if is_list { Quality::Good } else { self.quality } as u8);
        }
        self.dirty = !rail.publish_inputs(self.ranges.len() as u32, self.data_t_ns, &self.tail);
        self.sent_ns = now_ns;
    }
}

/// Whether it was different.
fn replace(slot: &mut [u8], with: &[u8]) -> bool {
    let changed = slot != with;
    slot.copy_from_slice(with);
    changed
}

/// The ranges of %I that the server owns by its maps: byte offset and length, sorted, neighbours joined.
pub fn own_inputs(maps: &[RegisterMap]) -> Vec<(u32, u32)> {
    let mut owned: Vec<(u32, u32)> = maps.iter().flat_map(RegisterMap::own_inputs).collect();
    owned.sort_unstable();
    let mut joined: Vec<(u32, u32)> = Vec::new();
    for (start, len) in owned {
        match joined.last_mut() {
            Some(last) if start <= last.0 + last.1 => last.1 = last.1.max(start + len - last.0),
            _ => joined.push((start, len)),
        }
    }
    joined
}

/// What changed since the last [`ProcessImage::tick`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Change {
    /// Requests are answered by exception 04 from now on.
    NotServing,
    /// ... and are carried out again.
    Serving,
    /// No client has written in time: the watchdog's values were sent.
    WatchdogFired,
    /// A client writes again.
    WatchdogCleared,
}

/// The image behind the server in a running stack.
pub struct ProcessImage<R> {
    rail: R,
    view: View,
    /// One for each unit that has one of its own; the first is everybody else's.
    maps: Vec<RegisterMap>,
    /// The map that requests mean now.
    map: usize,
    buffers: Buffers,
    exception_status: [Option<BitPlace>; 8],
    on_stop: OnStop,
    own: OwnInputs,
    watchdog: Option<Watchdog>,
    set: WriteSet,
    builder: Builder,
    /// Taken once a batch.
    now_ns: u64,
    counters: WriteCounters,
    serving: Option<bool>,
}

impl<R: Rail> ProcessImage<R> {
    /// An image that has not seen the PLC yet, with one map for all units.
    pub fn new(rail: R, view: View, map: RegisterMap, on_stop: OnStop, watchdog: Option<Watchdog>) -> Self {
        let maps = vec![map];
        let own = OwnInputs::new(own_inputs(&maps), None);
        let now_ns = rail.now_ns();
        Self {
            rail,
            view,
            maps,
            map: 0,
            buffers: Buffers::default(),
            exception_status: [None; 8],
            on_stop,
            own,
            watchdog,
            set: WriteSet::default(),
            builder: Builder::default(),
            now_ns,
            counters: WriteCounters::default(),
            serving: None,
        }
    }

    /// With maps of single units besides the first one, and a place in %I (byte, bytes) for the list of clients.
    #[must_use]
    pub fn with_maps(mut self, more: Vec<RegisterMap>, list: Option<(u32, u32)>) -> Self {
        self.maps.extend(more);
        self.own = OwnInputs::new(own_inputs(&self.maps), list);
        self
    }

    /// With files and queues.
    #[must_use]
    pub fn with_buffers(mut self, buffers: Buffers) -> Self {
        self.buffers = buffers;
        self
    }

    /// With the bits that function 7 shows, the lowest first.
    #[must_use]
    pub fn with_exception_status(mut self, bits: [Option<BitPlace>; 8]) -> Self {
        self.exception_status = bits;
        self
    }

    /// A bit of the image; `None` while the image is not fresh or has no such bit.
    pub fn bit(&self, place: BitPlace) -> Option<bool> {
        let fresh = self.view.is_fresh(self.now_ns);
        let byte = self.view.memory().area(place.area).get(place.byte as usize).filter(|_| fresh)?;
        Some(byte >> place.bit & 1 == 1)
    }

    /// Writes the list of clients, published with the next tick.
    pub fn list_clients(&mut self, clients: impl Iterator<Item = SocketAddr>) {
        self.own.list(clients, self.now_ns);
    }

    /// The ports.
    pub fn rail(&self) -> &R {
        &self.rail
    }

    /// Image and overlay.
    pub fn view(&self) -> &View {
        &self.view
    }

    /// Counters of writes.
    pub fn write_counters(&self) -> WriteCounters {
        self.counters
    }

    /// State of the watchdog; `None` without one.
    pub fn watchdog(&self) -> Option<WatchdogState> {
        self.watchdog.as_ref().map(Watchdog::state)
    }

    /// Whether reads are carried out now.
    pub fn is_serving(&self) -> bool {
        self.ready(Access::Read).is_ok()
    }

    /// Work that is not caused by a request; call it at least every 100 ms.
    pub fn tick(&mut self, mut changed: impl FnMut(Change)) {
        self.begin();
        let serving = self.is_serving();
        if self.serving.replace(serving).is_some_and(|before| before != serving) {
            changed(if serving { Change::Serving } else { Change::NotServing });
        }
        if let Some(watchdog) = &mut self.watchdog {
            if watchdog.take_cleared() {
                changed(Change::WatchdogCleared);
            }
            if watchdog.is_due(self.now_ns) && self.fire_watchdog() {
                changed(Change::WatchdogFired);
            }
        }
        if self.own.dirty || self.now_ns.saturating_sub(self.own.sent_ns) >= RESEND_NS {
            self.own.publish(&mut self.rail, self.now_ns);
        }
    }

    /// Sends the watchdog's values; `false` when they could not be queued, then it stays due.
    fn fire_watchdog(&mut self) -> bool {
        let Some(watchdog) = &mut self.watchdog else { return false };
        if watchdog.values().ops() > 0 {
            let Ok(seq) = self.rail.write(watchdog.values()) else { return false };
            self.view.overlay(seq, self.now_ns, watchdog.values());
        }
        watchdog.fired();
        if self.own.quality == Quality::Good {
            self.own.quality = Quality::Stale;
            self.own.dirty = true;
        }
        true
    }

    fn map(&self) -> &RegisterMap {
        // `select` keeps the index within the list, which has one map at least.
        &self.maps[self.map]
    }

    fn memory(&self) -> Memory<'_> {
        Memory { own_input: &self.own.bytes, ..self.view.memory() }
    }

    fn queue(&mut self) -> Result<(), Exception> {
        if self.view.is_full() {
            self.counters.full += 1;
            return Err(Exception::ServerDeviceBusy);
        }
        self.set.build(&mut self.builder).map_err(|_| Exception::ServerDeviceFailure)?;
        match self.rail.write(&self.builder) {
            Ok(seq) => {
                self.counters.queued += 1;
                self.view.overlay(seq, self.now_ns, &self.builder);
                Ok(())
            }
            Err(NotQueued::Full) => {
                self.counters.full += 1;
                Err(Exception::ServerDeviceBusy)
            }
            Err(NotQueued::NoReader) => {
                self.counters.no_reader += 1;
                Err(Exception::ServerDeviceFailure)
            }
        }
    }
}

impl<R: Rail> Backend for ProcessImage<R> {
    fn begin(&mut self) {
        let Self { rail, view, maps, buffers, .. } = self;
        rail.newest(&mut |header, tail| {
            if let Some(sizes) = view.take(header, tail) {
                for map in maps.iter_mut() {
                    map.set_sizes(sizes);
                }
                buffers.set_sizes(sizes);
            }
        });
        self.now_ns = self.rail.now_ns();
        self.view.expire(self.now_ns);
    }
}

impl<R: Rail> Image for ProcessImage<R> {
    fn check(&self, access: Access, table: Table, address: u16, quantity: u16) -> Result<(), Exception> {
        self.map().check(access, table, address, quantity)
    }

    /// Reads need an image that is fresh and in state RUN, or with `on_stop = "hold"` any image. Writes need a
    /// fresh one in any case: nobody would apply them.
    fn ready(&self, access: Access) -> Result<(), Exception> {
        let fresh = self.view.is_fresh(self.now_ns);
        let Some(newest) = self.view.newest() else { return Err(Exception::ServerDeviceFailure) };
        let ready = match (self.on_stop, access) {
            (OnStop::Exception, _) => fresh && newest.state == PlcState::Run,
            (OnStop::Hold, Access::Read) => true,
            (OnStop::Hold, Access::Write) => fresh,
        };
        if ready { Ok(()) } else { Err(Exception::ServerDeviceFailure) }
    }

    fn read_bits(
        &mut self,
        table: Table,
        address: u16,
        quantity: u16,
        out: &mut [u8],
    ) -> Result<(), Exception> {
        self.map().read_bits(&self.memory(), table, address, quantity, out)
    }

    fn read_words(&mut self, table: Table, address: u16, out: &mut [u8]) -> Result<(), Exception> {
        self.map().read_words(&self.memory(), table, address, out)
    }

    fn write(&mut self, write: &Write<'_>) -> Result<(), Exception> {
        let Some(map) = self.maps.get(self.map) else { return Err(Exception::ServerDeviceFailure) };
        match map.plan(write, &mut self.set)? {
            Destination::Plc => self.queue()?,
            Destination::OwnInputs => {
                self.own.write(&self.set, self.now_ns);
                self.own.publish(&mut self.rail, self.now_ns);
                self.counters.own += 1;
            }
        }
        if let Some(watchdog) = &mut self.watchdog {
            watchdog.written(self.now_ns);
        }
        Ok(())
    }

    fn select(&mut self, map: usize) {
        self.map = map.min(self.maps.len() - 1);
    }

    fn exception_status(&mut self) -> Result<u8, Exception> {
        if self.exception_status.iter().all(Option::is_none) {
            return Ok(0);
        }
        self.ready(Access::Read)?;
        let memory = self.view.memory();
        let bit = |place: &Option<BitPlace>| {
            let place = (*place)?;
            Some(memory.area(place.area).get(place.byte as usize)? >> place.bit & 1)
        };
        let bits = self.exception_status.iter().enumerate();
        Ok(bits.fold(0, |status, (i, place)| status | bit(place).unwrap_or(0) << i))
    }

    fn is_running(&self) -> bool {
        let state = self.view.newest().map(|newest| newest.state);
        state == Some(PlcState::Run) && self.view.is_fresh(self.now_ns)
    }

    fn check_file(&self, access: Access, file: u16, record: u16, count: u16) -> Result<(), Exception> {
        self.buffers.check_file(access, file, record, count)
    }

    fn read_file(&mut self, file: u16, record: u16, out: &mut [u8]) -> Result<(), Exception> {
        self.buffers.read_file(&self.view.memory(), file, record, out)
    }

    fn write_files(&mut self, groups: &[u8]) -> Result<(), Exception> {
        self.set.clear();
        for group in files::write_groups(groups) {
            self.buffers.plan(&group, &mut self.set)?;
        }
        self.queue()?;
        if let Some(watchdog) = &mut self.watchdog {
            watchdog.written(self.now_ns);
        }
        Ok(())
    }

    fn check_fifo(&self, address: u16) -> Result<(), Exception> {
        self.buffers.check_fifo(address)
    }

    fn read_fifo(&mut self, address: u16, out: &mut [u8; 2 * MAX_FIFO]) -> Result<usize, Exception> {
        self.buffers.read_fifo(&self.view.memory(), address, out)
    }
}

#[cfg(test)]
#[path = "process_image_tests.rs"]
mod tests;
