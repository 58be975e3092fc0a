//! Client and server wired back to back over a network that loses, repeats, delays and reorders frames.

use super::super::*;
use super::server::dictionary;
use crate::protocol::abort::Abort;
use crate::protocol::io::Outbox;
use crate::protocol::od::{NoHooks, ObjectDictionary};
use ipc_types::payload::CanFrame;
use proptest::prelude::*;

/// Faults of the network in percent, and the longest delay.
#[derive(Clone, Copy, Debug, Default)]
struct Faults {
    loss: u64,
    repeat: u64,
    swap: u64,
    delay_ns: u64,
    seed: u64,
}

struct Network {
    faults: Faults,
    random: u64,
    t_ns: u64,
    /// Time of arrival, order, to the server?, frame.
    wire: Vec<(u64, u64, bool, CanFrame)>,
    order: u64,
    last: [u64; 2],
    frames: u64,
}

impl Network {
    fn new(faults: Faults) -> Self {
        Self { faults, random: faults.seed | 1, t_ns: 0, wire: Vec::new(), order: 0, last: [0; 2], frames: 0 }
    }
    fn roll(&mut self, below: u64) -> u64 {
        self.random ^= self.random << 13;
        self.random ^= self.random >> 7;
        self.random ^= self.random << 17;
        (self.random >> 11) % below.max(1)
    }
    fn send(&mut self, out: &mut Outbox, to_server: bool) {
        for frame in out.drain() {
            self.frames += 1;
            if self.roll(100) < self.faults.loss {
                continue;
            }
            let copies = if self.roll(100) < self.faults.repeat { 2 } else { 1 };
            for _ in 0..copies {
                let mut at = self.t_ns + 1000 + self.roll(self.faults.delay_ns);
                at = at.max(self.last[usize::from(to_server)]);
                self.last[usize::from(to_server)] = at;
                self.order += 1;
                self.wire.push((at, self.order, to_server, frame));
            }
            if self.roll(100) < self.faults.swap
                && let [.., a, b] = &mut self.wire[..]
                && a.2 == b.2
            {
                std::mem::swap(&mut a.3, &mut b.3);
            }
        }
    }
    fn arrival(&mut self) -> Option<(u64, bool, CanFrame)> {
        let at = (0..self.wire.len()).min_by_key(|&at| (self.wire[at].0, self.wire[at].1))?;
        let (t_ns, _, to_server, frame) = self.wire.swap_remove(at);
        Some((t_ns, to_server, frame))
    }
    fn next(&self) -> Option<u64> {
        self.wire.iter().map(|frame| frame.0).min()
    }
}

struct Pair {
    od: ObjectDictionary,
    server: SdoServer,
    client: SdoClient,
    net: Network,
}

