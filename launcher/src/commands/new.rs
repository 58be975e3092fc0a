//! `dinrail new --from STACK [DIR]`: a ready stack as a starting point of one's own.

use super::{print, table};
use crate::stackfile::suggestion;
use crate::stacks::{self, STACKS};
use std::path::{Path, PathBuf};

/// Writes the ready stack `from` into `dir`, by default a folder of its name. Refuses to overwrite.
pub fn run(from: &str, dir: Option<&Path>) -> anyhow::Result<()> {
    let Some(ready) = stacks::find(from) else {
        let help = suggestion(from, "ready stacks", STACKS.iter().map(|s| s.name)).replace('\n', " ");
        anyhow::bail!("there is no ready stack '{from}'; {help}");
    };
    let dir = dir.map_or_else(|| PathBuf::from(ready.name), Path::to_owned);
    ready.write_to(&dir)?;
    name_it(ready.name, &dir)?;
    for (name, _) in ready.files {
        print(&format!("{}\n", dir.join(name).display()));
    }
    let shown = dir.display();
    eprintln!("next: dinrail check {shown} && dinrail up {shown}");
    Ok(())
}

/// The copy gets its folder's name, so that it runs beside the one it came from.
fn name_it(from: &str, dir: &Path) -> anyhow::Result<()> {
    let Some(name) = dir.file_name().and_then(|n| n.to_str()).filter(|n| is_stack_name(n)) else {
        return Ok(());
    };
    let path = dir.join("stack.toml");
    let text = std::fs::read_to_string(&path)?;
    std::fs::write(&path, text.replacen(&format!("name = \"{from}\""), &format!("name = \"{name}\""), 1))?;
    Ok(())
}

fn is_stack_name(name: &str) -> bool {
    name.len() <= 32
        && name.starts_with(|c: char| c.is_ascii_lowercase())
        && name.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-' || c == '_')
}

/// The ready stacks as a table.
pub fn list() -> String {
    let rows: Vec<Vec<String>> = STACKS.iter().map(|s| vec![s.name.to_owned(), s.about.to_owned()]).collect();
    table(&["STACK", "WHAT IT IS"], &rows)
}
