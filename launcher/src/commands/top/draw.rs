//! The screen: a pure function of the model. What does not fit is left out by rank; nothing is ever drawn outside
//! of the frame, however small it is.

use super::model::{Model, View};
use super::{image, sections};
use crate::supervise::logbook;
use ipc_types::event::{EventBody, Level};
use ratatui::Frame;
use ratatui::layout::{Constraint, Layout, Rect};
use ratatui::style::{Color, Modifier, Style};
use ratatui::text::{Line, Span};
use ratatui::widgets::{Clear, Paragraph, Row, Table, TableState};

/// Below this nothing useful can be shown.
const COLUMNS_MIN: u16 = 20;
const ROWS_MIN: u16 = 3;
/// Rows of events on the main screen: at least, when there is room for less important things as well.
const EVENT_ROWS: u16 = 4;

/// A cell of a table.
#[derive(Debug, Clone, Default)]
pub struct Cell {
    pub text: String,
    pub mood: Mood,
}

/// How a value is to be taken; colours are only a second hint beside the words.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Mood {
    #[default]
    Plain,
    Good,
    Warning,
    Bad,
}

impl Mood {
    fn style(self) -> Style {
        match self {
            Self::Plain => Style::new(),
            Self::Good => Style::new().fg(Color::Green),
            Self::Warning => Style::new().fg(Color::Yellow),
            Self::Bad => Style::new().fg(Color::Red).add_modifier(Modifier::BOLD),
        }
    }
}

pub fn cell(text: impl Into<String>) -> Cell {
    Cell { text: text.into(), mood: Mood::Plain }
}

pub fn moody(text: impl Into<String>, mood: Mood) -> Cell {
    Cell { text: text.into(), mood }
}

/// A table of the main screen.
pub struct Section {
    /// Names of the columns; those that begin with a space are aligned to the right.
    pub head: Vec<&'static str>,
    pub rows: Vec<Vec<Cell>>,
}

/// Draws the whole screen.
pub fn draw(model: &Model, frame: &mut Frame<'_>) {
    let area = frame.area();
    if area.width < COLUMNS_MIN || area.height < ROWS_MIN {
        let text = format!("{} x {} is too small", area.width, area.height);
        return frame.render_widget(Paragraph::new(text), area);
    }
    let [title, body, foot] =
        Layout::vertical([Constraint::Length(1), Constraint::Min(1), Constraint::Length(1)]).areas(area);
    frame.render_widget(Paragraph::new(title_line(model)), title);
    match &model.view {
        View::Main => main_view(model, frame, body),
        View::Events => lines_from_end(event_lines(model), model.scroll, frame, body),
        View::Log(_) => lines_from_end(log_lines(model), model.scroll, frame, body),
        View::Image => lines_from_start(image::lines(model), model.scroll, frame, body),
        View::Help => frame.render_widget(Paragraph::new(HELP), body),
    }
    frame.render_widget(Paragraph::new(foot_line(model)), foot);
}

fn title_line(model: &Model) -> Line<'static> {
    let mut spans = vec![Span::styled(format!("stack {}", model.stack), Modifier::BOLD)];
    if let Some(stack) = &model.now.stack {
        let mood = match stack.state.as_str() {
            _ if model.gone.is_some() => Mood::Plain,
            "running" => Mood::Good,
            "failed" => Mood::Bad,
            _ => Mood::Warning,
        };
        if model.gone.is_none() {
            spans.push(Span::raw(" is "));
            spans.push(Span::styled(stack.state.clone(), mood.style()));
            let up = crate::commands::ps::uptime(stack.uptime_ms);
            spans.push(Span::raw(format!(", up {up}, {} of {} ready", stack.ready, stack.services)));
        }
        spans.push(Span::raw(format!(", {} UTC", &logbook::clock(model.now.utc_ns)[..8])));
    }
    if let View::Log(service) = &model.view {
        spans.push(Span::raw(format!(" | log of {service}")));
    }
    Line::from(spans)
}

fn foot_line(model: &Model) -> Line<'static> {
    if let Some(service) = &model.confirm {
        return Line::styled(format!("restart {service}? y/n"), Mood::Warning.style().reversed());
    }
    if let Some(why) = &model.gone {
        return Line::styled(why.clone(), Mood::Bad.style());
    }
    if let Some(message) = &model.message {
        return Line::styled(message.clone(), Modifier::BOLD);
    }
    let keys = match model.view {
        View::Main => "q quit  ? help  j/k select  r restart  l log  e events  i image",
        View::Help => "q back",
        _ => "q back  j/k scroll  g start  G end",
    };
    Line::styled(keys, Modifier::DIM)
}

