//! One CAN frame as it stands on the wire: identifier, kind, payload. No stamp, no bus, no order: those are
//! given by the bus that carries it.

use thiserror::Error;

/// Bit in [`Frame::can_id`]: 29-bit identifier (same layout as Linux `can_id`).
pub const EFF_FLAG: u32 = 0x8000_0000;
/// Bit in [`Frame::can_id`]: remote transmission request.
pub const RTR_FLAG: u32 = 0x4000_0000;
/// Bit in [`Frame::can_id`]: error frame; the identifier bits then hold the error class.
pub const ERR_FLAG: u32 = 0x2000_0000;
/// Largest 11-bit identifier.
pub const SFF_MASK: u32 = 0x7FF;
/// Largest 29-bit identifier.
pub const EFF_MASK: u32 = 0x1FFF_FFFF;

/// Bit in [`Frame::fd`]: the data phase ran at the data bit rate.
pub const FD_BRS: u8 = 1;
/// Bit in [`Frame::fd`]: the sender was error passive.
pub const FD_ESI: u8 = 2;
/// Bit in [`Frame::fd`]: this is a CAN FD frame. Always set when any other FD bit is.
pub const FD_FDF: u8 = 4;

/// Payload bytes for each data length code of CAN FD (ISO 11898-1:2015, table 5).
pub const FD_LENGTHS: [u8; 16] = [0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64];

/// A CAN frame: classic, remote, FD or error.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Frame {
    /// Identifier in the low 11 or 29 bits with [`EFF_FLAG`], [`RTR_FLAG`], [`ERR_FLAG`] above.
    pub can_id: u32,
    /// Payload length in bytes: 0-8 classic, one of [`FD_LENGTHS`] for FD. A remote frame asks for this length
    /// and carries no data.
    pub len: u8,
    /// 0 for classic; else [`FD_FDF`] with [`FD_BRS`] and [`FD_ESI`].
    pub fd: u8,
    /// Payload; bytes from `len` on are zero.
    pub data: [u8; 64],
}

/// Why a frame cannot exist on a CAN bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
pub enum FrameError {
    /// 11-bit identifier above 7FF.
    #[error("identifier {0:X} needs 29 bits: write it with 8 digits, or use at most 7FF for 11 bits")]
    StandardId(u32),
    /// 29-bit identifier above 1FFFFFFF.
    #[error("identifier {0:X} is above 1FFFFFFF, the largest 29-bit identifier")]
    ExtendedId(u32),
    /// Classic payload above 8 bytes.
    #[error("{0} data bytes: a classic frame carries at most 8, only CAN FD carries more")]
    ClassicLength(usize),
    /// FD payload length that no data length code expresses.
    #[error("{0} data bytes: CAN FD carries 0-8, 12, 16, 20, 24, 32, 48 or 64")]
    FdLength(usize),
    /// Remote frame with FD bit.
    #[error("a CAN FD frame cannot be a remote frame: CAN FD has none")]
    FdRemote,
    /// FD flag bits without FDF, or unknown ones.
    #[error("CAN FD flags {0:02X} are not valid: FDF (04) is missing or bits above 07 are set")]
    FdFlags(u8),
}

impl std::fmt::Debug for Frame {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let mut text = [0u8; super::candump::MAX_FRAME_TEXT];
        let n = super::candump::encode(self, &mut text);
        f.write_str(&String::from_utf8_lossy(&text[..n]))
    }
}

impl Default for Frame {
    fn default() -> Self {
        Self { can_id: 0, len: 0, fd: 0, data: [0; 64] }
    }
}

impl Frame {
    /// A classic data frame. `id` is the bare identifier; `extended` selects 29 bits.
    pub fn data(id: u32, extended: bool, payload: &[u8]) -> Result<Self, FrameError> {
        Self::build(id, extended, 0, 0, payload)
    }

    /// A remote frame that asks for `len` bytes (0-8).
    pub fn remote(id: u32, extended: bool, len: u8) -> Result<Self, FrameError> {
        if len > 8 {
            return Err(FrameError::ClassicLength(len as usize));
        }
        let mut frame = Self::build(id, extended, RTR_FLAG, 0, &[])?;
        frame.len = len;
        Ok(frame)
    }

