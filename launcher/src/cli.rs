//! The command line: `dinrail NOUN VERB`, or a plain verb for what is used daily.

use crate::commands::can::args::CanCommand;
use crate::supervise::service_main::ServiceArgs;
use clap::{Args, Parser, Subcommand};
use ipc_types::units::Span;
use std::path::PathBuf;

/// Programmable bus gateway and soft PLC.
#[derive(Debug, Parser)]
#[command(name = "dinrail", version, propagate_version = true)]
pub struct Cli {
    /// Results as JSON
    #[arg(long, global = true)]
    pub json: bool,
    #[command(subcommand)]
    pub command: Command,
}

/// Which running stack is meant.
#[derive(Debug, Clone, Args)]
pub struct Which {
    /// Name of the running stack; not needed when only one runs
    #[arg(long, value_name = "NAME")]
    pub stack: Option<String>,
}

#[derive(Debug, Subcommand)]
pub enum Command {
    /// Start a stack and keep it running in the foreground
    Up {
        /// Stack file, or a folder with a stack.toml
        stack: PathBuf,
        /// Stop after so long, e.g. 10s
        #[arg(long = "for", value_name = "DURATION")]
        duration: Option<Span>,
    },
    /// Start the built-in demo stack in ./dinrail-demo
    Demo {
        /// Stop after so long, e.g. 10s
        #[arg(long = "for", value_name = "DURATION")]
        duration: Option<Span>,
        /// Folder for the stack's files and recordings
        #[arg(long, default_value = "dinrail-demo", value_name = "FOLDER")]
        dir: PathBuf,
    },
    /// Stop a running stack
    Down(Which),
    /// List the services of a running stack
    Ps(Which),
    /// How a running stack is, and what its services tell about themselves
    Status {
        /// Services; all of them when left out
        services: Vec<String>,
        /// Again every second
        #[arg(short, long)]
        watch: bool,
        #[command(flatten)]
        which: Which,
    },
    /// Processes, buses, PLCs, clients and events of a running stack, live
    Top {
        /// Time between two refreshes
        #[arg(long, default_value = "1s", value_name = "DURATION")]
        every: Span,
        #[command(flatten)]
        which: Which,
    },
    /// What services printed
    Logs {
        /// Service; all of them when left out
        service: Option<String>,
        /// Go on with what comes
        #[arg(short, long)]
        follow: bool,
        /// Lines from the past
        #[arg(short = 'n', long, default_value_t = 100, value_name = "COUNT")]
        lines: u32,
        #[command(flatten)]
        which: Which,
    },
    /// End one service and start it again
    Restart {
        service: String,
        #[command(flatten)]
        which: Which,
    },
    /// See, send, generate and replay CAN frames
    #[command(subcommand)]
    Can(CanCommand),
    /// See and command a CANopen network, read and write objects
    #[command(subcommand)]
    Canopen(crate::commands::canopen::CanopenCommand),
    /// Read and write Modbus devices, find and identify them
    #[command(subcommand)]
    Modbus(crate::commands::modbus::ModbusCommand),
    /// List serial ports, see and send frames
    #[command(subcommand)]
    Serial(crate::commands::serial::SerialCommand),
    /// Control a PLC, read and change its variables
    Plc {
        /// The plc service; not needed when the stack has only one
        #[arg(long, global = true, value_name = "NAME")]
        service: Option<String>,
        /// Name of the running stack; not needed when only one runs
        #[arg(long, global = true, value_name = "NAME")]
        stack: Option<String>,
        #[command(subcommand)]
        command: PlcCommand,
    },
    /// Run a program in virtual time and print or compare its variables
    Trace(crate::commands::trace::TraceArgs),
    /// Compile a program to WebAssembly
    Build {
        #[command(flatten)]
        program: crate::commands::sources::ProgramArgs,
        /// Where to write it
        #[arg(short, long, value_name = "FILE")]
        output: PathBuf,
    },
    /// Look into recordings
    #[command(subcommand)]
    Recordings(RecordingsCommand),
    /// Run a recording again
    Replay {
        /// Recording (MCAP)
        file: PathBuf,
        /// Execute the program again scan by scan and compare
        #[arg(long, required_unless_present = "as_slave")]
        verify: bool,
        /// Compare this program, instead of the recorded one, against the recorded data
        #[arg(long, value_name = "FILE")]
        program: Vec<PathBuf>,
        /// The plc service or serial line; not needed when the recording has only one
        #[arg(long, value_name = "NAME")]
        service: Option<String>,
        #[command(flatten)]
        slave: crate::commands::replay_slave::SlaveArgs,
    },
    /// Find what is wrong with a stack file without starting it
    Check {
        /// Stack file, or a folder with a stack.toml
        stack: PathBuf,
    },
    /// List every point of the process image in all its notations
    Map {
        /// Stack file, or a folder with a stack.toml
        stack: PathBuf,
        /// Only what contains this text
        filter: Option<String>,
    },
    /// Make a stack of your own from a built-in one
    New {
        /// Built-in stack; without it they are listed
        #[arg(long, value_name = "STACK")]
        from: Option<String>,
        /// Folder; default is the stack's name
        dir: Option<PathBuf>,
    },
    /// What a key of the stack file means
    Explain {
        /// `cycle`, `modbus-server.tcp.port`, `plc`; without it the kinds are listed
        key: Option<String>,
    },
    /// JSON schema of stack files, for editors
    Schema,
    /// Script that completes commands and options in a shell
    #[command(
        after_help = "bash:  dinrail completion bash > ~/.local/share/bash-completion/completions/dinrail\n\
        zsh:   dinrail completion zsh > DIR/_dinrail, DIR being in $fpath\n\
        fish:  dinrail completion fish > ~/.config/fish/completions/dinrail.fish"
    )]
    Completion { shell: crate::commands::completion::Shell },
    /// Write manual pages of all commands into a folder
    Man { folder: PathBuf },
    /// Measure this machine, each figure beside its goal
    Bench(crate::commands::bench::BenchArgs),
    #[command(name = "__service", hide = true)]
    Service(ServiceArgs),
    #[command(name = "__clean", hide = true)]
    Clean {
        #[arg(long)]
        root: PathBuf,
        #[arg(long)]
        parent: u32,
    },
}

