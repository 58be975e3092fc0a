//! `dinrail recordings export`.

use super::convert::{ExportArgs, LogFormat, chosen, create};
use crate::commands::can::source::{Logged, Source, contents};
use crate::commands::{DATA_LOSS, UsageError, println};
use dinrail_can::protocol::{asc, candump};
use std::io::{BufWriter, Write};
use std::process::ExitCode;

/// Makes lines of frames.
enum Lines {
    /// Whether with the direction.
    Candump(bool),
    Asc(asc::Writer, Vec<(String, u16)>),
}

impl Lines {
    fn new(format: LogFormat, direction: bool, first_ns: u64, buses: &[String]) -> Self {
        match format {
            LogFormat::Candump => Self::Candump(direction),
            LogFormat::Asc => Self::Asc(asc::Writer::new(first_ns), channels(buses)),
        }
    }

    fn header(&self) -> String {
        match self {
            Self::Candump(_) => String::new(),
            Self::Asc(writer, channels) => {
                let names = channels.iter().map(|(bus, channel)| format!("// channel {channel} is {bus}\n"));
                writer.header() + &names.collect::<String>()
            }
        }
    }

    fn line(&self, logged: &Logged) -> String {
        match self {
            Self::Candump(direction) => {
                let column = match (direction & logged.directed, logged.tx) {
                    (false, _) => "\n",
                    (true, true) => " T\n",
                    (true, false) => " R\n",
                };
                candump::format_log_line(logged.t_ns, &logged.bus, &logged.frame) + column
            }
            Self::Asc(writer, channels) => {
                let channel = channels.iter().find(|(bus, _)| *bus == logged.bus).map_or(1, |(_, c)| *c);
                writer.line(logged.t_ns, channel, &logged.frame, logged.tx)
            }
        }
    }

    fn footer(&self) -> &'static str {
        match self {
            Self::Candump(_) => "",
            Self::Asc(writer, _) => writer.footer(),
        }
    }
}

/// The ASC channel of each bus: canN is channel N + 1 where all buses have such names, else in order.
fn channels(buses: &[String]) -> Vec<(String, u16)> {
    let numbered = |bus: &String| {
        let digits = bus.trim_start_matches(|c: char| !c.is_ascii_digit());
        digits.parse::<u16>().ok().filter(|n| *n < 255).map(|n| n + 1)
    };
    let numbers: Vec<Option<u16>> = buses.iter().map(numbered).collect();
    let distinct = numbers.iter().enumerate().all(|(i, n)| n.is_some() && !numbers[..i].contains(n));
    let number = |(i, n): (usize, &Option<u16>)| n.filter(|_| distinct).unwrap_or(i as u16 + 1);
    buses.iter().cloned().zip(numbers.iter().enumerate().map(number)).collect()
}

pub fn run(args: &ExportArgs, json: bool) -> anyhow::Result<ExitCode> {
    let contents = contents(&args.file)?;
    let wanted = chosen(&args.bus, &contents.order)?;
    let buses = wanted.unwrap_or_else(|| contents.order.clone());
    let by_ending = || {
        let asc =
            args.output.as_ref().and_then(|p| p.extension()).is_some_and(|e| e.eq_ignore_ascii_case("asc"));
        if asc { LogFormat::Asc } else { LogFormat::Candump }
    };
    let format = args.format.unwrap_or_else(by_ending);
    if args.direction && matches!(format, LogFormat::Asc) {
        return Err(
            UsageError("an ASC file always tells the direction: leave out --direction".to_owned()).into()
        );
    }
    let to_stdout = args.output.is_none();
    let out: Box<dyn Write> = match &args.output {
        Some(path) => Box::new(create(path, &args.file, args.force)?),
        None => Box::new(std::io::stdout().lock()),
    };
    let mut out = BufWriter::new(out);
    let mut source = Source::open(&args.file)?;
    let lines = Lines::new(format, args.direction, contents.first_ns, &buses);
    let written = write(&mut source, &lines, &buses, &mut out);
    let frames = match written {
        Ok(frames) => frames,
        // The reader has seen enough.
        Err(e) if to_stdout && is_broken_pipe(&e) => return Ok(ExitCode::SUCCESS),
        Err(e) => return Err(e),
    };
    if let Some(path) = &args.output {
        if json {
            println(
                &serde_json::json!({ "file": path.display().to_string(), "frames": frames, "buses": buses })
                    .to_string(),
            );
        } else {
            println(&format!("{}: {frames} frames of {}", path.display(), buses.join(", ")));
        }
    }
    if let Some(damage) = source.damage() {
        eprintln!("dinrail: {damage}");
        return Ok(ExitCode::from(DATA_LOSS));
    }
    Ok(ExitCode::SUCCESS)
}

fn is_broken_pipe(error: &anyhow::Error) -> bool {
    error.downcast_ref::<std::io::Error>().is_some_and(|e| e.kind() == std::io::ErrorKind::BrokenPipe)
}

fn write(source: &mut Source, lines: &Lines, buses: &[String], out: &mut impl Write) -> anyhow::Result<u64> {
    out.write_all(lines.header().as_bytes())?;
    let mut frames = 0;
    while let Some(logged) = source.next_frame()? {
        if buses.contains(&logged.bus) {
            out.write_all(lines.line(&logged).as_bytes())?;
            frames += 1;
        }
    }
    out.write_all(lines.footer().as_bytes())?;
    out.flush()?;
    Ok(frames)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn channels_of_buses() {
        let of = |names: &[&str]| {
            let buses: Vec<String> = names.iter().map(ToString::to_string).collect();
            channels(&buses).into_iter().map(|(_, c)| c).collect::<Vec<_>>()
        };
        assert_eq!(of(&["can1", "can0"]), [2, 1]);
        assert_eq!(of(&["vcan3"]), [4]);
        assert_eq!(of(&["can0", "vcan0"]), [1, 2]);
        assert_eq!(of(&["body", "can7"]), [1, 2]);
        assert_eq!(of(&["can65535"]), [1]);
    }
}
