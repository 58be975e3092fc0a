//! What `top` shows and how keys change it. Knows no terminal, socket or clock: snapshots, log lines and keys go
//! in, wishes come out, so that every screen can be tested.

use super::feed::{Snapshot, Told};
use crate::supervise::control::LogLine;
use ipc_types::event::EventBody;
use serde_json::Value;
use std::collections::{BTreeMap, VecDeque};

/// Events that are kept.
const EVENTS_MAX: usize = 500;
/// Lines that Page Up and Page Down move.
const PAGE: usize = 10;

/// A key, whatever the terminal calls it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Key {
    Up,
    Down,
    PageUp,
    PageDown,
    Home,
    End,
    Enter,
    Escape,
    /// Ctrl-C.
    Interrupt,
    Char(char),
}

/// What the loop around the model shall do.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Wish {
    Quit,
    Restart(String),
    /// Fetch the log of this service now and at each refresh, until another view is shown.
    Log(String),
}

/// What fills the screen.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum View {
    #[default]
    Main,
    Events,
    Image,
    Log(String),
    Help,
}

/// The state of the screen.
#[derive(Debug, Default)]
pub struct Model {
    pub stack: String,
    pub now: Snapshot,
    /// The status before the last one of each service, for rates.
    before: BTreeMap<String, Told>,
    pub view: View,
    pub selected: usize,
    /// Lines scrolled up from the end (log, events) or down from the start (image).
    pub scroll: usize,
    /// Service that is restarted when the answer is `y`.
    pub confirm: Option<String>,
    /// One line for the user, e.g. how a restart went.
    pub message: Option<String>,
    /// Why the stack cannot be seen now.
    pub gone: Option<String>,
    pub events: VecDeque<EventBody>,
    pub log: Vec<LogLine>,
}

impl Model {
    pub fn new(stack: &str) -> Self {
        Self { stack: stack.to_owned(), ..Self::default() }
    }

    /// Shows a new moment of the stack.
    pub fn take(&mut self, mut snapshot: Snapshot) {
        self.gone = None;
        let selected = self.selected_service().map(str::to_owned);
        for told in &snapshot.told {
            let last = self.now.told.iter().find(|t| t.service == told.service);
            if let Some(last) = last.filter(|last| last.t_ns != told.t_ns) {
                self.before.insert(told.service.clone(), last.clone());
            }
        }
        for event in snapshot.events.drain(..) {
            if self.events.len() == EVENTS_MAX {
                self.events.pop_front();
            }
            self.events.push_back(event);
        }
        self.now = snapshot;
        if let Some(at) = selected.and_then(|name| self.now.rows.iter().position(|r| r.service == name)) {
            self.selected = at;
        }
        self.selected = self.selected.min(self.now.rows.len().saturating_sub(1));
    }

    /// The stack cannot be seen any more; what was seen last stays on the screen.
    pub fn lose(&mut self, why: String) {
        self.gone = Some(why);
        self.confirm = None;
        // Rates across the pause would be nonsense.
        self.before.clear();
    }

    /// Shows the log of the service that is looked at.
    pub fn take_log(&mut self, service: &str, lines: Vec<LogLine>) {
        if self.view == View::Log(service.to_owned()) {
            self.log = lines;
        }
    }

    pub fn selected_service(&self) -> Option<&str> {
        self.now.rows.get(self.selected).map(|r| r.service.as_str())
    }

    /// How fast a counter of a service's status grows, per second. `None` before there are two statuses of one
    /// process.
    pub fn rate(&self, service: &str, counter: &str) -> Option<f64> {
        let (new, old) = (self.now.told.iter().find(|t| t.service == service)?, self.before.get(service)?);
        if new.generation != old.generation {
            return None;
        }
        let grown = number(&new.body, counter)? - number(&old.body, counter)?;
        let seconds = new.t_ns.saturating_sub(old.t_ns) as f64 / 1e9;
        (grown >= 0.0 && seconds > 0.0).then(|| grown / seconds)
    }

