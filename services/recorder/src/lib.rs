//! Recording and replay.
//!
//! The recorder reads every recorded topic of a stack and writes it into MCAP files that python's `mcap`, the
//! `mcap` command, Foxglove and PlotJuggler read without our code: the bytes of a message in shared memory are
//! its bytes in the file. It must never disturb the stack: it owns no queue that a writer could wait for, it has
//! no inbox, and a slow or full disk costs messages of the recording, counted, and nothing else.
//!
//! Module by module: [`format`] what stands in a file; [`batch`] messages on their way from the rail to the
//! writer; [`writer`] the thread that writes, rotates and stops when the disk is full; [`file`] one MCAP file;
//! [`disk`] names, locks, free space; `shelf` what lies in the folder, and the quota; [`service`] the process; [`reader`] reading any recording, whole or cut
//! off at any byte; [`seal`] making a cut-off file whole; [`mod@info`] and [`mod@cat`] what `dinrail recordings` shows;
//! [`scan`] the messages a verifier needs; [`replay`] a recording in a bus driver's place.

pub mod batch;
pub mod cat;
pub mod config;
pub mod disk;
pub mod file;
pub mod format;
pub mod info;
mod item;
pub mod reader;
mod record;
pub mod replay;
pub mod ros1;
pub mod scan;
pub mod seal;
pub mod service;
mod shelf;
mod sink;
mod sync;
#[cfg(test)]
mod testing;
pub mod utc;
pub mod writer;

pub use cat::{CatError, Filter, Format, cat};
pub use config::{Compression, Config, check, topics};
pub use info::{Info, info};
pub use reader::{ReadError, Recording};
pub use scan::{ScanMessage, scan_contents};
pub use seal::{Report, SealError, recover};
pub use service::{RunError, run};
