//! The kinds of services that this executable can run, one adapter each, and what their keys mean.
//!
//! This is the only place of the launcher that knows service crates by name. It must never know what is in a
//! service's configuration: that is read, checked and wired through the three functions every crate exports.

use crate::explain_keys::{self as docs, KeyDoc};
use ipc_types::Context;
use ipc_types::stack::{Finding, ServiceEntry, Stack};
use ipc_types::wiring::{Neighbours, Wiring};
use serde::de::DeserializeOwned;
use toml_edit::{DocumentMut, Table};

/// A service's configuration, read and typed.
pub trait ServiceConfig {
    /// What it needs of the rail.
    fn topics(&self, neighbours: &Neighbours) -> Wiring;
    /// What is wrong with it, as far as that can be seen without starting.
    fn check(&self, stack: &Stack, me: &ServiceEntry) -> Vec<Finding>;
}

/// A kind of service.
pub struct Kind {
    /// As in `kind = "..."`.
    pub name: &'static str,
    /// One line for lists.
    pub about: &'static str,
    /// Reads a service's table without the launcher's keys.
    pub parse: fn(Table) -> Result<Box<dyn ServiceConfig>, toml_edit::de::Error>,
    /// Whether the resolved configuration, as the process will get it, is read back.
    pub accepts: fn(&serde_json::Value) -> Result<(), serde_json::Error>,
    pub run: fn(Context) -> anyhow::Result<()>,
    /// Every key of its table.
    pub config_doc: &'static [KeyDoc],
}

/// Reads a table as the type of its kind.
pub fn parse<C: DeserializeOwned + ServiceConfig + 'static>(
    table: Table,
) -> Result<Box<dyn ServiceConfig>, toml_edit::de::Error> {
    Ok(Box::new(toml_edit::de::from_document::<C>(DocumentMut::from(table))?))
}

/// Reads the resolved configuration as the process will.
pub fn accepts<C: DeserializeOwned>(value: &serde_json::Value) -> Result<(), serde_json::Error> {
    C::deserialize(value).map(|_| ())
}

/// Kinds that are named in the documentation of the project but cannot run yet.
pub const NOT_YET: [&str; 2] = ["j1939", "console"];

/// One row of [`KINDS`] from the functions a service crate exports.
macro_rules! kind {
    ($name:literal, $about:literal, $doc:expr, $config:ty, $run:path) => {
        Kind {
            name: $name,
            about: $about,
            parse: parse::<$config>,
            accepts: accepts::<$config>,
            run: |ctx| Ok($run(ctx)?),
            config_doc: $doc,
        }
    };
}

/// Lets the launcher see a service's configuration through [`ServiceConfig`] alone.
macro_rules! service_config {
    ($config:ty, $topics:path, $check:path) => {
        impl ServiceConfig for $config {
            fn topics(&self, neighbours: &Neighbours) -> Wiring {
                $topics(self, neighbours)
            }
            fn check(&self, stack: &Stack, me: &ServiceEntry) -> Vec<Finding> {
                $check(self, stack, me)
            }
        }
    };
}

service_config!(dinrail_can::Config, dinrail_can::topics, dinrail_can::check);
service_config!(
    dinrail_canopen::config::MasterConfig,
    dinrail_canopen::service::master::topics,
    dinrail_canopen::service::master::check
);
service_config!(
    dinrail_canopen::config::SlaveConfig,
    dinrail_canopen::service::slave::topics,
    dinrail_canopen::service::slave::check
);
service_config!(dinrail_can_io::Config, dinrail_can_io::topics, dinrail_can_io::check);
service_config!(dinrail_modbus::Config, dinrail_modbus::topics, dinrail_modbus::check);
service_config!(
    dinrail_modbus::client::Config,
    dinrail_modbus::client::topics,
    dinrail_modbus::client::check
);
service_config!(
    dinrail_modbus::gateway::Config,
    dinrail_modbus::gateway::topics,
    dinrail_modbus::gateway::check
);
service_config!(dinrail_plc::Config, dinrail_plc::topics, dinrail_plc::check);
service_config!(dinrail_serial::Config, dinrail_serial::topics, dinrail_serial::check);
service_config!(dinrail_recorder::Config, dinrail_recorder::topics, dinrail_recorder::check);
service_config!(
    dinrail_recorder::replay::Config,
    dinrail_recorder::replay::topics,
    dinrail_recorder::replay::check
);

/// Every kind of this build.
pub static KINDS: &[Kind] = &[
    kind!("can", "a CAN bus and its driver", docs::CAN, dinrail_can::Config, dinrail_can::run),
    kind!(
        "can-io",
        "signals of CAN frames to and from the process image",
        docs::CAN_IO,
        dinrail_can_io::Config,
        dinrail_can_io::run
    ),
    kind!(
        "canopen-master",
        "boots and runs a CANopen network, its objects are the process image",
        docs::CANOPEN_MASTER,
        dinrail_canopen::config::MasterConfig,
        dinrail_canopen::service::master::run
    ),
    kind!(
        "canopen-slave",
        "a CANopen device: its objects are the process image, or simulated",
        docs::CANOPEN_SLAVE,
        dinrail_canopen::config::SlaveConfig,
        dinrail_canopen::service::slave::run
    ),
    kind!(
        "plc",
        "a process image with its program, in IEC 61131-3 languages, and routes",
        docs::PLC,
        dinrail_plc::Config,
        dinrail_plc::run
    ),
    kind!(
        "modbus-server",
        "serves the process image to Modbus clients on TCP and serial lines",
        docs::MODBUS_SERVER,
        dinrail_modbus::Config,
        dinrail_modbus::run
    ),
    kind!(
        "modbus-client",
        "a Modbus master: units polled into the process image, written from it, asked by jobs",
        docs::MODBUS_CLIENT,
        dinrail_modbus::client::Config,
        dinrail_modbus::client::run
    ),
    kind!(
        "modbus-gateway",
        "passes requests of Modbus TCP masters on to serial lines",
        docs::MODBUS_GATEWAY,
        dinrail_modbus::gateway::Config,
        dinrail_modbus::gateway::run
    ),
    kind!(
        "serial",
        "a serial port, RS-232 or RS-485, and its driver",
        docs::SERIAL,
        dinrail_serial::Config,
        dinrail_serial::run
    ),
    kind!(
        "recorder",
        "records every message of the stack as MCAP",
        docs::RECORDER,
        dinrail_recorder::Config,
        dinrail_recorder::run
    ),
    kind!(
        "replay",
        "a recording in the place of a bus",
        docs::REPLAY,
        dinrail_recorder::replay::Config,
        dinrail_recorder::replay::run
    ),
];

/// The kind of this name.
pub fn find(name: &str) -> Option<&'static Kind> {
    KINDS.iter().find(|k| k.name == name)
}

/// Runs a service of this kind in this process until it is told to end.
pub fn run_service(kind: &str, ctx: Context) -> anyhow::Result<()> {
    match find(kind) {
        Some(kind) => (kind.run)(ctx),
        None => anyhow::bail!("this build of dinrail has no services of kind '{kind}'"),
    }
}
