//! Sub-functions of function 8 (V1.1b3 clause 6.8.1).

/// Sub-function codes.
pub mod sub {
    pub const RETURN_QUERY_DATA: u16 = 0x00;
    pub const RESTART_COMMUNICATIONS: u16 = 0x01;
    pub const RETURN_DIAGNOSTIC_REGISTER: u16 = 0x02;
    pub const CHANGE_ASCII_DELIMITER: u16 = 0x03;
    pub const FORCE_LISTEN_ONLY: u16 = 0x04;
    pub const CLEAR_COUNTERS: u16 = 0x0A;
    pub const BUS_MESSAGE_COUNT: u16 = 0x0B;
    pub const BUS_COMMUNICATION_ERROR_COUNT: u16 = 0x0C;
    pub const BUS_EXCEPTION_ERROR_COUNT: u16 = 0x0D;
    pub const SERVER_MESSAGE_COUNT: u16 = 0x0E;
    pub const SERVER_NO_RESPONSE_COUNT: u16 = 0x0F;
    pub const SERVER_NAK_COUNT: u16 = 0x10;
    pub const SERVER_BUSY_COUNT: u16 = 0x11;
    pub const BUS_CHARACTER_OVERRUN_COUNT: u16 = 0x12;
    pub const CLEAR_OVERRUN: u16 = 0x14;

    /// All of them.
    pub const ALL: [u16; 15] = [0, 1, 2, 3, 4, 0x0A, 0x0B, 0x0C, 0x0D, 0x0E, 0x0F, 0x10, 0x11, 0x12, 0x14];
}

/// Most bytes of the data of sub-function 0: a PDU without function and sub-function.
pub const MAX_DATA: usize = 250;

/// Whether a request of this sub-function may carry this data. Others than [`sub::ALL`]: false.
pub fn is_request_data(sub_function: u16, data: &[u8]) -> bool {
    match sub_function {
        sub::RETURN_QUERY_DATA => is_words(data),
        sub::RESTART_COMMUNICATIONS => matches!(data, [0 | 0xFF, 0]),
        // A colon begins a frame wherever it stands: behind that as delimiter no frame would end any more.
        sub::CHANGE_ASCII_DELIMITER => matches!(data, &[delimiter, 0] if delimiter != b':'),
        _ => sub::ALL.contains(&sub_function) && data == [0, 0],
    }
}

/// Whether a response may carry this data.
pub(super) fn is_words(data: &[u8]) -> bool {
    (2..=MAX_DATA).contains(&data.len()) && data.len().is_multiple_of(2)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_delimiter_that_would_end_every_frame_for_good_is_refused() {
        for (data, legal) in [
            ([b'\n', 0], true),
            ([b'\r', 0], true),
            ([0xFF, 0], true),
            ([b':', 0], false),
            ([b'!', 1], false),
        ] {
            assert_eq!(is_request_data(sub::CHANGE_ASCII_DELIMITER, &data), legal, "{data:02X?}");
        }
    }
}
