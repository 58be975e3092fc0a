//! One SDO server channel: serves reads and writes of one client against the object dictionary.

use super::block::{BlockReceiver, BlockSender, Step, check_size};
use super::channel::Channel;
use super::frame::*;
use super::{crc::crc16, frame};
use crate::protocol::abort::Abort;
use crate::protocol::io::Outbox;
use crate::protocol::od::{EntryRef, Hooks, ObjectDictionary};
use ipc_types::payload::CanFrame;

/// How a server behaves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ServerConfig {
    /// Silence of the client in ns after which the transfer is aborted with 0504 0000h.
    pub timeout_ns: u64,
    /// Segments of a sub-block that the server takes in a block download, 1-127.
    pub block_size: u8,
    /// Time of one frame on the bus in ns; added to the timeout for each segment of a sub-block. 0: unknown.
    pub frame_ns: u64,
    /// Longest value that is transferred, in bytes. The buffer has the length of the dictionary's longest
    /// value, but no more than this.
    pub max_value: usize,
}

impl Default for ServerConfig {
    fn default() -> Self {
        Self { timeout_ns: 1_000_000_000, block_size: MAX_BLOCK, frame_ns: 0, max_value: 1 << 20 }
    }
}

/// What a server has seen.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ServerCounters {
    /// Transfers that ended well.
    pub finished: u64,
    /// Transfers that the server aborted.
    pub aborted: u64,
    /// Transfers that the client aborted or left for another one.
    pub abandoned: u64,
    /// Frames that are no SDO frames: not 8 bytes long.
    pub ignored: u64,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum State {
    Idle,
    /// Segmented download; bytes the client announced.
    Download {
        size: Option<usize>,
        toggle: u8,
    },
    /// Segmented upload; bytes sent.
    Upload {
        at: usize,
        toggle: u8,
    },
    BlockDownload {
        receiver: BlockReceiver,
        size: Option<usize>,
        crc: bool,
    },
    /// All segments are in, the client's "end" is missing. `last`: sequence number of the last segment.
    BlockDownloadEnd {
        size: Option<usize>,
        crc: bool,
        last: u8,
    },
    /// The client's "start" is missing.
    BlockUploadStart {
        sender: BlockSender,
        crc: bool,
    },
    BlockUpload {
        sender: BlockSender,
        crc: bool,
    },
    /// The client's answer to our "end" is missing.
    BlockUploadEnd,
}

/// One SDO server channel.
#[derive(Clone, Debug)]
pub struct SdoServer {
    channel: Channel,
    config: ServerConfig,
    buffer: Vec<u8>,
    limit: usize,
    /// Most bytes of the present download: what was announced, else what object and buffer hold.
    room: usize,
    /// First frame of the present block download.
    initiate: Bytes,
    mux: Mux,
    state: State,
    deadline: u64,
    /// When an interrupted sub-block is acknowledged as far as it came.
    nudge: Option<u64>,
    pub counters: ServerCounters,
}

