//! What the network's nodes and objects are called.

use crate::config::ObjectRef;
use crate::device::Device;
use crate::protocol::od::Entry;
use std::collections::BTreeMap;

/// Names from the stack file and from the EDS files.
pub(super) struct Book {
    pub devices: BTreeMap<u8, Device>,
    pub names: BTreeMap<u8, String>,
}

impl Book {
    /// `node 5 (Test I/O)`.
    pub fn node(&self, node: u8) -> String {
        match self.names.get(&node).filter(|name| !name.is_empty()) {
            Some(name) => format!("node {node} ({name})"),
            None => format!("node {node}"),
        }
    }

    /// `1018:01 Vendor-ID`.
    pub fn object(&self, node: u8, index: u16, sub: u8) -> String {
        match self.devices.get(&node).and_then(|d| d.name_of(index, sub)) {
            Some(name) => format!("{index:04X}:{sub:02X} {name}"),
            None => format!("{index:04X}:{sub:02X}"),
        }
    }

    /// The object meant, by number or by its name in the EDS.
    pub fn resolve(&self, node: u8, object: &ObjectRef) -> Result<(u16, u8), String> {
        if !(1..=127).contains(&node) {
            return Err(format!("node-id {node} does not exist; node-ids are 1 to 127"));
        }
        match (object.number(), self.devices.get(&node)) {
            // A number needs no EDS: devices have objects that theirs does not know.
            (Some(number), _) => Ok(number),
            (None, Some(device)) => device.resolve(object),
            (None, None) => {
                Err(format!("node {node} has no EDS that names objects; write the number of '{object}'"))
            }
        }
    }

    /// What the EDS says of an object.
    pub fn entry(&self, node: u8, (index, sub): (u16, u8)) -> Option<&Entry> {
        self.devices.get(&node).and_then(|d| d.od.entry(d.od.find(index, sub).ok()?))
    }
}
