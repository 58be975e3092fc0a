//! The service `canopen-master`: rail ports, clocks, the loop.

mod book;
mod jobs;
mod later;
mod report;
mod setup;

pub use setup::{check, topics};

use super::job_port::JobPort;
use super::ports::{Ports, Station};
use super::{EVENTS_A_SECOND, RunError, SEND_AT, TAKE_FRAMES, load, plc_of};
use crate::config::{MasterConfig as Config, OnStop, OnStopWord};
use crate::master::exchange::Exchange;
use crate::master::network::Network;
use crate::master::plan::{Plan, plan};
use crate::master::transfers::Transfers;
use crate::protocol::cob_id::predefined;
use crate::protocol::io::Outbox;
use crate::protocol::nmt::NmtCommand;
use crate::protocol::time_stamp::TimeOfDay;
use book::Book;
use ipc_types::event::Budget;
use ipc_types::inputs::InputsPort;
use ipc_types::outputs::{Change, Guard, Words, gather};
use ipc_types::payload::{CanFrame, HealthState, Inputs};
use ipc_types::turns::Turns;
use ipc_types::wiring::ImageRange;
use ipc_types::{Context, clock};
use jobs::Desk;
use later::Later;
use setup::safe_values;

/// Runs until the launcher says stop.
pub fn run(mut ctx: Context) -> Result<(), RunError> {
    let config: Config = ctx.config()?;
    let wiring = ctx.entry().map(|entry| entry.wiring.clone()).unwrap_or_default();
    let name = ctx.service.clone();
    let (_, addressing) = plc_of(&ctx.stack, &wiring);
    let (devices, mistakes) = load::devices(&config, &ctx.stack.dir);
    let mut plan = plan(&config, &devices, addressing, &name);
    let wrong = mistakes.into_iter().chain(std::mem::take(&mut plan.mistakes)).find(|m| !m.warning);
    if let Some(mistake) = wrong {
        return Err(RunError::Config { key: mistake.key, message: mistake.message });
    }
    let safe =
        safe_values(&config, &plan.outputs).map_err(|(key, message)| RunError::Config { key, message })?;
    let ports = Ports::open(&mut ctx, &wiring, Guard::new(config.stale_after, &config.safe_on))?;
    let jobs = JobPort::open(&mut ctx)?;
    let mut turns = Turns::new(ctx.inbox()?, ctx.shutdown_fd())?;
    plan.settings.takeover = ctx.generation > 1;
    let Plan { settings, sync_window_ns, nodes, exchange, outputs, .. } = plan;
    let transfers = Transfers::new(config.nodes.iter().map(|node| {
        let timeout = node.sdo_timeout.unwrap_or(config.sdo_timeout);
        (node.id, timeout.ns())
    }));
    let names = nodes.iter().map(|n| (n.settings.plan.id, n.name.clone())).collect();
    let settings_of_nodes = nodes.into_iter().map(|n| n.settings).collect();
    let mut service = Service {
        network: Network::new(
            settings,
            settings_of_nodes,
            Exchange::new(exchange, sync_window_ns),
            transfers,
        ),
        gathered: vec![0; outputs.iter().map(|r| r.bytes as usize).sum()],
        outputs,
        safe_values: safe,
        desk: Desk::new(Book { devices, names }, config.sdo_timeout.ns()),
        ctx,
        config,
        ports,
        jobs,
        out: Outbox::default(),
        state: HealthState::Ready,
        events: Budget::new(EVENTS_A_SECOND),
        sync_late_ns: (0, 0),
        sync_out_ns: (0, 0),
        later: Later::default(),
    };
    service.introduce();
    if !service.await_driver(&mut turns)? {
        return Ok(());
    }
    service.begin();
    service.work(turns)
}

struct Service {
    ctx: Context,
    config: Config,
    network: Network,
    desk: Desk,
    outputs: Vec<ImageRange>,
    gathered: Vec<u8>,
    safe_values: Option<Vec<u8>>,
    ports: Ports,
    jobs: JobPort,
    out: Outbox,
    state: HealthState,
    events: Budget,
    /// From the time that the SYNC was due to its being sent: the last time, and the longest.
    sync_late_ns: (u64, u64),
    /// From the SYNC to its last PDO in the driver's queue, likewise.
    sync_out_ns: (u64, u64),
    /// What is due with the heartbeat and waits for the SYNC.
    later: Later,
}

impl Station for Service {
    fn parts(&mut self) -> (&mut Ports, &mut Context) {
        (&mut self.ports, &mut self.ctx)
    }

    fn publish(&mut self, fresh: bool) {
        publish(&mut self.ports.inputs, &mut self.network.exchange, fresh);
    }

    fn status(&mut self) {
        self.report();
    }
}

impl Service {
    fn begin(&mut self) {
        let now_ns = clock::mono_ns();
        self.network.start(now_ns, &mut self.out);
        self.send();
        self.status();
    }

