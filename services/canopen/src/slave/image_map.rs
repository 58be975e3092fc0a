//! Objects of a device and their places in the process image.

use crate::config::{OnBadWord, SlaveConfig};
use crate::device::Device;
use crate::mistakes::Mistakes;
use crate::place::{fits, iec_type};
use crate::protocol::io::Outbox;
use crate::protocol::node::Node;
use crate::protocol::od::EntryRef;
use dinrail_iec::artifact::AreaKind;
use dinrail_iec::{Addressing, LocatedAddress, parse_address};
use ipc_types::payload::Quality;
use ipc_types::wiring::{Area, ImageRange, OnBad};

/// Most `[[service.map]]` of a slave.
pub const MAX_MAPS: usize = 4096;

/// An object with its place in a flat buffer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Point {
    entry: EntryRef,
    index: u16,
    sub: u8,
    at: usize,
    /// Bytes in the image.
    bytes: usize,
    signed: bool,
}

/// All mapped objects.
#[derive(Debug, Clone, Default)]
pub struct ImageMap {
    /// What the network writes.
    inputs: Vec<Point>,
    /// What the network reads.
    outputs: Vec<Point>,
    /// Values, then one quality byte a range.
    tail: Vec<u8>,
    pub input_ranges: Vec<ImageRange>,
    pub output_ranges: Vec<ImageRange>,
    gathered: usize,
    /// Objects that an image changed; kept so that an image allocates nothing.
    changed: Vec<(u16, u8)>,
}

/// Resolves the table; entries with a mistake are left out.
pub fn plan(
    config: &SlaveConfig,
    device: &Device,
    addressing: Addressing,
    mistakes: &mut Mistakes,
) -> ImageMap {
    let mut map = ImageMap::default();
    if config.map.len() > MAX_MAPS {
        let message = format!("{} objects are mapped, the limit is {MAX_MAPS}", config.map.len());
        mistakes.add("map", message, "map fewer objects");
    }
    for (i, entry) in config.map.iter().take(MAX_MAPS).enumerate() {
        let key = format!("map[{i}]");
        let object = match device.resolve(&entry.object) {
            Ok(object) => object,
            Err(message) => {
                mistakes.add(&format!("{key}.object"), message, "map one of those");
                continue;
            }
        };
        let (text, end, to_image) = match (&entry.to, &entry.from) {
            (Some(to), None) => (to, "to", true),
            (None, Some(from)) => (from, "from", false),
            _ => {
                let help = "to = \"%IB0\" for what the network writes, from = \"%QB0\" for what it reads";
                mistakes.add(&key, "an object goes to %I or comes from %Q or %M", help);
                continue;
            }
        };
        let end = format!("{key}.{end}");
        let at = match parse_address(text, addressing) {
            Ok(at) if (at.area == AreaKind::Input) == to_image => at,
            Ok(_) => {
                let help = "to = an address in %I, from = one in %Q or %M";
                mistakes.add(&end, format!("{text} is of the wrong area"), help);
                continue;
            }
            Err(e) => {
                mistakes.add(&end, e.to_string(), "write an address like %IB0 or %QX1.0");
                continue;
            }
        };
        let Ok(found) = device.od.find(object.0, object.1) else { continue };
        let Some(of) = device.od.entry(found) else { continue };
        if let Err(message) = fits(of, at, text) {
            mistakes.add(&end, message, "take a place of the object's size: B has 8 bits, W 16, D 32, L 64");
            continue;
        }
        let name = device.name_of(object.0, object.1).unwrap_or("object");
        let range = ImageRange {
            area: match at.area {
                AreaKind::Input => Area::Input,
                AreaKind::Output => Area::Output,
                AreaKind::Marker | AreaKind::Retain | AreaKind::Data => Area::Marker,
            },
            byte: at.byte,
            bit: at.bit,
            bytes: at.size.bytes(),
            type_name: Some(iec_type(of.data_type, at).to_owned()),
            symbol: entry.symbol.clone(),
            label: format!("object {:04X}:{:02X} {name}", object.0, object.1),
            key: end,
            on_bad: if entry.on_bad == OnBadWord::Zero { OnBad::Zero } else { OnBad::Hold },
            status_byte: None,
        };
        map.add(found, object, at, of.data_type.is_signed(), range, to_image);
    }
    let values = map.tail.len();
    map.tail.resize(values + map.inputs.len(), Quality::NoData as u8);
    map.changed.reserve_exact(map.outputs.len());
    map
}

impl ImageMap {
    fn add(
        &mut self,
        entry: EntryRef,
        (index, sub): (u16, u8),
        place: LocatedAddress,
        signed: bool,
        range: ImageRange,
        to_image: bool,
    ) {
        let bytes = place.size.bytes() as usize;
        if to_image {
            let at = self.tail.len();
            self.inputs.push(Point { entry, index, sub, at, bytes, signed });
            self.tail.resize(at + bytes, 0);
            self.input_ranges.push(range);
        } else {
            let at = self.gathered;
            self.outputs.push(Point { entry, index, sub, at, bytes, signed });
            self.gathered += bytes;
            self.output_ranges.push(range);
        }
    }

    /// The tail of the `inputs` message.
    pub fn tail(&self) -> &[u8] {
        &self.tail
    }
    pub fn ranges(&self) -> u32 {
        self.inputs.len() as u32
    }
    /// Bytes of the gathered outputs.
    pub fn gathered_bytes(&self) -> usize {
        self.gathered
    }

    /// Takes the objects' values; true when a byte of the tail changed.
    pub fn collect(&mut self, node: &Node, good: bool) -> bool {
        let mut changed = false;
        let values = self.tail.len() - self.inputs.len();
        for (i, point) in self.inputs.iter().enumerate() {
            let data = node.get(point.entry);
            let fill = if point.signed && data.last().is_some_and(|b| b & 0x80 != 0) { 0xFF } else { 0 };
            for (n, byte) in self.tail[point.at..point.at + point.bytes].iter_mut().enumerate() {
                let value = data.get(n).copied().unwrap_or(fill);
                changed |= *byte != value;
                *byte = value;
            }
            let quality = match (good, Quality::from_u8(self.tail[values + i])) {
                (true, _) => Quality::Good,
                (false, Quality::Good) => Quality::Stale,
                (false, bad) => bad,
            };
            changed |= self.tail[values + i] != quality as u8;
            self.tail[values + i] = quality as u8;
        }
        changed
    }

    /// Puts gathered outputs into the objects; what changed is an event of the device's transmit PDOs.
    pub fn apply(&mut self, t_ns: u64, node: &mut Node, gathered: &[u8], out: &mut Outbox) {
        // First all values, then the event: a PDO of several objects goes out whole, and once.
        self.changed.clear();
        for point in &self.outputs {
            let Some(value) = gathered.get(point.at..point.at + point.bytes) else { continue };
            let size = node.get(point.entry).len().min(value.len());
            if node.get(point.entry)[..size] != value[..size]
                && node.set_quietly(point.entry, &value[..size]).is_ok()
            {
                self.changed.push((point.index, point.sub));
            }
        }
        node.changed(t_ns, &self.changed, out);
    }
}
