//! The Modbus server with foreign masters: on TCP, on RTU and ASCII lines (pseudo-terminals), and RTU over TCP.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod support;

use std::fs;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::Duration;
use support::{Stack, cases, free_port, peers};
use tokio::net::unix::pipe;
use tokio_modbus::client::Context;
use tokio_modbus::prelude::{ExceptionCode, Reader, Slave, Writer};

struct Ports {
    tcp: u16,
    rtu_over_tcp: u16,
}

/// One server on all transports; the program counts and answers what clients write.
fn stack_text(ports: &Ports) -> String {
    let Ports { tcp, rtu_over_tcp } = ports;
    format!(
        r#"
[stack]
name = "NAME"

[[service]]
name = "com1"
kind = "serial"
device = "pty:com1"
framing = "rtu"

[[service]]
name = "com2"
kind = "serial"
device = "pty:com2"
framing = "ascii"

[[service]]
name = "plc"
kind = "plc"
cycle = "5ms"

[[service]]
name = "modbus"
kind = "modbus-server"
# A machine with much to do may keep the plc from its turn for the 0.2 s that are the default.
stale_after = "10s"
tcp = {{ address = "127.0.0.1", port = {tcp} }}
rtu_over_tcp = {{ address = "127.0.0.1", port = {rtu_over_tcp}, unit = [1, 5] }}
serial = [
    {{ port = "com1", unit = [1, 5], answer_255 = true }},
    {{ port = "com2", mode = "ascii", unit = 1 }},
]
exception_status = ["%QB100"]
identity = {{ vendor_name = "Works", product_code = "P1", revision = "7", product_name = "Press" }}

[[service.file]]
number = 4
area = "%MW500"
records = 20

[[service.fifo]]
address = 1246
area = "%MW600"

[[service.unit]]
id = 5

[[service.unit.map]]
table = "holding"
at = 0
count = 4
area = "%MD400"
order = "ABCD"
"#
    )
}

fn up() -> (Stack, Ports) {
    let ports = Ports { tcp: free_port(), rtu_over_tcp: free_port() };
    let stack = Stack::up("mbserver", &stack_text(&ports), &[]);
    (stack, ports)
}

fn path(stack: &Stack, port: &str) -> String {
    stack.scratch.0.join(port).display().to_string()
}

/// Runs a peer that must end well and gives what it printed.
fn run_peer(script: &str, args: &[&str]) -> Option<String> {
    let output = peers::peer(script)?.args(args).output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(
        output.status.success(),
        "{script} {args:?}: {text}\n{}",
        String::from_utf8_lossy(&output.stderr)
    );
    Some(text)
}

#[test]
fn foreign_masters_on_every_transport() {
    let (mut stack, ports) = up();
    let (com1, com2) = (path(&stack, "com1"), path(&stack, "com2"));
    let (tcp, rtu) = (ports.tcp.to_string(), ports.rtu_over_tcp.to_string());
    stack.wait("the server serves", || {
        TcpStream::connect(("127.0.0.1", ports.tcp)).ok()?;
        (stack.ok(&["plc", "status"]).contains("run")).then_some(())
    });
    for args in [["tcp", tcp.as_str()], ["rtu_over_tcp", &rtu], ["rtu", &com1], ["ascii", &com2]] {
        let Some(text) = run_peer("modbus_all_functions.py", &args) else { return };
        assert!(text.contains("all good"), "{args:?}: {text}");
    }
    for args in [["rtu", com1.as_str()], ["ascii", &com2]] {
        run_peer("minimalmodbus_master.py", &args);
    }
    run_peer("pymodbustcp_master.py", &[&tcp]);
    run_peer("umodbus_master.py", &[&tcp, &com1]);
    mbpoll(&["-m", "tcp", "-p", &tcp, "-a", "1", "127.0.0.1"]);
    mbpoll(&["-m", "rtu", "-b", "19200", "-P", "none", "-a", "1", &com1]);
    assert_eq!(stack.take_down(), 0, "{}", stack.log());
}

/// Register 7 holds 4711: written by the peers before.
fn mbpoll(args: &[&str]) {
    let Some(mut mbpoll) = peers::program("mbpoll", "mbpoll") else { return };
    let (target, options) = args.split_last().unwrap();
    let output = mbpoll
        .args(options)
        .args(["-0", "-r", "7", "-c", "1", "-t", "4", "-1", "-o", "10", target])
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(
        text.contains("[7]: \t4711"),
        "mbpoll {args:?}: {text}{}",
        String::from_utf8_lossy(&output.stderr)
    );
}

