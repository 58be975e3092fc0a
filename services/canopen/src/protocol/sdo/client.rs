//! One SDO client channel: one transfer at a time with one server.

use super::block::{BlockReceiver, BlockSender};
use super::channel::Channel;
use super::crc::crc16;
use super::frame::*;
use super::transfer::{Busy, By, ClientConfig, ClientCounters, Direction, Failure, Finished, Mode, Options};
use crate::protocol::abort::Abort;
use crate::protocol::io::Outbox;
use ipc_types::payload::CanFrame;

#[derive(Clone, Copy, Debug, PartialEq)]
enum State {
    Idle,
    DownInit,
    /// The segment up to `at` was sent, its answer is missing.
    Down {
        at: usize,
        toggle: u8,
        last: bool,
    },
    UpInit,
    Up {
        size: Option<usize>,
        toggle: u8,
    },
    BlockDownInit,
    BlockDown {
        sender: BlockSender,
        crc: bool,
    },
    BlockDownEnd,
    BlockUpInit,
    BlockUp {
        receiver: BlockReceiver,
        size: Option<usize>,
        crc: bool,
    },
    /// All segments are in, the server's "end" is missing. `last`: sequence number of the last segment.
    BlockUpEnd {
        size: Option<usize>,
        crc: bool,
        last: u8,
    },
}

/// What an answer led to.
enum Step {
    /// It belongs to no transfer of now.
    Stale,
    Going,
    Done,
}

/// One SDO client channel.
#[derive(Clone, Debug)]
pub struct SdoClient {
    channel: Channel,
    config: ClientConfig,
    buffer: Vec<u8>,
    mux: Mux,
    direction: Direction,
    options: Options,
    state: State,
    /// The server said that it has no block transfer.
    no_block: bool,
    /// The answer that began the present block upload.
    initiate: Bytes,
    deadline: u64,
    nudge: Option<u64>,
    pub counters: ClientCounters,
}

impl SdoClient {
    pub fn new(channel: Channel, config: ClientConfig) -> Self {
        Self {
            channel,
            config: ClientConfig { block_size: config.block_size.clamp(1, MAX_BLOCK), ..config },
            buffer: Vec::new(),
            mux: Mux::default(),
            direction: Direction::Read,
            options: Options::default(),
            state: State::Idle,
            no_block: false,
            initiate: [0; 8],
            deadline: 0,
            nudge: None,
            counters: ClientCounters::default(),
        }
    }
    pub fn channel(&self) -> Channel {
        self.channel
    }
    /// Another server from now on; a transfer that runs is dropped without a word.
    pub fn set_channel(&mut self, channel: Channel) {
        self.channel = channel;
        self.reset();
    }
    /// Other settings, from the next transfer on; its times from the next frame on.
    pub fn set_config(&mut self, config: ClientConfig) {
        self.config = ClientConfig { block_size: config.block_size.clamp(1, MAX_BLOCK), ..config };
    }
    /// Forgets the transfer without a word, and what is known of the server: it was reset or replaced.
    pub fn reset(&mut self) {
        self.state = State::Idle;
        self.nudge = None;
        self.no_block = false;
    }
    pub fn is_busy(&self) -> bool {
        self.state != State::Idle
    }
    /// What was read, until the next transfer starts.
    pub fn data(&self) -> &[u8] {
        &self.buffer
    }
    /// Bytes transferred so far, and how many there are, if that is known.
    pub fn progress(&self) -> (usize, Option<usize>) {
        match self.state {
            State::Idle | State::UpInit | State::BlockUpInit => (0, None),
            State::DownInit | State::BlockDownInit => (0, Some(self.buffer.len())),
            State::Down { at, .. } => (at.min(self.buffer.len()), Some(self.buffer.len())),
            State::BlockDown { sender, .. } => (sender.at, Some(self.buffer.len())),
            State::BlockDownEnd => (self.buffer.len(), Some(self.buffer.len())),
            State::Up { size, .. } | State::BlockUp { size, .. } | State::BlockUpEnd { size, .. } => {
                (self.buffer.len(), size)
            }
        }
    }

