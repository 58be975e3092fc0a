//! socketcand, the driver's side: whatever a server says, wherever the stream breaks, frames that come are frames, and each
//! frame given is reported once.

#![no_main]

use dinrail_can::protocol::Frame;
use dinrail_can::protocol::peer::{Heard, Peer};
use dinrail_can::protocol::socketcand_client::Client;
use libfuzzer_sys::fuzz_target;

fn talk<'a>(pieces: impl Iterator<Item = &'a [u8]>) -> Vec<Heard> {
    let mut client = Client::new("can0");
    let (mut out, mut heard) = (Vec::new(), Vec::new());
    client.connected(1, &mut out);
    for piece in pieces {
        client.receive(piece, 2, &mut out, &mut |h| heard.push(h));
    }
    heard
}

fuzz_target!(|data: &[u8]| {
    let heard = talk(std::iter::once(data));
    assert_eq!(heard, talk(data.chunks(1)));
    for item in &heard {
        if let Heard::Frame(frame, _) = item {
            frame.validate().unwrap();
        }
    }
    let mut client = Client::new("can0");
    let (mut out, mut given) = (Vec::new(), Vec::new());
    client.connected(1, &mut out);
    client.receive(data, 2, &mut out, &mut |h| given.push(h));
    if given.contains(&Heard::Up) && !given.iter().any(|h| matches!(h, Heard::Fault(_))) {
        out.clear();
        given.clear();
        let frame = Frame::data(0x123, false, data.get(..data.len().min(8)).unwrap_or(&[])).unwrap();
        client.send(&frame, 3, &mut out, &mut |h| given.push(h));
        assert_eq!(given, [Heard::Sent]);
        assert!(!out.is_empty());
    }
});