/// Reads and writes every table and asks for the identification, by tokio-modbus.
async fn tokio_modbus_master(mut master: Context, first: u16, what: &str) {
    let values: Vec<u16> = (0..20).map(|n| n * 257 + first).collect();
    master.write_multiple_registers(first, &values).await.unwrap().unwrap();
    assert_eq!(master.read_holding_registers(first, 20).await.unwrap().unwrap(), values, "{what}");
    master.write_single_register(first, 7).await.unwrap().unwrap();
    master.masked_write_register(first, 0xFFF0, 0x0008).await.unwrap().unwrap();
    let both = master.read_write_multiple_registers(first, 2, first + 1, &[9]).await.unwrap().unwrap();
    assert_eq!(both, [8, 9], "{what}");
    let coils = [true, false, true, true, false, false, false, true, true];
    master.write_multiple_coils(first, &coils).await.unwrap().unwrap();
    master.write_single_coil(first + 1, true).await.unwrap().unwrap();
    assert_eq!(master.read_coils(first, 4).await.unwrap().unwrap(), [true, true, true, true], "{what}");
    assert_eq!(master.read_discrete_inputs(0, 3).await.unwrap().unwrap(), [false; 3], "{what}");
    assert_eq!(master.read_input_registers(0, 2).await.unwrap().unwrap(), [0, 0], "{what}");
    // An exception, and after it the line still works.
    let refused = master.read_holding_registers(65_535, 2).await.unwrap();
    assert_eq!(refused, Err(ExceptionCode::IllegalDataAddress), "{what}");
    assert_eq!(master.read_holding_registers(first + 19, 1).await.unwrap().unwrap(), values[19..], "{what}");
}

#[test]
fn tokio_modbus_is_a_master_on_tcp_and_on_a_line() {
    let (mut stack, ports) = up();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let address = (std::net::Ipv4Addr::LOCALHOST, ports.tcp).into();
        let master = tokio_modbus::client::tcp::connect_slave(address, Slave(1)).await.unwrap();
        tokio_modbus_master(master, 100, "tcp").await;
        // Several at once.
        let mut masters = tokio::task::JoinSet::new();
        for n in 0..4 {
            let master = tokio_modbus::client::tcp::connect_slave(address, Slave(1)).await.unwrap();
            masters
                .spawn(async move { tokio_modbus_master(master, 200 + n * 50, "tcp, four at once").await });
        }
        while let Some(ended) = masters.join_next().await {
            ended.unwrap();
        }
        let line = fs::OpenOptions::new().read(true).write(true).open(path(&stack, "com1")).unwrap();
        rustix::io::ioctl_fionbio(&line, true).unwrap();
        // Tokio has no type for a terminal; the ends of a pipe read and write any descriptor that can be waited for.
        let write = pipe::Sender::from_owned_fd_unchecked(line.try_clone().unwrap().into()).unwrap();
        let read = pipe::Receiver::from_owned_fd_unchecked(line.into()).unwrap();
        let master = tokio_modbus::client::rtu::attach_slave(tokio::io::join(read, write), Slave(1));
        tokio_modbus_master(master, 500, "rtu").await;
    });
    assert_eq!(stack.take_down(), 0, "{}", stack.log());
}

#[test]
fn nmap_discovers_the_units_and_who_they_are() {
    let (mut stack, ports) = up();
    let Some(mut nmap) = peers::program("nmap", "nmap") else { return };
    stack.wait("the server serves", || TcpStream::connect(("127.0.0.1", ports.tcp)).ok());
    // "+": also on a port that is not 502. Asks all units from 1 to 246, each on its own connections.
    let output = nmap
        .args(["-n", "-Pn", "-sT", "-p", &ports.tcp.to_string(), "--script", "+modbus-discover"])
        .args(["--script-args", "modbus-discover.aggressive=true", "-oX", "-", "127.0.0.1"])
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(output.status.success(), "{text}{}", String::from_utf8_lossy(&output.stderr));
    let of_unit = |unit: u8| {
        let (_, rest) = text.split_once(&format!("<table key=\"sid {unit:#x}\">"))?;
        rest.split_once("</table>").map(|(own, _)| own.to_owned())
    };
    for unit in [1, 5] {
        let own = of_unit(unit).unwrap_or_else(|| panic!("unit {unit} is missing: {text}"));
        assert!(own.contains("<elem key=\"Device identification\">Works P1 7"), "unit {unit}: {own}");
        assert!(own.contains("<elem key=\"Slave ID data\">"), "unit {unit}: {own}");
    }
    assert_eq!(stack.take_down(), 0, "{}", stack.log());
}

