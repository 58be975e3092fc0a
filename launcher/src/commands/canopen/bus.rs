//! A protocol machine of this command on the bus of a running stack.

use super::BusArgs;
use crate::supervise::client::{find, observe};
use crate::supervise::jobs::choose;
use dinrail_canopen::protocol::io::Outbox;
use ipc_types::clock;
use ipc_types::payload::CanFrame;
use ipc_types::port::{Publisher, SendError, Subscriber};
use ipc_types::topic::TopicKind;
use ipc_types::{Context, Stack};
use std::rc::Rc;
use std::time::{Duration, Instant};

/// Looks at the bus this often: the commands here wait for answers of devices, which take longer.
const LOOK: Duration = Duration::from_micros(500);
/// A queue of the driver that stays full for so long is a bus that does not move.
const FULL_LIMIT: Duration = Duration::from_secs(2);

/// The bus, seen by this process.
pub struct Bus {
    pub name: String,
    pub stack: Rc<Stack>,
    rx: Subscriber<CanFrame>,
    tx: Publisher<CanFrame>,
    _ctx: Context,
}

impl Bus {
    pub fn open(args: &BusArgs) -> anyhow::Result<Self> {
        let mut ctx = observe(&find(args.which.stack.as_deref())?)?;
        let name = choose(&ctx, "can", args.bus.as_deref())?;
        let rx = ctx.subscriber(&TopicKind::CanRx.of(&name))?;
        let tx = ctx.publisher(&TopicKind::CanTx.of(&name))?;
        Ok(Self { name, stack: ctx.stack.clone(), rx, tx, _ctx: ctx })
    }

    /// Hands frames to the driver, as fast as the bus takes them.
    pub fn send(&mut self, out: &mut Outbox) -> anyhow::Result<()> {
        for frame in out.drain() {
            let begin = Instant::now();
            loop {
                match self.tx.send(frame) {
                    Ok(_) => break,
                    Err(SendError::Full(_)) if begin.elapsed() < FULL_LIMIT => std::thread::sleep(LOOK),
                    Err(e) => anyhow::bail!("bus '{}': {e}", self.name),
                }
            }
        }
        self.tx.ring();
        Ok(())
    }

    /// The frames that came since the last call, with now.
    pub fn take(&mut self, mut each: impl FnMut(u64, &CanFrame)) -> u64 {
        std::thread::sleep(LOOK);
        self.rx.drain(256, |frame, _| {
            if frame.fault().is_none() {
                each(frame.stamp.t_ns, frame);
            }
        });
        clock::mono_ns()
    }
}
