//! Backends `slcan` and `socketcand`: a bus behind a connection that carries bytes, spoken to by a [`Peer`].

use std::io;

use ipc_types::clock;
use ipc_types::event::Level;
use tokio::io::Interest;

use super::port::{Port, Target};
use super::{BackOff, Line};
use crate::protocol::error_frame::ControllerState;
use crate::protocol::peer::{Heard, Peer};
use crate::server::{Host, sleep_until};

/// Bytes read at once.
const READ_BYTES: usize = 16 * 1024;
const PULLED: &str = "the adapter was pulled; it is tried again";
/// Bytes that may wait to be written before no more frames are taken. Few, because a frame may count as sent when it is
/// here, and one that is here is overtaken by none.
const WRITE_BYTES: usize = 1024;

/// Works for ever. Must run inside a `LocalSet`; the bus must have its wire attached with the peer's flight.
pub async fn drive<H: Host + 'static>(line: Line<H>, target: Target, mut peer: Box<dyn Peer>) {
    let mut back_off = BackOff::default();
    loop {
        match target.open().await {
            Err(e) => line.down(e.to_string()),
            Ok(port) => {
                let mut talk = Talk {
                    line: &line,
                    peer: &mut *peer,
                    port,
                    out: Vec::with_capacity(2 * WRITE_BYTES),
                    heard: Vec::with_capacity(1024),
                    last_ns: 0,
                    was_up: false,
                    blocked: false,
                };
                let why = talk.run().await;
                if talk.was_up {
                    back_off = BackOff::default();
                }
                let interface = line.status.borrow().interface.clone();
                line.down(format!("{interface}: {why}"));
            }
        }
        back_off.wait().await;
    }
}

struct Talk<'a, H: Host> {
    line: &'a Line<H>,
    peer: &'a mut dyn Peer,
    port: Port,
    out: Vec<u8>,
    heard: Vec<Heard>,
    last_ns: u64,
    was_up: bool,
    /// The other side did not take all that was written.
    blocked: bool,
}

impl<H: Host + 'static> Talk<'_, H> {
    /// Until the connection is of no use any more; returns why.
    async fn run(&mut self) -> String {
        let hub = self.line.hub.clone();
        let mut buffer = vec![0u8; READ_BYTES].into_boxed_slice();
        self.peer.connected(clock::mono_ns(), &mut self.out);
        // A full buffer was read: more waits, and others must have their turn in between.
        let mut flooded = false;
        loop {
            if let Err(why) = self.settle() {
                let _ = self.port.try_write(self.peer.farewell());
                return why;
            }
            self.blocked = match self.write() {
                Ok(blocked) => blocked,
                Err(e) => return gone(&e),
            };
            let blocked = self.blocked;
            if std::mem::take(&mut flooded) {
                tokio::task::yield_now().await;
            }
            let interest = if blocked { Interest::READABLE | Interest::WRITABLE } else { Interest::READABLE };
            let deadline_ns = self.peer.deadline_ns();
            tokio::select! {
                ready = self.port.ready(interest) => match ready {
                    Ok(false) => {}
                    Ok(true) => match self.port.try_read(&mut buffer) {
                        Ok(0) => {
                            return match self.port {
                                Port::Tcp(_) => "the other side ended the connection; it is tried again".to_owned(),
                                Port::Tty(_) => PULLED.to_owned(),
                            };
                        }
                        Ok(n) => {
                            flooded = n == READ_BYTES;
                            let heard = &mut self.heard;
                            self.peer.receive(&buffer[..n], clock::mono_ns(), &mut self.out, &mut |h| heard.push(h));
                        }
                        Err(e) if e.kind() == io::ErrorKind::WouldBlock => {}
                        Err(e) => return gone(&e),
                    },
                    Err(e) => return gone(&e),
                },
                () = hub.wire_wanted(), if !blocked => {}
                () = sleep_until(deadline_ns), if deadline_ns.is_some() => {
                    let heard = &mut self.heard;
                    self.peer.tick(clock::mono_ns(), &mut self.out, &mut |h| heard.push(h));
                }
            }
        }
    }

    /// Acts on what was heard and gives the peer what may go.
    fn settle(&mut self) -> Result<(), String> {
        let hub = self.line.hub.clone();
        loop {
            let (heard, mut rest) = (std::mem::take(&mut self.heard), Vec::new());
            hub.turn(|bus, host, now_ns| {
                for item in &heard {
                    match item {
                        Heard::Frame(frame, t_ns) => {
                            self.last_ns = self.last_ns.max((*t_ns).min(now_ns));
                            bus.wire_received(frame, self.last_ns, host);
                        }
                        Heard::Sent => {
                            self.last_ns = self.last_ns.max(now_ns);
                            bus.wire_sent(self.last_ns, host);
                        }
                        Heard::Refused => bus.wire_refused(),
                        other => rest.push(other.clone()),
                    }
                }
            });
            self.heard = heard;
            self.heard.clear();
            for item in rest {
                self.news(item)?;
            }
            self.give();
            if self.heard.is_empty() {
                return Ok(());
            }
        }
    }

    fn give(&mut self) {
        if self.blocked {
            return;
        }
        let (peer, out, heard) = (&mut *self.peer, &mut self.out, &mut self.heard);
        self.line.hub.turn(|bus, _, now_ns| {
            while out.len() < WRITE_BYTES
                && let Some(frame) = bus.wire_next(now_ns, |f| peer.fits(f))
            {
                peer.send(&frame, now_ns, out, &mut |h| heard.push(h));
            }
        });
    }

    fn news(&mut self, item: Heard) -> Result<(), String> {
        let interface = self.line.status.borrow().interface.clone();
        match item {
            Heard::Up => {
                self.was_up = true;
                if self.line.status.borrow().state == Some(ControllerState::BusOff) {
                    self.line.status.borrow_mut().restarts += 1;
                    self.line.state(ControllerState::Active, "its channel was opened again");
                }
                self.line.up(format!("{interface} is up"));
                Ok(())
            }
            Heard::Restarting(why) => {
                let state = self.line.status.borrow().state;
                self.line.down(format!("{interface}: {why}"));
                self.line.status.borrow_mut().state = state;
                Ok(())
            }
            Heard::State(state, words) => {
                if state != ControllerState::Active {
                    self.line.status.borrow_mut().last_error = Some(words.clone());
                }
                self.line.state(state, &words);
                Ok(())
            }
            Heard::Note(text) => {
                self.line.say(Level::Warning, format!("{interface}: {text}"));
                Ok(())
            }
            Heard::Fault(why) => Err(why),
            Heard::Frame(..) | Heard::Sent | Heard::Refused => Ok(()),
        }
    }

    /// Writes what waits; true when not all could be written.
    fn write(&mut self) -> io::Result<bool> {
        let mut done = 0;
        while done < self.out.len() {
            match self.port.try_write(&self.out[done..]) {
                Ok(0) => return Err(io::ErrorKind::WriteZero.into()),
                Ok(n) => done += n,
                Err(e) if e.kind() == io::ErrorKind::WouldBlock => break,
                Err(e) => return Err(e),
            }
        }
        self.out.drain(..done);
        Ok(!self.out.is_empty())
    }
}

fn gone(e: &io::Error) -> String {
    match e.raw_os_error() {
        Some(libc::EIO | libc::ENXIO | libc::ENODEV) => PULLED.to_owned(),
        _ => format!("{e}; it is tried again"),
    }
}

#[cfg(test)]
#[path = "remote_tests.rs"]
mod tests;
