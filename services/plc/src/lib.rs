//! PLC scan engine, process image and routes
