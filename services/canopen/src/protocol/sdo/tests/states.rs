//! Every state of a transfer: left by an abort of either side, entered with sub-blocks of any size.

use super::server::dictionary;
use crate::protocol::abort::Abort;
use crate::protocol::io::Outbox;
use crate::protocol::od::{NoHooks, ObjectDictionary};
use crate::protocol::sdo::crc::crc16;
use crate::protocol::sdo::{
    ClientConfig, Finished, Mode, Options, SdoClient, SdoServer, ServerConfig, server_channel,
};
use ipc_types::payload::CanFrame;
use std::collections::VecDeque;

const LONG: u16 = 0x2000;

fn sample(len: usize) -> Vec<u8> {
    (0..len).map(|at| (at as u8).wrapping_mul(31) ^ (at >> 8) as u8).collect()
}

/// Client and server with a wire that keeps order and loses nothing.
struct Pair {
    od: ObjectDictionary,
    server: SdoServer,
    client: SdoClient,
    wire: VecDeque<(bool, CanFrame)>,
}

impl Pair {
    fn new(of_server: u8, of_client: u8) -> Self {
        let od = dictionary();
        let channel = server_channel(&od, 0).unwrap();
        let server = ServerConfig { block_size: of_server, ..ServerConfig::default() };
        let client = ClientConfig { block_size: of_client, ..ClientConfig::default() };
        Self {
            server: SdoServer::new(channel, server, &od),
            client: SdoClient::new(channel, client),
            wire: VecDeque::new(),
            od,
        }
    }
    fn put(&mut self, out: &mut Outbox, to_server: bool) {
        self.wire.extend(out.drain().map(|frame| (to_server, frame)));
    }
    fn start(&mut self, write: Option<&[u8]>, mode: Mode) {
        let mut out = Outbox::default();
        let options = Options { mode, ..Options::default() };
        match write {
            Some(data) => self.client.start_write(0, LONG, 0, data, options, &mut out).unwrap(),
            None => self.client.start_read(0, LONG, 0, options, &mut out).unwrap(),
        }
        self.put(&mut out, true);
    }
    /// One frame arrives; false: none is on its way.
    fn step(&mut self, finished: &mut Option<Finished>) -> bool {
        let Some((to_server, frame)) = self.wire.pop_front() else { return false };
        let mut out = Outbox::default();
        if to_server {
            self.server.on_frame(0, &frame, &mut self.od, &mut NoHooks, &mut out);
        } else if let Some(end) = self.client.on_frame(0, &frame, &mut out) {
            *finished = Some(end);
        }
        self.put(&mut out, !to_server);
        true
    }
    fn run(&mut self) -> Option<Finished> {
        let mut finished = None;
        while self.step(&mut finished) {}
        finished
    }
    fn whole(&mut self, data: &[u8]) {
        for mode in [Mode::Segmented, Mode::BlockOnly] {
            self.start(Some(data), mode);
            assert_eq!(self.run().map(|end| end.result), Some(Ok(data.len())), "{mode:?}");
            assert_eq!(self.od.bytes(LONG, 0), Some(data));
            self.start(None, mode);
            assert_eq!(self.run().map(|end| end.result), Some(Ok(data.len())), "{mode:?}");
            assert_eq!(self.client.data(), data);
            assert!(!self.server.is_busy() && !self.client.is_busy());
        }
    }
}

#[test]
fn values_that_fill_their_last_sub_block() {
    for (of_server, of_client) in [(127, 127), (127, 1), (1, 127), (2, 3), (126, 127)] {
        let mut pair = Pair::new(of_server, of_client);
        for size in [of_server, of_client] {
            for blocks in 1..=3 {
                let whole = usize::from(size) * 7 * blocks;
                for len in [whole - 1, whole, whole + 1].into_iter().filter(|len| *len <= 2000) {
                    pair.whole(&sample(len));
                }
            }
        }
    }
}

#[test]
fn a_transfer_can_be_left_in_every_state_by_either_side() {
    let data = sample(100);
    for (write, mode) in
        [(true, Mode::Segmented), (true, Mode::BlockOnly), (false, Mode::Segmented), (false, Mode::BlockOnly)]
    {
        for who in ["client", "server", "reset of the server"] {
            let mut ended = false;
            for steps in 0.. {
                let mut pair = Pair::new(4, 4);
                pair.od.set_bytes(LONG, 0, &data).unwrap();
                pair.start(write.then_some(&data[..]), mode);
                let mut finished = None;
                let taken = (0..steps).take_while(|_| pair.step(&mut finished)).count();
                if taken < steps {
                    assert!(finished.is_some(), "{mode:?} {who} {steps}");
                    ended = true;
                    break;
                }
                let what = format!("write {write} {mode:?}: {who} after {steps} frames");
                let mut out = Outbox::default();
                match who {
                    "client" => {
                        let end = pair.client.cancel(Abort::LOCAL_CONTROL, &mut out);
                        assert_eq!(end.is_some(), finished.is_none(), "{what}");
                        pair.put(&mut out, true);
                        assert_eq!(pair.run(), None, "{what}");
                        assert!(!pair.server.is_busy(), "{what}");
                    }
                    "server" if finished.is_none() => {
                        let bytes = [0x80, LONG as u8, (LONG >> 8) as u8, 0, 0, 0, 0, 8];
                        pair.wire.clear();
                        pair.server.reset();
                        pair.wire.push_back((false, CanFrame::classic(0x584, &bytes)));
                        let end = pair.run().unwrap();
                        assert_eq!(end.result.unwrap_err().abort, Abort::GENERAL, "{what}");
                    }
                    _ => {
                        // What the server gets of the rest makes no sense to it: it says so, or the client waits in vain.
                        pair.server.reset();
                        let _ = pair.run();
                        // An interrupted sub-block is acknowledged first; then both have waited long enough.
                        for _ in 0..2 {
                            if let Some(deadline) = pair.client.next_deadline() {
                                pair.client.on_time(deadline, &mut out);
                            }
                            pair.put(&mut out, true);
                            let _ = pair.run();
                            if let Some(deadline) = pair.server.next_deadline() {
                                pair.server.on_time(deadline, &mut out);
                            }
                        }
                        pair.wire.clear();
                    }
                }
                assert!(!pair.client.is_busy() && !pair.server.is_busy(), "{what}");
                pair.whole(&data);
            }
            assert!(ended);
        }
    }
}

