//! Which frames are shown: identifiers, masks, ranges, names, kinds.

use super::names::{Ids, Names};
use crate::commands::UsageError;
use crate::stackfile::suggestion;
use ipc_types::payload::{CanFrame, can_flag, id_flag};

#[derive(Debug, Clone, PartialEq, Eq)]
enum Test {
    /// `(id & mask) == value`, of frames with this length of identifier.
    Mask {
        value: u32,
        mask: u32,
        extended: bool,
    },
    Range {
        from: u32,
        to: u32,
        extended: bool,
    },
    /// Identifiers of each bus.
    Named(Ids),
    Error,
    Remote,
    Fd,
    Extended,
    Sent,
    Received,
}

/// All filters of a command.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Filter {
    any: Vec<Test>,
    none: Vec<Test>,
}

const KINDS: [(&str, Test); 6] = [
    ("#error", Test::Error),
    ("#rtr", Test::Remote),
    ("#fd", Test::Fd),
    ("#ext", Test::Extended),
    ("#tx", Test::Sent),
    ("#rx", Test::Received),
];

impl Filter {
    /// Reads the filters; names are those of the stack.
    pub fn parse(texts: &[String], names: &Names) -> Result<Self, UsageError> {
        let mut filter = Self::default();
        for text in texts {
            let (mut turned, body) = match text.strip_prefix('!') {
                Some(body) => (true, body),
                None => (false, text.as_str()),
            };
            let test = parse_one(body, names, &mut turned)?;
            if turned { &mut filter.none } else { &mut filter.any }.push(test);
        }
        Ok(filter)
    }

    /// Whether it asks who sent a frame.
    pub fn asks_direction(&self) -> bool {
        self.any.iter().chain(&self.none).any(|test| matches!(test, Test::Sent | Test::Received))
    }

    /// Whether a frame is shown.
    pub fn takes(&self, bus: &str, frame: &CanFrame) -> bool {
        let fits = |test: &Test| test.fits(bus, frame);
        (self.any.is_empty() || self.any.iter().any(fits)) && !self.none.iter().any(fits)
    }
}

impl Test {
    fn fits(&self, bus: &str, frame: &CanFrame) -> bool {
        let same = |extended: bool| !frame.is_error() && frame.is_extended() == extended;
        match self {
            Self::Mask { value, mask, extended } => same(*extended) && frame.id() & mask == value & mask,
            Self::Range { from, to, extended } => same(*extended) && (*from..=*to).contains(&frame.id()),
            Self::Named(ids) => {
                let id = frame.id() | (frame.can_id & id_flag::EFF);
                !frame.is_error() && ids.get(bus).is_some_and(|ids| ids.contains(&id))
            }
            Self::Error => frame.is_error(),
            Self::Remote => frame.is_remote() && !frame.is_error(),
            Self::Fd => frame.is_fd(),
            Self::Extended => frame.is_extended() && !frame.is_error(),
            Self::Sent => frame.flags & can_flag::TX_ECHO != 0,
            Self::Received => frame.flags & can_flag::TX_ECHO == 0,
        }
    }
}

fn parse_one(text: &str, names: &Names, turned: &mut bool) -> Result<Test, UsageError> {
    // A signal may be called `error`; `#error` never is, nor an identifier.
    if !text.starts_with('#') && identifier(text).is_none() {
        let signals = names.find_signal(text);
        if !signals.is_empty() {
            return Ok(Test::Named(signals));
        }
    }
    // Without the # as well: shells take it for a comment where it is not quoted.
    let kind = KINDS
        .iter()
        .find(|(name, _)| name.trim_start_matches('#').eq_ignore_ascii_case(text.trim_start_matches('#')));
    if let Some((_, test)) = kind {
        return Ok(test.clone());
    }
    if text.starts_with('#') {
        let hint = suggestion(text, "kinds of frames", KINDS.iter().map(|(name, _)| *name));
        return Err(UsageError(format!("filter '{text}': {hint}")));
    }
    let parts = |separator| text.split_once(separator).and_then(|(a, b)| Some((identifier(a)?, hex(b)?)));
    if let Some(((value, extended), mask)) = parts(':') {
        return Ok(Test::Mask { value, mask, extended });
    }
    if let Some(((value, extended), mask)) = parts('~') {
        *turned = !*turned;
        return Ok(Test::Mask { value, mask, extended });
    }
    if let Some((from, to)) = text.split_once('-')
        && let (Some((from, long)), Some((to, also))) = (identifier(from), identifier(to))
    {
        if long != also || from > to {
            return Err(UsageError(format!(
                "filter '{text}': a range goes from the lower to the higher identifier, both with 3 digits or both with 8"
            )));
        }
        return Ok(Test::Range { from, to, extended: long });
    }
    if let Some((value, extended)) = identifier(text) {
        return Ok(Test::Mask { value, mask: u32::MAX, extended });
    }
    let ids = names.find(text);
    if !ids.is_empty() {
        return Ok(Test::Named(ids));
    }
    Err(UsageError(format!(
        "filter '{text}' is neither an identifier (3 or 8 hex digits; 123:7F0, 123~7F0, 100-1FF) nor a kind (#error, #rtr, #fd, #ext, #tx, #rx) nor a name\n{}",
        names.unknown(text)
    )))
}

