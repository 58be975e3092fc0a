//! A log of a real car, a stack that decodes and records it, and what must come out.

use std::collections::HashMap;

/// Where the log stands among the cases.
pub const LOG: &str = "canlogs/savvycan/examples_candump.log";
/// Frames of the log.
pub const FRAMES: usize = 12_974;

/// `ID#DATA` of every line of a candump log.
pub fn frames_of_log(text: &str) -> Vec<String> {
    text.lines().filter_map(|line| line.split_whitespace().nth(2)).map(str::to_owned).collect()
}

/// The stack with a bus of its own.
pub fn on_a_virtual_bus(can_port: u16, modbus_port: u16) -> String {
    let can = format!("backend = \"virtual\"\nserve = {{ socketcand = \"127.0.0.1:{can_port}\" }}");
    stack_text("NAME", &can, modbus_port)
}

/// The stack on an interface of the kernel.
pub fn on_an_interface(name: &str, interface: &str, modbus_port: u16) -> String {
    stack_text(name, &format!("backend = \"socketcan\"\ninterface = \"{interface}\""), modbus_port)
}

fn stack_text(name: &str, can: &str, modbus_port: u16) -> String {
    format!(
        r#"
[stack]
name = "{name}"

[[service]]
name = "rec"
kind = "recorder"
dir = "recordings"

[[service]]
name = "can0"
kind = "can"
{can}

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

/// Decodes it.
pub const PROGRAM: &str = r"
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
pub fn expected_registers(frames: &[String]) -> Vec<u16> {
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
