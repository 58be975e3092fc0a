//! When outputs follow the image and when they go to their safe state.

use super::{SafeOn, Unsafe, judge};
use crate::clock;
use crate::context::Context;
use crate::event::{EventKind, Level};
use crate::payload::Image;
use crate::port::Subscriber;
use crate::units::Span;
use serde_json::{Value, json};

/// Judges images and their age. Sans-I/O.
#[derive(Debug, Clone)]
pub struct Guard {
    stale_ns: u64,
    safe_on: Vec<SafeOn>,
    image_ns: u64,
    why: Option<Unsafe>,
    /// The last entry was told and has no end yet.
    told: bool,
}

impl Guard {
    /// Outputs are in their safe state until the first image of a running program, and then in the states `safe_on` and
    /// while the image is older than `stale_after`.
    pub fn new(stale_after: Span, safe_on: &[SafeOn]) -> Self {
        Self {
            stale_ns: stale_after.ns(),
            safe_on: safe_on.to_vec(),
            image_ns: 0,
            why: Some(Unsafe::Waiting),
            told: false,
        }
    }

    /// Why outputs are in their safe state; `None`: they follow the image.
    pub fn why(&self) -> Option<Unsafe> {
        self.why
    }

    /// An image has come. One that waited too long in the queue is as good as none.
    pub fn image(&mut self, now_ns: u64, image: &Image) -> Option<Change> {
        self.image_ns = image.stamp.t_ns;
        let why = judge(image.plc_state(), image.scan, &self.safe_on);
        self.enter(why.or(self.is_stale(now_ns).then_some(Unsafe::Stale)))
    }

    /// Notices an image that stopped coming.
    pub fn on_time(&mut self, now_ns: u64) -> Option<Change> {
        if self.why.is_some() || !self.is_stale(now_ns) {
            return None;
        }
        self.enter(Some(Unsafe::Stale))
    }

    /// When [`Self::on_time`] would find the image stale.
    pub fn next_deadline(&self) -> Option<u64> {
        self.why.is_none().then(|| self.image_ns.saturating_add(self.stale_ns).saturating_add(1))
    }

    fn is_stale(&self, now_ns: u64) -> bool {
        now_ns.saturating_sub(self.image_ns) > self.stale_ns
    }

    fn enter(&mut self, why: Option<Unsafe>) -> Option<Change> {
        if self.why == why {
            return None;
        }
        let was = std::mem::replace(&mut self.why, why);
        let news = match (was, why) {
            (None, Some(why)) => {
                self.told = true;
                Some(News::Entered(why))
            }
            (_, None) if std::mem::take(&mut self.told) => Some(News::Left),
            _ => None,
        };
        Some(Change { why, was, news })
    }
}

/// What people are told of a [`Change`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum News {
    Entered(Unsafe),
    Left,
}

/// The safe state began, ended, or has another reason.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[must_use = "the service does what the change asks for, then tells it"]
pub struct Change {
    /// Why outputs are in their safe state now; `None`: they follow the image.
    pub why: Option<Unsafe>,
    /// The same before.
    pub was: Option<Unsafe>,
    news: Option<News>,
}

/// How a service calls its outputs in events.
#[derive(Debug, Clone, Copy)]
pub struct Words {
    /// Before a colon and the reason.
    pub entered: &'static str,
    /// A whole sentence.
    pub left: &'static str,
}

impl Words {
    /// Of a service that has outputs.
    pub const OUTPUTS: Self =
        Self { entered: "outputs went to their safe state", left: "outputs follow the image again" };
}

impl Change {
    /// Kind, level, sentence and details of the event; `None` where there is nothing to tell: before outputs ever
    /// followed an image, and when only the reason changed.
    pub fn event(&self, words: &Words) -> Option<(EventKind, Level, String, Value)> {
        Some(match self.news? {
            News::Entered(why) => {
                let message = format!("{}: {}", words.entered, why.text());
                (EventKind::SafeEntered, why.level(), message, json!({ "why": why }))
            }
            News::Left => (EventKind::SafeLeft, Level::Info, words.left.to_owned(), Value::Null),
        })
    }

    /// Sends the event, if there is one.
    pub fn tell(&self, ctx: &mut Context, words: &Words) {
        if let Some((kind, level, message, detail)) = self.event(words) {
            ctx.event(kind, level, message, detail);
        }
    }
}

/// The topic `<plc>/image` with its [`Guard`]. A service without outputs has no topic; then nothing ever changes.
pub struct OutputImage {
    port: Option<Subscriber<Image>>,
    guard: Guard,
    has_outputs: bool,
    inputs_t_ns: u64,
}

impl OutputImage {
    pub fn new(port: Option<Subscriber<Image>>, guard: Guard) -> Self {
        Self { has_outputs: port.is_some(), port, guard, inputs_t_ns: 0 }
    }

    /// The image is read for [`Self::inputs_t_ns`] alone: no safe state.
    #[must_use]
    pub fn without_outputs(mut self) -> Self {
        self.has_outputs = false;
        self
    }

    /// Why outputs are in their safe state; `None`: they follow the image, or there are none.
    pub fn why(&self) -> Option<Unsafe> {
        self.guard.why().filter(|_| self.has_outputs)
    }

    /// [`Image::inputs_t_ns`] of the newest image: the inputs sent before have reached the program.
    pub fn inputs_t_ns(&self) -> u64 {
        self.inputs_t_ns
    }

