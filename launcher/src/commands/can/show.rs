//! A frame as a line: for people, as a candump log, as JSON.

use super::names::Names;
use dinrail_can::protocol::candump;
use dinrail_can::protocol::error_frame::ErrorFrame;
use dinrail_recorder::utc::Utc;
use ipc_types::payload::{CanFrame, can_flag, fd_flag};
use std::fmt::Write as _;

use super::to_frame;

/// Colours as terminals know them; empty without.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Paint {
    pub dim: &'static str,
    pub red: &'static str,
    pub green: &'static str,
    pub cyan: &'static str,
    pub mark: &'static str,
    pub off: &'static str,
}

impl Paint {
    pub const PLAIN: Self = Self { dim: "", red: "", green: "", cyan: "", mark: "", off: "" };
    pub const COLOR: Self = Self {
        dim: "\x1b[2m",
        red: "\x1b[31m",
        green: "\x1b[32m",
        cyan: "\x1b[36m",
        mark: "\x1b[1;7m",
        off: "\x1b[0m",
    };

    /// By the option, the output and NO_COLOR (no-color.org: any value but an empty one).
    pub fn choose(option: super::args::Color, terminal: bool, no_color: Option<&std::ffi::OsStr>) -> Self {
        use super::args::Color;
        let wanted = match option {
            Color::Always => true,
            Color::Never => false,
            Color::Auto => terminal && no_color.is_none_or(std::ffi::OsStr::is_empty),
        };
        if wanted { Self::COLOR } else { Self::PLAIN }
    }
}

/// Which line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Form {
    Screen,
    /// `candump -L`.
    Log,
    Json,
}

/// Which time stands in front of a screen line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Time {
    /// UTC, time of day.
    Day,
    /// Seconds since 1970.
    Absolute,
    /// Since the frame before.
    Delta,
    /// Since the first frame.
    Start,
}

/// Makes lines.
pub struct Printer<'a> {
    pub form: Form,
    pub time: Time,
    pub ascii: bool,
    pub paint: Paint,
    pub names: Option<&'a Names>,
    /// Width of the column of buses; 0 leaves it out.
    pub bus_width: usize,
    /// Who sent it, in a log line.
    pub direction: bool,
    last_ns: Option<u64>,
}

impl<'a> Printer<'a> {
    pub fn new(
        form: Form,
        time: Time,
        ascii: bool,
        paint: Paint,
        names: Option<&'a Names>,
        bus_width: usize,
    ) -> Self {
        Self { form, time, ascii, paint, names, bus_width, direction: false, last_ns: None }
    }

    /// One line, without its end.
    pub fn line(&mut self, bus: &str, message: &CanFrame, utc_ns: u64) -> String {
        match self.form {
            Form::Screen => self.screen(bus, message, utc_ns),
            Form::Log => log_line(utc_ns, bus, message, self.direction),
            Form::Json => self.json(bus, message, utc_ns),
        }
    }

    fn screen(&mut self, bus: &str, message: &CanFrame, utc_ns: u64) -> String {
        let p = self.paint;
        let mut line = String::with_capacity(160);
        let _ = write!(line, "{}{}{}", p.dim, self.stamp(utc_ns), p.off);
        if self.bus_width > 0 {
            let _ = write!(line, "  {bus:<width$}", width = self.bus_width);
        }
        let sent = message.flags & can_flag::TX_ECHO != 0;
        let _ = write!(line, "  {}{}{}", p.cyan, if sent { "TX" } else { "  " }, p.off);
        let frame = to_frame(message);
        if let Some(error) = ErrorFrame::of(&frame) {
            let _ = write!(line, "  {}   ERROR  {}{}", p.red, error.words(), p.off);
            return line;
        }
        let _ = write!(line, "  {:>8}  [{:>2}]", id_text(message), message.len);
        let flags = flag_words(message);
        if !flags.is_empty() {
            let _ = write!(line, " {}{flags}{}", p.cyan, p.off);
        }
        let names = self.names.map(|n| n.text(bus, message)).unwrap_or_default();
        // Columns behind the data only where there is something behind it.
        let width = if names.is_empty() && !self.ascii { 0 } else { 23 };
        let data = spaced(message.payload());
        if !data.is_empty() || width > 0 {
            let _ = write!(line, "  {data:<width$}");
        }
        if self.ascii {
            let _ = write!(line, "  {}{:<8}{}", p.dim, ascii(message.payload()), p.off);
        }
        if !names.is_empty() {
            let _ = write!(line, "  {}{names}{}", p.green, p.off);
        }
        line.truncate(line.trim_end().len());
        line
    }

