//! No ring is ever lost, however many writers ring at once and however the consumer waits: each writes a number, rings,
//! and waits until the consumer, which looks only when its inbox rang, has seen it. One test function, because a process
//! belongs to one rail for its whole life.
#![allow(clippy::unwrap_used, reason = "a test may end like this")]

use ipc_types::Wiring;
use ipc_types::payload::CanFrame;
use ipc_types::testing::{PATIENCE, TestRail, join, service, topic, wait};
use ipc_types::topic::TopicKind;
use rustix::buffer::spare_capacity;
use rustix::event::{Timespec, epoll};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::{Duration, Instant};

const WRITERS: usize = 4;
const ROUNDS: u32 = 200_000;

#[test]
fn no_ring_is_lost() {
    let names = ["reader", "w0", "w1", "w2", "w3"];
    let rail = TestRail::new(
        "wakeups",
        names.iter().map(|name| service(name, "test", serde_json::Value::Null, Wiring::default())).collect(),
        vec![topic(TopicKind::CanTx, "can0").wakes("reader")],
    );
    assert_eq!(lost(rail.root(), epoll::EventFlags::IN), 0, "told as long as something waits");
    // As tokio waits.
    assert_eq!(
        lost(rail.root(), epoll::EventFlags::IN | epoll::EventFlags::ET),
        0,
        "told of each arrival once"
    );
}

/// Writers that waited in vain.
fn lost(root: &Path, told: epoll::EventFlags) -> u32 {
    let written: [AtomicU32; WRITERS] = std::array::from_fn(|_| AtomicU32::new(0));
    let seen: [AtomicU32; WRITERS] = std::array::from_fn(|_| AtomicU32::new(0));
    let (lost, done) = (AtomicU32::new(0), AtomicU32::new(0));
    let (listening, over) = (AtomicBool::new(false), AtomicBool::new(false));
    std::thread::scope(|scope| {
        let consumer = scope.spawn(|| {
            let ctx = join(root, "reader", BTreeMap::new());
            let mut inbox = ctx.inbox().unwrap();
            let ring = epoll::create(epoll::CreateFlags::CLOEXEC).unwrap();
            epoll::add(&ring, inbox.fd(), epoll::EventData::new_u64(0), told).unwrap();
            let mut events = Vec::with_capacity(1);
            listening.store(true, Ordering::SeqCst);
            while !over.load(Ordering::SeqCst) {
                // The time only ends the test.
                events.clear();
                let half_a_second = Timespec { tv_sec: 0, tv_nsec: 500_000_000 };
                if epoll::wait(&ring, spare_capacity(&mut events), Some(&half_a_second)).unwrap() > 0 {
                    inbox.drain();
                    for (seen, written) in seen.iter().zip(&written) {
                        seen.store(written.load(Ordering::SeqCst), Ordering::SeqCst);
                    }
                }
            }
        });
        wait("the consumer", || listening.load(Ordering::SeqCst).then_some(()));
        for i in 0..WRITERS {
            let (written, seen, lost, done) = (&written[i], &seen[i], &lost, &done);
            scope.spawn(move || {
                let mut ctx = join(root, &format!("w{i}"), BTreeMap::new());
                let port = ctx.publisher::<CanFrame>("can0/tx").unwrap();
                for n in 1..=ROUNDS {
                    written.store(n, Ordering::SeqCst);
                    // A moment later in every round, and sometimes twice: so that rings meet in every way.
                    for _ in 0..n % 61 {
                        std::hint::spin_loop();
                    }
                    for _ in 0..=n % 3 / 2 {
                        port.ring();
                    }
                    let end = Instant::now() + PATIENCE / 12;
                    while seen.load(Ordering::SeqCst) < n {
                        if Instant::now() > end {
                            lost.fetch_add(1, Ordering::SeqCst);
                            done.fetch_add(1, Ordering::SeqCst);
                            return;
                        }
                        std::thread::yield_now();
                    }
                }
                done.fetch_add(1, Ordering::SeqCst);
            });
        }
        while done.load(Ordering::SeqCst) < WRITERS as u32 {
            std::thread::sleep(Duration::from_millis(10));
        }
        over.store(true, Ordering::SeqCst);
        consumer.join().unwrap();
    });
    lost.into_inner()
}
