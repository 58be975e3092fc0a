//! All SDO server channels of a device: objects 1200-127Fh (CiA 301 V4.2, 7.5.2.33).

use super::channel::{CHANNELS, SERVER, server_channel};
use super::server::{SdoServer, ServerConfig};
use crate::protocol::io::Outbox;
use crate::protocol::od::{Hooks, ObjectDictionary};
use ipc_types::payload::CanFrame;

/// The server channels that exist, by the object dictionary.
#[derive(Clone, Debug)]
pub struct SdoServers {
    /// Number of the channel (0-127) and its server, ascending.
    servers: Vec<(u8, SdoServer)>,
    config: ServerConfig,
}

impl SdoServers {
    /// The channels of `od`. Memory: one buffer a channel, as long as the dictionary's longest value (at most
    /// `config.max_value`).
    pub fn new(od: &ObjectDictionary, config: ServerConfig) -> Self {
        let mut servers = Self { servers: Vec::new(), config };
        servers.refresh_all(od);
        servers
    }
    /// Takes the COB-IDs of every channel from the dictionary: after a reset or a change of the node-id.
    pub fn refresh_all(&mut self, od: &ObjectDictionary) {
        for n in 0..CHANNELS {
            self.refresh(od, n);
        }
    }
    /// Takes the COB-IDs of channel `n` (0-127) from the dictionary: after a write to object 1200h + n. Allocates
    /// the buffer when the channel comes to be.
    pub fn refresh(&mut self, od: &ObjectDictionary, n: u8) {
        let at = self.servers.binary_search_by_key(&n, |server| server.0);
        match (server_channel(od, n), at) {
            (Some(channel), Ok(at)) => self.servers[at].1.set_channel(channel),
            (Some(channel), Err(at)) => {
                self.servers.insert(at, (n, SdoServer::new(channel, self.config, od)));
            }
            (None, Ok(at)) => {
                self.servers.remove(at);
            }
            (None, Err(_)) => {}
        }
    }
    /// The number of the channel whose parameters lie at `index`.
    pub fn channel_of(index: u16) -> Option<u8> {
        (SERVER..SERVER + u16::from(CHANNELS)).contains(&index).then(|| (index - SERVER) as u8)
    }
    /// The channels, with their numbers.
    pub fn iter(&self) -> impl Iterator<Item = (u8, &SdoServer)> {
        self.servers.iter().map(|(n, server)| (*n, server))
    }
    /// Drops all transfers without a word: the node was reset or stopped.
    pub fn reset(&mut self) {
        for (_, server) in &mut self.servers {
            server.reset();
        }
    }
    /// A frame came; `false` if it is of none of the channels.
    pub fn on_frame(
        &mut self,
        t_ns: u64,
        frame: &CanFrame,
        od: &mut ObjectDictionary,
        hooks: &mut dyn Hooks,
        out: &mut Outbox,
    ) -> bool {
        self.servers.iter_mut().any(|(_, server)| server.on_frame(t_ns, frame, od, hooks, out))
    }
    /// When [`on_time`](Self::on_time) wants to be called.
    pub fn next_deadline(&self) -> Option<u64> {
        self.servers.iter().filter_map(|(_, server)| server.next_deadline()).min()
    }
    /// A time has come.
    pub fn on_time(&mut self, t_ns: u64, out: &mut Outbox) {
        for (_, server) in &mut self.servers {
            server.on_time(t_ns, out);
        }
    }
}
