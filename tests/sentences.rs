//! What a user reads when something is wrong: the sentence, the place, the remedy; and the exit code.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod support;

use std::process::Output;
use support::{Scratch, Stack, dinrail, free_port};

fn check(text: &str, files: &[(&str, &str)]) -> (i32, String) {
    let scratch = Scratch::new("sentence");
    for (name, content) in files {
        scratch.write(name, content);
    }
    let output = dinrail().arg("check").arg(scratch.write("stack.toml", text)).output().unwrap();
    (output.status.code().unwrap(), both(&output))
}

fn both(output: &Output) -> String {
    format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr))
}

#[track_caller]
fn says(text: &str, parts: &[&str]) {
    for part in parts {
        assert!(text.contains(part), "'{part}' is missing in:\n{text}");
    }
}

const PLC: &str = "[stack]\nname = \"s\"\n[[service]]\nname = \"plc\"\nkind = \"plc\"\nprogram = [\"main.st\"]\ncycle = \"10ms\"\n";

#[test]
fn an_unknown_key_names_line_and_nearest_key() {
    let text = PLC.replace("cycle =", "cicle =");
    let (code, said) = check(&text, &[("main.st", "PROGRAM p VAR x : INT; END_VAR x := 1; END_PROGRAM")]);
    assert_eq!(code, 1, "{said}");
    says(&said, &["stack.toml:7", "cicle", "cycle"]);
}

#[test]
fn a_range_owned_twice_names_both_lines() {
    let input = "[[service.in]]\nid = 0x100\nstart = 0\nlen = 16\nto = \"%IW0\"\ntype = \"INT\"\n";
    let text = format!(
        "[stack]\nname = \"s\"\n[[service]]\nname = \"can0\"\nkind = \"can\"\nbackend = \"virtual\"\n\
         [[service]]\nname = \"io\"\nkind = \"can-io\"\nbus = \"can0\"\n{input}{}[[service]]\nname = \"plc\"\nkind = \"plc\"\ncycle = \"10ms\"\n",
        input.replace("0x100", "0x101")
    );
    let (code, said) = check(&text, &[]);
    assert_eq!(code, 1, "{said}");
    says(&said, &["line 15", "line 21", "%IB0"]);
}

#[test]
fn a_missing_program_names_the_file() {
    let (code, said) = check(PLC, &[]);
    assert_eq!(code, 1, "{said}");
    says(&said, &["stack.toml:6", "main.st"]);
}

#[test]
fn a_program_that_does_not_compile_names_its_line() {
    let (code, said) =
        check(PLC, &[("main.st", "PROGRAM p\nVAR x : INT; END_VAR\nx := nowhere + 1;\nEND_PROGRAM\n")]);
    assert_eq!(code, 1, "{said}");
    says(&said, &["main.st:3", "nowhere"]);
}

#[test]
fn a_service_that_is_not_there_yet_says_so() {
    let text = "[stack]\nname = \"s\"\n[[service]]\nname = \"io\"\nkind = \"j1939\"\n";
    let (code, said) = check(text, &[]);
    assert_eq!(code, 1, "{said}");
    says(&said, &["stack.toml:5", "j1939", "not supported"]);
}

#[test]
fn a_taken_port_is_named_with_its_service_and_nothing_is_half_started() {
    let port = free_port();
    let _taken = std::net::TcpListener::bind(("127.0.0.1", port)).unwrap();
    let text = format!(
        "[stack]\nname = \"NAME\"\n[[service]]\nname = \"plc\"\nkind = \"plc\"\ncycle = \"10ms\"\n\
         [[service]]\nname = \"modbus\"\nkind = \"modbus-server\"\ntcp = {{ address = \"127.0.0.1\", port = {port} }}\n"
    );
    let mut stack = Stack::spawn("taken", &text, &[]);
    assert_eq!(stack.wait_end(), 1, "{}", stack.log());
    says(&stack.log(), &["modbus", &port.to_string(), "in use"]);
    assert_eq!(stack.leftovers(), Vec::<String>::new());
}

#[test]
fn a_stack_that_runs_already_names_its_pid() {
    let text = "[stack]\nname = \"NAME\"\n[[service]]\nname = \"plc\"\nkind = \"plc\"\ncycle = \"10ms\"\n";
    let mut stack = Stack::up("twice", text, &[]);
    let second = dinrail().arg("up").arg(stack.scratch.0.join("stack.toml")).output().unwrap();
    assert_eq!(second.status.code(), Some(1));
    says(&both(&second), &["already running", &format!("pid {}", stack.launcher.id())]);
    assert!(stack.is_ready("plc"), "the first one goes on");
    assert_eq!(stack.take_down(), 0);
}

#[test]
fn a_program_fault_names_place_instance_and_values() {
    let program = "PROGRAM p\nVAR i : INT; a : ARRAY [0..9] OF INT; END_VAR\ni := i + 1;\nIF i > 50 THEN a[i] := 1; END_IF;\nEND_PROGRAM\n";
    let text = PLC.replace("\"s\"", "\"NAME\"");
    let mut stack = Stack::up("fault", &text, &[("main.st", program)]);
    stack.wait("the fault in the log", || stack.log().contains("out of bounds").then_some(()));
    says(&stack.log(), &["main.st:4", "51", "i = 51"]);
    assert_eq!(stack.generation("plc"), 1, "the process lives on");
    let status = stack.ok(&["plc", "status"]);
    says(&status, &["fault"]);
    assert_eq!(stack.take_down(), 0);
}

#[test]
fn an_unknown_command_is_a_usage_error() {
    let output = dinrail().arg("fly").output().unwrap();
    assert_eq!(output.status.code(), Some(2));
}

#[test]
fn a_stack_that_does_not_run_says_so() {
    let output = dinrail().args(["ps", "--stack", "no-such-stack"]).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    says(&both(&output), &["no-such-stack"]);
}

#[test]
fn a_new_stack_has_its_folders_name_and_is_accepted() {
    let scratch = Scratch::new("new");
    let dir = scratch.0.join("my-gateway");
    let made = dinrail().args(["new", "--from", "conveyor"]).arg(&dir).output().unwrap();
    assert!(made.status.success(), "{}", both(&made));
    says(&std::fs::read_to_string(dir.join("stack.toml")).unwrap(), &["name = \"my-gateway\""]);
    let checked = dinrail().arg("check").arg(&dir).output().unwrap();
    assert!(checked.status.success(), "{}", both(&checked));
    let again = dinrail().args(["new", "--from", "conveyor"]).arg(&dir).output().unwrap();
    assert_eq!(again.status.code(), Some(1));
    says(&both(&again), &["exists", "nothing was written"]);
}

#[test]
fn what_is_no_file_is_refused_and_not_read_for_ever() {
    let output = dinrail().args(["check", "/dev/zero"]).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    says(&both(&output), &["no regular file"]);
}
