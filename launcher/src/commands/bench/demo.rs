//! The conveyor stack under another name, on ports of its own: several benches need a stack of its size.

use super::stack::{BenchStack, Scratch, free_port, unique_name};
use crate::stacks;
use anyhow::Context as _;
use std::path::Path;
use toml::{Table, Value};

/// What is changed beside name and ports.
#[derive(Debug, Clone, Copy, Default)]
pub struct Changes {
    /// The log that feeds the bus is left out.
    pub quiet: bool,
    /// Any number of restarts, and each the first in a row: the policy's back-off is not what is measured.
    pub restarts: bool,
}

/// Starts it; does not wait.
pub fn spawn(parent: &Path, what: &str, changes: Changes) -> anyhow::Result<BenchStack> {
    let name = unique_name(what);
    let scratch = Scratch::new(parent, &name)?;
    stacks::find("conveyor").context("this build has no conveyor stack inside")?.write_to(scratch.path())?;
    let text = std::fs::read_to_string(scratch.path().join("stack.toml"))?;
    scratch.write("stack.toml", &change(&text, &name, changes)?)?;
    BenchStack::spawn(scratch, &name)
}

fn change(text: &str, name: &str, changes: Changes) -> anyhow::Result<String> {
    let mut doc: Table = toml::from_str(text)?;
    let shape = "the conveyor stack has another shape than the benches know";
    let head = doc.get_mut("stack").and_then(Value::as_table_mut).context(shape)?;
    head.insert("name".into(), name.into());
    let services = doc.get_mut("service").and_then(Value::as_array_mut).context(shape)?;
    for service in services.iter_mut().filter_map(Value::as_table_mut) {
        if let Some(tcp) = service.get_mut("tcp").and_then(Value::as_table_mut) {
            tcp.insert("port".into(), i64::from(free_port()?).into());
        }
        if let Some(serve) = service.get_mut("serve").and_then(Value::as_table_mut) {
            for (_, address) in serve.iter_mut() {
                *address = format!("127.0.0.1:{}", free_port()?).into();
            }
        }
        if changes.quiet {
            service.remove("feed");
        }
        if changes.restarts {
            let rule = Table::from_iter(
                [
                    ("max", Value::from(1000)),
                    ("within", Value::from("1s")),
                    ("backoff_first", Value::from("0ms")),
                    ("backoff_max", Value::from("0ms")),
                ]
                .map(|(k, v)| (k.to_owned(), v)),
            );
            service.insert("restart".into(), rule.into());
        }
    }
    Ok(toml::to_string(&doc)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_conveyor_stack_can_be_changed() {
        let demo = stacks::find("conveyor").unwrap();
        let (_, text) = demo.files.iter().find(|(name, _)| *name == "stack.toml").unwrap();
        let text = std::str::from_utf8(text).unwrap();
        let changed = change(text, "other", Changes { quiet: true, restarts: true }).unwrap();
        for gone in ["1502", "29536", "29537", "feed", "\"conveyor\""] {
            assert!(text.contains(gone) && !changed.contains(gone), "{gone}:\n{changed}");
        }
        let services = text.matches("[[service]]").count();
        assert_eq!(changed.matches("within = \"1s\"").count(), services);
        assert!(changed.contains("name = \"other\""));
        assert!(change(text, "other", Changes::default()).unwrap().contains("feed"));
    }
}
