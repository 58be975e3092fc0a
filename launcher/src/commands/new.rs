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
    for (name, _) in ready.files {
        print(&format!("{}\n", dir.join(name).display()));
    }
    let shown = dir.display();
    eprintln!("next: dinrail check {shown} && dinrail up {shown}");
    Ok(())
}

/// The ready stacks as a table.
pub fn list() -> String {
    let rows: Vec<Vec<String>> = STACKS.iter().map(|s| vec![s.name.to_owned(), s.about.to_owned()]).collect();
    table(&["STACK", "WHAT IT IS"], &rows)
}
