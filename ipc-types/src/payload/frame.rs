//! Bus frames.

use super::payload;

/// Flags in [`CanFrame::can_id`], as Linux has them (`linux/can.h`).
pub mod id_flag {
    /// Extended frame format, 29 bits.
    pub const EFF: u32 = 0x8000_0000;
    /// Remote transmission request.
    pub const RTR: u32 = 0x4000_0000;
    /// Error frame.
    pub const ERR: u32 = 0x2000_0000;
    /// Identifier bits of an extended frame.
    pub const EFF_MASK: u32 = 0x1FFF_FFFF;
    /// Identifier bits of a standard frame.
    pub const SFF_MASK: u32 = 0x7FF;
}

/// Flags in [`CanFrame::fd_flags`], as Linux has them.
pub mod fd_flag {
    /// Bit rate switch.
    pub const BRS: u8 = 1;
    /// Error state indicator.
    pub const ESI: u8 = 2;
    /// This is a CAN FD frame.
    pub const FDF: u8 = 4;
}

/// Flags in [`CanFrame::flags`].
pub mod can_flag {
    /// On `rx`: this frame was sent by a process of the stack and has been on the bus.
    pub const TX_ECHO: u8 = 1;
    /// On `tx`: only the newest value of this identifier counts (cyclic PDO, PG): it takes the place of one
    /// that still waits.
    pub const NEWEST: u8 = 2;
}

payload! {
    /// One CAN frame on `<can>/rx` or `<can>/tx`, classic or FD. 96 bytes.
    ///
    /// On `rx`, `stamp.t_ns` is when the frame was on the bus and `stamp.seq` is the bus's one true order.
    pub struct CanFrame: "dinrail.CanFrame/1", fixed, Ros1 {
        /// Identifier with [`id_flag`]s.
        pub can_id: u32,
        /// Bytes of data: 0-8 classic, 0-8, 12, 16, 20, 24, 32, 48, 64 FD. Of a remote frame: the length asked for.
        pub len: u8,
        /// [`fd_flag`]s; 0 is a classic frame.
        pub fd_flags: u8,
        /// [`can_flag`]s.
        pub flags: u8,
        /// On `rx`, of an echo: the low 8 bits of the number of the process that sent it; 0 = not told, as in recordings
        /// made before it was, and in everything that is no echo. See [`CanFrame::echo_of`].
        pub sender: u8,
        /// Data; bytes behind `len` are 0.
        pub data: [u8; 64],
    }
}

impl CanFrame {
    /// A classic data frame. Longer data is cut at 8 bytes, identifiers above 7FFh become extended.
    pub fn classic(id: u32, data: &[u8]) -> Self {
        let can_id = if id & !id_flag::SFF_MASK == 0 { id } else { (id & id_flag::EFF_MASK) | id_flag::EFF };
        let len = data.len().min(8);
        let mut frame = Self { can_id, len: len as u8, ..Self::default() };
        frame.data[..len].copy_from_slice(&data[..len]);
        frame
    }
    /// Whether this is the echo of a frame that this writer sent; `None`: an echo that does not tell whose. `Some(false)`
    /// is certain. `Some(true)` is so among the services of a stack; a tool, whose number is a process id, has the same
    /// low bits as another sender in one of 256 cases.
    pub fn echo_of(&self, writer: u32) -> Option<bool> {
        if self.flags & can_flag::TX_ECHO == 0 {
            return Some(false);
        }
        (self.sender != 0).then_some(self.sender == (writer & 0xFF) as u8)
    }
    /// Identifier without flags.
    pub fn id(&self) -> u32 {
        if self.is_extended() { self.can_id & id_flag::EFF_MASK } else { self.can_id & id_flag::SFF_MASK }
    }
    pub fn is_extended(&self) -> bool {
        self.can_id & id_flag::EFF != 0
    }
    pub fn is_remote(&self) -> bool {
        self.can_id & id_flag::RTR != 0
    }
    pub fn is_error(&self) -> bool {
        self.can_id & id_flag::ERR != 0
    }
    pub fn is_fd(&self) -> bool {
        self.fd_flags & fd_flag::FDF != 0
    }
    /// The data bytes; none for a remote frame. Never panics, whatever `len` says.
    pub fn payload(&self) -> &[u8] {
        let len = if self.is_remote() { 0 } else { usize::from(self.len).min(64) };
        &self.data[..len]
    }
    /// What is wrong with the frame, if anything: a reader of shared memory validates before it believes.
    pub fn fault(&self) -> Option<&'static str> {
        if self.is_fd() {
            if self.is_remote() {
                return Some("CAN FD has no remote frames");
            }
            if !matches!(self.len, 0..=8 | 12 | 16 | 20 | 24 | 32 | 48 | 64) {
                return Some("length is none of CAN FD's");
            }
        } else if self.len > 8 {
            return Some("classic frame longer than 8 bytes");
        }
        if !self.is_extended() && !self.is_error() && self.can_id & id_flag::EFF_MASK > id_flag::SFF_MASK {
            return Some("standard identifier above 7FFh");
        }
        None
    }
}

