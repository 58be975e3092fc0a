//! An LSS master and slaves that hear anything. Each 10 bytes: who speaks (bit 0: a slave to the master, else a master
//! to the slaves; the rest chooses the master's next service), how long nothing happened, the frame. The master always
//! comes to an end, a slave answers a frame with one at most, and its node-id is always one.

#![no_main]

use dinrail_canopen::protocol::cob_id::predefined;
use dinrail_canopen::protocol::io::Outbox;
use dinrail_canopen::protocol::lss::master::{
    FastscanHint, Inquiry, LssMaster, LssRange, LssRequest, LssTimes,
};
use dinrail_canopen::protocol::lss::slave::{LssAbilities, LssSlave};
use dinrail_canopen::protocol::lss::{LssAddress, LssState, UNCONFIGURED};
use ipc_types::payload::CanFrame;
use libfuzzer_sys::fuzz_target;

const ADDRESS: LssAddress = LssAddress { vendor: 0x11, product: 0x22, revision: 0x33, serial: 0x8000_0001 };

fn request(n: u8) -> LssRequest {
    match n % 10 {
        0 => LssRequest::SwitchGlobal(LssState::Configuration),
        1 => LssRequest::SwitchSelective(ADDRESS),
        2 => LssRequest::ConfigureNodeId(n),
        3 => LssRequest::ConfigureBitTiming(n),
        4 => LssRequest::ActivateBitTiming { delay_ms: u16::from(n) },
        5 => LssRequest::Store,
        6 => LssRequest::Inquire(Inquiry::Serial),
        7 => LssRequest::Identify(LssRange {
            vendor: 0x11,
            product: 0x22,
            revision: (0, u32::from(n)),
            serial: (0, u32::MAX),
        }),
        8 => LssRequest::IdentifyNonConfigured,
        _ => LssRequest::Fastscan(FastscanHint {
            vendor: (n & 1 == 0).then_some(0x11),
            ..FastscanHint::default()
        }),
    }
}

fuzz_target!(|input: &[u8]| {
    let mut master = LssMaster::new(LssTimes::default());
    let other = LssAddress { serial: 7, ..ADDRESS };
    let mut slaves = [
        LssSlave::new(ADDRESS, UNCONFIGURED, LssAbilities::default()),
        LssSlave::new(other, 5, LssAbilities { store: false, bit_timing: 0 }),
    ];
    let (mut t_ns, mut out) = (0_u64, Outbox::default());
    for step in input.chunks_exact(10) {
        if !master.is_busy() {
            assert!(master.start(t_ns, request(step[0] >> 1)).is_ok());
        }
        t_ns += u64::from(step[1]) * 1_000_000;
        master.on_time(t_ns, &mut out);
        // What the master says reaches the slaves, and their answers the master.
        let said: Vec<CanFrame> = out.drain().collect();
        assert!(said.len() <= 1, "one frame, then its inhibit time");
        let foreign = CanFrame::classic(predefined::LSS_MASTER, &step[2..]);
        for frame in said.iter().chain((step[0] & 1 == 0).then_some(&foreign)) {
            for slave in &mut slaves {
                slave.on_frame(frame, &mut out);
                assert!(out.len() <= 1);
                let answers: Vec<CanFrame> = out.drain().collect();
                for answer in answers {
                    master.on_frame(t_ns, &answer);
                }
                let id = slave.pending_node_id();
                assert!((1..=127).contains(&id) || id == UNCONFIGURED);
            }
        }
        if step[0] & 1 == 1 {
            master.on_frame(t_ns, &CanFrame::classic(predefined::LSS_SLAVE, &step[2..]));
        }
    }
    // A service has at most so many questions, each with its timeout.
    for _ in 0..300 {
        let Some(at_ns) = master.next_deadline() else { break };
        t_ns = t_ns.max(at_ns);
        master.on_time(t_ns, &mut out);
        out.drain().for_each(drop);
    }
    assert!(!master.is_busy());
});
