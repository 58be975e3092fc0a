use super::*;
use crate::protocol::{Response, ResponseError, decode_response, encode_response, mbap};
use crate::testing::{DEVICE_FRAMES, SPEC_EXAMPLES, hex, rows};
use proptest::prelude::*;

/// Decodes and encodes both PDUs and compares the bytes.
fn round_trip(request: &[u8], response: Option<&[u8]>, what: &str) {
    let decoded = decode_request(request).unwrap_or_else(|refused| panic!("{what}: {refused:?}"));
    let mut out = [0; MAX_PDU];
    let len = encode_request(&decoded, &mut out).unwrap();
    assert_eq!(&out[..len], request, "{what}");
    let Some(response) = response else { return };
    let answer = decode_response(&decoded, response).unwrap_or_else(|error| panic!("{what}: {error}"));
    let len = encode_response(&answer, &mut out).unwrap();
    assert_eq!(&out[..len], response, "{what}");
}

#[test]
fn examples_of_the_specification_byte_for_byte() {
    let mut served = 0;
    for row in rows(SPEC_EXAMPLES) {
        let (request, response) = (hex(row[2]), hex(row[3]));
        assert!(function_name(request[0]).is_some(), "{}: public code without a name", row[0]);
        round_trip(&request, Some(&response), row[4]);
        served += 1;
    }
    assert_eq!(served, 17);
}

/// Clause 6.21's example, and frames of the clauses that print none.
#[test]
fn the_other_public_codes_byte_for_byte() {
    for (request, response) in [
        ("11", "11 03 09 FF 41"),
        ("08 0001 FF00", "08 0001 FF00"),
        ("08 0002 0000", "08 0002 0001"),
        ("08 0003 2100", "08 0003 2100"),
        ("08 0004 0000", "88 01"),
        ("08 0000 0102 0304", "08 0000 0102 0304"),
        ("08 000B 0000", "08 000B 1234"),
        ("0C", "0C 46 FFFF 0108 0121 {64}"),
        ("14 07 06 0001 0000 0002", "14 06 05 06 1234 5678"),
        ("18 0000", "18 0002 0000"),
        ("2B 0E 01 00", "2B 0E 01 01 00 00 03 00 02 4142 01 01 43 02 00"),
        ("2B 0E 04 80", "2B 0E 04 83 FF 81 01 80 01 41"),
        ("2B 0D 00", "2B 0D 0102"),
        ("2B 0D", "2B 0D"),
    ] {
        round_trip(&hex(request), Some(&hex(&response.replace("{64}", &"20".repeat(64)))), request);
    }
}

#[test]
fn frames_of_the_replaced_devices_byte_for_byte() {
    let mut frames = 0;
    for row in rows(DEVICE_FRAMES).filter(|row| row[1] == "tcp") {
        let pdu = |text: &str| match mbap::scan(&hex(text)) {
            mbap::Scan::Frame { frame, used } => {
                assert_eq!(used * 2, text.len(), "{row:?}");
                let mut out = [0; mbap::MAX_ADU];
                let len = mbap::encode(frame.transaction, frame.unit, frame.pdu, &mut out).unwrap();
                assert_eq!(out[..len], hex(text), "{row:?}");
                frame.pdu.to_vec()
            }
            other => panic!("{row:?}: {other:?}"),
        };
        frames += 1;
        if row[3] == "-" {
            // A response alone: one input register.
            let request = Request::ReadInputRegisters { address: 0, quantity: 1 };
            assert_eq!(decode_response(&request, &pdu(row[4])), Ok(Response::ReadInputRegisters(&[0, 6])));
        } else {
            round_trip(&pdu(row[3]), Some(&pdu(row[4])), row[5]);
        }
    }
    // On a serial line the same PDUs stand between address and CRC.
    for row in rows(DEVICE_FRAMES).filter(|row| row[1] == "rtu") {
        let pdu = |text: &str| {
            let adu = hex(text);
            adu[1..adu.len() - 2].to_vec()
        };
        frames += 1;
        round_trip(&pdu(row[3]), (row[4] != "-").then(|| pdu(row[4])).as_deref(), row[5]);
    }
    assert_eq!(frames, 31);
}

