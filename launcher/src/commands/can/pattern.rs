//! Frames that nobody recorded: `dinrail can gen`. The same settings and seed make the same frames. Sans-I/O.

use super::args::GenArgs;
use crate::commands::UsageError;
use dinrail_can::protocol::frame::{EFF_MASK, FD_BRS, FD_ESI, FD_LENGTHS, Frame, SFF_MASK};

#[derive(Debug, Clone, PartialEq, Eq)]
enum Id {
    Fixed(u32),
    Counting(u32),
    Random,
}

#[derive(Debug, Clone, PartialEq, Eq)]
enum Length {
    Fixed(u8),
    Counting,
    Random,
}

#[derive(Debug, Clone, PartialEq, Eq)]
enum Data {
    Fixed(Vec<u8>),
    Counting,
    Random,
    Zero,
}

/// See the module.
#[derive(Debug, Clone)]
pub struct Pattern {
    id: Id,
    length: Length,
    data: Data,
    extended: bool,
    remote: bool,
    fd: Option<u8>,
    mix: bool,
    random: u64,
    count: u64,
}

impl Pattern {
    pub fn of(args: &GenArgs) -> Result<Self, UsageError> {
        let fd_flags = if args.brs { FD_BRS } else { 0 } | if args.esi { FD_ESI } else { 0 };
        let fd = (args.fd || fd_flags != 0).then_some(fd_flags);
        if fd.is_some() && args.rtr {
            return Err(UsageError(
                "CAN FD has no remote frames: leave out --rtr, --brs or --esi".to_owned(),
            ));
        }
        let (id, extended) = id(&args.id, args.extended, args.mix)?;
        let data = data(&args.data)?;
        let length = match (&data, args.len.as_str()) {
            (Data::Fixed(bytes), "random") => fixed_length(bytes.len(), fd.is_some())?,
            (_, "random") => Length::Random,
            (_, "inc") => Length::Counting,
            (_, text) => {
                let len = text.parse::<usize>().map_err(|_| {
                    UsageError(format!("--len '{text}' must be a number of bytes, `inc` or `random`"))
                })?;
                fixed_length(len, fd.is_some())?
            }
        };
        let random = args.seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) ^ 0xD1B5_4A32_D192_ED03;
        Ok(Self { id, length, data, extended, remote: args.rtr, fd, mix: args.mix, random, count: 0 })
    }

    /// splitmix64.
    fn random(&mut self) -> u64 {
        self.random = self.random.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.random;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// The next frame; there is always one.
    pub fn next_frame(&mut self) -> Frame {
        let n = self.count;
        self.count += 1;
        let (mut extended, mut remote, mut fd) = (self.extended, self.remote, self.fd);
        if self.mix {
            let dice = self.random();
            extended = dice & 1 == 1;
            fd = self.fd.filter(|_| dice & 2 == 2).map(|_| ((dice >> 2) % 4) as u8);
            remote = fd.is_none() && (dice >> 4).is_multiple_of(8);
        }
        let mask = if extended { EFF_MASK } else { SFF_MASK };
        let id = match self.id {
            Id::Fixed(id) => id & mask,
            Id::Counting(from) => (u64::from(from).wrapping_add(n) & u64::from(mask)) as u32,
            Id::Random => self.random() as u32 & mask,
        };
        let lengths = if fd.is_some() { &FD_LENGTHS[..] } else { &FD_LENGTHS[..9] };
        let len = match self.length {
            Length::Fixed(len) if fd.is_none() => len.min(8),
            Length::Fixed(len) => len,
            Length::Counting => lengths[(n % lengths.len() as u64) as usize],
            Length::Random => lengths[(self.random() % lengths.len() as u64) as usize],
        };
        let mut bytes = [0u8; 64];
        match &self.data {
            Data::Zero => {}
            Data::Fixed(fixed) => bytes[..fixed.len().min(64)].copy_from_slice(&fixed[..fixed.len().min(64)]),
            Data::Counting => bytes[..8].copy_from_slice(&n.to_le_bytes()),
            Data::Random => {
                for chunk in bytes.chunks_exact_mut(8) {
                    let word = self.random();
                    chunk.copy_from_slice(&word.to_le_bytes());
                }
            }
        }
        let data = &bytes[..usize::from(len)];
        let frame = match fd {
            Some(flags) => Frame::fd(id, extended, flags, data),
            None if remote => Frame::remote(id, extended, len),
            None => Frame::data(id, extended, data),
        };
        // Everything was brought into range above.
        frame.unwrap_or_default()
    }
}

fn fixed_length(len: usize, fd: bool) -> Result<Length, UsageError> {
    let fits = u8::try_from(len).ok().filter(|n| if fd { FD_LENGTHS.contains(n) } else { *n <= 8 });
    fits.map(Length::Fixed).ok_or_else(|| {
        UsageError(if fd {
            format!("{len} data bytes: CAN FD carries 0-8, 12, 16, 20, 24, 32, 48 or 64")
        } else {
            format!("{len} data bytes: a classic frame carries at most 8; --fd makes CAN FD frames")
        })
    })
}

