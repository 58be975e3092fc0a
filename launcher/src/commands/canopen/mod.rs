//! `dinrail canopen`: a network as its master sees it, objects, NMT, LSS, EDS files.

mod bus;
mod eds;
mod emcy;
mod lss;
mod network;
mod plan;
mod scan;
mod value;

use crate::cli::Which;
use clap::{Args, Subcommand, ValueEnum};
use dinrail_canopen::protocol::lss::LssState;
use std::path::PathBuf;
use std::process::ExitCode;

/// Which master is meant.
#[derive(Debug, Clone, Args)]
pub struct MasterArgs {
    /// The canopen-master service; not needed when the stack has only one
    #[arg(long, value_name = "NAME")]
    pub service: Option<String>,
    #[command(flatten)]
    pub which: Which,
}

/// Which bus is meant.
#[derive(Debug, Clone, Args)]
pub struct BusArgs {
    /// The can service; not needed when the stack has only one
    #[arg(long, value_name = "NAME")]
    pub bus: Option<String>,
    #[command(flatten)]
    pub which: Which,
}

/// How a value travels.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, ValueEnum)]
pub enum Mode {
    /// Up to 4 bytes expedited, long values by block
    #[default]
    Auto,
    /// Never block transfer
    Segmented,
    /// Block transfer
    Block,
}

impl Mode {
    fn word(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::Segmented => "segmented",
            Self::Block => "block",
        }
    }
}

#[derive(Debug, Subcommand)]
pub enum CanopenCommand {
    /// State of the network, node by node, with the reasons of failed boots
    Status(MasterArgs),
    /// Find the nodes of a bus and what they are
    Scan {
        /// Print [[service.node]] tables to paste into a stack file
        #[arg(long)]
        toml: bool,
        #[command(flatten)]
        bus: BusArgs,
    },
    /// Read and write objects of nodes
    #[command(subcommand)]
    Sdo(SdoCommand),
    /// Command a node, or all
    Nmt {
        command: Nmt,
        /// Node-id, or `all`
        #[arg(value_parser = node_or_all)]
        node: u8,
        #[command(flatten)]
        master: MasterArgs,
    },
    /// Boot a node again from the beginning: identity, configuration, start
    Boot {
        #[arg(value_parser = clap::value_parser!(u8).range(1..=127))]
        node: u8,
        #[command(flatten)]
        master: MasterArgs,
    },
    /// How the boot-up of nodes goes or went: step, tries, time, letter
    BootState {
        #[arg(value_parser = clap::value_parser!(u8).range(1..=127))]
        node: Option<u8>,
        #[command(flatten)]
        master: MasterArgs,
    },
    /// Emergency messages that the master saw, newest first; or let a device of the stack report one
    #[command(args_conflicts_with_subcommands = true)]
    Emcy(EmcyArgs),
    /// Give devices node-ids and bit rates over the bus (CiA 305)
    #[command(subcommand)]
    Lss(LssCommand),
    /// Look at EDS and DCF files
    #[command(subcommand)]
    Eds(EdsCommand),
    /// Make DCF files
    #[command(subcommand)]
    Dcf(DcfCommand),
    /// The PDOs of a stack's network: COB-IDs, types, bytes, objects and bus load
    Plan {
        /// Stack file, or a folder with a stack.toml
        stack: PathBuf,
    },
}

/// NMT commands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Nmt {
    Start,
    Stop,
    Preop,
    ResetNode,
    ResetCommunication,
}

impl Nmt {
    fn word(self) -> &'static str {
        match self {
            Self::Start => "start",
            Self::Stop => "stop",
            Self::Preop => "preop",
            Self::ResetNode => "reset_node",
            Self::ResetCommunication => "reset_communication",
        }
    }
}

#[derive(Debug, Subcommand)]
pub enum SdoCommand {
    /// Read an object
    Read {
        #[arg(value_parser = clap::value_parser!(u8).range(1..=127))]
        node: u8,
        /// 1018:01, both parts in hex, or the object's name in the EDS
        object: String,
        /// Type of the value, where no EDS says it: u8, i16, u32, f32, string, hex, ...
        #[arg(long = "type", value_name = "TYPE")]
        kind: Option<String>,
        /// Write the bytes to a file
        #[arg(short, long, value_name = "FILE")]
        output: Option<PathBuf>,
        #[arg(long, value_enum, default_value_t)]
        mode: Mode,
        #[command(flatten)]
        master: MasterArgs,
    },
    /// Write an object
    Write {
        #[arg(value_parser = clap::value_parser!(u8).range(1..=127))]
        node: u8,
        /// 2000:01, both parts in hex, or the object's name in the EDS
        object: String,
        /// The value; of type hex the bytes
        #[arg(required_unless_present = "input", allow_hyphen_values = true)]
        value: Option<String>,
        /// Type of the value, where no EDS says it: u8, i16, u32, f32, string, hex, ...
        #[arg(long = "type", value_name = "TYPE")]
        kind: Option<String>,
        /// Take the bytes from a file
        #[arg(short, long, value_name = "FILE", conflicts_with = "value")]
        input: Option<PathBuf>,
        #[arg(long, value_enum, default_value_t)]
        mode: Mode,
        #[command(flatten)]
        master: MasterArgs,
    },
}