impl SdoServer {
    /// A server for `channel` with a buffer for the dictionary's longest value.
    pub fn new(channel: Channel, config: ServerConfig, od: &ObjectDictionary) -> Self {
        let limit = od.largest().min(config.max_value).max(8);
        Self {
            channel,
            config: ServerConfig { block_size: config.block_size.clamp(1, MAX_BLOCK), ..config },
            buffer: Vec::with_capacity(limit + SEGMENT),
            limit,
            room: 0,
            initiate: [0; 8],
            mux: Mux::default(),
            state: State::Idle,
            deadline: 0,
            nudge: None,
            counters: ServerCounters::default(),
        }
    }
    pub fn channel(&self) -> Channel {
        self.channel
    }
    /// Other identifiers from now on; a transfer that runs is dropped.
    pub fn set_channel(&mut self, channel: Channel) {
        if self.channel != channel {
            self.reset();
            self.channel = channel;
        }
    }
    /// Drops the transfer without a word: the node was reset or stopped.
    pub fn reset(&mut self) {
        self.state = State::Idle;
        self.nudge = None;
    }
    /// A transfer of several frames is going on.
    pub fn is_busy(&self) -> bool {
        self.state != State::Idle
    }
    /// When [`on_time`](Self::on_time) wants to be called.
    pub fn next_deadline(&self) -> Option<u64> {
        match (self.state, self.nudge) {
            (State::Idle, _) => None,
            (_, Some(nudge)) => Some(nudge.min(self.deadline)),
            (_, None) => Some(self.deadline),
        }
    }
    /// A time has come: aborts a transfer whose client fell silent, or acknowledges an interrupted sub-block.
    pub fn on_time(&mut self, t_ns: u64, out: &mut Outbox) {
        if self.state == State::Idle {
            return;
        }
        if t_ns >= self.deadline {
            self.abort(Abort::TIMEOUT, out);
        } else if self.nudge.is_some_and(|nudge| t_ns >= nudge) {
            self.nudge = None;
            if let State::BlockDownload { receiver, .. } = &mut self.state {
                let (seq, size) = (receiver.next(), receiver.size);
                self.acknowledge(seq, size, out);
            }
        }
    }
    /// A frame came; `false` if it is none of this channel's.
    pub fn on_frame(
        &mut self,
        t_ns: u64,
        frame: &CanFrame,
        od: &mut ObjectDictionary,
        hooks: &mut dyn Hooks,
        out: &mut Outbox,
    ) -> bool {
        let bytes = match frame::receive(frame, self.channel.request) {
            None => return false,
            Some(Err(())) => {
                self.counters.ignored += 1;
                return true;
            }
            Some(Ok(bytes)) => bytes,
        };
        if let Err(abort) = self.step(&bytes, od, hooks, out) {
            self.abort(abort, out);
        }
        self.set_deadline(t_ns);
        true
    }

    fn set_deadline(&mut self, t_ns: u64) {
        let segments = match self.state {
            State::BlockUpload { sender, .. } => sender.sent,
            State::BlockDownload { receiver, .. } => receiver.size,
            _ => 0,
        };
        let wait = self.config.timeout_ns.saturating_add(u64::from(segments) * self.config.frame_ns);
        self.deadline = t_ns.saturating_add(wait);
        self.nudge = match self.state {
            State::BlockDownload { receiver, .. } if receiver.seen => {
                Some(t_ns.saturating_add(self.config.timeout_ns / 2))
            }
            _ => None,
        };
    }
    fn send(&self, bytes: Bytes, out: &mut Outbox) {
        send(out, self.channel.response, bytes);
    }
    fn acknowledge(&self, seq: u8, size: u8, out: &mut Outbox) {
        self.send([scs::BLOCK_DOWN << 5 | BLOCK_ACK, seq, size, 0, 0, 0, 0, 0], out);
    }
    fn abort(&mut self, abort: Abort, out: &mut Outbox) {
        self.send(abort_frame(self.mux, abort), out);
        self.counters.aborted += 1;
        self.reset();
    }
    fn finish(&mut self) {
        self.counters.finished += 1;
        self.reset();
    }