    /// Starts to write `data`. Grows the buffer where needed.
    pub fn start_write(
        &mut self,
        t_ns: u64,
        index: u16,
        sub: u8,
        data: &[u8],
        options: Options,
        out: &mut Outbox,
    ) -> Result<(), Busy> {
        if self.is_busy() {
            return Err(Busy::Busy);
        }
        if data.len() > self.config.max_value {
            return Err(Busy::TooLong { len: data.len(), max: self.config.max_value });
        }
        self.buffer.clear();
        self.buffer.extend_from_slice(data);
        (self.mux, self.direction, self.options) = (Mux { index, sub }, Direction::Write, options);
        let block = match options.mode {
            Mode::Auto => !self.no_block && data.len() >= self.config.auto_block.max(5),
            Mode::Segmented => false,
            Mode::Block => !self.no_block,
            Mode::BlockOnly => true,
        };
        if block {
            let command = ccs::BLOCK_DOWN << 5 | u8::from(options.crc) << 2 | 2;
            self.send(with_mux(command, self.mux, data.len() as u32), out);
            self.state = State::BlockDownInit;
        } else {
            self.download(out);
        }
        self.set_deadline(t_ns);
        Ok(())
    }
    /// Starts to read. The value will be [`data`](Self::data).
    pub fn start_read(
        &mut self,
        t_ns: u64,
        index: u16,
        sub: u8,
        options: Options,
        out: &mut Outbox,
    ) -> Result<(), Busy> {
        if self.is_busy() {
            return Err(Busy::Busy);
        }
        self.buffer.clear();
        (self.mux, self.direction, self.options) = (Mux { index, sub }, Direction::Read, options);
        let block = match options.mode {
            Mode::Auto | Mode::Segmented => false,
            Mode::Block => !self.no_block,
            Mode::BlockOnly => true,
        };
        if block {
            let mut bytes = with_mux(ccs::BLOCK_UP << 5 | u8::from(options.crc) << 2, self.mux, 0);
            (bytes[4], bytes[5]) = (self.config.block_size, options.threshold);
            self.send(bytes, out);
            self.state = State::BlockUpInit;
        } else {
            self.send(with_mux(ccs::UP << 5, self.mux, 0), out);
            self.state = State::UpInit;
        }
        self.set_deadline(t_ns);
        Ok(())
    }
    /// Aborts the transfer that runs, if any, with this code.
    pub fn cancel(&mut self, abort: Abort, out: &mut Outbox) -> Option<Finished> {
        self.is_busy().then(|| self.abort(abort, out))
    }
    /// When [`on_time`](Self::on_time) wants to be called.
    pub fn next_deadline(&self) -> Option<u64> {
        match (self.state, self.nudge) {
            (State::Idle, _) => None,
            (_, Some(nudge)) => Some(nudge.min(self.deadline)),
            (_, None) => Some(self.deadline),
        }
    }
    /// A time has come: ends a transfer whose server fell silent, or acknowledges an interrupted sub-block.
    pub fn on_time(&mut self, t_ns: u64, out: &mut Outbox) -> Option<Finished> {
        if self.state == State::Idle {
            return None;
        }
        if t_ns >= self.deadline {
            return Some(self.abort(Abort::TIMEOUT, out));
        }
        if self.nudge.is_some_and(|nudge| t_ns >= nudge) {
            self.nudge = None;
            if let State::BlockUp { receiver, .. } = &mut self.state {
                let (seq, size) = (receiver.next(), receiver.size);
                self.acknowledge(seq, size, out);
            }
        }
        None
    }
    /// A frame came. Frames of others, and answers to what was given up, are passed over.
    pub fn on_frame(&mut self, t_ns: u64, frame: &CanFrame, out: &mut Outbox) -> Option<Finished> {
        let bytes = match receive(frame, self.channel.response)? {
            Ok(bytes) => bytes,
            Err(()) => {
                self.counters.ignored += 1;
                return None;
            }
        };
        if self.state == State::Idle {
            self.counters.stale += 1;
            return None;
        }
        if bytes[0] == ABORT {
            return self.aborted(t_ns, &bytes, out);
        }
        match self.step(&bytes, out) {
            Ok(Step::Stale) => {
                self.counters.stale += 1;
                None
            }
            Ok(Step::Going) => {
                self.set_deadline(t_ns);
                None
            }
            Ok(Step::Done) => Some(self.end(Ok(self.buffer.len()))),
            Err(abort) => Some(self.abort(abort, out)),
        }
    }

