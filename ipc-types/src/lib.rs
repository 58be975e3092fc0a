//! What travels on the rail of a dinrail stack.
//!
//! The rail is shared memory (iceoryx2). Every bus driver, protocol service, the PLC and the recorder is a
//! process of its own; this crate is all they have in common: payloads, topic names and depths, recorded
//! schemas, and the port helpers that stamp, number, count and validate. It depends on nothing of ours, and it
//! must never know what a service does with a message.
//!
//! A service crate exports `Config` (serde, `deny_unknown_fields`; the service's own table of the stack file,
//! without the keys of the launcher: name, kind, restart, priority, nice, cpus, memory_limit, hang_timeout) and
//! exactly these three functions:
//!
//! ```text
//! pub fn topics(config: &Config, neighbours: &Neighbours) -> Wiring;          // what it needs, pure
//! pub fn check(config: &Config, stack: &Stack, me: &ServiceEntry) -> Vec<Finding>;  // what is wrong, pure but for files
//! pub fn run(ctx: Context) -> Result<(), RunError>;                           // until ctx.shutdown_fd() is readable
//! ```
//!
//! How a service is built on it:
//!
//! ```no_run
//! use ipc_types::{Context, payload::CanFrame, reactor::{Reactor, Wake}};
//! # fn run(mut ctx: Context) -> Result<(), Box<dyn std::error::Error>> {
//! let mut rx = ctx.subscriber::<CanFrame>("can0/rx")?;      // copies out, validates, counts gaps
//! let mut tx = ctx.publisher::<CanFrame>("can0/tx")?;       // numbers, stamps, refuses when full
//! let mut inbox = ctx.inbox()?;                             // one per consumer: it rings
//! let mut reactor = Reactor::new()?;
//! let inbox_token = reactor.add(inbox.fd())?;
//! let tick = reactor.add_timer(std::time::Duration::from_millis(100))?;
//! let stop = reactor.add(ctx.shutdown_fd())?;
//! ctx.ready();                                              // the launcher waits for this
//! loop {
//!     for wake in reactor.wait(None)?.to_vec() {
//!         if wake == stop { return Ok(()); }
//!         if wake == inbox_token {
//!             inbox.drain();                                // takes all rings; then look at every topic
//!             rx.drain(256, |frame, _tail| { let _ = frame.can_id; });
//!         }
//!         if wake == tick { ctx.beat(); }                   // from the thread that does the work
//!     }
//! }
//! # }
//! ```
//!
//! Module by module: [`payload`] the messages; [`topic`] the one table of topics; [`wiring`] what a service
//! declares before it runs; [`stack`] the resolved stack every process reads; [`plc_table`] what others read of a
//! plc's keys; [`rail`] joining and creating the
//! rail; [`port`] publishers and subscribers; [`inbox`] wake-ups; [`reactor`] waiting for descriptors and
//! clocks; [`context`] what `run` receives; [`image_write`] and [`scan_record`] the two binary codecs;
//! for field services [`inputs`] publishes, [`outputs`] says when outputs follow the image, [`can_queue`] holds frames
//! that wait for a driver, [`turns`] is the loop; [`event`] what happened; [`units`] and [`net`] values of the stack file. With the
//! feature `testing` a module of that name makes a rail for tests.

pub mod can_queue;
pub mod clock;
pub mod context;
pub mod event;
pub mod image_write;
pub mod inbox;
pub mod inputs;
pub mod net;
pub mod outputs;
pub mod payload;
pub mod plc_table;
pub mod port;
pub mod rail;
pub mod reactor;
pub mod reserve;
pub mod scan_record;
pub mod stack;
#[cfg(feature = "testing")]
pub mod testing;
pub mod topic;
pub mod turns;
pub mod units;
pub mod wiring;

pub use context::Context;
pub use stack::{Finding, Stack};
pub use wiring::Wiring;