impl Pair {
    fn new(faults: Faults, block_size: u8) -> Self {
        let od = dictionary();
        let channel = server_channel(&od, 0).unwrap();
        let server = SdoServer::new(channel, ServerConfig { block_size, ..ServerConfig::default() }, &od);
        let client = SdoClient::new(channel, ClientConfig { block_size, ..ClientConfig::default() });
        Self { od, server, client, net: Network::new(faults) }
    }
    /// Runs until the transfer has ended.
    fn run(&mut self) -> Finished {
        let mut out = Outbox::default();
        for _ in 0..200_000 {
            let timer =
                [self.client.next_deadline(), self.server.next_deadline()].into_iter().flatten().min();
            let frame = self.net.next();
            let by_frame = match (timer, frame) {
                (None, None) => panic!("nothing will ever happen"),
                (Some(timer), Some(frame)) => frame <= timer,
                (None, Some(_)) => true,
                (Some(_), None) => false,
            };
            let mut finished = None;
            if by_frame {
                let (t_ns, to_server, frame) = self.net.arrival().unwrap();
                self.net.t_ns = t_ns.max(self.net.t_ns);
                if to_server {
                    assert!(self.server.on_frame(
                        self.net.t_ns,
                        &frame,
                        &mut self.od,
                        &mut NoHooks,
                        &mut out
                    ));
                } else {
                    finished = self.client.on_frame(self.net.t_ns, &frame, &mut out);
                }
                self.net.send(&mut out, !to_server);
            } else {
                self.net.t_ns = timer.unwrap();
                self.server.on_time(self.net.t_ns, &mut out);
                self.net.send(&mut out, false);
                finished = self.client.on_time(self.net.t_ns, &mut out);
                self.net.send(&mut out, true);
            }
            if let Some(finished) = finished {
                assert!(!self.client.is_busy());
                return finished;
            }
        }
        panic!("the transfer never ends");
    }
    /// Lets every frame arrive: an answer to a transfer that was given up cannot be told from the answer to the
    /// next one for the same object, so nobody may start that one within the network's delay.
    fn settle(&mut self) {
        let mut out = Outbox::default();
        while let Some((t_ns, to_server, frame)) = self.net.arrival() {
            self.net.t_ns = t_ns.max(self.net.t_ns);
            if to_server {
                self.server.on_frame(self.net.t_ns, &frame, &mut self.od, &mut NoHooks, &mut out);
            } else {
                assert_eq!(self.client.on_frame(self.net.t_ns, &frame, &mut out), None);
            }
            self.net.send(&mut out, !to_server);
        }
    }
    fn write(&mut self, index: u16, data: &[u8], mode: Mode) -> Result<usize, Failure> {
        let mut out = Outbox::default();
        let options = Options { mode, ..Options::default() };
        self.client.start_write(self.net.t_ns, index, 0, data, options, &mut out).unwrap();
        self.net.send(&mut out, true);
        self.run().result
    }
    fn read(&mut self, index: u16, mode: Mode, threshold: u8) -> Result<Vec<u8>, Failure> {
        let mut out = Outbox::default();
        let options = Options { mode, threshold, ..Options::default() };
        self.client.start_read(self.net.t_ns, index, 0, options, &mut out).unwrap();
        self.net.send(&mut out, true);
        self.run().result.map(|_| self.client.data().to_vec())
    }
}

fn sample(len: usize, seed: u8) -> Vec<u8> {
    (0..len).map(|at| (at as u8).wrapping_mul(31).wrapping_add(seed) ^ (at >> 8) as u8).collect()
}

#[test]
fn every_length_by_every_protocol() {
    let mut pair = Pair::new(Faults::default(), 5);
    for len in (0..40).chain([69, 70, 71, 126, 127, 128, 889, 890, 1999, 2000]) {
        for mode in [Mode::Auto, Mode::Segmented, Mode::Block, Mode::BlockOnly] {
            let data = sample(len, len as u8);
            assert_eq!(pair.write(0x2000, &data, mode), Ok(len), "{mode:?}");
            assert_eq!(pair.od.bytes(0x2000, 0), Some(&data[..]));
            for threshold in [0, 20, 255] {
                assert_eq!(pair.read(0x2000, mode, threshold).as_ref(), Ok(&data), "{mode:?}");
            }
        }
    }
    pair.settle();
    assert_eq!(pair.server.counters.finished, 50 * 16);
    assert_eq!(pair.client.counters.fallbacks, 0);
}

#[test]
fn aborts_of_the_server_reach_the_caller() {
    let mut pair = Pair::new(Faults::default(), 127);
    for mode in [Mode::Segmented, Mode::BlockOnly] {
        let by_server = |abort| Failure { abort, by: By::Server };
        assert_eq!(pair.write(0x1000, &[0; 4], mode), Err(by_server(Abort::READ_ONLY)));
        assert_eq!(pair.write(0x4000, &[0; 4], mode), Err(by_server(Abort::NO_OBJECT)));
        assert_eq!(pair.write(0x2002, &[0; 11], mode), Err(by_server(Abort::TOO_LONG)));
        assert_eq!(pair.write(0x1017, &[0; 1], mode), Err(by_server(Abort::TOO_SHORT)));
        assert_eq!(pair.write(0x2001, &[0xFF; 8], mode), Err(by_server(Abort::TOO_HIGH)));
        assert_eq!(pair.read(0x2003, mode, 0), Err(by_server(Abort::WRITE_ONLY)));
    }
    assert_eq!(
        pair.read(0x2003, Mode::Auto, 0).unwrap_err().to_string(),
        "the node answered abort 06010001h: the object is write-only and cannot be read"
    );
}

