//! Failures as the user sees them: exit code, message, and what to do about it.

use std::path::Path;

use ecaxis::config::ConfigError;

use super::note;

/// The machine or the bus failed.
pub(crate) const FAILED: u8 = 1;
/// The file or the command line is wrong.
pub(crate) const WRONG: u8 = 2;

#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Failure {
    pub code: u8,
    /// Complete in itself; a list of problems is already laid out.
    pub message: String,
    pub hints: Vec<String>,
}

impl Failure {
    pub fn new(code: u8, message: impl Into<String>) -> Self {
        Self {
            code,
            message: message.into(),
            hints: Vec::new(),
        }
    }

    pub fn hint(mut self, hint: impl Into<String>) -> Self {
        self.hints.push(hint.into());
        self
    }

    pub fn print(&self) {
        let prefix = if self.message.starts_with("error: ") {
            ""
        } else {
            "error: "
        };
        note(&format!("{prefix}{}", self.message));
        for hint in &self.hints {
            note(&format!("  = help: {hint}"));
        }
    }
}

/// A machine file that is wrong.
pub(crate) fn config(path: &Path, error: &ConfigError) -> Failure {
    let failure = Failure::new(WRONG, error.to_string());
    match error {
        ConfigError::Io { .. } => failure.hint(machine_files(path)),
        ConfigError::Problems(problems) if problems.len() > 1 => {
            let message = format!(
                "{error}\n\n{} problems in {}",
                problems.len(),
                path.display()
            );
            Failure::new(WRONG, message)
        }
        ConfigError::Problems(_) => failure,
    }
}

/// Machine files that could have been meant.
fn machine_files(path: &Path) -> String {
    let nearby = [
        path.parent().unwrap_or(Path::new("")),
        Path::new("."),
        Path::new("configs"),
    ];
    for folder in nearby {
        let folder = if folder.as_os_str().is_empty() {
            Path::new(".")
        } else {
            folder
        };
        let Ok(entries) = std::fs::read_dir(folder) else {
            continue;
        };
        let mut names: Vec<String> = entries
            .flatten()
            .map(|e| e.path())
            .filter(|p| p.extension().is_some_and(|e| e == "toml"))
            .filter(|p| std::fs::read_to_string(p).is_ok_and(|text| text.contains("[bus]")))
            .map(|p| p.strip_prefix("./").unwrap_or(&p).display().to_string())
            .collect();
        names.sort();
        names.truncate(10);
        if !names.is_empty() {
            return format!("machine files nearby: {}", names.join(", "));
        }
    }
    "name a machine file, such as configs/demo.toml".to_owned()
}