    fn step(
        &mut self,
        bytes: &Bytes,
        od: &mut ObjectDictionary,
        hooks: &mut dyn Hooks,
        out: &mut Outbox,
    ) -> Result<(), Abort> {
        if bytes[0] == ABORT {
            self.counters.abandoned += u64::from(self.is_busy());
            self.reset();
            return Ok(());
        }
        if let State::BlockDownload { receiver, size, crc } = self.state {
            return self.block_segment(bytes, receiver, size, crc, out);
        }
        if let State::BlockDownloadEnd { last, .. } = self.state
            && bytes[0] == last | 0x80
            && bytes[0] & 0xE3 != ccs::BLOCK_DOWN << 5 | BLOCK_END
        {
            return Ok(()); // the last segment, repeated by the bus
        }
        let command = bytes[0] >> 5;
        let initiates = match command {
            ccs::DOWN | ccs::UP => true,
            ccs::BLOCK_UP => bytes[0] & 3 == BLOCK_INIT,
            ccs::BLOCK_DOWN => bytes[0] & 1 == BLOCK_INIT,
            _ => false,
        };
        if initiates {
            // A client that starts anew has given up the transfer before.
            self.counters.abandoned += u64::from(self.is_busy());
            self.reset();
            self.mux = Mux::of(bytes);
            return match command {
                ccs::DOWN => self.download(bytes, od, hooks, out),
                ccs::UP => self.upload(od, hooks, out),
                ccs::BLOCK_DOWN => self.block_download(bytes, od, out),
                _ => self.block_upload(bytes, od, hooks, out),
            };
        }
        match (command, self.state) {
            (ccs::DOWN_SEGMENT, State::Download { size, toggle }) => {
                self.download_segment(bytes, size, toggle, od, hooks, out)
            }
            (ccs::UP_SEGMENT, State::Upload { at, toggle }) => self.upload_segment(bytes, at, toggle, out),
            (ccs::BLOCK_DOWN, State::BlockDownloadEnd { size, crc, .. }) => {
                self.block_download_end(bytes, size, crc, od, hooks, out)
            }
            (ccs::BLOCK_UP, _) => self.block_upload_step(bytes, out),
            _ => {
                if self.state == State::Idle && command > ccs::UP_SEGMENT {
                    self.mux = Mux::of(bytes);
                }
                Err(Abort::COMMAND)
            }
        }
    }

    /// The sub-object of a download: it exists and may be written.
    fn target(&self, od: &ObjectDictionary) -> Result<EntryRef, Abort> {
        let entry = od.find(self.mux.index, self.mux.sub)?;
        od.check_access(entry)?;
        Ok(entry)
    }
    /// What a download of several frames announces is checked before its first data: size, and room for it.
    fn announce(&mut self, od: &ObjectDictionary, size: Option<usize>) -> Result<(), Abort> {
        let entry = self.target(od)?;
        if let Some(size) = size {
            od.check_length(entry, size)?;
            if size > self.limit {
                return Err(Abort::MEMORY);
            }
        }
        let capacity = od.entry(entry).map_or(0, |entry| entry.capacity as usize);
        self.room = size.unwrap_or(capacity.min(self.limit));
        self.buffer.clear();
        Ok(())
    }

    fn download(
        &mut self,
        bytes: &Bytes,
        od: &mut ObjectDictionary,
        hooks: &mut dyn Hooks,
        out: &mut Outbox,
    ) -> Result<(), Abort> {
        let (expedited, sized) = (bytes[0] & 2 != 0, bytes[0] & 1 != 0);
        if expedited {
            let len = if sized {
                4 - usize::from((bytes[0] >> 2) & 3)
            } else {
                // No length given: the object's own, if it is fixed and short enough.
                let entry = self.target(od)?;
                let entry = od.entry(entry).ok_or(Abort::INTERNAL)?;
                entry.data_type.size().map_or(4, |size| size.min(4))
            };
            od.write_hooked(hooks, self.mux.index, self.mux.sub, &bytes[4..4 + len])?;
            self.send(with_mux(scs::DOWN << 5, self.mux, 0), out);
            self.finish();
            return Ok(());
        }
        let size = sized.then(|| value_of(bytes) as usize);
        self.announce(od, size)?;
        self.state = State::Download { size, toggle: 0 };
        self.send(with_mux(scs::DOWN << 5, self.mux, 0), out);
        Ok(())
    }

