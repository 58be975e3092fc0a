//! `dinrail build FILES -o OUT.wasm`: the compiler alone.

use super::sources::{Program, ProgramArgs};
use anyhow::Context as _;
use std::path::Path;

/// Compiles all files as one program. Errors and warnings go to stderr with their source lines.
pub fn run(args: &ProgramArgs, output: &Path, json: bool) -> anyhow::Result<()> {
    let compiled = Program::read(args)?.compile("nothing was written")?;
    let artifact = &compiled.artifact;
    std::fs::write(output, &artifact.wasm).with_context(|| format!("cannot write {}", output.display()))?;
    let (bytes, hash) = (artifact.wasm.len(), artifact.hash());
    if json {
        let file = output.display().to_string();
        let value = serde_json::json!({ "file": file, "bytes": bytes, "hash": format!("{hash:016x}") });
        super::println(&value.to_string());
    } else {
        super::println(&format!("{}: {bytes} bytes, program {hash:016x}", output.display()));
    }
    Ok(())
}
