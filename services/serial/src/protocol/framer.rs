//! Finds frames in received bytes.
//!
//! Every byte that comes in goes out in a chunk, frame or not, so that a recording has the whole line; the exceptions
//! are counted: what is beyond the longest frame, and frames that `strict_t15` rejects.

use ipc_types::payload::{CHUNK_BYTES, serial_flag};
use serde::Serialize;

use super::answer::Expected;
use super::length::{self, MAX_RTU};
use super::rtu::{self, MAX_MARKS};
use super::timing::Timing;

/// Longest ASCII frame: ':' , 2 x (1 + 253 + 1 bytes), CR LF (V1.02, 2.5.2.1).
pub const MAX_ASCII: usize = 513;
/// Longest delimiter.
pub const MAX_DELIMITER: usize = 8;

/// How frames are told apart.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mode {
    /// Silence, and the CRC.
    Rtu {
        /// A gap of more than 1.5 characters inside a frame rejects it.
        strict_t15: bool,
        /// How long after the last byte more is waited for when what is there is only the beginning of a frame, ns.
        grace_ns: u64,
    },
    /// ':' to the byte behind CR: LF, or the delimiter that a master has set at run time (function 8, sub-function 03).
    Ascii,
    /// Up to these bytes.
    Delimiter {
        /// The last bytes of a frame, in the low bytes.
        pattern: u64,
        /// How many, 1 to 8.
        len: u8,
    },
    /// So many bytes.
    Length(usize),
    /// Silence.
    Silence,
    /// No frames: what is read together is handed over together.
    Raw,
}

impl Mode {
    /// A delimiter; `None` when it is empty or too long.
    pub fn delimiter(bytes: &[u8]) -> Option<Self> {
        if bytes.is_empty() || bytes.len() > MAX_DELIMITER {
            return None;
        }
        let pattern = bytes.iter().fold(0, |all, byte| all << 8 | u64::from(*byte));
        Some(Self::Delimiter { pattern, len: bytes.len() as u8 })
    }
}

/// How a [`Framer`] works.
#[derive(Debug, Clone, Copy)]
pub struct Settings {
    /// What ends a frame.
    pub mode: Mode,
    /// Times of the line.
    pub timing: Timing,
    /// Modes rtu and silence: silence that ends a frame, ns.
    pub silence_ns: u64,
    /// Modes ascii, delimiter and length: a frame that stops for so long is handed over unfinished, ns.
    pub timeout_ns: u64,
    /// Longest frame; what is beyond is cut.
    pub max_frame: usize,
    /// Bytes come at the line's pace (a UART, or a paced terminal), so that the time of a read says when its bytes
    /// were on the line.
    pub timed: bool,
}

/// What a [`Framer`] counted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct FrameCounters {
    /// Bytes received.
    pub bytes: u64,
    /// Frames that are whole; of RTU those whose CRC fits.
    pub frames: u64,
    /// RTU: pieces of at least 4 bytes whose CRC does not fit.
    pub crc_errors: u64,
    /// Pieces that are no frame: shorter than any, before a ':', broken off, or stopped too long.
    pub fragments: u64,
    /// Silences of more than 1.5 characters inside a frame.
    pub t15_gaps: u64,
    /// Frames rejected for such a silence (`strict_t15`).
    pub rejected_t15: u64,
    /// Frames that went on after a silence that should have ended them (`grace`).
    pub late: u64,
    /// Frames longer than the longest.
    pub too_long: u64,
    /// Bytes cut from them.
    pub bytes_cut: u64,
}

/// A frame or a part of one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Chunk<'a> {
    /// When its first byte began, as far as it is known.
    pub first_ns: u64,
    /// When its end was known.
    pub end_ns: u64,
    /// [`serial_flag`]s.
    pub flags: u32,
    /// At most [`CHUNK_BYTES`].
    pub bytes: &'a [u8],
}

/// Where chunks go.
pub type Out<'a> = dyn FnMut(Chunk<'_>) + 'a;

/// See the module.
#[derive(Debug)]
pub struct Framer {
    settings: Settings,
    buffer: Box<[u8; CHUNK_BYTES]>,
    len: usize,
    /// Bytes of the frame that were handed over already.
    passed: usize,
    /// What comes belongs to a frame that was cut.
    skipping: bool,
    /// The last bytes of the frame, for delimiters.
    window: u64,
    first_ns: u64,
    /// When the byte that is being looked at began.
    byte_ns: u64,
    last_ns: Option<u64>,
    flags: u32,
    marks: [u16; MAX_MARKS],
    mark_count: usize,
    /// The silence is over, and more is waited for.
    in_grace: bool,
    /// The answer that ends without a silence.
    expected: Option<Expected>,
    counters: FrameCounters,
}