    fn download_segment(
        &mut self,
        bytes: &Bytes,
        size: Option<usize>,
        toggle: u8,
        od: &mut ObjectDictionary,
        hooks: &mut dyn Hooks,
        out: &mut Outbox,
    ) -> Result<(), Abort> {
        if bytes[0] & 0x10 != toggle {
            return Err(Abort::TOGGLE);
        }
        let (data, last) = segment_data(bytes);
        if self.buffer.len() + data.len() > self.room {
            return Err(Abort::TOO_LONG);
        }
        self.buffer.extend_from_slice(data);
        if last {
            self.commit(size, od, hooks)?;
            self.finish();
        } else {
            self.state = State::Download { size, toggle: toggle ^ 0x10 };
        }
        self.send([scs::DOWN_SEGMENT << 5 | toggle, 0, 0, 0, 0, 0, 0, 0], out);
        Ok(())
    }

    /// Writes the buffer to the object.
    fn commit(
        &mut self,
        size: Option<usize>,
        od: &mut ObjectDictionary,
        hooks: &mut dyn Hooks,
    ) -> Result<(), Abort> {
        match size {
            Some(size) if self.buffer.len() > size => Err(Abort::TOO_LONG),
            Some(size) if self.buffer.len() < size => Err(Abort::TOO_SHORT),
            _ => od.write_hooked(hooks, self.mux.index, self.mux.sub, &self.buffer),
        }
    }

    /// Copies the object's value into the buffer, so that a long upload is of one moment.
    fn fetch(&mut self, od: &mut ObjectDictionary, hooks: &mut dyn Hooks) -> Result<(), Abort> {
        let data = od.read_hooked(hooks, self.mux.index, self.mux.sub)?;
        if data.len() > self.limit {
            return Err(Abort::MEMORY);
        }
        self.buffer.clear();
        self.buffer.extend_from_slice(data);
        Ok(())
    }

    fn upload(
        &mut self,
        od: &mut ObjectDictionary,
        hooks: &mut dyn Hooks,
        out: &mut Outbox,
    ) -> Result<(), Abort> {
        self.fetch(od, hooks)?;
        self.upload_answer(out);
        Ok(())
    }
    fn upload_answer(&mut self, out: &mut Outbox) {
        if (1..=4).contains(&self.buffer.len()) {
            self.send(expedited(scs::UP, self.mux, &self.buffer), out);
            self.finish();
        } else {
            self.send(with_mux(scs::UP << 5 | 1, self.mux, self.buffer.len() as u32), out);
            self.state = State::Upload { at: 0, toggle: 0 };
        }
    }
    fn upload_segment(
        &mut self,
        bytes: &Bytes,
        at: usize,
        toggle: u8,
        out: &mut Outbox,
    ) -> Result<(), Abort> {
        if bytes[0] & 0x10 != toggle {
            return Err(Abort::TOGGLE);
        }
        let (answer, last) = segment(scs::UP_SEGMENT << 5 | toggle, &self.buffer, at);
        self.send(answer, out);
        if last {
            self.finish();
        } else {
            self.state = State::Upload { at: at + SEGMENT, toggle: toggle ^ 0x10 };
        }
        Ok(())
    }