const HELP: &str = " Up Down j k   select a service, or scroll
 r             restart the selected service (asks)
 l Enter       its log
 e             events
 i             process image: points and bytes
 PgUp PgDn     scroll by ten lines
 g G           to the start, to the end
 q Esc         back; q on the main screen ends
 Ctrl-C        end

 MiB is resident memory, CPU % is of one CPU. Rates are of
 the last second; - means that nothing is known yet.
 The same numbers for programs: dinrail status --json";

// --- the main screen --------------------------------------------------------------------------------------

fn main_view(model: &Model, frame: &mut Frame<'_>, area: Rect) {
    let services = sections::services(model);
    let filled = |all: Vec<Section>| all.into_iter().filter(|s| !s.rows.is_empty()).collect::<Vec<_>>();
    let mut others = filled(vec![
        sections::buses(model),
        sections::plcs(model),
        sections::recorders(model),
        sections::others(model),
    ]);
    let vital = others.len();
    others.extend(filled(vec![sections::clients(model), sections::points(model)]));
    let wants: Vec<u16> = others.iter().map(|s| s.rows.len() as u16 + 1).collect();
    let heights = share(
        area.height,
        services.rows.len() as u16 + 1,
        wants.split_at(vital),
        model.events.len() as u16 + 1,
    );
    let mut top = area.y;
    let mut place = |height: u16| {
        let part = Rect { x: area.x, y: top, width: area.width, height };
        top += height;
        part
    };
    let mut state = TableState::new().with_selected(Some(model.selected));
    let part = place(heights.services);
    frame.render_stateful_widget(table(&services, part, true), part, &mut state);
    for (section, height) in others.iter().zip(heights.others) {
        let part = place(height);
        if height > 0 {
            frame.render_widget(table(section, part, false), part);
        }
    }
    let part = place(heights.events);
    if part.height > 1 {
        let head = Line::styled("  EVENTS (UTC)", Modifier::BOLD);
        frame.render_widget(Paragraph::new(head), Rect { height: 1, ..part });
        let rest = Rect { y: part.y + 1, height: part.height - 1, ..part };
        lines_from_end(event_lines(model), 0, frame, rest);
    }
}

#[derive(Debug, PartialEq, Eq)]
struct Heights {
    services: u16,
    others: Vec<u16>,
    events: u16,
}

/// Who gets how many of the rows: services first, then the vital sections whole, then some events, then of every
/// other section its head and one row, then these what they want, and the events what is left.
fn share(total: u16, services: u16, (vital, rest): (&[u16], &[u16]), events: u16) -> Heights {
    let mut left = total;
    let mut take = |want: u16, least: u16| {
        let taken = if left < least { 0 } else { want.min(left) };
        left -= taken;
        taken
    };
    let services = take(services, 1);
    let mut others: Vec<u16> = vital.iter().map(|want| take(*want, 2)).collect();
    let mut events_get = take(events.clamp(2, EVENT_ROWS), 2);
    let mut more: Vec<u16> = rest.iter().map(|want| take((*want).min(2), 2)).collect();
    for (has, want) in more.iter_mut().zip(rest).filter(|(has, _)| **has > 0) {
        *has += take(want - *has, 0);
    }
    if events_get > 0 {
        events_get += take(events.saturating_sub(events_get), 0);
    }
    others.append(&mut more);
    Heights { services, others, events: events_get }
}

/// Columns as wide as their contents; those that do not fit are left out from the right, the last one gets the rest
/// of the line. A table that is cut says so in its head.
fn table(section: &Section, area: Rect, selectable: bool) -> Table<'static> {
    const MARK: usize = 2;
    const SPACE: usize = 2;
    const CUT_LEAST: usize = 8;
    let (total, fits) = (section.rows.len(), usize::from(area.height.saturating_sub(1)));
    let mut head: Vec<String> = section.head.iter().map(|h| h.trim().to_owned()).collect();
    if fits < total && !selectable {
        head[0] += &format!(" {fits}/{total}");
    }
    let width = |i: usize| {
        let cells = section.rows.iter().filter_map(|r| r.get(i)).map(|c| c.text.chars().count());
        cells.chain([head[i].chars().count()]).max().unwrap_or(0)
    };
    let mut widths: Vec<usize> = (0..head.len()).map(width).collect();
    let (mut start, mut columns) = (MARK, 0);
    for w in &widths {
        let room = usize::from(area.width).saturating_sub(start);
        // The last column is a file name or a sentence: its beginning is worth something.
        if *w > room && (columns + 1 < widths.len() || room < CUT_LEAST) {
            break;
        }
        columns += 1;
        start += w + SPACE;
    }
    let columns = columns.max(1);
    widths.truncate(columns);
    let pad = |i: usize, text: &str| {
        if section.head[i].starts_with(' ') { format!("{text:>w$}", w = widths[i]) } else { text.to_owned() }
    };
    let rows = section.rows.iter().map(|row| {
        let cells = row.iter().take(columns).enumerate();
        Row::new(cells.map(|(i, c)| Span::styled(pad(i, &c.text), c.mood.style())).collect::<Vec<_>>())
    });
    let head: Vec<String> = head.iter().take(columns).enumerate().map(|(i, h)| pad(i, h)).collect();
    let constraints: Vec<Constraint> = widths
        .iter()
        .enumerate()
        .map(|(i, w)| if i + 1 == columns { Constraint::Fill(1) } else { Constraint::Length(*w as u16) })
        .collect();
    let symbol = if selectable { "> " } else { "  " };
    Table::new(rows.collect::<Vec<_>>(), constraints)
        .header(Row::new(head).style(Modifier::BOLD))
        .column_spacing(SPACE as u16)
        .row_highlight_style(Modifier::REVERSED)
        .highlight_symbol(symbol)
        .highlight_spacing(ratatui::widgets::HighlightSpacing::Always)
}