/// Three digits are 11 bits, eight are 29.
fn identifier(text: &str) -> Option<(u32, bool)> {
    let value = hex(text)?;
    match text.len() {
        3 if value <= id_flag::SFF_MASK => Some((value, false)),
        8 if value <= id_flag::EFF_MASK => Some((value, true)),
        _ => None,
    }
}

fn hex(text: &str) -> Option<u32> {
    let digits = (1..=8).contains(&text.len()) && text.bytes().all(|c| c.is_ascii_hexdigit());
    digits.then(|| u32::from_str_radix(text, 16).ok()).flatten()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names() -> Names {
        Names::of_table(&[
            ("can0", 0x1A0, "Speed"),
            ("can1", 0x8000_0001, "Level"),
            ("can0", 0x2B0, "Temperature"),
        ])
    }

    fn filter(texts: &[&str]) -> Result<Filter, UsageError> {
        Filter::parse(&texts.iter().map(ToString::to_string).collect::<Vec<_>>(), &names())
    }

    fn shown(texts: &[&str]) -> String {
        let filter = filter(texts).unwrap();
        let mut sent = CanFrame::classic(0x100, &[]);
        sent.flags = can_flag::TX_ECHO;
        let error = CanFrame { can_id: id_flag::ERR | 0x40, len: 8, ..CanFrame::default() };
        let remote = CanFrame { can_id: id_flag::RTR | 0x1AF, ..CanFrame::default() };
        let fd = CanFrame { can_id: 0x2B0, fd_flags: 4, ..CanFrame::default() };
        let frames = [
            ("s", CanFrame::classic(0x1A0, &[1])),
            ("r", remote),
            ("t", sent),
            ("e", error),
            ("f", fd),
            ("x", CanFrame { can_id: id_flag::EFF | 1, ..CanFrame::default() }),
        ];
        frames.iter().filter(|(_, f)| filter.takes("can0", f)).map(|(name, _)| *name).collect()
    }

    #[test]
    fn forms() {
        for (texts, expected) in [
            (&[][..], "srtefx"),
            (&["1A0"], "s"),
            (&["1A0:7F0"], "sr"),
            (&["1A0~7F0"], "tefx"),
            (&["!1A0~7F0"], "sr"),
            (&["100-1A0"], "st"),
            (&["00000001"], "x"),
            (&["00000000:1FFFFFF0"], "x"),
            (&["#error", "#fd"], "ef"),
            (&["#RTR"], "r"),
            (&["error", "!ext"], "e"),
            (&["#tx"], "t"),
            (&["#rx", "!#error"], "srfx"),
            (&["!#ext"], "srtef"),
            (&["Speed"], "s"),
            (&["!Speed", "!#error"], "rtfx"),
            // A name on another bus.
            (&["Level"], ""),
            (&["100-1FF", "!1A0"], "rt"),
        ] {
            assert_eq!(shown(texts), expected, "{texts:?}");
        }
    }

    #[test]
    fn mistakes_are_named() {
        let said: Vec<String> = ["Sped", "#eror", "1A00", "200-100", "100-00000200", "1A0:", ""]
            .iter()
            .map(|text| filter(&[text]).unwrap_err().to_string())
            .collect();
        insta::assert_snapshot!(said.join("\n"), @r#"
filter 'Sped' is neither an identifier (3 or 8 hex digits; 123:7F0, 123~7F0, 100-1FF) nor a kind (#error, #rtr, #fd, #ext, #tx, #rx) nor a name
did you mean 'Speed'?
names in this stack: Level, Speed, Temperature
filter '#eror': did you mean '#error'?
kinds of frames: #error, #rtr, #fd, #ext, #tx, #rx
filter '1A00' is neither an identifier (3 or 8 hex digits; 123:7F0, 123~7F0, 100-1FF) nor a kind (#error, #rtr, #fd, #ext, #tx, #rx) nor a name
names in this stack: Level, Speed, Temperature
filter '200-100': a range goes from the lower to the higher identifier, both with 3 digits or both with 8
filter '100-00000200': a range goes from the lower to the higher identifier, both with 3 digits or both with 8
filter '1A0:' is neither an identifier (3 or 8 hex digits; 123:7F0, 123~7F0, 100-1FF) nor a kind (#error, #rtr, #fd, #ext, #tx, #rx) nor a name
names in this stack: Level, Speed, Temperature
filter '' is neither an identifier (3 or 8 hex digits; 123:7F0, 123~7F0, 100-1FF) nor a kind (#error, #rtr, #fd, #ext, #tx, #rx) nor a name
names in this stack: Level, Speed, Temperature
"#);
        let none = Filter::parse(&["Speed".to_owned()], &Names::default()).unwrap_err().to_string();
        assert!(none.contains("nor a name\nthe stack gives no names to frames"), "{none}");
    }

    #[test]
    fn a_signal_may_have_the_name_of_a_kind() {
        let names = Names::of_table(&[("can0", 0x1A0, "Error"), ("can0", 0x123, "1A0")]);
        let test = |text: &str| Filter::parse(&[text.to_owned()], &names).unwrap();
        let speed = CanFrame::classic(0x1A0, &[]);
        assert!(test("error").takes("can0", &speed) && !test("#error").takes("can0", &speed));
        assert!(test("1A0").takes("can0", &speed));
        assert!(
            test("!#tx").asks_direction() && test("rx").asks_direction() && !test("error").asks_direction()
        );
    }
}