#[test]
fn a_megabyte_both_ways() {
    use crate::protocol::data_type::DataType;
    use crate::protocol::od::{Access, EntryDef, OdBuilder};
    let mut b = OdBuilder::new();
    b.var(0x2000, EntryDef::new(DataType::Domain, Access::Rw).capacity(1 << 20));
    let mut pair = Pair::new(Faults::default(), 127);
    pair.od = b.build(4).unwrap();
    pair.server = SdoServer::new(server_channel(&pair.od, 0).unwrap(), ServerConfig::default(), &pair.od);
    let data = sample(1 << 20, 7);
    assert_eq!(pair.write(0x2000, &data, Mode::Auto), Ok(1 << 20));
    assert_eq!(pair.read(0x2000, Mode::Block, 0), Ok(data.clone()));
    let block = pair.net.frames;
    assert!(block < 2 * (1 << 20) / 7 * 103 / 100, "{block} frames");
    pair.client.set_config(ClientConfig { max_value: 1000, ..ClientConfig::default() });
    let mut out = Outbox::default();
    let busy = pair.client.start_write(0, 0x2000, 0, &data, Options::default(), &mut out);
    assert_eq!(busy, Err(Busy::TooLong { len: 1 << 20, max: 1000 }));
    for mode in [Mode::Segmented, Mode::Block] {
        let refused = pair.read(0x2000, mode, 0);
        assert_eq!(refused, Err(Failure { abort: Abort::MEMORY, by: By::Client }));
    }
}

/// A server that knows no block transfer and fills the object of some other time into its abort.
#[test]
fn block_falls_back_to_segmented() {
    let channel = Channel::default_of(4);
    let mut client = SdoClient::new(channel, ClientConfig::default());
    let mut out = Outbox::default();
    let answer = |bytes: [u8; 8]| CanFrame::classic(0x584, &bytes);
    let take = |out: &mut Outbox| out.drain().map(|frame| frame.data[0]).collect::<Vec<_>>();
    client.start_write(0, 0x2000, 0, &[1; 200], Options::default(), &mut out).unwrap();
    assert_eq!(take(&mut out), [0xC6]);
    assert_eq!(client.start_read(0, 1, 1, Options::default(), &mut out), Err(Busy::Busy));
    assert!(client.on_frame(1, &answer([0x80, 4, 0x10, 0, 1, 0, 4, 5]), &mut out).is_none());
    assert_eq!(take(&mut out), [0x21]);
    // From now on it is segmented at once, until told that the server is another.
    let cancelled = client.cancel(Abort::GENERAL, &mut out).unwrap();
    assert_eq!(cancelled.result, Err(Failure { abort: Abort::GENERAL, by: By::Client }));
    assert_eq!(take(&mut out), [0x80]);
    let block = Options { mode: Mode::Block, ..Options::default() };
    client.start_read(2, 0x2000, 0, block, &mut out).unwrap();
    assert_eq!(take(&mut out), [0x40]);
    client.reset();
    client.start_read(2, 0x2000, 0, block, &mut out).unwrap();
    assert_eq!(take(&mut out), [0xA4]);
    assert_eq!(client.progress(), (0, None));
    client.on_frame(3, &answer([0x80, 0, 0x20, 0, 1, 0, 4, 5]), &mut out);
    assert_eq!(take(&mut out), [0x40]);
    assert_eq!(client.counters.fallbacks, 2);
    let only = Options { mode: Mode::BlockOnly, ..Options::default() };
    client.reset();
    client.start_read(2, 0x2000, 0, only, &mut out).unwrap();
    take(&mut out);
    let finished = client.on_frame(3, &answer([0x80, 0, 0x20, 0, 1, 0, 4, 5]), &mut out).unwrap();
    assert_eq!(finished.result, Err(Failure { abort: Abort::COMMAND, by: By::Server }));
}