/// Flags in [`SerialChunk::flags`].
pub mod serial_flag {
    /// On `rx`: these bytes were sent by a process of the stack and have left the port.
    pub const TX_ECHO: u32 = 1;
    /// The chunk ends a frame: the line was silent behind it (framing `rtu`, `silence`), its delimiter or length
    /// was reached, or it is an awaited answer ([`EXPECT_ANSWER`]). Absent: the frame goes on in the next chunk.
    pub const END: u32 = 2;
    /// A silence of more than 1.5 characters lay inside the frame (serial line guide V1.02, 2.5.1.1).
    pub const GAP: u32 = 4;
    /// The UART saw a parity error in it.
    pub const PARITY: u32 = 8;
    /// The UART saw a framing error in it.
    pub const FRAMING: u32 = 16;
    /// Bytes were lost before or in it: overrun of the UART or of the driver's buffer.
    pub const OVERRUN: u32 = 32;
    /// The line was held low longer than a character.
    pub const BREAK: u32 = 64;
    /// On `rx` with [`TX_ECHO`]: the bytes could not be sent, because the port was gone or its deadline was over.
    pub const NOT_SENT: u32 = 128;
    /// On `tx`: start at once, without waiting until the line was silent for 3.5 characters.
    pub const AT_ONCE: u32 = 256;
    /// On `tx`, framing `rtu`: a request of a Modbus master. Its answer ends as soon as it is whole, without a silence
    /// behind it; the silence before the next transmission is kept all the same.
    pub const EXPECT_ANSWER: u32 = 512;
    /// Every flag that tells of a damaged frame.
    pub const DAMAGED: u32 = PARITY | FRAMING | OVERRUN | BREAK;
}

/// Most bytes of one [`SerialChunk`]; a longer frame travels in several.
pub const CHUNK_BYTES: usize = 1024;

payload! {
    /// Bytes of a serial port on `<serial>/rx` or `<serial>/tx`: one frame, or a part of a long one. Tail: the bytes.
    ///
    /// On `rx`, `stamp.t_ns` is when the driver knew the end of the chunk and `stamp.seq` is the line's one true
    /// order. An echo carries writer, generation and seq of the message on `tx` that it confirms.
    pub struct SerialChunk: "dinrail.SerialChunk/1", tail, Ros1 {
        /// CLOCK_MONOTONIC of the first byte in ns. On `tx`: the time after which it shall not be sent any more,
        /// 0 for none.
        pub first_t_ns: u64,
        /// Of an echo: `stamp.seq` of the message on `tx`. Otherwise 0.
        pub tx_seq: u64,
        /// Of an echo: `stamp.writer` of the message on `tx`. Otherwise 0.
        pub tx_writer: u32,
        /// Of an echo: `stamp.generation` of the message on `tx`. Otherwise 0.
        pub tx_generation: u32,
        /// [`serial_flag`]s.
        pub flags: u32,
        /// Bytes of the tail.
        pub n: u32,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_echo_is_ours_somebody_elses_or_does_not_tell() {
        let frame = |flags, sender| CanFrame { flags, sender, ..CanFrame::classic(0x123, &[]) };
        for (flags, sender, writer, answer) in [
            (0, 0, 3, Some(false)),
            (can_flag::TX_ECHO, 0, 3, None),
            (can_flag::TX_ECHO, 3, 3, Some(true)),
            (can_flag::TX_ECHO, 4, 3, Some(false)),
            // A tool's number is a process id.
            (can_flag::TX_ECHO, 0x34, 0x1234, Some(true)),
            (can_flag::TX_ECHO, 3, 0x1200, Some(false)),
        ] {
            assert_eq!(frame(flags, sender).echo_of(writer), answer, "{flags} {sender} {writer}");
        }
    }
}
