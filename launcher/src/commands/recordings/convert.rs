//! Arguments and names shared by `recordings export` and `recordings import`.

use crate::commands::UsageError;
use crate::stackfile::nearest;
use clap::{Args, ValueEnum};
use dinrail_recorder::disk::{Lock, open_locked};
use std::fs::File;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

/// A format of CAN logs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum LogFormat {
    /// `candump -L`; can-utils, python-can, Wireshark, SavvyCAN read it
    Candump,
    /// Vector ASC; CANalyzer, CANoe, python-can, Busmaster read it
    Asc,
}

#[derive(Debug, Args)]
pub struct ExportArgs {
    /// Recording (MCAP); or a log, to convert it
    pub file: PathBuf,
    /// Default: by the ending of --output, else candump
    #[arg(long, value_enum)]
    pub format: Option<LogFormat>,
    /// Default: standard output
    #[arg(short, long, value_name = "FILE")]
    pub output: Option<PathBuf>,
    /// `T` or `R` behind each line of a candump log, as `candump -x` does, where the file tells who sent it
    #[arg(long)]
    pub direction: bool,
    /// Only this bus (`can0`) or topic (`can0/rx`)
    #[arg(long, visible_alias = "topic", value_name = "BUS", value_delimiter = ',')]
    pub bus: Vec<String>,
    /// Write over a file that is there
    #[arg(long)]
    pub force: bool,
}

#[derive(Debug, Args)]
pub struct ImportArgs {
    /// candump log or Vector ASC
    pub file: PathBuf,
    /// Recording to make
    #[arg(short, long, value_name = "FILE")]
    pub output: PathBuf,
    /// Name of the bus in the recording; of several LOGGED=NAME
    #[arg(long, value_name = "[LOGGED=]NAME", value_delimiter = ',')]
    pub bus: Vec<String>,
    /// Write over a file that is there
    #[arg(long)]
    pub force: bool,
}

/// The buses asked for, by name or topic, all of them known; `None` is all of them.
pub fn chosen(asked: &[String], there: &[String]) -> anyhow::Result<Option<Vec<String>>> {
    if asked.is_empty() {
        return Ok(None);
    }
    let mut buses = Vec::new();
    for name in asked {
        let bus = name.strip_suffix("/rx").unwrap_or(name);
        anyhow::ensure!(there.iter().any(|b| b == bus), unknown(bus, there));
        buses.push(bus.to_owned());
    }
    Ok(Some(buses))
}

fn unknown(bus: &str, there: &[String]) -> String {
    let near = nearest(bus, there.iter().map(String::as_str));
    let near = near.map(|near| format!(" (did you mean '{near}'?)")).unwrap_or_default();
    format!("no frame of '{bus}' in the file{near}; it has frames of {}", there.join(", "))
}

/// New names of buses, from `NAME` or `LOGGED=NAME`.
pub fn renamed(asked: &[String], there: &[String]) -> anyhow::Result<Vec<(String, String)>> {
    let mut names: Vec<(String, String)> = there.iter().map(|b| (b.clone(), b.clone())).collect();
    for text in asked {
        let (from, to) = match (text.split_once('='), there) {
            (Some((from, to)), _) => (from, to),
            (None, [only]) => (only.as_str(), text.as_str()),
            (None, _) => {
                let many = there.join(", ");
                return Err(UsageError(format!(
                    "--bus '{text}': the log has frames of {many}; write LOGGED={text}"
                ))
                .into());
            }
        };
        if to.is_empty() || !to.bytes().all(|c| c.is_ascii_alphanumeric() || matches!(c, b'_' | b'-')) {
            return Err(
                UsageError(format!("--bus '{text}': a bus has a name of letters, digits, _ and -")).into()
            );
        }
        let Some(entry) = names.iter_mut().find(|(logged, _)| logged == from) else {
            anyhow::bail!(unknown(from, there));
        };
        to.clone_into(&mut entry.1);
    }
    Ok(names)
}

