//! SDO transfers of the master: one at a time and node, the others wait in their node's queue. Sans-I/O.

use super::boot::SdoEnd;
use crate::protocol::abort::Abort;
use crate::protocol::io::Outbox;
use crate::protocol::sdo::{Channel, ClientConfig, Direction, Failure, Finished, Mode, Options, SdoClient};
use ipc_types::payload::CanFrame;
use std::collections::VecDeque;

/// Transfers that wait for one node; more are refused.
pub const MAX_QUEUE: usize = 32;
/// Ends that nobody took yet; the oldest is dropped, because who asked is gone.
const MAX_ENDS: usize = 256;

/// Writes by block that are under way at once, to different nodes. Their sub-blocks of 127 segments together have room in
/// a driver's queue (`tx_queue`, 512), which sorts by priority: more would stand before SYNC, NMT and PDOs, and the bus is no
/// faster for them.
pub const LONG_WRITES: usize = 3;

/// A job that boot-ups interrupt for longer than this fails: its node does not come back.
const INTERRUPTED_NS: u64 = 20_000_000_000;

/// Who asked for a transfer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Owner {
    /// The boot-up of the node; it goes before jobs.
    Boot,
    /// A job, by the number its caller gave.
    Job(u64),
}

/// A transfer of a job.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Request {
    pub index: u16,
    pub sub: u8,
    /// Data to write; `None` reads.
    pub data: Option<Vec<u8>>,
    pub owner: Owner,
    pub options: Options,
}

impl Request {
    /// It may go by block, and then sends whole sub-blocks at once.
    fn is_long_write(&self) -> bool {
        let threshold = match self.options.mode {
            Mode::Auto => ClientConfig::default().auto_block,
            Mode::Block | Mode::BlockOnly => 0,
            Mode::Segmented => return false,
        };
        self.data.as_ref().is_some_and(|data| data.len() >= threshold)
    }
}

/// How a job's transfer ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct JobEnd {
    pub job: u64,
    pub node: u8,
    pub index: u16,
    pub sub: u8,
    pub direction: Direction,
    /// Bytes transferred.
    pub bytes: usize,
    /// Data read, empty after a write.
    pub result: Result<Vec<u8>, Failure>,
}

#[derive(Debug)]
struct Slot {
    node: u8,
    client: SdoClient,
    queue: VecDeque<Request>,
    current: Option<Request>,
    /// Job that a boot-up interrupted, and when first.
    interrupted: Option<(Owner, u64)>,
}

/// See the module.
#[derive(Debug)]
pub struct Transfers {
    slots: Vec<Slot>,
    place: [u8; 128],
    boot_ends: VecDeque<(u8, SdoEnd)>,
    job_ends: VecDeque<JobEnd>,
    /// Transfers that were refused because their node's queue was full.
    pub refused: u64,
}

const NOWHERE: u8 = u8::MAX;

impl Transfers {
    /// One client a node: node-id and its time-out.
    pub fn new(nodes: impl IntoIterator<Item = (u8, u64)>) -> Self {
        let mut all = Self {
            slots: Vec::new(),
            place: [NOWHERE; 128],
            boot_ends: VecDeque::with_capacity(MAX_ENDS),
            job_ends: VecDeque::with_capacity(MAX_ENDS),
            refused: 0,
        };
        for (node, timeout_ns) in nodes {
            all.add(node, timeout_ns);
        }
        all
    }

    /// Adds a node that is not there yet: jobs may talk to nodes that no stack file names.
    pub fn add(&mut self, node: u8, timeout_ns: u64) {
        let id = usize::from(node);
        if !(1..128).contains(&id) || self.place[id] != NOWHERE {
            return;
        }
        self.place[id] = self.slots.len() as u8;
        let config = ClientConfig { timeout_ns, ..ClientConfig::default() };
        let client = SdoClient::new(Channel::default_of(node), config);
        let queue = VecDeque::with_capacity(MAX_QUEUE);
        self.slots.push(Slot { node, client, queue, current: None, interrupted: None });
    }

    fn slot(&mut self, node: u8) -> Option<&mut Slot> {
        let at = *self.place.get(usize::from(node))?;
        self.slots.get_mut(usize::from(at))
    }