    fn set_deadline(&mut self, t_ns: u64) {
        let segments = match self.state {
            State::BlockDown { sender, .. } => sender.sent,
            State::BlockUp { receiver, .. } => receiver.size,
            _ => 0,
        };
        let wait = self.config.timeout_ns.saturating_add(u64::from(segments) * self.config.frame_ns);
        self.deadline = t_ns.saturating_add(wait);
        self.nudge = match self.state {
            State::BlockUp { receiver, .. } if receiver.seen => {
                Some(t_ns.saturating_add(self.config.timeout_ns / 2))
            }
            _ => None,
        };
    }
    fn send(&self, bytes: Bytes, out: &mut Outbox) {
        send(out, self.channel.request, bytes);
    }
    fn acknowledge(&self, seq: u8, size: u8, out: &mut Outbox) {
        let command = ccs::BLOCK_UP << 5 | BLOCK_ACK;
        self.send([command, seq, size, 0, 0, 0, 0, 0], out);
    }
    fn end(&mut self, result: Result<usize, Failure>) -> Finished {
        self.state = State::Idle;
        self.nudge = None;
        Finished { index: self.mux.index, sub: self.mux.sub, direction: self.direction, result }
    }
    fn abort(&mut self, abort: Abort, out: &mut Outbox) -> Finished {
        self.send(abort_frame(self.mux, abort), out);
        self.end(Err(Failure { abort, by: By::Client }))
    }

    /// The server aborts. Of another object: a late answer to a transfer of before, unless we just asked for a
    /// block transfer that the server does not know (such servers fill in any object).
    fn aborted(&mut self, t_ns: u64, bytes: &Bytes, out: &mut Outbox) -> Option<Finished> {
        let abort = Abort(value_of(bytes));
        let asked_block = matches!(self.state, State::BlockDownInit | State::BlockUpInit);
        if Mux::of(bytes) != self.mux && !(asked_block && abort == Abort::COMMAND) {
            self.counters.stale += 1;
            return None;
        }
        let unknown = matches!(abort, Abort::COMMAND | Abort::UNSUPPORTED_ACCESS | Abort::GENERAL);
        if asked_block && unknown && self.options.mode != Mode::BlockOnly {
            self.counters.fallbacks += 1;
            self.no_block = true;
            if self.direction == Direction::Write {
                self.download(out);
            } else {
                self.send(with_mux(ccs::UP << 5, self.mux, 0), out);
                self.state = State::UpInit;
            }
            self.set_deadline(t_ns);
            return None;
        }
        Some(self.end(Err(Failure { abort, by: By::Server })))
    }

    /// Initiates an expedited or segmented download.
    fn download(&mut self, out: &mut Outbox) {
        let bytes = if (1..=4).contains(&self.buffer.len()) {
            expedited(ccs::DOWN, self.mux, &self.buffer)
        } else {
            with_mux(ccs::DOWN << 5 | 1, self.mux, self.buffer.len() as u32)
        };
        self.send(bytes, out);
        self.state = State::DownInit;
    }
    fn download_segment(&mut self, at: usize, toggle: u8, out: &mut Outbox) {
        let (bytes, last) = segment(ccs::DOWN_SEGMENT << 5 | toggle, &self.buffer, at);
        self.send(bytes, out);
        self.state = State::Down { at: at + SEGMENT, toggle, last };
    }

