//! `dinrail modbus read`, `write`, `scan` and `identify`: a Modbus master on the command line, against a device or
//! through a modbus-client of a running stack.

mod access;
mod identify;
mod points;
pub mod server;
mod target;

use crate::commands::UsageError;
use clap::{Args, Subcommand};
use dinrail_modbus::client::order::Order;
use dinrail_modbus::server::Table;
use ipc_types::units::Span;
use points::ValueType;
use target::Master;

/// What is common to all.
#[derive(Debug, Clone, Args)]
pub struct MasterArgs {
    /// `tcp://HOST[:502]`, `rtu:///dev/ttyUSB0?baud=19200&parity=even`, `ascii:///dev/...`, `rtu-over-tcp://HOST:PORT`,
    /// or a modbus-client service of a running stack
    #[arg(value_name = "TARGET")]
    pub target: String,
    /// Unit id; of a service also the name of a unit
    #[arg(short, long, default_value = "1", value_name = "UNIT")]
    pub unit: String,
    /// How long an answer is waited for
    #[arg(long, default_value = "1s", value_name = "DURATION")]
    pub timeout: Span,
    /// Repetitions of a request without an answer
    #[arg(long, default_value_t = 1, value_name = "COUNT")]
    pub retries: u8,
    /// Name of the running stack; not needed when only one runs
    #[arg(long, value_name = "NAME")]
    pub stack: Option<String>,
}

/// What points are made of when they do not say it themselves.
#[derive(Debug, Clone, Args)]
pub struct PointArgs {
    /// Addresses are of this table and count from 0; else 00001, 10001, 30001, 40001 name table and entry, and any
    /// other number is a holding register counted from 0
    #[arg(long, value_name = "TABLE", value_parser = points::parse_table)]
    pub table: Option<Table>,
    /// int16, uint16, int32, uint32, int64, uint64, float, double, bit, hex, string
    #[arg(long = "type", value_name = "TYPE", value_parser = ValueType::parse)]
    pub value_type: Option<ValueType>,
    /// Bytes on the wire, A the most significant: AB, BA, ABCD, DCBA, BADC, CDAB
    #[arg(long, value_name = "ORDER", value_parser = points::parse_order)]
    pub order: Option<Order>,
}

#[derive(Debug, Subcommand)]
pub enum ModbusCommand {
    /// Read registers or bits
    Read {
        #[command(flatten)]
        master: MasterArgs,
        /// [NAME=]ADDRESS[xCOUNT][:TYPE[:ORDER]], e.g. 40001, 0x10, Power=30001:float:CDAB
        #[arg(required = true, value_name = "POINT")]
        points: Vec<String>,
        #[command(flatten)]
        form: PointArgs,
        /// Values of each point
        #[arg(short = 'n', long, default_value_t = 1, value_name = "COUNT")]
        count: u16,
        /// Read again and again
        #[arg(long, value_name = "DURATION")]
        every: Option<Span>,
        /// Stop after so many rounds
        #[arg(long, value_name = "COUNT", requires = "every")]
        rounds: Option<u64>,
    },
    /// Write registers or coils
    Write {
        #[command(flatten)]
        master: MasterArgs,
        /// ADDRESS[xCOUNT][:TYPE[:ORDER]]=VALUE[,VALUE], e.g. 40001=5, 40001=1,2,3, 00001=on, 40010:float=1.5,
        /// 40010x2:float=1.5,2.5
        #[arg(required = true, value_name = "POINT=VALUE")]
        points: Vec<String>,
        #[command(flatten)]
        form: PointArgs,
        /// Functions 15 and 16 for single values too
        #[arg(long)]
        multiple: bool,
    },
    /// Find the units of a line
    Scan {
        #[command(flatten)]
        master: MasterArgs,
        /// First unit
        #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u8).range(0..=255))]
        from: u8,
        /// Last unit
        #[arg(long, default_value_t = 247, value_parser = clap::value_parser!(u8).range(0..=255))]
        to: u8,
    },
    /// What a unit says of itself: device identification (43/14) and server id (17)
    Identify {
        #[command(flatten)]
        master: MasterArgs,
    },
    /// Who is connected to a modbus-server of a running stack
    Clients(server::ServerArgs),
    /// Switch a modbus-server on
    Enable(server::ServerArgs),
    /// Switch a modbus-server off: it closes its connections and answers nobody
    Disable(server::ServerArgs),
}

pub fn run(command: ModbusCommand, json: bool) -> anyhow::Result<()> {
    match command {
        ModbusCommand::Read { master, points, form, count, every, rounds } => {
            let points = points::parse_all(&points, &form, count)?;
            let mut line = Master::open(&master)?;
            access::read(&mut line, &points, every, rounds, json)
        }
        ModbusCommand::Write { master, points, form, multiple } => {
            let writes = points::parse_writes(&points, &form)?;
            let mut line = Master::open(&master)?;
            access::write(&mut line, &writes, multiple, json)
        }
        ModbusCommand::Scan { master, from, to } => {
            if from > to {
                return Err(UsageError(format!("--from {from} lies behind --to {to}")).into());
            }
            // Most of the units asked are not there: no repetitions.
            let mut line = Master::open(&MasterArgs { retries: 0, ..master })?;
            identify::scan(&mut line, from, to, json)
        }
        ModbusCommand::Identify { master } => {
            let mut line = Master::open(&master)?;
            identify::identify(&mut line, json)
        }
        ModbusCommand::Clients(args) => server::clients(&args, json),
        ModbusCommand::Enable(args) => server::switch(&args, true, json),
        ModbusCommand::Disable(args) => server::switch(&args, false, json),
    }
}