    pub fn read(&mut self, now_ns: u64, node: u8, index: u16, sub: u8, owner: Owner, out: &mut Outbox) {
        let request = Request { index, sub, data: None, owner, options: Options::default() };
        self.ask(now_ns, node, request, out);
    }

    #[expect(clippy::too_many_arguments, reason = "object, value and who asks")]
    pub fn write(
        &mut self,
        now_ns: u64,
        node: u8,
        index: u16,
        sub: u8,
        data: Vec<u8>,
        owner: Owner,
        out: &mut Outbox,
    ) {
        let request = Request { index, sub, data: Some(data), owner, options: Options::default() };
        self.ask(now_ns, node, request, out);
    }

    /// Queues a transfer; false when the node's queue is full or the node is not known.
    pub fn ask(&mut self, now_ns: u64, node: u8, request: Request, out: &mut Outbox) -> bool {
        let Some(slot) = self.slot(node) else { return false };
        if slot.queue.len() >= MAX_QUEUE && request.owner != Owner::Boot {
            self.refused += 1;
            return false;
        }
        if request.owner == Owner::Boot {
            slot.queue.push_front(request);
            // A job may take minutes, and the node stands still until it is booted: the job begins again afterwards.
            if let Some(job) = slot.current.take_if(|r| r.owner != Owner::Boot) {
                slot.client.cancel(Abort::LOCAL_CONTROL, out);
                let first = slot.interrupted.filter(|(owner, _)| *owner == job.owner);
                let (_, since_ns) = *slot.interrupted.insert(first.unwrap_or((job.owner, now_ns)));
                if now_ns.saturating_sub(since_ns) < INTERRUPTED_NS {
                    slot.queue.insert(1, job);
                } else {
                    // A node that is away is tried for ever; who waits for the job is not kept waiting.
                    self.gave_up(node, &job);
                }
            }
        } else {
            slot.queue.push_back(request);
        }
        self.next(now_ns, node, out);
        true
    }

    /// Ends a job that boot-ups interrupted for too long.
    fn gave_up(&mut self, node: u8, request: &Request) {
        let Owner::Job(job) = request.owner else { return };
        let direction = if request.data.is_some() { Direction::Write } else { Direction::Read };
        let result = Err(Failure { abort: Abort::TIMEOUT, by: crate::protocol::sdo::By::Client });
        if self.job_ends.len() == MAX_ENDS {
            self.job_ends.pop_front();
        }
        let Request { index, sub, .. } = *request;
        self.job_ends.push_back(JobEnd { job, node, index, sub, direction, bytes: 0, result });
    }

    /// Gives up what an owner asked of a node, without telling it.
    pub fn cancel(&mut self, node: u8, owner: Owner) {
        let Some(slot) = self.slot(node) else { return };
        slot.queue.retain(|r| r.owner != owner);
        if slot.current.as_ref().is_some_and(|r| r.owner == owner) {
            slot.client.reset();
            slot.current = None;
        }
        if owner == Owner::Boot {
            self.boot_ends.retain(|(of, _)| *of != node);
        }
    }

    /// Starts the next transfer of an idle node. A long write waits while [`LONG_WRITES`] are under way; then
    /// [`Self::on_time`] comes back to it.
    fn next(&mut self, now_ns: u64, node: u8, out: &mut Outbox) {
        let is_long = |request: Option<&Request>| request.is_some_and(Request::is_long_write);
        let long = self.slots.iter().filter(|slot| is_long(slot.current.as_ref())).count();
        let Some(slot) = self.slot(node) else { return };
        if slot.current.is_some() || (long >= LONG_WRITES && is_long(slot.queue.front())) {
            return;
        }
        let Some(request) = slot.queue.pop_front() else { return };
        let Request { index, sub, options, .. } = request;
        let (direction, started) = match &request.data {
            Some(data) => (Direction::Write, slot.client.start_write(now_ns, index, sub, data, options, out)),
            None => (Direction::Read, slot.client.start_read(now_ns, index, sub, options, out)),
        };
        slot.current = Some(request);
        if started.is_err() {
            let failure = Failure { abort: Abort::MEMORY, by: crate::protocol::sdo::By::Client };
            self.ended(now_ns, node, Finished { index, sub, direction, result: Err(failure) }, out);
        }
    }

