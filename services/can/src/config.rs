//! The service's table of the stack file, and what can be found wrong with it without starting.

use std::net::SocketAddr;
use std::path::PathBuf;

use ipc_types::Finding;
use ipc_types::net::IpFilter;
use ipc_types::units::{BitRate, Size, Span};
use serde::{Deserialize, Deserializer, Serialize, de};

use crate::feed;
use crate::protocol::slcan_client::{self, Channel};
use crate::virtual_bus::{CLIENT_QUEUE, Dialect, MAX_CLIENTS, Settings};
use crate::wire::filter::{Filters, MAX_FILTERS};
use crate::wire::netlink::{self, Wanted};
use crate::wire::port::Target;

/// Rates of SLCAN adapters.
const BAUDS: [u32; 14] = [
    9600, 19_200, 38_400, 57_600, 115_200, 230_400, 460_800, 500_000, 576_000, 921_600, 1_000_000, 1_500_000,
    2_000_000, 3_000_000,
];

/// What stands between this driver and the wire.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Backend {
    /// A bus inside the driver process.
    Virtual,
    /// A network interface of the kernel.
    Socketcan,
    /// A serial adapter.
    Slcan,
    /// A remote socketcand.
    Socketcand,
}

impl Backend {
    /// As the stack file names it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Virtual => "virtual",
            Self::Socketcan => "socketcan",
            Self::Slcan => "slcan",
            Self::Socketcand => "socketcand",
        }
    }
}

/// A service of kind `can`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Required.
    pub backend: Backend,
    /// `can0`; `/dev/ttyACM0` or `tcp://host:port` for slcan; `tcp://host:port/bus` for socketcand.
    #[serde(default)]
    pub interface: Option<String>,
    /// Number for blocks that name a bus by number; default: order in the stack file.
    #[serde(default)]
    pub number: Option<u32>,
    /// Nominal bit rate, 5k - 1M. Default 500k.
    #[serde(default = "default_bitrate")]
    pub bitrate: BitRate,
    /// Data bit rate of CAN FD, up to 8M. Default 2M.
    #[serde(default = "default_data_bitrate")]
    pub data_bitrate: BitRate,
    /// CAN FD. Default: as the interface has it; off for slcan.
    #[serde(default)]
    pub fd: Option<bool>,
    /// Set what of the interface differs, where permitted; false: only compare. Default true.
    #[serde(default = "default_true")]
    pub configure: bool,
    /// First pause before the restart after bus-off, up to 60s; 0 = never. Default 100ms.
    #[serde(default = "default_bus_off_restart")]
    pub bus_off_restart: Span,
    /// Receive buffer of the socket, 64KiB - 64MiB. Default 4MiB: about 5,000 frames.
    #[serde(default = "default_rx_buffer")]
    pub rx_buffer: Size,
    /// Frames that the kernel hands to the driver: "none" (every frame), "auto" (what the readers of the bus name),
    /// or a list of at most 512. Default "none".
    #[serde(default)]
    pub filters: Filters,
    /// Rate of the serial device. Default 115200.
    #[serde(default = "default_baud")]
    pub baud: u32,
    /// Ask the serial adapter for stamps. Default false.
    #[serde(default)]
    pub timestamps: bool,
    /// Hold frames to the time they take on a wire. Default false: as fast as it goes.
    #[serde(default)]
    pub pace: bool,
    /// Without pace: most frames a second, 100 - 10000000. Default 150000: a reader may sleep 50 ms without loss.
    #[serde(default = "default_max_rate")]
    pub max_rate: u32,
    /// Frames of the stack that wait for the bus, 1 - 4096. Default 512.
    #[serde(default = "default_tx_queue")]
    pub tx_queue: u32,
    /// Bytes that wait for one TCP client, 4KiB - 64MiB. Default 1MiB: about 23,000 frames.
    #[serde(default = "default_client_buffer")]
    pub client_buffer: Size,
    /// Servers for foreign tools. Default: none.
    #[serde(default)]
    pub serve: Serve,
    /// A recorded log that is played onto the bus. Default: none.
    #[serde(default)]
    pub feed: Option<Feed>,
}

