//! From files of the stack to an engine's program and setup.

use crate::config::Config;
use crate::engine::Program;
use crate::setup::{External, InputRange, Setup};
use dinrail_iec::{Addressing, Artifact, LocatedAddress, Source, compile};
use ipc_types::stack::Stack;
use ipc_types::wiring::ImageRange;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Largest source or module file.
const MAX_FILE_BYTES: u64 = 64 * 1024 * 1024;

/// Why there is no program.
#[derive(Debug, thiserror::Error)]
pub enum ProgramError {
    #[error("cannot read {path}: {source}")]
    Read { path: PathBuf, source: std::io::Error },
    #[error("{path} has more than 64 MiB: this is no program")]
    TooLong { path: PathBuf },
    #[error("{path} is no text (UTF-8): {source}")]
    Text { path: PathBuf, source: std::string::FromUtf8Error },
    #[error("{path}: {source}")]
    Artifact { path: PathBuf, source: dinrail_iec::ArtifactError },
    #[error("a compiled module stands alone: name one .wasm file, or only sources")]
    Mixed,
    #[error("the program does not compile:\n{0}")]
    Compile(String),
}

/// A program with the compiler's warnings as text.
#[derive(Debug, Clone)]
pub struct Compiled {
    pub program: Arc<Program>,
    pub warnings: Option<String>,
}

/// Reads and compiles; names in messages are the paths as given.
pub fn load(dir: &Path, files: &[PathBuf], setup: &Setup) -> Result<Compiled, ProgramError> {
    let is_module = |path: &PathBuf| path.extension().is_some_and(|e| e.eq_ignore_ascii_case("wasm"));
    if files.iter().any(is_module) {
        let [path] = files else { return Err(ProgramError::Mixed) };
        let wasm = read(&dir.join(path))?;
        let artifact = Artifact::from_wasm(&wasm)
            .map_err(|source| ProgramError::Artifact { path: path.clone(), source })?;
        return Ok(Compiled { program: Arc::new(Program { artifact, sources: Vec::new() }), warnings: None });
    }
    let mut sources = Vec::with_capacity(files.len());
    for path in files {
        let text = String::from_utf8(read(&dir.join(path))?)
            .map_err(|source| ProgramError::Text { path: path.clone(), source })?;
        sources.push(Source { name: path.display().to_string(), text });
    }
    compile_sources(sources, setup)
}

/// Compiles texts.
pub fn compile_sources(sources: Vec<Source>, setup: &Setup) -> Result<Compiled, ProgramError> {
    match compile(&sources, &setup.options()) {
        Ok(compiled) => {
            let warnings = (!compiled.warnings.is_empty()).then(|| compiled.render_warnings(&sources, false));
            Ok(Compiled { program: Arc::new(Program { artifact: compiled.artifact, sources }), warnings })
        }
        Err(diagnostics) => Err(ProgramError::Compile(diagnostics.render(false))),
    }
}

fn read(path: &Path) -> Result<Vec<u8>, ProgramError> {
    let error = |source| ProgramError::Read { path: path.to_owned(), source };
    let metadata = std::fs::metadata(path).map_err(error)?;
    // A pipe may never deliver and a device never end.
    if !metadata.is_file() {
        return Err(error(std::io::Error::new(std::io::ErrorKind::InvalidInput, "it is no file")));
    }
    if metadata.len() > MAX_FILE_BYTES {
        return Err(ProgramError::TooLong { path: path.to_owned() });
    }
    std::fs::read(path).map_err(error)
}

/// The setup of a service: its configuration and what its neighbours declare.
pub fn setup(config: &Config, stack: &Stack, me: &str) -> Setup {
    let mut setup = Setup {
        addressing: config.addressing,
        input_bytes: Config::area_bytes(config.input_bytes),
        output_bytes: Config::area_bytes(config.output_bytes),
        marker_bytes: Config::area_bytes(config.marker_bytes),
        routes: config.route.clone(),
        trigger: config.trigger.event().cloned(),
        cycle_ns: config.cycle.map(|c| c.ns()),
        debug: config.debug,
        real_to_int: config.real_to_int,
        mod_by_zero: config.mod_by_zero,
        files: config.program.iter().map(|p| p.display().to_string()).collect(),
        ..Setup::default()
    };
    for service in stack.services.iter().filter(|s| s.wiring.plc.as_deref() == Some(me)) {
        for range in &service.wiring.inputs {
            setup.inputs.push(InputRange {
                owner: service.name.clone(),
                label: range.label.clone(),
                byte: range.byte,
                bytes: range.bytes,
                bit: range.bit,
                on_bad: range.on_bad,
                status_byte: range.status_byte,
            });
        }
        for range in service.wiring.inputs.iter().chain(&service.wiring.outputs) {
            if let Ok(Some(external)) = external(range, &service.name, config.addressing) {
                setup.externals.push(external);
            }
        }
    }
    setup
}

/// The VAR_GLOBAL of a range with a `symbol`. The error is the reason why there can be none.
pub fn external(range: &ImageRange, owner: &str, addressing: Addressing) -> Result<Option<External>, String> {
    let Some(name) = &range.symbol else { return Ok(None) };
    let type_name = match (&range.type_name, range.bit, range.bytes) {
        (Some(name), _, _) => name.clone(),
        (None, Some(_), _) => "BOOL".to_owned(),
        (None, None, 1) => "USINT".to_owned(),
        (None, None, 2) => "UINT".to_owned(),
        (None, None, 4) => "UDINT".to_owned(),
        (None, None, 8) => "ULINT".to_owned(),
        (None, None, n) => {
            return Err(format!("{n} bytes are no elementary type, a symbol needs 1, 2, 4 or 8"));
        }
    };
    let address = address_text(range, addressing)?;
    let origin = format!("service '{owner}' {}", range.key);
    Ok(Some(External { name: name.clone(), address, type_name, origin }))
}

/// The `%`-address of a range in the service's way to count.
pub fn address_text(range: &ImageRange, addressing: Addressing) -> Result<String, String> {
    let (area, byte) = (range.area.letter(), range.byte);
    let at = LocatedAddress::new(area, byte, range.bit, range.bytes)
        .ok_or_else(|| format!("{} bytes at byte {byte} of %{area} have no %-address", range.bytes))?;
    at.text(addressing).ok_or_else(|| {
        let (letter, size) = (at.size.letter(), at.size.bytes());
        format!(
            "byte {byte} of %{area} cannot be named as %{area}{letter}: place it at a multiple of {size}, or set addressing = \"byte\" in the plc"
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_file_is_not_read() {
        // Reading would take all memory.
        let Err(error) = read(Path::new("/dev/zero")) else { panic!("a device is no program") };
        assert_eq!(error.to_string(), "cannot read /dev/zero: it is no file");
        assert!(matches!(read(Path::new("/")), Err(ProgramError::Read { .. })));
    }
}
