//! Helpers of the unit tests.

use ipc_types::stack::{ServiceEntry, Stack, TopicEntry};
use ipc_types::topic::{EVENTS, TopicKind};
use ipc_types::wiring::Wiring;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};

/// A folder that goes with the test.
pub struct TempDir(PathBuf);

impl TempDir {
    pub fn new(name: &str) -> Self {
        Self::below(&std::env::temp_dir(), name)
    }
    /// In memory: for tests with many small files.
    pub fn fast(name: &str) -> Self {
        let shm = Path::new("/dev/shm");
        if shm.is_dir() { Self::below(shm, name) } else { Self::new(name) }
    }
    fn below(parent: &Path, name: &str) -> Self {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let n = COUNT.fetch_add(1, Ordering::Relaxed);
        let path = parent.join(format!("dinrail-rec-{}-{name}-{n}", std::process::id()));
        std::fs::create_dir_all(&path).unwrap();
        Self(path)
    }
    pub fn path(&self) -> &Path {
        &self.0
    }
}

impl Drop for TempDir {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

pub fn entry(name: &str, kind: &str, index: u32) -> ServiceEntry {
    let config = serde_json::json!({});
    ServiceEntry { name: name.into(), kind: kind.into(), index, config, wiring: Wiring::default() }
}

pub fn topic(name: &str, kind: TopicKind) -> TopicEntry {
    TopicEntry {
        name: name.into(),
        kind,
        depth: kind.row().depth,
        max_tail: kind.row().max_tail,
        writers: vec![name.split('/').next().unwrap_or_default().to_owned()],
        readers: Vec::new(),
        wakes: Vec::new(),
        max_publishers: 5,
        max_subscribers: 5,
    }
}

/// A stack with these topics, each of its service, and `stack/events`.
pub fn stack_of(name: &str, dir: &Path, topics: &[(&str, TopicKind)]) -> Stack {
    let mut topics: Vec<_> = topics
        .iter()
        .filter(|(_, kind)| *kind != TopicKind::Events)
        .map(|(service, kind)| topic(&kind.of(service), *kind))
        .collect();
    topics.push(topic(EVENTS, TopicKind::Events));
    Stack {
        name: name.into(),
        file: dir.join("stack.toml"),
        dir: dir.to_owned(),
        text: "[stack]\nname = \"test\"\n".into(),
        build_id: "test-build".into(),
        root: PathBuf::from("/nowhere"),
        prefix: "none_".into(),
        services: Vec::new(),
        topics,
    }
}

/// A file of so many bytes that ends as a finished recording does, or not.
pub fn file(dir: &Path, name: &str, bytes: usize, finished: bool) -> PathBuf {
    let path = dir.join(name);
    let mut data = vec![0u8; bytes];
    if finished {
        data[bytes - 8..].copy_from_slice(mcap::MAGIC);
    }
    std::fs::write(&path, data).unwrap();
    path
}