impl Framer {
    /// A line on which nothing was received yet.
    pub fn new(settings: Settings) -> Self {
        Self {
            settings,
            buffer: Box::new([0; CHUNK_BYTES]),
            len: 0,
            passed: 0,
            skipping: false,
            window: 0,
            first_ns: 0,
            byte_ns: 0,
            last_ns: None,
            flags: 0,
            marks: [0; MAX_MARKS],
            mark_count: 0,
            in_grace: false,
            expected: None,
            counters: FrameCounters::default(),
        }
    }

    /// What was counted so far.
    pub fn counters(&self) -> FrameCounters {
        self.counters
    }

    /// When the last byte was received.
    pub fn last_ns(&self) -> Option<u64> {
        self.last_ns
    }

    /// Whether a frame has begun and not ended.
    pub fn is_receiving(&self) -> bool {
        self.len > 0 || self.passed > 0 || self.skipping
    }

    /// When [`Self::turn`] must be called, if nothing is received before.
    pub fn deadline(&self) -> Option<u64> {
        if !self.is_receiving() {
            return None;
        }
        let wait = match self.settings.mode {
            Mode::Rtu { grace_ns, .. } if self.in_grace => self.settings.silence_ns.max(grace_ns),
            Mode::Rtu { .. } | Mode::Silence => self.settings.silence_ns,
            Mode::Ascii | Mode::Delimiter { .. } | Mode::Length(_) => self.settings.timeout_ns,
            Mode::Raw => return None,
        };
        Some(self.last_ns.unwrap_or(0).saturating_add(wait))
    }

    /// The line was silent up to now.
    pub fn turn(&mut self, now_ns: u64, out: &mut Out<'_>) {
        while self.deadline().is_some_and(|due| due <= now_ns) {
            self.silent(now_ns, out);
        }
    }

    /// Errors the UART saw since the last call, as [`serial_flag`]s: they mark the frame that is being received, or
    /// the next one.
    pub fn mark(&mut self, flags: u32) {
        self.flags |= flags;
    }

    /// From now on this answer needs no silence to end, until a good frame was received; `None`: no answer is awaited.
    /// Ignored while a frame is being received: what began before the request had left is no answer to it.
    pub fn expect(&mut self, answer: Option<Expected>) {
        self.expected = answer.filter(|_| !self.is_receiving());
    }

    /// These bytes were read at `now_ns`.
    pub fn push(&mut self, now_ns: u64, bytes: &[u8], out: &mut Out<'_>) {
        if bytes.is_empty() {
            return;
        }
        let took = if self.settings.timed { self.settings.timing.of(bytes.len()) } else { 0 };
        let last_ns = self.last_ns.unwrap_or(0);
        let begin_ns = now_ns.saturating_sub(took).max(last_ns).min(now_ns);
        if self.is_receiving() {
            self.turn(begin_ns, out);
        }
        if self.is_receiving() {
            self.gap(begin_ns - last_ns);
        }
        self.last_ns = Some(now_ns);
        self.counters.bytes += bytes.len() as u64;
        let char_ns = if self.settings.timed { self.settings.timing.char_ns } else { 0 };
        for (i, byte) in bytes.iter().enumerate() {
            self.byte_ns = (begin_ns + char_ns * i as u64).min(now_ns);
            self.byte(*byte, now_ns, out);
        }
        if self.settings.mode == Mode::Raw {
            self.emit(now_ns, 0, out);
        }
    }

    /// Gives up what is being received: the port is gone.
    pub fn reset(&mut self, now_ns: u64, out: &mut Out<'_>) {
        if self.len > 0 || self.passed > 0 {
            self.counters.fragments += 1;
            self.emit(now_ns, serial_flag::END, out);
        }
        self.clear();
        self.last_ns = Some(now_ns);
    }

    fn gap(&mut self, gap_ns: u64) {
        let watched = matches!(self.settings.mode, Mode::Rtu { .. } | Mode::Silence);
        if !watched || self.skipping || gap_ns <= self.settings.timing.t15_ns {
            return;
        }
        self.flags |= serial_flag::GAP;
        self.counters.t15_gaps += 1;
        if self.in_grace {
            self.in_grace = false;
            self.counters.late += 1;
        }
    }