/// Creates the output. What is there is written over only when asked for, and never the input, nor what is in use.
pub fn create(path: &Path, input: &Path, force: bool) -> anyhow::Result<File> {
    let cannot = |e: std::io::Error| match e.kind() {
        std::io::ErrorKind::AlreadyExists => {
            anyhow::anyhow!("{} is there already: name another output, or give --force", path.display())
        }
        _ => anyhow::anyhow!("cannot write {}: {e}", path.display()),
    };
    // The same file may have two names.
    let identity = |meta: std::fs::Metadata| (meta.dev(), meta.ino());
    let there = std::fs::metadata(path).ok().map(identity);
    let same = there.is_some() && there == std::fs::metadata(input).ok().map(identity);
    anyhow::ensure!(!same, "{} is the input itself: name another output", path.display());
    let mut options = File::options();
    options.read(true).write(true);
    if !force {
        return options.create_new(true).open(path).map_err(cannot);
    }
    let file = options.create(true).truncate(false).open(path).map_err(cannot)?;
    let in_use = matches!(open_locked(path), Ok((_, Lock::InUse)));
    anyhow::ensure!(
        !in_use,
        "{} is being written by a running recorder: name another output",
        path.display()
    );
    // Pipes and terminals have no length.
    if file.metadata().map_err(cannot)?.is_file() {
        file.set_len(0).map_err(cannot)?;
    }
    Ok(file)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn list(names: &[&str]) -> Vec<String> {
        names.iter().map(ToString::to_string).collect()
    }

    #[test]
    fn buses_by_name_and_topic() {
        let there = list(&["can0", "can1"]);
        assert_eq!(chosen(&[], &there).unwrap(), None);
        assert_eq!(chosen(&list(&["can1/rx"]), &there).unwrap(), Some(list(&["can1"])));
        let said = chosen(&list(&["cna1"]), &there).unwrap_err().to_string();
        assert_eq!(
            said,
            "no frame of 'cna1' in the file (did you mean 'can1'?); it has frames of can0, can1"
        );
    }

    #[test]
    fn new_names() {
        let names = |asked: &[&str], there: &[&str]| match renamed(&list(asked), &list(there)) {
            Ok(names) => names.iter().map(|(a, b)| format!("{a}>{b}")).collect::<Vec<_>>().join(" "),
            Err(e) => e.to_string(),
        };
        assert_eq!(names(&[], &["a", "b"]), "a>a b>b");
        assert_eq!(names(&["can0"], &["vcan0"]), "vcan0>can0");
        assert_eq!(names(&["b=can1"], &["a", "b"]), "a>a b>can1");
        assert_eq!(
            names(&["can0"], &["a", "b"]),
            "--bus 'can0': the log has frames of a, b; write LOGGED=can0"
        );
        assert_eq!(
            names(&["c=x"], &["a"]),
            "no frame of 'c' in the file (did you mean 'a'?); it has frames of a"
        );
        assert_eq!(names(&["a b"], &["a"]), "--bus 'a b': a bus has a name of letters, digits, _ and -");
    }

    #[test]
    fn the_input_and_a_file_in_use_are_never_written_over() {
        let dir = std::env::temp_dir().join(format!("dinrail-convert-{}", std::process::id()));
        std::fs::create_dir_all(&dir).unwrap();
        let (input, link, other) = (dir.join("in.log"), dir.join("link.log"), dir.join("other.mcap"));
        std::fs::write(&input, "in").unwrap();
        std::fs::hard_link(&input, &link).unwrap();
        std::fs::write(&other, "old").unwrap();
        for path in [&input, &link] {
            let said = create(path, &input, true).unwrap_err().to_string();
            assert!(said.contains("is the input itself"), "{said}");
        }
        assert!(create(&other, &input, false).unwrap_err().to_string().contains("give --force"));
        let (held, lock) = open_locked(&other).unwrap();
        assert!(matches!(lock, Lock::Taken));
        let said = create(&other, &input, true).unwrap_err().to_string();
        assert!(said.contains("is being written by a running recorder"), "{said}");
        assert_eq!(std::fs::read(&other).unwrap(), b"old");
        drop(held);
        create(&other, &input, true).unwrap();
        assert_eq!(std::fs::read(&other).unwrap(), b"");
        std::fs::remove_dir_all(&dir).unwrap();
    }
}
