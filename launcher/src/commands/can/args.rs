//! Arguments of `dinrail can`.

use crate::cli::Which;
use clap::{Args, Subcommand, ValueEnum};
use ipc_types::units::Span;
use std::path::PathBuf;

/// What a reader of the bus may not expect of frames that the stack's own driver sends.
const OWN_FRAMES: &str = "These are frames of the stack: `can-io` inputs take them with `echo = true` only. Frames of another \
    node (a client of `serve`, a `feed`, a device) reach them always.";

#[derive(Debug, Subcommand)]
pub enum CanCommand {
    /// Print frames as they are on the bus; several buses in order of time
    Dump(DumpArgs),
    /// Send frames and wait until they were on the bus
    #[command(after_help = OWN_FRAMES)]
    Send(SendArgs),
    /// Make frames, as many and as fast as wanted
    #[command(after_help = OWN_FRAMES)]
    Gen(GenArgs),
    /// Send a log or a recording to a bus, in its order and with its timing
    #[command(after_help = OWN_FRAMES)]
    Replay(ReplayArgs),
    /// Rates of buses and identifiers, load, errors
    Stats(StatsArgs),
    /// One line an identifier, with the bytes that change
    Sniff(SniffArgs),
}

/// Which frames.
#[derive(Debug, Clone, Args)]
pub struct FilterArgs {
    /// 123, 123:7F0 (identifier:mask), 123~7F0 (all others), 100-1FF, 18FEF100, a name as `can dump` shows it (Speed,
    /// "TPDO1 5", "SDO 5", heartbeat, "node 5"), #error, #rtr, #fd, #ext, #tx, #rx; ! in front turns it round; several:
    /// any that fits and none that is turned round
    #[arg(long = "filter", value_name = "FILTER", value_delimiter = ',', allow_hyphen_values = true)]
    pub filter: Vec<String>,
}

/// Whether to use colours.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Color {
    /// On a terminal, unless NO_COLOR is set
    Auto,
    Always,
    Never,
}

#[derive(Debug, Args)]
pub struct DumpArgs {
    /// CAN services of the stack; all of them when left out, or `all`
    #[arg(value_name = "BUS")]
    pub buses: Vec<String>,
    #[command(flatten)]
    pub filter: FilterArgs,
    /// Stop after so many frames
    #[arg(long, short = 'n')]
    pub count: Option<u64>,
    /// Stop after so long
    #[arg(long = "for", value_name = "DURATION")]
    pub duration: Option<Span>,
    /// Stop when no frame came for so long
    #[arg(long, value_name = "DURATION")]
    pub silence: Option<Span>,
    /// Also write every frame shown to a file, as `candump -L` does; `-` prints such lines instead
    #[arg(long, value_name = "FILE")]
    pub log: Option<PathBuf>,
    /// Show frames as for a terminal, whatever the output is
    #[arg(long)]
    pub screen: bool,
    /// Print `candump -L` lines, as is done when the output is no terminal
    #[arg(long = "lines", conflicts_with_all = ["screen", "absolute", "delta", "since_start", "ascii"])]
    pub log_lines: bool,
    /// `T` (sent by the stack) or `R` (received) behind each `candump -L` line, as `candump -x` does
    #[arg(long, conflicts_with_all = ["screen", "absolute", "delta", "since_start", "ascii"])]
    pub direction: bool,
    /// Seconds since 1970 instead of the time of day
    #[arg(long)]
    pub absolute: bool,
    /// Time since the frame before instead of the time of day
    #[arg(long, conflicts_with = "absolute")]
    pub delta: bool,
    /// Time since the first frame instead of the time of day
    #[arg(long, conflicts_with_all = ["absolute", "delta"])]
    pub since_start: bool,
    /// The data as text, too
    #[arg(long)]
    pub ascii: bool,
    /// Leave out the names that the stack gives to frames
    #[arg(long)]
    pub no_names: bool,
    #[arg(long, value_enum, default_value = "auto", value_name = "WHEN")]
    pub color: Color,
    #[command(flatten)]
    pub which: Which,
}

#[derive(Debug, Args)]
pub struct SendArgs {
    /// CAN service of the stack
    pub bus: String,
    /// 123#DEADBEEF, 12345678#00, 123#R4, 123##1AABB
    #[arg(required = true)]
    pub frames: Vec<String>,
    /// Send all of them so often
    #[arg(long, short = 'n', default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..))]
    pub count: u64,
    /// From one time to the next
    #[arg(long, value_name = "DURATION")]
    pub every: Option<Span>,
    #[command(flatten)]
    pub which: Which,
}