    fn ended(&mut self, now_ns: u64, node: u8, finished: Finished, out: &mut Outbox) {
        let Some(slot) = self.slot(node) else { return };
        let owner = slot.current.take().map(|r| r.owner);
        let Finished { index, sub, direction, result } = finished;
        let bytes = result.unwrap_or(0);
        let result = result.map(|n| match direction {
            Direction::Read => slot.client.data().get(..n).unwrap_or_default().to_vec(),
            Direction::Write => Vec::new(),
        });
        match owner {
            Some(Owner::Boot) => {
                let end = match result {
                    Ok(data) if direction == Direction::Read => SdoEnd::Read(data),
                    Ok(_) => SdoEnd::Written,
                    Err(failure) if failure.is_timeout() => SdoEnd::Timeout,
                    Err(failure) => SdoEnd::Abort(failure.abort.0),
                };
                self.boot_ends.push_back((node, end));
            }
            Some(Owner::Job(job)) => {
                if self.job_ends.len() == MAX_ENDS {
                    self.job_ends.pop_front();
                }
                self.job_ends.push_back(JobEnd { job, node, index, sub, direction, bytes, result });
            }
            None => {}
        }
        self.next(now_ns, node, out);
    }

    /// A frame of a node's SDO server, 580h + node-id.
    pub fn on_frame(&mut self, t_ns: u64, node: u8, frame: &CanFrame, out: &mut Outbox) {
        let Some(slot) = self.slot(node) else { return };
        if let Some(finished) = slot.client.on_frame(t_ns, frame, out) {
            self.ended(t_ns, node, finished, out);
        }
    }

    pub fn on_time(&mut self, now_ns: u64, out: &mut Outbox) {
        for i in 0..self.slots.len() {
            let slot = &mut self.slots[i];
            let node = slot.node;
            if slot.current.is_none() {
                if !slot.queue.is_empty() {
                    self.next(now_ns, node, out);
                }
                continue;
            }
            if let Some(finished) = slot.client.on_time(now_ns, out) {
                self.ended(now_ns, node, finished, out);
            }
        }
    }

    pub fn next_deadline(&self) -> Option<u64> {
        self.slots.iter().filter(|s| s.current.is_some()).filter_map(|s| s.client.next_deadline()).min()
    }

