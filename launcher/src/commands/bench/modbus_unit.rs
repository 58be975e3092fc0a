//! A unit at the far end of a serial line: a thread that answers reads of holding registers after 3.5 characters of
//! silence, as RTU demands.
//!
//! A unit is a device of its own, whose lateness is nobody else's. It has real-time priority where the user may, sleeps
//! on an absolute timer without slack, never spins, and says when it did what, so that its lateness can be told from
//! that of what is measured.

use super::modbus_lines::T35_US;
use crate::supervise::sys::set_fifo;
use anyhow::Context as _;
use dinrail_modbus::protocol::rtu;
use dinrail_serial::Config as SerialConfig;
use dinrail_serial::port::{Port, Read};
use ipc_types::clock::mono_ns;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::time::{
    Itimerspec, TimerfdClockId, TimerfdFlags, TimerfdTimerFlags, timerfd_create, timerfd_settime,
};
use std::io;
use std::os::fd::OwnedFd;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;

/// Real-time priority, of what has one here.
pub const PRIORITY: u32 = 4;
const SILENCE_NS: u64 = T35_US as u64 * 1000;

/// What the unit did last. Read it after the answer was received: then it is not written any more.
#[derive(Debug, Default)]
pub struct Log {
    pub answered: AtomicU64,
    /// So much later than it was set to did the timer of the silence wake the unit, ns.
    pub timer_late_ns: AtomicU64,
    /// CLOCK_MONOTONIC just before the first byte of the answer was written, ns.
    pub answer_ns: AtomicU64,
}

/// See the module; ends when dropped.
pub struct Unit {
    stop: Arc<AtomicBool>,
    pub log: Arc<Log>,
    thread: Option<JoinHandle<()>>,
}

impl Unit {
    pub fn start(line: &Path) -> anyhow::Result<Self> {
        let mut config = SerialConfig::of_device(&line.display().to_string());
        config.verify = false;
        config.exclusive = false;
        let options = config.options(Path::new("/")).context("the pseudo-terminal has no path")?;
        let port = Port::open(&options)?;
        let timer = Timer::new()?;
        let (stop, log) = (Arc::new(AtomicBool::new(false)), Arc::new(Log::default()));
        let (ended, noted) = (stop.clone(), log.clone());
        let thread = std::thread::spawn(move || serve(port, &timer, &ended, &noted));
        Ok(Self { stop, log, thread: Some(thread) })
    }

    pub fn answered(&self) -> u64 {
        self.log.answered.load(Ordering::Relaxed)
    }
}

impl Drop for Unit {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn serve(mut port: Port, timer: &Timer, stop: &AtomicBool, log: &Log) {
    // The report says so where the user may not.
    let _ = set_fifo(PRIORITY);
    let mut bytes: Vec<u8> = Vec::with_capacity(512);
    let mut some = [0; 256];
    while !stop.load(Ordering::Relaxed) {
        let wait = Timespec { tv_sec: 0, tv_nsec: 100_000_000 };
        let mut fds = [PollFd::from_borrowed_fd(port.fd(), PollFlags::IN)];
        let _ = poll(&mut fds, Some(&wait));
        match port.read(&mut some) {
            Ok(Read::Bytes(n, _)) => bytes.extend_from_slice(&some[..n]),
            Ok(Read::Nothing | Read::Nobody) => {}
            Err(_) => return,
        }
        let heard_ns = mono_ns();
        // Requests of the bench all have 8 bytes.
        while bytes.len() >= 8 {
            let Ok((unit, &[3, _, _, _, count])) = rtu::decode(&bytes[..8]) else {
                bytes.remove(0);
                continue;
            };
            let mut pdu = vec![3, count * 2];
            pdu.resize(2 + usize::from(count) * 2, 0x11);
            bytes.drain(..8);
            let mut frame = [0; rtu::MAX_ADU];
            let len = rtu::encode(unit, &pdu, &mut frame);
            // A unit knows the end of a request by the silence behind it.
            let Ok(late_ns) = timer.wait_until(heard_ns + SILENCE_NS) else { return };
            log.timer_late_ns.store(late_ns, Ordering::Release);
            log.answer_ns.store(mono_ns(), Ordering::Release);
            let mut left = &frame[..len];
            while !left.is_empty() {
                match port.write(left) {
                    Ok(n) => left = &left[n..],
                    Err(_) => return,
                }
            }
            log.answered.fetch_add(1, Ordering::Relaxed);
        }
    }
}

/// Sleeps to an absolute time. A timerfd: sleeps by call are late by the thread's timer slack, 50 us by default.
struct Timer(OwnedFd);

impl Timer {
    fn new() -> io::Result<Self> {
        Ok(Self(timerfd_create(TimerfdClockId::Monotonic, TimerfdFlags::CLOEXEC)?))
    }

    /// Sleeps until CLOCK_MONOTONIC is `at_ns`; how much later it is then.
    fn wait_until(&self, at_ns: u64) -> io::Result<u64> {
        let at = Timespec { tv_sec: (at_ns / 1_000_000_000) as i64, tv_nsec: (at_ns % 1_000_000_000) as i64 };
        let once = Itimerspec { it_interval: Timespec { tv_sec: 0, tv_nsec: 0 }, it_value: at };
        timerfd_settime(&self.0, TimerfdTimerFlags::ABSTIME, &once)?;
        rustix::io::retry_on_intr(|| rustix::io::read(&self.0, &mut [0; 8]))?;
        Ok(mono_ns().saturating_sub(at_ns))
    }
}