#[test]
fn a_late_answer_is_not_taken_for_another_objects() {
    let mut client = SdoClient::new(Channel::default_of(4), ClientConfig::default());
    let mut out = Outbox::default();
    client.start_read(0, 0x1000, 0, Options::default(), &mut out).unwrap();
    let t_ns = client.next_deadline().unwrap();
    assert_eq!(t_ns, 500_000_000);
    let finished = client.on_time(t_ns, &mut out).unwrap();
    assert!(finished.result.unwrap_err().is_timeout());
    let frames: Vec<_> = out.drain().collect();
    assert_eq!(frames[1].data[..8], [0x80, 0, 0x10, 0, 0, 0, 4, 5]);
    client.start_read(t_ns, 0x1018, 1, Options::default(), &mut out).unwrap();
    for late in [
        [0x43, 0, 0x10, 0, 1, 2, 3, 4],
        [0x80, 0, 0x10, 0, 0, 0, 4, 5],
        [0x00, 1, 2, 3, 4, 5, 6, 7],
        [0x60, 0x18, 0x10, 2, 0, 0, 0, 0],
    ] {
        assert_eq!(client.on_frame(t_ns + 1, &CanFrame::classic(0x584, &late), &mut out), None);
    }
    assert_eq!(client.counters.stale, 4);
    let answer = CanFrame::classic(0x584, &[0x4F, 0x18, 0x10, 1, 9, 0, 0, 0]);
    assert_eq!(client.on_frame(t_ns + 2, &answer, &mut out).unwrap().result, Ok(1));
    assert_eq!(client.data(), [9]);
    assert_eq!(client.on_frame(t_ns + 3, &answer, &mut out), None);
}

/// A transfer that failed leaves the old value or, when only the last answer was lost, the new one whole.
fn check(pair: &Pair, old: &[u8], data: &[u8], result: &Result<usize, Failure>) -> Result<(), TestCaseError> {
    let now = pair.od.bytes(0x2000, 0).unwrap();
    match result {
        Ok(len) => {
            prop_assert_eq!(*len, data.len());
            prop_assert_eq!(now, data);
        }
        Err(_) => prop_assert!(now == old || now == data),
    }
    Ok(())
}

