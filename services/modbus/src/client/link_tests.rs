//! What tokio-modbus and streams make of answers.

use super::*;
use proptest::prelude::*;

#[test]
fn answers_become_the_bytes_they_were() {
    for (response, pdu) in [
        (
            Response::ReadCoils(vec![
                true, false, true, false, false, false, false, false, true, false, false, false, false,
                false, false, false,
            ]),
            vec![1, 2, 5, 1],
        ),
        (Response::ReadHoldingRegisters(vec![1, 0xABCD]), vec![3, 4, 0, 1, 0xAB, 0xCD]),
        (Response::WriteSingleCoil(1, true), vec![5, 0, 1, 0xFF, 0]),
        (Response::WriteSingleRegister(1, 9), vec![6, 0, 1, 0, 9]),
        (Response::WriteMultipleRegisters(1, 2), vec![16, 0, 1, 0, 2]),
        (Response::MaskWriteRegister(1, 2, 3), vec![22, 0, 1, 0, 2, 0, 3]),
        (Response::ReportServerId(7, true, vec![65]), vec![17, 3, 7, 0xFF, 65]),
        (Response::Custom(8, vec![0, 0, 1, 2].into()), vec![8, 0, 0, 1, 2]),
    ] {
        assert_eq!(response_pdu(&response), pdu);
    }
}

fn frame(unit: u8, pdu: &[u8]) -> Vec<u8> {
    let mut out = [0; rtu::MAX_ADU];
    let len = rtu::encode(unit, pdu, &mut out);
    out[..len].to_vec()
}

#[test]
fn answers_are_found_in_a_stream() {
    let request = [3, 0, 0, 0, 2];
    let answer = frame(5, &[3, 4, 1, 2, 3, 4]);
    for cut in 0..answer.len() {
        assert!(matches!(find_answer(5, &request, &answer[..cut]), Found::More), "{cut}");
    }
    for noise in [&[][..], &[0], &[5], &[0xFF, 5, 3]] {
        let mut bytes = noise.to_vec();
        bytes.extend(&answer);
        // Noise that looks like the beginning of a longer answer keeps the search waiting; the timeout ends it.
        match find_answer(5, &request, &bytes) {
            Found::Frame(pdu) => assert_eq!(pdu, [3, 4, 1, 2, 3, 4]),
            Found::More => assert!(noise.contains(&5)),
            Found::Garbage => panic!("{noise:?}"),
        }
    }
    assert!(matches!(find_answer(5, &request, &frame(5, &[0x83, 2])), Found::Frame(pdu) if pdu == [0x83, 2]));
    assert!(matches!(find_answer(5, &request, &[9; 600]), Found::Garbage));
}

proptest! {
    #[test]
    fn any_stream(bytes in prop::collection::vec(any::<u8>(), 0..600), request in prop::collection::vec(any::<u8>(), 1..9)) {
        let _ = find_answer(bytes.first().copied().unwrap_or(0), &request, &bytes);
    }
}