/// Servers for foreign tools.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Serve {
    /// The socketcand protocol.
    #[serde(default)]
    pub socketcand: Option<Endpoint>,
    /// SLCAN over TCP.
    #[serde(default)]
    pub slcan: Option<Endpoint>,
    /// The cannelloni protocol over TCP.
    #[serde(default)]
    pub cannelloni: Option<Endpoint>,
    /// SLCAN on a pseudo-terminal: path of the link that leads to it.
    #[serde(default)]
    pub slcan_pty: Option<PathBuf>,
}

/// Where a server listens: `"127.0.0.1:29536"` or a table with filter and limit.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(untagged)]
pub enum Endpoint {
    /// The address alone.
    Address(SocketAddr),
    /// Address, filter and limit.
    Table(EndpointTable),
}

impl<'de> Deserialize<'de> for Endpoint {
    fn deserialize<D: Deserializer<'de>>(d: D) -> Result<Self, D::Error> {
        struct Visit;
        impl<'de> de::Visitor<'de> for Visit {
            type Value = Endpoint;
            fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str(
                    "an address such as \"127.0.0.1:29536\", or a table { address, filter, max_clients }",
                )
            }
            fn visit_str<E: de::Error>(self, text: &str) -> Result<Endpoint, E> {
                let address = text.parse().map_err(|_| E::invalid_value(de::Unexpected::Str(text), &self))?;
                Ok(Endpoint::Address(address))
            }
            // A derived untagged enum would swallow which key of the table is unknown.
            fn visit_map<A: de::MapAccess<'de>>(self, map: A) -> Result<Endpoint, A::Error> {
                EndpointTable::deserialize(de::value::MapAccessDeserializer::new(map)).map(Endpoint::Table)
            }
        }
        d.deserialize_any(Visit)
    }
}

/// The long form of [`Endpoint`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EndpointTable {
    /// Where it listens.
    pub address: SocketAddr,
    /// Who may connect; required unless the address is loopback.
    #[serde(default)]
    pub filter: Option<IpFilter>,
    /// Most clients at once, 1 - 32. Default 8.
    #[serde(default = "default_max_clients")]
    pub max_clients: u32,
}

impl Endpoint {
    /// The long form.
    pub fn table(&self) -> EndpointTable {
        match self {
            Self::Address(address) => {
                EndpointTable { address: *address, filter: None, max_clients: default_max_clients() }
            }
            Self::Table(table) => table.clone(),
        }
    }
}

/// A recorded log that is played onto the bus.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Feed {
    /// A candump log (`candump -L`), relative to the stack file.
    pub file: PathBuf,
    /// Take only lines of this bus name. Default: all lines.
    #[serde(default)]
    pub bus: Option<String>,
    /// Start again at the end. Default true.
    #[serde(default = "default_true", rename = "loop")]
    pub repeat: bool,
    /// Pause before it starts again, at least 1ms. Default 100ms.
    #[serde(default = "default_gap")]
    pub gap: Span,
    /// 2.0 plays twice as fast; 0.01 - 1000. Default 1.0.
    #[serde(default = "default_speed")]
    pub speed: f64,
}

fn default_bitrate() -> BitRate {
    BitRate(500_000)
}
fn default_data_bitrate() -> BitRate {
    BitRate(2_000_000)
}
fn default_max_rate() -> u32 {
    150_000
}
fn default_tx_queue() -> u32 {
    512
}
fn default_client_buffer() -> Size {
    Size(1 << 20)
}
fn default_max_clients() -> u32 {
    8
}
fn default_bus_off_restart() -> Span {
    Span::from_ms(100)
}
fn default_rx_buffer() -> Size {
    Size(4 << 20)
}
fn default_baud() -> u32 {
    115_200
}
fn default_gap() -> Span {
    Span::from_ms(100)
}
fn default_true() -> bool {
    true
}
fn default_speed() -> f64 {
    1.0
}