/// PDUs of the matrix of disagreements that need no state, and what V1.1b3 asks for.
const MATRIX: &[(&[u8], &[u8])] = &[
    (&[3, 0, 0, 0, 2], &[3, 4, 0, 0, 0, 0]),
    (&[1, 0, 0, 0, 0], &[0x81, 3]),
    (&[1, 0, 0, 7, 0xD1], &[0x81, 3]),
    (&[3, 0, 0, 0, 0], &[0x83, 3]),
    (&[3, 0, 0, 0, 126], &[0x83, 3]),
    (&[3, 0xFF, 0xFF, 0, 2], &[0x83, 2]),
    (&[5, 0, 0, 0x12, 0x34], &[0x85, 3]),
    (&[15, 0, 0, 0, 100, 1, 0xFF], &[0x8F, 3]),
    (&[15, 0, 0, 0, 1, 2, 0xFF, 0xFF], &[0x8F, 3]),
    (&[16, 0, 0, 0, 2, 2, 0, 1], &[0x90, 3]),
    (&[3, 0, 0, 0, 2, 0], &[0x83, 3]),
    (&[7], &[7, 0]),
    (&[8, 0, 0, 0xA5, 0x37], &[8, 0, 0, 0xA5, 0x37]),
    (&[0x14, 7, 6, 0, 1, 0, 0, 0, 2], &[0x94, 2]),
    (&[0x16, 0, 4, 0, 0xF2, 0, 0x25], &[0x16, 0, 4, 0, 0xF2, 0, 0x25]),
    (&[0x18, 0, 0], &[0x98, 2]),
    (&[0x2B, 14, 9, 0], &[0xAB, 3]),
    (&[0x2B, 13, 0], &[0xAB, 1]),
    (&[100, 1], &[0xE4, 1]),
    (&[9], &[0x89, 1]),
    (&[0x83, 2], &[0x83, 1]),
    (&[0], &[0x80, 1]),
];

fn tcp_frame(transaction: u16, pdu: &[u8]) -> Vec<u8> {
    let [high, low] = transaction.to_be_bytes();
    [&[high, low, 0, 0, 0, pdu.len() as u8 + 1, 1], pdu].concat()
}

fn rtu_frame(pdu: &[u8]) -> Vec<u8> {
    let mut out = [0; 256];
    let len = dinrail_modbus::protocol::rtu::encode(1, pdu, &mut out);
    out[..len].to_vec()
}

fn ascii_frame(pdu: &[u8]) -> Vec<u8> {
    let mut out = [0; 513];
    let len = dinrail_modbus::protocol::ascii::encode(1, pdu, &mut out);
    out[..len].to_vec()
}

/// Sends a frame and reads as many bytes as the answer must have.
fn ask(stream: &mut (impl Read + Write), frame: &[u8], expected: &[u8], what: &str) {
    stream.write_all(frame).unwrap();
    let mut got = vec![0; expected.len()];
    if let Err(error) = stream.read_exact(&mut got) {
        panic!("{what} {frame:02X?}: {error}, so far {got:02X?}, expected {expected:02X?}");
    }
    assert_eq!(got, expected, "{what} {frame:02X?}");
}

#[test]
fn the_matrix_across_processes() {
    let (mut stack, ports) = up();
    let mut tcp = TcpStream::connect(("127.0.0.1", ports.tcp)).unwrap();
    let mut over_tcp = TcpStream::connect(("127.0.0.1", ports.rtu_over_tcp)).unwrap();
    for stream in [&tcp, &over_tcp] {
        stream.set_nodelay(true).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
    }
    let line = |port: &str| fs::OpenOptions::new().read(true).write(true).open(path(&stack, port)).unwrap();
    let (mut com1, mut com2) = (line("com1"), line("com2"));
    for (n, (request, response)) in MATRIX.iter().enumerate() {
        let n = n as u16;
        ask(&mut tcp, &tcp_frame(n, request), &tcp_frame(n, response), "tcp");
        ask(&mut com1, &rtu_frame(request), &rtu_frame(response), "rtu");
        ask(&mut com2, &ascii_frame(request), &ascii_frame(response), "ascii");
        ask(&mut over_tcp, &rtu_frame(request), &rtu_frame(response), "rtu over tcp");
    }
    // Shorter than its function: silence ends it on a line, so it is answered there.
    let short: (&[u8], &[u8]) = (&[3, 0, 0, 0], &[0x83, 3]);
    ask(&mut com1, &rtu_frame(short.0), &rtu_frame(short.1), "rtu");
    ask(&mut com2, &ascii_frame(short.0), &ascii_frame(short.1), "ascii");
    // A broadcast is carried out and not answered: the next answer is the next request's.
    let mut broadcast = [0; 256];
    let len = dinrail_modbus::protocol::rtu::encode(0, &[6, 0, 9, 0x12, 0x34], &mut broadcast);
    com1.write_all(&broadcast[..len]).unwrap();
    stack.wait("the broadcast is carried out", || {
        (stack.ok(&["plc", "read", "%MW9"]).contains("4660")).then_some(())
    });
    ask(&mut com1, &rtu_frame(&[3, 0, 9, 0, 1]), &rtu_frame(&[3, 2, 0x12, 0x34]), "rtu");
    // Noise, half a frame, a wrong CRC, another unit's frame: then still the right answer.
    let mut foreign = [0; 256];
    let len = dinrail_modbus::protocol::rtu::encode(9, &[3, 0, 0, 0, 1], &mut foreign);
    let mut wrong = rtu_frame(&[6, 0, 9, 0, 0]);
    wrong[3] ^= 0x40;
    for junk in [&[0xFF; 40][..], &rtu_frame(&[6, 0, 9, 0, 0])[..5], &wrong, &foreign[..len]] {
        com1.write_all(junk).unwrap();
        std::thread::sleep(Duration::from_millis(100));
        ask(&mut com1, &rtu_frame(&[3, 0, 9, 0, 1]), &rtu_frame(&[3, 2, 0x12, 0x34]), "after noise");
    }
    drop((com1, com2));
    assert_eq!(stack.take_down(), 0, "{}", stack.log());
}

