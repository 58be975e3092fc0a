//! What the network may write into the communication profile, and what reading it gives: the node's part in SDO
//! accesses.

use super::com::Com;
use super::event::NodeEvent;
use crate::protocol::abort::Abort;
use crate::protocol::cob_id::CobId;
use crate::protocol::data_type::unsigned;
use crate::protocol::error_control::{ErrorBehaviour, heartbeat};
use crate::protocol::od::{Accept, Hooks, ObjectDictionary};
use crate::protocol::{pdo, sdo, store, sync};

/// Objects of the communication profile (CiA 301 V4.2, 7.5.2) that the node itself serves.
pub mod object {
    pub const ERROR_REGISTER: u16 = 0x1001;
    pub const ERROR_FIELD: u16 = 0x1003;
    pub const SYNC_COB_ID: u16 = 0x1005;
    pub const CYCLE_PERIOD: u16 = 0x1006;
    pub const SYNC_WINDOW: u16 = 0x1007;
    pub const GUARD_TIME: u16 = 0x100C;
    pub const LIFE_TIME_FACTOR: u16 = 0x100D;
    pub const STORE: u16 = 0x1010;
    pub const RESTORE: u16 = 0x1011;
    pub const TIME_COB_ID: u16 = 0x1012;
    pub const EMCY_COB_ID: u16 = 0x1014;
    pub const EMCY_INHIBIT: u16 = 0x1015;
    pub const HEARTBEAT_CONSUMER: u16 = 0x1016;
    pub const HEARTBEAT_PRODUCER: u16 = 0x1017;
    pub const IDENTITY: u16 = 0x1018;
    pub const SYNC_OVERFLOW: u16 = 0x1019;
    pub const EMCY_CONSUMER: u16 = 0x1028;
    pub const ERROR_BEHAVIOUR: u16 = 0x1029;
    /// CiA 302-2 V4.1.
    pub const NMT_STARTUP: u16 = 0x1F80;
}
use object::*;

/// May the network write `data`? What is no object of the communication profile passes.
pub fn check_write(od: &ObjectDictionary, index: u16, sub: u8, data: &[u8]) -> Result<(), Abort> {
    let value = unsigned(data.get(..8).unwrap_or(data)) as u32;
    match index {
        // 7.5.2.4: a 0 to sub-index 0 empties the history, nothing else can be written.
        ERROR_FIELD if sub > 0 => Err(Abort::READ_ONLY),
        ERROR_FIELD if value != 0 => Err(Abort::INVALID_VALUE),
        SYNC_COB_ID => sync_cob_id(od, CobId(value)),
        TIME_COB_ID => time_cob_id(od, CobId(value)),
        EMCY_COB_ID => pdo::check::cob_id(CobId(od.u32(EMCY_COB_ID, 0).unwrap_or(u32::MAX)), CobId(value)),
        EMCY_CONSUMER if sub > 0 => {
            pdo::check::cob_id(CobId(od.u32(index, sub).unwrap_or(u32::MAX)), CobId(value))
        }
        HEARTBEAT_CONSUMER if sub > 0 => heartbeat_consumer(od, sub, value),
        SYNC_OVERFLOW => sync_overflow(od, value),
        ERROR_BEHAVIOUR if sub > 0 => {
            let known = u8::try_from(value).ok().and_then(ErrorBehaviour::from_object);
            known.map(|_| ()).ok_or(Abort::INVALID_VALUE)
        }
        STORE | RESTORE if sub > 0 => store::check(od, index, sub, value),
        0x1200..=0x12FF => sdo::validate_parameter(od, index, sub, data),
        0x1400..=0x1BFF => pdo::check::write(od, index, sub, data),
        _ => Ok(()),
    }
}

/// 7.5.2.5: bits 0-29 shall not change while the device produces SYNC (bit 30).
fn sync_cob_id(od: &ObjectDictionary, new: CobId) -> Result<(), Abort> {
    let old = CobId(od.u32(SYNC_COB_ID, 0).unwrap_or(0));
    let moved = old.bit30() && old.identity() != new.identity();
    if moved || new.fault().is_some() { Err(Abort::INVALID_VALUE) } else { Ok(()) }
}

/// 7.5.2.15: bits 0-29 shall not change while the device produces or consumes TIME (bits 30 and 31).
fn time_cob_id(od: &ObjectDictionary, new: CobId) -> Result<(), Abort> {
    let old = CobId(od.u32(TIME_COB_ID, 0).unwrap_or(0));
    let used = |cob: CobId| cob.bit30() || !cob.exists();
    let moved = used(old) && used(new) && old.identity() != new.identity();
    if moved || new.fault().is_some() { Err(Abort::INVALID_VALUE) } else { Ok(()) }
}

/// 7.5.2.19: several entries for one node are refused with 0604 0043h.
fn heartbeat_consumer(od: &ObjectDictionary, sub: u8, value: u32) -> Result<(), Abort> {
    let node = |value: u32| heartbeat::is_used(value).then(|| heartbeat::split_consumer_time(value).0);
    let Some(wanted) = node(value) else { return Ok(()) };
    let twice = (1..=127)
        .filter(|&other| other != sub)
        .any(|other| od.u32(HEARTBEAT_CONSUMER, other).and_then(node) == Some(wanted));
    if twice { Err(Abort::PARAMETER) } else { Ok(()) }
}

/// 7.5.2.22: 0 or 2-240, and only while 1006h is 0.
fn sync_overflow(od: &ObjectDictionary, value: u32) -> Result<(), Abort> {
    if od.u32(CYCLE_PERIOD, 0).unwrap_or(0) != 0 {
        return Err(Abort::DEVICE_STATE);
    }
    if value == 1 || value > u32::from(sync::COUNTER_MAX) { Err(Abort::INVALID_VALUE) } else { Ok(()) }
}

impl Hooks for Com {
    fn before_read(&mut self, od: &mut ObjectDictionary, index: u16, sub: u8) -> Result<(), Abort> {
        match (index, sub) {
            (ERROR_FIELD, 0) => {
                let count = self.emcy.history().len() as u64;
                od.set_uint(index, sub, count)
            }
            (ERROR_FIELD, sub) => {
                let value = self.emcy.history().get(usize::from(sub) - 1).copied().ok_or(Abort::NO_DATA)?;
                od.set_uint(index, sub, u64::from(value))
            }
            _ => Ok(()),
        }
    }
    fn before_write(
        &mut self,
        od: &mut ObjectDictionary,
        index: u16,
        sub: u8,
        data: &[u8],
    ) -> Result<Accept, Abort> {
        check_write(od, index, sub, data)?;
        match index {
            ERROR_FIELD => {
                self.emcy.clear_history();
                Ok(Accept::Taken)
            }
            STORE if sub > 0 => {
                self.store.save(od, sub);
                self.events.push(NodeEvent::StoreChanged);
                Ok(Accept::Taken)
            }
            RESTORE if sub > 0 => {
                self.store.restore(od, sub);
                self.events.push(NodeEvent::StoreChanged);
                Ok(Accept::Taken)
            }
            _ => Ok(Accept::Store),
        }
    }
    fn after_write(&mut self, _od: &mut ObjectDictionary, index: u16, sub: u8) {
        self.written = Some((index, sub));
    }
}