impl Config {
    /// Servers with their names, as `take_fd` and findings name them.
    pub fn endpoints(&self) -> Vec<(&'static str, EndpointTable)> {
        self.servers().into_iter().map(|(dialect, e)| (dialect.name(), e)).collect()
    }

    /// TCP servers with what they speak.
    pub fn servers(&self) -> Vec<(Dialect, EndpointTable)> {
        let serve = &self.serve;
        let all = [
            (Dialect::Socketcand, &serve.socketcand),
            (Dialect::Slcan, &serve.slcan),
            (Dialect::Cannelloni, &serve.cannelloni),
        ];
        all.into_iter().filter_map(|(dialect, e)| Some((dialect, e.as_ref()?.table()))).collect()
    }

    /// What the kernel interface shall be like.
    pub fn wanted(&self) -> Wanted {
        Wanted {
            name: self.interface.clone().unwrap_or_default(),
            bitrate: self.bitrate.0,
            data_bitrate: self.data_bitrate.0,
            fd: self.fd,
            restart_ms: (self.bus_off_restart.ns() / 1_000_000) as u32,
            configure: self.configure,
        }
    }

    /// How the channel of a serial adapter is opened; `None` when the protocol has no code for a rate.
    pub fn channel(&self) -> Option<Channel> {
        let data_rate_code = match self.fd {
            Some(true) => Some(slcan_client::data_rate_code(self.data_bitrate.0)?),
            _ => None,
        };
        Some(Channel {
            rate_code: slcan_client::rate_code(self.bitrate.0)?,
            data_rate_code,
            timestamps: self.timestamps,
            restart_ns: self.bus_off_restart.ns(),
        })
    }

    /// Where the adapter or the remote bus is, and the bus's name there.
    pub fn target(&self) -> Option<(Target, Option<String>)> {
        let text = self.interface.as_deref()?;
        match (text.strip_prefix("tcp://"), self.backend) {
            (None, Backend::Slcan) => Some((Target::Device { path: text.to_owned(), baud: self.baud }, None)),
            (Some(rest), Backend::Slcan) => address(rest).map(|a| (Target::Tcp(a), None)),
            (Some(rest), Backend::Socketcand) => {
                let (host, bus) = rest.split_once('/')?;
                let named = !bus.is_empty()
                    && bus.len() <= 16
                    && bus.bytes().all(|c| c.is_ascii_graphic() && c != b'/');
                let named = named && !bus.contains(['<', '>']);
                Some((Target::Tcp(address(host)?), named.then(|| bus.to_owned())))
            }
            _ => None,
        }
    }

    /// How the virtual bus shall behave.
    pub fn settings(&self, name: &str) -> Settings {
        Settings {
            name: name.to_owned(),
            bitrate: self.bitrate.0,
            data_bitrate: self.data_bitrate.0,
            pace: self.pace,
            max_rate: self.max_rate,
            tx_queue: self.tx_queue.clamp(1, 4096) as usize,
            client_buffer: self.client_buffer.0.clamp(4096, 64 << 20) as usize,
        }
    }

