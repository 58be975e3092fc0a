//! Read device identification: function 43, MEI type 14 (V1.1b3 clause 6.21).

/// MEI type of the device identification.
pub const MEI_DEVICE_IDENTIFICATION: u8 = 14;
/// MEI type of the CANopen general reference.
pub const MEI_CANOPEN: u8 = 13;
/// Read device ID codes: stream access to the three categories, individual access to one object.
pub mod code {
    pub const BASIC: u8 = 1;
    pub const REGULAR: u8 = 2;
    pub const EXTENDED: u8 = 3;
    pub const INDIVIDUAL: u8 = 4;
}
/// Objects of the basic and regular categories. Extended ones are 80h to FFh.
pub mod object {
    pub const VENDOR_NAME: u8 = 0;
    pub const PRODUCT_CODE: u8 = 1;
    pub const REVISION: u8 = 2;
    pub const VENDOR_URL: u8 = 3;
    pub const PRODUCT_NAME: u8 = 4;
    pub const MODEL_NAME: u8 = 5;
    pub const USER_APPLICATION_NAME: u8 = 6;
    pub const FIRST_EXTENDED: u8 = 0x80;
}
/// Set in the conformity level when individual access is possible too.
pub const INDIVIDUAL_ACCESS: u8 = 0x80;
/// Bytes of a response before its first object, function code included.
pub const RESPONSE_HEAD: usize = 7;
/// Longest value that fits a response: 253 bytes without head, object id and length.
pub const MAX_VALUE: usize = 244;

/// Id and value of each object of a response; ends early where bytes do not make a whole object.
pub fn objects(bytes: &[u8]) -> Objects<'_> {
    Objects { rest: bytes }
}

/// See [`objects`].
pub struct Objects<'a> {
    rest: &'a [u8],
}

impl<'a> Iterator for Objects<'a> {
    type Item = (u8, &'a [u8]);

    fn next(&mut self) -> Option<(u8, &'a [u8])> {
        let &[id, len, ref rest @ ..] = self.rest else { return None };
        let value = rest.get(..usize::from(len))?;
        self.rest = &rest[usize::from(len)..];
        Some((id, value))
    }
}

/// Number of objects if the bytes are whole objects and nothing else.
pub(super) fn count(bytes: &[u8]) -> Option<u8> {
    let (n, len) = objects(bytes).fold((0_usize, 0), |(n, len), (_, value)| (n + 1, len + 2 + value.len()));
    (len == bytes.len()).then_some(n).and_then(|n| u8::try_from(n).ok())
}