    fn stamp(&mut self, utc_ns: u64) -> String {
        let (seconds, us) = (utc_ns / 1_000_000_000, utc_ns / 1000 % 1_000_000);
        match self.time {
            Time::Absolute => format!("({seconds:010}.{us:06})"),
            Time::Delta => {
                let before = self.last_ns.replace(utc_ns).unwrap_or(utc_ns);
                let us = utc_ns.saturating_sub(before) / 1000;
                format!("(+{:>4}.{:06})", us / 1_000_000, us % 1_000_000)
            }
            Time::Start => {
                let us = utc_ns.saturating_sub(*self.last_ns.get_or_insert(utc_ns)) / 1000;
                format!("({:>6}.{:06})", us / 1_000_000, us % 1_000_000)
            }
            Time::Day => {
                let of_day = seconds % 86_400;
                format!("{:02}:{:02}:{:02}.{us:06}", of_day / 3600, of_day / 60 % 60, of_day % 60)
            }
        }
    }

    fn json(&self, bus: &str, message: &CanFrame, utc_ns: u64) -> String {
        let mut line = as_json(bus, message, self.names);
        line["seq"] = message.stamp.seq.into();
        line["utc_ns"] = utc_ns.into();
        line["utc"] = Utc::from_ns(utc_ns as i64).iso().into();
        line.to_string()
    }
}

/// `candump -L`, with `direction` as `candump -x` has it.
pub fn log_line(utc_ns: u64, bus: &str, message: &CanFrame, direction: bool) -> String {
    let line = candump::format_log_line(utc_ns, bus, &to_frame(message));
    match (direction, message.flags & can_flag::TX_ECHO != 0) {
        (false, _) => line,
        (true, true) => line + " T",
        (true, false) => line + " R",
    }
}

/// A frame in the one shape that all commands have.
pub fn as_json(bus: &str, message: &CanFrame, names: Option<&Names>) -> serde_json::Value {
    let frame = to_frame(message);
    let mut value = serde_json::json!({
        "bus": bus, "frame": candump::format(&frame), "id": message.id(), "id_text": id_text(message),
        "extended": message.is_extended(), "len": message.len, "data": hex(message.payload()),
        "echo": message.flags & can_flag::TX_ECHO != 0,
        "rtr": message.is_remote() && !message.is_error(), "fd": message.is_fd(),
        "brs": message.fd_flags & fd_flag::BRS != 0, "esi": message.fd_flags & fd_flag::ESI != 0,
        "names": names.map_or_else(|| serde_json::json!({}), |names| names.json(bus, message)),
    });
    if let Some(error) = ErrorFrame::of(&frame) {
        value["error"] = error.words().into();
    }
    value
}

/// `FD BRS ESI`, `RTR`.
pub fn flag_words(message: &CanFrame) -> String {
    let mut words = Vec::new();
    for (set, word) in [
        (message.is_remote(), "RTR"),
        (message.is_fd(), "FD"),
        (message.fd_flags & fd_flag::BRS != 0, "BRS"),
        (message.fd_flags & fd_flag::ESI != 0, "ESI"),
    ] {
        if set {
            words.push(word);
        }
    }
    words.join(" ")
}