#[derive(Debug, Args)]
pub struct GenArgs {
    /// CAN service of the stack; may be left out when there is one
    pub bus: Option<String>,
    /// An identifier; `inc` or `inc:100` counts up (from there), `random`
    #[arg(long, default_value = "random")]
    pub id: String,
    /// Bytes of data, `inc` or `random`
    #[arg(long, default_value = "random")]
    pub len: String,
    /// Hex bytes, `inc` (a counter of 64 bits, low byte first), `random`, `zero`
    #[arg(long, default_value = "random")]
    pub data: String,
    /// From one frame to the next; 0 is as fast as the bus takes them
    #[arg(long, default_value = "200ms", value_name = "DURATION")]
    pub gap: Span,
    /// Stop after so many frames
    #[arg(long, short = 'n', value_parser = clap::value_parser!(u64).range(1..))]
    pub count: Option<u64>,
    /// Stop after so long
    #[arg(long = "for", value_name = "DURATION")]
    pub duration: Option<Span>,
    /// 29-bit identifiers
    #[arg(long, short = 'e')]
    pub extended: bool,
    /// Remote frames
    #[arg(long, conflicts_with = "fd")]
    pub rtr: bool,
    /// CAN FD frames
    #[arg(long)]
    pub fd: bool,
    /// CAN FD frames with bit rate switch
    #[arg(long)]
    pub brs: bool,
    /// CAN FD frames with error state
    #[arg(long)]
    pub esi: bool,
    /// 11 and 29 bits, remote, and with --fd also FD, in a random mix
    #[arg(long, conflicts_with_all = ["extended", "rtr"])]
    pub mix: bool,
    /// Frames go out in the order they are made, not by identifier
    #[arg(long)]
    pub in_order: bool,
    /// The same number makes the same frames
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    #[command(flatten)]
    pub which: Which,
}

#[derive(Debug, Args)]
pub struct ReplayArgs {
    /// candump log, Vector ASC or MCAP recording
    pub file: PathBuf,
    /// Bus that everything goes to
    #[arg(long, value_name = "BUS", conflicts_with = "map")]
    pub bus: Option<String>,
    /// Where the frames of a logged bus go; what is not named is left out
    #[arg(long, value_name = "LOGGED=BUS", value_delimiter = ',')]
    pub map: Vec<String>,
    #[command(flatten)]
    pub filter: FilterArgs,
    /// 2 is twice as fast
    #[arg(long, default_value_t = 1.0)]
    pub speed: f64,
    /// As fast as the bus takes the frames
    #[arg(long, conflicts_with = "speed")]
    pub no_wait: bool,
    /// Play it so often; 0 is for ever
    #[arg(long = "loop", default_value_t = 1, value_name = "COUNT")]
    pub rounds: u64,
    /// Begin so long behind the first frame
    #[arg(long, value_name = "DURATION")]
    pub from: Option<Span>,
    /// End so long behind the first frame
    #[arg(long, value_name = "DURATION")]
    pub to: Option<Span>,
    /// Longer pauses of the file are cut to this
    #[arg(long, value_name = "DURATION", conflicts_with = "no_wait")]
    pub max_gap: Option<Span>,
    /// Leave out what the logging side had sent itself; refused where the file does not tell that
    #[arg(long)]
    pub received_only: bool,
    #[command(flatten)]
    pub which: Which,
}

#[derive(Debug, Args)]
pub struct StatsArgs {
    /// CAN services of the stack; all of them when left out, or `all`
    #[arg(value_name = "BUS")]
    pub buses: Vec<String>,
    #[command(flatten)]
    pub filter: FilterArgs,
    /// Stop after so long; 2s when the output is no terminal
    #[arg(long = "for", value_name = "DURATION")]
    pub duration: Option<Span>,
    #[command(flatten)]
    pub which: Which,
}

#[derive(Debug, Args)]
pub struct SniffArgs {
    /// CAN service of the stack; may be left out when there is one
    pub bus: Option<String>,
    #[command(flatten)]
    pub filter: FilterArgs,
    /// Stop after so long
    #[arg(long = "for", value_name = "DURATION")]
    pub duration: Option<Span>,
    #[arg(long, value_enum, default_value = "auto", value_name = "WHEN")]
    pub color: Color,
    #[command(flatten)]
    pub which: Which,
}