#[test]
fn clients_are_listed_and_the_server_is_switched_off_and_on() {
    let (mut stack, ports) = up();
    let mut client = TcpStream::connect(("127.0.0.1", ports.tcp)).unwrap();
    client.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
    ask(&mut client, &tcp_frame(1, &[3, 0, 0, 0, 1]), &tcp_frame(1, &[3, 2, 0, 0]), "tcp");
    let port = client.local_addr().unwrap().port().to_string();
    stack.wait("the client is listed", || {
        let text = stack.ok(&["modbus", "clients"]);
        (text.contains("127.0.0.1") && text.contains(&port)).then_some(())
    });
    assert!(stack.ok(&["modbus", "disable", "modbus"]).contains("off"));
    assert_eq!(client.read(&mut [0; 1]).unwrap_or(0), 0, "the connection is closed");
    stack.wait("it says so", || stack.ok(&["modbus", "clients"]).contains("switched off").then_some(()));
    assert!(stack.ok(&["modbus", "enable"]).contains("on"));
    stack.wait("it serves again", || {
        let mut client = TcpStream::connect(("127.0.0.1", ports.tcp)).ok()?;
        client.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
        client.write_all(&tcp_frame(1, &[3, 0, 0, 0, 1])).ok()?;
        client.read_exact(&mut [0; 11]).ok()
    });
    assert_eq!(stack.take_down(), 0, "{}", stack.log());
}

#[test]
fn recorded_traffic_gets_the_answers_of_the_specification() {
    let Some(cases) = cases() else { return };
    let (mut stack, ports) = up();
    let mut asked = 0;
    for entry in fs::read_dir(cases.join("modbus")).unwrap().flatten() {
        let path = entry.path();
        if path.extension().is_some_and(|e| e == "pcap") {
            asked += replay(&fs::read(&path).unwrap(), ports.tcp);
        }
    }
    assert!(asked > 20, "{asked} requests found");
    assert_eq!(stack.take_down(), 0, "{}", stack.log());
}

/// Sends every whole request to port 502 of a capture, each on its own connection, and checks that the answer can be
/// one to it. Returns how many.
fn replay(pcap: &[u8], port: u16) -> usize {
    use dinrail_modbus::protocol::decode_response;
    use dinrail_modbus::protocol::mbap::{Scan, scan};
    use dinrail_modbus::protocol::pdu::decode_request;
    let mut asked = 0;
    for payload in support::pcap::tcp_payloads_to(pcap, 502) {
        let Scan::Frame { frame, used } = scan(&payload) else { continue };
        let mut stream = TcpStream::connect(("127.0.0.1", port)).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
        stream.write_all(&payload[..used]).unwrap();
        if frame.pdu.starts_with(&[8, 0, 4]) {
            // Listen-only mode: only a restart ends it, without an answer.
            stream.write_all(&tcp_frame(1, &[8, 0, 1, 0, 0])).unwrap();
            stream.write_all(&tcp_frame(2, &[8, 0, 0, 7, 7])).unwrap();
            stream.read_exact(&mut [0; 12]).unwrap();
            continue;
        }
        let mut head = [0; 6];
        stream.read_exact(&mut head).unwrap_or_else(|e| panic!("{frame:02X?} has no answer: {e}"));
        let mut body = vec![0; usize::from(head[5])];
        stream.read_exact(&mut body).unwrap();
        assert_eq!(body[0], frame.unit);
        match decode_request(frame.pdu) {
            Ok(request) => drop(decode_response(&request, &body[1..]).unwrap()),
            Err(refused) => assert_eq!(body[1..], [refused.function | 0x80, refused.exception.code()]),
        }
        asked += 1;
    }
    asked
}
