//! Publishers and subscribers as every service uses them: numbered, stamped, validated, gaps counted.

use crate::inbox::Bell;
use crate::payload::{Payload, Stamp, as_bytes};
use crate::rail::{RailError, Svc, service_name};
use crate::stack::TopicEntry;
use crate::topic::{MAX_NODES, TopicKind, WhenFull};
use crate::{clock, with_payload};
use iceoryx2::node::Node;
use iceoryx2::port::publisher::Publisher as IoxPublisher;
use iceoryx2::port::subscriber::Subscriber as IoxSubscriber;
use iceoryx2::port::{BackpressureAction, SendError as IoxSendError};
use iceoryx2::prelude::AllocationStrategy;
use iceoryx2::service::port_factory::PortFactory as _;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;
use std::rc::Rc;

/// Why a message was not sent.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SendError {
    #[error("topic '{0}': the reader's queue is full; the message was refused, send it later or less often")]
    Full(String),
    #[error(
        "topic '{0}': nobody reads it now; its consumer is down, restarting, or has not connected yet: try again"
    )]
    NoReader(String),
    #[error("topic '{topic}': a tail of {bytes} bytes is above the limit of {limit}")]
    TooLong { topic: String, bytes: usize, limit: u32 },
    #[error("topic '{topic}': {cause}")]
    Middleware { topic: String, cause: String },
}

type Factory<H> = PortFactory<Svc, [u8], H>;

fn open<H: Payload>(node: &Node<Svc>, topic: &TopicEntry) -> Result<Factory<H>, RailError> {
    let row = topic.kind.row();
    if row.payload != H::NAME {
        return Err(RailError::WrongPayload { topic: topic.name.clone(), has: row.payload, asked: H::NAME });
    }
    node.service_builder(&service_name(&topic.name)?)
        .publish_subscribe::<[u8]>()
        .user_header::<H>()
        .open()
        .map_err(|e| RailError::port(format!("opening topic '{}'", topic.name), MAX_NODES, e))
}

/// A writer of a topic.
pub struct Publisher<H: Payload> {
    port: IoxPublisher<Svc, [u8], H>,
    factory: Factory<H>,
    /// Rung by [`Publisher::ring`].
    bells: Vec<Rc<Bell>>,
    name: String,
    max_tail: u32,
    refuse: bool,
    next_seq: u64,
    generation: u32,
    writer: u32,
    refused: u64,
}

impl<H: Payload> Publisher<H> {
    pub(crate) fn new(
        node: &Node<Svc>,
        topic: &TopicEntry,
        bells: Vec<Rc<Bell>>,
        writer: u32,
        generation: u32,
    ) -> Result<Self, RailError> {
        let factory = open::<H>(node, topic)?;
        let refuse = topic.kind.row().when_full == WhenFull::Refuse;
        let builder = factory
            .publisher_builder()
            .initial_max_slice_len((topic.max_tail as usize).max(1))
            .allocation_strategy(AllocationStrategy::Static)
            .max_loaned_samples(2);
        // A full queue is told to the writer at once: blocking would hang on a dead reader for ever.
        let port =
            builder.set_backpressure_handler(|_| BackpressureAction::DiscardDataAndFail).create().map_err(
                |e| RailError::port(format!("publisher on '{}'", topic.name), topic.max_publishers, e),
            )?;
        Ok(Self {
            port,
            factory,
            bells,
            name: topic.name.clone(),
            max_tail: topic.max_tail,
            refuse,
            next_seq: 1,
            generation,
            writer,
            refused: 0,
        })
    }

    /// Sends a header without tail, stamped now. Returns its `seq`.
    pub fn send(&mut self, header: H) -> Result<u64, SendError> {
        self.send_at(header, &[], clock::mono_ns())
    }

    /// Sends a header and its tail, stamped now. Returns its `seq`.
    pub fn send_tail(&mut self, header: H, tail: &[u8]) -> Result<u64, SendError> {
        self.send_at(header, tail, clock::mono_ns())
    }

    /// Sends with a stamp of the caller's, CLOCK_MONOTONIC in ns: when the frame was on the bus.
    ///
    /// A refused message consumes no `seq`. On topics that replace the oldest this fails only when shared
    /// memory does.
    pub fn send_at(&mut self, mut header: H, tail: &[u8], t_ns: u64) -> Result<u64, SendError> {
        if tail.len() > self.max_tail as usize {
            return Err(SendError::TooLong {
                topic: self.name.clone(),
                bytes: tail.len(),
                limit: self.max_tail,
            });
        }
        let seq = self.next_seq;
        *header.stamp_mut() = Stamp { seq, t_ns, generation: self.generation, writer: self.writer };
        header.set_tail_len(tail.len() as u32);
        // A header without tail still needs one element: zero-length samples are not portable over versions.
        let body: &[u8] = if H::TAIL { tail } else { &[0] };
        let mut sample = match self.port.loan_slice_uninit(body.len()) {
            Ok(sample) => sample,
            Err(cause) => return Err(self.failed(format!("{cause:?}"))),
        };
        *sample.user_header_mut() = header;
        let sent = sample.write_from_slice(body).send();
        match sent {
            Ok(0) if self.refuse => {
                self.refused += 1;
                Err(SendError::NoReader(self.name.clone()))
            }
            Ok(_) => {
                self.next_seq += 1;
                Ok(seq)
            }
            Err(IoxSendError::UnableToDeliver) => {
                self.refused += 1;
                Err(SendError::Full(self.name.clone()))
            }
            Err(cause) => Err(self.failed(format!("{cause:?}"))),
        }
    }