    /// Every mistake in the table itself; `dir` is the folder of the stack file.
    pub fn findings(&self, service: &str, dir: &std::path::Path) -> Vec<Finding> {
        let mut found = Vec::new();
        let mut error = |key: &str, message: String, help: &str| {
            found.push(Finding::error(service, key, message, help));
        };
        if !(5_000..=1_000_000).contains(&self.bitrate.0) {
            error("bitrate", format!("bitrate {} is not possible on CAN", self.bitrate), "use 5k to 1M");
        }
        if !(5_000..=8_000_000).contains(&self.data_bitrate.0) || self.data_bitrate < self.bitrate {
            error(
                "data_bitrate",
                format!("data_bitrate {} is not possible with bitrate {}", self.data_bitrate, self.bitrate),
                "use a rate from bitrate up to 8M",
            );
        }
        if !(100..=10_000_000).contains(&self.max_rate) {
            error(
                "max_rate",
                format!("max_rate {} is out of range", self.max_rate),
                "use 100 to 10000000 frames/s",
            );
        }
        if !(1..=4096).contains(&self.tx_queue) {
            error("tx_queue", format!("tx_queue {} is out of range", self.tx_queue), "use 1 to 4096");
        }
        if !(4096..=64 << 20).contains(&self.client_buffer.0) {
            let message = format!("client_buffer {} is out of range", self.client_buffer);
            error("client_buffer", message, "use 4KiB to 64MiB");
        }
        if self.backend == Backend::Virtual && self.interface.is_some() {
            found.push(Finding::warning(
                service,
                "interface",
                "a virtual bus has no interface",
                "remove the key; clients open the bus by the service's name",
            ));
        }
        self.backend_findings(service, &mut found);
        self.endpoint_findings(service, &mut found);
        self.feed_findings(service, dir, &mut found);
        found
    }

    fn backend_findings(&self, service: &str, found: &mut Vec<Finding>) {
        let mut error = |key: &str, message: String, help: &str| {
            found.push(Finding::error(service, key, message, help));
        };
        if self.bus_off_restart.ns() > 60_000_000_000 || !self.bus_off_restart.ns().is_multiple_of(1_000_000)
        {
            error(
                "bus_off_restart",
                format!("bus_off_restart {} is out of range", self.bus_off_restart),
                "use whole ms up to 60s; 0 = never",
            );
        }
        if !(64 << 10..=64 << 20).contains(&self.rx_buffer.0) {
            error("rx_buffer", format!("rx_buffer {} is out of range", self.rx_buffer), "use 64KiB to 64MiB");
        }
        match &self.filters {
            Filters::List(list) if list.is_empty() || list.len() > MAX_FILTERS => error(
                "filters",
                format!("filters has {} entries", list.len()),
                "use 1 to 512, or \"none\" for every frame",
            ),
            Filters::None => {}
            _ if self.backend != Backend::Socketcan => error(
                "filters",
                format!("backend \"{}\" has no filters in the kernel", self.backend.name()),
                "remove the key: every frame comes",
            ),
            _ => {}
        }
        match (self.backend, self.interface.as_deref()) {
            (Backend::Virtual, _) => {}
            (Backend::Socketcan, None | Some("")) => error(
                "interface",
                "backend \"socketcan\" needs the name of a network interface".into(),
                "add interface = \"can0\"; `ip -brief link` lists what there is",
            ),
            (Backend::Socketcan, Some(name)) if name.len() > 15 || name.contains(['/', ' ']) => error(
                "interface",
                format!("'{name}' is no name of a network interface"),
                "write e.g. \"can0\"; for a serial device use backend = \"slcan\"",
            ),
            (Backend::Socketcan, Some(name)) => {
                let sys = std::path::Path::new("/sys/class/net");
                if sys.is_dir() && !sys.join(name).exists() {
                    let (message, help) = if netlink::supported() {
                        (
                            format!("this machine has no interface '{name}' now ({})", netlink::known()),
                            format!(
                                "the driver waits for it; `ip link add dev {name} type vcan` makes one without hardware"
                            ),
                        )
                    } else {
                        (
                            format!("this machine has no interface '{name}', and its kernel no SocketCAN"),
                            "load it with `modprobe can_raw`, or use backend = \"slcan\" for a serial adapter".to_owned(),
                        )
                    };
                    found.push(Finding::warning(service, "interface", message, help));
                }
            }
            (Backend::Slcan, _) => self.slcan_findings(&mut error),
            (Backend::Socketcand, _) => match self.target() {
                Some((_, Some(_))) => {}
                _ => error(
                    "interface",
                    "backend \"socketcand\" needs the address of a server and its bus".into(),
                    "write e.g. interface = \"tcp://192.168.1.7:29536/can0\"",
                ),
            },
        }
    }

