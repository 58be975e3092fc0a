//! A port with its framing, sending, echo and pace: what service, command line and virtual slave share.
//!
//! The caller waits (for [`Driver::fd`] and [`Driver::deadline`]) and calls; nothing here waits, and nothing allocates
//! once it is made.

use std::io;
use std::os::fd::BorrowedFd;

use ipc_types::payload::{CHUNK_BYTES, SerialChunk, serial_flag};
use serde::Serialize;

use crate::port::{ErrorCounters, Port, Read};
use crate::protocol::answer::Expected;
use crate::protocol::echo::{Echo, EchoCounters};
use crate::protocol::framer::{self, Chunk, FrameCounters, Framer};
use crate::protocol::pacer::{self, Pacer};
use crate::protocol::sender::{self, Head, Outcome, SendCounters, Sender, Step};

/// Bytes of one read.
const READ: usize = 4096;
/// Reads of one wake-up; the rest waits for the next.
const READS: usize = 4;
/// Steps of one turn: each makes progress or waits, so that this is never reached.
const STEPS: usize = 64;

/// How a port is driven.
#[derive(Debug, Clone, Copy)]
pub struct Settings {
    /// How frames are found.
    pub framer: framer::Settings,
    /// How frames are sent.
    pub sender: sender::Settings,
    /// Our own bytes come back and are removed.
    pub discard_echo: bool,
    /// How long after sending they are waited for, ns.
    pub echo_patience_ns: u64,
    /// Received bytes are held to the line's pace.
    pub pace: bool,
}

/// Where chunks go. The header's stamp and `n` are the receiver's to fill; `t_ns` is the time for the stamp.
pub trait Sink {
    /// A frame, or a part of one, or the echo of a transmission.
    fn chunk(&mut self, header: SerialChunk, bytes: &[u8], t_ns: u64);
}

impl<F: FnMut(SerialChunk, &[u8], u64)> Sink for F {
    fn chunk(&mut self, header: SerialChunk, bytes: &[u8], t_ns: u64) {
        self(header, bytes, t_ns);
    }
}

/// Everything that was counted.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Counters {
    /// Received.
    pub rx: FrameCounters,
    /// Sent.
    pub tx: SendCounters,
    /// Seen by the UART.
    pub line: ErrorCounters,
    /// Our own bytes.
    pub echo: EchoCounters,
}

/// See the module.
pub struct Driver {
    port: Port,
    framer: Framer,
    sender: Sender,
    echo: Option<Echo>,
    echo_patience_ns: u64,
    pacer: Option<Pacer>,
    scratch: Box<[u8; READ]>,
    wake_ns: Option<u64>,
    nobody: bool,
}

fn hand_over(sink: &mut dyn Sink, chunk: &Chunk<'_>) {
    let header = SerialChunk { first_t_ns: chunk.first_ns, flags: chunk.flags, ..SerialChunk::default() };
    sink.chunk(header, chunk.bytes, chunk.end_ns);
}

impl Driver {
    /// Drives a port from now on.
    pub fn new(port: Port, settings: &Settings) -> Self {
        Self {
            port,
            framer: Framer::new(settings.framer),
            sender: Sender::new(settings.sender),
            echo: settings.discard_echo.then(Echo::default),
            echo_patience_ns: settings.echo_patience_ns,
            pacer: settings.pace.then(|| Pacer::new(settings.framer.timing.char_ns)),
            scratch: Box::new([0; READ]),
            wake_ns: None,
            nobody: false,
        }
    }

    /// The port.
    pub fn port(&self) -> &Port {
        &self.port
    }