    /// Takes the newest image, if there is a new one; `follow` is handed its %Q and %M where outputs may follow it,
    /// before the change is returned. An image whose lengths disagree is left out.
    pub fn take(&mut self, mut follow: impl FnMut(&[u8], &[u8])) -> Option<Change> {
        let Self { port, guard, has_outputs, inputs_t_ns } = self;
        let mut change = None;
        port.as_mut()?.newest(|image, tail| {
            *inputs_t_ns = image.inputs_t_ns;
            let Some((_, q, m)) = image.areas(tail).filter(|_| *has_outputs) else { return };
            change = guard.image(clock::mono_ns(), image);
            if guard.why().is_none() {
                follow(q, m);
            }
        });
        change
    }

    /// See [`Guard::on_time`].
    pub fn on_time(&mut self, now_ns: u64) -> Option<Change> {
        self.guard.on_time(now_ns)
    }

    /// See [`Guard::next_deadline`].
    pub fn next_deadline(&self) -> Option<u64> {
        self.guard.next_deadline()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::payload::{PlcState, Stamp};
    use proptest::prelude::*;

    const MS: u64 = 1_000_000;

    fn image(state: PlcState, t_ns: u64) -> Image {
        let stamp = Stamp { t_ns, ..Stamp::default() };
        Image { stamp, scan: 1, state: state as u32, ..Image::default() }
    }

    fn guard() -> Guard {
        Guard::new(Span::from_ms(200), &SafeOn::ALL)
    }

    fn said(change: Option<Change>) -> String {
        match change.map(|c| c.event(&Words::OUTPUTS)) {
            None => "-".to_owned(),
            Some(None) => "changed".to_owned(),
            Some(Some((kind, level, message, detail))) => format!("{kind:?} {level:?} {message} {detail}"),
        }
    }

    #[test]
    fn entries_and_ends_are_told_once() {
        let mut guard = guard();
        assert_eq!(guard.next_deadline(), None);
        // The first images: nothing has been driven yet, so nothing is told.
        assert_eq!(said(guard.image(0, &image(PlcState::Stop, 0))), "changed");
        assert_eq!(said(guard.image(MS, &image(PlcState::Run, MS))), "changed");
        assert_eq!(said(guard.image(2 * MS, &image(PlcState::Run, 2 * MS))), "-");
        let entered = guard.image(3 * MS, &image(PlcState::Fault, 3 * MS));
        assert_eq!(
            said(entered),
            r#"SafeEntered Fault outputs went to their safe state: the program of the PLC faulted {"why":"fault"}"#
        );
        assert_eq!(entered.map(|c| (c.was, c.why)), Some((None, Some(Unsafe::Fault))));
        // Another reason on the way is no news, and does not swallow the end.
        assert_eq!(said(guard.image(4 * MS, &image(PlcState::Starting, 4 * MS))), "changed");
        let left = guard.image(5 * MS, &image(PlcState::Run, 5 * MS));
        assert_eq!(said(left), "SafeLeft Info outputs follow the image again null");
        assert_eq!(left.map(|c| (c.was, c.why)), Some((Some(Unsafe::Waiting), None)));
    }

    #[test]
    fn an_image_that_stops_coming_is_noticed_at_its_deadline() {
        let mut guard = guard();
        let _ = guard.image(5 * MS, &image(PlcState::Run, 4 * MS));
        assert_eq!(guard.next_deadline(), Some(204 * MS + 1));
        assert_eq!(guard.on_time(204 * MS), None);
        let change = guard.on_time(204 * MS + 1).unwrap();
        assert_eq!(change.why, Some(Unsafe::Stale));
        assert_eq!(guard.next_deadline(), None);
        assert_eq!(guard.on_time(300 * MS), None);
        // One that waited in the queue does not bring them back.
        assert_eq!(guard.image(300 * MS, &image(PlcState::Run, 99 * MS)), None);
        assert!(guard.image(300 * MS, &image(PlcState::Run, 100 * MS)).is_some());
        assert_eq!(guard.why(), None);
    }

    #[test]
    fn an_image_that_is_stale_and_stopped_is_stopped() {
        let mut guard = guard();
        let _ = guard.image(0, &image(PlcState::Run, 0));
        let change = guard.image(900 * MS, &image(PlcState::Stop, 0)).unwrap();
        assert_eq!(change.why, Some(Unsafe::Stop));
        // Its stop was no fault, whatever became of the plc afterwards.
        assert_eq!(change.event(&Words::OUTPUTS).map(|e| e.1), Some(Level::Info));
    }

    #[test]
    fn a_service_without_outputs_has_no_safe_state() {
        let mut outputs = OutputImage::new(None, guard());
        assert_eq!(outputs.take(|_, _| panic!("there is no image")), None);
        assert_eq!((outputs.why(), outputs.on_time(900 * MS), outputs.next_deadline()), (None, None, None));
    }

    proptest! {
        #[test]
        fn whatever_comes_every_entry_told_has_one_end(
            steps in prop::collection::vec((0..400u64, 0..7u32, 0..400u64), 0..80)
        ) {
            let mut guard = guard();
            let (mut now_ns, mut entered) = (1000 * MS, false);
            for (step_ms, state, age_ms) in steps {
                now_ns += step_ms * MS;
                let change = match state {
                    5.. => guard.on_time(now_ns),
                    state => guard.image(now_ns, &image(PlcState::from_u32(state), now_ns - age_ms * MS)),
                };
                if let Some(change) = change {
                    prop_assert_ne!(change.why, change.was);
                    prop_assert_eq!(change.why, guard.why());
                    if let Some((kind, ..)) = change.event(&Words::OUTPUTS) {
                        prop_assert_eq!(kind == EventKind::SafeEntered, !entered);
                        entered = !entered;
                    }
                }
                prop_assert!(!entered || guard.why().is_some());
                prop_assert_eq!(guard.why().is_none(), guard.next_deadline().is_some());
            }
        }
    }
}
