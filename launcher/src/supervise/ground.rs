//! What a stack stands on: its folder in shared memory, its listeners, its RETAIN memory, its descriptor limit.
//! Made before the first process starts, removed after the last one ended.

use super::state_dir;
use ipc_types::Stack;
use ipc_types::rail::{self, CONFIG_FILE, RailError, STACK_FILE};
use ipc_types::wiring::Listener;
use rustix::fs::{MemfdFlags, SealFlags};
use rustix::process::{Pid, PidfdFlags, Resource, Rlimit, Signal};
use std::fs::DirBuilder;
use std::io;
use std::net::{SocketAddr, TcpListener};
use std::os::fd::OwnedFd;
use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Why a stack could not be prepared. Nothing has been started when one of these comes.
#[derive(Debug, thiserror::Error)]
pub enum GroundError {
    #[error("{0} already exists and is not a folder of yours: remove it, or give the stack another name")]
    Foreign(PathBuf),
    #[error("another launcher answers in {0}: stop it first (`dinrail down`)")]
    Answers(PathBuf),
    #[error(
        "process {0} of an earlier run of this stack does not end, even after SIGKILL: see `ps -o stat,wchan {0}`"
    )]
    Leftover(u32),
    #[error("shared memory {path}: {source}; is /dev/shm mounted, writable and not full?")]
    Folder { path: PathBuf, source: io::Error },
    #[error(transparent)]
    Rail(#[from] RailError),
    #[error("service '{service}', {key}: cannot listen on {address}: {cause}")]
    Listen { service: String, key: String, address: SocketAddr, cause: String },
    #[error("service '{service}': {bytes} bytes of RETAIN memory: {source}")]
    Retain { service: String, bytes: u32, source: io::Error },
}

/// Removes what an earlier run left, its processes too. Call with the stack's lock held.
pub fn clear(root: &Path, prefix: &str) -> Result<(), GroundError> {
    if root.exists() {
        if state_dir::answers(root) {
            return Err(GroundError::Answers(root.to_owned()));
        }
        end_leftovers(root)?;
    }
    wipe(root, prefix)
}

/// [`clear`]s, and makes the stack's folder with its two files.
pub fn prepare(stack: &Stack) -> Result<(), GroundError> {
    clear(&stack.root, &stack.prefix)?;
    let fail = |source| GroundError::Folder { path: stack.root.clone(), source };
    DirBuilder::new().mode(0o700).create(&stack.root).map_err(fail)?;
    let write = |name: &str, text: &[u8]| {
        let path = stack.root.join(name);
        std::fs::write(&path, text).map_err(|source| RailError::Write { path, source })
    };
    write(CONFIG_FILE, rail::config_text(&stack.root, &stack.prefix).as_bytes())?;
    let text = serde_json::to_vec(stack).map_err(|e| fail(io::Error::other(e)))?;
    write(STACK_FILE, &text)?;
    Ok(())
}

/// Removes the stack's folder and its objects in shared memory, and nothing else.
pub fn wipe(root: &Path, prefix: &str) -> Result<(), GroundError> {
    let fail = |source| GroundError::Folder { path: root.to_owned(), source };
    match std::fs::symlink_metadata(root) {
        Ok(found) if !found.is_dir() || found.uid() != rustix::process::getuid().as_raw() => {
            return Err(GroundError::Foreign(root.to_owned()));
        }
        Ok(_) => std::fs::remove_dir_all(root).map_err(fail)?,
        Err(e) if e.kind() == io::ErrorKind::NotFound => {}
        Err(e) => return Err(fail(e)),
    }
    // An empty prefix would match the objects of everybody.
    let Some(shm) = root.parent().filter(|_| prefix.len() >= 4) else { return Ok(()) };
    for entry in std::fs::read_dir(shm).map_err(fail)?.flatten() {
        if entry.file_name().as_encoded_bytes().starts_with(prefix.as_bytes()) {
            let _ = std::fs::remove_file(entry.path());
        }
    }
    Ok(())
}

