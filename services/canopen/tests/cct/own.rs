//! Steps of our own for cases that the tool skipped or failed at the log's device: what the case asks for, on a device
//! of the same EDS that has the objects too (guarding 100Ch and 100Dh, a configuration date 1020h, write-only objects and
//! limits).

use crate::device::{Device, MS, NODE_ID};
use crate::eds;
use crate::runner::Verdict;
use dinrail_canopen::protocol::data_type::{DataType, Number};
use dinrail_canopen::protocol::od::{Access, EntryDef};

type Steps = fn(&mut Device) -> Result<(), String>;

#[derive(Clone, Copy)]
pub enum Own {
    Steps(Steps),
    No(&'static str),
    /// The log has all that can be run; it was run.
    Replayed,
}

impl Own {
    pub fn is_own(self) -> bool {
        matches!(self, Self::Steps(_))
    }
    pub fn run(self, text: &str) -> Verdict {
        match self {
            Self::No(why) => Verdict::NotApplicable(why),
            Self::Replayed => Verdict::Passed,
            Self::Steps(steps) => match steps(&mut fuller_device(text)) {
                Ok(()) => Verdict::Passed,
                Err(why) => Verdict::Failed(why),
            },
        }
    }
}

fn fuller_device(text: &str) -> Device {
    let mut builder = eds::builder(text);
    let rw = |data_type: DataType| EntryDef::new(data_type, Access::Rw);
    builder.var(0x100C, rw(DataType::Unsigned16)).var(0x100D, rw(DataType::Unsigned8));
    builder.array(0x1020, 2, rw(DataType::Unsigned32));
    let mappable = |access: Access| EntryDef::new(DataType::Unsigned8, access).mappable();
    builder
        .var(0x2201, mappable(Access::Wo))
        .var(0x2202, mappable(Access::Rww))
        .var(0x2203, mappable(Access::Rwr));
    builder.var(0x2204, rw(DataType::Integer16).limits(Number::Int(-10), Number::Int(10)));
    Device::new(builder.build(NODE_ID).unwrap())
}

pub fn find(id: &str) -> Option<Own> {
    use Own::{No, Replayed, Steps};
    Some(match id {
        "0" => Replayed,
        "1.0" => No("checks a file, not a device: `dinrail canopen eds check`"),
        "2.4" | "4.4" => Steps(read_write_only),
        "2.11" | "4.6" => Steps(limits),
        "2.14" => Steps(|device| write_100c(device, Way::Segmented)),
        "2.20" => Steps(|device| write_100c(device, Way::Block { crc: false })),
        "2.24" => Steps(|device| write_100c(device, Way::Block { crc: true })),
        "2.27" => Steps(block_sequence),
        "2.29" => Steps(|device| absent_channels(device, 0x1201)),
        "2.30" => Steps(|device| absent_channels(device, 0x1280)),
        "3.3" => Steps(rtr_operational),
        "3.7" => Steps(acyclic),
        "3.8" => Steps(sync_start),
        "3.9" => Steps(rtr_stopped),
        "3.14" => Steps(sync_start_preoperational),
        "3.15" => Steps(rtr_preoperational),
        "3.20" => Steps(sync_start_stopped),
        "3.22" => Steps(mapping_procedure),
        "3.24" => Steps(mapping_while_valid),
        "3.27" => Steps(|device| map(device, true, &[(0x2201, 0), (0x2202, 0)], None)),
        "3.31" => Steps(|device| map(device, false, &[(0x2201, 0), (0x2202, 0)], Some(0x0604_0041))),
        "4.2" | "4.8" => Steps(defaults),
        "4.5" => No("sub-index FFh is optional, the device has none"),
        "5.6" => Steps(error_field),
        "7.1" => Steps(|device| {
            device.expect(0x100C, 0, &[0, 0])?;
            device.expect(0x100D, 0, &[0])
        }),
        "7.2" | "7.3" => Steps(guarding_toggle),
        "7.4" => Steps(guarding_ids),
        "7.5" => Steps(|device| {
            device.write_ok(0x100C, 0, &500u16.to_le_bytes())?;
            device.write_ok(0x100D, 0, &[3])?;
            device.expect(0x100C, 0, &500u16.to_le_bytes())?;
            device.expect(0x100D, 0, &[3])
        }),
        "7.6" => Steps(life_guarding),
        "7.202" | "7.204" => Steps(heartbeat_replaces_guarding),
        "7.203" => Steps(guarding_toggle),
        "7.205" | "7.207" => Steps(heartbeat_ignores_rtr),
        "7.206" => Steps(heartbeat_beside_guarding),
        "8.1" => Steps(|device| stored(device, b"wron", 0x2305)),
        "8.2" => Steps(|device| stored(device, b"save", 0x4E20)),
        "8.9" => Steps(configuration_date),
        "8.10" => Replayed,
        _ => return None,
    })
}

/// Small SDO client.
impl Device {
    fn sdo(&mut self, request: [u8; 8]) -> Result<[u8; 8], String> {
        self.wait_ms(1);
        self.send(0x600 + u32::from(NODE_ID), &request);
        let answer = self.take(0, |sent| sent.id == 0x580 + u32::from(NODE_ID));
        let answer = answer.ok_or_else(|| format!("no answer to {request:02X?}"))?;
        answer.data.try_into().map_err(|data| format!("answer {data:02X?}"))
    }
    fn request(command: u8, index: u16, sub: u8, data: &[u8]) -> [u8; 8] {
        let mut request = [0; 8];
        request[0] = command;
        request[1..3].copy_from_slice(&index.to_le_bytes());
        request[3] = sub;
        request[4..4 + data.len()].copy_from_slice(data);
        request
    }
    /// Value (up to 4 bytes), or abort code.
    fn read(&mut self, index: u16, sub: u8) -> Result<Vec<u8>, String> {
        let answer = self.sdo(Self::request(0x40, index, sub, &[]))?;
        match answer[0] {
            0x43 | 0x47 | 0x4B | 0x4F => Ok(answer[4..8 - usize::from(answer[0] >> 2 & 3)].to_vec()),
            0x80 => {
                Err(format!("abort {:08X}", u32::from_le_bytes([answer[4], answer[5], answer[6], answer[7]])))
            }
            _ => Err(format!("answer {answer:02X?}")),
        }
    }
    fn expect(&mut self, index: u16, sub: u8, value: &[u8]) -> Result<(), String> {
        let got = self.read(index, sub)?;
        if got == value {
            Ok(())
        } else {
            Err(format!("{index:04X}:{sub:02X} is {got:02X?}, expected {value:02X?}"))
        }
    }
    /// Abort code, if any.
    fn write(&mut self, index: u16, sub: u8, data: &[u8]) -> Result<Option<u32>, String> {
        let command = 0x23 | (4 - data.len() as u8) << 2;
        let answer = self.sdo(Self::request(command, index, sub, data))?;
        match answer[0] {
            0x60 => Ok(None),
            0x80 => Ok(Some(u32::from_le_bytes([answer[4], answer[5], answer[6], answer[7]]))),
            _ => Err(format!("answer {answer:02X?}")),
        }
    }
    fn write_ok(&mut self, index: u16, sub: u8, data: &[u8]) -> Result<(), String> {
        match self.write(index, sub, data)? {
            None => Ok(()),
            Some(code) => Err(format!("write to {index:04X}:{sub:02X} aborted with {code:08X}")),
        }
    }
    fn write_aborts(&mut self, index: u16, sub: u8, data: &[u8], code: u32) -> Result<(), String> {
        match self.write(index, sub, data)? {
            Some(got) if got == code => Ok(()),
            got => Err(format!("write to {index:04X}:{sub:02X}: {got:08X?}, expected abort {code:08X}")),
        }
    }
    fn nmt(&mut self, command: u8) {
        self.wait_ms(1);
        self.send(0, &[command, NODE_ID]);
    }
    /// Frames with this id since the last call of it or `quiet`.
    fn got(&mut self, id: u32) -> Vec<Vec<u8>> {
        let got = self.sent.iter().filter(|sent| sent.id == id).map(|sent| sent.data.clone()).collect();
        self.sent.clear();
        got
    }
    fn sync(&mut self, counter: Option<u8>) -> Vec<Vec<u8>> {
        self.wait_ms(10);
        self.sent.clear();
        self.send(0x080, counter.as_slice());
        self.got(0x184)
    }
    /// TPDO 1 with this transmission type and COB-ID bits.
    fn tpdo(&mut self, kind: u8, bits: u32, start: u8) -> Result<(), String> {
        self.write_ok(0x1800, 1, &0xC000_0184u32.to_le_bytes())?;
        self.write_ok(0x1800, 2, &[kind])?;
        self.write_ok(0x1800, 6, &[start])?;
        self.write_ok(0x1800, 1, &(bits | 0x184).to_le_bytes())
    }
}

fn check(right: bool, what: &str) -> Result<(), String> {
    if right { Ok(()) } else { Err(what.to_string()) }
}

fn read_write_only(device: &mut Device) -> Result<(), String> {
    check(device.read(0x2201, 0) == Err("abort 06010001".into()), "a write-only object was read")
}

fn limits(device: &mut Device) -> Result<(), String> {
    device.write_ok(0x2204, 0, &(-10i16).to_le_bytes())?;
    device.write_aborts(0x2204, 0, &(-11i16).to_le_bytes(), 0x0609_0032)?;
    device.write_aborts(0x2204, 0, &11i16.to_le_bytes(), 0x0609_0031)?;
    device.expect(0x2204, 0, &(-10i16).to_le_bytes())
}

enum Way {
    Segmented,
    Block { crc: bool },
}

fn write_100c(device: &mut Device, way: Way) -> Result<(), String> {
    let value = 0x01F4u16.to_le_bytes();
    match way {
        Way::Segmented => {
            let answer = device.sdo(Device::request(0x21, 0x100C, 0, &[2, 0, 0, 0]))?;
            check(answer[0] == 0x60, "initiate was refused")?;
            let answer = device.sdo([0x0B, value[0], value[1], 0, 0, 0, 0, 0])?;
            check(answer[0] == 0x20, "the segment was refused")?;
        }
        Way::Block { crc } => {
            let answer = device.sdo(Device::request(0xC2 | u8::from(crc) << 2, 0x100C, 0, &[2, 0, 0, 0]))?;
            check(answer[0] & 0xFB == 0xA0, "initiate was refused")?;
            let answer = device.sdo([0x81, value[0], value[1], 0, 0, 0, 0, 0])?;
            check(answer[0] == 0xA2 && answer[1] == 1, "the sub-block was refused")?;
            // CRC-16/XMODEM of F4h 01h.
            let sum = value.iter().fold(0u16, |crc, &byte| {
                (0..8).fold(crc ^ u16::from(byte) << 8, |crc, _| {
                    if crc & 0x8000 != 0 { crc << 1 ^ 0x1021 } else { crc << 1 }
                })
            });
            let [low, high] = if crc { sum.to_le_bytes() } else { [0, 0] };
            let answer = device.sdo([0xD5, low, high, 0, 0, 0, 0, 0])?;
            check(answer[0] == 0xA1, "the end was refused")?;
        }
    }
    device.expect(0x100C, 0, &value)
}

fn block_sequence(device: &mut Device) -> Result<(), String> {
    device.sdo([0xA0, 0x00, 0x10, 0, 20, 0, 0, 0])?;
    device.sdo([0xA3, 0, 0, 0, 0, 0, 0, 0])?;
    let answer = device.sdo([0xA2, 0x80, 20, 0, 0, 0, 0, 0])?;
    let code = u32::from_le_bytes([answer[4], answer[5], answer[6], answer[7]]);
    check(
        answer[0] == 0x80 && matches!(code, 0x0504_0001 | 0x0504_0003 | 0x0800_0000),
        &format!("abort {code:08X}"),
    )
}

fn absent_channels(device: &mut Device, first: u16) -> Result<(), String> {
    for index in first..=(first | 0x7F) {
        check(device.read(index, 0) == Err("abort 06020000".into()), &format!("{index:04X} is there"))?;
    }
    Ok(())
}

/// Types 252 and 253, 254 with RTR, and bit 30.
fn rtr_operational(device: &mut Device) -> Result<(), String> {
    device.tpdo(253, 0, 0)?;
    device.nmt(1);
    device.sent.clear();
    device.remote(0x184);
    check(device.got(0x184) == [[0xFF, 0]], "type 253 does not answer a request")?;
    device.nmt(128);
    device.tpdo(252, 0, 0)?;
    device.nmt(1);
    device.sent.clear();
    device.remote(0x184);
    check(device.got(0x184).is_empty(), "type 252 answers before the first SYNC")?;
    check(device.sync(None).is_empty(), "type 252 sends at SYNC")?;
    device.remote(0x184);
    check(device.got(0x184).len() == 1, "type 252 does not answer a request")?;
    device.nmt(128);
    device.tpdo(253, 0x4000_0000, 0)?;
    device.nmt(1);
    device.sent.clear();
    device.remote(0x184);
    check(device.got(0x184).is_empty(), "bit 30 does not forbid RTR")
}

fn rtr_stopped(device: &mut Device) -> Result<(), String> {
    rtr_in(device, 2)
}

fn rtr_preoperational(device: &mut Device) -> Result<(), String> {
    rtr_in(device, 128)
}

fn rtr_in(device: &mut Device, command: u8) -> Result<(), String> {
    device.tpdo(253, 0, 0)?;
    device.nmt(1);
    device.nmt(command);
    device.sent.clear();
    device.remote(0x184);
    device.wait_ms(100);
    check(device.got(0x184).is_empty(), "a PDO outside operational")
}

/// Type 0: at the SYNC behind an event, and at no other.
fn acyclic(device: &mut Device) -> Result<(), String> {
    device.tpdo(0, 0x4000_0000, 0)?;
    device.nmt(1);
    check(device.sync(None).len() == 1, "no PDO at the first SYNC")?;
    check(device.sync(None).is_empty(), "a PDO without event")?;
    device.application_input(0x55);
    check(device.got(0x184).is_empty(), "a PDO without SYNC")?;
    check(device.sync(None) == [[0x55, 0]], "no PDO at the SYNC behind the event")?;
    check(device.sync(None).is_empty(), "a second PDO for one event")
}

fn sync_start(device: &mut Device) -> Result<(), String> {
    device.write_ok(0x1019, 0, &[8])?;
    device.tpdo(2, 0x4000_0000, 5)?;
    device.nmt(1);
    let mut sent = Vec::new();
    for counter in (1..=8).chain(1..=8) {
        if !device.sync(Some(counter)).is_empty() {
            sent.push(counter);
        }
    }
    check(sent == [5, 7, 1, 3, 5, 7], &format!("PDOs at {sent:?}"))
}

fn sync_start_preoperational(device: &mut Device) -> Result<(), String> {
    sync_start_in(device, 128)
}

fn sync_start_stopped(device: &mut Device) -> Result<(), String> {
    sync_start_in(device, 2)
}

fn sync_start_in(device: &mut Device, command: u8) -> Result<(), String> {
    device.write_ok(0x1019, 0, &[8])?;
    device.tpdo(1, 0x4000_0000, 2)?;
    device.nmt(1);
    device.nmt(command);
    let sent: usize = (1..=8).map(|counter| device.sync(Some(counter)).len()).sum();
    check(sent == 0, "a PDO outside operational")
}

fn mapping_procedure(device: &mut Device) -> Result<(), String> {
    device.write_ok(0x1400, 1, &0x8000_0204u32.to_le_bytes())?;
    device.write_ok(0x1600, 0, &[0])?;
    for (sub, object) in [(1, 0x6200_0208u32), (2, 0x0005_0008), (3, 0x6200_0108)] {
        device.write_ok(0x1600, sub, &object.to_le_bytes())?;
    }
    device.write_ok(0x1600, 0, &[3])?;
    device.write_ok(0x1400, 1, &0x0000_0204u32.to_le_bytes())?;
    device.nmt(1);
    device.send(0x204, &[0x11, 0x22, 0x33]);
    device.expect(0x6200, 1, &[0x33])?;
    device.expect(0x6200, 2, &[0x11])
}

fn mapping_while_valid(device: &mut Device) -> Result<(), String> {
    for (index, value) in [(0x1600u16, 0x6200_0108u32), (0x1A00, 0x6000_0108)] {
        device.write_aborts(index, 0, &[0], 0x0601_0000)?;
        device.write_aborts(index, 1, &value.to_le_bytes(), 0x0601_0000)?;
    }
    Ok(())
}

fn map(device: &mut Device, receive: bool, objects: &[(u16, u8)], abort: Option<u32>) -> Result<(), String> {
    let (cob, mapping) = if receive { (0x1400, 0x1600) } else { (0x1800, 0x1A00) };
    device.write_ok(cob, 1, &0xC000_0204u32.to_le_bytes())?;
    device.write_ok(mapping, 0, &[0])?;
    for &(index, sub) in objects {
        let value = (u32::from(index) << 16 | u32::from(sub) << 8 | 8).to_le_bytes();
        match abort {
            Some(code) => device.write_aborts(mapping, 1, &value, code)?,
            None => device.write_ok(mapping, 1, &value)?,
        }
    }
    Ok(())
}

/// Every default of the EDS is what the device has; inputs and counters are the application's.
fn defaults(device: &mut Device) -> Result<(), String> {
    let node = &device.node;
    let wrong = node.od().entries().find(|&(at, entry)| {
        let application = matches!(entry.index, 0x1008..=0x100A | 0x2100 | 0x2121 | 0x2122 | 0x6000 | 0x6401);
        !application && node.get(at) != node.od().default_of(at)
    });
    match wrong {
        Some((_, entry)) => Err(format!("{:04X}:{:02X} has not its default", entry.index, entry.sub)),
        None => Ok(()),
    }
}

/// The newest entry of 1003h is the EMCY that was sent.
fn error_field(device: &mut Device) -> Result<(), String> {
    device.nmt(1);
    device.sent.clear();
    device.send(0x204, &[]);
    let emcy = device.got(0x084).pop().ok_or("no EMCY")?;
    check(emcy[..2] == [0x10, 0x82], "no EMCY 8210h")?;
    let register = device.read(0x1001, 0)?;
    check(register == emcy[2..3], "1001h is not what the EMCY says")?;
    device.expect(0x1003, 0, &[1])?;
    device.expect(0x1003, 1, &[emcy[0], emcy[1], emcy[3], emcy[4]])?;
    device.write_ok(0x1003, 0, &[0])?;
    device.expect(0x1003, 0, &[0])
}

fn guarding_toggle(device: &mut Device) -> Result<(), String> {
    device.nmt(129);
    device.wait_ms(1);
    device.sent.clear();
    for toggle in [0x00, 0x80, 0x00, 0x80] {
        device.remote(0x704);
        let got = device.got(0x704);
        check(got == [[toggle | 0x7F]], &format!("{got:02X?}"))?;
        device.wait_ms(100);
    }
    device.nmt(2);
    device.sent.clear();
    device.remote(0x704);
    check(device.got(0x704) == [[0x04]], "toggle or state wrong after stop")
}

fn guarding_ids(device: &mut Device) -> Result<(), String> {
    for id in (0x701..=0x77F).filter(|&id| id != 0x704) {
        device.remote(id);
        check(device.got(id).is_empty(), &format!("{id:03X} was answered"))?;
    }
    device.remote(0x704);
    check(device.got(0x704).len() == 1, "704 was not answered")
}

fn life_guarding(device: &mut Device) -> Result<(), String> {
    device.write_ok(0x100C, 0, &100u16.to_le_bytes())?;
    device.write_ok(0x100D, 0, &[3])?;
    device.nmt(1);
    device.remote(0x704);
    for _ in 0..5 {
        device.wait_ms(290);
        device.remote(0x704);
    }
    check(device.got(0x084).is_empty(), "an EMCY while guarded")?;
    let from = device.t_ns;
    let emcy = device.take(1000, |sent| sent.id == 0x084).ok_or("no life guard EMCY")?;
    check(emcy.data[..2] == [0x30, 0x81] && emcy.t_ns - from == 300 * MS, "wrong EMCY or time")?;
    device.sent.clear();
    device.remote(0x704);
    check(device.got(0x704).last().is_some_and(|data| data[0] & 0x7F == 0x7F), "not pre-operational")
}

fn heartbeat_replaces_guarding(device: &mut Device) -> Result<(), String> {
    device.write_ok(0x1017, 0, &100u16.to_le_bytes())?;
    device.wait_ms(500);
    check(device.got(0x704).len() >= 5, "no heartbeats")?;
    device.write_ok(0x1017, 0, &[0, 0])?;
    device.sent.clear();
    device.wait_ms(500);
    check(device.got(0x704).is_empty(), "heartbeats while off")?;
    device.remote(0x704);
    check(device.got(0x704).len() == 1, "guarding is not answered with heartbeat off")
}

fn heartbeat_ignores_rtr(device: &mut Device) -> Result<(), String> {
    device.write_ok(0x100C, 0, &100u16.to_le_bytes())?;
    device.write_ok(0x100D, 0, &[3])?;
    device.write_ok(0x1017, 0, &1000u16.to_le_bytes())?;
    device.wait_ms(1);
    device.sent.clear();
    device.remote(0x704);
    device.wait_ms(900);
    check(device.got(0x704).is_empty(), "RTR was answered while the heartbeat is on")
}

fn heartbeat_beside_guarding(device: &mut Device) -> Result<(), String> {
    device.write_ok(0x100C, 0, &100u16.to_le_bytes())?;
    device.write_ok(0x100D, 0, &[3])?;
    device.write_ok(0x1017, 0, &200u16.to_le_bytes())?;
    device.sent.clear();
    device.wait_ms(2000);
    let times: Vec<_> = device.sent.iter().filter(|sent| sent.id == 0x704).map(|sent| sent.t_ns).collect();
    let even = times.windows(2).all(|pair| pair[1] - pair[0] == 200 * MS);
    check(times.len() == 11 && even, "heartbeats do not come every 200 ms")
}

fn stored(device: &mut Device, word: &[u8], period: u16) -> Result<(), String> {
    device.write_ok(0x1017, 0, &period.to_le_bytes())?;
    let right = word == b"save";
    let code = device.write(0x1010, 1, word)?;
    check(code == (!right).then_some(0x0800_0020), "1010:01 takes only \"save\"")?;
    device.nmt(129);
    device.expect(0x1017, 0, &if right { period } else { 0 }.to_le_bytes())
}

/// 1020h keeps date and time with the parameters.
fn configuration_date(device: &mut Device) -> Result<(), String> {
    device.write_ok(0x1020, 1, &12345u32.to_le_bytes())?;
    device.write_ok(0x1020, 2, &678u32.to_le_bytes())?;
    device.write_ok(0x1010, 2, b"save")?;
    device.nmt(129);
    device.expect(0x1020, 1, &12345u32.to_le_bytes())?;
    device.expect(0x1020, 2, &678u32.to_le_bytes())
}
