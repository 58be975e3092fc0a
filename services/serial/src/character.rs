//! Rate and shape of characters, and the settings of a terminal that `serialport` has no words for.

use std::io;
use std::os::fd::BorrowedFd;

use rustix::termios::{ControlModes, InputModes, OptionalActions, tcgetattr, tcsetattr};
use serde::{Deserialize, Serialize};

/// Parity bit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Parity {
    /// No parity bit.
    None,
    /// Even number of ones.
    Even,
    /// Odd number of ones.
    Odd,
    /// Always 1.
    Mark,
    /// Always 0.
    Space,
}

/// Flow control.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Flow {
    /// None.
    #[default]
    None,
    /// By the lines RTS and CTS.
    Rtscts,
    /// By the characters XON and XOFF.
    Xonxoff,
}

/// Rate and shape of characters.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Character {
    /// Bit/s.
    pub baud: u32,
    /// 5 to 8.
    pub data_bits: u8,
    /// Parity bit.
    pub parity: Parity,
    /// 1 or 2.
    pub stop_bits: u8,
    /// Flow control.
    pub flow: Flow,
}

impl Character {
    /// Bits of a character on the line, start, parity and stop bits included.
    pub fn bits(&self) -> u32 {
        1 + u32::from(self.data_bits) + u32::from(self.parity != Parity::None) + u32::from(self.stop_bits)
    }
}

impl std::fmt::Display for Character {
    /// `19200 8E1`
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let parity = match self.parity {
            Parity::None => 'N',
            Parity::Even => 'E',
            Parity::Odd => 'O',
            Parity::Mark => 'M',
            Parity::Space => 'S',
        };
        write!(f, "{} {}{parity}{}", self.baud, self.data_bits, self.stop_bits)
    }
}

fn control_modes(c: &Character) -> ControlModes {
    let size = match c.data_bits {
        5 => ControlModes::CS5,
        6 => ControlModes::CS6,
        7 => ControlModes::CS7,
        _ => ControlModes::CS8,
    };
    let parity = match c.parity {
        Parity::None => ControlModes::empty(),
        Parity::Even => ControlModes::PARENB,
        Parity::Odd => ControlModes::PARENB | ControlModes::PARODD,
        Parity::Mark => ControlModes::PARENB | ControlModes::PARODD | ControlModes::CMSPAR,
        Parity::Space => ControlModes::PARENB | ControlModes::CMSPAR,
    };
    let stop = if c.stop_bits == 2 { ControlModes::CSTOPB } else { ControlModes::empty() };
    let flow = if c.flow == Flow::Rtscts { ControlModes::CRTSCTS } else { ControlModes::empty() };
    size | parity | stop | flow
}

const PARITY: ControlModes = ControlModes::PARENB.union(ControlModes::PARODD).union(ControlModes::CMSPAR);

/// Makes the other end of a pseudo-terminal a plain pipe of bytes of this character, from its master, which
/// `serialport` does not open.
pub fn make_pipe(master: BorrowedFd<'_>, c: &Character) -> io::Result<()> {
    let mut t = tcgetattr(master)?;
    t.make_raw();
    t.input_modes -= InputModes::INPCK | InputModes::IGNPAR | InputModes::IXOFF | InputModes::IXANY;
    t.input_modes.set(InputModes::IXON | InputModes::IXOFF, c.flow == Flow::Xonxoff);
    t.control_modes -= ControlModes::CSIZE | PARITY | ControlModes::CSTOPB | ControlModes::CRTSCTS;
    t.control_modes |= control_modes(c) | ControlModes::CLOCAL | ControlModes::CREAD;
    t.control_modes -= ControlModes::HUPCL;
    t.set_speed(c.baud)?;
    Ok(tcsetattr(master, OptionalActions::Now, &t)?)
}

/// Adds to what `serialport` has set: parity mark and space, and lines that stay as they are when the port is closed.
/// Takes away what an earlier program may have left on.
pub fn complete(port: BorrowedFd<'_>, c: &Character) -> io::Result<()> {
    let mut t = tcgetattr(port)?;
    t.input_modes -= InputModes::IXANY;
    t.control_modes -= ControlModes::HUPCL;
    t.control_modes.set(ControlModes::CMSPAR, matches!(c.parity, Parity::Mark | Parity::Space));
    Ok(tcsetattr(port, OptionalActions::Now, &t)?)
}