    /// The next transfer of a boot-up that ended.
    pub fn take_boot_end(&mut self) -> Option<(u8, SdoEnd)> {
        self.boot_ends.pop_front()
    }
    /// The next transfer of a job that ended.
    pub fn take_job_end(&mut self) -> Option<JobEnd> {
        self.job_ends.pop_front()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::master::testing::dictionary;
    use crate::protocol::data_type::DataType;
    use crate::protocol::od::{Access, EntryDef, NoHooks, OdBuilder};
    use crate::protocol::sdo::{SdoServer, ServerConfig};

    #[test]
    fn a_boot_up_goes_before_a_job_that_begins_again_afterwards() {
        let mut od = dictionary(5);
        let mut server = SdoServer::new(Channel::default_of(5), ServerConfig::default(), &od);
        let mut transfers = Transfers::new([(5, 1_000_000)]);
        let mut out = Outbox::default();
        let job = |n| Request {
            index: 0x2000,
            sub: 0,
            data: Some(vec![n, 0, 0, 0]),
            owner: Owner::Job(u64::from(n)),
            options: Options::default(),
        };
        assert!(transfers.ask(0, 5, job(1), &mut out) && transfers.ask(0, 5, job(2), &mut out));
        transfers.read(1, 5, 0x1000, 0, Owner::Boot, &mut out);
        let mut order = Vec::new();
        for _ in 0..10 {
            let mut answers = Outbox::default();
            for frame in out.drain().collect::<Vec<_>>() {
                server.on_frame(2, &frame, &mut od, &mut NoHooks, &mut answers);
            }
            for frame in answers.drain().collect::<Vec<_>>() {
                transfers.on_frame(2, 5, &frame, &mut out);
            }
            while let Some((_, end)) = transfers.take_boot_end() {
                assert!(matches!(end, SdoEnd::Read(_)), "{end:?}");
                order.push(0);
            }
            while let Some(end) = transfers.take_job_end() {
                assert_eq!(end.result, Ok(Vec::new()));
                order.push(end.job);
            }
        }
        assert_eq!(order, [0, 1, 2]);
    }

    #[test]
    fn few_long_writes_at_once_and_the_others_in_their_turn() {
        let mut transfers = Transfers::new((1..=6).map(|node| (node, 1_000_000)));
        let mut out = Outbox::default();
        let mut servers: Vec<_> = (1..=6)
            .map(|node| {
                let mut b = OdBuilder::new();
                b.var(0x2000, EntryDef::new(DataType::Domain, Access::Rw).capacity(1 << 16));
                let od = b.build(node).unwrap();
                (SdoServer::new(Channel::default_of(node), ServerConfig::default(), &od), od)
            })
            .collect();
        let value: Vec<u8> = (0..20_000u32).map(|i| (i % 251) as u8).collect();
        for node in 1..=6 {
            let request = Request {
                index: 0x2000,
                sub: 0,
                data: Some(value.clone()),
                owner: Owner::Job(node.into()),
                options: Options::default(),
            };
            assert!(transfers.ask(0, node, request, &mut out));
        }
        // A short one does not wait for long ones of others.
        transfers.read(0, 6, 0x2000, 0, Owner::Boot, &mut out);
        let (mut ended, mut now_ns) = (0, 0);
        while ended < 6 {
            assert!(out.len() <= LONG_WRITES * 127 + 1 && out.dropped == 0, "{} frames at once", out.len());
            let mut answers = Outbox::default();
            for frame in out.drain().collect::<Vec<_>>() {
                for (server, od) in &mut servers {
                    server.on_frame(now_ns, &frame, od, &mut NoHooks, &mut answers);
                }
            }
            for frame in answers.drain().collect::<Vec<_>>() {
                transfers.on_frame(now_ns, (frame.id() & 0x7F) as u8, &frame, &mut out);
            }
            while let Some(end) = transfers.take_job_end() {
                assert_eq!((end.result, end.bytes), (Ok(Vec::new()), value.len()));
                ended += 1;
            }
            now_ns += 1000;
            assert!(now_ns < 1_000_000_000, "stuck with {ended} of 6");
            transfers.on_time(now_ns, &mut out);
        }
        assert!(transfers.take_boot_end().is_some());
        assert!(servers.iter().all(|(_, od)| od.bytes(0x2000, 0) == Some(&value[..])));
    }

    #[test]
    fn a_job_for_a_node_that_stays_away_fails() {
        let mut transfers = Transfers::new([(5, 2_000_000_000)]);
        let mut out = Outbox::default();
        let request =
            |owner| Request { index: 0x2000, sub: 0, data: None, owner, options: Options::default() };
        assert!(transfers.ask(0, 5, request(Owner::Job(7)), &mut out));
        // The boot-up tries every second, before the job's time is over.
        let mut ended = None;
        for second in 1..60u64 {
            let now_ns = second * 1_000_000_000;
            transfers.cancel(5, Owner::Boot);
            transfers.next(now_ns, 5, &mut out);
            assert!(transfers.ask(now_ns, 5, request(Owner::Boot), &mut out));
            out.drain().for_each(drop);
            ended = transfers.take_job_end();
            if ended.is_some() {
                break;
            }
        }
        let end = ended.unwrap();
        assert_eq!(end.job, 7);
        assert!(end.result.is_err_and(|failure| failure.is_timeout()));
        assert!(transfers.take_job_end().is_none() && transfers.slots[0].queue.is_empty());
    }

    #[test]
    fn a_full_queue_refuses_jobs_and_never_a_boot_up() {
        let mut transfers = Transfers::new([(5, 1_000_000)]);
        let mut out = Outbox::default();
        let job = |n| Request {
            index: 0x2000,
            sub: 0,
            data: None,
            owner: Owner::Job(n),
            options: Options::default(),
        };
        let taken = (0..100).filter(|&n| transfers.ask(0, 5, job(n), &mut out)).count();
        assert_eq!((taken, transfers.refused), (MAX_QUEUE + 1, 99 - MAX_QUEUE as u64));
        assert!(transfers.ask(0, 5, Request { owner: Owner::Boot, ..job(0) }, &mut out));
        assert!(!transfers.ask(0, 6, job(0), &mut out));
    }
}