    fn work(&mut self, mut turns: Turns) -> Result<(), RunError> {
        loop {
            let due = turns.wait()?;
            if due.stop {
                self.end();
                return Ok(());
            }
            // The SYNC goes before everything else, and is looked for again behind what may take long.
            self.sync();
            turns.drain();
            let more = self.take_frames();
            self.sync();
            self.take_image();
            self.take_jobs();
            let now_ns = clock::mono_ns();
            let change = self.ports.image.on_time(now_ns);
            self.follow(change);
            self.on_time();
            self.answer_jobs();
            self.tell_events();
            // A status takes longer than a SYNC may be late. The turn of the SYNC does it.
            let regular = self.later.take(due, self.network.is_sync_near(now_ns), now_ns);
            self.regular(regular);
            let next_ns = self.ports.next_ns(now_ns, more, self.network.next_deadline());
            turns.come_again(next_ns)?;
        }
    }

    /// The SYNC, if it is due. It is with the driver before its PDOs are made.
    fn sync(&mut self) {
        let began_ns = clock::mono_ns();
        let Some(late_ns) = self.network.sync(began_ns, &mut self.out) else { return };
        self.send();
        self.network.sync_pdos(began_ns, &mut self.out);
        if !self.out.is_empty() {
            self.send();
        }
        let out_ns = clock::mono_ns().saturating_sub(began_ns);
        self.sync_late_ns = (late_ns, self.sync_late_ns.1.max(late_ns));
        self.sync_out_ns = (out_ns, self.sync_out_ns.1.max(out_ns));
    }

    fn on_time(&mut self) {
        self.sync();
        let now_ns = clock::mono_ns();
        self.network.on_time(now_ns, &mut self.out);
        if self.network.take_time_due(now_ns) {
            let ms = u64::try_from(clock::utc_ns() / 1_000_000).unwrap_or(0);
            if let Some(time) = TimeOfDay::from_unix_ms(ms) {
                self.out.push(CanFrame::classic(predefined::TIME, &time.encode()));
            }
        }
        self.send();
        self.publish_sample();
    }

    fn send(&mut self) {
        self.ports.send(self.out.drain(), |_| {});
    }

    /// Takes frames of the bus; true when more may wait.
    fn take_frames(&mut self) -> bool {
        let Some(mut rx) = self.ports.rx.take() else { return false };
        let taken = rx.drain(TAKE_FRAMES, |frame, _| {
            if frame.fault().is_none() {
                self.network.on_frame(frame.stamp.t_ns, frame, &mut self.out);
                // Each SYNC is published for itself, however many frames were waiting.
                if self.network.exchange.is_sample_due() && self.network.exchange.take_sample().is_some() {
                    self.publish(true);
                }
                // One frame may make a sub-block of 127: many nodes that acknowledge theirs would overfill the outbox.
                if self.out.len() >= SEND_AT {
                    self.send();
                }
            }
        });
        self.ports.rx = Some(rx);
        self.send();
        self.publish_sample();
        taken == TAKE_FRAMES
    }

    fn publish_sample(&mut self) {
        if self.network.exchange.take_sample().is_some() {
            self.publish(true);
        }
    }

    fn take_image(&mut self) {
        let Self { outputs, gathered, network, ports, .. } = self;
        let change = ports.image.take(|q, m| {
            gather(outputs, q, m, gathered);
            network.exchange.set_outputs(gathered);
        });
        network.exchange.on_scan(ports.image.inputs_t_ns());
        self.follow(change);
    }

    /// The outputs enter or leave their safe state, or it has another reason.
    fn follow(&mut self, change: Option<Change>) {
        let Some(change) = change else { return };
        if change.why.is_some() {
            self.enter_safe();
        } else {
            self.network.set_safe(clock::mono_ns(), None, &mut self.out);
        }
        change.tell(&mut self.ctx, &Words::OUTPUTS);
        self.send();
    }

    fn enter_safe(&mut self) {
        if let Some(values) = &self.safe_values {
            self.network.exchange.set_outputs(values);
        }
        let command = match self.config.on_stop {
            OnStop::Word(OnStopWord::Preop) => Some(NmtCommand::EnterPreOperational),
            OnStop::Word(OnStopWord::Stop) => Some(NmtCommand::Stop),
            _ => None,
        };
        if command.is_some() {
            self.network.set_safe(clock::mono_ns(), command, &mut self.out);
        }
    }

    /// An orderly end: the safe state goes out once more, synchronous outputs behind a last SYNC.
    fn end(&mut self) {
        self.enter_safe();
        let now_ns = clock::mono_ns();
        self.network.last_outputs(now_ns, &mut self.out);
        self.send();
        let waiting = self.ports.queue.len();
        if waiting > 0 {
            tracing::warn!("{waiting} frames of the safe state found no room in the driver's queue");
        }
    }
}

/// All inputs with the number of SYNCs so far; the queues learn when they were sent.
fn publish(port: &mut InputsPort, exchange: &mut Exchange, fresh: bool) {
    let header = Inputs {
        data_t_ns: exchange.data_t_ns(),
        samples: exchange.samples(),
        ranges: exchange.ranges(),
        ..Inputs::default()
    };
    if let Some(sent_ns) = port.publish(header, exchange.tail(), fresh) {
        exchange.published(sent_ns);
    }
}
