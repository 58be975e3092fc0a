//! Reads the EDS and DCF files of a stack file.

use crate::config::{MasterConfig, SlaveConfig};
use crate::device::Device;
use crate::mistakes::{Mistake, Mistakes};
use crate::protocol::eds::{BuildOptions, Eds};
use crate::slave::simulation;
use std::collections::BTreeMap;
use std::path::Path;

/// Findings of a file that are shown; `dinrail canopen eds check` shows all.
const SHOWN: usize = 3;
/// Largest value of the scratch domain of a simulated device.
const SCRATCH_BYTES: u32 = 1 << 20;

/// Reads a file; what it says that cannot be is a mistake at `key`.
fn read(file: &str, dir: &Path, key: &str, mistakes: &mut Mistakes) -> Option<Eds> {
    let bytes = match std::fs::read(dir.join(file)) {
        Ok(bytes) => bytes,
        Err(e) => {
            mistakes.add(key, format!("{file}: {e}"), "name an EDS or DCF, from the stack file's folder on");
            return None;
        }
    };
    match Eds::parse(&bytes) {
        Ok(eds) => {
            for diag in eds.warnings.iter().take(SHOWN) {
                mistakes.warn(
                    key,
                    format!("{file}: {diag}"),
                    format!("`dinrail canopen eds check {file}` shows all"),
                );
            }
            Some(eds)
        }
        Err(e) => {
            mistakes.add(key, format!("{file}: {e}"), "get the EDS from the device's maker");
            None
        }
    }
}

fn device(eds: &Eds, node: u8, options: &BuildOptions, key: &str, mistakes: &mut Mistakes) -> Option<Device> {
    match Device::from_eds(eds, node, options) {
        Ok(device) => Some(device),
        Err(e) => {
            mistakes.add(key, e.to_string(), "mend the EDS, or get another from the device's maker");
            None
        }
    }
}

/// The devices of a master's nodes, and what is wrong with their files.
pub fn devices(config: &MasterConfig, dir: &Path) -> (BTreeMap<u8, Device>, Vec<Mistake>) {
    let mut mistakes = Mistakes::default();
    let mut devices = BTreeMap::new();
    let mut files: BTreeMap<&str, Option<Eds>> = BTreeMap::new();
    for (i, node) in config.nodes.iter().enumerate().filter(|(_, n)| (1..=127).contains(&n.id)) {
        let Some(file) = &node.eds else { continue };
        let key = format!("node[{i}].eds");
        // Ten equal nodes read their file once.
        let eds = files.entry(file).or_insert_with(|| read(file, dir, &key, &mut mistakes));
        if let Some(eds) = eds
            && let Some(device) = device(eds, node.id, &BuildOptions::default(), &key, &mut mistakes)
        {
            devices.insert(node.id, device);
        }
    }
    (devices, mistakes.0)
}

/// The device that a slave is. A DCF's values are what it starts with.
pub fn slave(config: &SlaveConfig, dir: &Path, mistakes: &mut Mistakes) -> Option<Device> {
    let mut options = BuildOptions { parameter_values: true, ..BuildOptions::default() };
    let (eds, key) = match (&config.eds, config.simulate) {
        (Some(file), None) => (read(file, dir, "eds", mistakes)?, "eds"),
        (None, Some(simulation)) => {
            options.capacities.push((0x2000, 0, SCRATCH_BYTES));
            match Eds::parse(simulation::eds(simulation).as_bytes()) {
                Ok(eds) => (eds, "simulate"),
                Err(e) => {
                    mistakes.add("simulate", e.to_string(), "report this: the simulation's own EDS is wrong");
                    return None;
                }
            }
        }
        (Some(_), Some(_)) => {
            mistakes.add("simulate", "eds and simulate exclude each other", "leave one of them out");
            return None;
        }
        (None, None) => {
            let help = "set eds = \"FILE\", or simulate = \"401\" for a ready I/O device";
            mistakes.add("eds", "nothing says what device this is", help);
            return None;
        }
    };
    // A device without node-id has its objects all the same.
    let node = if (1..=127).contains(&config.node_id) { config.node_id } else { 0 };
    let mut device = device(&eds, node, &options, key, mistakes)?;
    if let Some(serial) = config.serial_number
        && device.od.set_uint(0x1018, 4, u64::from(serial)).is_err()
    {
        mistakes.add("serial_number", "the EDS has no object 1018:04", "leave serial_number out");
    }
    Some(device)
}