    /// A key was pressed.
    pub fn key(&mut self, key: Key) -> Option<Wish> {
        if key == Key::Interrupt {
            return Some(Wish::Quit);
        }
        if let Some(service) = self.confirm.take() {
            let yes = matches!(key, Key::Char('y' | 'Y'));
            self.message = Some(if yes {
                format!("restarting {service} ...")
            } else {
                format!("{service} is not restarted")
            });
            return yes.then_some(Wish::Restart(service));
        }
        self.message = None;
        match (key, &self.view) {
            (Key::Char('q'), View::Main) => return Some(Wish::Quit),
            (Key::Char('q') | Key::Escape, _) => self.show(View::Main),
            (Key::Char('?'), View::Help) => self.show(View::Main),
            (Key::Char('?' | 'h'), _) => self.show(View::Help),
            (Key::Char('e'), View::Events) | (Key::Char('i'), View::Image) => self.show(View::Main),
            (Key::Char('e'), _) => self.show(View::Events),
            (Key::Char('i'), _) => self.show(View::Image),
            (Key::Char('l'), View::Log(_)) => self.show(View::Main),
            (Key::Char('l') | Key::Enter, View::Main) => return self.open_log(),
            (Key::Char('r'), View::Main) => self.ask_restart(),
            (Key::Down | Key::Char('j'), View::Main) => self.select(1),
            (Key::Up | Key::Char('k'), View::Main) => self.select(-1),
            (Key::Home | Key::Char('g'), View::Main) => self.selected = 0,
            (Key::End | Key::Char('G'), View::Main) => self.select(isize::MAX),
            (Key::PageDown, View::Main) => self.select(PAGE as isize),
            (Key::PageUp, View::Main) => self.select(-(PAGE as isize)),
            (Key::Down | Key::Char('j'), _) => self.scroll_by(1),
            (Key::Up | Key::Char('k'), _) => self.scroll_by(-1),
            (Key::PageDown | Key::Char(' '), _) => self.scroll_by(PAGE as isize),
            (Key::PageUp, _) => self.scroll_by(-(PAGE as isize)),
            (Key::Home | Key::Char('g'), _) => self.scroll_by(-(EVENTS_MAX as isize * 8)),
            (Key::End | Key::Char('G'), _) => self.scroll_by(EVENTS_MAX as isize * 8),
            _ => {}
        }
        None
    }

    fn show(&mut self, view: View) {
        self.view = view;
        self.scroll = 0;
        self.log.clear();
    }

    fn open_log(&mut self) -> Option<Wish> {
        let service = self.selected_service()?.to_owned();
        self.show(View::Log(service.clone()));
        Some(Wish::Log(service))
    }

    fn ask_restart(&mut self) {
        self.confirm = self.selected_service().filter(|_| self.gone.is_none()).map(str::to_owned);
    }

    fn select(&mut self, by: isize) {
        let last = self.now.rows.len().saturating_sub(1);
        self.selected = self.selected.saturating_add_signed(by).min(last);
    }

    /// Down is towards the end: of a log, where it is read from, that is scroll 0.
    fn scroll_by(&mut self, by: isize) {
        let from_end = !matches!(self.view, View::Image | View::Help);
        let most = match &self.view {
            View::Log(_) => self.log.len(),
            View::Events => self.events.len(),
            View::Image => super::image::lines(self).len(),
            View::Main | View::Help => 0,
        };
        let by = if from_end { by.saturating_neg() } else { by };
        self.scroll = self.scroll.saturating_add_signed(by).min(most.saturating_sub(1));
    }
}

/// A number in a status by its path: `bus.frames`. A list counts its elements.
pub fn number(status: &Value, path: &str) -> Option<f64> {
    match at(status, path)? {
        Value::Array(list) => Some(list.len() as f64),
        other => other.as_f64(),
    }
}

/// A text in a status by its path.
pub fn text<'a>(status: &'a Value, path: &str) -> Option<&'a str> {
    at(status, path)?.as_str()
}

