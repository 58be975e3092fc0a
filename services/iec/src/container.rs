//! Reading a deployed `.wasm` back: finds the debug map's custom section.
//!
//! Only the section frame is read here; whether the code in it is valid is for the engine's validator.

use crate::artifact::{ARTIFACT_VERSION, Artifact, DebugMap, MAP_SECTION};

/// Why a file is no artefact of this compiler.
#[derive(Debug, thiserror::Error)]
pub enum ArtifactError {
    #[error("not a WebAssembly module (it does not start with \\0asm, version 1)")]
    NotWasm,
    #[error("WebAssembly module is cut off or damaged at byte {at}")]
    Damaged { at: usize },
    #[error("WebAssembly module has no section `dinrail.map`: it was not made by dinrail's compiler")]
    NoMap,
    #[error("debug map is not readable: {0}")]
    BadMap(#[from] serde_json::Error),
    #[error(
        "artefact is of version {found}, this build reads version {ARTIFACT_VERSION}: compile the sources again"
    )]
    Version { found: u32 },
}

impl Artifact {
    /// The artefact in these bytes.
    pub fn from_wasm(wasm: &[u8]) -> Result<Self, ArtifactError> {
        if !wasm.starts_with(b"\0asm\x01\0\0\0") {
            return Err(ArtifactError::NotWasm);
        }
        let mut at = 8;
        while at < wasm.len() {
            let id = wasm[at];
            let (size, body) = leb(wasm, at + 1)?;
            let end =
                body.checked_add(size).filter(|e| *e <= wasm.len()).ok_or(ArtifactError::Damaged { at })?;
            if id == 0 {
                let (len, name) = leb(wasm, body)?;
                let name_end =
                    name.checked_add(len).filter(|e| *e <= end).ok_or(ArtifactError::Damaged { at })?;
                if wasm[name..name_end] == *MAP_SECTION.as_bytes() {
                    return Ok(Self { wasm: wasm.to_vec(), map: read_map(&wasm[name_end..end])? });
                }
            }
            at = end;
        }
        Err(ArtifactError::NoMap)
    }
}

fn read_map(json: &[u8]) -> Result<DebugMap, ArtifactError> {
    #[derive(serde::Deserialize)]
    struct Version {
        version: u32,
    }
    // The version first: a map of another version may lack fields.
    let found = serde_json::from_slice::<Version>(json)?.version;
    if found != ARTIFACT_VERSION {
        return Err(ArtifactError::Version { found });
    }
    Ok(serde_json::from_slice(json)?)
}

/// Unsigned LEB128 of at most 5 bytes: value and offset after it.
fn leb(bytes: &[u8], at: usize) -> Result<(usize, usize), ArtifactError> {
    let mut value: u64 = 0;
    for i in 0..5 {
        let b = *bytes.get(at + i).ok_or(ArtifactError::Damaged { at })?;
        value |= u64::from(b & 0x7f) << (7 * i);
        if b & 0x80 == 0 {
            return Ok((value as usize, at + i + 1));
        }
    }
    Err(ArtifactError::Damaged { at })
}
