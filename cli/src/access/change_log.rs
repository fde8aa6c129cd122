//! Enters a command line in the change log.

use ecaxis_master::change_log::ChangeLog;
use ecaxis_master::file_digest::UsedFile;
use serde_json::{Map, Value, json};

use crate::render::note;

/// Appends the command line of this process, and its outcome.
pub(crate) fn append(log: &ChangeLog, outcome: &str) {
    append_with(log, outcome, Map::new());
}

/// Appends the command line of this process, the file that it is about to write to a device, and
/// whose signature the file has.
pub(crate) fn append_file(log: &ChangeLog, file: &UsedFile) {
    let mut more = Map::new();
    more.insert("file".to_owned(), json!(file.path));
    more.insert("sha256".to_owned(), json!(file.sha256.to_string()));
    more.insert("signed_by".to_owned(), json!(file.signed_by));
    append_with(log, "begins", more);
}

fn append_with(log: &ChangeLog, outcome: &str, more: Map<String, Value>) {
    let words = std::env::args_os().skip(1);
    let words = words.map(|word| word.to_string_lossy().into_owned());
    let mut entry = Map::new();
    entry.insert("command".to_owned(), json!(without_secrets(words)));
    if let Ok(folder) = std::env::current_dir() {
        entry.insert("folder".to_owned(), json!(folder));
    }
    entry.extend(more);
    entry.insert("outcome".to_owned(), json!(outcome));
    if let Err(error) = log.append(entry) {
        let path = log.path().display();
        note(&format!("warning: the change log {path}: {error}"));
    }
}

/// Replaces the password of a firmware update.
fn without_secrets(words: impl Iterator<Item = String>) -> Vec<String> {
    let mut secret = false;
    let shown = words.map(|word| {
        let hidden = std::mem::replace(&mut secret, word == "--password");
        match word.split_once('=') {
            _ if hidden => "…".to_owned(),
            Some(("--password", _)) => "--password=…".to_owned(),
            _ => word,
        }
    });
    shown.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn passwords_are_not_logged() {
        let words = ["firmware", "--password", "0x12", "m.toml", "--password=3"];
        let shown = without_secrets(words.map(str::to_owned).into_iter());
        assert_eq!(
            shown,
            ["firmware", "--password", "…", "m.toml", "--password=…"]
        );
    }
}
