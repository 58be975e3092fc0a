//! LSS of a master (CiA 305 V3.0): calls of one or many services, one call at a time. Sans-I/O.
//!
//! [`LssLine`] carries out one [`LssCall`]; the command line uses it on a bus of its own. [`LssJobs`] is the queue in
//! front of it, inside of a running master.

mod call;
mod queue;
mod run;
#[cfg(test)]
mod tests;

pub use call::{LssCall, MAX_ASSIGNED};
pub use queue::{LssJobs, MAX_CALLS, QueueFull};
pub use run::{LssError, LssLine, LssOutcome};
