//! `dinrail build FILES -o OUT.wasm`: the compiler alone.

use anyhow::Context as _;
use dinrail_iec::{Options, Source, compile};
use std::io::IsTerminal;
use std::path::{Path, PathBuf};

/// Largest source file.
const SOURCE_MAX: u64 = 16 << 20;

/// Reads source files for the compiler; their names are as given.
pub fn read_sources(files: &[PathBuf]) -> anyhow::Result<Vec<Source>> {
    files.iter().map(|file| read_source(file)).collect()
}

fn read_source(file: &Path) -> anyhow::Result<Source> {
    let shown = file.display();
    let size = std::fs::metadata(file).with_context(|| format!("cannot read {shown}"))?.len();
    anyhow::ensure!(size <= SOURCE_MAX, "{shown} has {size} bytes; a source file has at most {SOURCE_MAX}");
    let bytes = std::fs::read(file).with_context(|| format!("cannot read {shown}"))?;
    let text = String::from_utf8(bytes).map_err(|e| {
        anyhow::anyhow!("{shown}: byte {} is no UTF-8; is this a source file?", e.utf8_error().valid_up_to())
    })?;
    Ok(Source { name: shown.to_string(), text })
}

/// Compiles all files as one program. Errors and warnings go to stderr with their source lines.
pub fn run(files: &[PathBuf], output: &Path, json: bool) -> anyhow::Result<()> {
    let sources = read_sources(files)?;
    let color = std::io::stderr().is_terminal();
    let compiled = match compile(&sources, &Options::default()) {
        Ok(compiled) => compiled,
        Err(diagnostics) => {
            eprintln!("{}", diagnostics.render(color));
            anyhow::bail!("nothing was written");
        }
    };
    let warnings = compiled.render_warnings(&sources, color);
    if !warnings.is_empty() {
        eprintln!("{warnings}");
    }
    let artifact = &compiled.artifact;
    std::fs::write(output, &artifact.wasm).with_context(|| format!("cannot write {}", output.display()))?;
    let (bytes, hash) = (artifact.wasm.len(), artifact.hash());
    if json {
        let value = serde_json::json!({ "file": output, "bytes": bytes, "hash": format!("{hash:016x}") });
        super::println(&value.to_string());
    } else {
        super::println(&format!("{}: {bytes} bytes, program {hash:016x}", output.display()));
    }
    Ok(())
}