#[derive(Debug, Args)]
pub struct EmcyArgs {
    #[command(subcommand)]
    pub command: Option<EmcyCommand>,
    /// Only of this node
    #[arg(value_parser = clap::value_parser!(u8).range(1..=127))]
    pub node: Option<u8>,
    /// Forget them; the list in the device (1003h) stays. They live in the master's process and end with it
    #[arg(long)]
    pub clear: bool,
    #[command(flatten)]
    pub master: MasterArgs,
}

#[derive(Debug, Subcommand)]
pub enum EmcyCommand {
    /// A canopen-slave of the stack reports an error
    Send {
        /// Emergency error code, like 0x4210
        #[arg(value_parser = code)]
        code: u16,
        /// Bits of the error register besides bit 0, which is always set
        #[arg(long, value_parser = byte, default_value = "0")]
        register: u8,
        /// Up to 5 manufacturer-specific bytes, in hex
        #[arg(long, value_name = "HEX", default_value = "")]
        data: String,
        /// The canopen-slave service; not needed when the stack has only one
        #[arg(long, value_name = "NAME")]
        service: Option<String>,
        #[command(flatten)]
        which: Which,
    },
    /// A canopen-slave of the stack reports that an error is gone
    Reset {
        /// Only this error; without it all that were sent by `emcy send` or jobs
        #[arg(value_parser = code)]
        code: Option<u16>,
        /// The canopen-slave service; not needed when the stack has only one
        #[arg(long, value_name = "NAME")]
        service: Option<String>,
        #[command(flatten)]
        which: Which,
    },
}

/// The device with a known identity, or the only one.
#[derive(Debug, Clone, Args)]
pub struct AddressArgs {
    /// Vendor-ID (1018h:01)
    #[arg(long, value_parser = number, required_unless_present = "sole")]
    pub vendor: Option<u32>,
    /// Product code (1018h:02)
    #[arg(long, value_parser = number, required_unless_present = "sole")]
    pub product: Option<u32>,
    /// Revision number (1018h:03)
    #[arg(long, value_parser = number, required_unless_present = "sole")]
    pub revision: Option<u32>,
    /// Serial number (1018h:04)
    #[arg(long, value_parser = number, required_unless_present = "sole")]
    pub serial: Option<u32>,
    /// The only device of the bus, whatever its identity; refused when several answer
    ///
    /// All devices enter configuration and are asked for their serial number; when more than one answers nothing is
    /// changed. A device that answers too late, whose answer is lost, or whose equal answer meets another's on the wire
    /// is not seen and gets the same node-id or bit rate. Unequal answers at the very same moment are errors on the bus.
    /// Where there may be several, give the identity, or let `lss fastscan` find them.
    #[arg(long, conflicts_with_all = ["vendor", "product", "revision", "serial"])]
    pub sole: bool,
}

/// Bounds of a number.
#[derive(Debug, Clone, Copy)]
pub struct Range(pub (u32, u32));

/// States of an LSS slave.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum LssStateWord {
    Waiting,
    Configuration,
}

impl LssStateWord {
    fn state(self) -> LssState {
        match self {
            Self::Waiting => LssState::Waiting,
            Self::Configuration => LssState::Configuration,
        }
    }
}