    fn failed(&mut self, cause: String) -> SendError {
        self.refused += 1;
        SendError::Middleware { topic: self.name.clone(), cause }
    }

    /// Whether anybody has connected to read. A reader that was killed counts until it is cleaned up after.
    pub fn has_reader(&self) -> bool {
        self.factory.dynamic_config().number_of_subscribers() > 0
    }

    /// Wakes the consumers of the topic. Once a batch is enough.
    pub fn ring(&self) {
        for bell in &self.bells {
            bell.ring();
        }
    }

    /// Messages that were not sent.
    pub fn refused(&self) -> u64 {
        self.refused
    }

    /// `seq` of the next message.
    pub fn next_seq(&self) -> u64 {
        self.next_seq
    }

    /// Bytes of the largest tail.
    pub fn max_tail(&self) -> u32 {
        self.max_tail
    }
}

/// Writers that one reader follows; beyond that the one silent for longest is forgotten.
const MAX_WRITERS: usize = 32;

#[derive(Debug, Clone, Copy, Default)]
struct Followed {
    writer: u32,
    generation: u32,
    next_seq: u64,
    touched: u64,
}

/// What [`Sequence::accept`] made of a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Accept {
    /// The next one, or the first of a writer or generation; so many before it were lost.
    Fresh { lost: u64 },
    /// From a generation before the one already seen, or a number already seen: dropped.
    Old,
}

/// Follows `seq` and `generation` of every writer of a topic. Sans-I/O; also used on recordings.
#[derive(Debug, Clone, Default)]
pub struct Sequence {
    table: [Followed; MAX_WRITERS],
    used: usize,
    clock: u64,
}

impl Sequence {
    /// Judges a message by its stamp.
    pub fn accept(&mut self, stamp: &Stamp) -> Accept {
        self.clock += 1;
        let clock = self.clock;
        if let Some(known) = self.table[..self.used].iter_mut().find(|f| f.writer == stamp.writer) {
            if stamp.generation < known.generation
                || (stamp.generation == known.generation && stamp.seq < known.next_seq)
            {
                return Accept::Old;
            }
            // What a new generation sent before we saw its first message cannot be told from "never sent".
            let lost = if stamp.generation == known.generation { stamp.seq - known.next_seq } else { 0 };
            *known = Followed {
                generation: stamp.generation,
                next_seq: stamp.seq.wrapping_add(1),
                touched: clock,
                ..*known
            };
            return Accept::Fresh { lost };
        }
        let slot = if self.used < MAX_WRITERS {
            self.used += 1;
            self.used - 1
        } else {
            (0..MAX_WRITERS).min_by_key(|&i| self.table[i].touched).unwrap_or(0)
        };
        self.table[slot] = Followed {
            writer: stamp.writer,
            generation: stamp.generation,
            next_seq: stamp.seq.wrapping_add(1),
            touched: clock,
        };
        Accept::Fresh { lost: 0 }
    }
}

/// Counters of a reader.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize)]
pub struct ReadCounters {
    pub received: u64,
    /// Messages that were replaced before we read them.
    pub lost: u64,
    /// Dropped: of an older generation.
    pub old: u64,
    /// Dropped: header and tail disagree.
    pub malformed: u64,
}

/// A reader of a topic.
pub struct Subscriber<H: Payload> {
    port: IoxSubscriber<Svc, [u8], H>,
    name: String,
    sequence: Sequence,
    counters: ReadCounters,
}

impl<H: Payload> Subscriber<H> {
    pub(crate) fn new(node: &Node<Svc>, topic: &TopicEntry) -> Result<Self, RailError> {
        let factory = open::<H>(node, topic)?;
        let port = factory.subscriber_builder().buffer_size(topic.depth as usize).create().map_err(|e| {
            RailError::port(format!("subscriber on '{}'", topic.name), topic.max_subscribers, e)
        })?;
        // Connects at once: history is handed over and a refusing writer sees its reader.
        let _ = port.has_samples();
        Ok(Self {
            port,
            name: topic.name.clone(),
            sequence: Sequence::default(),
            counters: ReadCounters::default(),
        })
    }