    /// A CAN FD frame; `flags` may hold [`FD_BRS`] and [`FD_ESI`].
    pub fn fd(id: u32, extended: bool, flags: u8, payload: &[u8]) -> Result<Self, FrameError> {
        Self::build(id, extended, 0, flags | FD_FDF, payload)
    }

    fn build(id: u32, extended: bool, kind: u32, fd: u8, payload: &[u8]) -> Result<Self, FrameError> {
        let mut frame = Self { can_id: checked_id(id, extended)? | kind, len: 0, fd, data: [0; 64] };
        if payload.len() > 64 {
            return Err(if fd == 0 {
                FrameError::ClassicLength(payload.len())
            } else {
                FrameError::FdLength(payload.len())
            });
        }
        frame.len = payload.len() as u8;
        frame.data[..payload.len()].copy_from_slice(payload);
        frame.validate()?;
        Ok(frame)
    }

    /// Checks what a peer or another process handed over: every bus boundary calls this once.
    pub fn validate(&self) -> Result<(), FrameError> {
        if self.fd & !(FD_BRS | FD_ESI | FD_FDF) != 0 || (self.fd != 0 && self.fd & FD_FDF == 0) {
            return Err(FrameError::FdFlags(self.fd));
        }
        if self.can_id & ERR_FLAG == 0 && self.can_id & EFF_FLAG == 0 && self.can_id & EFF_MASK > SFF_MASK {
            return Err(FrameError::StandardId(self.can_id & EFF_MASK));
        }
        if self.is_fd() {
            if self.is_remote() {
                return Err(FrameError::FdRemote);
            }
            if !FD_LENGTHS.contains(&self.len) {
                return Err(FrameError::FdLength(self.len as usize));
            }
        } else if self.len > 8 {
            return Err(FrameError::ClassicLength(self.len as usize));
        }
        Ok(())
    }

    /// The bare identifier, 11 or 29 bits.
    pub fn id(&self) -> u32 {
        self.can_id & EFF_MASK
    }

    /// True for a 29-bit identifier.
    pub fn is_extended(&self) -> bool {
        self.can_id & EFF_FLAG != 0
    }

    /// True for a remote frame.
    pub fn is_remote(&self) -> bool {
        self.can_id & RTR_FLAG != 0
    }

    /// True for an error frame.
    pub fn is_error(&self) -> bool {
        self.can_id & ERR_FLAG != 0
    }

    /// True for a CAN FD frame.
    pub fn is_fd(&self) -> bool {
        self.fd & FD_FDF != 0
    }

    /// The bytes on the wire: empty for a remote frame.
    pub fn payload(&self) -> &[u8] {
        if self.is_remote() { &[] } else { &self.data[..(self.len as usize).min(64)] }
    }

    /// Data length code, 0-15 (the smallest that holds `len`).
    pub fn dlc(&self) -> u8 {
        FD_LENGTHS.iter().position(|&n| n >= self.len).unwrap_or(15) as u8
    }

    /// The order in which a bus lets frames through: the lower value wins arbitration.
    ///
    /// Bits as they pass the wire (ISO 11898-1 10.4.2): 11 base bits, RTR or SRR, IDE, 18 extension bits, RTR.
    /// So a standard frame beats an extended one with the same base, and a data frame its remote frame.
    pub fn arbitration_key(&self) -> u32 {
        let remote = u32::from(self.is_remote());
        if self.is_extended() {
            let base = (self.id() >> 18) & SFF_MASK;
            (base << 21) | (1 << 20) | (1 << 19) | ((self.id() & 0x3_FFFF) << 1) | remote
        } else {
            ((self.id() & SFF_MASK) << 21) | (remote << 20)
        }
    }
}

