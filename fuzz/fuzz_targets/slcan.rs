//! SLCAN: any stream is cut into the same commands wherever it breaks, and a frame a client sends comes back
//! as the text of the same frame.

#![no_main]

use dinrail_can::protocol::slcan::{Action, Command, Decoder, MAX_TEXT, Session, encode};
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
    for command in &found {
        match session.handle(command) {
            Action::Reply(reply) => assert!(!reply.is_empty()),
            Action::Transmit { frame, .. } => {
                assert!(session.receives());
                frame.validate().unwrap();
                let stamp = session.timestamps().then_some(u64::MAX);
                let mut text = [0; MAX_TEXT];
                let len = encode(&frame, stamp, &mut text);
                assert_eq!(commands(std::iter::once(&text[..len])), [Command::Transmit(frame)]);
            }
        }
    }
});
