//! Modbus PDUs and MBAP headers: what is accepted is written again as the same bytes. The first byte says how
//! many of the following are a request; the rest is taken for the response to it.

#![no_main]

use dinrail_modbus::protocol::mbap::{self, Scan};
use dinrail_modbus::protocol::pdu::{Exception, MAX_PDU, decode_request, encode_request};
use dinrail_modbus::protocol::{decode_response, encode_response};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    header(data);
    let Some((&len, rest)) = data.split_first() else { return };
    let (request_bytes, response_bytes) = rest.split_at(usize::from(len).min(rest.len()));
    let mut out = [0; MAX_PDU];
    let request = match decode_request(request_bytes) {
        Ok(request) => request,
        Err(refused) => {
            assert_eq!(refused.function, request_bytes.first().copied().unwrap_or(0));
            assert!(matches!(refused.exception, Exception::IllegalFunction | Exception::IllegalDataValue));
            return;
        }
    };
    let len = encode_request(&request, &mut out).unwrap();
    assert_eq!(out[..len], *request_bytes);
    match decode_response(&request, response_bytes) {
        Ok(response) => {
            let len = encode_response(&response, &mut out).unwrap();
            assert_eq!(out[..len], *response_bytes);
        }
        Err(error) => assert!(!error.to_string().is_empty()),
    }
});

fn header(data: &[u8]) {
    match mbap::scan(data) {
        Scan::Frame { frame, used } => {
            assert!(used <= data.len() && used <= mbap::MAX_RECEIVED);
            assert_eq!(frame.pdu.len() + mbap::HEADER, used);
            let mut out = [0; mbap::MAX_ADU];
            if let Some(len) = mbap::encode(frame.transaction, frame.unit, frame.pdu, &mut out) {
                assert_eq!(out[..len], data[..used]);
            } else {
                assert!(frame.pdu.len() > MAX_PDU);
            }
        }
        Scan::Foreign { used } => assert!(used >= mbap::HEADER && used <= data.len()),
        Scan::Incomplete => assert!(data.len() < mbap::MAX_RECEIVED),
        Scan::BadLength { length } => assert!(!(2..=mbap::MAX_LENGTH).contains(&length)),
    }
}
