//! What an answer must look like to be the answer to a request: for masters, who on a serial line have nothing else
//! to tell a late answer from the right one, and on a stream nothing else to find its end.
//!
//! Works on raw PDUs, so that it serves every function code, user-defined ones too.

use super::pdu::{EXCEPTION_BIT, bytes_for_bits};

/// How an answer PDU relates to a request PDU.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fit {
    /// It can be the answer.
    Answer,
    /// It is the exception answer with this code.
    Exception(u8),
    /// It answers something else, or nothing.
    No,
}

/// Length of an answer PDU whose first bytes are known.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Length {
    /// It has so many bytes.
    Exactly(usize),
    /// More bytes are needed to know: at least so many in all.
    AtLeast(usize),
    /// The function code says nothing about it; the answer ends where the line falls silent.
    Unknown,
}

fn word(bytes: &[u8], at: usize) -> Option<u16> {
    match bytes.get(at..at.checked_add(2)?) {
        Some(&[high, low]) => Some(u16::from_be_bytes([high, low])),
        _ => None,
    }
}

/// Whether `answer` can be the answer to `request` (V1.1b3 clause 6). What a request asks for and what an answer
/// repeats of it is compared: byte counts, echoed addresses, quantities and values, sub-functions.
pub fn fit(request: &[u8], answer: &[u8]) -> Fit {
    let (Some(&asked), Some((&got, data))) = (request.first(), answer.split_first()) else { return Fit::No };
    if got == asked | EXCEPTION_BIT && asked & EXCEPTION_BIT == 0 {
        return match data {
            &[code] => Fit::Exception(code),
            _ => Fit::No,
        };
    }
    if got != asked {
        return Fit::No;
    }
    if fits_data(asked, request, data) { Fit::Answer } else { Fit::No }
}

fn fits_data(function: u8, request: &[u8], data: &[u8]) -> bool {
    let counted = |expected: usize| data.len() == expected + 1 && usize::from(data[0]) == expected;
    let self_counted = || data.first().is_some_and(|&n| data.len() == usize::from(n) + 1);
    match function {
        1 | 2 => word(request, 3).is_some_and(|quantity| counted(bytes_for_bits(quantity))),
        3 | 4 | 23 => word(request, 3).is_some_and(|quantity| counted(usize::from(quantity) * 2)),
        5 | 6 | 21 | 22 => request.get(1..) == Some(data),
        7 => data.len() == 1,
        8 => match word(request, 1) {
            Some(0) => request.get(1..) == Some(data),
            Some(_) => data.len() == 4 && request.get(1..3) == data.get(..2),
            None => false,
        },
        11 => data.len() == 4,
        12 | 17 | 20 => self_counted(),
        15 | 16 => data.len() == 4 && request.get(1..5) == Some(data),
        24 => word(data, 0).is_some_and(|n| data.len() == usize::from(n) + 2),
        43 => match request.get(1) {
            Some(14) => {
                request.get(1..3) == data.get(..2) && objects_len(data) == Length::Exactly(data.len() + 1)
            }
            mei => mei == data.first(),
        },
        _ => true,
    }
}

/// Length of an answer PDU to `request` of which `head` has arrived.
pub fn length(request: &[u8], head: &[u8]) -> Length {
    let Some((&function, data)) = head.split_first() else { return Length::AtLeast(2) };
    if function & EXCEPTION_BIT != 0 {
        return Length::Exactly(2);
    }
    match function {
        7 => Length::Exactly(2),
        5 | 6 | 11 | 15 | 16 => Length::Exactly(5),
        8 => Length::Exactly(if request.first() == Some(&8) { request.len().max(5) } else { 5 }),
        22 => Length::Exactly(7),
        1..=4 | 12 | 17 | 20 | 21 | 23 => match data.first() {
            Some(&n) => Length::Exactly(2 + usize::from(n)),
            None => Length::AtLeast(2),
        },
        24 => word(data, 0).map_or(Length::AtLeast(3), |n| Length::Exactly(3 + usize::from(n))),
        43 => match data.first() {
            None => Length::AtLeast(2),
            Some(14) => objects_len(data),
            Some(_) => Length::Unknown,
        },
        _ => Length::Unknown,
    }
}

