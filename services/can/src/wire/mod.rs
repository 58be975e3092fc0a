//! What stands between the bus and the world: a kernel interface, a serial adapter, a remote bus.
//!
//! A backend is one task. It opens its wire, moves frames between wire and [`Hub`], and when the wire goes away it says so
//! once and tries again with back-off, for ever: adapters are pulled and plugged in again. It never ends the service.

pub mod filter;
pub mod netlink;
pub mod port;
pub mod remote;
pub mod socketcan;

use std::cell::RefCell;
use std::rc::Rc;
use std::time::Duration;

use ipc_types::event::Level;
use serde::Serialize;

use crate::protocol::error_frame::ControllerState;
use crate::server::{Host, Hub};

/// First and longest pause before a wire is opened again.
const BACK_OFF: (Duration, Duration) = (Duration::from_millis(100), Duration::from_secs(5));
/// A frame on its way for longer than this: nobody acknowledges.
const NO_ACK_NS: u64 = 1_000_000_000;

/// What the status says about the wire.
#[derive(Debug, Clone, Default, Serialize)]
pub struct LinkStatus {
    /// Interface, device or address.
    pub interface: String,
    /// Carries frames now.
    pub up: bool,
    /// State of the controller, as far as it is told.
    pub state: Option<ControllerState>,
    /// Transmit error counter.
    pub tec: Option<u16>,
    /// Receive error counter.
    pub rec: Option<u16>,
    /// Bit rate that the interface has, in bit/s.
    pub bitrate: Option<u32>,
    /// Data bit rate that the interface has, in bit/s.
    pub data_bitrate: Option<u32>,
    /// Times in bus-off.
    pub bus_off: u64,
    /// Times restarted after bus-off.
    pub restarts: u64,
    /// Times the wire went away or down.
    pub downs: u64,
    /// Frames that the kernel dropped because this process did not read in time.
    pub kernel_drops: u64,
    /// Times the kernel's transmit queue was full.
    pub tx_busy: u64,
    /// Filters in the kernel; 0: every frame comes.
    pub filters: usize,
    /// The last error frame in words.
    pub last_error: Option<String>,
    /// Why it is down, with the remedy.
    pub trouble: Option<String>,
}

/// The wire's side of the hub.
pub struct Line<H: Host> {
    /// The bus.
    pub hub: Rc<Hub<H>>,
    /// What the status shows.
    pub status: Rc<RefCell<LinkStatus>>,
}

impl<H: Host + 'static> Line<H> {
    /// A line to the wire of this name.
    pub fn new(hub: Rc<Hub<H>>, interface: &str) -> Self {
        let status = LinkStatus { interface: interface.to_owned(), ..LinkStatus::default() };
        Self { hub, status: Rc::new(RefCell::new(status)) }
    }

    fn say(&self, level: Level, message: String) {
        let up = self.status.borrow().up;
        self.hub.look(|_, host| host.link(level, message, up));
    }

    /// The wire carries frames.
    fn up(&self, message: String) {
        {
            let mut status = self.status.borrow_mut();
            if status.up {
                return;
            }
            status.up = true;
            status.trouble = None;
        }
        self.hub.turn(|bus, _, now_ns| bus.wire_up(now_ns));
        self.say(Level::Info, message);
    }

    /// The wire carries nothing, with reason and remedy; said once per reason.
    fn down(&self, why: String) {
        {
            let mut status = self.status.borrow_mut();
            if status.trouble.as_ref() == Some(&why) {
                return;
            }
            status.downs += u64::from(status.up);
            status.up = false;
            status.state = None;
            (status.tec, status.rec) = (None, None);
            status.trouble = Some(why.clone());
        }
        self.hub.look(|bus, _| bus.wire_down());
        self.say(Level::Warning, why);
    }

    /// The controller is in this state; a change is said.
    fn state(&self, state: ControllerState, words: &str) {
        let before = self.status.borrow_mut().state.replace(state);
        // The first word of a healthy controller is no news.
        if before == Some(state) || (before.is_none() && state == ControllerState::Active) {
            return;
        }
        let level = match state {
            ControllerState::Active => Level::Info,
            ControllerState::Warning | ControllerState::Passive => Level::Warning,
            ControllerState::BusOff => {
                self.status.borrow_mut().bus_off += 1;
                Level::Fault
            }
        };
        let interface = self.status.borrow().interface.clone();
        let state = state.words();
        let why = if words == state { String::new() } else { format!(": {words}") };
        self.say(level, format!("{interface} is {state}{why}"));
    }
}

/// Pauses between attempts: 100 ms, doubled up to 5 s.
#[derive(Debug)]
struct BackOff(Duration);

impl Default for BackOff {
    fn default() -> Self {
        Self(BACK_OFF.0)
    }
}

impl BackOff {
    async fn wait(&mut self) {
        tokio::time::sleep(self.0).await;
        self.0 = (self.0 * 2).min(BACK_OFF.1);
    }
}
