//! A virtual bus and its servers, as several tests of this folder use them.
#![allow(clippy::unwrap_used, reason = "a test may end like this")]

use std::net::{Ipv4Addr, SocketAddr};
use std::rc::Rc;

use dinrail_can::server::{Host, Hub, listen};
use dinrail_can::virtual_bus::{Dialect, Settings};
use tokio::task::{JoinHandle, LocalSet, spawn_local};

/// A bus without pace, with room for bursts.
pub fn settings() -> Settings {
    Settings {
        name: "can0".into(),
        bitrate: 500_000,
        data_bitrate: 2_000_000,
        pace: false,
        max_rate: 150_000,
        tx_queue: 512,
        client_buffer: 1 << 20,
    }
}

/// Runs this and what it spawns on this thread.
pub fn local<F: Future>(work: F) -> F::Output {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    LocalSet::new().block_on(&runtime, work)
}

/// A server of the bus on a port of its own; inside of [`local`].
pub async fn serve<H: Host + 'static>(hub: &Rc<Hub<H>>, dialect: Dialect) -> (SocketAddr, JoinHandle<()>) {
    let listener = listen(Ipv4Addr::LOCALHOST.into(), 0).await.unwrap();
    let address = listener.local_addr().unwrap();
    (address, spawn_local(Rc::clone(hub).serve(listener, dialect, None, 8)))
}
