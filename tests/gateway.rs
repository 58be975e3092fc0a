//! The main job on real input: CAN frames in, a program in between, Modbus TCP out, every message recorded.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod support;

use std::collections::HashMap;
use std::fs;
use support::{Stack, cases, free_port, peers};

/// `ID#DATA` of every line of a candump log.
fn frames_of_log(text: &str) -> Vec<String> {
    text.lines().filter_map(|line| line.split_whitespace().nth(2)).map(str::to_owned).collect()
}

fn stack_text(can_port: u16, modbus_port: u16) -> String {
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
serve = {{ socketcand = "127.0.0.1:{can_port}" }}

[[service]]
name = "io"
kind = "can-io"
bus = "can0"

[[service.in]]
id = 0x102
start = 0
len = 16
to = "%IW0"
type = "UINT"
symbol = "SteerRaw"

[[service.in]]
id = 0x116
start = 7
len = 16
order = "motorola"
to = "%IW1"
type = "UINT"
symbol = "SpeedRaw"

[[service.in]]
id = 0x106
start = 16
len = 16
signed = true
to = "%IW2"
type = "INT"
symbol = "TorqueRaw"

[[service]]
name = "plc"
kind = "plc"
program = ["car.st"]
cycle = "5ms"

[[service]]
name = "modbus"
kind = "modbus-server"
tcp = {{ address = "127.0.0.1", port = {modbus_port} }}
"#
    )
}

const PROGRAM: &str = r"
PROGRAM car
VAR
  Steer AT %MW0 : UINT;
  Speed AT %MW1 : UINT;
  Torque AT %MW2 : INT;
  Sum AT %MD2 : DINT;
  Scaled AT %MD3 : REAL;
END_VAR
  Steer := SteerRaw;
  Speed := SpeedRaw / 2 + 1;
  Torque := ABS(TorqueRaw);
  Sum := UINT_TO_DINT(SteerRaw) + UINT_TO_DINT(SpeedRaw) - INT_TO_DINT(TorqueRaw);
  Scaled := UINT_TO_REAL(SpeedRaw) * 0.01 - 40.0;
END_PROGRAM
";

/// What the program makes of the last frames of a log, as holding registers 0-7.
fn expected_registers(frames: &[String]) -> Vec<u16> {
    let mut last: HashMap<&str, Vec<u8>> = HashMap::new();
    for frame in frames {
        let (id, data) = frame.split_once('#').unwrap();
        let bytes =
            (0..data.len() / 2).map(|i| u8::from_str_radix(&data[2 * i..2 * i + 2], 16).unwrap()).collect();
        last.insert(id, bytes);
    }
    let steer = u16::from_le_bytes([last["102"][0], last["102"][1]]);
    let speed = u16::from_be_bytes([last["116"][0], last["116"][1]]);
    let torque = i16::from_le_bytes([last["106"][2], last["106"][3]]);
    let sum = i32::from(steer) + i32::from(speed) - i32::from(torque);
    let scaled = (f32::from(speed) * 0.01 - 40.0).to_bits();
    vec![
        steer,
        speed / 2 + 1,
        torque.unsigned_abs(),
        0,
        sum as u16,
        (sum >> 16) as u16,
        scaled as u16,
        (scaled >> 16) as u16,
    ]
}

#[test]
fn a_real_car_is_decoded_by_the_program_read_by_modbus_and_recorded_frame_by_frame() {
    let Some(cases) = cases() else { return };
    let log_path = cases.join("canlogs/savvycan/examples_candump.log");
    let frames = frames_of_log(&fs::read_to_string(&log_path).unwrap());
    assert_eq!(frames.len(), 12_974);
    let (can_port, modbus_port) = (free_port(), free_port());
    let Some(mut player) = peers::peer("play_candump.py") else { return };

    let mut stack = Stack::up("car", &stack_text(can_port, modbus_port), &[("car.st", PROGRAM)]);
    let played = player
        .args(["127.0.0.1", &can_port.to_string(), "can0"])
        .arg(&log_path)
        .arg("4000")
        .output()
        .unwrap();
    assert!(played.status.success(), "{}", String::from_utf8_lossy(&played.stderr));
    assert_eq!(String::from_utf8_lossy(&played.stdout).trim(), "12974");

    let expected = expected_registers(&frames).iter().map(u16::to_string).collect::<Vec<_>>().join(",");
    stack.wait("pymodbus reads what the program decoded", || {
        let output = peers::peer("modbus_read.py")
            .unwrap()
            .args([&modbus_port.to_string(), "holding", "0", "8"])
            .output()
            .unwrap();
        let got = String::from_utf8_lossy(&output.stdout).trim().to_owned();
        (got == expected).then_some(())
    });
    if let Some(mut mbpoll) = peers::program("mbpoll", "mbpoll") {
        let output = mbpoll
            .args([
                "-m",
                "tcp",
                "-p",
                &modbus_port.to_string(),
                "-0",
                "-r",
                "0",
                "-c",
                "2",
                "-t",
                "4",
                "-1",
                "127.0.0.1",
            ])
            .output()
            .unwrap();
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        let first = expected.split(',').next().unwrap();
        assert!(text.contains(&format!("[0]: \t{first}")), "mbpoll reads {text}");
    }

    assert_eq!(stack.take_down(), 0, "{}", stack.log());
    let recorded =
        peers::peer("frames_of.py").unwrap().arg("can0/rx").args(stack.recordings()).output().unwrap();
    assert!(recorded.status.success(), "{}", String::from_utf8_lossy(&recorded.stderr));
    let recorded: Vec<_> = String::from_utf8(recorded.stdout).unwrap().lines().map(str::to_owned).collect();
    assert_eq!(recorded.len(), frames.len(), "every frame is in the recording");
    for (n, (got, sent)) in recorded.iter().zip(&frames).enumerate() {
        assert_eq!(got, sent, "frame {n}");
    }

    for recording in stack.recordings() {
        let verified = support::dinrail().args(["replay", "--verify"]).arg(&recording).output().unwrap();
        assert_eq!(
            verified.status.code(),
            Some(0),
            "{}\n{}",
            String::from_utf8_lossy(&verified.stdout),
            String::from_utf8_lossy(&verified.stderr)
        );
    }
}
