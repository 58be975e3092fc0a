//! `dinrail top` on a terminal: a pty of a given size, keys written to it, the screen read back. And `dinrail
//! status`, which tells the same to programs.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod support;

use rustix::fs::OFlags;
use rustix::process::{Pid, Signal, kill_process};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{Action, LocalModes, Termios, Winsize, tcflow, tcgetattr, tcsetwinsize};
use serde_json::Value;
use std::io::{Read, Write};
use std::process::{Child, ExitStatus, Stdio};
use std::time::{Duration, Instant};
use support::{PATIENCE, Stack, dinrail, free_port};

const PROGRAM: &str =
    "PROGRAM main\nVAR n : UDINT; out AT %QW0 : UINT; END_VAR\nn := n + 1;\nout := 4660;\nEND_PROGRAM\n";

fn stack(name: &str) -> Stack {
    Stack::up(name, &stack_text(), &[("main.st", PROGRAM)])
}

fn stack_text() -> String {
    format!(
        r#"
[stack]
name = "NAME"

[[service]]
name = "rec"
kind = "recorder"
dir = "recordings"

[[service]]
name = "can0"
kind = "can"
backend = "virtual"

[[service]]
name = "io"
kind = "can-io"
bus = "can0"

[[service.out]]
id = 0x210
dlc = 2
mode = "cyclic"
period = "100ms"
signals = [{{ start = 0, len = 16, from = "%QW0", type = "UINT", symbol = "Command" }}]

[[service]]
name = "plc"
kind = "plc"
program = ["main.st"]
cycle = "10ms"

[[service]]
name = "modbus"
kind = "modbus-server"
tcp = {{ address = "127.0.0.1", port = {} }}
"#,
        free_port()
    )
}

/// `dinrail top` on a pty of its own.
struct Screen {
    master: std::fs::File,
    child: Child,
    /// All that it wrote.
    written: Vec<u8>,
    /// Kept open, so that the modes can be looked at after the end.
    slave: std::fs::File,
    before: Termios,
}

