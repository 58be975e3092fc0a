use super::*;
use serde_json::json;

fn config(value: serde_json::Value) -> Config {
    serde_json::from_value(value).unwrap()
}

fn said(value: serde_json::Value) -> String {
    let findings = config(value).findings("can0", std::path::Path::new("/nonexistent"));
    let lines = findings.iter().map(|f| format!("{:?} {}: {} -> {}", f.severity, f.key, f.message, f.help));
    lines.collect::<Vec<_>>().join("\n")
}

#[test]
fn defaults() {
    let config = config(json!({ "backend": "virtual", "serve": { "socketcand": "127.0.0.1:29536" } }));
    assert_eq!((config.bitrate.0, config.data_bitrate.0, config.pace), (500_000, 2_000_000, false));
    assert_eq!((config.tx_queue, config.client_buffer.0), (512, 1 << 20));
    let (name, endpoint) = config.endpoints().remove(0);
    assert_eq!((name, endpoint.max_clients, endpoint.filter), ("socketcand", 8, None));
    assert!(config.findings("can0", std::path::Path::new("/")).is_empty());
}

#[test]
fn unknown_keys_are_refused() {
    for value in [
        json!({ "backend": "virtual", "bitrat": "500k" }),
        json!({ "backend": "virtual", "serve": { "socketcan": "127.0.0.1:1" } }),
        json!({ "backend": "virtual", "feed": { "file": "x", "sped": 1 } }),
        json!({ "backend": "pcan" }),
        json!({}),
    ] {
        assert!(serde_json::from_value::<Config>(value.clone()).is_err(), "{value}");
    }
}