    fn byte(&mut self, byte: u8, now_ns: u64, out: &mut Out<'_>) {
        match self.settings.mode {
            Mode::Rtu { .. } => self.rtu_byte(byte, now_ns, out),
            Mode::Silence | Mode::Raw => self.put(byte, now_ns, out),
            Mode::Ascii => self.ascii_byte(byte, now_ns, out),
            Mode::Delimiter { pattern, len } => {
                self.window = self.window << 8 | u64::from(byte);
                self.put(byte, now_ns, out);
                let mask = u64::MAX >> (64 - 8 * u32::from(len));
                let whole = self.skipping || self.passed + self.len >= usize::from(len);
                if whole && self.window & mask == pattern {
                    self.end(now_ns, out);
                }
            }
            Mode::Length(length) => {
                self.put(byte, now_ns, out);
                if self.passed + self.len >= length {
                    self.end(now_ns, out);
                }
            }
        }
    }

    fn ascii_byte(&mut self, byte: u8, now_ns: u64, out: &mut Out<'_>) {
        if byte == b':' {
            // The frame before never ended, or this is noise: a ':' begins a frame wherever it stands.
            if self.len > 0 {
                self.counters.fragments += 1;
                self.emit(now_ns, serial_flag::END, out);
            }
            self.clear();
        }
        let before = if self.len > 0 { self.buffer[self.len - 1] } else { 0 };
        self.put(byte, now_ns, out);
        if self.skipping {
            return;
        }
        // Inside of a frame are hexadecimal digits alone, so CR and any byte behind it end it.
        if self.buffer[0] == b':' && before == b'\r' {
            self.end(now_ns, out);
        } else if byte == b'\n' {
            self.counters.fragments += 1;
            self.emit(now_ns, serial_flag::END, out);
            self.clear();
        }
    }

    fn rtu_byte(&mut self, byte: u8, now_ns: u64, out: &mut Out<'_>) {
        if self.skipping {
            self.counters.bytes_cut += 1;
            return;
        }
        self.store(byte);
        // A gap or damage inside leaves it to the silence.
        let undoubted = self.flags == 0 && self.mark_count == 0;
        if undoubted && self.expected.is_some_and(|e| e.fits(&self.buffer[..self.len])) {
            self.rtu_emit(self.len, now_ns, out);
            self.clear();
        } else if self.len == CHUNK_BYTES {
            self.overfull(now_ns, out);
        }
    }

    /// More than any frame, and no silence yet: what is whole goes out; what can still become a frame stays.
    fn overfull(&mut self, now_ns: u64, out: &mut Out<'_>) {
        let (mut good, mut from) = (false, 0);
        let marks = &self.marks[..self.mark_count];
        rtu::cut(&self.buffer[..], marks, |piece| {
            (good, from) = (piece.good, piece.from);
        });
        // A frame that is not whole yet began later than this: behind a good one, or behind a silence.
        let oldest = CHUNK_BYTES - MAX_RTU;
        let begins = std::iter::once(from).chain(marks.iter().map(|m| usize::from(*m)));
        let kept = begins.filter(|at| !good && *at > oldest && *at >= from && *at < CHUNK_BYTES).min();
        let Some(kept) = kept else {
            self.rtu_emit(CHUNK_BYTES, now_ns, out);
            self.clear();
            self.skipping = !good;
            return;
        };
        self.rtu_emit(kept, now_ns, out);
        self.buffer.copy_within(kept.., 0);
        self.len -= kept;
        let mut count = 0;
        for i in 0..self.mark_count {
            let mark = usize::from(self.marks[i]);
            if mark > kept {
                self.marks[count] = (mark - kept) as u16;
                count += 1;
            }
        }
        self.mark_count = count;
        self.first_ns = self.byte_ns;
    }

