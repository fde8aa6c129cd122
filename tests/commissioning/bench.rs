//! Runs the program in a folder with machine files and ESI files.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

pub fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// A temporary folder with copies of the project's ESI files in `esi`.
#[derive(Debug)]
pub struct Bench {
    folder: tempfile::TempDir,
}

/// The result of a command.
#[derive(Debug)]
pub struct Ran {
    pub code: i32,
    pub out: String,
    pub err: String,
}

impl Bench {
    pub fn new() -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let esi = folder.path().join("esi");
        std::fs::create_dir(&esi).expect("a folder");
        for entry in std::fs::read_dir(root().join("configs/esi")).expect("our ESI files") {
            let path = entry.expect("a file").path();
            std::fs::copy(&path, esi.join(path.file_name().expect("a name"))).expect("copied");
        }
        Self { folder }
    }

    pub fn path(&self) -> &Path {
        self.folder.path()
    }

    pub fn write(&self, name: &str, text: &str) {
        std::fs::write(self.path().join(name), text).expect("written");
    }

    pub fn read(&self, name: &str) -> String {
        std::fs::read_to_string(self.path().join(name)).expect("a text file")
    }

    /// Copies one of `configs` under another name.
    pub fn copy(&self, config: &str, name: &str) {
        let text = std::fs::read_to_string(root().join("configs").join(config));
        self.write(name, &text.expect("one of our files"));
    }

    pub fn command(&self, program: &str) -> Command {
        let mut command = Command::new(program);
        command
            .current_dir(self.path())
            .env("XDG_CACHE_HOME", self.path())
            .stdin(Stdio::null());
        command
    }

    pub fn ecaxis(&self, arguments: &[&str]) -> Ran {
        let mut command = self.command(env!("CARGO_BIN_EXE_ecaxis"));
        let output = command.args(arguments).output().expect("the binary runs");
        let text = |bytes: &[u8]| String::from_utf8(bytes.to_vec()).expect("UTF-8");
        Ran {
            code: output.status.code().expect("an exit code"),
            out: text(&output.stdout),
            err: text(&output.stderr),
        }
    }

    /// Runs a command that must succeed and returns its output.
    #[track_caller]
    pub fn well(&self, arguments: &[&str]) -> String {
        let ran = self.ecaxis(arguments);
        assert_eq!(ran.code, 0, "{arguments:?}: {}{}", ran.out, ran.err);
        ran.out
    }
}

/// Compares a text with its reviewed snapshot.
#[track_caller]
pub fn reviewed(name: &str, now: &str) {
    let kept = root().join(format!("tests/snapshots/scan/{name}"));
    if std::env::var_os("ECAXIS_UPDATE_SNAPSHOTS").is_some() {
        std::fs::create_dir_all(kept.parent().expect("a folder")).expect("written");
        std::fs::write(&kept, now).expect("written");
    }
    let expected = std::fs::read_to_string(&kept).unwrap_or_default();
    assert!(expected == now, "{} differs, now:\n{now}", kept.display());
}

/// Checks that every line fits a terminal.
#[track_caller]
pub fn fits(text: &str) {
    for line in text.lines() {
        assert!(line.chars().count() <= 80, "longer than 80: {line}");
        assert!(!line.contains(char::is_control), "{line:?}");
    }
}
