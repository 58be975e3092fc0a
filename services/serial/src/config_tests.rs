use super::*;
use serde_json::{Value, json};

fn config(mut value: Value) -> Config {
    if value.get("device").is_none() {
        value["device"] = json!("pty:com1");
    }
    serde_json::from_value(value).unwrap()
}

fn said(value: Value) -> String {
    config(value)
        .findings("com1", Path::new("/nonexistent"))
        .iter()
        .map(|f| format!("{:?} {}: {} -> {}", f.severity, f.key, f.message, f.help))
        .collect::<Vec<_>>()
        .join("\n")
}

#[test]
fn defaults_by_framing_and_preset() {
    let shown = |value| config(value).character().to_string();
    assert_eq!(shown(json!({})), "19200 8E1");
    assert_eq!(shown(json!({ "framing": "ascii" })), "19200 7E1");
    assert_eq!(shown(json!({ "preset": "device-L" })), "9600 8E1");
    assert_eq!(
        shown(json!({ "preset": "device-L", "baud": 1200, "parity": "none", "stop_bits": 2 })),
        "1200 8N2"
    );
    assert_eq!(config(json!({})), Config { device: "pty:com1".into(), ..Config::of_device("x") });
}

#[test]
fn the_kind_of_port_decides_what_time_means() {
    let c = config(json!({ "pace": true, "echo": "discard", "reply_delay": "5ms" }));
    let uart = c.settings(Kind::Uart);
    assert!(uart.framer.timed && !uart.pace && uart.discard_echo && uart.sender.half_duplex);
    let pty = c.settings(Kind::Pty);
    assert!(pty.framer.timed && pty.sender.paced && pty.pace);
    let plain = config(json!({ "framing": "raw" })).settings(Kind::Pty);
    assert!(!plain.framer.timed && !plain.sender.timed && !plain.sender.half_duplex);
    let rts = config(json!({ "rs485": "rts", "rts_delay_after": "300us", "framing": "raw" }));
    assert_eq!(rts.settings(Kind::Uart).sender.rts, Some((0, 300_000)));
    assert!(rts.settings(Kind::Uart).sender.half_duplex);
    assert_eq!(rts.options(Path::new("/")).unwrap().rts_on_send, Some(true));
    let kernel = config(json!({ "rs485": "kernel", "rts_on_send": false, "rts_delay_before": "2ms" }));
    let rs485 = kernel.options(Path::new("/")).unwrap().rs485.unwrap();
    assert_eq!((rs485.rts_on_send, rs485.delay_before_ms), (false, 2));
    for (grace, kind) in [(20_000_000, Kind::Usb), (50_000_000, Kind::Tcp), (16 * 572_917, Kind::Uart)] {
        let Mode::Rtu { grace_ns, .. } = config(json!({})).settings(kind).framer.mode else { panic!() };
        assert_eq!(grace_ns, grace);
    }
}

