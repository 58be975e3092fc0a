//! SDO channels: the COB-IDs of objects 1200-127Fh (servers) and 1280-12FFh (clients), and what may be written to
//! them (CiA 301 V4.2, 7.5.2.33 and 7.5.2.34).

use crate::protocol::abort::Abort;
use crate::protocol::cob_id::is_restricted;
use crate::protocol::data_type::unsigned;
use crate::protocol::od::ObjectDictionary;
use ipc_types::payload::id_flag;

/// Object of the first server channel (7.5.2.33).
pub const SERVER: u16 = 0x1200;
/// Object of the first client channel (7.5.2.34).
pub const CLIENT: u16 = 0x1280;
/// Channels of each kind.
pub const CHANNELS: u8 = 128;
/// Bit 31 of a COB-ID: the channel does not exist.
const INVALID: u32 = 1 << 31;
/// Bit 29 of a COB-ID: 29-bit identifier.
const FRAME: u32 = 1 << 29;
/// Predefined connection set (7.3.5, table 39): client to server.
const DEFAULT_REQUEST: u32 = 0x600;
/// Predefined connection set (7.3.5, table 39): server to client.
const DEFAULT_RESPONSE: u32 = 0x580;

/// The two identifiers of a channel, with Linux's flag for extended frames.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Channel {
    /// Client to server.
    pub request: u32,
    /// Server to client.
    pub response: u32,
    /// Node-id of the other end, 0 if not given.
    pub node_id: u8,
}

impl Channel {
    /// The default channel of node `node_id` (1-127).
    pub fn default_of(node_id: u8) -> Self {
        let id = u32::from(node_id & 0x7F);
        Self { request: DEFAULT_REQUEST + id, response: DEFAULT_RESPONSE + id, node_id }
    }
}

/// A COB-ID parameter as an identifier of a frame; `None` if the channel does not exist by it.
fn can_id(cob_id: u32) -> Option<u32> {
    if cob_id & INVALID != 0 {
        None
    } else if cob_id & FRAME != 0 {
        Some(cob_id & id_flag::EFF_MASK | id_flag::EFF)
    } else {
        Some(cob_id & id_flag::SFF_MASK)
    }
}

/// Server channel `n` (0-127) of this device. Channel 0 without object 1200h is the default channel of the
/// device's node-id.
pub fn server_channel(od: &ObjectDictionary, n: u8) -> Option<Channel> {
    let index = SERVER + u16::from(n.min(CHANNELS - 1));
    if n == 0 && od.object(index).is_none() {
        return (1..=127).contains(&od.node_id()).then(|| Channel::default_of(od.node_id()));
    }
    Some(Channel {
        request: can_id(od.u32(index, 1)?)?,
        response: can_id(od.u32(index, 2)?)?,
        node_id: od.u8(index, 3).unwrap_or(0),
    })
}

/// Client channel `n` (0-127) of this device.
pub fn client_channel(od: &ObjectDictionary, n: u8) -> Option<Channel> {
    let index = CLIENT + u16::from(n.min(CHANNELS - 1));
    Some(Channel {
        request: can_id(od.u32(index, 1)?)?,
        response: can_id(od.u32(index, 2)?)?,
        node_id: od.u8(index, 3).unwrap_or(0),
    })
}

/// May the network write `data` to this sub-object of 1200-12FFh? For the owner's `before_write`; everything
/// outside those objects is fine.
///
/// [`Abort::INVALID_VALUE`]: the identifier is restricted, or would change while the channel exists; the node-id is
/// not 1-127.
pub fn validate_parameter(od: &ObjectDictionary, index: u16, sub: u8, data: &[u8]) -> Result<(), Abort> {
    if !(SERVER..CLIENT + u16::from(CHANNELS)).contains(&index) {
        return Ok(());
    }
    let value = unsigned(data) as u32;
    match sub {
        1 | 2 => {
            let old = od.u32(index, sub).unwrap_or(INVALID);
            let changes = (old ^ value) & (FRAME | id_flag::EFF_MASK) != 0;
            let exists = old & INVALID == 0;
            let standard = value & FRAME == 0;
            if (exists && changes)
                || (standard && value & id_flag::EFF_MASK > id_flag::SFF_MASK)
                || (value & INVALID == 0 && standard && is_restricted(value & id_flag::SFF_MASK))
            {
                return Err(Abort::INVALID_VALUE);
            }
            Ok(())
        }
        3 if !(1..=127).contains(&value) => Err(Abort::INVALID_VALUE),
        _ => Ok(()),
    }
}
