//! The ready stacks inside the executable: every file of `launcher/stacks/NAME/`, listed in one place.

use std::io;
use std::path::{Path, PathBuf};

/// A ready stack.
pub struct ReadyStack {
    pub name: &'static str,
    /// One line for lists.
    pub about: &'static str,
    /// Path in the stack's folder, and content.
    pub files: &'static [(&'static str, &'static [u8])],
}

/// Lists the files of a folder of `launcher/stacks`.
macro_rules! files {
    ($name:literal: $($file:literal),+ $(,)?) => {
        &[$(($file, include_bytes!(concat!("../stacks/", $name, "/", $file)))),+]
    };
}

/// Every ready stack. A test compares the list with the folders.
pub static STACKS: &[ReadyStack] = &[
    ReadyStack {
        name: "can-to-modbus",
        about: "a CAN interface of the kernel, a program, Modbus TCP and a recorder",
        files: files!("can-to-modbus": "README.md", "main.st", "stack.toml"),
    },
    ReadyStack {
        name: "canopen-io",
        about: "a CANopen master, two simulated I/O nodes, a program, Modbus TCP and a recorder",
        files: files!("canopen-io": "README.md", "io401.eds", "main.st", "stack.toml"),
    },
    ReadyStack {
        name: "conveyor",
        about: "a conveyor's CAN bus, a program, Modbus TCP and a recorder",
        files: files!("conveyor": "README.md", "conveyor.log", "main.st", "stack.toml"),
    },
    ReadyStack {
        name: "meter-logger",
        about: "a Modbus master, a simulated energy meter, a program that watches it, and a recorder",
        files: files!("meter-logger": "README.md", "logger.st", "meter.st", "stack.toml"),
    },
    ReadyStack {
        name: "modbus-gateway",
        about: "Modbus TCP masters on one side, the units of an RS-485 line on the other",
        files: files!("modbus-gateway": "README.md", "stack.toml"),
    },
];

/// The ready stack of this name.
pub fn find(name: &str) -> Option<&'static ReadyStack> {
    STACKS.iter().find(|s| s.name == name)
}

/// Why a ready stack could not be written.
#[derive(Debug, thiserror::Error)]
pub enum WriteError {
    #[error("{0} exists; nothing was written. Name another folder, or remove the file")]
    Exists(PathBuf),
    #[error("cannot write {path}: {source}; check the folder's permissions and free space")]
    Io { path: PathBuf, source: io::Error },
}

impl ReadyStack {
    /// Writes all files into a folder, made when missing. Overwrites nothing: when one of the files exists, none
    /// is written.
    pub fn write_to(&self, dir: &Path) -> Result<(), WriteError> {
        for (name, _) in self.files {
            let path = dir.join(name);
            if path.symlink_metadata().is_ok() {
                return Err(WriteError::Exists(path));
            }
        }
        for (name, content) in self.files {
            let path = dir.join(name);
            let folder = path.parent().unwrap_or(dir);
            write(folder, &path, content).map_err(|source| WriteError::Io { path, source })?;
        }
        Ok(())
    }
}

fn write(folder: &Path, path: &Path, content: &[u8]) -> io::Result<()> {
    use io::Write;
    std::fs::create_dir_all(folder)?;
    std::fs::OpenOptions::new().write(true).create_new(true).open(path)?.write_all(content)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn walk(dir: &Path, base: &Path, found: &mut Vec<String>) {
        for entry in std::fs::read_dir(dir).into_iter().flatten().flatten() {
            let path = entry.path();
            if path.is_dir() {
                walk(&path, base, found);
            } else {
                found.push(path.strip_prefix(base).unwrap().display().to_string());
            }
        }
    }

    #[test]
    fn every_file_of_the_folders_is_listed() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("stacks");
        let mut folders = Vec::new();
        for entry in std::fs::read_dir(&root).into_iter().flatten().flatten() {
            folders.push(entry.file_name().into_string().unwrap());
        }
        folders.sort();
        let mut names: Vec<_> = STACKS.iter().map(|s| s.name.to_owned()).collect();
        names.sort();
        assert_eq!(names, folders, "launcher/stacks and STACKS differ");
        for stack in STACKS {
            let mut there = Vec::new();
            walk(&root.join(stack.name), &root.join(stack.name), &mut there);
            let mut listed: Vec<_> = stack.files.iter().map(|(n, _)| (*n).to_owned()).collect();
            there.sort();
            listed.sort();
            assert_eq!(listed, there, "files of stack {}", stack.name);
            assert!(listed.iter().any(|n| n == "stack.toml") && !stack.about.is_empty());
        }
    }

    #[test]
    fn nothing_is_overwritten() {
        let ready = ReadyStack { name: "t", about: "", files: &[("a.txt", b"a"), ("sub/b.txt", b"b")] };
        let dir = std::env::temp_dir().join(format!("dinrail-stacks-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&dir);
        ready.write_to(&dir).unwrap();
        assert_eq!(std::fs::read(dir.join("sub/b.txt")).unwrap(), b"b");
        std::fs::remove_file(dir.join("a.txt")).unwrap();
        std::fs::write(dir.join("sub/b.txt"), "mine").unwrap();
        assert!(matches!(ready.write_to(&dir), Err(WriteError::Exists(p)) if p.ends_with("sub/b.txt")));
        assert!(!dir.join("a.txt").exists());
        assert_eq!(std::fs::read(dir.join("sub/b.txt")).unwrap(), b"mine");
        std::fs::remove_dir_all(&dir).unwrap();
    }
}
