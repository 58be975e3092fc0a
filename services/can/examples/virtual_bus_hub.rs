//! The virtual bus with its TCP servers, without a stack: for tests with foreign tools.
//!
//! `virtual_bus_hub SOCKETCAND_PORT SLCAN_PORT [--pace BITRATE] [--feed FILE]` listens on 127.0.0.1, prints one line
//! per frame when `--print` is given, and ends with a count when its standard input closes.

use std::io::Write as _;
use std::net::Ipv4Addr;

use dinrail_can::feed::{Log, Player};
use dinrail_can::protocol::Frame;
use dinrail_can::protocol::candump;
use dinrail_can::server::{Host, Hub, listen};
use dinrail_can::virtual_bus::{Dialect, Origin, Settings, Tap};
use dinrail_can::watch;

struct Printer {
    print: bool,
    frames: u64,
}

impl Tap for Printer {
    fn frame(&mut self, frame: &Frame, t_ns: u64, _origin: Origin) {
        self.frames += 1;
        if self.print {
            println!("{}", candump::format_log_line(t_ns, "can0", frame));
        }
    }
}

impl Host for Printer {
    fn flush(&mut self) {}
    fn client(&mut self, message: String, _refused: bool) {
        eprintln!("{message}");
    }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let args: Vec<String> = std::env::args().collect();
    let value = |key: &str| args.iter().position(|a| a == key).and_then(|i| args.get(i + 1));
    let settings = Settings {
        name: "can0".into(),
        bitrate: value("--pace").map_or(Ok(500_000), |v| v.parse())?,
        data_bitrate: 2_000_000,
        pace: value("--pace").is_some(),
        max_rate: 150_000,
        tx_queue: 512,
        client_buffer: 1 << 20,
    };
    let feed = value("--feed").map(|file| Log::load(file.as_ref(), None)).transpose()?;
    let feed = feed.map(|log| Player::new(log, 1.0, true, 100_000_000, ipc_types::clock::mono_ns()));
    let ports: Vec<u16> = args.iter().skip(1).take(2).map(|a| a.parse()).collect::<Result<_, _>>()?;
    let [socketcand, slcan] = ports[..] else { return Err("usage: virtual_bus_hub PORT PORT".into()) };
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let local = tokio::task::LocalSet::new();
    local.block_on(&runtime, async {
        let host = Printer { print: args.iter().any(|a| a == "--print"), frames: 0 };
        let hub = Hub::new(settings, host, feed)?;
        hub.turn(|bus, _, _| bus.set_utc_offset(ipc_types::clock::utc_offset_ns()));
        for (port, dialect) in [(socketcand, Dialect::Socketcand), (slcan, Dialect::Slcan)] {
            let listener = listen(Ipv4Addr::LOCALHOST.into(), port).await?;
            tokio::task::spawn_local(hub.clone().serve(listener, dialect, None, 8));
        }
        println!("ready");
        std::io::stdout().flush()?;
        // The parent holds the other end of this pipe.
        let stdin = watch::readable(rustix::io::dup(rustix::stdio::stdin())?)?;
        loop {
            tokio::select! {
                end = hub.alarm() => { end?; hub.turn(|_, _, _| ()); }
                end = stdin.readable() => { end?.retain_ready(); break; }
            }
        }
        eprintln!("frames {}", hub.look(|_, host| host.frames));
        Ok(())
    })
}