#[test]
fn limits_and_lengths() {
    let registers = |n: usize| "00".repeat(n * 2);
    let write_words =
        |n: u16, data: usize| format!("10 0000 {n:04X} {:02X} {}", (data * 2) as u8, registers(data));
    let write_coils =
        |n: u16, data: usize| format!("0F 0000 {n:04X} {:02X} {}", data as u8, "00".repeat(data));
    let read_write = |r: u16, n: u16, data: usize| {
        format!("17 0000 {r:04X} 0000 {n:04X} {:02X} {}", (data * 2) as u8, registers(data))
    };
    let good = [
        "01 0000 0001",
        "01 0000 07D0",
        "02 FFFF 07D0",
        "03 0000 0001",
        "03 0000 007D",
        "04 0000 007D",
        "05 0000 0000",
        "05 0000 FF00",
        "06 FFFF FFFF",
        "16 0000 FFFF 0000",
        "15 09 06 0001 0000 0001 1234",
        "14 07 06 0001 270F 0001",
    ];
    for text in good.map(str::to_owned).into_iter().chain([
        write_words(1, 1),
        write_words(123, 123),
        write_coils(1, 1),
        write_coils(8, 1),
        write_coils(9, 2),
        write_coils(1968, 246),
        read_write(1, 1, 1),
        read_write(125, 121, 121),
    ]) {
        round_trip(&hex(&text), None, &text);
    }
    let bad = [
        "01 0000 0000",
        "01 0000 07D1",
        "02 0000 0000",
        "02 0000 FFFF",
        "03 0000 0000",
        "03 0000 007E",
        "04 0000 007E",
        "05 0000 1234",
        "05 0000 00FF",
        "05 0000 FF01",
        "03",
        "03 00",
        "03 0000 00",
        "03 0000 0002 00",
        "06 0000",
        "06 0000 0001 00",
        "16 0000 0000 00",
        "16 0000 0000 0000 00",
        "0F 0000 0064 01 FF",
        "0F 0000 0001 02 FFFF",
        "0F 0000 0001 00",
        "0F 0000 0008 01",
        "0F 0000 0000 00",
        "0F 0000",
        "10 0000 0002 02 0001",
        "10 0000 0001 02 00",
        "10 0000 0001 03 000000",
        "10 0000 0001 02 0000 00",
        "10",
        "17 0000 0001 0000 0001 02 00",
        "17 0000 0000 0000 0001 02 0000",
        "17 0000 007E 0000 0001 02 0000",
        "17 0000 0001 0000 0000 00",
        "17 0000 0001 0000 0001 04 0000 0000",
        "17 0000 0001 0000",
    ];
    for text in bad.map(str::to_owned).into_iter().chain([
        write_words(124, 124),
        write_words(0, 0),
        write_coils(1969, 247),
        read_write(1, 122, 122),
    ]) {
        let pdu = hex(&text);
        let refused = decode_request(&pdu).expect_err(&text);
        assert_eq!(refused, Refused { function: pdu[0], exception: Exception::IllegalDataValue }, "{text}");
    }
}

#[test]
fn function_comes_before_everything_else() {
    for function in (0..=255_u8).filter(|f| !matches!(f, 1..=8 | 11 | 12 | 15..=17 | 20..=24 | 43)) {
        for tail in [&[][..], &[0xFF; 3], &[0; 252]] {
            let mut pdu = vec![function];
            pdu.extend(tail);
            let refused = decode_request(&pdu).unwrap_err();
            assert_eq!(refused, Refused { function, exception: Exception::IllegalFunction });
            let mut out = [0; 2];
            encode_exception(function, refused.exception, &mut out).unwrap();
            assert_eq!(out, [function | 0x80, 1]);
        }
    }
    assert_eq!(decode_request(&[]).unwrap_err().exception, Exception::IllegalFunction);
    // Sub-functions and MEI types belong to the function.
    for sub in (0..=0xFF_u16).filter(|sub| !diagnostics::sub::ALL.contains(sub)) {
        let pdu = [&[8][..], &sub.to_be_bytes(), &[1, 2, 3]].concat();
        assert_eq!(decode_request(&pdu).unwrap_err().exception, Exception::IllegalFunction, "{sub}");
    }
    for mei in (0..=255_u8).filter(|mei| ![13, 14].contains(mei)) {
        assert_eq!(decode_request(&[43, mei, 9]).unwrap_err().exception, Exception::IllegalFunction, "{mei}");
    }
}

