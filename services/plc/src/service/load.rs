//! Loading a program while the old one runs: compiled and instantiated on a thread of its own.

use crate::engine::{Engine, Runtime};
use crate::program;
use crate::setup::Setup;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, TryRecvError, channel};

use super::jobs::Asker;

/// A load under way.
pub(super) struct Loading {
    pub asker: Asker,
    pub path: PathBuf,
    pub cold: bool,
    done: Receiver<Result<Engine, String>>,
}

impl Loading {
    /// Starts the thread.
    pub(super) fn start(
        asker: Asker,
        runtime: &Runtime,
        setup: &Setup,
        dir: PathBuf,
        path: PathBuf,
        cold: bool,
    ) -> Result<Self, String> {
        let (send, done) = channel();
        let runtime = runtime.clone();
        let mut setup = setup.clone();
        setup.files = vec![path.display().to_string()];
        let file = path.clone();
        std::thread::Builder::new()
            .name("load".to_owned())
            .spawn(move || {
                let built =
                    program::load(&dir, &[file], &setup).map_err(|e| e.to_string()).and_then(|compiled| {
                        Engine::new(&runtime, Some(compiled.program), Arc::new(setup))
                            .map_err(|e| e.to_string())
                    });
                let _ = send.send(built);
            })
            .map_err(|e| format!("cannot start the thread that compiles: {e}"))?;
        Ok(Self { asker, path, cold, done })
    }

    /// The new engine, once it is ready.
    pub(super) fn poll(&self) -> Option<Result<Engine, String>> {
        match self.done.try_recv() {
            Ok(result) => Some(result),
            Err(TryRecvError::Empty) => None,
            Err(TryRecvError::Disconnected) => {
                Some(Err("the thread that compiles ended without a result".to_owned()))
            }
        }
    }
}