#[test]
fn a_bad_server_is_named() {
    let said = |value| serde_json::from_value::<Endpoint>(value).unwrap_err().to_string();
    let all = [
        said(json!("localhost:29536")),
        said(json!("127.0.0.1")),
        said(json!(29536)),
        said(json!({ "address": "127.0.0.1:1", "fliter": {} })),
        said(json!({ "filter": { "mask": "1", "start": "10.0.0.1", "end": "10.0.0.2" } })),
    ];
    insta::assert_snapshot!(all.join("\n"), @r#"
    invalid value: string "localhost:29536", expected an address such as "127.0.0.1:29536", or a table { address, filter, max_clients }
    invalid value: string "127.0.0.1", expected an address such as "127.0.0.1:29536", or a table { address, filter, max_clients }
    invalid type: integer `29536`, expected an address such as "127.0.0.1:29536", or a table { address, filter, max_clients }
    unknown field `fliter`, expected one of `address`, `filter`, `max_clients`
    invalid IPv4 address syntax
    "#);
}

/// What it says depends on the machine: whether its kernel has CAN, and which interfaces.
#[test]
fn an_interface_that_is_not_there() {
    let said = said(json!({ "backend": "socketcan", "interface": "nocan42" }));
    let (what, help) = if netlink::supported() {
        ("' now (", "`ip link add dev nocan42 type vcan`")
    } else {
        ("', and its kernel no SocketCAN", "`modprobe can_raw`")
    };
    assert!(
        said.starts_with(&format!("Warning interface: this machine has no interface 'nocan42{what}")),
        "{said}"
    );
    assert!(said.contains(help), "{said}");
}

#[test]
fn mistakes() {
    let all = [
        said(json!({ "backend": "socketcan" })),
        said(
            json!({ "backend": "socketcan", "interface": "/dev/ttyACM0", "bus_off_restart": "2min", "rx_buffer": "1KiB" }),
        ),
        said(json!({ "backend": "socketcan", "interface": "lo", "filters": [] })),
        said(json!({ "backend": "virtual", "filters": "auto" })),
        said(
            json!({ "backend": "slcan", "bitrate": "33k", "baud": 115_201, "fd": true, "data_bitrate": "2500k" }),
        ),
        said(json!({ "backend": "slcan", "interface": "tcp://adapter" })),
        said(json!({ "backend": "socketcand" })),
        said(json!({ "backend": "socketcand", "interface": "tcp://10.0.0.1:29536" })),
        said(json!({ "backend": "socketcand", "interface": "tcp://10.0.0.1:29536/can0" })),
        said(json!({ "backend": "slcan", "interface": "/dev/ttyACM0", "fd": true, "data_bitrate": "5M" })),
        said(
            json!({ "backend": "virtual", "interface": "can0", "bitrate": "2M", "max_rate": 5, "tx_queue": 0, "client_buffer": "1KiB" }),
        ),
        said(json!({ "backend": "virtual", "serve": {
            "socketcand": "0.0.0.0:29536",
            "slcan": { "address": "0.0.0.0:29537", "max_clients": 33,
                       "filter": { "mask": "255.255.255.0", "start": "10.0.0.9", "end": "10.0.0.1" } } } })),
        said(json!({ "backend": "virtual", "feed": { "file": "no.log", "speed": 0, "gap": "1us" } })),
    ];
    insta::assert_snapshot!(all.join("\n"), @r#"
    Error interface: backend "socketcan" needs the name of a network interface -> add interface = "can0"; `ip -brief link` lists what there is
    Error bus_off_restart: bus_off_restart 2min is out of range -> use whole ms up to 60s; 0 = never
    Error rx_buffer: rx_buffer 1KiB is out of range -> use 64KiB to 64MiB
    Error interface: '/dev/ttyACM0' is no name of a network interface -> write e.g. "can0"; for a serial device use backend = "slcan"
    Error filters: filters has 0 entries -> use 1 to 512, or "none" for every frame
    Error filters: backend "virtual" has no filters in the kernel -> remove the key: every frame comes
    Error interface: backend "slcan" needs a serial device or an address -> write e.g. interface = "/dev/ttyACM0" or "tcp://192.168.1.7:3333"; `ls /dev/serial/by-id` lists serial adapters
    Error bitrate: the SLCAN protocol has no bit rate 33k -> use 10k, 20k, 50k, 83300, 100k, 125k, 250k, 500k, 750k, 800k or 1M
    Error data_bitrate: the SLCAN protocol has no data bit rate 2500k -> use 1M to 8M in whole M; most adapters have 2M and 5M
    Error baud: a serial port has no rate 115201 -> use e.g. 115200, 921600, 1000000 or 3000000
    Error interface: backend "slcan" needs a serial device or an address -> write e.g. interface = "/dev/ttyACM0" or "tcp://192.168.1.7:3333"; `ls /dev/serial/by-id` lists serial adapters
    Error interface: backend "socketcand" needs the address of a server and its bus -> write e.g. interface = "tcp://192.168.1.7:29536/can0"
    Error interface: backend "socketcand" needs the address of a server and its bus -> write e.g. interface = "tcp://192.168.1.7:29536/can0"


    Error bitrate: bitrate 2M is not possible on CAN -> use 5k to 1M
    Error max_rate: max_rate 5 is out of range -> use 100 to 10000000 frames/s
    Error tx_queue: tx_queue 0 is out of range -> use 1 to 4096
    Error client_buffer: client_buffer 1KiB is out of range -> use 4KiB to 64MiB
    Warning interface: a virtual bus has no interface -> remove the key; clients open the bus by the service's name
    Error serve.socketcand: 0.0.0.0:29536 is open to the network: anyone could send CAN frames -> add filter = { mask = "255.255.255.0", start = "...", end = "..." }, or listen on 127.0.0.1
    Error serve.slcan: max_clients 33 is out of range -> use 1 to 32
    Error serve.slcan: filter: start 10.0.0.9 lies behind end 10.0.0.1: nobody could connect -> swap start and end
    Error serve: max_clients of all servers together is 41 -> one bus has at most 32 clients: lower max_clients
    Error feed.speed: speed 0 is out of range -> use 0.01 to 1000
    Error feed.gap: gap 1us is too short -> use at least 1ms
    Error feed.file: feed: cannot read /nonexistent/no.log: No such file or directory (os error 2) -> `file` is a candump log (`candump -L`) of at most 1000000 frames; `bus` picks the lines of one bus
    "#);
}