/// Has the kernel drop RTS and DTR when the port is closed, also by a process that was killed.
pub fn drop_lines_on_close(port: BorrowedFd<'_>) -> io::Result<()> {
    let mut t = tcgetattr(port)?;
    t.control_modes |= ControlModes::HUPCL;
    Ok(tcsetattr(port, OptionalActions::Now, &t)?)
}

/// Asks for marks before damaged bytes (PARMRK), see [`crate::protocol::parmrk`].
pub fn mark_errors(port: BorrowedFd<'_>) -> io::Result<()> {
    let mut t = tcgetattr(port)?;
    // `serialport` ignores errors where there is no parity; framing errors would go unseen.
    t.input_modes -= InputModes::IGNPAR;
    t.input_modes |= InputModes::PARMRK | InputModes::INPCK;
    Ok(tcsetattr(port, OptionalActions::Now, &t)?)
}

/// What the port has taken otherwise than asked, e.g. `data_bits`. The rate may be off by 2 %: more than that no
/// receiver follows.
pub fn differences(port: BorrowedFd<'_>, c: &Character) -> io::Result<Vec<&'static str>> {
    let t = tcgetattr(port)?;
    let other = t.control_modes ^ control_modes(c);
    let mut different = Vec::new();
    let keys = [
        (ControlModes::CSIZE, "data_bits"),
        (PARITY, "parity"),
        (ControlModes::CSTOPB, "stop_bits"),
        (ControlModes::CRTSCTS, "flow"),
    ];
    for (mask, key) in keys {
        if other.intersects(mask) {
            different.push(key);
        }
    }
    if u64::from(t.output_speed().abs_diff(c.baud)) * 50 > u64::from(c.baud) {
        different.push("baud");
    }
    Ok(different)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sentences() {
        let c =
            Character { baud: 12_345, data_bits: 7, parity: Parity::Even, stop_bits: 2, flow: Flow::None };
        assert_eq!((c.to_string().as_str(), c.bits()), ("12345 7E2", 11));
        let c = Character { data_bits: 8, parity: Parity::None, stop_bits: 1, ..c };
        assert_eq!((c.to_string().as_str(), c.bits()), ("12345 8N1", 10));
    }

    #[test]
    fn every_character_has_its_bits() {
        let c = |data_bits, parity, stop_bits, flow| {
            control_modes(&Character { baud: 9600, data_bits, parity, stop_bits, flow }).bits()
        };
        assert_eq!(c(8, Parity::None, 1, Flow::None), libc::CS8);
        assert_eq!(c(7, Parity::Even, 2, Flow::Xonxoff), libc::CS7 | libc::PARENB | libc::CSTOPB);
        assert_eq!(
            c(6, Parity::Odd, 1, Flow::Rtscts),
            libc::CS6 | libc::PARENB | libc::PARODD | libc::CRTSCTS
        );
        let mark = libc::PARENB | libc::PARODD | libc::CMSPAR;
        assert_eq!(c(5, Parity::Mark, 1, Flow::None), libc::CS5 | mark);
        assert_eq!(c(8, Parity::Space, 1, Flow::None), libc::CS8 | libc::PARENB | libc::CMSPAR);
    }

    #[test]
    fn a_pipe_is_no_terminal() {
        use std::os::fd::AsFd;
        let (pipe, _) = rustix::pipe::pipe().unwrap();
        let c = Character { baud: 9600, data_bits: 8, parity: Parity::None, stop_bits: 1, flow: Flow::None };
        assert!(make_pipe(pipe.as_fd(), &c).is_err() && complete(pipe.as_fd(), &c).is_err());
        assert!(mark_errors(pipe.as_fd()).is_err() && differences(pipe.as_fd(), &c).is_err());
        assert!(drop_lines_on_close(pipe.as_fd()).is_err());
    }
}