    fn block_download(
        &mut self,
        bytes: &Bytes,
        od: &mut ObjectDictionary,
        out: &mut Outbox,
    ) -> Result<(), Abort> {
        let size = (bytes[0] & 2 != 0).then(|| value_of(bytes) as usize);
        self.announce(od, size)?;
        let receiver = BlockReceiver::new(self.config.block_size);
        self.initiate = *bytes;
        self.state = State::BlockDownload { receiver, size, crc: bytes[0] & 4 != 0 };
        let answer = with_mux(scs::BLOCK_DOWN << 5 | 4, self.mux, u32::from(self.config.block_size));
        self.send(answer, out);
        Ok(())
    }
    fn block_segment(
        &mut self,
        bytes: &Bytes,
        mut receiver: BlockReceiver,
        size: Option<usize>,
        crc: bool,
        out: &mut Outbox,
    ) -> Result<(), Abort> {
        if self.buffer.is_empty() && *bytes == self.initiate {
            return Ok(()); // the initiate, repeated by the bus
        }
        let step = receiver.segment(bytes, &mut self.buffer, self.room).unwrap_or(Err(Abort::TOO_LONG))?;
        self.state = State::BlockDownload { receiver, size, crc };
        match step {
            Step::Wait => {}
            Step::Acknowledge(seq) => self.acknowledge(seq, receiver.size, out),
            Step::Complete(seq) => {
                self.state = State::BlockDownloadEnd { size, crc, last: receiver.last() };
                self.acknowledge(seq, receiver.size, out);
            }
        }
        Ok(())
    }
    fn block_download_end(
        &mut self,
        bytes: &Bytes,
        size: Option<usize>,
        crc: bool,
        od: &mut ObjectDictionary,
        hooks: &mut dyn Hooks,
        out: &mut Outbox,
    ) -> Result<(), Abort> {
        let unused = usize::from((bytes[0] >> 2) & 7);
        self.buffer.truncate(self.buffer.len().saturating_sub(unused));
        if crc && crc16(&self.buffer) != u16::from_le_bytes([bytes[1], bytes[2]]) {
            return Err(Abort::CRC);
        }
        self.commit(size, od, hooks)?;
        self.send([scs::BLOCK_DOWN << 5 | BLOCK_END, 0, 0, 0, 0, 0, 0, 0], out);
        self.finish();
        Ok(())
    }

    fn block_upload(
        &mut self,
        bytes: &Bytes,
        od: &mut ObjectDictionary,
        hooks: &mut dyn Hooks,
        out: &mut Outbox,
    ) -> Result<(), Abort> {
        let (size, threshold) = (bytes[4], usize::from(bytes[5]));
        check_size(size)?;
        self.fetch(od, hooks)?;
        if threshold != 0 && self.buffer.len() <= threshold {
            // Short enough for the client to want the upload protocol instead (7.2.4.3.12, pst).
            self.upload_answer(out);
            return Ok(());
        }
        self.state = State::BlockUploadStart { sender: BlockSender::new(size)?, crc: bytes[0] & 4 != 0 };
        self.send(with_mux(scs::BLOCK_UP << 5 | 4 | 2, self.mux, self.buffer.len() as u32), out);
        Ok(())
    }
    fn block_upload_step(&mut self, bytes: &Bytes, out: &mut Outbox) -> Result<(), Abort> {
        match (bytes[0] & 3, self.state) {
            (BLOCK_START, State::BlockUploadStart { mut sender, crc }) => {
                sender.send(&self.buffer, self.channel.response, out);
                self.state = State::BlockUpload { sender, crc };
                Ok(())
            }
            (BLOCK_ACK, State::BlockUpload { mut sender, crc }) => {
                if sender.acknowledge(bytes[1], bytes[2], self.buffer.len())? {
                    let unused = BlockSender::unused(self.buffer.len());
                    let sum = if crc { crc16(&self.buffer) } else { 0 };
                    let [low, high] = sum.to_le_bytes();
                    let command = scs::BLOCK_UP << 5 | unused << 2 | BLOCK_END;
                    self.send([command, low, high, 0, 0, 0, 0, 0], out);
                    self.state = State::BlockUploadEnd;
                } else {
                    sender.send(&self.buffer, self.channel.response, out);
                    self.state = State::BlockUpload { sender, crc };
                }
                Ok(())
            }
            (BLOCK_END, State::BlockUploadEnd) => {
                self.finish();
                Ok(())
            }
            // Repeated by the bus.
            (BLOCK_START, State::BlockUpload { sender, .. }) if sender.at == 0 => Ok(()),
            (BLOCK_END, State::Idle) => Ok(()),
            _ => Err(Abort::COMMAND),
        }
    }
}
