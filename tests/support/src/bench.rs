//! A folder with machine files and ESI files.

use std::ffi::OsStr;
use std::path::Path;
use std::process::{Command, Stdio};

use ecaxis_master::config::{self, Machine};

use crate::program::{Ran, ecaxis};
use crate::root;

/// A temporary folder with copies of the project's ESI files in `esi`.
#[derive(Debug)]
pub struct Bench {
    folder: tempfile::TempDir,
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

    /// Changes a file.
    #[track_caller]
    pub fn change(&self, name: &str, change: impl FnOnce(&str) -> String) {
        let text = self.read(name);
        let changed = change(&text);
        assert_ne!(changed, text, "{name}");
        self.write(name, &changed);
    }

    /// Parses a machine file in the folder.
    pub fn parse(&self, text: &str) -> Result<Machine, String> {
        config::parse(&self.path().join("machine.toml"), text).map_err(|error| error.to_string())
    }

    #[track_caller]
    pub fn machine(&self, text: &str) -> Machine {
        self.parse(text).unwrap_or_else(|error| panic!("{error}"))
    }

    /// Copies one of `configs` under another name.
    pub fn copy(&self, config: &str, name: &str) {
        let text = std::fs::read_to_string(root().join("configs").join(config));
        self.write(name, &text.expect("one of our files"));
    }

    /// Returns the command for a program in the folder.
    pub fn command(&self, program: impl AsRef<OsStr>) -> Command {
        let mut command = Command::new(program);
        command.current_dir(self.path()).stdin(Stdio::null());
        command.env("XDG_CACHE_HOME", self.path());
        command
    }

    #[track_caller]
    pub fn ecaxis(&self, arguments: &[&str]) -> Ran {
        Ran::new(self.command(ecaxis()).args(arguments))
    }

    /// Runs a command that must succeed and returns its output.
    #[track_caller]
    pub fn well(&self, arguments: &[&str]) -> String {
        self.ecaxis(arguments).exits(0).out
    }
}