fn id(text: &str, extended: bool, mix: bool) -> Result<(Id, bool), UsageError> {
    let number = |digits: &str| {
        let value =
            Some(digits).filter(|d| (1..=8).contains(&d.len()) && d.bytes().all(|c| c.is_ascii_hexdigit()));
        let value = value.and_then(|d| u32::from_str_radix(d, 16).ok()).filter(|v| *v <= EFF_MASK);
        let value = value.ok_or_else(|| {
            UsageError(format!(
                "--id '{text}' must be a hex identifier up to 1FFFFFFF, `inc`, `inc:100` or `random`"
            ))
        })?;
        if value > SFF_MASK && !extended && !mix && digits.len() < 8 {
            return Err(UsageError(format!(
                "--id {text} needs 29 bits: write it with 8 digits or give --extended"
            )));
        }
        Ok((value, extended || digits.len() == 8))
    };
    match text {
        "random" => Ok((Id::Random, extended)),
        "inc" => Ok((Id::Counting(0), extended)),
        _ => match text.strip_prefix("inc:") {
            Some(from) => number(from).map(|(from, extended)| (Id::Counting(from), extended)),
            None => number(text).map(|(id, extended)| (Id::Fixed(id), extended)),
        },
    }
}

fn data(text: &str) -> Result<Data, UsageError> {
    match text {
        "random" => return Ok(Data::Random),
        "inc" => return Ok(Data::Counting),
        "zero" => return Ok(Data::Zero),
        _ => {}
    }
    let bytes = text.as_bytes().chunks(2).map(|pair| {
        let pair = std::str::from_utf8(pair)
            .ok()
            .filter(|p| p.len() == 2 && p.bytes().all(|c| c.is_ascii_hexdigit()))?;
        u8::from_str_radix(pair, 16).ok()
    });
    bytes.collect::<Option<Vec<u8>>>().filter(|bytes| bytes.len() <= 64).map(Data::Fixed).ok_or_else(|| {
        UsageError(format!(
            "--data '{text}' must be pairs of hex digits, at most 64 bytes, `inc`, `random` or `zero`"
        ))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::{Cli, Command};
    use crate::commands::can::args::CanCommand;
    use clap::Parser;
    use dinrail_can::protocol::candump::format;

    fn pattern(args: &str) -> Result<Pattern, UsageError> {
        let words = ["dinrail", "can", "gen", "can0"].into_iter().chain(args.split_whitespace());
        let Command::Can(CanCommand::Gen(args)) = Cli::try_parse_from(words).unwrap().command else {
            panic!()
        };
        Pattern::of(&args)
    }

    fn first(args: &str, count: usize) -> String {
        let mut pattern = pattern(args).unwrap();
        (0..count).map(|_| format(&pattern.next_frame())).collect::<Vec<_>>().join(" ")
    }

    #[test]
    fn fixed_and_counting() {
        assert_eq!(first("--id 123 --data 1122", 2), "123#1122 123#1122");
        assert_eq!(first("--id inc:7FE --len 2 --data inc", 4), "7FE#0000 7FF#0100 000#0200 001#0300");
        assert_eq!(first("--id 00000123 --data zero --len inc", 3), "00000123# 00000123#00 00000123#0000");
        assert_eq!(first("--id 1 --extended --rtr --len 4", 1), "00000001#R4");
        assert_eq!(first("--id 1 --brs --len 12 --data AB", 1), "001##1AB0000000000000000000000");
        assert_eq!(first("--id 1 --len 3 --data 1122334455", 1), "001#112233");
    }

    #[test]
    fn the_same_seed_makes_the_same_frames() {
        assert_eq!(first("--mix --fd --seed 7", 100), first("--mix --fd --seed 7", 100));
        assert_ne!(first("--seed 7", 10), first("--seed 8", 10));
        let mut mixed = pattern("--mix --fd").unwrap();
        let frames: Vec<Frame> = (0..500).map(|_| mixed.next_frame()).collect();
        for frame in &frames {
            frame.validate().unwrap();
        }
        type Is = fn(&Frame) -> bool;
        let kinds: [Is; 6] = [
            |f| f.is_extended(),
            |f| !f.is_extended(),
            |f| f.is_remote(),
            |f| f.is_fd() && f.len == 64,
            |f| f.fd & FD_BRS != 0,
            |f| !f.is_fd() && !f.is_remote(),
        ];
        assert!(kinds.iter().all(|kind| frames.iter().filter(|f| kind(f)).count() > 5));
        let mut classic = pattern("--mix").unwrap();
        assert!((0..500).all(|_| !classic.next_frame().is_fd()));
    }

    #[test]
    fn mistakes_are_named() {
        let said: Vec<String> = [
            "--id 800",
            "--id xyz",
            "--id 20000000",
            "--len 9",
            "--len x",
            "--fd --len 9",
            "--data 1",
            "--data 11223344556677889900",
            "--brs --rtr",
        ]
        .iter()
        .map(|args| format!("{args}: {}", pattern(args).unwrap_err()))
        .collect();
        insta::assert_snapshot!(said.join("\n"), @r#"
--id 800: --id 800 needs 29 bits: write it with 8 digits or give --extended
--id xyz: --id 'xyz' must be a hex identifier up to 1FFFFFFF, `inc`, `inc:100` or `random`
--id 20000000: --id '20000000' must be a hex identifier up to 1FFFFFFF, `inc`, `inc:100` or `random`
--len 9: 9 data bytes: a classic frame carries at most 8; --fd makes CAN FD frames
--len x: --len 'x' must be a number of bytes, `inc` or `random`
--fd --len 9: 9 data bytes: CAN FD carries 0-8, 12, 16, 20, 24, 32, 48 or 64
--data 1: --data '1' must be pairs of hex digits, at most 64 bytes, `inc`, `random` or `zero`
--data 11223344556677889900: 10 data bytes: a classic frame carries at most 8; --fd makes CAN FD frames
--brs --rtr: CAN FD has no remote frames: leave out --rtr, --brs or --esi
"#);
    }
}