#[derive(Debug, Subcommand)]
pub enum LssCommand {
    /// Find every device without node-id and give them node-ids from the first one on
    Fastscan {
        /// First node-id to give; without it the first device found is only shown
        #[arg(long, value_parser = clap::value_parser!(u8).range(1..=127))]
        from: Option<u8>,
        /// Let each device keep its node-id
        #[arg(long)]
        store: bool,
        /// How long each question waits for an answer; 100 without it
        #[arg(long, value_name = "MS", value_parser = clap::value_parser!(u16).range(1..=5000))]
        timeout: Option<u16>,
        #[command(flatten)]
        bus: BusArgs,
        /// Not through the canopen-master of the bus, but from this command
        #[arg(long)]
        direct: bool,
    },
    /// Give the device of this identity a node-id
    SetNodeId {
        #[arg(value_parser = clap::value_parser!(u8).range(1..=127))]
        node: u8,
        #[command(flatten)]
        address: AddressArgs,
        /// Let the device keep its node-id
        #[arg(long)]
        store: bool,
        #[command(flatten)]
        bus: BusArgs,
        /// Not through the canopen-master of the bus, but from this command
        #[arg(long)]
        direct: bool,
    },
    /// Set the bit rate of the device of this identity; it takes effect at its next start, or at once with --activate
    SetBitrate {
        /// kbit/s: 10, 20, 50, 125, 250, 500, 800 or 1000
        kbit: u16,
        #[command(flatten)]
        address: AddressArgs,
        #[arg(long)]
        store: bool,
        /// Change over after so many milliseconds; the bus needs the new bit rate then
        #[arg(long, value_name = "MS")]
        activate: Option<u16>,
        #[command(flatten)]
        bus: BusArgs,
        /// Not through the canopen-master of the bus, but from this command
        #[arg(long)]
        direct: bool,
    },
    /// Identity and node-id of the device of this identity
    Inquire {
        #[command(flatten)]
        address: AddressArgs,
        #[command(flatten)]
        bus: BusArgs,
        /// Not through the canopen-master of the bus, but from this command
        #[arg(long)]
        direct: bool,
    },
    /// Is there a device without node-id, or one of this make?
    Identify {
        /// Vendor-ID (1018h:01)
        #[arg(long, value_parser = number, requires = "product")]
        vendor: Option<u32>,
        /// Product code (1018h:02)
        #[arg(long, value_parser = number, requires = "vendor")]
        product: Option<u32>,
        /// Revision number (1018h:03), or bounds: 1..9
        #[arg(long, value_parser = lss::range, default_value = "0..0xFFFFFFFF", requires = "vendor")]
        revision: Range,
        /// Serial number (1018h:04), or bounds
        #[arg(long, value_parser = lss::range, default_value = "0..0xFFFFFFFF", requires = "vendor")]
        serial: Range,
        #[command(flatten)]
        bus: BusArgs,
        /// Not through the canopen-master of the bus, but from this command
        #[arg(long)]
        direct: bool,
    },
    /// Send all devices into a state; those in configuration do not answer a fastscan
    Switch {
        state: LssStateWord,
        #[command(flatten)]
        bus: BusArgs,
        /// Not through the canopen-master of the bus, but from this command
        #[arg(long)]
        direct: bool,
    },
    /// Let the devices in configuration change over to the bit rate they were set to
    Activate {
        /// Milliseconds of silence before and after
        delay: u16,
        #[command(flatten)]
        bus: BusArgs,
        /// Not through the canopen-master of the bus, but from this command
        #[arg(long)]
        direct: bool,
    },
}

#[derive(Debug, Subcommand)]
pub enum EdsCommand {
    /// Everything that is wrong with a file, with its line
    Check {
        #[arg(required = true)]
        files: Vec<PathBuf>,
    },
    /// The objects of a file
    Show {
        file: PathBuf,
        /// Only objects whose index or name contains this
        filter: Option<String>,
    },
}

#[derive(Debug, Subcommand)]
pub enum DcfCommand {
    /// The EDS of a node with what its master writes at boot, as a DCF
    Make {
        /// Stack file, or a folder with a stack.toml
        stack: PathBuf,
        #[arg(long, value_parser = clap::value_parser!(u8).range(1..=127))]
        node: u8,
        /// The canopen-master service; not needed when the stack has only one
        #[arg(long, value_name = "NAME")]
        service: Option<String>,
        #[arg(short, long, value_name = "FILE")]
        output: Option<PathBuf>,
    },
}

fn node_or_all(text: &str) -> Result<u8, String> {
    if text.eq_ignore_ascii_case("all") {
        return Ok(0);
    }
    text.parse()
        .ok()
        .filter(|n| (1..=127).contains(n))
        .ok_or_else(|| "a node-id from 1 to 127, or `all`".to_owned())
}

fn number(text: &str) -> Result<u32, String> {
    let digits = text.strip_prefix("0x").or_else(|| text.strip_prefix("0X"));
    let parsed = match digits {
        Some(hex) => u32::from_str_radix(hex, 16).ok(),
        None => text.parse().ok(),
    };
    parsed.ok_or_else(|| "a number like 4660 or 0x1234".to_owned())
}

fn code(text: &str) -> Result<u16, String> {
    let code = number(text)?;
    u16::try_from(code).map_err(|_| format!("{text} is no 16-bit code"))
}

fn byte(text: &str) -> Result<u8, String> {
    let byte = number(text)?;
    u8::try_from(byte).map_err(|_| format!("{text} is no byte"))
}

pub fn run(command: CanopenCommand, json: bool) -> anyhow::Result<ExitCode> {
    let done = |result: anyhow::Result<()>| result.map(|()| ExitCode::SUCCESS);
    match command {
        CanopenCommand::Status(master) => done(network::status(&master, json)),
        CanopenCommand::Scan { toml, bus } => done(scan::run(&bus, toml, json)),
        CanopenCommand::Sdo(command) => done(network::sdo(command, json)),
        CanopenCommand::Nmt { command, node, master } => done(network::nmt(command, node, &master, json)),
        CanopenCommand::Boot { node, master } => done(network::boot(node, &master, json)),
        CanopenCommand::BootState { node, master } => done(network::boot_state(node, &master, json)),
        CanopenCommand::Emcy(args) => done(emcy::run(args, json)),
        CanopenCommand::Lss(command) => done(lss::run(command, json)),
        CanopenCommand::Eds(EdsCommand::Check { files }) => eds::check(&files, json),
        CanopenCommand::Eds(EdsCommand::Show { file, filter }) => {
            done(eds::show(&file, filter.as_deref(), json))
        }
        CanopenCommand::Dcf(command) => done(plan::dcf(&command, json)),
        CanopenCommand::Plan { stack } => done(plan::run(&stack, json)),
    }
}