    /// Hands over at most `max` messages, oldest first per writer, copied header and borrowed tail.
    /// Returns how many were taken, dropped ones included; `max` means there may be more.
    ///
    /// Between several writers there is no order: what is taken first is first.
    pub fn drain(&mut self, max: usize, mut take: impl FnMut(&H, &[u8])) -> usize {
        for count in 0..max {
            let Ok(Some(sample)) = self.port.receive() else { return count };
            let header = *sample.user_header();
            let tail: &[u8] = if H::TAIL { sample.payload() } else { &[] };
            if header.tail_len() as usize != tail.len() {
                self.counters.malformed += 1;
                continue;
            }
            match self.sequence.accept(header.stamp()) {
                Accept::Old => self.counters.old += 1,
                Accept::Fresh { lost } => {
                    self.counters.lost += lost;
                    self.counters.received += 1;
                    take(&header, tail);
                }
            }
        }
        max
    }

    /// Hands over only the newest message, if there is a new one.
    pub fn newest(&mut self, mut take: impl FnMut(&H, &[u8])) -> bool {
        let mut last = None;
        // Bounded: at most the queue of every writer.
        for _ in 0..4096 {
            let Ok(Some(sample)) = self.port.receive() else { break };
            let header = *sample.user_header();
            let len = if H::TAIL { sample.payload().len() } else { 0 };
            if header.tail_len() as usize != len {
                self.counters.malformed += 1;
                continue;
            }
            if self.sequence.accept(header.stamp()) == Accept::Old {
                self.counters.old += 1;
                continue;
            }
            self.counters.received += 1;
            last = Some(sample);
        }
        let Some(sample) = last else { return false };
        take(sample.user_header(), if H::TAIL { sample.payload() } else { &[] });
        true
    }

    pub fn counters(&self) -> ReadCounters {
        self.counters
    }
    pub fn name(&self) -> &str {
        &self.name
    }
}

/// Takes a message of unknown type: stamp, bytes of the header, tail.
pub type TakeRaw<'a> = dyn FnMut(&Stamp, &[u8], &[u8]) + 'a;

/// A reader that does not know the payload type: the recorder's. Hands over header bytes and tail.
pub trait RawSubscriber {
    /// Like [`Subscriber::drain`], with the bytes of the header.
    fn drain_raw(&mut self, max: usize, take: &mut TakeRaw<'_>) -> usize;
    /// Its counters.
    fn counters(&self) -> ReadCounters;
}

impl<H: Payload> RawSubscriber for Subscriber<H> {
    fn drain_raw(&mut self, max: usize, take: &mut TakeRaw<'_>) -> usize {
        self.drain(max, |header, tail| take(header.stamp(), as_bytes(header), tail))
    }
    fn counters(&self) -> ReadCounters {
        self.counters
    }
}

pub(crate) fn raw_subscriber(
    node: &Node<Svc>,
    topic: &TopicEntry,
) -> Result<Box<dyn RawSubscriber>, RailError> {
    with_payload!(topic.kind, T => Ok(Box::new(Subscriber::<T>::new(node, topic)?)))
}

/// Whether messages of this kind have a tail, for code that only knows the kind.
pub fn has_tail(kind: TopicKind) -> bool {
    with_payload!(kind, T => T::TAIL)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stamp(writer: u32, generation: u32, seq: u64) -> Stamp {
        Stamp { seq, t_ns: 0, generation, writer }
    }

    #[test]
    fn gaps_are_counted_and_old_generations_dropped() {
        let mut sequence = Sequence::default();
        let table = [
            ((1, 1, 5), Accept::Fresh { lost: 0 }), // joined late
            ((1, 1, 6), Accept::Fresh { lost: 0 }),
            ((2, 1, 1), Accept::Fresh { lost: 0 }),
            ((1, 1, 9), Accept::Fresh { lost: 2 }),
            ((1, 1, 9), Accept::Old),
            ((1, 2, 1), Accept::Fresh { lost: 0 }), // restarted
            ((1, 1, 10), Accept::Old),              // still in the dead writer's queue
            ((2, 1, 2), Accept::Fresh { lost: 0 }),
        ];
        for ((writer, generation, seq), expected) in table {
            assert_eq!(
                sequence.accept(&stamp(writer, generation, seq)),
                expected,
                "{writer}/{generation}/{seq}"
            );
        }
    }

    #[test]
    fn beyond_the_limit_the_longest_silent_writer_is_forgotten() {
        let mut sequence = Sequence::default();
        for writer in 1..=MAX_WRITERS as u32 + 1 {
            sequence.accept(&stamp(writer, 1, 10));
        }
        // 1 was forgotten: its next message is a first one again, nothing is counted lost.
        assert_eq!(sequence.accept(&stamp(1, 1, 20)), Accept::Fresh { lost: 0 });
        assert_eq!(sequence.accept(&stamp(33, 1, 12)), Accept::Fresh { lost: 1 });
    }
}