    /// A silence that ends a frame has passed.
    fn silent(&mut self, now_ns: u64, out: &mut Out<'_>) {
        match self.settings.mode {
            Mode::Rtu { strict_t15, grace_ns } => {
                if self.skipping {
                    self.clear();
                } else if !self.in_grace
                    && !strict_t15
                    && grace_ns > self.settings.silence_ns
                    && self.may_go_on()
                {
                    if self.mark_count < MAX_MARKS {
                        self.marks[self.mark_count] = self.len as u16;
                        self.mark_count += 1;
                    }
                    self.in_grace = true;
                } else {
                    self.rtu_end(strict_t15, now_ns, out);
                }
            }
            Mode::Silence if !self.skipping => self.end(now_ns, out),
            _ => {
                if self.len > 0 || self.passed > 0 {
                    self.counters.fragments += 1;
                    self.emit(now_ns, serial_flag::END, out);
                }
                self.clear();
            }
        }
    }

    /// Whether what stands behind the last silence is only the beginning of a frame.
    fn may_go_on(&self) -> bool {
        let all = &self.buffer[..self.len];
        let mut good = false;
        let mut last = 0;
        rtu::cut(all, &self.marks[..self.mark_count], |piece| {
            good = piece.good;
            last = piece.from;
        });
        if good {
            return false;
        }
        let since = self.marks[..self.mark_count].last().map_or(0, |m| usize::from(*m));
        length::may_go_on(&all[last..]) || (since > last && length::may_go_on(&all[since..]))
    }

    fn rtu_end(&mut self, strict: bool, now_ns: u64, out: &mut Out<'_>) {
        if strict && self.flags & serial_flag::GAP != 0 {
            self.counters.rejected_t15 += 1;
        } else {
            self.rtu_emit(self.len, now_ns, out);
        }
        self.clear();
    }

    /// Hands over the first `to` bytes in their pieces.
    fn rtu_emit(&mut self, to: usize, now_ns: u64, out: &mut Out<'_>) {
        let Self { settings, buffer, counters, marks, mark_count, flags, first_ns, expected, .. } = self;
        let char_ns = if settings.timed { settings.timing.char_ns } else { 0 };
        rtu::cut(&buffer[..to], &marks[..*mark_count], |piece| {
            let mut bytes = &buffer[piece.from..piece.to];
            let mut chunk_flags = *flags | serial_flag::END;
            if piece.good {
                counters.frames += 1;
                *expected = None;
            } else if bytes.len() > settings.max_frame {
                counters.too_long += 1;
                counters.bytes_cut += (bytes.len() - settings.max_frame) as u64;
                bytes = &bytes[..settings.max_frame];
                chunk_flags |= serial_flag::OVERRUN;
            } else if bytes.len() < 4 {
                counters.fragments += 1;
            } else {
                counters.crc_errors += 1;
            }
            let first_ns = (*first_ns + char_ns * piece.from as u64).min(now_ns);
            out(Chunk { first_ns, end_ns: now_ns, flags: chunk_flags, bytes });
        });
    }

    /// One byte of a frame that has no end yet.
    fn put(&mut self, byte: u8, now_ns: u64, out: &mut Out<'_>) {
        if self.skipping {
            self.counters.bytes_cut += 1;
            return;
        }
        if self.passed + self.len >= self.settings.max_frame && self.settings.mode != Mode::Raw {
            self.counters.too_long += 1;
            self.counters.bytes_cut += 1;
            self.emit(now_ns, serial_flag::END | serial_flag::OVERRUN, out);
            self.passed = 0;
            self.skipping = true;
            return;
        }
        if self.len == CHUNK_BYTES {
            self.emit(now_ns, 0, out);
        }
        self.store(byte);
    }

    fn store(&mut self, byte: u8) {
        if self.len == 0 && self.passed == 0 {
            self.first_ns = self.byte_ns;
        }
        self.buffer[self.len] = byte;
        self.len += 1;
    }

    /// The frame is whole.
    fn end(&mut self, now_ns: u64, out: &mut Out<'_>) {
        if !self.skipping {
            self.counters.frames += 1;
            self.emit(now_ns, serial_flag::END, out);
        }
        self.clear();
    }

    fn emit(&mut self, now_ns: u64, flags: u32, out: &mut Out<'_>) {
        let bytes = &self.buffer[..self.len];
        out(Chunk { first_ns: self.first_ns, end_ns: now_ns, flags: flags | self.flags, bytes });
        self.passed = if self.settings.mode == Mode::Raw { 0 } else { self.passed + self.len };
        self.len = 0;
        self.flags = 0;
    }

    fn clear(&mut self) {
        self.len = 0;
        self.passed = 0;
        self.skipping = false;
        self.window = 0;
        self.flags = 0;
        self.mark_count = 0;
        self.in_grace = false;
    }
}
