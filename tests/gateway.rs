//! The main job on real input: CAN frames in, a program in between, Modbus TCP out, every message recorded.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod support;

use std::fs;
use support::car::{self, expected_registers, frames_of_log};
use support::{Stack, cases, free_port, peers};

#[test]
fn a_real_car_is_decoded_by_the_program_read_by_modbus_and_recorded_frame_by_frame() {
    let Some(cases) = cases() else { return };
    let log_path = cases.join(car::LOG);
    let frames = frames_of_log(&fs::read_to_string(&log_path).unwrap());
    assert_eq!(frames.len(), car::FRAMES);
    let (can_port, modbus_port) = (free_port(), free_port());
    let Some(mut player) = peers::peer("play_candump.py") else { return };

    let mut stack =
        Stack::up("car", &car::on_a_virtual_bus(can_port, modbus_port), &[("car.st", car::PROGRAM)]);
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
                "-o",
                "10",
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