    fn step(&mut self, bytes: &Bytes, out: &mut Outbox) -> Result<Step, Abort> {
        let command = bytes[0] >> 5;
        match self.state {
            State::Idle => Ok(Step::Stale),
            State::DownInit | State::UpInit | State::BlockDownInit | State::BlockUpInit => {
                self.initiated(bytes, command, out)
            }
            State::BlockUp { receiver, size, crc } => self.block_segment(bytes, receiver, size, crc, out),
            _ if self.is_initiate(bytes, command) => Ok(Step::Stale),
            State::Down { at, toggle, last } if command == scs::DOWN_SEGMENT => {
                if bytes[0] & 0x10 != toggle {
                    return Err(Abort::TOGGLE);
                }
                if last {
                    return Ok(Step::Done);
                }
                self.download_segment(at, toggle ^ 0x10, out);
                Ok(Step::Going)
            }
            State::Up { size, toggle } if command == scs::UP_SEGMENT => {
                self.upload_segment(bytes, size, toggle, out)
            }
            State::BlockDown { sender, crc } if command == scs::BLOCK_DOWN && bytes[0] & 3 == BLOCK_ACK => {
                self.block_acknowledged(bytes, sender, crc, out)
            }
            State::BlockDownEnd if command == scs::BLOCK_DOWN => match bytes[0] & 3 {
                BLOCK_END => Ok(Step::Done),
                BLOCK_ACK => Ok(Step::Stale),
                _ => Err(Abort::COMMAND),
            },
            State::BlockUpEnd { size, crc, last } => self.block_end(bytes, size, crc, last, out),
            _ => Err(Abort::COMMAND),
        }
    }
    /// The answer that began this transfer, once more.
    fn is_initiate(&self, bytes: &Bytes, command: u8) -> bool {
        let initiates = match self.state {
            State::Down { .. } => command == scs::DOWN,
            State::Up { .. } => command == scs::UP,
            State::BlockDown { .. } => command == scs::BLOCK_DOWN && bytes[0] & 3 == BLOCK_INIT,
            State::BlockUpEnd { .. } => command == scs::BLOCK_UP && bytes[0] & 1 == BLOCK_INIT,
            _ => false,
        };
        initiates && Mux::of(bytes) == self.mux
    }

    /// The first answer of a transfer.
    fn initiated(&mut self, bytes: &Bytes, command: u8, out: &mut Outbox) -> Result<Step, Abort> {
        let initiates = match command {
            scs::UP | scs::DOWN => true,
            scs::BLOCK_DOWN => bytes[0] & 3 == BLOCK_INIT,
            scs::BLOCK_UP => bytes[0] & 1 == BLOCK_INIT,
            scs::UP_SEGMENT | scs::DOWN_SEGMENT => return Ok(Step::Stale),
            _ => return Err(Abort::COMMAND),
        };
        if !initiates || Mux::of(bytes) != self.mux {
            return Ok(Step::Stale);
        }
        match (self.state, command) {
            (State::DownInit, scs::DOWN) => {
                if (1..=4).contains(&self.buffer.len()) {
                    return Ok(Step::Done);
                }
                self.download_segment(0, 0, out);
                Ok(Step::Going)
            }
            (State::UpInit | State::BlockUpInit, scs::UP) => self.upload_initiated(bytes, out),
            (State::BlockDownInit, scs::BLOCK_DOWN) => {
                let mut sender = BlockSender::new(bytes[4])?;
                sender.send(&self.buffer, self.channel.request, out);
                let crc = self.options.crc && bytes[0] & 4 != 0;
                self.state = State::BlockDown { sender, crc };
                Ok(Step::Going)
            }
            (State::BlockUpInit, scs::BLOCK_UP) => {
                let size = (bytes[0] & 2 != 0).then(|| value_of(bytes) as usize);
                self.make_room(size)?;
                self.initiate = *bytes;
                let receiver = BlockReceiver::new(self.config.block_size);
                let crc = self.options.crc && bytes[0] & 4 != 0;
                self.state = State::BlockUp { receiver, size, crc };
                self.send([ccs::BLOCK_UP << 5 | BLOCK_START, 0, 0, 0, 0, 0, 0, 0], out);
                Ok(Step::Going)
            }
            _ => Err(Abort::COMMAND),
        }
    }
    /// Room for what the server announces; [`Abort::MEMORY`] above the limit. Without a size the buffer grows as
    /// data comes.
    fn make_room(&mut self, size: Option<usize>) -> Result<(), Abort> {
        let wanted = size.unwrap_or(0);
        if wanted > self.config.max_value {
            return Err(Abort::MEMORY);
        }
        self.buffer.clear();
        self.buffer.reserve(wanted + SEGMENT);
        Ok(())
    }