// --- lists ------------------------------------------------------------------------------------------------

fn event_lines(model: &Model) -> Vec<Line<'static>> {
    if model.events.is_empty() {
        return vec![Line::raw("  none since this screen was opened")];
    }
    model.events.iter().map(event_line).collect()
}

fn event_line(event: &EventBody) -> Line<'static> {
    let (word, mood) = match event.level {
        Level::Info => ("info   ", Mood::Plain),
        Level::Warning => ("warning", Mood::Warning),
        Level::Fault => ("FAULT  ", Mood::Bad),
    };
    let time = logbook::clock(event.utc_ns);
    Line::from(vec![
        Span::raw(format!("  {time}  ")),
        Span::styled(word, mood.style()),
        Span::raw(format!("  {}: {}", event.service, printable(&event.message))),
    ])
}

fn log_lines(model: &Model) -> Vec<Line<'static>> {
    if model.log.is_empty() {
        return vec![Line::raw("  nothing logged yet")];
    }
    let line = |l: &crate::supervise::control::LogLine| {
        Line::raw(format!("{}  {}", logbook::clock(l.utc_ns), printable(&l.line)))
    };
    model.log.iter().map(line).collect()
}

/// Text that cannot steer the terminal.
pub fn printable(text: &str) -> String {
    text.chars()
        .map(|c| {
            if c == '\t' {
                ' '
            } else if c.is_control() {
                '\u{fffd}'
            } else {
                c
            }
        })
        .collect()
}

/// The last lines, less so many.
fn lines_from_end(mut lines: Vec<Line<'static>>, scroll: usize, frame: &mut Frame<'_>, area: Rect) {
    let height = usize::from(area.height);
    let end = lines.len().saturating_sub(scroll).max(height.min(lines.len()));
    lines.truncate(end);
    let shown = lines.split_off(end.saturating_sub(height));
    frame.render_widget(Clear, area);
    frame.render_widget(Paragraph::new(shown), area);
}

fn lines_from_start(lines: Vec<Line<'static>>, scroll: usize, frame: &mut Frame<'_>, area: Rect) {
    let first = scroll.min(lines.len().saturating_sub(usize::from(area.height)));
    let shown: Vec<_> = lines.into_iter().skip(first).collect();
    frame.render_widget(Paragraph::new(shown), area);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_are_shared_by_rank() {
        let heights =
            |services, others: &[u16], events| Heights { services, others: others.to_vec(), events };
        let vital: &[u16] = &[3, 2];
        assert_eq!(share(40, 6, (vital, &[5]), 3), heights(6, &[3, 2, 5], 3));
        assert_eq!(
            share(40, 6, (vital, &[5]), 1),
            heights(6, &[3, 2, 5], 2),
            "room to say that there is none"
        );
        assert_eq!(share(22, 6, (vital, &[9]), 50), heights(6, &[3, 2, 7], 4));
        assert_eq!(share(40, 6, (vital, &[9]), 50), heights(6, &[3, 2, 9], 20));
        assert_eq!(share(10, 6, (vital, &[9]), 50), heights(6, &[3, 0, 0], 0));
        assert_eq!(share(13, 6, (vital, &[9]), 50), heights(6, &[3, 2, 0], 2));
        assert_eq!(share(4, 6, (vital, &[9]), 50), heights(4, &[0, 0, 0], 0));
        for total in 0..60 {
            let h = share(total, 6, (&[2, 3], &[10, 2]), 7);
            assert!(h.services + h.others.iter().sum::<u16>() + h.events <= total);
        }
    }

    #[test]
    fn a_log_cannot_steer_the_terminal() {
        assert_eq!(printable("a\x1b[2J\tb"), "a\u{fffd}[2J b");
    }
}