fn transfers(
    faults: Faults,
    size: u8,
    lens: &[usize],
    mode: Mode,
    fine: &[Abort],
) -> Result<(), TestCaseError> {
    let mut pair = Pair::new(faults, size);
    for (n, &len) in lens.iter().enumerate() {
        let data = sample(len, n as u8);
        let old = pair.od.bytes(0x2000, 0).unwrap().to_vec();
        let result = pair.write(0x2000, &data, mode);
        check(&pair, &old, &data, &result)?;
        pair.settle();
        let value = pair.od.bytes(0x2000, 0).unwrap().to_vec();
        let read = pair.read(0x2000, mode, 0);
        if let Ok(read) = &read {
            prop_assert_eq!(read, &value);
        }
        pair.settle();
        if faults.loss + faults.repeat + faults.swap == 0 && faults.delay_ns <= 50_000_000 {
            prop_assert!(result.is_ok() && read.is_ok(), "{:?} {:?}", result, read);
        }
        for failure in [result.err(), read.err()].into_iter().flatten() {
            prop_assert!(fine.contains(&failure.abort), "{:?}", failure);
        }
    }
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, ..ProptestConfig::default() })]

    /// Loss and delays within the timeout: success or a timeout. The server's wrong sequence number is the client's
    /// next request when its abort was lost too, in the middle of a sub-block.
    #[test]
    fn loss(
        (loss, seed, delay_ns) in (0u64..15, any::<u64>(), 0u64..50_000_000),
        size in 2u8..=127,
        lens in prop::collection::vec(0usize..1500, 1..4),
        mode in prop::sample::select(vec![Mode::Auto, Mode::Segmented, Mode::BlockOnly]),
    ) {
        let faults = Faults { loss, delay_ns, seed, ..Faults::default() };
        transfers(faults, size, &lens, mode, &[Abort::TIMEOUT, Abort::SEQUENCE])?;
    }

    /// A frame in several arrives twice, as CAN may do, and delays exceed the timeouts.
    #[test]
    fn repetition_and_long_delays(
        (loss, repeat, seed, delay_ns) in (0u64..10, 0u64..10, any::<u64>(), 0u64..1_500_000_000),
        lens in prop::collection::vec(0usize..300, 1..4),
    ) {
        let fine = [Abort::TIMEOUT, Abort::TOGGLE, Abort::COMMAND];
        let faults = Faults { loss, repeat, delay_ns, seed, ..Faults::default() };
        transfers(faults, 127, &lens, Mode::Segmented, &fine)?;
    }

    /// Everything at once, with CRC.
    #[test]
    fn all_faults(
        (loss, repeat, swap) in (0u64..10, 0u64..10, 0u64..10),
        (seed, delay_ns) in (any::<u64>(), prop::sample::select(vec![0u64, 1_000_000, 400_000_000, 2_000_000_000])),
        size in 2u8..=127,
        lens in prop::collection::vec(5usize..1500, 1..4),
    ) {
        let fine = [
            Abort::TIMEOUT, Abort::COMMAND, Abort::CRC, Abort::SEQUENCE, Abort::BLOCK_SIZE,
            Abort::TOO_LONG, Abort::TOO_SHORT, Abort::TOGGLE,
        ];
        let faults = Faults { loss, repeat, swap, delay_ns, seed };
        transfers(faults, size, &lens, Mode::BlockOnly, &fine)?;
    }

    /// Whatever comes, the client neither panics nor waits for ever.
    #[test]
    fn any_answers(
        mode in prop::sample::select(vec![Mode::Auto, Mode::Segmented, Mode::Block, Mode::BlockOnly]),
        write in prop::option::of(0usize..300),
        frames in prop::collection::vec((any::<[u8; 8]>(), 0usize..40), 0..60),
    ) {
        let config = ClientConfig { max_value: 1000, ..ClientConfig::default() };
        let mut client = SdoClient::new(Channel::default_of(4), config);
        let mut out = Outbox::default();
        let options = Options { mode, ..Options::default() };
        match write {
            Some(len) => client.start_write(0, 0x2000, 0, &sample(len, 1), options, &mut out).unwrap(),
            None => client.start_read(0, 0x2000, 0, options, &mut out).unwrap(),
        }
        for (t_ns, (mut bytes, kind)) in frames.into_iter().enumerate() {
            const LIKELY: &[u8] = &[0x60, 0x20, 0x30, 0x41, 0x43, 0x00, 0x10, 0x01, 0xA4, 0xA2, 0xA1, 0xC6, 0xC1,
                0x01, 0x02, 0x03, 0x81, 0x82, 0x80];
            if let Some(&likely) = LIKELY.get(kind) {
                bytes[0] = likely;
            }
            if bytes[3] & 1 == 0 && bytes[0] & 0x80 == 0 || bytes[0] & 0xA0 == 0xA0 {
                (bytes[1], bytes[2], bytes[3]) = (0, 0x20, 0);
                (bytes[6], bytes[7]) = (0, 0);
            }
            client.on_frame(t_ns as u64, &CanFrame::classic(0x584, &bytes), &mut out);
            let (done, total) = client.progress();
            prop_assert!(done <= 1010 && total.is_none_or(|total| total <= 1000));
            prop_assert!(out.len() <= 130);
            out.drain().for_each(drop);
        }
        client.on_time(u64::MAX, &mut out);
        prop_assert!(!client.is_busy());
        prop_assert!(client.data().len() <= 1010);
    }
}
