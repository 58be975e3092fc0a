//! What the three services on tokio share: one thread, its wake-ups, its listeners, why it ends.

use crate::readable;
use ipc_types::Context;
use ipc_types::inbox::Inbox;
use ipc_types::rail::RailError;
use ipc_types::turns::BEAT;
use std::io;
use std::net::SocketAddr;
use std::os::fd::OwnedFd;
use tokio::io::unix::AsyncFd;
use tokio::net::TcpListener;
use tokio::time::{Interval, MissedTickBehavior};

/// Why a service ended.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    #[error(transparent)]
    Rail(#[from] RailError),
    #[error("{kind}: {what}: {source}")]
    System { kind: &'static str, what: &'static str, source: io::Error },
    #[error("{kind}: {key}: {message}; run `dinrail check`")]
    Config { kind: &'static str, key: String, message: String },
}

impl RunError {
    /// For `map_err`: what a service of this kind attempted.
    pub(crate) fn system(kind: &'static str, what: &'static str) -> impl FnOnce(io::Error) -> Self {
        move |source| Self::System { kind, what, source }
    }
}

/// Runs a service on the calling thread alone, its tasks too. `failed` names the runtime that could not start.
pub(crate) fn run_here<E>(
    serve: impl Future<Output = Result<(), E>>,
    failed: impl FnOnce(io::Error) -> E,
) -> Result<(), E> {
    let runtime =
        tokio::runtime::Builder::new_current_thread().enable_io().enable_time().build().map_err(failed)?;
    tokio::task::LocalSet::new().block_on(&runtime, serve)
}

/// What wakes every service.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Wake {
    /// The launcher says stop.
    Shutdown,
    /// A [`BEAT`] has passed.
    Beat,
    /// The rail has news.
    Rail,
}

/// See [`Wake`].
pub(crate) struct Wakes {
    kind: &'static str,
    inbox: Inbox,
    rail: AsyncFd<OwnedFd>,
    shutdown: AsyncFd<OwnedFd>,
    beat: Interval,
}

impl Wakes {
    /// The service's inbox and shutdown descriptor; the first beat comes at once.
    pub(crate) fn new(kind: &'static str, ctx: &mut Context) -> Result<Self, RunError> {
        let failed = |what| RunError::system(kind, what);
        let inbox = ctx.inbox()?;
        let rail = inbox.fd().try_clone_to_owned().map_err(failed("duplicating the inbox"))?;
        let rail = readable::watch(rail).map_err(failed("watching the inbox"))?;
        let shutdown =
            ctx.shutdown_fd().try_clone_to_owned().map_err(failed("duplicating the shutdown descriptor"))?;
        let shutdown = readable::watch(shutdown).map_err(failed("watching the shutdown descriptor"))?;
        let mut beat = tokio::time::interval(BEAT);
        beat.set_missed_tick_behavior(MissedTickBehavior::Skip);
        Ok(Self { kind, inbox, rail, shutdown, beat })
    }

    /// Waits for the next one. Loses none when it is dropped.
    pub(crate) async fn next(&mut self) -> Result<Wake, RunError> {
        tokio::select! {
            biased;
            _ = self.shutdown.readable() => Ok(Wake::Shutdown),
            _ = self.beat.tick() => Ok(Wake::Beat),
            ready = self.rail.readable() => {
                // First cleared, then drained: what rings in between is an edge again.
                ready.map_err(RunError::system(self.kind, "waiting for the rail"))?.clear_ready();
                self.inbox.drain();
                Ok(Wake::Rail)
            }
        }
    }
}

/// An inherited listener, and where it listens.
pub(crate) fn listener(
    kind: &'static str,
    ctx: &mut Context,
    name: &str,
) -> Result<(TcpListener, Option<SocketAddr>), RunError> {
    let listener = std::net::TcpListener::from(ctx.take_fd(name)?);
    listener.set_nonblocking(true).map_err(RunError::system(kind, "preparing the listener"))?;
    let listener =
        TcpListener::from_std(listener).map_err(RunError::system(kind, "watching the listener"))?;
    let address = listener.local_addr().ok();
    Ok((listener, address))
}