/// Three digits for 11 bits, eight for 29.
pub fn id_text(message: &CanFrame) -> String {
    if message.is_extended() { format!("{:08X}", message.id()) } else { format!("{:03X}", message.id()) }
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::with_capacity(2 * bytes.len()), |mut text, b| {
        let _ = write!(text, "{b:02X}");
        text
    })
}

/// `DE AD BE EF`.
pub fn spaced(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02X}")).collect::<Vec<_>>().join(" ")
}

/// The data as text, a dot for what is none.
pub fn ascii(bytes: &[u8]) -> String {
    bytes.iter().map(|&b| if (0x20..0x7F).contains(&b) { b as char } else { '.' }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::commands::can::args::Color;
    use crate::commands::can::from_frame;

    const UTC: u64 = 1_506_783_973_191_777_888;

    fn frames() -> Vec<CanFrame> {
        let texts =
            ["1A0#B004466F6F0D", "18FEF100#01", "123#R4", "123##3AABB", "7FF#", "20000040#0000000000000000"];
        let mut frames: Vec<CanFrame> =
            texts.iter().map(|t| from_frame(&candump::parse(t).unwrap())).collect();
        frames[1].flags = can_flag::TX_ECHO;
        frames
    }

    fn lines(form: Form, time: Time, ascii: bool, paint: Paint) -> String {
        let names = Names::of_table(&[("can0", 0x1A0, "Speed"), ("can0", 0x1A0, "Torque")]);
        let mut printer = Printer::new(form, time, ascii, paint, Some(&names), 5);
        let lines = frames()
            .iter()
            .enumerate()
            .map(|(i, f)| printer.line("can0", f, UTC + i as u64 * 1_500_000))
            .collect::<Vec<_>>();
        lines.join("\n")
    }

    #[test]
    fn for_people() {
        insta::assert_snapshot!(lines(Form::Screen, Time::Day, false, Paint::PLAIN), @r#"
15:06:13.191777  can0            1A0  [ 6]  B0 04 46 6F 6F 0D        Speed Torque
15:06:13.193277  can0   TX  18FEF100  [ 1]  01
15:06:13.194777  can0            123  [ 4] RTR
15:06:13.196277  can0            123  [ 2] FD BRS ESI  AA BB
15:06:13.197777  can0            7FF  [ 0]
15:06:13.199277  can0          ERROR  bus-off
"#);
        insta::assert_snapshot!(lines(Form::Screen, Time::Delta, true, Paint::PLAIN), @r#"
(+   0.000000)  can0            1A0  [ 6]  B0 04 46 6F 6F 0D        ..Foo.    Speed Torque
(+   0.001500)  can0   TX  18FEF100  [ 1]  01                       .
(+   0.001500)  can0            123  [ 4] RTR
(+   0.001500)  can0            123  [ 2] FD BRS ESI  AA BB                    ..
(+   0.001500)  can0            7FF  [ 0]
(+   0.001500)  can0          ERROR  bus-off
"#);
        insta::assert_snapshot!(lines(Form::Screen, Time::Start, false, Paint::PLAIN).lines().take(2).collect::<Vec<_>>().join("\n"), @r#"
(     0.000000)  can0            1A0  [ 6]  B0 04 46 6F 6F 0D        Speed Torque
(     0.001500)  can0   TX  18FEF100  [ 1]  01
"#);
        insta::assert_snapshot!(lines(Form::Screen, Time::Absolute, false, Paint::COLOR).replace('\x1b', "ESC"), @r#"
ESC[2m(1506783973.191777)ESC[0m  can0   ESC[36m  ESC[0m       1A0  [ 6]  B0 04 46 6F 6F 0D        ESC[32mSpeed TorqueESC[0m
ESC[2m(1506783973.193277)ESC[0m  can0   ESC[36mTXESC[0m  18FEF100  [ 1]  01
ESC[2m(1506783973.194777)ESC[0m  can0   ESC[36m  ESC[0m       123  [ 4] ESC[36mRTRESC[0m
ESC[2m(1506783973.196277)ESC[0m  can0   ESC[36m  ESC[0m       123  [ 2] ESC[36mFD BRS ESIESC[0m  AA BB
ESC[2m(1506783973.197777)ESC[0m  can0   ESC[36m  ESC[0m       7FF  [ 0]
ESC[2m(1506783973.199277)ESC[0m  can0   ESC[36m  ESC[0m  ESC[31m   ERROR  bus-offESC[0m
"#);
    }

    #[test]
    fn for_programs() {
        insta::assert_snapshot!(lines(Form::Log, Time::Day, true, Paint::COLOR), @r#"
(1506783973.191777) can0 1A0#B004466F6F0D
(1506783973.193277) can0 18FEF100#01
(1506783973.194777) can0 123#R4
(1506783973.196277) can0 123##3AABB
(1506783973.197777) can0 7FF#
(1506783973.199277) can0 20000040#0000000000000000
"#);
        insta::assert_snapshot!(lines(Form::Json, Time::Day, true, Paint::COLOR), @r#"
{"brs":false,"bus":"can0","data":"B004466F6F0D","echo":false,"esi":false,"extended":false,"fd":false,"frame":"1A0#B004466F6F0D","id":416,"id_text":"1A0","len":6,"names":{"Speed":null,"Torque":null},"rtr":false,"seq":0,"utc":"2017-09-30T15:06:13.191777Z","utc_ns":1506783973191777888}
{"brs":false,"bus":"can0","data":"01","echo":true,"esi":false,"extended":true,"fd":false,"frame":"18FEF100#01","id":419361024,"id_text":"18FEF100","len":1,"names":{},"rtr":false,"seq":0,"utc":"2017-09-30T15:06:13.193277Z","utc_ns":1506783973193277888}
{"brs":false,"bus":"can0","data":"","echo":false,"esi":false,"extended":false,"fd":false,"frame":"123#R4","id":291,"id_text":"123","len":4,"names":{},"rtr":true,"seq":0,"utc":"2017-09-30T15:06:13.194777Z","utc_ns":1506783973194777888}
{"brs":true,"bus":"can0","data":"AABB","echo":false,"esi":true,"extended":false,"fd":true,"frame":"123##3AABB","id":291,"id_text":"123","len":2,"names":{},"rtr":false,"seq":0,"utc":"2017-09-30T15:06:13.196277Z","utc_ns":1506783973196277888}
{"brs":false,"bus":"can0","data":"","echo":false,"esi":false,"extended":false,"fd":false,"frame":"7FF#","id":2047,"id_text":"7FF","len":0,"names":{},"rtr":false,"seq":0,"utc":"2017-09-30T15:06:13.197777Z","utc_ns":1506783973197777888}
{"brs":false,"bus":"can0","data":"0000000000000000","echo":false,"error":"bus-off","esi":false,"extended":false,"fd":false,"frame":"20000040#0000000000000000","id":64,"id_text":"040","len":8,"names":{},"rtr":false,"seq":0,"utc":"2017-09-30T15:06:13.199277Z","utc_ns":1506783973199277888}
"#);
    }

    #[test]
    fn who_sent_a_frame() {
        let frames = frames();
        assert_eq!(log_line(UTC, "can0", &frames[0], true), "(1506783973.191777) can0 1A0#B004466F6F0D R");
        assert_eq!(log_line(UTC, "can0", &frames[1], true), "(1506783973.191777) can0 18FEF100#01 T");
    }

    #[test]
    fn colours_are_asked_for() {
        let set = std::ffi::OsStr::new("1");
        let table = [
            (Color::Auto, true, None, true),
            (Color::Auto, false, None, false),
            (Color::Auto, true, Some(set), false),
            (Color::Auto, true, Some(std::ffi::OsStr::new("")), true),
            (Color::Always, false, Some(set), true),
            (Color::Never, true, None, false),
        ];
        for (option, terminal, no_color, colored) in table {
            assert_eq!(Paint::choose(option, terminal, no_color) == Paint::COLOR, colored, "{option:?}");
        }
    }
}