#[test]
fn mistakes() {
    let all = [
        said(json!({})),
        said(json!({ "device": "COM1" })),
        said(json!({ "device": "ttyUSB0" })),
        said(json!({ "device": "./serial/by-id/usb-x" })),
        said(json!({ "device": "lines/one" })),
        said(json!({ "device": "socket://nowhere" })),
        said(json!({ "device": "/dev/ttyNOTHERE", "data_bits": 7, "baud": 9 })),
        said(json!({ "framing": "ascii", "data_bits": 6, "stop_bits": 3 })),
        said(json!({ "parity": "none" })),
        said(json!({ "parity": "none", "stop_bits": 2 })),
        said(json!({ "parity": "none", "framing": "raw", "data_bits": 5 })),
        said(json!({ "flow": "xonxoff", "length": 4, "delimiter": "", "grace": "2min", "silence": "0" })),
        said(json!({ "framing": "length" })),
        said(json!({ "framing": "length", "length": 70000, "strict_t15": true })),
        said(
            json!({ "device": "socket://10.0.0.1:4001", "rs485": "kernel", "rts_delay_after": "100us", "pace": true }),
        ),
        said(json!({ "rs485": "rts", "flow": "rtscts", "max_frame": 0, "timeout": "0" })),
    ];
    insta::assert_snapshot!(all.join("\n"), @r#"
    Error device: 'COM1' is no device of Linux -> name the device, e.g. device = "/dev/ttyS0"; name = "com1" in [[service]] makes it COM1 for the rest of the stack
    Error device: 'ttyUSB0' is a relative path: it is not looked for in any folder -> write device = "/dev/ttyUSB0"
    Error device: './serial/by-id/usb-x' is a relative path: it is not looked for in any folder -> write device = "/dev/serial/by-id/usb-x"
    Error device: 'lines/one' is a relative path: it is not looked for in any folder -> write e.g. device = "/dev/ttyUSB0", better its name in /dev/serial/by-id; "socket://host:port" for a port over TCP, "pty:/tmp/com1" for a pseudo-terminal; `dinrail serial list` lists ports
    Error device: 'socket://nowhere' is no serial device -> write e.g. device = "/dev/ttyUSB0", better its name in /dev/serial/by-id; "socket://host:port" for a port over TCP, "pty:/tmp/com1" for a pseudo-terminal; `dinrail serial list` lists ports
    Warning device: this machine has no /dev/ttyNOTHERE now -> the driver waits for it; `dinrail serial list` lists ports
    Error baud: baud 9 is out of range -> use 50 to 12000000, e.g. 19200
    Error data_bits: framing "rtu" needs 8 data bits, not 7 -> MODBUS over Serial Line V1.02, 2.5.1: each byte of RTU is sent as 8 data bits; for 7 use framing = "ascii", for 5 to 7 without Modbus framing = "raw", "silence", "length" or "delimiter"
    Error data_bits: framing "ascii" needs 7 or 8 data bits, not 6 -> use 7
    Error stop_bits: stop_bits 3 is out of range -> use 1 or 2
    Warning stop_bits: 19200 8N1: without parity the standard asks for 2 stop bits (V1.02, 2.5.1) -> set stop_bits = 2, or parity = "even"; leave it if all devices on the line are set so
    
    
    Error flow: flow "xonxoff" takes the bytes 11h and 13h out of RTU frames -> use "none" or "rtscts"
    Error delimiter: delimiter of 0 bytes is out of range -> use 1 to 8 bytes, e.g. "\r\n"
    Warning length: length has no meaning for this framing, only for "length" -> remove the key, or change framing
    Warning delimiter: delimiter has no meaning for this framing, only for "delimiter" -> remove the key, or change framing
    Error grace: grace 2min is out of range -> use at most 60s
    Error silence: silence must be above 0 -> use e.g. "1s"; the default of silence is 3.5 characters
    Error length: framing "length" needs length -> add e.g. length = 12
    Error length: length 70000 is out of range -> use 1 to 65536
    Warning strict_t15: strict_t15 has no meaning for this framing, only for "rtu" -> remove the key, or change framing
    Warning rs485: rs485 has no meaning for this device -> remove the key
    Warning pace: pace has no meaning for a port over TCP -> remove the key
    Error rts_delay_after: rts_delay_after 100us: the kernel takes whole ms up to 100 -> use e.g. "1ms", or rs485 = "rts"
    Warning rs485: rs485 has no meaning for this device -> remove the key
    Error flow: RTS cannot switch the transmitter and control the flow -> remove flow: RS-485 has none
    Error max_frame: max_frame 0 is out of range -> use 1 to 65536
    Warning max_frame: max_frame has no meaning for this framing, only for "delimiter" and "silence" -> remove the key, or change framing
    Error timeout: timeout must be above 0 -> use e.g. "1s"; the default of silence is 3.5 characters
    "#);
}

#[test]
fn unknown_keys_and_values_are_refused() {
    for value in [json!({ "devise": "x" }), json!({}), json!({ "device": "x", "parity": "evn" })] {
        assert!(serde_json::from_value::<Config>(value.clone()).is_err(), "{value}");
    }
}