/// Length of an answer to 43/14 from its object list; `data` begins behind the function code.
fn objects_len(data: &[u8]) -> Length {
    let Some(&count) = data.get(5) else { return Length::AtLeast(7) };
    let mut at = 6;
    for _ in 0..count {
        let Some(&len) = data.get(at + 1) else { return Length::AtLeast(at + 3) };
        at += 2 + usize::from(len);
    }
    Length::Exactly(at + 1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn answers_of_every_function() {
        for (request, answer, expected) in [
            (&[1, 0, 0x13, 0, 0x13][..], &[1, 3, 0xCD, 0x6B, 5][..], Fit::Answer),
            (&[1, 0, 0x13, 0, 0x13], &[1, 2, 0xCD, 0x6B], Fit::No),
            (&[2, 0, 0, 0, 8], &[1, 1, 0], Fit::No),
            (&[3, 0, 0, 0, 2], &[3, 4, 1, 2, 3, 4], Fit::Answer),
            (&[3, 0, 0, 0, 2], &[3, 4, 1, 2, 3], Fit::No),
            (&[3, 0, 0, 0, 2], &[3, 2, 1, 2], Fit::No),
            (&[3, 0, 0, 0, 2], &[0x83, 2], Fit::Exception(2)),
            (&[3, 0, 0, 0, 2], &[0x83], Fit::No),
            (&[3, 0, 0, 0, 2], &[0x84, 2], Fit::No),
            (&[5, 0, 1, 0xFF, 0], &[5, 0, 1, 0xFF, 0], Fit::Answer),
            (&[6, 0, 1, 0, 3], &[6, 0, 2, 0, 3], Fit::No),
            (&[7], &[7, 0x6D], Fit::Answer),
            (&[8, 0, 0, 0xA5, 0x37], &[8, 0, 0, 0xA5, 0x37], Fit::Answer),
            (&[8, 0, 0, 0xA5, 0x37], &[8, 0, 0, 0xA5, 0x38], Fit::No),
            (&[8, 0, 0x0B, 0, 0], &[8, 0, 0x0B, 1, 2], Fit::Answer),
            (&[8, 0, 0x0B, 0, 0], &[8, 0, 0x0C, 1, 2], Fit::No),
            (&[11], &[11, 0xFF, 0xFF, 1, 8], Fit::Answer),
            (&[12], &[12, 2, 0, 0], Fit::Answer),
            (&[15, 0, 0x13, 0, 10, 2, 0xCD, 1], &[15, 0, 0x13, 0, 10], Fit::Answer),
            (&[16, 0, 1, 0, 1, 2, 0, 10], &[16, 0, 1, 0, 2], Fit::No),
            (&[17], &[17, 3, 1, 0xFF, 0x41], Fit::Answer),
            (&[20, 7, 6, 0, 4, 0, 1, 0, 2], &[20, 6, 5, 6, 0, 1, 0, 2], Fit::Answer),
            (&[22, 0, 4, 0, 0xF2, 0, 0x25], &[22, 0, 4, 0, 0xF2, 0, 0x25], Fit::Answer),
            (&[23, 0, 3, 0, 1, 0, 0x0E, 0, 1, 2, 0, 1], &[23, 2, 0, 1], Fit::Answer),
            (&[24, 4, 0xDE], &[24, 0, 4, 0, 1, 1, 0xB8], Fit::Answer),
            (&[24, 4, 0xDE], &[24, 0, 5, 0, 1, 1, 0xB8], Fit::No),
            (&[43, 14, 1, 0], &[43, 14, 1, 1, 0, 0, 1, 0, 2, 0x41, 0x42], Fit::Answer),
            (&[43, 14, 1, 0], &[43, 14, 1, 1, 0, 0, 1, 0, 3, 0x41, 0x42], Fit::No),
            (&[43, 13, 1], &[43, 13, 9], Fit::Answer),
            (&[100, 1], &[100], Fit::Answer),
            (&[100, 1], &[101], Fit::No),
            (&[], &[1], Fit::No),
            (&[1, 0, 0, 0, 1], &[], Fit::No),
        ] {
            assert_eq!(fit(request, answer), expected, "{request:02X?} {answer:02X?}");
        }
    }

    proptest! {
        #[test]
        fn any_bytes(request in prop::collection::vec(any::<u8>(), 0..20), answer in prop::collection::vec(any::<u8>(), 0..40)) {
            let _ = fit(&request, &answer);
            if let Length::Exactly(n) = length(&request, &answer) {
                // A longer head changes nothing.
                let mut more = answer.clone();
                more.extend([0; 8]);
                prop_assert!(length(&request, &more) == Length::Exactly(n) || answer.len() < 2);
            }
        }

        #[test]
        fn what_fits_has_the_length(function in prop::sample::select(&[1u8, 2, 3, 4, 5, 6, 7, 11, 12, 15, 16, 17, 20, 22, 23, 24, 43]),
                                    tail in prop::collection::vec(any::<u8>(), 0..12), request in prop::collection::vec(any::<u8>(), 7..12)) {
            let mut asked = vec![function];
            asked.extend(&request);
            let mut answer = vec![function];
            answer.extend(&tail);
            if fit(&asked, &answer) == Fit::Answer && !(function == 43 && asked[1] != 14) {
                prop_assert!(matches!(length(&asked, &answer), Length::Exactly(n) if n == answer.len() || function == 5 || function == 6 || function == 22));
            }
        }
    }
}
