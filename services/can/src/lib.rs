//! CAN bus driver service

pub mod protocol;
