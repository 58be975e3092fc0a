use super::*;
use crate::testing::{MemoryImage, SPEC_EXAMPLES, hex, rows, to_hex};
use proptest::prelude::*;

fn ask(image: &mut MemoryImage, pdu: &[u8]) -> Vec<u8> {
    let mut out = [0; MAX_PDU];
    let (mut line, identity) = (LineState::default(), Identity::default());
    let outcome = answer(pdu, &mut Unit { line: &mut line, identity: &identity }, image, &mut out);
    assert_eq!(outcome.function, pdu.first().copied().unwrap_or(0));
    assert_eq!(outcome.exception.is_some(), out[0] & 0x80 != 0);
    out[..outcome.len].to_vec()
}

fn ask_hex(image: &mut MemoryImage, pdu: &str) -> String {
    to_hex(&ask(image, &hex(pdu)))
}

/// The device that the examples of V1.1b3 clause 6 talk to.
fn example_device() -> MemoryImage {
    let mut image = MemoryImage::new(65536);
    MemoryImage::set_bits(&mut image.coils[0x13..], &[0xCD, 0x6B, 0x05]);
    MemoryImage::set_bits(&mut image.discrete[0xC4..], &[0xAC, 0xDB, 0x35]);
    image.holding[0x6B..0x6E].copy_from_slice(&[0x022B, 0, 0x64]);
    image.input[8] = 10;
    image.holding[3..9].copy_from_slice(&[0x00FE, 0x0ACD, 1, 3, 13, 0xFF]);
    image.files.insert(4, vec![0, 0x0DFE, 0x0020, 0, 0, 0, 0, 0, 0, 0]);
    image.files.insert(3, vec![0, 0, 0, 0, 0, 0, 0, 0, 0, 0x33CD, 0x0040]);
    image.fifos.insert(1246, vec![0x01B8, 0x1284]);
    image
}

#[test]
fn examples_of_the_specification_are_answered_byte_for_byte() {
    let mut answered = 0;
    for row in rows(SPEC_EXAMPLES) {
        let mut image = example_device();
        let got = ask_hex(&mut image, row[2]);
        if ["11", "12"].contains(&row[1]) {
            // The example's device is busy and has counted 264 events; this one is neither.
            assert_eq!(&got[..2], &row[3][..2], "{row:?}");
            continue;
        }
        // The 19 and 22 bits read in 6.1 and 6.2 are 3 bytes; clause 6.2 leaves the unused ones zero.
        assert_eq!(got, row[3], "{row:?}");
        answered += 1;
        match row[1] {
            "15" => assert_eq!(
                &image.coils[0x13..0x1D],
                [true, false, true, true, false, false, true, true, true, false]
            ),
            "16" => assert_eq!(image.holding[1..3], [0x000A, 0x0102]),
            "21" => assert_eq!(image.files[&4][7..], [0x06AF, 0x04BE, 0x100D]),
            "23" => assert_eq!(image.holding[0x0E..0x11], [0xFF, 0xFF, 0xFF]),
            _ => {}
        }
    }
    assert_eq!(answered, 15);
}

#[test]
fn files_and_queues_are_checked_before_anything_is_done() {
    let mut image = example_device();
    image.fifos.insert(1, (0..32).collect());
    for (request, expected) in [
        ("14 07 06 0004 0001 0002", "1406 05 06 0DFE0020"),
        ("14 07 05 0004 0001 0002", "9402"),
        ("14 07 06 0000 0001 0002", "9402"),
        ("14 07 06 0004 0009 0002", "9402"),
        ("14 07 06 0004 270F 0002", "9402"),
        ("14 0E 06 0004 0001 0001 06 0009 0001 0001", "9402"),
        ("15 09 06 0004 000A 0001 1234", "9502"),
        ("15 12 06 0004 0001 0001 1234 06 0009 0001 0001 1234", "9502"),
        ("18 04DE", "18000600 0201B81284"),
        ("18 0001", "9803"),
        ("18 0002", "9802"),
    ] {
        assert_eq!(ask_hex(&mut image, request), expected.replace(' ', ""), "{request}");
    }
    assert_eq!((image.files[&4][1], image.writes), (0x0DFE, 0));
    image.ready = false;
    for (request, expected) in [
        ("14 07 06 0004 0001 0002", "9404"),
        ("15 09 06 0004 0001 0001 1234", "9504"),
        ("18 04DE", "9804"),
        ("18 0002", "9802"),
    ] {
        assert_eq!(ask_hex(&mut image, request), expected, "{request}");
    }
}

