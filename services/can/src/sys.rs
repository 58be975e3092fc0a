//! What neither rustix nor the socketcan crate offers: many frames with their marks in one call.
#![allow(unsafe_code)]

use std::io;
use std::os::fd::{AsRawFd, BorrowedFd};

use crate::protocol::Frame;
use crate::protocol::frame::{FD_BRS, FD_ESI, FD_FDF};

/// Frames taken by one call.
pub const BATCH: usize = 64;
/// `struct can_frame` and `struct canfd_frame`.
pub const CLASSIC_BYTES: usize = 16;
/// See [`CLASSIC_BYTES`].
pub const FD_BYTES: usize = 72;
/// Control data of a frame: a time and a counter need 56 bytes.
const CONTROL: usize = 16;

/// A received frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Received {
    /// The frame.
    pub frame: Frame,
    /// This very socket sent it, and it has been on the bus (MSG_CONFIRM).
    pub own: bool,
    /// The kernel's stamp, UTC in ns.
    pub utc_ns: Option<u64>,
    /// Frames that the kernel dropped for this socket so far (SO_RXQ_OVFL), modulo 2^32.
    pub drops: Option<u32>,
}

/// Memory for [`receive`].
pub struct Batch {
    frames: Box<[[u8; FD_BYTES]; BATCH]>,
    control: Box<[[u64; CONTROL]; BATCH]>,
    received: Vec<Received>,
}

impl Batch {
    /// What the last [`receive`] took.
    pub fn items(&self) -> &[Received] {
        &self.received
    }
}

impl Default for Batch {
    fn default() -> Self {
        Self {
            frames: Box::new([[0; FD_BYTES]; BATCH]),
            control: Box::new([[0; CONTROL]; BATCH]),
            received: Vec::with_capacity(BATCH),
        }
    }
}

/// `frame` as the kernel reads it; the length is [`CLASSIC_BYTES`] or [`FD_BYTES`].
pub fn to_kernel(frame: &Frame) -> ([u8; FD_BYTES], usize) {
    let mut bytes = [0; FD_BYTES];
    bytes[..4].copy_from_slice(&frame.can_id.to_ne_bytes());
    bytes[4] = frame.len;
    // The kernel sets its own mark for CAN FD.
    bytes[5] = frame.fd & (FD_BRS | FD_ESI);
    let payload = frame.payload();
    bytes[8..8 + payload.len()].copy_from_slice(payload);
    (bytes, if frame.is_fd() { FD_BYTES } else { CLASSIC_BYTES })
}

/// What the kernel wrote; `None` when it is no frame.
pub fn from_kernel(bytes: &[u8]) -> Option<Frame> {
    let fd = match bytes.len() {
        CLASSIC_BYTES => 0,
        FD_BYTES => FD_FDF | (bytes[5] & 3),
        _ => return None,
    };
    let mut frame = Frame {
        can_id: u32::from_ne_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]),
        len: bytes[4],
        fd,
        data: [0; 64],
    };
    frame.validate().ok()?;
    let n = frame.payload().len();
    frame.data[..n].copy_from_slice(&bytes[8..8 + n]);
    Some(frame)
}

/// Takes what waits in a raw CAN socket, at most [`BATCH`] messages, and says how many; those that are frames are the
/// batch's items. Never waits: `WouldBlock` when there is nothing.
pub fn receive(socket: BorrowedFd<'_>, batch: &mut Batch) -> io::Result<usize> {
    batch.received.clear();
    let mut vectors: [libc::iovec; BATCH] = std::array::from_fn(|i| libc::iovec {
        iov_base: batch.frames[i].as_mut_ptr().cast(),
        iov_len: FD_BYTES,
    });
    // SAFETY: an all-zero mmsghdr is valid: null pointers with lengths of zero.
    let mut headers: [libc::mmsghdr; BATCH] = unsafe { std::mem::zeroed() };
    for (i, header) in headers.iter_mut().enumerate() {
        header.msg_hdr.msg_iov = &raw mut vectors[i];
        header.msg_hdr.msg_iovlen = 1;
        header.msg_hdr.msg_control = batch.control[i].as_mut_ptr().cast();
        header.msg_hdr.msg_controllen = (CONTROL * 8) as _;
    }
    // SAFETY: each header points to one vector and one control buffer of the stated lengths, all of which live and are
    // not otherwise used until the call returns.
    let count = unsafe {
        libc::recvmmsg(
            socket.as_raw_fd(),
            headers.as_mut_ptr(),
            BATCH as libc::c_uint,
            libc::MSG_DONTWAIT as _,
            std::ptr::null_mut(),
        )
    };
    if count < 0 {
        return Err(io::Error::last_os_error());
    }
    for (i, header) in headers.iter().take(count as usize).enumerate() {
        let Some(frame) = from_kernel(&batch.frames[i][..(header.msg_len as usize).min(FD_BYTES)]) else {
            continue;
        };
        let own = header.msg_hdr.msg_flags & libc::MSG_CONFIRM != 0;
        let (utc_ns, drops) = control(&header.msg_hdr);
        batch.received.push(Received { frame, own, utc_ns, drops });
    }
    Ok(count as usize)
}

