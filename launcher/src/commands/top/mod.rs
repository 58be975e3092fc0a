//! `dinrail top`: a running stack, live on the terminal.
//!
//! [`feed`] gathers, [`model`] decides, [`draw`] shows; this file is the loop and the terminal. Whatever happens,
//! the terminal is left as it was found: by the normal end, an error, a panic and a signal. [`guard`] sees to it that
//! nothing outlives its terminal.

mod draw;
pub mod feed;
mod guard;
mod image;
mod model;
mod sections;
#[cfg(test)]
pub mod tests;

use crate::supervise::client::{Client, find};
use crate::supervise::control::{Reply, Request};
use crate::supervise::state_dir::{self, RunningStack};
use anyhow::Context as _;
use feed::Feed;
use guard::Guard;
use ipc_types::reactor::signals;
use model::{Key, Model, View, Wish};
use ratatui::DefaultTerminal;
use ratatui::crossterm::event::{self, Event, KeyCode, KeyEvent, KeyEventKind, KeyModifiers};
use std::io::IsTerminal;
use std::mem::ManuallyDrop;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::{Duration, Instant};

/// The guard is asked at least this often.
const LOOK: Duration = Duration::from_millis(100);
/// Shortest and longest time between two refreshes.
const EVERY: (Duration, Duration) = (Duration::from_millis(100), Duration::from_mins(1));
/// The launcher answers a restart within 15 s.
const RESTART_LIMIT: Duration = Duration::from_secs(20);

/// Shows a stack until `q`, Ctrl-C, SIGTERM, SIGHUP or the end of the terminal.
pub fn run(stack: Option<&str>, every: Duration) -> anyhow::Result<()> {
    if !std::io::stdout().is_terminal() || !std::io::stdin().is_terminal() {
        anyhow::bail!("`dinrail top` needs a terminal; `dinrail status --json` tells a program the same");
    }
    if every < EVERY.0 || every > EVERY.1 {
        return Err(super::UsageError("--every takes 100ms to 60s".to_owned()).into());
    }
    // Before any thread exists: a signal must end the loop, not the process, or the terminal stays raw.
    let guard = Guard::start(signals::descriptor(&[libc::SIGTERM, libc::SIGINT, libc::SIGHUP])?)?;
    let stack = find(stack)?;
    let feed = Feed::open(&stack)?;
    let model = Model::new(&stack.stack);
    // Sets a panic hook that restores the terminal first.
    let terminal = ratatui::try_init().context("preparing the terminal")?;
    let (done, results) = channel();
    let terminal = ManuallyDrop::new(terminal);
    let mut screen = Screen { terminal, model, feed: Some(feed), stack, every, done, results };
    let ended = screen.work(&guard);
    let _ = screen.terminal.show_cursor();
    let restored = ratatui::try_restore().context("restoring the terminal");
    // What fails on a terminal that is gone is nobody's error.
    if guard.asked() || guard::is_gone() { Ok(()) } else { ended.and(restored) }
}

struct Screen {
    /// Its own end panics when neither the terminal nor stderr is there any more.
    terminal: ManuallyDrop<DefaultTerminal>,
    model: Model,
    /// `None` while the stack is down.
    feed: Option<Feed>,
    stack: RunningStack,
    every: Duration,
    /// How restarts went; they are asked for on threads, because the answer takes its time.
    done: Sender<String>,
    results: Receiver<String>,
}

impl Screen {
    fn work(&mut self, guard: &Guard) -> anyhow::Result<()> {
        let mut due = Instant::now();
        while !guard.asked() {
            let now = Instant::now();
            if now >= due {
                due = now + self.every;
                self.refresh();
            }
            while let Ok(message) = self.results.try_recv() {
                self.model.message = Some(message);
            }
            let model = &self.model;
            self.terminal.draw(|frame| draw::draw(model, frame))?;
            let wait = due.saturating_duration_since(Instant::now()).min(LOOK);
            // Not left to the reader of keys: on a terminal that is gone it never comes back.
            if !guard::wait_for_keys(wait) {
                return Ok(());
            }
            while event::poll(Duration::ZERO)? {
                if self.react(&event::read()?) {
                    return Ok(());
                }
            }
        }
        Ok(())
    }

    fn refresh(&mut self) {
        if self.feed.is_none() {
            // The same name: this process belongs to its rail for good.
            let again = state_dir::running().into_iter().find(|s| s.stack == self.stack.stack);
            let Some(again) = again else { return };
            match Feed::open(&again) {
                Ok(feed) => (self.feed, self.stack) = (Some(feed), again),
                Err(e) => return self.model.lose(format!("{e}; trying again")),
            }
        }
        let Some(feed) = &mut self.feed else { return };
        match feed.look() {
            // Another launcher in the place of the one that was joined: everything on the rail is new.
            Ok(snapshot) if snapshot.stack.as_ref().is_some_and(|s| s.pid != self.stack.pid) => {
                self.feed = None;
            }
            Ok(snapshot) => {
                self.model.take(snapshot);
                if let View::Log(service) = self.model.view.clone() {
                    self.fetch_log(&service);
                }
            }
            Err(_) => {
                self.feed = None;
                let text =
                    format!("stack '{}' is down; waiting for it to come back, q ends", self.stack.stack);
                self.model.lose(text);
            }
        }
    }

    fn fetch_log(&mut self, service: &str) {
        let Some(feed) = &mut self.feed else { return };
        // A launcher that is gone is noticed at the next refresh.
        if let Ok(lines) = feed.log(service) {
            self.model.take_log(service, lines);
        }
    }

    /// `true` when the screen shall end.
    fn react(&mut self, event: &Event) -> bool {
        let Event::Key(pressed) = event else { return false };
        let Some(key) = key_of(*pressed) else { return false };
        match self.model.key(key) {
            None => {}
            Some(Wish::Quit) => return true,
            Some(Wish::Log(service)) => self.fetch_log(&service),
            Some(Wish::Restart(service)) => self.restart(service),
        }
        false
    }

    fn restart(&self, service: String) {
        let (stack, done) = (self.stack.clone(), self.done.clone());
        let work = move || {
            let request = Request::Restart { service: service.clone() };
            let reply = Client::connect(stack).and_then(|mut c| c.call(&request, RESTART_LIMIT));
            let _ = done.send(match reply {
                Ok(Reply::Restarted { generation, after_ms, .. }) => {
                    format!("{service} is ready again after {after_ms} ms, generation {generation}")
                }
                Ok(_) => format!("{service}: the launcher gave another answer than asked for"),
                Err(e) => e.to_string(),
            });
        };
        if let Err(e) = std::thread::Builder::new().name("restart".into()).spawn(work) {
            let _ = self.done.send(format!("no thread could be started: {e}"));
        }
    }
}

fn key_of(pressed: KeyEvent) -> Option<Key> {
    if pressed.kind == KeyEventKind::Release {
        return None;
    }
    let control = pressed.modifiers.contains(KeyModifiers::CONTROL);
    Some(match pressed.code {
        KeyCode::Char('c') if control => Key::Interrupt,
        KeyCode::Char(_) if control => return None,
        KeyCode::Char(c) => Key::Char(c),
        KeyCode::Up => Key::Up,
        KeyCode::Down => Key::Down,
        KeyCode::PageUp => Key::PageUp,
        KeyCode::PageDown => Key::PageDown,
        KeyCode::Home => Key::Home,
        KeyCode::End => Key::End,
        KeyCode::Enter => Key::Enter,
        KeyCode::Esc => Key::Escape,
        _ => return None,
    })
}
