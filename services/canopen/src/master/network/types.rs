//! What the network is told, what it tells, and what is known of a node.

use super::watch::Watch;
use crate::config::ErrorPolicy;
use crate::master::boot::{self, Boot, Failure, Loaded, OPERATIONAL};

/// How the network is run.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Settings {
    pub node_id: u8,
    pub sync_period_ns: Option<u64>,
    /// 0: no counter.
    pub sync_overflow: u8,
    pub sync_cob_id: u32,
    pub time_period_ns: Option<u64>,
    /// 0: none.
    pub heartbeat_ns: u64,
    pub start_nodes: bool,
    pub start_all_nodes: bool,
    pub reset_all_nodes: bool,
    pub stop_all_nodes: bool,
    /// 0: for ever.
    pub boot_time_ns: u64,
    pub nmt_inhibit_ns: u64,
    /// An earlier process of this master ran the network: nodes that are operational are left running.
    pub takeover: bool,
}

/// One node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NodeSettings {
    pub plan: boot::Plan,
    pub mandatory: bool,
    pub boot: bool,
    pub on_error: ErrorPolicy,
}

/// Something the user is told.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Event {
    /// A node is booted; `kept`: it was running already and was left alone; `loaded`: why its configuration was loaded,
    /// where that is a question of its date.
    Booted {
        node: u8,
        attempts: u32,
        kept: bool,
        loaded: Option<Loaded>,
    },
    BootFailed {
        node: u8,
        failure: Failure,
    },
    /// Error control lost it.
    Lost {
        node: u8,
        guarding: bool,
    },
    /// It told another NMT state than it should have.
    State {
        node: u8,
        state: u8,
        wanted: u8,
    },
    /// A boot-up message of a node that ran.
    Rebooted {
        node: u8,
    },
    Emcy {
        node: u8,
        code: u16,
        register: u8,
        vendor: [u8; 5],
    },
    /// A node that is not in the list sent its boot-up message (letter A).
    Unknown {
        node: u8,
    },
    /// Two devices seem to have this node-id.
    Duplicate {
        node: u8,
        sign: Sign,
    },
    /// Mandatory nodes were not booted in time; the first of them.
    MandatoryMissing {
        node: u8,
        missing: u8,
    },
    /// All mandatory nodes are booted.
    NetworkStarted,
    BusOff,
    BusBack,
}

/// What tells that two devices have one node-id.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sign {
    /// States without command, or boot-up messages in a row.
    States,
    /// Twice as many heartbeats as asked for.
    Heartbeats,
    /// The devices say so.
    Emcy,
}

/// What is known of a node.
#[derive(Debug, Clone)]
pub struct NodeRun {
    pub settings: NodeSettings,
    pub boot: Boot,
    /// NMT state it last told.
    pub state: Option<u8>,
    /// NMT state it was commanded to.
    pub wanted: u8,
    /// The safe state took it out of operation.
    pub(super) held: bool,
    pub last_failure: Option<Failure>,
    pub emcys: u64,
    pub last_emcy: Option<(u16, u8)>,
    /// Times it was lost.
    pub losses: u64,
    /// When it was booted last, and how long that took.
    pub booted_ns: Option<(u64, u64)>,
    /// It was running already at its last boot-up and was left alone (letter L).
    pub kept: bool,
    /// When a boot-up failed last.
    pub failed_ns: Option<u64>,
    pub(super) watch: Option<Watch>,
    pub(super) restart_at_ns: Option<u64>,
    pub(super) changes: u8,
    pub(super) changes_since_ns: u64,
    pub(super) beats: u8,
    pub(super) beats_since_ns: u64,
    pub(super) told_duplicate: bool,
}
impl NodeRun {
    pub(super) fn new(mut settings: NodeSettings, takeover: bool) -> Self {
        settings.plan.keep_alive |= takeover;
        let boot = Boot::new(settings.plan.clone());
        Self {
            settings,
            boot,
            state: None,
            wanted: 127,
            held: false,
            last_failure: None,
            emcys: 0,
            last_emcy: None,
            losses: 0,
            booted_ns: None,
            kept: false,
            failed_ns: None,
            watch: None,
            restart_at_ns: None,
            changes: 0,
            changes_since_ns: 0,
            beats: 0,
            beats_since_ns: 0,
            told_duplicate: false,
        }
    }
    pub fn id(&self) -> u8 {
        self.settings.plan.id
    }
    /// Process data is exchanged with it.
    pub fn is_operational(&self) -> bool {
        self.boot.is_running() && self.wanted == OPERATIONAL && self.state.is_none_or(|s| s == OPERATIONAL)
    }
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
pub struct Counters {
    pub syncs: u64,
    /// SYNCs left out because the process was late by a period or more.
    pub syncs_missed: u64,
    pub bus_offs: u64,
    pub nmt_commands: u64,
    /// Events that nobody took in time.
    pub events_dropped: u64,
}