    fn slcan_findings(&self, error: &mut impl FnMut(&str, String, &str)) {
        if self.target().is_none() {
            error(
                "interface",
                "backend \"slcan\" needs a serial device or an address".into(),
                "write e.g. interface = \"/dev/ttyACM0\" or \"tcp://192.168.1.7:3333\"; `ls /dev/serial/by-id` lists serial adapters",
            );
        }
        if slcan_client::rate_code(self.bitrate.0).is_none() {
            error(
                "bitrate",
                format!("the SLCAN protocol has no bit rate {}", self.bitrate),
                "use 10k, 20k, 50k, 83300, 100k, 125k, 250k, 500k, 750k, 800k or 1M",
            );
        }
        if self.fd == Some(true) && slcan_client::data_rate_code(self.data_bitrate.0).is_none() {
            error(
                "data_bitrate",
                format!("the SLCAN protocol has no data bit rate {}", self.data_bitrate),
                "use 1M to 8M in whole M; most adapters have 2M and 5M",
            );
        }
        if !BAUDS.contains(&self.baud) {
            error(
                "baud",
                format!("a serial port has no rate {}", self.baud),
                "use e.g. 115200, 921600, 1000000 or 3000000",
            );
        }
    }

    fn endpoint_findings(&self, service: &str, found: &mut Vec<Finding>) {
        let mut total = 0;
        for (name, endpoint) in self.endpoints() {
            let key = format!("serve.{name}");
            total += endpoint.max_clients;
            if !(1..=MAX_CLIENTS as u32).contains(&endpoint.max_clients) {
                let message = format!("max_clients {} is out of range", endpoint.max_clients);
                found.push(Finding::error(service, &key, message, format!("use 1 to {MAX_CLIENTS}")));
            }
            match &endpoint.filter {
                Some(filter) => {
                    if let Some(fault) = filter.fault() {
                        found.push(Finding::error(service, &key, fault, "swap start and end"));
                    }
                }
                None if !endpoint.address.ip().is_loopback() => found.push(Finding::error(
                    service,
                    &key,
                    format!("{} is open to the network: anyone could send CAN frames", endpoint.address),
                    "add filter = { mask = \"255.255.255.0\", start = \"...\", end = \"...\" }, or listen on 127.0.0.1",
                )),
                None => {}
            }
        }
        if total > MAX_CLIENTS as u32 {
            found.push(Finding::error(
                service,
                "serve",
                format!("max_clients of all servers together is {total}"),
                format!("one bus has at most {MAX_CLIENTS} clients: lower max_clients"),
            ));
        }
    }

    fn feed_findings(&self, service: &str, dir: &std::path::Path, found: &mut Vec<Finding>) {
        let Some(feed) = &self.feed else { return };
        if !(0.01..=1000.0).contains(&feed.speed) {
            let message = format!("speed {} is out of range", feed.speed);
            found.push(Finding::error(service, "feed.speed", message, "use 0.01 to 1000"));
        }
        if feed.gap.ns() < 1_000_000 {
            let message = format!("gap {} is too short", feed.gap);
            found.push(Finding::error(service, "feed.gap", message, "use at least 1ms"));
        }
        match feed::Log::load(&dir.join(&feed.file), feed.bus.as_deref()) {
            Ok(_) => {}
            Err(e) => {
                let help = format!(
                    "`file` is a candump log (`candump -L`) of at most {} frames; `bus` picks the lines of one bus",
                    feed::MAX_FRAMES
                );
                found.push(Finding::error(service, "feed.file", e.to_string(), help));
            }
        }
    }
}

/// `host:port`, the host not empty.
fn address(text: &str) -> Option<String> {
    let (host, port) = text.rsplit_once(':')?;
    let good = !host.is_empty() && !host.contains('/') && port.parse::<u16>().is_ok_and(|port| port > 0);
    good.then(|| text.to_owned())
}

const _: () = assert!(CLIENT_QUEUE <= 4096 && MAX_CLIENTS <= 32);

#[cfg(test)]
#[path = "config_tests.rs"]
mod tests;
