//! Commands without a stack, and what they printed.

use super::dinrail;
use std::path::Path;

/// Third column of candump lines.
pub fn frames(log: &str) -> Vec<String> {
    log.lines().map(|line| line.split_whitespace().nth(2).unwrap().to_owned()).collect()
}

/// A command without a stack that must succeed.
pub fn ok(args: &[&str]) -> String {
    let output = dinrail().args(args).output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "dinrail {args:?}: {:?} {said}", output.status);
    String::from_utf8(output.stdout).unwrap()
}

/// Exit code and what a command said on stderr.
pub fn refused(args: &[&str]) -> (i32, String) {
    let output = dinrail().args(args).output().unwrap();
    (output.status.code().unwrap(), String::from_utf8_lossy(&output.stderr).into_owned())
}

/// A path as an argument.
pub fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}