/// `id` with [`EFF_FLAG`] if extended, or why it cannot be.
pub fn checked_id(id: u32, extended: bool) -> Result<u32, FrameError> {
    match (extended, id) {
        (true, id) if id > EFF_MASK => Err(FrameError::ExtendedId(id)),
        (false, id) if id > SFF_MASK => Err(FrameError::StandardId(id)),
        (true, id) => Ok(id | EFF_FLAG),
        (false, id) => Ok(id),
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use proptest::prelude::*;

    pub(crate) fn any_id() -> impl Strategy<Value = (u32, bool)> {
        prop_oneof![(0..=SFF_MASK, Just(false)), (0..=EFF_MASK, Just(true))]
    }

    pub(crate) fn any_classic() -> impl Strategy<Value = Frame> {
        (any_id(), prop::collection::vec(any::<u8>(), 0..=8))
            .prop_map(|((id, ext), data)| Frame::data(id, ext, &data).unwrap())
    }

    /// Any data, remote or FD frame; `esi` says whether FD frames may carry ESI.
    pub(crate) fn any_frame(esi: bool) -> impl Strategy<Value = Frame> {
        let fd_flags = if esi { 0u8..4 } else { 0u8..2 };
        let fd = (any_id(), fd_flags, prop::sample::select(FD_LENGTHS.to_vec()), any::<[u8; 32]>()).prop_map(
            |((id, ext), flags, len, seed)| {
                let data: Vec<u8> = (0..len as usize).map(|i| seed[i % 32].wrapping_add(i as u8)).collect();
                Frame::fd(id, ext, flags, &data).unwrap()
            },
        );
        let remote = (any_id(), 0u8..=8).prop_map(|((id, ext), len)| Frame::remote(id, ext, len).unwrap());
        prop_oneof![any_classic(), remote, fd]
    }

    #[test]
    fn arbitration_follows_the_wire() {
        let std = |id| Frame::data(id, false, &[]).unwrap();
        let ext = |id| Frame::data(id, true, &[]).unwrap();
        let in_order = [
            std(0),
            Frame::remote(0, false, 0).unwrap(),
            ext(0),
            Frame::remote(0, true, 0).unwrap(),
            ext(1),
            ext(0x3_FFFF),
            std(1),
            ext(1 << 18),
            std(0x123),
            ext(0x123 << 18 | 5),
            std(0x124),
            std(0x7FF),
            ext(EFF_MASK),
        ];
        for pair in in_order.windows(2) {
            assert!(
                pair[0].arbitration_key() < pair[1].arbitration_key(),
                "{:?} before {:?}",
                pair[0],
                pair[1]
            );
        }
    }

    #[test]
    fn impossible_frames_are_refused() {
        assert_eq!(Frame::data(0x800, false, &[]), Err(FrameError::StandardId(0x800)));
        assert_eq!(Frame::data(0x2000_0000, true, &[]), Err(FrameError::ExtendedId(0x2000_0000)));
        assert_eq!(Frame::data(1, false, &[0; 9]), Err(FrameError::ClassicLength(9)));
        assert_eq!(Frame::fd(1, false, 0, &[0; 9]), Err(FrameError::FdLength(9)));
        assert_eq!(Frame::fd(1, false, 0, &[0; 65]), Err(FrameError::FdLength(65)));
        assert_eq!(Frame::remote(1, false, 9), Err(FrameError::ClassicLength(9)));
        let remote_fd = Frame { can_id: RTR_FLAG, len: 0, fd: FD_FDF, data: [0; 64] };
        assert_eq!(remote_fd.validate(), Err(FrameError::FdRemote));
        assert_eq!(Frame { fd: FD_BRS, ..Frame::default() }.validate(), Err(FrameError::FdFlags(1)));
        assert_eq!(Frame { fd: 0x84, ..Frame::default() }.validate(), Err(FrameError::FdFlags(0x84)));
    }

    #[test]
    fn data_length_codes() {
        for (dlc, &len) in FD_LENGTHS.iter().enumerate() {
            let frame = Frame::fd(1, false, 0, &vec![0; len as usize]).unwrap();
            assert_eq!(frame.dlc() as usize, dlc);
        }
    }
}