#[test]
fn responses_that_are_not_the_answer() {
    let read = Request::ReadHoldingRegisters { address: 0, quantity: 2 };
    let write = Request::WriteSingleRegister { address: 1, value: 2 };
    for (request, pdu, expected) in [
        (read, "", ResponseError::Empty),
        (read, "04 04 00000000", ResponseError::Function { expected: 3, got: 4 }),
        (read, "84 02", ResponseError::Function { expected: 3, got: 0x84 }),
        (read, "03 02 0000", ResponseError::Length { function: 3 }),
        (read, "03 04 000000", ResponseError::Length { function: 3 }),
        (read, "03 04 0000000000", ResponseError::Length { function: 3 }),
        (read, "83", ResponseError::Length { function: 3 }),
        (read, "83 02 00", ResponseError::Length { function: 3 }),
        (write, "06 0001 0003", ResponseError::Echo { function: 6 }),
        (write, "06 0001 0002 00", ResponseError::Length { function: 6 }),
        (Request::ReadExceptionStatus, "07", ResponseError::Length { function: 7 }),
        (
            Request::Diagnostics { sub_function: 0, data: &[1, 2] },
            "08 0000 0103",
            ResponseError::Echo { function: 8 },
        ),
        (
            Request::Diagnostics { sub_function: 11, data: &[0, 0] },
            "08 000C 0103",
            ResponseError::Echo { function: 8 },
        ),
        (Request::GetCommEventLog, "0C 05 0000 0000 00", ResponseError::Length { function: 12 }),
        (
            Request::ReadFifoQueue { address: 0 },
            "18 0006 0001 0000 0000",
            ResponseError::Length { function: 24 },
        ),
        (
            Request::ReadFileRecord { groups: &[6, 0, 1, 0, 0, 0, 2] },
            "14 04 03 06 1234",
            ResponseError::Length { function: 20 },
        ),
        (Request::WriteFileRecord { groups: &[6] }, "15 01 07", ResponseError::Echo { function: 21 }),
        (
            Request::ReadDeviceIdentification { code: 1, object: 0 },
            "2B 0E 02 01 00 00 00",
            ResponseError::Echo { function: 43 },
        ),
        (
            Request::ReadDeviceIdentification { code: 1, object: 0 },
            "2B 0E 01 01 00 00 01",
            ResponseError::Length { function: 43 },
        ),
    ] {
        assert_eq!(decode_response(&request, &hex(pdu)), Err(expected), "{pdu}");
    }
    assert_eq!(decode_response(&read, &hex("83 7F")), Ok(Response::Exception { function: 3, code: 0x7F }));
}

#[test]
fn what_does_not_fit_is_not_encoded() {
    let mut out = [0; MAX_PDU];
    let limits = |function| Err(EncodeError::Limits { function });
    assert_eq!(encode_request(&Request::ReadCoils { address: 0, quantity: 2001 }, &mut out), limits(1));
    let values = [0; 248];
    assert_eq!(
        encode_request(&Request::WriteMultipleRegisters { address: 0, values: &values }, &mut out),
        limits(16)
    );
    assert_eq!(
        encode_request(&Request::WriteMultipleRegisters { address: 0, values: &[0] }, &mut out),
        limits(16)
    );
    assert_eq!(encode_response(&Response::ReadCoils(&[0; 251]), &mut out), limits(1));
    assert_eq!(encode_response(&Response::ReadHoldingRegisters(&[]), &mut out), limits(3));
    let request = Request::ReadCoils { address: 0, quantity: 1 };
    assert_eq!(encode_request(&request, &mut out[..4]), Err(EncodeError::Buffer { needed: 5, got: 4 }));
}

#[test]
fn exception_codes_are_read_back() {
    let known = (0..=255).filter_map(Exception::from_code).map(Exception::code);
    assert_eq!(known.collect::<Vec<_>>(), [1, 2, 3, 4, 5, 6, 7, 8, 10, 11]);
}

fn words(max: usize) -> impl Strategy<Value = Vec<u8>> {
    (1..=max).prop_flat_map(|n| proptest::collection::vec(any::<u8>(), n * 2))
}

/// Encodes a request and decodes it again.
fn check(request: &Request<'_>) -> Result<(), TestCaseError> {
    let mut out = [0; MAX_PDU];
    let len = encode_request(request, &mut out).unwrap();
    prop_assert_eq!(&decode_request(&out[..len]), &Ok(*request));
    for cut in 1..len {
        prop_assert_eq!(decode_request(&out[..cut]).unwrap_err().exception, Exception::IllegalDataValue);
    }
    Ok(())
}

