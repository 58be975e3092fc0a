//! The tables of the stack file, one a role.

mod master;
mod slave;
mod value;

pub use master::{
    Check, Config as MasterConfig, ErrorPolicy, Guarding, MAX_MAPS, MAX_NODES, MAX_QUEUE, MAX_SDO_WRITES,
    Map, Node, OnBadWord, OnStop, OnStopWord, Pdo, Restore, SdoWrite, StopValue, Transmission,
};
pub use slave::{Config as SlaveConfig, Map as SlaveMap, Simulation};
pub use value::{Number, ObjectRef};
