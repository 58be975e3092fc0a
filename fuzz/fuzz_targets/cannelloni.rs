//! cannelloni: any stream is taken apart in the same way wherever it breaks, nothing follows the end of sense, and a frame
//! that is read can be written and read again.

#![no_main]

use dinrail_can::protocol::cannelloni::{Decoder, GREETING, Item, MAX_BYTES, encode};
use libfuzzer_sys::fuzz_target;

fn items<'a>(pieces: impl Iterator<Item = &'a [u8]>) -> Vec<Item> {
    let mut decoder = Decoder::default();
    let mut found = Vec::new();
    for mut piece in pieces {
        while let Some(item) = decoder.next(&mut piece) {
            found.push(item);
        }
        assert!(piece.is_empty());
    }
    found
}

fuzz_target!(|data: &[u8]| {
    let found = items(std::iter::once(data));
    assert_eq!(found, items(data.chunks(1)));
    for (n, item) in found.iter().enumerate() {
        match item {
            Item::Greeted => assert_eq!(n, 0),
            Item::Lost(_) => assert_eq!(n + 1, found.len()),
            Item::Frame(frame) => {
                assert!(n > 0);
                frame.validate().unwrap();
                let mut bytes = [0; MAX_BYTES];
                let len = encode(frame, &mut bytes);
                let mut expected = *frame;
                if frame.is_remote() {
                    // Written without its length.
                    expected.len = 0;
                }
                let again = items([GREETING, &bytes[..len]].into_iter());
                assert_eq!(again, [Item::Greeted, Item::Frame(expected)]);
            }
        }
    }
});