    /// Readable when [`Self::readable`] should be called.
    pub fn fd(&self) -> BorrowedFd<'_> {
        self.port.fd()
    }

    /// Whether nobody has the other end of a pseudo-terminal open: then [`Self::fd`] must not be waited for until
    /// [`Self::visited`] says so.
    pub fn nobody(&self) -> bool {
        self.nobody
    }

    /// Whether received bytes must wait in the kernel, because the imagined line is full of them.
    pub fn is_full(&self) -> bool {
        self.pacer.as_ref().is_some_and(|p| p.room() < pacer::MAX_BYTES / 2)
    }

    /// The pseudo-terminal was opened by somebody, or is thought to be.
    pub fn visited(&mut self) {
        self.nobody = !self.port.visited();
    }

    /// What was counted so far.
    pub fn counters(&self) -> Counters {
        Counters {
            rx: self.framer.counters(),
            tx: self.sender.counters(),
            line: self.port.errors(),
            echo: self.echo.as_ref().map(Echo::counters).unwrap_or_default(),
        }
    }

    /// When [`Self::turn`] must be called.
    pub fn deadline(&self) -> Option<u64> {
        let line = match self.pacer.as_ref().and_then(Pacer::deadline) {
            Some(due) => Some(due),
            None => self.framer.deadline(),
        };
        [line, self.wake_ns].into_iter().flatten().min()
    }

    /// Whether the next transmission can be loaded.
    pub fn is_idle(&self) -> bool {
        self.sender.is_idle()
    }

    /// Whether bytes are going out.
    pub fn is_sending(&self) -> bool {
        self.sender.is_sending()
    }

    /// Takes a transmission; its end comes to the sink as an echo chunk. False: one is under way, or the length is
    /// wrong.
    pub fn load(&mut self, head: Head, bytes: &[u8], now_ns: u64) -> bool {
        self.sender.load(head, bytes, now_ns)
    }

    /// Reads what has come. An error means that the port is gone.
    pub fn readable(&mut self, now_ns: u64, sink: &mut dyn Sink) -> io::Result<()> {
        for _ in 0..READS {
            if self.is_full() {
                return Ok(());
            }
            let want = self.pacer.as_ref().map_or(READ, |p| p.room().min(READ));
            let (n, flags) = match self.port.read(&mut self.scratch[..want])? {
                Read::Nothing => return Ok(()),
                Read::Nobody => {
                    self.nobody = true;
                    return Ok(());
                }
                Read::Bytes(n, flags) => (n, flags),
            };
            if flags != 0 {
                self.framer.mark(flags);
            }
            if let Some(pacer) = &mut self.pacer {
                pacer.push(now_ns, &self.scratch[..n]);
            } else {
                received(&mut self.framer, self.echo.as_mut(), &self.scratch[..n], now_ns, sink);
            }
            // A short read: there is no more.
            if n < want {
                return Ok(());
            }
        }
        Ok(())
    }

    /// Does what is due. An error means that the port is gone.
    pub fn turn(&mut self, now_ns: u64, sink: &mut dyn Sink) -> io::Result<()> {
        if let Some(pacer) = &mut self.pacer {
            loop {
                let (n, t_ns) = pacer.take(now_ns, &mut self.scratch[..]);
                if n == 0 {
                    break;
                }
                received(&mut self.framer, self.echo.as_mut(), &self.scratch[..n], t_ns, sink);
            }
        }
        let on_line = self.pacer.as_ref().is_some_and(|p| !p.is_empty());
        if !on_line {
            self.framer.turn(now_ns, &mut |chunk| hand_over(sink, &chunk));
        }
        if let Some(echo) = &mut self.echo {
            echo.turn(now_ns);
        }
        self.wake_ns = None;
        for _ in 0..STEPS {
            let receiving = on_line || self.framer.is_receiving();
            match self.sender.step(now_ns, self.framer.last_ns(), receiving) {
                Step::Idle => return Ok(()),
                Step::Wait(t_ns) => {
                    self.wake_ns = Some(t_ns);
                    return Ok(());
                }
                Step::Rts(on) => self.port.transmitter(on)?,
                Step::Write(from, to) => self.write(from, to, now_ns)?,
                Step::Probe => {
                    let empty = self.port.is_drained()?;
                    self.sender.drained(empty, now_ns);
                }
                Step::Done(outcome) => {
                    self.done(outcome, now_ns, sink);
                    return Ok(());
                }
            }
        }
        self.wake_ns = Some(now_ns + 1_000_000);
        Ok(())
    }

    fn write(&mut self, from: usize, to: usize, now_ns: u64) -> io::Result<()> {
        let (_, bytes) = self.sender.current();
        let n = self.port.write(&bytes[from..to])?;
        // Nothing comes back of what the port did not take, and it is asked again and again.
        if from == 0
            && n > 0
            && let Some(echo) = &mut self.echo
        {
            // Until the end is known: its own time and a second.
            echo.expect(bytes, now_ns + 1_000_000_000 + bytes.len() as u64 * 20_000_000);
        }
        self.sender.wrote(n, now_ns);
        Ok(())
    }

    fn done(&mut self, outcome: Outcome, now_ns: u64, sink: &mut dyn Sink) {
        if outcome.not_sent.is_some() {
            self.port.discard_output();
        }
        if let Some(echo) = &mut self.echo {
            echo.end_at(now_ns + self.echo_patience_ns);
        }
        let (head, bytes) = self.sender.current();
        // Where nothing keeps the silence before the next transmission, waiting for the one behind the answer does.
        let awaited = outcome.not_sent.is_none()
            && head.flags & serial_flag::EXPECT_ANSWER != 0
            && self.sender.keeps_silence();
        self.framer.expect(if awaited { Expected::of(bytes) } else { None });
        let missing = if outcome.not_sent.is_some() { serial_flag::NOT_SENT } else { 0 };
        let header = SerialChunk {
            first_t_ns: outcome.first_ns,
            tx_seq: head.seq,
            tx_writer: head.writer,
            tx_generation: head.generation,
            flags: echo_flags(head, bytes.len()) | missing,
            ..SerialChunk::default()
        };
        sink.chunk(header, bytes, outcome.end_ns);
    }

    /// The port is gone: ends what is under way and gives the port back for closing.
    pub fn end(mut self, now_ns: u64, sink: &mut dyn Sink) -> (Port, Counters) {
        self.framer.reset(now_ns, &mut |chunk| hand_over(sink, &chunk));
        self.sender.port_gone(now_ns);
        if let Step::Done(outcome) = self.sender.step(now_ns, None, false) {
            self.done(outcome, now_ns, sink);
        }
        let counters = self.counters();
        (self.port, counters)
    }
}

