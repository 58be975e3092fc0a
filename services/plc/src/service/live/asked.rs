//! Jobs: read, checked, done or handed to the next scan; programs loaded while the old one runs.

use super::*;

impl Live {
    pub(super) fn take_jobs(&mut self, ctx: &mut Context) {
        let mut taken: Vec<(Asker, Vec<u8>)> = Vec::new();
        self.jobs.drain(16, |job, tail| {
            let stamp = job.stamp;
            let source = Source { writer: stamp.writer, generation: stamp.generation, seq: stamp.seq };
            taken.push((Asker { source, deadline_ns: job.deadline_t_ns }, tail.to_vec()));
        });
        for (asker, tail) in taken {
            self.counters.jobs += 1;
            if clock::mono_ns() > asker.deadline_ns {
                self.reply(&asker, 2, json!({ "error": "expired before it was read" }));
                continue;
            }
            match jobs::parse(&tail, &self.engine, &self.orders) {
                Ok(request) => self.take_request(ctx, asker, request),
                Err((code, text)) => self.reply(&asker, code, json!({ "error": text })),
            }
        }
    }

    fn take_request(&mut self, ctx: &mut Context, asker: Asker, request: Request) {
        match request {
            Request::Orders(orders) => {
                if self.orders.len() + orders.len() > MAX_ORDERS {
                    let text = format!("{} commands already wait for the next scan", self.orders.len());
                    self.reply(&asker, 1, json!({ "error": text }));
                    return;
                }
                self.orders.extend(orders.into_iter().map(|order| (asker.source, order)));
                self.replies.push(asker);
                self.hurry = true;
            }
            Request::Answer(value) => self.reply(&asker, 0, json!({ "ok": value })),
            Request::Status => {
                let value = status(self, clock::mono_ns());
                self.reply(&asker, 0, json!({ "ok": value }));
            }
            Request::Keyframe => {
                self.keyframe_wanted.get_or_insert(Reason::Request);
                self.reply(&asker, 0, json!({ "ok": true }));
            }
            Request::Load { path, cold } => {
                if self.loading.is_some() {
                    self.reply(&asker, 1, json!({ "error": "another program is being loaded" }));
                    return;
                }
                tracing::info!(
                    "loading {} for {}",
                    path.display(),
                    ctx.stack.writer_name(asker.source.writer)
                );
                let started =
                    Loading::start(asker, &self.runtime, self.engine.setup(), self.dir.clone(), path, cold);
                match started {
                    Ok(loading) => self.loading = Some(loading),
                    Err(text) => self.reply(&asker, 1, json!({ "error": text })),
                }
            }
        }
    }

    pub(super) fn finish_load(&mut self, ctx: &mut Context) {
        let Some(result) = self.loading.as_ref().and_then(Loading::poll) else { return };
        let Some(loading) = self.loading.take() else { return };
        let mut engine = match result {
            Ok(engine) => engine,
            Err(text) => {
                self.reply(
                    &loading.asker,
                    1,
                    json!({ "error": format!("{}: {text}", loading.path.display()) }),
                );
                return;
            }
        };
        engine.continue_from(&self.engine);
        let layout = engine.retain_layout();
        let kept = !loading.cold && layout == self.retain_layout && engine.set_retain(self.engine.retain());
        let start = if kept { Start::Warm } else { Start::Cold };
        if self.engine.forces().next().is_some() {
            ctx.event(EventKind::Forced, Level::Info, "nothing forced any more: a new program", Value::Null);
        }
        self.engine = engine;
        self.retain_layout = layout;
        self.copy_to_disk();
        self.orders.clear();
        // What waited was meant for the old program.
        for asker in std::mem::take(&mut self.replies) {
            self.reply(&asker, 1, json!({ "error": "another program was loaded meanwhile; ask again" }));
        }
        self.orders.push((loading.asker.source, Order::Load(self.engine.program_hash())));
        self.orders.push((loading.asker.source, Order::Start(start)));
        self.replies.push(loading.asker);
        self.keyframe_next = None;
        self.engine.take_keyframe(Reason::Load);
        self.keyframe_next = Some(0);
        self.send_keyframe();
        self.tell_loaded(ctx);
        self.hurry = true;
    }

    pub(super) fn reply(&mut self, asker: &Asker, code: u32, body: Value) {
        let header = JobResult {
            job_seq: asker.source.seq,
            job_writer: asker.source.writer,
            job_generation: asker.source.generation,
            code,
            ..JobResult::default()
        };
        let text = serde_json::to_vec(&body).unwrap_or_default();
        let sent = if text.len() > self.results.max_tail() as usize {
            let short = json!({ "error": "the answer is longer than 4096 bytes; ask for less at once" });
            let header = JobResult { code: 1, ..header };
            self.results.send_tail(header, &serde_json::to_vec(&short).unwrap_or_default())
        } else {
            self.results.send_tail(header, &text)
        };
        if let Err(e) = sent {
            tracing::warn!("an answer was not sent: {e}");
        }
        self.results.ring();
    }
}