fn control(header: &libc::msghdr) -> (Option<u64>, Option<u32>) {
    let (mut utc_ns, mut drops) = (None, None);
    // SAFETY: the kernel has filled the control buffer that `header` points to and set its length; CMSG_FIRSTHDR and
    // CMSG_NXTHDR stay within it. The data are read unaligned and only as far as the message says.
    unsafe {
        let mut message = libc::CMSG_FIRSTHDR(header);
        while !message.is_null() {
            let head = std::ptr::read_unaligned(message);
            let data = libc::CMSG_DATA(message);
            let len = (head.cmsg_len as usize).saturating_sub(libc::CMSG_LEN(0) as usize);
            if head.cmsg_level == libc::SOL_SOCKET {
                if head.cmsg_type == libc::SCM_TIMESTAMPNS && len >= size_of::<libc::timespec>() {
                    let t = std::ptr::read_unaligned(data.cast::<libc::timespec>());
                    utc_ns =
                        Some((t.tv_sec as u64).wrapping_mul(1_000_000_000).wrapping_add(t.tv_nsec as u64));
                } else if head.cmsg_type == libc::SO_RXQ_OVFL && len >= 4 {
                    drops = Some(std::ptr::read_unaligned(data.cast::<u32>()));
                }
            }
            message = libc::CMSG_NXTHDR(header, message);
        }
    }
    (utc_ns, drops)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::protocol::candump::parse;
    use proptest::prelude::*;
    use std::os::fd::AsFd;
    use std::os::unix::net::UnixDatagram;

    /// A datagram socket carries the same messages, stamps included, so that the call is tested without CAN.
    #[test]
    fn many_frames_in_one_call() {
        let (a, b) = UnixDatagram::pair().unwrap();
        rustix::net::sockopt::set_socket_keepalive(&a, false).ok();
        let frames: Vec<_> = ["123#0102", "00000123#R4", "1ABCDEF0##3AABB", "20000080#0000000000000000"]
            .iter()
            .map(|text| parse(text).unwrap())
            .collect();
        for frame in &frames {
            let (bytes, n) = to_kernel(frame);
            a.send(&bytes[..n]).unwrap();
        }
        a.send(b"no frame").unwrap();
        let mut batch = Batch::default();
        assert_eq!(receive(b.as_fd(), &mut batch).unwrap(), 5);
        let got: Vec<_> = batch.items().iter().map(|r| (r.frame, r.own, r.drops)).collect();
        assert_eq!(got, frames.iter().map(|f| (*f, false, None)).collect::<Vec<_>>());
        assert_eq!(receive(b.as_fd(), &mut batch).unwrap_err().kind(), io::ErrorKind::WouldBlock);
    }

    proptest! {
        #[test]
        fn round_trip(frame in crate::protocol::frame::tests::any_frame(true)) {
            let (bytes, n) = to_kernel(&frame);
            prop_assert_eq!(from_kernel(&bytes[..n]), Some(frame));
        }

        #[test]
        fn never_panics(bytes in prop::collection::vec(any::<u8>(), 0..80), classic in any::<bool>()) {
            let _ = from_kernel(&bytes);
            let mut padded = bytes;
            padded.resize(if classic { CLASSIC_BYTES } else { FD_BYTES }, 0);
            let _ = from_kernel(&padded);
        }
    }
}
