//! Programs for `build` and `trace`: files of their own, or those of a stack, with the symbols that a stack file makes.

use super::UsageError;
use crate::stackfile::{LoadError, load};
use crate::terminal::say_coloured;
use anyhow::Context as _;
use clap::Args;
use dinrail_iec::{Compiled, Source, compile};
use dinrail_plc::program;
use dinrail_plc::setup::Setup;
use std::io::IsTerminal;
use std::path::{Path, PathBuf};

/// Largest source file.
const SOURCE_MAX: u64 = 16 << 20;
/// What a program says that uses a name nobody declares: a variable, a VAR_EXTERNAL.
const UNKNOWN_NAMES: [&str; 2] = ["[E0302]", "[E0307]"];

/// Which program.
#[derive(Debug, Args)]
pub struct ProgramArgs {
    /// Source files; with --stack those of its program when left out
    #[arg(required_unless_present = "stack")]
    pub files: Vec<PathBuf>,
    /// Stack file, or a folder with a stack.toml: its symbols, sizes and addressing
    #[arg(long, value_name = "STACK")]
    pub stack: Option<PathBuf>,
    /// The plc service of that stack; not needed when it has only one
    #[arg(long, value_name = "NAME", requires = "stack")]
    pub service: Option<String>,
}

/// A program and what it is compiled for.
pub struct Program {
    pub sources: Vec<Source>,
    pub setup: Setup,
    /// Whether names of a stack are known.
    of_stack: bool,
}

impl Program {
    pub fn read(args: &ProgramArgs) -> anyhow::Result<Self> {
        if let Some(stack) =
            args.files.iter().find(|f| f.is_dir() || f.extension().is_some_and(|e| e == "toml"))
        {
            let shown = stack.display();
            return Err(
                UsageError(format!("{shown} is a stack, no source file: write --stack {shown}")).into()
            );
        }
        let Some(stack) = &args.stack else {
            return Ok(Self {
                sources: read_sources(Path::new(""), &args.files)?,
                setup: Setup::default(),
                of_stack: false,
            });
        };
        let (setup, dir) = setup_of(stack, args.service.as_deref())?;
        // Named as the stack names them, so that it is the same program.
        let (files, dir) = if args.files.is_empty() {
            (setup.files.iter().map(PathBuf::from).collect(), dir)
        } else {
            (args.files.clone(), PathBuf::new())
        };
        anyhow::ensure!(
            !files.is_empty(),
            "the plc of {} has no program: name source files",
            stack.display()
        );
        Ok(Self { sources: read_sources(&dir, &files)?, setup, of_stack: true })
    }

    /// Compiles; what is wrong goes to stderr with its source lines, and `none` is the error's text.
    pub fn compile(&self, none: &str) -> anyhow::Result<Compiled> {
        let color = std::io::stderr().is_terminal();
        match compile(&self.sources, &self.setup.options()) {
            Ok(compiled) => {
                let warnings = compiled.render_warnings(&self.sources, color);
                if !warnings.is_empty() {
                    say_coloured(warnings.trim_end());
                }
                Ok(compiled)
            }
            Err(diagnostics) => {
                let shown = diagnostics.render(color);
                say_coloured(shown.trim_end());
                anyhow::bail!("{none}{}", self.advice(&shown))
            }
        }
    }

    /// What to do about what the compiler has shown.
    pub fn advice(&self, shown: &str) -> &'static str {
        let unknown = UNKNOWN_NAMES.iter().any(|code| shown.contains(code));
        if unknown && !self.of_stack {
            "; if a name that is missing is a symbol of a stack file, give that with --stack STACK"
        } else {
            ""
        }
    }
}

/// What the programs of a stack's plc are compiled for, and the folder that its files are relative to.
fn setup_of(path: &Path, service: Option<&str>) -> anyhow::Result<(Setup, PathBuf)> {
    let stack = match load(path) {
        Ok(loaded) => loaded.stack,
        Err(LoadError { findings }) => {
            super::check::report(&findings);
            anyhow::bail!("{}: a stack with errors lends no symbols", path.display());
        }
    };
    let plcs: Vec<&str> =
        stack.services.iter().filter(|s| s.kind == "plc").map(|s| s.name.as_str()).collect();
    let plc = match (service, plcs.as_slice()) {
        (_, []) => anyhow::bail!("stack '{}' has no plc service", stack.name),
        (Some(name), list) if list.contains(&name) => name,
        (Some(name), list) => {
            anyhow::bail!("stack '{}' has no plc service '{name}'; it has {}", stack.name, list.join(", "))
        }
        (None, [only]) => only,
        (None, list) => {
            anyhow::bail!("several plc services: {}; say which one with --service NAME", list.join(", "))
        }
    };
    let config = stack.service(plc).map(|s| s.config.clone()).unwrap_or_default();
    let config: dinrail_plc::Config =
        serde_json::from_value(config).with_context(|| format!("configuration of service '{plc}'"))?;
    Ok((program::setup(&config, &stack, plc), stack.dir))
}

/// Reads files of a folder; they are named as given.
fn read_sources(dir: &Path, files: &[PathBuf]) -> anyhow::Result<Vec<Source>> {
    files.iter().map(|file| read_source(&dir.join(file), file.display().to_string())).collect()
}

fn read_source(file: &Path, name: String) -> anyhow::Result<Source> {
    let shown = file.display();
    let size = std::fs::metadata(file).with_context(|| format!("cannot read {shown}"))?.len();
    anyhow::ensure!(size <= SOURCE_MAX, "{shown} has {size} bytes; a source file has at most {SOURCE_MAX}");
    let bytes = std::fs::read(file).with_context(|| format!("cannot read {shown}"))?;
    let text = String::from_utf8(bytes).map_err(|e| {
        anyhow::anyhow!("{shown}: byte {} is no UTF-8; is this a source file?", e.utf8_error().valid_up_to())
    })?;
    Ok(Source { name, text })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stackfile::real_tests::{Folder, STACK};

    fn args(files: &[PathBuf], stack: Option<PathBuf>) -> ProgramArgs {
        ProgramArgs { files: files.to_vec(), stack, service: None }
    }

    #[test]
    fn symbols_of_a_stack_are_known_with_it_and_named_without() {
        let folder = Folder::new("sources");
        folder.load(STACK).unwrap();
        let file = folder.0.join("uses.st");
        std::fs::write(
            &file,
            "PROGRAM p\nVAR_EXTERNAL Speed : UINT; END_VAR\nCommand := Speed;\nEND_PROGRAM\n",
        )
        .unwrap();
        let stack = folder.0.join("stack.toml");
        std::fs::write(&stack, STACK).unwrap();
        let with = Program::read(&args(std::slice::from_ref(&file), Some(stack.clone()))).unwrap();
        with.compile("nothing").unwrap();
        let without = Program::read(&args(&[file], None)).unwrap();
        let said = without.compile("nothing was written").unwrap_err().to_string();
        assert!(said.ends_with("give that with --stack STACK"), "{said}");
        // Its own program.
        let own = Program::read(&args(&[], Some(stack.clone()))).unwrap();
        assert_eq!(own.sources[0].name, "main.st");
        let said = Program::read(&args(&[stack], None)).err().unwrap().to_string();
        assert!(said.contains("is a stack, no source file: write --stack "), "{said}");
    }
}
