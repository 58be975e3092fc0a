//! Mistakes in what the table says of the master itself.

use super::{cob_ids, times};
use crate::config::{MAX_NODES, MasterConfig as Config};
use crate::mistakes::Mistakes;

pub(super) fn check_master(config: &Config, mistakes: &mut Mistakes) {
    if !(1..=127).contains(&config.node_id) {
        let message = format!("node-id {} does not exist", config.node_id);
        mistakes.add("node_id", message, "node-ids are 1 to 127 (CiA 301 clause 7.2.3)");
    }
    if config.nodes.len() > MAX_NODES {
        let message =
            format!("{} nodes: a network has at most {MAX_NODES} besides its master", config.nodes.len());
        mistakes.add("node", message, "split them over two buses");
    }
    if config.nodes.is_empty() {
        mistakes.warn(
            "node",
            "the master has no nodes",
            "add [[service.node]]; `dinrail canopen scan --toml` finds them",
        );
    }
    times::check_master(config, mistakes);
    cob_ids::check_sync(config, mistakes);
    if config.sync_overflow == 1 || config.sync_overflow > 240 {
        let message = format!("a SYNC counter cannot overflow at {}", config.sync_overflow);
        mistakes.add(
            "sync_overflow",
            message,
            "take 0 for no counter, or 2 to 240 (CiA 301 clause 7.5.2.22)",
        );
    }
    if let Some(period) = config.sync_period
        && period.ns() < 1_000_000
    {
        let help = "take 1ms or more: one frame needs 0.13 ms at 1 Mbit/s";
        mistakes.add("sync_period", "the SYNC comes faster than a bus can carry it", help);
    }
    if let (Some(window), Some(period)) = (config.sync_window, config.sync_period)
        && window.ns() > period.ns()
    {
        mistakes.add(
            "sync_window",
            "the window is longer than the SYNC period",
            "make it shorter, or leave it out",
        );
    }
}