/// Sizes that a receiver gives for the next sub-block, each time another.
const SIZES: [u8; 7] = [127, 1, 5, 126, 2, 127, 64];

#[test]
fn a_client_may_change_the_size_of_sub_blocks_with_every_acknowledge() {
    let data = sample(2000);
    let mut pair = Pair::new(127, 127);
    pair.od.set_bytes(LONG, 0, &data).unwrap();
    let mut ask = |bytes: [u8; 8]| {
        let mut out = Outbox::default();
        let frame = CanFrame::classic(0x604, &bytes);
        pair.server.on_frame(0, &frame, &mut pair.od, &mut NoHooks, &mut out);
        out.drain().collect::<Vec<_>>()
    };
    let init = ask([0xA4, LONG as u8, (LONG >> 8) as u8, 0, SIZES[0], 0, 0, 0]);
    assert_eq!(init[0].data[..8], [0xC6, 0, 0x20, 0, 0xD0, 7, 0, 0]);
    let mut segments = ask([0xA3, 0, 0, 0, 0, 0, 0, 0]);
    let (mut got, mut sizes) = (Vec::new(), SIZES.iter().cycle());
    let mut size = *sizes.next().unwrap();
    let end = loop {
        let whole = got.len() / 7 + segments.len() == 2000usize.div_ceil(7);
        assert!(segments.len() == usize::from(size) || whole, "{} of {size}", segments.len());
        for (at, segment) in segments.iter().enumerate() {
            assert_eq!(usize::from(segment.data[0] & 0x7F), at + 1);
            got.extend_from_slice(&segment.data[1..8]);
        }
        let last = segments.last().unwrap().data[0];
        size = *sizes.next().unwrap();
        let answer = ask([0xA2, last & 0x7F, size, 0, 0, 0, 0, 0]);
        if last & 0x80 != 0 {
            break answer[0].data;
        }
        segments = answer;
    };
    let unused = usize::from(end[0] >> 2 & 7);
    got.truncate(got.len() - unused);
    assert!(got == data);
    assert_eq!(u16::from_le_bytes([end[1], end[2]]), crc16(&data));
}

#[test]
fn a_server_may_change_the_size_of_sub_blocks_with_every_acknowledge() {
    let data = sample(2000);
    let mut pair = Pair::new(127, 127);
    let mut out = Outbox::default();
    let options = Options { mode: Mode::BlockOnly, ..Options::default() };
    pair.client.start_write(0, LONG, 0, &data, options, &mut out).unwrap();
    assert_eq!(out.drain().count(), 1);
    let mut answer = |bytes: [u8; 8]| {
        let mut out = Outbox::default();
        let end = pair.client.on_frame(0, &CanFrame::classic(0x584, &bytes), &mut out);
        (out.drain().collect::<Vec<_>>(), end)
    };
    let mut sizes = SIZES.iter().cycle();
    let mut size = *sizes.next().unwrap();
    let (mut segments, _) = answer([0xA4, LONG as u8, (LONG >> 8) as u8, 0, size, 0, 0, 0]);
    let mut got = Vec::new();
    let end = loop {
        let whole = got.len() / 7 + segments.len() == 2000usize.div_ceil(7);
        assert!(segments.len() == usize::from(size) || whole, "{} of {size}", segments.len());
        // Every third time the second half is confirmed to be lost.
        let taken = if got.len() % 3 == 0 { segments.len().div_ceil(2) } else { segments.len() };
        for segment in &segments[..taken] {
            got.extend_from_slice(&segment.data[1..8]);
        }
        let last = segments[taken - 1].data[0];
        size = *sizes.next().unwrap();
        let (next, _) = answer([0xA2, last & 0x7F, size, 0, 0, 0, 0, 0]);
        if last & 0x80 != 0 {
            break next[0].data;
        }
        segments = next;
    };
    got.truncate(got.len() - usize::from(end[0] >> 2 & 7));
    assert!(got == data);
    assert_eq!(u16::from_le_bytes([end[1], end[2]]), crc16(&data));
    let (_, finished) = answer([0xA1, 0, 0, 0, 0, 0, 0, 0]);
    assert_eq!(finished.map(|end| end.result), Some(Ok(2000)));
}
