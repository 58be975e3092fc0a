use super::*;
use insta::assert_snapshot;
use ipc_types::image_write;

fn parse(json: &str) -> Config {
    serde_json::from_str(json).unwrap()
}

#[test]
fn an_empty_table_has_the_documented_defaults() {
    let config = parse("{}");
    assert_eq!(config, Config::default());
    let tcp = config.tcp().unwrap();
    assert!(config.enable && config.units.is_none() && tcp.filter.is_none());
    assert_eq!((tcp.port, tcp.max_connections, tcp.idle_timeout), (502, 8, Span::from_ms(60_000)));
    assert_eq!((config.on_stop, config.stale_after), (OnStop::Exception, Span::from_ms(200)));
    let options = tcp.options(Framing::Tcp);
    assert_eq!((options.max_connections, options.idle_timeout), (8, Some(Duration::from_mins(1))));
}

#[test]
fn every_key_is_read() {
    let config = parse(
        r#"{ "enable": false, "plc": "p",
             "tcp": { "address": "127.0.0.1", "port": 1502, "max_connections": 2, "idle_timeout": "0",
                      "when_full": "close_oldest_idle",
                      "filter": { "mask": "255.255.255.0", "start": "192.168.1.10", "end": "192.168.1.99" } },
             "units": [1, 2], "map": "openplc", "on_stop": "hold", "stale_after": "1s",
             "write_watchdog": "2s", "watchdog_values": [ { "to": "%QW0", "value": 0 } ],
             "enable_from": "%MX0.0", "clients_to": "%IB100", "serial_codes_on_tcp": false,
             "rtu_over_tcp": { "port": 4001, "unit": [1, 2], "answer_255": true, "address": "127.0.0.1",
                               "max_connections": 3, "idle_timeout": "1s", "when_full": "refuse",
                               "filter": [ { "start": "10.0.0.1", "end": "10.0.0.2" } ] },
             "serial": [ { "port": "com1", "mode": "ascii", "unit": 5, "answer_255": true, "answer_within": "2s" } ],
             "unit": [ { "id": 2, "map": "openplc" } ],
             "rights": [ { "peer": "com1", "units": [1], "functions": [3], "allow": "all" } ],
             "file": [ { "number": 1, "name": "recipe", "area": "%MW0", "records": 10, "read_only": true } ],
             "fifo": [ { "address": 7, "name": "queue", "area": "%MW100", "size": 4 } ],
             "identity": { "server_id": 1, "server_text": "a", "vendor_name": "b", "product_code": "c",
                           "revision": "d", "vendor_url": "e", "product_name": "f", "model_name": "g",
                           "user_application_name": "h", "extended": [ { "id": 128, "value": "i" } ] },
             "exception_status": ["%QX0.0", "%MX1.1"] }"#,
    );
    let options = config.tcp().unwrap().options(Framing::Tcp);
    assert!(!config.enable && options.idle_timeout.is_none());
    assert_eq!(options.when_full, WhenFull::CloseOldestIdle);
    assert_eq!(config.units_of(&config.rtu_over_tcp.as_ref().unwrap().unit), [(1, 0), (2, 1)]);
    assert_eq!(config.client_list(Addressing::Element), Ok(Some((100, 2 + 6 * 5))));
    assert_eq!(config.serial[0].unit, UnitIds(vec![5]));
    assert_eq!(parse(&serde_json::to_string(&config).unwrap()), config);
}

