//! Whether anything that comes on a line is right: a wrong baud rate or parity shows as damaged frames and nothing else.

use crate::driver::Counters;

/// Damaged frames after which the line is doubted...
const MANY: u64 = 5;
/// ... when none was right for so long since the first of them.
const SPAN_NS: u64 = 10_000_000_000;
/// Damage is forgotten when none follows it for so long.
const FORGOTTEN_NS: u64 = 30_000_000_000;

/// What has changed.
#[derive(Debug, PartialEq, Eq)]
pub enum Verdict {
    /// Nothing is right, in words.
    Wrong(String),
    /// A frame was right again.
    Right,
}

#[derive(Debug, Clone, Copy)]
struct Damage {
    first_ns: u64,
    last_ns: u64,
    frames: u64,
    characters: u64,
}

/// See the module.
#[derive(Debug, Default)]
pub struct Doubt {
    seen: Counters,
    damage: Option<Damage>,
    told: bool,
}

impl Doubt {
    /// The port is open anew.
    pub fn reset(&mut self, counters: &Counters) {
        *self = Self { seen: *counters, ..Self::default() };
    }

    /// To be called about every second. `checked`: frames have a form (RTU, ASCII), so that a whole one is right;
    /// else characters without errors are.
    pub fn look(&mut self, counters: &Counters, checked: bool, now_ns: u64) -> Option<Verdict> {
        let before = std::mem::replace(&mut self.seen, *counters);
        let grown = |of: fn(&Counters) -> u64| of(counters).saturating_sub(of(&before));
        let characters = grown(|c| c.line.parity + c.line.framing);
        let right = grown(|c| c.rx.frames);
        let wrong = if checked { grown(|c| c.rx.crc_errors + c.rx.fragments) } else { characters.min(right) };
        if right > wrong || (checked && right > 0) {
            self.damage = None;
            return std::mem::take(&mut self.told).then_some(Verdict::Right);
        }
        if wrong > 0 || characters > 0 {
            let old = self.damage.filter(|d| now_ns.saturating_sub(d.last_ns) < FORGOTTEN_NS);
            let old = old.unwrap_or(Damage { first_ns: now_ns, last_ns: now_ns, frames: 0, characters: 0 });
            self.damage = Some(Damage {
                last_ns: now_ns,
                frames: old.frames + wrong,
                characters: old.characters + characters,
                ..old
            });
        }
        let damage = self.damage.filter(|d| !self.told && d.frames >= MANY)?;
        let span_ns = now_ns.saturating_sub(damage.first_ns);
        if span_ns < SPAN_NS {
            return None;
        }
        self.told = true;
        let characters = match damage.characters {
            0 => String::new(),
            n => format!(", {n} parity or framing errors"),
        };
        Some(Verdict::Wrong(format!(
            "{} damaged frames (wrong CRC or none at all{characters}) and none right in {} s: baud rate, parity, wiring?",
            damage.frames,
            span_ns / 1_000_000_000
        )))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: u64 = 1_000_000_000;

    fn add(counters: &mut Counters, right: u64, crc: u64, parity: u64) {
        counters.rx.frames += right;
        counters.rx.crc_errors += crc;
        counters.line.parity += parity;
    }

    #[test]
    fn a_line_with_nothing_right_is_told_once_and_when_it_comes_right() {
        let (mut doubt, mut counters) = (Doubt::default(), Counters::default());
        let mut said = Vec::new();
        for second in 0..30 {
            add(&mut counters, 0, 1, 2);
            said.extend(doubt.look(&counters, true, second * S).map(|v| (second, v)));
        }
        let words = "11 damaged frames (wrong CRC or none at all, 22 parity or framing errors) and none right in 10 s: baud rate, parity, wiring?";
        assert_eq!(said, [(10, Verdict::Wrong(words.to_owned()))]);
        add(&mut counters, 1, 3, 0);
        assert_eq!(doubt.look(&counters, true, 31 * S), Some(Verdict::Right));
        assert_eq!(doubt.look(&counters, true, 32 * S), None);
    }

    #[test]
    fn a_damaged_frame_now_and_then_is_no_reason() {
        let (mut doubt, mut counters) = (Doubt::default(), Counters::default());
        for second in 0..200 {
            // One in ten with right ones in between; then some at long intervals and nothing else.
            let right = u64::from(second < 100 && second % 10 != 0);
            add(&mut counters, right, u64::from(second % 40 == 0 || (second < 100 && right == 0)), 0);
            assert_eq!(doubt.look(&counters, true, second * S), None, "{second}");
        }
        // A port that was opened anew begins anew.
        for second in 200..209 {
            add(&mut counters, 0, 1, 0);
            assert_eq!(doubt.look(&counters, true, second * S), None);
        }
        doubt.reset(&counters);
        assert_eq!(doubt.look(&counters, true, 215 * S), None);
    }

    #[test]
    fn without_a_form_of_frames_the_characters_count() {
        let (mut doubt, mut counters) = (Doubt::default(), Counters::default());
        let verdicts: Vec<bool> = (0..12)
            .map(|second| {
                add(&mut counters, 1, 0, 3);
                doubt.look(&counters, false, second * S).is_some()
            })
            .collect();
        assert_eq!(verdicts.iter().filter(|v| **v).count(), 1);
        add(&mut counters, 1, 0, 0);
        assert_eq!(doubt.look(&counters, false, 13 * S), Some(Verdict::Right));
    }
}