/// An echo ends a frame unless it is a full chunk that says otherwise.
pub fn echo_flags(head: &Head, len: usize) -> u32 {
    let goes_on = len == CHUNK_BYTES && head.flags & serial_flag::END == 0;
    serial_flag::TX_ECHO | if goes_on { 0 } else { serial_flag::END }
}

fn received(framer: &mut Framer, echo: Option<&mut Echo>, bytes: &[u8], t_ns: u64, sink: &mut dyn Sink) {
    let own = echo.map_or(0, |echo| echo.filter(bytes, t_ns));
    framer.push(t_ns, &bytes[own..], &mut |chunk| hand_over(sink, &chunk));
}

impl Counters {
    /// The sum with those of the port before it was reopened.
    #[must_use]
    pub fn plus(&self, o: &Self) -> Self {
        let (r, s) = (&self.rx, &o.rx);
        Self {
            rx: FrameCounters {
                bytes: r.bytes + s.bytes,
                frames: r.frames + s.frames,
                crc_errors: r.crc_errors + s.crc_errors,
                fragments: r.fragments + s.fragments,
                t15_gaps: r.t15_gaps + s.t15_gaps,
                rejected_t15: r.rejected_t15 + s.rejected_t15,
                late: r.late + s.late,
                too_long: r.too_long + s.too_long,
                bytes_cut: r.bytes_cut + s.bytes_cut,
            },
            tx: SendCounters {
                bytes: self.tx.bytes + o.tx.bytes,
                frames: self.tx.frames + o.tx.frames,
                expired: self.tx.expired + o.tx.expired,
                line_busy: self.tx.line_busy + o.tx.line_busy,
                blocked: self.tx.blocked + o.tx.blocked,
                port_gone: self.tx.port_gone + o.tx.port_gone,
            },
            line: ErrorCounters {
                parity: self.line.parity + o.line.parity,
                framing: self.line.framing + o.line.framing,
                overrun: self.line.overrun + o.line.overrun,
                breaks: self.line.breaks + o.line.breaks,
            },
            echo: EchoCounters {
                removed: self.echo.removed + o.echo.removed,
                collisions: self.echo.collisions + o.echo.collisions,
                missing: self.echo.missing + o.echo.missing,
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Config, EchoMode};
    use crate::port::Kind;
    use std::path::Path;

    #[test]
    fn a_port_that_takes_nothing_yet_misses_no_echo() {
        let dir = std::env::temp_dir();
        let link = dir.join(format!("dinrail-serial-full-{}", std::process::id()));
        let made = Config::of_device(&format!("pty:{}", link.display()));
        let mut other = Port::open(&made.options(Path::new("/")).unwrap()).unwrap();
        let mut config = Config::of_device(link.to_str().unwrap());
        config.echo = EchoMode::Discard;
        let mut port = Port::open(&config.options(Path::new("/")).unwrap()).unwrap();
        assert!(other.visited());
        // The kernel moves bytes on by and by: full is what takes nothing for a while.
        let (mut filled, mut refused) = (0, 0);
        while refused < 20 {
            match port.write(&[0; 4096]).unwrap() {
                0 => {
                    refused += 1;
                    std::thread::sleep(std::time::Duration::from_millis(5));
                }
                n => (filled, refused) = (filled + n, 0),
            }
        }
        let mut driver = Driver::new(port, &config.settings(Kind::Pty));
        assert!(driver.load(Head::default(), b"hello", 0));
        let mut echoes = 0;
        let mut sink = |header: SerialChunk, _: &[u8], _: u64| {
            assert_eq!(header.flags & serial_flag::NOT_SENT, 0);
            echoes += 1;
        };
        for turn in 0..20 {
            driver.turn(turn * 20_000_000, &mut sink).unwrap();
        }
        assert_eq!((driver.counters().echo.missing, driver.is_idle()), (0, false));
        // It takes it when there is room.
        let mut bytes = [0; 4096];
        let mut now_ns = 500_000_000;
        ipc_types::testing::wait("the last byte", || {
            while let Ok(Read::Bytes(n, _)) = other.read(&mut bytes) {
                filled = filled.saturating_sub(n);
            }
            now_ns += 1_000_000;
            driver.turn(now_ns.min(900_000_000), &mut sink).unwrap();
            driver.is_idle().then_some(())
        });
        assert_eq!((echoes, driver.counters().tx.frames), (1, 1));
    }

    #[test]
    fn an_awaited_answer_waits_for_no_silence_but_the_next_request_does() {
        let frame = |bytes: &[u8]| [bytes, &crate::protocol::crc::crc16(bytes).to_le_bytes()].concat();
        let (request, answer) = (frame(&[1, 3, 0, 0, 0, 1]), frame(&[1, 3, 2, 0, 7]));
        for (flags, duplex, at_once) in [
            (serial_flag::EXPECT_ANSWER, None, true),
            (0, None, false),
            (serial_flag::EXPECT_ANSWER, Some(crate::config::Duplex::Full), false),
        ] {
            let link = std::env::temp_dir().join(format!("dinrail-serial-await-{}", std::process::id()));
            let made = Config::of_device(&format!("pty:{}", link.display()));
            let mut other = Port::open(&made.options(Path::new("/")).unwrap()).unwrap();
            let mut config = Config::of_device(link.to_str().unwrap());
            config.duplex = duplex;
            let port = Port::open(&config.options(Path::new("/")).unwrap()).unwrap();
            assert!(other.visited());
            let settings = config.settings(Kind::Pty);
            let mut driver = Driver::new(port, &settings);
            let (mut echoes, mut answers) = (0, 0);
            let mut sink = |header: SerialChunk, bytes: &[u8], _: u64| {
                if header.flags & serial_flag::TX_ECHO != 0 {
                    echoes += 1;
                } else {
                    assert_eq!(bytes, answer);
                    answers += 1;
                }
            };
            let t = 1_000_000_000;
            assert!(driver.load(Head { flags, ..Head::default() }, &request, t));
            while !driver.is_idle() {
                driver.turn(t, &mut sink).unwrap();
            }
            assert_eq!(other.write(&answer).unwrap(), answer.len());
            ipc_types::testing::wait("the answer", || {
                driver.readable(t, &mut sink).unwrap();
                (driver.counters().rx.bytes == answer.len() as u64).then_some(())
            });
            assert_eq!(driver.counters().rx.frames, u64::from(at_once));
            if duplex.is_some() {
                continue;
            }
            assert!(driver.load(Head::default(), &request, t));
            let silent = t + settings.framer.silence_ns;
            for now in [t, silent - 1] {
                driver.turn(now, &mut sink).unwrap();
                assert_eq!(driver.counters().tx.frames, 1);
            }
            while !driver.is_idle() {
                driver.turn(silent, &mut sink).unwrap();
            }
            assert_eq!((echoes, answers), (2, 1));
        }
    }
}