#[test]
fn mask_write_of_the_specification() {
    let mut image = MemoryImage::new(16);
    image.holding[4] = 0x12;
    assert_eq!(ask_hex(&mut image, "16 0004 00F2 0025"), "16000400F20025");
    assert_eq!(image.holding[4], 0x17);
}

#[test]
fn checks_come_in_the_order_function_value_address_execution() {
    let mut image = MemoryImage::new(100);
    image.ready = false;
    image.busy = true;
    // Everything is wrong with it; then one thing less each time.
    for (request, expected) in [
        ("09 FFFF 0000", "8901"),
        ("03 FFFF 0000", "8303"),
        ("03 FFFF 0001", "8302"),
        ("03 0000 0001", "8304"),
    ] {
        assert_eq!(ask_hex(&mut image, request), expected, "{request}");
    }
    for (request, expected) in
        [("10 FFFF 0001 04 0000", "9003"), ("10 FFFF 0001 02 0000", "9002"), ("10 0000 0001 02 0000", "9004")]
    {
        assert_eq!(ask_hex(&mut image, request), expected, "{request}");
    }
    image.ready = true;
    for (request, expected) in [
        ("10 0000 0001 02 0000", "9006"),
        ("05 0000 FF00", "8506"),
        ("06 0000 0001", "8606"),
        ("0F 0000 0001 01 01", "8F06"),
        ("16 0000 0000 0000", "9606"),
        ("17 0000 0001 0000 0001 02 0000", "9706"),
        ("03 0000 0001", "03020000"),
    ] {
        assert_eq!(ask_hex(&mut image, request), expected, "{request}");
    }
    assert_eq!(image.writes, 0);
}

#[test]
fn addresses_end_where_the_table_ends() {
    let mut image = MemoryImage::new(100);
    for (request, expected) in [
        ("03 0063 0001", "03020000"),
        ("03 0063 0002", "8302"),
        ("03 FFFF 0002", "8302"),
        ("01 005C 0008", "010100"),
        ("01 005C 0009", "8102"),
        ("0F 0063 0002 01 03", "8F02"),
        ("16 0064 0000 0000", "9602"),
    ] {
        assert_eq!(ask_hex(&mut image, request), expected, "{request}");
    }
}

#[test]
fn read_write_checks_both_ranges_first_and_writes_before_it_reads() {
    let mut image = MemoryImage::new(100);
    assert_eq!(ask_hex(&mut image, "17 0064 0001 0000 0001 02 1234"), "9702");
    assert_eq!(ask_hex(&mut image, "17 0000 0001 0064 0001 02 1234"), "9702");
    assert_eq!((image.writes, image.holding[0]), (0, 0));
    assert_eq!(ask_hex(&mut image, "17 0000 0002 0001 0001 02 1234"), "170400001234");
}

proptest! {
    #[test]
    fn any_request_gets_a_whole_answer(pdu in proptest::collection::vec(any::<u8>(), 1..=MAX_PDU)) {
        let mut image = MemoryImage::new(65536);
        let reply = ask(&mut image, &pdu);
        prop_assert!((2..=MAX_PDU).contains(&reply.len()));
        if let Ok(request) = crate::protocol::pdu::decode_request(&pdu) {
            prop_assert!(crate::protocol::decode_response(&request, &reply).is_ok());
        }
    }

    #[test]
    fn coils_written_are_coils_read(
        address in 0_u16..1000, quantity in 1_u16..=1968, packed in proptest::collection::vec(any::<u8>(), 246),
    ) {
        let mut image = MemoryImage::new(4000);
        let n = bytes_for_bits(quantity);
        let mut write = vec![15];
        write.extend(address.to_be_bytes());
        write.extend(quantity.to_be_bytes());
        write.push(n as u8);
        write.extend(&packed[..n]);
        ask(&mut image, &write);
        let mut read = vec![1];
        read.extend(address.to_be_bytes());
        read.extend(quantity.to_be_bytes());
        let reply = ask(&mut image, &read);
        for i in 0..usize::from(quantity) {
            prop_assert_eq!(reply[2 + i / 8] >> (i % 8) & 1, packed[i / 8] >> (i % 8) & 1);
        }
    }
}