/// Kills services of this root whose launcher was killed while they were stopped or hanging.
fn end_leftovers(root: &Path) -> Result<(), GroundError> {
    let root = root.as_os_str().as_encoded_bytes();
    for entry in std::fs::read_dir("/proc").into_iter().flatten().flatten() {
        let Some(pid) = entry.file_name().to_str().and_then(|n| n.parse::<i32>().ok()) else { continue };
        // Before the look: who has the number then is whom the descriptor means.
        let Some(pidfd) =
            Pid::from_raw(pid).and_then(|p| rustix::process::pidfd_open(p, PidfdFlags::empty()).ok())
        else {
            continue;
        };
        let Ok(line) = std::fs::read(entry.path().join("cmdline")) else { continue };
        let words: Vec<&[u8]> = line.split(|b| *b == 0).collect();
        if words.get(1) != Some(&b"__service".as_slice()) || !words.contains(&root) {
            continue;
        }
        let _ = rustix::process::pidfd_send_signal(&pidfd, Signal::KILL);
        let begin = Instant::now();
        while rustix::process::pidfd_send_signal(&pidfd, Signal::KILL).is_ok() && alive(pid) {
            if begin.elapsed() > Duration::from_secs(2) {
                return Err(GroundError::Leftover(pid as u32));
            }
            std::thread::sleep(Duration::from_millis(5));
        }
    }
    Ok(())
}

/// Not gone and not a zombie.
fn alive(pid: i32) -> bool {
    std::fs::read_to_string(format!("/proc/{pid}/stat"))
        .is_ok_and(|s| !s.rsplit(')').next().is_some_and(|rest| rest.trim_start().starts_with('Z')))
}

/// Allows as many descriptors as the system lets us: about 15 a topic and process.
pub fn raise_descriptor_limit() {
    let limit = rustix::process::getrlimit(Resource::Nofile);
    let _ = rustix::process::setrlimit(
        Resource::Nofile,
        Rlimit { current: limit.maximum, maximum: limit.maximum },
    );
}

/// Opens a listener of a service.
pub fn listen(service: &str, listener: &Listener) -> Result<TcpListener, GroundError> {
    TcpListener::bind(listener.address).and_then(|l| l.set_nonblocking(true).map(|()| l)).map_err(|e| {
        GroundError::Listen {
            service: service.to_owned(),
            key: listener.key.clone(),
            address: listener.address,
            cause: explain_bind(listener.address, &e),
        }
    })
}

fn explain_bind(address: SocketAddr, error: &io::Error) -> String {
    let port = address.port();
    match error.kind() {
        io::ErrorKind::AddrInUse => match holder_of(port) {
            Some((pid, name)) => {
                format!("port {port} is in use by '{name}', pid {pid}; stop it or choose another port")
            }
            None => format!(
                "port {port} is in use by another program (`ss -ltnp 'sport = {port}'` as root names it); stop it or \
                 choose another port"
            ),
        },
        io::ErrorKind::PermissionDenied => format!(
            "not permitted: ports below 1024 need a privilege; allow it with `sudo setcap cap_net_bind_service=+ep \
             $(readlink -f $(which dinrail))` or `sudo sysctl net.ipv4.ip_unprivileged_port_start={port}`, or choose a \
             port from 1024 up"
        ),
        io::ErrorKind::AddrNotAvailable => format!(
            "this machine has no address {}; `ip address` lists those it has, 0.0.0.0 means all",
            address.ip()
        ),
        _ => error.to_string(),
    }
}

/// Which process of this user listens on a port; others' descriptors cannot be seen.
fn holder_of(port: u16) -> Option<(u32, String)> {
    let inodes: Vec<String> = ["/proc/net/tcp", "/proc/net/tcp6"]
        .iter()
        .filter_map(|file| std::fs::read_to_string(file).ok())
        .flat_map(|text| listening_inodes(&text, port))
        .map(|inode| format!("socket:[{inode}]"))
        .collect();
    for entry in std::fs::read_dir("/proc").ok()?.flatten() {
        let Some(pid) = entry.file_name().to_str().and_then(|n| n.parse::<u32>().ok()) else { continue };
        let Ok(fds) = std::fs::read_dir(entry.path().join("fd")) else { continue };
        for fd in fds.flatten() {
            let holds = std::fs::read_link(fd.path())
                .is_ok_and(|target| inodes.iter().any(|i| target.as_os_str() == i.as_str()));
            if holds {
                let name = std::fs::read_to_string(entry.path().join("comm")).unwrap_or_default();
                return Some((pid, name.trim().to_owned()));
            }
        }
    }
    None
}

/// Inodes of sockets in state LISTEN (0A) on a port, from the text of `/proc/net/tcp`.
fn listening_inodes(text: &str, port: u16) -> Vec<u64> {
    let inode = |line: &str| {
        let fields: Vec<&str> = line.split_whitespace().collect();
        let local = fields.get(1)?.rsplit_once(':')?.1;
        (u16::from_str_radix(local, 16).ok()? == port && *fields.get(3)? == "0A")
            .then(|| fields.get(9)?.parse().ok())
            .flatten()
    };
    text.lines().filter_map(inode).collect()
}