#[derive(Debug, Subcommand)]
pub enum PlcCommand {
    /// State, scans, cycle times, forces
    Status,
    /// Stop scanning; outputs go to their safe state
    Stop,
    /// Go on from where it stopped
    Run,
    /// Start with all variables initial, RETAIN too
    Cold,
    /// Start with RETAIN kept
    Warm,
    /// Start with everything kept
    Hot,
    /// Run another program; RETAIN is kept when its layout is the same
    Load {
        /// Source or .wasm file
        program: PathBuf,
        /// Start it with RETAIN initial as well
        #[arg(long)]
        cold: bool,
    },
    /// Hold a variable or %-address at a value, whatever the program writes
    Force {
        #[arg(required = true, value_name = "VAR=VALUE")]
        assignments: Vec<String>,
    },
    /// Let go of forced variables
    Unforce {
        #[arg(required_unless_present = "all", value_name = "VAR")]
        variables: Vec<String>,
        /// All of them
        #[arg(long)]
        all: bool,
    },
    /// Values of variables or %-addresses; of an instance those of its members
    Read {
        #[arg(required = true, value_name = "VAR")]
        variables: Vec<String>,
    },
    /// Every variable with type, address and where it is declared
    List {
        /// Only lines with this text
        filter: Option<String>,
    },
    /// Values as they change: on a terminal in place, else a line for every change
    Watch {
        /// Variables, instances, %-addresses; all variables when left out
        #[arg(value_name = "VAR")]
        variables: Vec<String>,
        /// Time between two looks
        #[arg(long, default_value = "500ms", value_name = "DURATION")]
        every: Span,
        /// End after so long; without it at Ctrl-C
        #[arg(long = "for", value_name = "DURATION")]
        duration: Option<Span>,
    },
    /// Set variables or %-addresses once, all in one scan; none when one of them is wrong
    Write {
        #[arg(required = true, value_name = "VAR=VALUE")]
        assignments: Vec<String>,
    },
}

#[derive(Debug, Subcommand)]
pub enum RecordingsCommand {
    /// Channels, counts, times, gaps
    Info {
        #[arg(required = true)]
        files: Vec<PathBuf>,
    },
    /// Messages, one a line
    Cat {
        file: PathBuf,
        /// Only this topic; a trailing * stands for any ending
        #[arg(long)]
        topic: Vec<String>,
        /// At most so many messages
        #[arg(long)]
        count: Option<u64>,
        /// CAN frames only, as `candump -L` lines, instead of JSON
        #[arg(long)]
        candump: bool,
    },
    /// Make files whole that were cut off, in their place
    Recover {
        #[arg(required = true)]
        files: Vec<PathBuf>,
    },
    /// Write the CAN frames of a recording or log as a candump log or Vector ASC
    Export(crate::commands::recordings::convert::ExportArgs),
    /// Make a recording of a candump log or Vector ASC
    Import(crate::commands::recordings::convert::ImportArgs),
}
