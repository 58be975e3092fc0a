//! Files that nobody finished, and files that are to go: what lies in the folder beside the current one.

use super::{Notice, Writer};
use crate::{disk, seal};
use std::path::{Path, PathBuf};
use std::time::Duration;

/// How often, and how long between, a file to be made whole is looked at again while it is in use: 10 s.
const SEAL_LOOKS: u32 = 50;
const SEAL_PAUSE: Duration = Duration::from_millis(200);

impl Writer {
    /// At the start: what lies in the folder, what of it is above the quota, and what of it a killed predecessor left.
    pub(super) fn tidy(&mut self) {
        disk::remove_half_sealed(&self.dir, &self.stack.name);
        self.shelf.look();
        let deleted = self.keep_quota();
        // There may be room now.
        if self.open.is_none() && deleted {
            self.try_open();
        }
        let current = self.open.as_ref().map(|open| open.path.clone());
        let old: Vec<_> = self.shelf.paths().filter(|path| Some(path) != current.as_ref()).collect();
        self.seal_in_background(old);
    }

    /// Deletes what is above the quota; whether there was anything.
    pub(super) fn keep_quota(&mut self) -> bool {
        let current = self.open.as_ref().map(|open| (open.path.clone(), open.mcap.bytes()));
        if let Some((path, bytes)) = &current {
            self.shelf.put(path, *bytes);
        }
        let deleted = self.shelf.keep(self.config.keep.0, current.as_ref().map(|(path, _)| path.as_path()));
        for found in &deleted {
            tracing::info!("deleted {} to stay below keep = {}", found.path.display(), self.config.keep);
        }
        !deleted.is_empty()
    }

    /// Makes unfinished files whole that nobody is writing.
    pub(super) fn seal_in_background(&self, files: Vec<PathBuf>) {
        if files.is_empty() {
            return;
        }
        let (notices, shared) = (self.notices.clone(), self.shared.clone());
        let work = move || {
            // A folder of years has thousands of files: each is opened once, here where nobody waits.
            for path in files.into_iter().filter(|path| !disk::is_finished(path)) {
                let (fault, message) = match recover_when_free(&path) {
                    Ok(report) => (false, format!("made {} whole: {report}", path.display())),
                    Err(seal::SealError::InUse(_)) => continue,
                    Err(error) => (true, error.to_string()),
                };
                if let Ok(mut progress) = shared.progress.lock() {
                    progress.sealed += u32::from(!fault);
                }
                let detail = serde_json::json!({ "path": path.display().to_string() });
                let _ = notices.send(Notice { fault, message, detail });
            }
        };
        let _ = std::thread::Builder::new().name("rec-seal".into()).spawn(work);
    }
}

/// A file that is given up may be in use for as long as its last data takes to the disk; one that is in use for longer is
/// another recorder's.
fn recover_when_free(path: &Path) -> Result<seal::Report, seal::SealError> {
    let mut looks = SEAL_LOOKS;
    loop {
        match seal::recover_own(path) {
            Err(seal::SealError::InUse(_)) if looks > 0 => {
                looks -= 1;
                std::thread::sleep(SEAL_PAUSE);
            }
            result => return result,
        }
    }
}