impl Screen {
    fn open(stack: &str, columns: u16, rows: u16) -> Self {
        let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC).unwrap();
        grantpt(&master).unwrap();
        unlockpt(&master).unwrap();
        let path = ptsname(&master, Vec::new()).unwrap();
        let slave = rustix::fs::open(path, OFlags::RDWR | OFlags::NOCTTY, rustix::fs::Mode::empty()).unwrap();
        tcsetwinsize(&slave, Winsize { ws_row: rows, ws_col: columns, ws_xpixel: 0, ws_ypixel: 0 }).unwrap();
        let before = tcgetattr(&slave).unwrap();
        let slave = std::fs::File::from(slave);
        let end = || Stdio::from(slave.try_clone().unwrap());
        let child = dinrail()
            .args(["top", "--stack", stack, "--every", "200ms"])
            .env("TERM", "xterm-256color")
            .stdin(end())
            .stdout(end())
            .stderr(end())
            .spawn()
            .unwrap();
        rustix::io::ioctl_fionbio(&master, true).unwrap();
        Self { master: master.into(), child, written: Vec::new(), slave, before }
    }

    fn read(&mut self) {
        let mut chunk = [0u8; 65536];
        while let Ok(n @ 1..) = self.master.read(&mut chunk) {
            self.written.extend_from_slice(&chunk[..n]);
        }
    }

    /// Waits until a text was written.
    fn wait_until_shown(&mut self, text: &str) {
        let begin = Instant::now();
        loop {
            self.read();
            let plain = plain(&self.written);
            if plain.contains(text) {
                return;
            }
            assert!(begin.elapsed() < PATIENCE, "never on the screen: {text}\n{plain}");
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// The same, and forgets all that was written: what comes next is waited for anew. The screen sends only what
    /// changed, so it must be a text that is not there yet.
    fn wait_for(&mut self, text: &str) {
        self.wait_until_shown(text);
        self.written.clear();
    }

    fn press(&mut self, keys: &str) {
        self.master.write_all(keys.as_bytes()).unwrap();
    }

    fn wait_for_exit(&mut self) -> ExitStatus {
        let begin = Instant::now();
        loop {
            self.read();
            if let Some(status) = self.child.try_wait().unwrap() {
                return status;
            }
            assert!(begin.elapsed() < PATIENCE, "top does not end");
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    fn end(mut self) -> ExitStatus {
        let status = self.wait_for_exit();
        self.read();
        let text = String::from_utf8_lossy(&self.written);
        assert!(text.contains("\x1b[?1049l"), "the alternate screen was not left: {text:?}");
        assert!(text.contains("\x1b[?25h"), "the cursor stays hidden: {text:?}");
        let after = tcgetattr(&self.slave).unwrap();
        assert_eq!(
            (after.local_modes, after.input_modes, after.output_modes),
            (self.before.local_modes, self.before.input_modes, self.before.output_modes)
        );
        assert!(after.local_modes.contains(LocalModes::ICANON | LocalModes::ECHO));
        status
    }
}

impl Drop for Screen {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// What was written without escape sequences. Moves of the cursor become spaces, so that words stay apart.
fn plain(bytes: &[u8]) -> String {
    let text = String::from_utf8_lossy(bytes);
    let mut out = String::new();
    let mut chars = text.chars().peekable();
    while let Some(c) = chars.next() {
        if c != '\x1b' {
            out.push(c);
            continue;
        }
        if chars.next_if_eq(&'[').is_none() {
            continue;
        }
        let end = chars.by_ref().find(|c| ('@'..='~').contains(c));
        if end == Some('H') {
            out.push(' ');
        }
    }
    out
}

#[test]
fn top_shows_the_stack_takes_keys_and_leaves_the_terminal_as_it_was() {
    let mut stack = stack("top");
    let mut screen = Screen::open(&stack.name, 100, 40);
    for name in ["rec", "can0", "io", "plc", "modbus"] {
        screen.wait_until_shown(name);
    }
    screen.press("?");
    screen.wait_for("restart the selected service");
    screen.press("q");
    // The fourth service: the plc.
    screen.press("jjjr");
    screen.wait_for("restart plc? y/n");
    screen.press("y");
    screen.wait_for("ready again after");
    assert_eq!(stack.generation("plc"), 2);
    screen.press("l");
    screen.wait_for("log of plc");
    screen.press("q");
    screen.press("i");
    screen.wait_for("34 12");
    screen.press("qq");
    assert_eq!(screen.end().code(), Some(0));

    // Ctrl-C, SIGTERM and a very small terminal end as well.
    let mut screen = Screen::open(&stack.name, 30, 4);
    screen.wait_for("SERVICE");
    screen.press("\x03");
    assert_eq!(screen.end().code(), Some(0));
    let mut screen = Screen::open(&stack.name, 80, 24);
    screen.wait_for("SERVICE");
    kill_process(Pid::from_child(&screen.child), Signal::TERM).unwrap();
    assert_eq!(screen.end().code(), Some(0));

    // A service that dies, and the whole stack that goes.
    let mut screen = Screen::open(&stack.name, 120, 40);
    screen.wait_for("SERVICE");
    let generation = stack.generation("io");
    stack.kill("io", Signal::KILL);
    screen.wait_for("SIGKILL");
    stack.wait_generation_above("io", generation);
    assert_eq!(stack.take_down(), 0);
    screen.wait_for("is down; waiting for it to come back");
    screen.press("q");
    assert_eq!(screen.end().code(), Some(0));
}

#[test]
fn top_ends_with_its_terminal_and_by_every_signal() {
    let mut stack = stack("topgone");
    // The window is closed: no signal comes, reads and writes fail.
    let mut screen = Screen::open(&stack.name, 80, 24);
    screen.wait_for("SERVICE");
    screen.master = std::fs::File::open("/dev/null").unwrap();
    assert_eq!(screen.wait_for_exit().code(), Some(0));

    let mut screen = Screen::open(&stack.name, 80, 24);
    screen.wait_for("SERVICE");
    kill_process(Pid::from_child(&screen.child), Signal::HUP).unwrap();
    assert_eq!(screen.end().code(), Some(0));

    // A terminal that takes no output (Ctrl-S): the loop stands in a write.
    let mut screen = Screen::open(&stack.name, 80, 24);
    screen.wait_for("SERVICE");
    tcflow(&screen.slave, Action::OOff).unwrap();
    std::thread::sleep(Duration::from_millis(600));
    kill_process(Pid::from_child(&screen.child), Signal::TERM).unwrap();
    screen.wait_for_exit();
    tcflow(&screen.slave, Action::OOn).unwrap();
    assert_eq!(stack.take_down(), 0);
}

#[test]
fn without_a_terminal_the_way_for_programs_is_named() {
    let output = dinrail().arg("top").output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{errors}");
    assert!(errors.contains("`dinrail status --json`"), "{errors}");
}

#[test]
fn status_shows_every_service_or_those_asked_for() {
    let mut stack = stack("status");
    let text = stack.ok(&["status"]);
    for expected in [
        "is running, launcher pid",
        "\ncan0  can  ready",
        "\n  backend",
        "\nplc  plc  ready",
        "\n  scan_us.average",
    ] {
        assert!(text.contains(expected), "{expected} is missing:\n{text}");
    }
    let text = stack.ok(&["status", "plc"]);
    assert!(text.contains("\nplc  plc  ready") && !text.contains("\ncan0"), "{text}");
    let value: Value = serde_json::from_str(&stack.ok(&["status", "plc", "rec", "--json"])).unwrap();
    let list = value["service_list"].as_array().unwrap();
    assert_eq!(list.iter().map(|s| s["service"].as_str().unwrap()).collect::<Vec<_>>(), ["rec", "plc"]);
    assert_eq!(
        (&list[1]["status"]["state"], &list[1]["status"]["program"][0]),
        (&"run".into(), &"main.st".into())
    );
    let refused = stack.cli(&["status", "plv"]);
    let errors = String::from_utf8_lossy(&refused.stderr);
    assert_eq!(refused.status.code(), Some(1));
    assert!(errors.contains("no service 'plv'; did you mean 'plc'?"), "{errors}");
    assert_eq!(stack.take_down(), 0);
}

const NAMED: &str = "TYPE Mode : (Off, Auto := 5); END_TYPE
PROGRAM main
VAR n : UDINT; mode : Mode := Auto; pause : TIME := T#500ms; hold : TON; END_VAR
n := n + 1; hold(IN := TRUE, PT := pause);
END_PROGRAM
";

#[test]
fn variables_of_a_plc_are_named_as_people_name_them() {
    let mut stack = Stack::up("plcnames", &stack_text(), &[("main.st", NAMED)]);
    let list = stack.ok(&["plc", "list"]);
    for expected in ["main.mode", "Mode (Off, Auto)", "Command", "%QW0", "main.hold.ET"] {
        assert!(list.contains(expected), "{expected} is missing:\n{list}");
    }
    assert_eq!(stack.ok(&["plc", "read", "mode", "pause"]), "main.mode = Auto (5)\nmain.pause = T#500ms\n");
    assert!(stack.ok(&["plc", "read", "hold"]).contains("main.hold.PT = T#500ms\n"));
    assert_eq!(
        stack.ok(&["plc", "write", "mode=off", "pause=T#1m30s"]),
        "main.mode = Off (0)\nmain.pause = T#1m30s\n"
    );
    assert_eq!(stack.read("main.pause"), 90_000);
    let refused = |args: &[&str]| {
        let output = stack.cli(args);
        assert_eq!(output.status.code(), Some(1));
        String::from_utf8_lossy(&output.stderr).into_owned()
    };
    assert!(refused(&["plc", "read", "main.modee"]).contains("did you mean 'main.mode'?"));
    assert!(refused(&["plc", "force", "mode=Aut"]).contains("did you mean 'Auto'?"));
    let watched = stack.ok(&["plc", "watch", "n", "mode", "--every", "100ms", "--for", "1s", "--json"]);
    let looks: Vec<Value> = watched.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(
        (&looks[0]["values"]["main.mode"], &looks[0]["names"]["main.mode"]),
        (&0.into(), &"Off".into())
    );
    assert!(looks.len() > 1 && looks[1]["values"]["main.n"].is_u64(), "{watched}");
    assert!(looks[1]["values"]["main.mode"].is_null(), "it has not changed: {watched}");
    let status = stack.ok(&["plc", "status"]);
    assert!(
        status.contains("state    ") && status.contains("program  ") && !status.contains('{'),
        "{status}"
    );
    assert_eq!(stack.take_down(), 0);
}

#[test]
fn symbols_of_the_stack_work_without_a_program() {
    let text = stack_text().replace("program = [\"main.st\"]", "");
    let mut stack = Stack::up("plcnone", &text, &[]);
    assert_eq!(stack.ok(&["plc", "write", "Command=7"]), "Command = 7\n");
    assert_eq!(stack.ok(&["plc", "read", "command", "%QW0"]), "Command = 7\n%QW0 = 7\n");
    stack.ok(&["plc", "force", "Command=8"]);
    assert_eq!(stack.read("%QW0"), 8);
    stack.ok(&["plc", "unforce", "Command"]);
    assert_eq!(stack.take_down(), 0);
}

#[test]
fn jobs_for_a_plc_survive_its_restart() {
    let mut stack = stack("plcjobs");
    for round in 0..4 {
        let generation = stack.generation("plc");
        stack.kill("plc", Signal::KILL);
        // Sent to a dead process, to none, or to one that starts: answered by the next that runs.
        let begin = Instant::now();
        let text = stack.ok(&["plc", "read", "%QW0", "main.n"]);
        assert!(text.starts_with("%QW0 = "), "{text}");
        assert!(begin.elapsed() < PATIENCE, "round {round}");
        stack.wait_generation_above("plc", generation);
    }
    assert_eq!(stack.take_down(), 0);
}