/// RETAIN memory of a service: held by the launcher over restarts, of fixed size, zero at first.
pub fn retain_memory(service: &str, bytes: u32) -> Result<OwnedFd, GroundError> {
    let make = || -> rustix::io::Result<OwnedFd> {
        let fd = rustix::fs::memfd_create("dinrail-retain", MemfdFlags::CLOEXEC | MemfdFlags::ALLOW_SEALING)?;
        rustix::fs::ftruncate(&fd, u64::from(bytes))?;
        rustix::fs::fcntl_add_seals(&fd, SealFlags::SHRINK | SealFlags::GROW | SealFlags::SEAL)?;
        Ok(fd)
    };
    make().map_err(|e| GroundError::Retain { service: service.to_owned(), bytes, source: e.into() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_taken_port_names_its_holder() {
        let held = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = held.local_addr().unwrap();
        let listener = Listener { name: "modbus".into(), address, key: "tcp.port".into() };
        let message = listen("modbus", &listener).unwrap_err().to_string();
        let start = format!(
            "service 'modbus', tcp.port: cannot listen on {address}: port {} is in use",
            address.port()
        );
        assert!(message.starts_with(&start), "{message}");
        assert!(message.contains(&format!("pid {}", std::process::id())), "{message}");
    }

    #[test]
    fn an_address_of_another_machine_is_told_apart() {
        let address = "192.0.2.1:15020".parse().unwrap();
        let listener = Listener { name: "modbus".into(), address, key: "tcp.address".into() };
        let message = listen("modbus", &listener).unwrap_err().to_string();
        assert!(message.contains("this machine has no address 192.0.2.1"), "{message}");
    }

    #[test]
    fn a_port_without_privilege_names_the_remedies() {
        let error = io::Error::from(io::ErrorKind::PermissionDenied);
        let message = explain_bind("0.0.0.0:502".parse().unwrap(), &error);
        assert!(message.contains("setcap cap_net_bind_service=+ep"), "{message}");
        assert!(message.contains("ip_unprivileged_port_start=502"), "{message}");
    }

    #[test]
    fn only_listening_sockets_count() {
        let text = "  sl  local_address rem_address   st tx_queue rx_queue tr tm->when retrnsmt   uid  timeout inode\n\
                    0: 0100007F:05DE 00000000:0000 0A 00000000:00000000 00:00000000 00000000  1000        0 777 1 x\n\
                    1: 0100007F:05DE 0100007F:9999 01 00000000:00000000 00:00000000 00000000  1000        0 778 1 x\n\
                    2: 0100007F:05DF 00000000:0000 0A 00000000:00000000 00:00000000 00000000  1000        0 779 1 x\n";
        assert_eq!(listening_inodes(text, 1502), [777]);
        assert!(listening_inodes("garbage\n: : :\n", 1502).is_empty());
    }

    #[test]
    fn retain_memory_cannot_change_its_size() {
        let fd = retain_memory("plc", 4096).unwrap();
        assert_eq!(rustix::fs::fstat(&fd).unwrap().st_size, 4096);
        assert!(rustix::fs::ftruncate(&fd, 8192).is_err());
    }

    #[test]
    fn only_the_stacks_own_objects_are_wiped() {
        let shm = std::env::temp_dir().join(format!("dinrail-wipe-{}", std::process::id()));
        let root = shm.join("dr00000001");
        std::fs::create_dir_all(root.join("services")).unwrap();
        for name in ["dr00000001_a.data", "dr00000002_a.data", "other"] {
            std::fs::write(shm.join(name), "").unwrap();
        }
        wipe(&root, "dr00000001_").unwrap();
        wipe(&root, "dr00000001_").unwrap();
        wipe(&root, "").unwrap();
        let mut left: Vec<_> = std::fs::read_dir(&shm).unwrap().map(|e| e.unwrap().file_name()).collect();
        left.sort();
        assert_eq!(left, ["dr00000002_a.data", "other"]);
        std::fs::write(&root, "").unwrap();
        assert!(matches!(wipe(&root, "dr00000001_"), Err(GroundError::Foreign(_))));
        std::fs::remove_dir_all(&shm).unwrap();
    }
}
