//! The bus itself: off, and back.

use super::{Event, Network};
use ipc_types::payload::CanFrame;

impl Network {
    pub(super) fn on_error_frame(&mut self, t_ns: u64, frame: &CanFrame) {
        // Classes of linux/can/error.h.
        const BUS_OFF: u32 = 0x40;
        const RESTARTED: u32 = 0x100;
        if frame.can_id & BUS_OFF != 0 && !self.bus_off {
            self.bus_off = true;
            self.counters.bus_offs += 1;
            self.next_sync_ns = None;
            self.lss.bus_off();
            for i in 0..self.nodes.len() {
                self.nodes[i].boot.stop();
                self.nodes[i].watch = None;
                self.gate(t_ns, i);
            }
            self.tell(Event::BusOff);
        } else if frame.can_id & RESTARTED != 0 && self.bus_off {
            self.bus_back(t_ns);
        }
    }

    pub(super) fn bus_back(&mut self, now_ns: u64) {
        self.bus_off = false;
        self.next_sync_ns = self.settings.sync_period_ns.map(|_| now_ns);
        self.tell(Event::BusBack);
        self.boot_all(now_ns);
    }
}
