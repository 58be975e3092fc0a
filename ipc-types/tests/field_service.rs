//! The parts of a field service on a real rail: its turns, its inputs, the image it follows, frames for a driver. One
//! test function, because a process belongs to one rail for its whole life.
#![allow(clippy::unwrap_used, clippy::panic)]

use ipc_types::can_queue::{CanQueue, Handed};
use ipc_types::event::Level;
use ipc_types::inputs::InputsPort;
use ipc_types::outputs::{Guard, OutputImage, SafeOn, Unsafe, Words};
use ipc_types::payload::{CanFrame, Image, Inputs, PlcState};
use ipc_types::testing::{TestRail, service, topic};
use ipc_types::topic::TopicKind;
use ipc_types::turns::{STATUS_BEATS, Turn, Turns};
use ipc_types::units::Span;
use ipc_types::{Context, Wiring, clock};
use std::io::Write;
use std::os::fd::AsFd;
use std::os::unix::net::UnixStream;

/// Turns until one is as wanted; how many status turns came on the way.
fn until(turns: &mut Turns, mut wanted: impl FnMut(Turn) -> bool) -> u32 {
    let mut statuses = 0;
    loop {
        let turn = turns.wait().unwrap();
        turns.drain();
        statuses += u32::from(turn.status);
        assert!(!turn.status || turn.beat, "a status comes with a beat");
        if wanted(turn) {
            return statuses;
        }
    }
}

fn image(state: PlcState, q: &[u8]) -> Image {
    Image { scan: 1, state: state as u32, output_bytes: q.len() as u32, ..Image::default() }
}

fn turns_come_and_end(ctx: &mut Context) {
    let (stop, mut ender) = UnixStream::pair().unwrap();
    let mut turns = Turns::new(ctx.inbox().unwrap(), stop.as_fd()).unwrap();
    let mut beats = 0;
    let statuses = until(&mut turns, |turn| {
        beats += u32::from(turn.beat);
        beats == 2 * STATUS_BEATS
    });
    assert_eq!(statuses, 2);
    // A topic rings, and so does the alarm: neither is a beat. Drained, the inbox is silent.
    let bell = ctx.publisher::<Image>("plc/image").unwrap();
    bell.ring();
    until(&mut turns, |turn| turn == Turn::default());
    turns.come_again(Some(1)).unwrap();
    turns.come_again(None).unwrap();
    until(&mut turns, |turn| turn == Turn::default());
    ender.write_all(&[1]).unwrap();
    until(&mut turns, |turn| turn.stop);
}

fn inputs_are_repeated(ctx: &mut Context) {
    let mut none = InputsPort::new(None);
    none.publish(Inputs::default(), &[], true);
    assert!(!none.is_open() && !none.is_due(u64::MAX));
    let mut reader = ctx.subscriber::<Inputs>("io/inputs").unwrap();
    let mut port = InputsPort::new(Some(ctx.publisher("io/inputs").unwrap()));
    assert!(port.is_open() && port.is_due(clock::mono_ns()), "the first is due at once");
    let before_ns = clock::mono_ns();
    port.publish(Inputs { ranges: 1, ..Inputs::default() }, &[7, 0], true);
    assert!(!port.is_due(before_ns + 80_000_000));
    assert!(port.is_due(clock::mono_ns() + 100_000_000));
    let mut tails = Vec::new();
    reader.drain(10, |header, tail| tails.push((header.ranges, tail.to_vec())));
    assert_eq!(tails, [(1, vec![7, 0])]);
}

fn outputs_follow_the_newest_image(ctx: &mut Context) {
    let mut plc = ctx.publisher::<Image>("plc/image").unwrap();
    let guard = Guard::new(Span::from_ms(60_000), &SafeOn::ALL);
    let mut outputs = OutputImage::new(Some(ctx.subscriber("plc/image").unwrap()), guard);
    let mut followed = Vec::new();
    assert_eq!(outputs.take(|_, _| panic!("nothing came yet")), None);
    assert_eq!(outputs.why(), Some(Unsafe::Waiting));
    plc.send_tail(image(PlcState::Run, &[1]), &[1]).unwrap();
    plc.send_tail(image(PlcState::Run, &[2]), &[2]).unwrap();
    let change = outputs.take(|q, m| followed.push((q.to_vec(), m.len()))).unwrap();
    assert_eq!((change.was, change.why), (Some(Unsafe::Waiting), None));
    assert_eq!(followed, [(vec![2], 0)]);
    assert!(outputs.next_deadline().is_some_and(|at_ns| at_ns > clock::mono_ns()));
    // Lengths that disagree: as if it had not come.
    plc.send_tail(image(PlcState::Run, &[2, 3]), &[2]).unwrap();
    assert_eq!(outputs.take(|_, _| panic!("it is malformed")), None);
    plc.send_tail(image(PlcState::Halted, &[3]), &[3]).unwrap();
    let change = outputs.take(|_, _| panic!("it is halted")).unwrap();
    assert_eq!(outputs.why(), Some(Unsafe::Halted));
    let mut events = ctx.raw_subscriber("stack/events").unwrap();
    change.tell(ctx, &Words::OUTPUTS);
    let mut told = Vec::new();
    events.drain_raw(10, &mut |_, _, tail| {
        told.push(serde_json::from_slice::<ipc_types::event::EventBody>(tail).unwrap());
    });
    assert_eq!(told.len(), 1);
    assert_eq!(told[0].message, "outputs went to their safe state: the PLC is halted at a breakpoint");
    assert_eq!((told[0].level, &told[0].detail["why"]), (Level::Info, &serde_json::json!("halted")));
}

fn frames_wait_for_room_at_the_driver(ctx: &mut Context) {
    let mut tx = ctx.publisher::<CanFrame>("can0/tx").unwrap();
    let mut queue = CanQueue::new(8);
    queue.add((1..=6).map(|id| CanFrame::classic(id, &[])));
    assert!(!tx.has_reader());
    let mut driver = ctx.subscriber::<CanFrame>("can0/tx").unwrap();
    let (mut sent, mut got) = (Vec::new(), Vec::new());
    assert!(tx.has_reader());
    assert_eq!(queue.send(&mut tx, |frame| sent.push(frame.id())), Ok(Handed::On));
    assert_eq!((sent.as_slice(), queue.len()), (&[1, 2, 3, 4][..], 2), "the driver's queue has a depth of 4");
    driver.drain(10, |frame, _| got.push(frame.id()));
    assert_eq!(queue.send(&mut tx, |_| {}), Ok(Handed::On));
    driver.drain(10, |frame, _| got.push(frame.id()));
    assert_eq!((got, queue.is_empty()), (vec![1, 2, 3, 4, 5, 6], true));
    drop(driver);
    assert!(!tx.has_reader());
    queue.add([CanFrame::classic(7, &[])]);
    assert_eq!(queue.send(&mut tx, |_| {}), Ok(Handed::Dropped));
    assert_eq!(queue.dropped(), 1);
}

#[test]
fn a_field_service_has_turns_inputs_outputs_and_a_queue() {
    let rail = TestRail::new(
        "fieldtest",
        vec![service("io", "test", serde_json::Value::Null, Wiring::default())],
        vec![
            topic(TopicKind::CanTx, "can0").depth(4),
            topic(TopicKind::Inputs, "io"),
            topic(TopicKind::Image, "plc").wakes("io"),
        ],
    );
    let mut ctx = rail.context("io");
    turns_come_and_end(&mut ctx);
    inputs_are_repeated(&mut ctx);
    outputs_follow_the_newest_image(&mut ctx);
    frames_wait_for_room_at_the_driver(&mut ctx);
}