/// A value in a status by its path.
pub fn at<'a>(status: &'a Value, path: &str) -> Option<&'a Value> {
    path.split('.').try_fold(status, |value, key| value.get(key))
}

#[cfg(test)]
mod tests {
    use super::super::tests::{row, snapshot};
    use super::*;

    fn model() -> Model {
        let mut model = Model::new("demo");
        model.take(snapshot(0));
        model
    }

    fn keys(model: &mut Model, keys: &[Key]) -> Vec<Wish> {
        keys.iter().filter_map(|key| model.key(*key)).collect()
    }

    #[test]
    fn a_restart_is_asked_for_twice() {
        let mut model = model();
        let down = Key::Down;
        assert_eq!(keys(&mut model, &[down, Key::Char('r'), Key::Char('n')]), []);
        assert_eq!(model.message.as_deref(), Some("can0 is not restarted"));
        let wishes = keys(&mut model, &[Key::Char('r'), Key::Char('y')]);
        assert_eq!(wishes, [Wish::Restart("can0".into())]);
        model.lose("gone".into());
        assert_eq!(keys(&mut model, &[Key::Char('r'), Key::Char('y')]), [], "nothing there to restart");
    }

    #[test]
    fn q_leaves_a_view_first_and_ctrl_c_always_ends() {
        let mut model = model();
        assert_eq!(keys(&mut model, &[Key::Char('e'), Key::Char('q')]), []);
        assert_eq!(model.view, View::Main);
        assert_eq!(keys(&mut model, &[Key::Char('q')]), [Wish::Quit]);
        assert_eq!(keys(&mut model, &[Key::Char('?'), Key::Interrupt]), [Wish::Quit]);
        assert_eq!(keys(&mut model, &[Key::Char('r'), Key::Interrupt]), [Wish::Quit]);
    }

    #[test]
    fn the_selected_service_stays_selected_when_rows_move() {
        let mut model = model();
        keys(&mut model, &[Key::Char('G')]);
        let last = model.selected_service().unwrap().to_owned();
        let mut next = snapshot(1);
        next.rows.insert(0, row("new", "can"));
        model.take(next);
        assert_eq!(model.selected_service(), Some(last.as_str()));
        let mut few = snapshot(2);
        few.rows.truncate(1);
        model.take(few);
        assert_eq!(model.selected, 0);
        model.take(Snapshot::default());
        assert_eq!(keys(&mut model, &[Key::Char('l'), Key::Char('r'), Key::Down, Key::Char('k')]), []);
    }

    #[test]
    fn rates_need_two_statuses_of_one_process() {
        let mut model = model();
        assert_eq!(model.rate("can0", "rx"), None);
        model.take(snapshot(0));
        assert_eq!(model.rate("can0", "rx"), None, "the same status again");
        model.take(snapshot(1));
        assert_eq!(model.rate("can0", "rx"), Some(2000.0));
        assert_eq!(model.rate("can0", "bus.client_drops"), Some(0.0));
        assert_eq!(model.rate("can0", "nothing"), None);
        let mut restarted = snapshot(2);
        for told in &mut restarted.told {
            told.generation += 1;
        }
        model.take(restarted);
        assert_eq!(model.rate("can0", "rx"), None);
    }

    #[test]
    fn scrolling_stays_within_what_is_there() {
        let mut model = model();
        assert_eq!(keys(&mut model, &[Key::Char('l')]), [Wish::Log("rec".into())]);
        let lines = (0..50).map(|n| LogLine { utc_ns: n, service: "rec".into(), line: n.to_string() });
        model.take_log("rec", lines.collect());
        model.take_log("other", Vec::new());
        keys(&mut model, &[Key::PageUp, Key::Up]);
        assert_eq!((model.log.len(), model.scroll), (50, 11));
        keys(&mut model, &[Key::Home]);
        assert_eq!(model.scroll, 49);
        keys(&mut model, &[Key::End]);
        assert_eq!(model.scroll, 0);
    }
}
