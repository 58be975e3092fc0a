//! socketcand: any stream is cut into the same commands wherever it breaks; only valid frames reach the bus, only
//! after a bus was opened, and every one of them has a text.

#![no_main]

use dinrail_can::protocol::socketcand::{Action, Command, Decoder, MAX_TEXT, OK, Session, encode};
use libfuzzer_sys::fuzz_target;

fn commands<'a>(pieces: impl Iterator<Item = &'a [u8]>) -> Vec<Command> {
    let mut decoder = Decoder::default();
    let mut found = Vec::new();
    for mut piece in pieces {
        while let Some(command) = decoder.next(&mut piece) {
            found.push(command);
        }
        assert!(piece.is_empty());
    }
    found
}

fuzz_target!(|data: &[u8]| {
    let found = commands(std::iter::once(data));
    assert_eq!(found, commands(data.chunks(1)));
    let mut session = Session::default();
    let mut open = false;
    for command in &found {
        match session.handle(command, "can0") {
            Action::Reply(reply) => {
                open |= matches!(command, Command::Open(_)) && reply == OK;
                assert!(reply.starts_with(b"< ") && reply.ends_with(b" >"));
            }
            Action::ReplyAndClose(reply) => {
                assert!(!open && reply.starts_with(b"< error "));
                return;
            }
            Action::Refused => assert!(open),
            Action::Transmit(frame) => {
                assert!(open);
                frame.validate().unwrap();
                let mut text = [0; MAX_TEXT];
                let len = encode(&frame, u64::MAX, &mut text);
                assert!(text[..len].ends_with(b" >"), "cut: {}", String::from_utf8_lossy(&text[..len]));
            }
        }
    }
});
