//! A service of kind `canopen-slave`.

use super::master::OnBadWord;
use super::value::ObjectRef;
use ipc_types::outputs::STALE_AFTER;
use ipc_types::units::Span;
use serde::{Deserialize, Serialize};

/// The service's table of the stack file, without the launcher's keys.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// The can service. Default: the only one of the stack.
    pub bus: Option<String>,
    /// The plc service. Default: the only one of the stack.
    pub plc: Option<String>,
    /// 1 - 127; 255: not configured, waits for LSS.
    pub node_id: u8,
    /// EDS or DCF, relative to the stack file. Not needed where `simulate` says what the device is.
    pub eds: Option<String>,
    /// A ready device without process image.
    pub simulate: Option<Simulation>,
    /// File that keeps stored objects (1010h) and the node-id set by LSS, relative to the stack file. Absent: storing
    /// is answered by an abort.
    pub store: Option<String>,
    /// Overrides of 1018h:04, so that one EDS serves several devices.
    pub serial_number: Option<u32>,
    /// Age of the image above which the device reports an error (EMCY FF10h) and acts as 1029h says.
    pub stale_after: Span,
    /// Objects to and from the image.
    pub map: Vec<Map>,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            bus: None,
            plc: None,
            node_id: 0,
            eds: None,
            simulate: None,
            store: None,
            serial_number: None,
            stale_after: STALE_AFTER,
            map: Vec::new(),
        }
    }
}

/// Ready devices.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Simulation {
    /// CiA 401: 16 digital inputs and outputs, 4 analogue inputs and outputs. Inputs show the outputs, so that a
    /// master sees an effect.
    #[serde(rename = "401")]
    Cia401,
}

/// A value of an object to or from the image.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Map {
    pub object: ObjectRef,
    /// Place in %I: what the network writes.
    #[serde(default)]
    pub to: Option<String>,
    /// Place in %Q or %M: what the network reads.
    #[serde(default)]
    pub from: Option<String>,
    /// Name of a global variable for the program.
    #[serde(default)]
    pub symbol: Option<String>,
    /// What the PLC makes of it while the device is not operational.
    #[serde(default)]
    pub on_bad: OnBadWord,
}
