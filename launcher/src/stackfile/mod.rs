//! Reads a stack file, resolves it, and says everything that is wrong with it, each mistake with its line.
//!
//! Four steps: [`document`] (text to typed tables), [`resolve`] (what every service declares to topics, ports
//! and wake-ups), [`checks`] (what no single service can see: two owners of one range, one port used twice,
//! shared memory), then each service's own `check`. Nothing here starts, opens or writes anything.

mod checks;
mod document;
mod keypath;
mod launch;
mod nearest;
mod place;
mod read;
mod registers;
mod resolve;

#[cfg(test)]
pub mod real_tests;
#[cfg(test)]
mod tests;

/// What the types of the launcher's own keys say to a table, for the test of their documentation.
#[cfg(test)]
pub mod probe {
    pub use super::launch::SERVICE_KEYS;
    use super::launch::{LaunchTable, StackTable};
    use serde::Deserialize;

    pub fn stack(value: &serde_json::Value) -> String {
        StackTable::deserialize(value).err().map_or_else(String::new, |e| e.to_string())
    }
    pub fn service(value: &serde_json::Value) -> String {
        LaunchTable::deserialize(value).err().map_or_else(String::new, |e| e.to_string())
    }
}

pub use checks::{free_shared_memory, percent, readable_size, shared_memory};
pub use launch::{LaunchOptions, OnExhausted, StackSettings};
pub use nearest::{nearest, suggestion};
pub use place::Located;
pub use resolve::exchangers;

use crate::kinds::{KINDS, Kind};
use ipc_types::Stack;
use ipc_types::stack::Severity;
use place::{Sink, Source};
use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// Largest stack file.
const FILE_MAX: u64 = 1 << 20;
/// Name of the file in a stack's folder.
const FILE_NAME: &str = "stack.toml";

/// A stack that may be started.
#[derive(Debug)]
pub struct Loaded {
    pub stack: Stack,
    /// How to run each service, by its name.
    pub launch: BTreeMap<String, LaunchOptions>,
    pub settings: StackSettings,
    /// Warnings only.
    pub findings: Vec<Located>,
}

/// Why a stack file is refused: everything that was found, warnings too.
#[derive(Debug)]
pub struct LoadError {
    pub findings: Vec<Located>,
}

impl LoadError {
    fn of_file(file: &Path, message: String, help: &str) -> Self {
        Self { findings: vec![Located::of_file(file, message, help)] }
    }

    /// How many of the findings are errors.
    pub fn errors(&self) -> usize {
        self.findings.iter().filter(|f| f.severity == Severity::Error).count()
    }
}

impl fmt::Display for LoadError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (i, finding) in self.findings.iter().enumerate() {
            if i > 0 {
                f.write_str("\n\n")?;
            }
            write!(f, "{finding}")?;
        }
        Ok(())
    }
}

impl std::error::Error for LoadError {}

/// Loads a stack file, or the `stack.toml` of a folder.
pub fn load(path: &Path) -> Result<Loaded, LoadError> {
    let path = if path.is_dir() { path.join(FILE_NAME) } else { path.to_owned() };
    let text = read_file(&path).map_err(|(message, help)| LoadError::of_file(&path, message, help))?;
    load_text(&path, &text)
}

/// Loads a text as if it stood in the stack file `path`, which need not be there.
pub fn load_text(path: &Path, text: &str) -> Result<Loaded, LoadError> {
    let full = path.canonicalize().unwrap_or_else(|_| path.to_owned());
    let dir = full.parent().unwrap_or(Path::new("/")).to_owned();
    Loader::new(path, &full, &dir).load(text)
}

fn read_file(path: &Path) -> Result<String, (String, &'static str)> {
    let metadata = std::fs::metadata(path).map_err(|e| {
        (
            format!("cannot read the stack file: {e}"),
            "name a stack file or its folder; `dinrail new --from conveyor DIR` makes one",
        )
    })?;
    if !metadata.is_file() {
        return Err(("this is no regular file".to_owned(), "name a stack file or its folder"));
    }
    if metadata.len() > FILE_MAX {
        return Err((
            format!("the file has {} bytes; a stack file has at most {FILE_MAX}", metadata.len()),
            "is this the right file?",
        ));
    }
    let bytes = std::fs::read(path)
        .map_err(|e| (format!("cannot read the stack file: {e}"), "check the file's permissions"))?;
    String::from_utf8(bytes).map_err(|e| {
        (
            format!("byte {} is no UTF-8", e.utf8_error().valid_up_to()),
            "stack files are UTF-8 text; is this the right file?",
        )
    })
}

/// What one run of loading depends on, so that tests can bring their own.
struct Loader<'a> {
    /// As shown in messages.
    shown: &'a Path,
    file: PathBuf,
    dir: PathBuf,
    kinds: &'static [Kind],
    /// Bytes free in /dev/shm; `None` = unknown.
    free_shm: Option<u64>,
}

impl<'a> Loader<'a> {
    fn new(shown: &'a Path, file: &Path, dir: &Path) -> Self {
        Self {
            shown,
            file: file.to_owned(),
            dir: dir.to_owned(),
            kinds: KINDS,
            free_shm: free_shared_memory(),
        }
    }

    fn load(self, text: &str) -> Result<Loaded, LoadError> {
        let mut sink = Sink { source: Source::new(self.shown, text), list: Vec::new() };
        let document = document::read(text, self.kinds, &mut sink);
        // Resolving half a stack would report neighbours as missing that are only misspelt.
        let Some(document) = document.filter(|_| !sink.has_errors()) else {
            return Err(LoadError { findings: sink.list });
        };
        let stack = resolve::resolve(&document, &self, text, &mut sink);
        checks::check(&document, &stack, self.free_shm, &mut sink);
        registers::check(&document, &stack, &mut sink);
        sink.list.sort_by_key(|f| (std::cmp::Reverse(f.severity), f.line, f.column));
        if sink.has_errors() {
            return Err(LoadError { findings: sink.list });
        }
        let launch = document.services.into_iter().map(|s| (s.name, s.launch)).collect();
        Ok(Loaded { stack, launch, settings: document.settings, findings: sink.list })
    }
}

/// Identifies this executable: version and hash of its bytes. Children of another build refuse to run.
pub fn build_id() -> &'static str {
    static ID: OnceLock<String> = OnceLock::new();
    ID.get_or_init(|| {
        // Through /proc, so that a file replaced on disk since the start does not count.
        let hash = std::fs::read("/proc/self/exe").map_or(0, |bytes| xxhash_rust::xxh3::xxh3_64(&bytes));
        format!("{}-{hash:016x}", env!("CARGO_PKG_VERSION"))
    })
}
