//! Client and server, alone against frames and against each other over networks of all kinds.

mod network;
mod server;
mod states;
