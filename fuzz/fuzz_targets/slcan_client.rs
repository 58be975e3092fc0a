//! SLCAN, the driver's side: whatever an adapter says, and however long it takes, the driver never has more frames on
//! their way than it may, reports each frame it gave once, and knows when it wants to be called again.

#![no_main]

use dinrail_can::protocol::Frame;
use dinrail_can::protocol::peer::{Heard, Peer};
use dinrail_can::protocol::slcan_client::{Channel, Client};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    let Some((&options, mut rest)) = data.split_first() else { return };
    let mut client = Client::new(Channel {
        rate_code: options & 7,
        data_rate_code: (options & 8 != 0).then_some(2),
        timestamps: options & 16 != 0,
        restart_ns: if options & 32 != 0 { 0 } else { 100_000_000 },
    });
    let (mut now_ns, mut out, mut flight, mut up) = (1u64, Vec::new(), 0usize, false);
    client.connected(now_ns, &mut out);
    let mut heard = Vec::new();
    // Each piece: time that passes, length, what the adapter says.
    while let Some((&[time, len], more)) = rest.split_first_chunk::<2>() {
        let (piece, more) = more.split_at(usize::from(len & 0x3F).min(more.len()));
        rest = more;
        now_ns += u64::from(time) * 20_000_000;
        client.receive(piece, now_ns, &mut out, &mut |h| heard.push(h));
        if client.deadline_ns().is_some_and(|at_ns| at_ns <= now_ns) {
            client.tick(now_ns, &mut out, &mut |h| heard.push(h));
        }
        for item in heard.drain(..) {
            match item {
                Heard::Up => up = true,
                Heard::Restarting(_) | Heard::Fault(_) => up = false,
                Heard::Sent | Heard::Refused => {
                    assert!(flight > 0, "a frame is reported twice");
                    flight -= 1;
                }
                Heard::Frame(frame, t_ns) => {
                    frame.validate().unwrap();
                    assert!(t_ns <= now_ns);
                }
                Heard::State(..) | Heard::Note(_) => {}
            }
        }
        if up && len & 0x40 != 0 && flight < client.flight() {
            flight += 1;
            let frame = Frame::data(u32::from(time), false, &[len]).unwrap();
            assert!(client.fits(&frame));
            client.send(&frame, now_ns, &mut out, &mut |h| heard.push(h));
        }
        assert!(out.len() < 1 << 20);
        out.clear();
    }
});