#[test]
fn unknown_keys_are_errors() {
    let error = |json| serde_json::from_str::<Config>(json).unwrap_err().to_string();
    assert_snapshot!(error(r#"{ "prot": 502 }"#), @"unknown field `prot`, expected one of `enable`, `enable_from`, `plc`, `tcp`, `rtu_over_tcp`, `serial`, `units`, `map`, `unit`, `rights`, `file`, `fifo`, `identity`, `exception_status`, `serial_codes_on_tcp`, `clients_to`, `on_stop`, `stale_after`, `write_watchdog`, `watchdog_values` at line 1 column 8");
    assert_snapshot!(error(r#"{ "tcp": { "prot": 502 } }"#), @"unknown field `prot`, expected one of `address`, `port`, `max_connections`, `filter`, `idle_timeout`, `when_full` at line 1 column 17");
    assert_snapshot!(error(r#"{ "on_stop": "stop" }"#), @"unknown variant `stop`, expected `exception` or `hold` at line 1 column 19");
    assert_snapshot!(error(r#"{ "stale_after": 200 }"#), @r#"'200' is not a duration: write a number and a unit, e.g. "500us", "10ms", "1.5s", "2min", "1h" at line 1 column 20"#);
}

#[test]
fn tcp_is_served_unless_another_transport_stands_alone() {
    assert!(parse("{}").tcp().is_some());
    assert!(parse(r#"{ "serial": [ { "port": "com1" } ] }"#).tcp().is_none());
    assert!(parse(r#"{ "rtu_over_tcp": { "port": 4001 } }"#).tcp().is_none());
    assert!(parse(r#"{ "serial": [ { "port": "com1" } ], "tcp": {} }"#).tcp().is_some());
    assert_eq!(parse(r#"{ "serial": [ { "port": "com1" } ] }"#).serial[0].unit, UnitIds(vec![1]));
}

#[test]
fn places_of_bits_and_lists() {
    let place = |json: &str| {
        let config = parse(json);
        let at = Addressing::Element;
        let error =
            config.enable_bit(at).err().or(config.exception_bits(at).err()).or(config.client_list(at).err());
        error.unwrap().to_string()
    };
    assert_snapshot!(place(r#"{ "enable_from": "%MW0" }"#), @"enable_from: %MW0 is no bit; write one like %MX0.0");
    assert_snapshot!(place(r#"{ "clients_to": "%MB0" }"#), @"clients_to: %MB0 is no place for the list of clients; write a byte of %I like %IB100");
    assert_snapshot!(place(r#"{ "exception_status": ["%QW0"] }"#), @"exception_status: %QW0 is no bit; write one like %MX0.0");
    assert_snapshot!(place(r#"{ "exception_status": ["%QX0.0", "%QX0.1", "%QX0.2", "%QX0.3", "%QX0.4", "%QX0.5", "%QX0.6", "%QX0.7", "%QX1.0"] }"#), @"exception_status: eight bits are shown; give at most eight, or one byte like %QB0");
    let bits = parse(r#"{ "exception_status": ["%QB3"] }"#).exception_bits(Addressing::Element).unwrap();
    assert_eq!(bits[7], Some(BitPlace { area: Area::Output, byte: 3, bit: 7 }));
}

#[test]
fn watchdog_values_become_one_message() {
    let config = parse(
        r#"{ "watchdog_values": [ { "to": "%QX0.3", "value": true }, { "to": "%QX0.4", "value": false },
             { "to": "%QB1", "value": 255 }, { "to": "%QW1", "value": -2 }, { "to": "%QD1", "value": 4294967295 },
             { "to": "%QL1", "value": -1 } ] }"#,
    );
    let builder = config.watchdog_write(Addressing::Element).unwrap();
    let mut output = [0x10; 16];
    for op in image_write::parse(builder.tail()).unwrap() {
        assert!(op.apply(&mut output));
    }
    assert_eq!(output, [8, 255, 0xFE, 0xFF, 255, 255, 255, 255, 255, 255, 255, 255, 255, 255, 255, 255]);
}

#[test]
fn watchdog_values_that_cannot_be_written() {
    let error = |to: &str, value: &str| {
        let config = parse(&format!(
            r#"{{ "watchdog_values": [ {{ "to": "%QB0", "value": 0 }}, {{ "to": "{to}", "value": {value} }} ] }}"#
        ));
        let error = config.watchdog_write(Addressing::Element).unwrap_err();
        assert_eq!(error.index(), 1);
        error.to_string()
    };
    assert_snapshot!(error("%QW", "0"), @"watchdog value 2: `%QW` is not an address: write %I, %Q or %M, a size X, B, W, D or L, and a number, like %IX0.3 or %QW2");
    assert_snapshot!(error("%IW0", "0"), @"watchdog value 2: %IW0 is an input; write a value to %Q or %M");
    assert_snapshot!(error("%QX0.0", "1"), @"watchdog value 2: %QX0.0 is a bit; its value is true or false");
    assert_snapshot!(error("%QW0", "65536"), @"watchdog value 2: 65536 does not fit %QW0, which takes -32768 to 65535");
    assert_snapshot!(error("%QB0", "-129"), @"watchdog value 2: -129 does not fit %QB0, which takes -128 to 255");
    assert_snapshot!(error("%QB65536", "0"), @"watchdog value 2: `%QB65536`: the number is too large, an area has at most 65536 bytes");
    let many: Vec<_> =
        (0..17).map(|i| WatchdogValue { to: format!("%QB{i}"), value: Value::Int(0) }).collect();
    let error = Config { watchdog_values: many, ..Config::default() }
        .watchdog_write(Addressing::Element)
        .unwrap_err();
    assert_snapshot!(error, @"watchdog value 17: there are too many; at most 16 values are written at once");
}
