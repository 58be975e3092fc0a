//! Mistakes of a stack file, as `check` and a refused start name them.

use ipc_types::Finding;

/// Something wrong in the service's table.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Mistake {
    /// Path of the key: `node[2].map[0].to`.
    pub key: String,
    pub message: String,
    /// What to do about it.
    pub help: String,
    /// The stack runs all the same.
    pub warning: bool,
}

impl Mistake {
    /// As `check` tells it of a service.
    pub fn finding(&self, service: &str) -> Finding {
        let make = if self.warning { Finding::warning } else { Finding::error };
        make(service, &self.key, &self.message, &self.help)
    }
}

/// Mistakes so far.
#[derive(Debug, Default)]
pub struct Mistakes(pub Vec<Mistake>);

impl Mistakes {
    pub fn add(&mut self, key: &str, message: impl Into<String>, help: impl Into<String>) {
        self.0.push(Mistake {
            key: key.to_owned(),
            message: message.into(),
            help: help.into(),
            warning: false,
        });
    }
    pub fn warn(&mut self, key: &str, message: impl Into<String>, help: impl Into<String>) {
        self.0.push(Mistake {
            key: key.to_owned(),
            message: message.into(),
            help: help.into(),
            warning: true,
        });
    }
}