    fn upload_initiated(&mut self, bytes: &Bytes, out: &mut Outbox) -> Result<Step, Abort> {
        let (expedited, sized) = (bytes[0] & 2 != 0, bytes[0] & 1 != 0);
        if expedited {
            let len = if sized { 4 - usize::from((bytes[0] >> 2) & 3) } else { 4 };
            self.buffer.clear();
            self.buffer.extend_from_slice(&bytes[4..4 + len]);
            return Ok(Step::Done);
        }
        let size = sized.then(|| value_of(bytes) as usize);
        self.make_room(size)?;
        self.state = State::Up { size, toggle: 0 };
        self.send([ccs::UP_SEGMENT << 5, 0, 0, 0, 0, 0, 0, 0], out);
        Ok(Step::Going)
    }
    fn upload_segment(
        &mut self,
        bytes: &Bytes,
        size: Option<usize>,
        toggle: u8,
        out: &mut Outbox,
    ) -> Result<Step, Abort> {
        if bytes[0] & 0x10 != toggle {
            return Err(Abort::TOGGLE);
        }
        let (data, last) = segment_data(bytes);
        let len = self.buffer.len() + data.len();
        if size.is_some_and(|size| len > size) {
            return Err(Abort::TOO_LONG);
        }
        if len > self.config.max_value {
            return Err(Abort::MEMORY);
        }
        self.buffer.extend_from_slice(data);
        if last {
            return self.complete(size);
        }
        let toggle = toggle ^ 0x10;
        self.state = State::Up { size, toggle };
        self.send([ccs::UP_SEGMENT << 5 | toggle, 0, 0, 0, 0, 0, 0, 0], out);
        Ok(Step::Going)
    }
    fn complete(&self, size: Option<usize>) -> Result<Step, Abort> {
        match size {
            Some(size) if self.buffer.len() < size => Err(Abort::TOO_SHORT),
            Some(size) if self.buffer.len() > size => Err(Abort::TOO_LONG),
            _ => Ok(Step::Done),
        }
    }

    fn block_acknowledged(
        &mut self,
        bytes: &Bytes,
        mut sender: BlockSender,
        crc: bool,
        out: &mut Outbox,
    ) -> Result<Step, Abort> {
        if sender.acknowledge(bytes[1], bytes[2], self.buffer.len())? {
            let sum = if crc { crc16(&self.buffer) } else { 0 };
            let [low, high] = sum.to_le_bytes();
            let unused = BlockSender::unused(self.buffer.len());
            self.send([ccs::BLOCK_DOWN << 5 | unused << 2 | BLOCK_END, low, high, 0, 0, 0, 0, 0], out);
            self.state = State::BlockDownEnd;
        } else {
            sender.send(&self.buffer, self.channel.request, out);
            self.state = State::BlockDown { sender, crc };
        }
        Ok(Step::Going)
    }
    fn block_segment(
        &mut self,
        bytes: &Bytes,
        mut receiver: BlockReceiver,
        size: Option<usize>,
        crc: bool,
        out: &mut Outbox,
    ) -> Result<Step, Abort> {
        use super::block::Step as Block;
        if self.buffer.is_empty() && *bytes == self.initiate {
            return Ok(Step::Stale);
        }
        let limit = size.unwrap_or(self.config.max_value);
        let over = if size.is_some() { Abort::TOO_LONG } else { Abort::MEMORY };
        let step = receiver.segment(bytes, &mut self.buffer, limit).unwrap_or(Err(over))?;
        self.state = State::BlockUp { receiver, size, crc };
        match step {
            Block::Wait => {}
            Block::Acknowledge(seq) => self.acknowledge(seq, receiver.size, out),
            Block::Complete(seq) => {
                self.acknowledge(seq, receiver.size, out);
                self.state = State::BlockUpEnd { size, crc, last: receiver.last() };
            }
        }
        Ok(Step::Going)
    }
    fn block_end(
        &mut self,
        bytes: &Bytes,
        size: Option<usize>,
        crc: bool,
        last: u8,
        out: &mut Outbox,
    ) -> Result<Step, Abort> {
        if bytes[0] & 0xE3 != scs::BLOCK_UP << 5 | BLOCK_END {
            let repeated = bytes[0] == last | 0x80;
            return if repeated { Ok(Step::Stale) } else { Err(Abort::COMMAND) };
        }
        let unused = usize::from((bytes[0] >> 2) & 7);
        self.buffer.truncate(self.buffer.len().saturating_sub(unused));
        if crc && crc16(&self.buffer) != u16::from_le_bytes([bytes[1], bytes[2]]) {
            return Err(Abort::CRC);
        }
        let step = self.complete(size)?;
        self.send([ccs::BLOCK_UP << 5 | BLOCK_END, 0, 0, 0, 0, 0, 0, 0], out);
        Ok(step)
    }
}
