//! The master: units on lines are polled into %I, follow %Q and %M, and answer jobs of anybody.
//!
//! Three storeys: [`config`] and [`plan`] resolve the stack file; [`line`] schedules one line, [`image`] turns
//! answers into inputs and outputs into requests, [`ask`] jobs into requests, all in virtual time and without I/O;
//! [`port`] and [`link`] are the transports, [`service`] the process.
//!
//! What may never happen here: two requests in flight on a line, a job without an end, an answer to one request
//! taken for that to another, an output written from an image that is too old to be true.

pub(crate) mod alarm;
pub mod ask;
pub mod config;
pub mod image;
pub mod line;
mod link;
pub mod order;
pub mod plan;
pub mod port;
mod service;
pub(crate) mod unit_row;
pub(crate) mod wiring;

pub use config::Config;
pub use service::{KIND, RunError, run};
pub use wiring::{check, topics};
