//! What the loop tells about a scan: events for people and for the recording, answers to commands.

use super::*;

impl Live {
    pub(super) fn tell_orders(&mut self, ctx: &mut Context, before: PlcState) {
        let orders = std::mem::take(&mut self.orders);
        for (source, order) in &orders {
            let by = ctx.stack.writer_name(source.writer);
            match order {
                Order::Start(kind) => {
                    let message = format!("PLC started, {} start", kind.word());
                    let detail = json!({ "start": kind, "by": by, "scan": self.engine.scan() });
                    ctx.event(EventKind::PlcStarted, Level::Info, message, detail);
                    ctx.set_state(HealthState::Ready);
                    self.restart_at_ns = None;
                }
                Order::Stop => {
                    self.restart_at_ns = None;
                    if before == PlcState::Run {
                        let detail = json!({ "by": by, "scan": self.engine.scan() });
                        let message = format!("PLC stopped by {by}");
                        ctx.event(EventKind::PlcStopped, Level::Warning, message, detail);
                    }
                }
                Order::Force(patch, path) => {
                    let text = self
                        .engine
                        .resolve(path)
                        .map_or_else(|_| "?".to_owned(), |c| c.text(self.engine.memory()));
                    let detail = json!({ "var": path, "value": text, "by": by, "offset": patch.offset });
                    ctx.event(
                        EventKind::Forced,
                        Level::Warning,
                        format!("{path} forced to {text} by {by}"),
                        detail,
                    );
                }
                Order::Unforce(_, path) => {
                    let detail = json!({ "var": path, "by": by });
                    ctx.event(
                        EventKind::Forced,
                        Level::Info,
                        format!("{path} no longer forced, by {by}"),
                        detail,
                    );
                }
                Order::UnforceAll => {
                    ctx.event(
                        EventKind::Forced,
                        Level::Info,
                        format!("nothing forced any more, by {by}"),
                        json!({ "by": by }),
                    );
                }
                Order::Set(..) | Order::Load(_) => {}
            }
        }
        self.orders = orders;
        self.orders.clear();
        let now_ns = clock::mono_ns();
        for i in 0..self.replies.len() {
            let asker = self.replies[i];
            let code = if now_ns > asker.deadline_ns { 2 } else { 0 };
            self.reply(&asker, code, json!({ "ok": true }));
        }
        self.replies.clear();
    }

    pub(super) fn tell_fault(&mut self, ctx: &mut Context, fault: &FaultReport, now_ns: u64) {
        self.counters.faults += 1;
        let mut detail = serde_json::to_value(fault).unwrap_or(Value::Null);
        detail["scan"] = json!(self.engine.scan());
        let restarts = restart_of(self.config.on_fault).is_some();
        let next = if restarts {
            "it starts again in a second (on_fault)".to_owned()
        } else {
            let service = &ctx.service;
            format!(
                "`dinrail plc run --service {service}` starts it again, RETAIN kept; `dinrail plc load` another program"
            )
        };
        let message = format!("program fault: {}; {next}", fault.message);
        ctx.event(EventKind::ProgramFault, Level::Fault, message, detail);
        ctx.set_state(HealthState::Degraded);
        self.keyframe_wanted = Some(Reason::Trap);
        if restarts {
            self.restart_at_ns = Some(now_ns + RESTART_NS);
        }
    }

    pub(super) fn tell_quality(&mut self, ctx: &mut Context) {
        for i in 0..self.inputs.len() {
            let quality = self.inputs[i].quality(&self.engine);
            let told = self.inputs[i].told.replace(quality);
            if told == Some(quality) || (told.is_none() && quality == Quality::Good) {
                continue;
            }
            let name = self.inputs[i].name.clone();
            let (level, words) = match quality {
                Quality::Good => (Level::Info, "good"),
                Quality::Stale => (Level::Warning, "stale"),
                Quality::NoData => (Level::Warning, "without data"),
                Quality::OwnerDead => (Level::Warning, "bad: their service is dead or silent"),
            };
            let detail = json!({ "quality": quality, "was": told, "scan": self.engine.scan() });
            ctx.event_about(
                &name,
                EventKind::InputQuality,
                level,
                format!("inputs of '{name}' are {words}"),
                detail,
            );
        }
    }
}
