//! `dinrail completion SHELL` and `dinrail man FOLDER`: what shells and `man` know of the commands.

use super::{print, println};
use crate::cli::Cli;
use anyhow::Context as _;
use clap::{CommandFactory, ValueEnum};
use clap_complete::aot;
use std::path::Path;

/// A shell that completes commands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Shell {
    Bash,
    Zsh,
    Fish,
}

impl Shell {
    fn script(self) -> String {
        let shell = match self {
            Self::Bash => aot::Shell::Bash,
            Self::Zsh => aot::Shell::Zsh,
            Self::Fish => aot::Shell::Fish,
        };
        let mut text = Vec::new();
        aot::generate(shell, &mut shown(Cli::command()), "dinrail", &mut text);
        String::from_utf8_lossy(&text).into_owned()
    }
}

/// The commands without those that only the launcher gives to itself.
fn shown(command: clap::Command) -> clap::Command {
    let inner: Vec<clap::Command> =
        command.get_subcommands().filter(|c| !c.is_hide_set()).cloned().map(shown).collect();
    // Names live as long as the process, which ends with this command.
    let name = |text: &str| -> &'static str { text.to_owned().leak() };
    let mut bare = clap::Command::new(name(command.get_name()))
        .args(command.get_arguments().cloned())
        .subcommands(inner);
    if let Some(about) = command.get_about() {
        bare = bare.about(about.clone());
    }
    if let Some(about) = command.get_long_about() {
        bare = bare.long_about(about.clone());
    }
    if let Some(version) = command.get_version() {
        bare = bare.version(name(version));
    }
    bare.subcommand_required(command.is_subcommand_required_set())
}

/// Prints the script of a shell.
pub fn completion(shell: Shell) {
    print(&shell.script());
}

/// Writes a page for every command.
pub fn man(folder: &Path) -> anyhow::Result<()> {
    let cannot = || format!("cannot write to {}", folder.display());
    std::fs::create_dir_all(folder).with_context(cannot)?;
    let command = shown(Cli::command()).propagate_version(true);
    clap_mangen::generate_to(command, folder).with_context(cannot)?;
    println(&format!("{0}: `man {0}/dinrail.1` shows the first page", folder.display()));
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_shell_gets_every_command_and_no_hidden_one() {
        for shell in [Shell::Bash, Shell::Zsh, Shell::Fish] {
            let script = shell.script();
            for word in ["recordings", "watch", "fastscan", "--stack"] {
                assert!(script.contains(word) || script.contains(&word[2..]), "{shell:?}: {word}");
            }
            assert!(!script.contains("__service") && !script.contains("__clean"), "{shell:?}");
        }
    }

    #[test]
    fn every_command_has_a_page() {
        let folder = std::env::temp_dir().join(format!("dinrail-man-{}", std::process::id()));
        man(&folder).unwrap();
        for page in ["dinrail.1", "dinrail-plc-watch.1", "dinrail-can-send.1"] {
            let text = std::fs::read_to_string(folder.join(page)).unwrap();
            assert!(text.contains(".SH") && !text.contains("__service"), "{page}");
        }
        std::fs::remove_dir_all(&folder).unwrap();
    }
}