proptest! {
    #[test]
    fn any_bytes_are_decoded_without_panic(pdu in proptest::collection::vec(any::<u8>(), 0..300)) {
        match decode_request(&pdu) {
            Ok(request) => {
                let mut out = [0; MAX_PDU];
                let len = encode_request(&request, &mut out).unwrap();
                prop_assert_eq!(&out[..len], &pdu[..]);
            }
            Err(refused) => prop_assert_eq!(refused.function, pdu.first().copied().unwrap_or(0)),
        }
    }

    #[test]
    fn any_bytes_behind_a_served_function_are_decoded_without_panic(
        function in prop::sample::select(&[1_u8, 2, 3, 4, 5, 6, 7, 8, 11, 12, 15, 16, 17, 20, 21, 22, 23, 24, 43][..]),
        tail in proptest::collection::vec(any::<u8>(), 0..260),
    ) {
        let mut pdu = vec![function];
        pdu.extend(tail);
        if let Ok(request) = decode_request(&pdu) {
            let mut out = [0; MAX_PDU];
            let len = encode_request(&request, &mut out).unwrap();
            prop_assert_eq!(&out[..len], &pdu[..]);
        }
    }

    #[test]
    fn any_response_is_decoded_without_panic(
        function in prop_oneof![0_u8..=43, any::<u8>()],
        tail in prop_oneof![
            proptest::collection::vec(any::<u8>(), 0..260), proptest::collection::vec(0_u8..16, 0..30),
        ],
        quantity in 1_u16..=125,
        bits in 1_u16..=2000, address: u16, value: u16,
    ) {
        let mut pdu = vec![function];
        pdu.extend(&tail);
        for request in [
            Request::ReadCoils { address, quantity: bits },
            Request::ReadInputRegisters { address, quantity },
            Request::WriteSingleCoil { address, on: value > 9 },
            Request::WriteMultipleRegisters { address, values: &[0; 4] },
            Request::MaskWriteRegister { address, and_mask: value, or_mask: address },
            Request::ReadWriteMultipleRegisters {
                read_address: address, read_quantity: quantity, write_address: 0, values: &[0; 2],
            },
            Request::ReadExceptionStatus,
            Request::Diagnostics { sub_function: 0, data: &[1, 2] },
            Request::Diagnostics { sub_function: 0x12, data: &[0, 0] },
            Request::GetCommEventCounter,
            Request::GetCommEventLog,
            Request::ReportServerId,
            Request::ReadFileRecord { groups: &[6, 0, 1, 0, 0, 0, 2] },
            Request::WriteFileRecord { groups: &[6, 0, 1, 0, 0, 0, 1, 1, 2] },
            Request::ReadFifoQueue { address },
            Request::ReadDeviceIdentification { code: 1, object: 0 },
            Request::CanopenGeneralReference { data: &[] },
        ] {
            if let Ok(response) = decode_response(&request, &pdu) {
                let mut out = [0; MAX_PDU];
                let len = encode_response(&response, &mut out).unwrap();
                prop_assert_eq!(&out[..len], &pdu[..]);
            }
        }
    }

    #[test]
    fn requests_round_trip(
        address: u16, value: u16, mask: u16, on: bool, bits in 1_u16..=2000, quantity in 1_u16..=125,
        coils in 1_u16..=1968, packed in proptest::collection::vec(any::<u8>(), 246),
        registers in words(123), fewer in words(121),
    ) {
        check(&Request::ReadCoils { address, quantity: bits })?;
        check(&Request::ReadDiscreteInputs { address, quantity: bits })?;
        check(&Request::ReadHoldingRegisters { address, quantity })?;
        check(&Request::ReadInputRegisters { address, quantity })?;
        check(&Request::WriteSingleCoil { address, on })?;
        check(&Request::WriteSingleRegister { address, value })?;
        check(&Request::WriteMultipleCoils { address, quantity: coils, values: &packed[..bytes_for_bits(coils)] })?;
        check(&Request::WriteMultipleRegisters { address, values: &registers })?;
        check(&Request::MaskWriteRegister { address, and_mask: value, or_mask: mask })?;
        check(&Request::ReadWriteMultipleRegisters {
            read_address: address, read_quantity: quantity, write_address: value, values: &fewer,
        })?;
    }
}

#[test]
fn a_response_longer_than_a_pdu_is_refused() {
    let mut pdu = vec![17, 255];
    pdu.resize(257, 0);
    let refused = crate::protocol::decode_response(&Request::ReportServerId, &pdu);
    assert_eq!(refused, Err(crate::protocol::ResponseError::Length { function: 17 }));
}
