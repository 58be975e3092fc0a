//! Input services: their newest sample, and whether they are alive.

use crate::engine::Engine;
use ipc_types::Context;
use ipc_types::payload::{Inputs, Quality};
use ipc_types::port::Subscriber;
use ipc_types::rail::RailError;
use ipc_types::scan_record::Source;
use ipc_types::topic::TopicKind;

/// One input service.
pub(super) struct InputSource {
    pub name: String,
    subscriber: Subscriber<Inputs>,
    /// Index of its first range among all ranges of the engine.
    first_range: u16,
    /// Bytes of each of its ranges.
    lengths: Vec<u32>,
    tail: Vec<u8>,
    pub source: Source,
    /// Of its newest message.
    pub samples: u64,
    fresh: bool,
    /// CLOCK_MONOTONIC of its last sample; 0 = none yet.
    last_ns: u64,
    died_ns: u64,
    pub dead: bool,
    pub malformed: u64,
    /// Quality told last by an event.
    pub told: Option<Quality>,
    pub data_t_ns: u64,
}

impl InputSource {
    /// Opens every input service of this plc, in the order of the setup's ranges.
    pub(super) fn open_all(ctx: &Context) -> Result<Vec<Self>, RailError> {
        let stack = ctx.stack.clone();
        let mut first = 0usize;
        let mut out = Vec::new();
        for service in stack.services.iter().filter(|s| s.wiring.plc.as_deref() == Some(ctx.service.as_str()))
        {
            let lengths: Vec<u32> = service.wiring.inputs.iter().map(|r| r.bytes).collect();
            if lengths.is_empty() {
                continue;
            }
            let tail = lengths.iter().sum::<u32>() as usize + lengths.len();
            out.push(Self {
                name: service.name.clone(),
                subscriber: ctx.subscriber::<Inputs>(&TopicKind::Inputs.of(&service.name))?,
                first_range: first as u16,
                tail: vec![0; tail],
                source: Source { writer: service.index, ..Source::default() },
                samples: 0,
                fresh: false,
                last_ns: 0,
                died_ns: 0,
                dead: false,
                malformed: 0,
                told: None,
                data_t_ns: 0,
                lengths,
            });
            first += out.last().map_or(0, |s| s.lengths.len());
        }
        Ok(out)
    }

    /// Takes the newest sample, if there is a new one.
    pub(super) fn poll(&mut self) -> bool {
        let Self { subscriber, tail, source, samples, fresh, last_ns, malformed, lengths, data_t_ns, .. } =
            self;
        subscriber.newest(|header, bytes| {
            if header.ranges as usize != lengths.len() || bytes.len() != tail.len() {
                *malformed += 1;
                return;
            }
            tail.copy_from_slice(bytes);
            let stamp = header.stamp;
            *source = Source { writer: stamp.writer, generation: stamp.generation, seq: stamp.seq };
            *last_ns = stamp.t_ns;
            *data_t_ns = header.data_t_ns;
            *samples = header.samples;
            *fresh = true;
        });
        self.fresh
    }

    /// Has it ever delivered?
    pub(super) fn delivered(&self) -> bool {
        self.last_ns != 0
    }

    /// The launcher says that the service is gone since then.
    pub(super) fn died(&mut self, t_ns: u64) {
        self.died_ns = self.died_ns.max(t_ns);
    }

    /// Age of the last sample.
    pub(super) fn age_ns(&self, now_ns: u64) -> Option<u64> {
        self.delivered().then(|| now_ns.saturating_sub(self.last_ns))
    }

    /// Hands what is new to the open scan: the sample, or that the owner is dead.
    pub(super) fn apply(&mut self, engine: &mut Engine, now_ns: u64, timeout_ns: u64, waiting_is_over: bool) {
        if self.fresh {
            self.fresh = false;
            self.dead = false;
            let at = engine.input_begin(&self.source);
            let (mut bytes, qualities) = self.tail.split_at(self.tail.len() - self.lengths.len());
            for (i, (len, quality)) in self.lengths.iter().zip(qualities).enumerate() {
                let (range, rest) = bytes.split_at(*len as usize);
                bytes = rest;
                // Only this engine says that an owner is dead.
                let quality = (*quality).min(Quality::NoData as u8);
                engine.input_range(self.first_range + i as u16, quality, 0, range);
            }
            engine.input_end(at);
        }
        let silent = now_ns.saturating_sub(self.last_ns) > timeout_ns;
        let gone = self.died_ns > self.last_ns || if self.delivered() { silent } else { waiting_is_over };
        if gone && !self.dead {
            self.dead = true;
            let at = engine.input_begin(&self.source);
            for i in 0..self.lengths.len() {
                engine.input_range(self.first_range + i as u16, Quality::OwnerDead as u8, 0, &[]);
            }
            engine.input_end(at);
        }
    }

    /// Worst quality of its ranges.
    pub(super) fn quality(&self, engine: &Engine) -> Quality {
        let first = usize::from(self.first_range);
        let own = engine.quality().get(first..first + self.lengths.len()).unwrap_or(&[]);
        own.iter().map(|q| Quality::from_u8(*q)).max().unwrap_or(Quality::NoData)
    }

    pub(super) fn lost(&self) -> u64 {
        self.subscriber.counters().lost
    }
}
