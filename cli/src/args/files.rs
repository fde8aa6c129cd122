//! Output files. An existing file is overwritten only with `--force`, and an input never.

use std::ffi::OsString;
use std::fs::{self, File, OpenOptions};
use std::io::{self, ErrorKind, Write};
use std::os::unix::fs::{FileTypeExt, MetadataExt, PermissionsExt, chown};
use std::path::{Path, PathBuf};

use ecaxis_master::config::Machine;
use tempfile::NamedTempFile;

use crate::failure::{Failure, WRONG};

/// The maximum number of backups of a file.
const MAX_BACKUPS: u32 = 1000;

/// Creates a file that must not exist yet, completely or not at all. The file is synced to disk on
/// return.
pub(crate) fn write_new(path: &Path, bytes: &[u8]) -> Result<(), Failure> {
    let mut file = File::create_new(path).map_err(|error| match error.kind() {
        ErrorKind::AlreadyExists => already_exists(path),
        _ => unwritable(path, &error),
    })?;
    let written = file.write_all(bytes).and_then(|()| file.sync_all());
    if written.is_err() {
        let _ = fs::remove_file(path);
    }
    written.map_err(|error| unwritable(path, &error))?;
    sync_folder(path);
    Ok(())
}

/// Returns the failure for a file that cannot be written.
pub(crate) fn unwritable(path: &Path, error: &io::Error) -> Failure {
    // A temporary file adds its own path, which means nothing to the user.
    let cause = match error.get_ref() {
        Some(_) => error.kind().to_string(),
        None => error.to_string(),
    };
    let message = format!("cannot write {}: {cause}", path.display());
    Failure::new(WRONG, message).hint(WRITABLE)
}

const WRITABLE: &str = "name a file in a folder that exists and can be written";

pub(crate) fn already_exists(path: &Path) -> Failure {
    Failure::new(WRONG, format!("{} exists already", path.display()))
        .hint("existing files are not overwritten; name another file or remove that one")
}

/// Syncs the directory entry to disk if the file system supports it.
fn sync_folder(path: &Path) {
    let _ = File::open(folder(path)).and_then(|folder| folder.sync_all());
}

fn folder(path: &Path) -> &Path {
    match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    }
}

/// The files that a command reads, each with its description. No output replaces one of them.
#[derive(Debug, Default)]
pub(crate) struct Inputs(Vec<(PathBuf, &'static str)>);

impl Inputs {
    /// Returns the machine file, the ESI files that it names, and the tables: the other files.
    pub fn from_machine(machine: &Machine) -> Self {
        let esi = machine.devices.iter().map(|device| &device.esi_path);
        let others = machine.files.iter().map(|file| &file.path);
        Self::default()
            .with("the machine file", [&machine.path])
            .with("an ESI file of this machine", esi)
            .with("a set-point table of this machine", others)
    }

    pub fn with<P: Into<PathBuf>>(
        mut self,
        what: &'static str,
        files: impl IntoIterator<Item = P>,
    ) -> Self {
        self.0
            .extend(files.into_iter().map(|file| (file.into(), what)));
        self
    }
}

/// Fails if `target`, given with `option`, cannot be written, is one of the inputs, or has a
/// content and `force` is false.
pub(crate) fn check_output(
    option: &str,
    target: &Path,
    force: bool,
    inputs: &Inputs,
) -> Result<(), Failure> {
    let shown = target.display();
    let refuse =
        |what: String, hint: &str| Err(Failure::new(WRONG, format!("{option}: {what}")).hint(hint));
    for (input, what) in &inputs.0 {
        if same_file(input, target) {
            return refuse(format!("{shown} is {what}"), "name another file");
        }
    }
    let tried = match fs::metadata(target) {
        Ok(there) if there.is_dir() => {
            return refuse(format!("{shown} is a folder"), "name a file in it");
        }
        Ok(there) if there.file_type().is_block_device() => {
            return refuse(format!("{shown} is a disk"), "name a file");
        }
        Ok(there) if there.is_file() && there.len() > 0 && !force => {
            return refuse(
                format!("{shown} exists already"),
                "name another file, or overwrite it with `--force`",
            );
        }
        Ok(there) if there.is_file() => OpenOptions::new().write(true).open(target).map(drop),
        // Opening a pipe or a device could block, and it holds no data.
        Ok(_) => Ok(()),
        Err(e) if e.kind() == ErrorKind::NotFound => {
            tempfile::tempfile_in(folder(target)).map(drop)
        }
        Err(e) => Err(e),
    };
    tried.or_else(|e| refuse(format!("cannot write {shown}: {e}"), WRITABLE))
}

fn same_file(a: &Path, b: &Path) -> bool {
    match (fs::metadata(a), fs::metadata(b)) {
        (Ok(a), Ok(b)) => (a.dev(), a.ino()) == (b.dev(), b.ino()),
        _ => false,
    }
}

/// Replaces the text of a file atomically, or creates the file. Symlinks, owner and permissions are
/// kept.
pub(crate) fn replace(path: &Path, bytes: &[u8]) -> Result<(), Failure> {
    let target = fs::canonicalize(path)
        // A symlink to a file that does not exist yet.
        .or_else(|_| fs::read_link(path).map(|to| folder(path).join(to)))
        .unwrap_or_else(|_| path.to_owned());
    let replaced =
        sibling(&target, bytes).and_then(|new| new.persist(&target).map_err(|e| e.error));
    replaced.map_err(|e| unwritable(path, &e))?;
    sync_folder(&target);
    Ok(())
}

/// Copies a file to the first free of `FILE.old`, `FILE.old.1` … and returns that path.
pub(crate) fn back_up(path: &Path) -> Result<PathBuf, Failure> {
    let failed = |e: io::Error| unwritable(path, &e);
    let old = fs::read(path).map_err(failed)?;
    let mut copy = sibling(path, &old).map_err(failed)?;
    for n in 0..MAX_BACKUPS {
        let mut name = OsString::from(path);
        name.push(".old");
        if n > 0 {
            name.push(format!(".{n}"));
        }
        match copy.persist_noclobber(&name) {
            Ok(_) => return Ok(name.into()),
            Err(e) if e.error.kind() == ErrorKind::AlreadyExists => copy = e.file,
            Err(e) => return Err(failed(e.error)),
        }
    }
    Err(failed(io::Error::other("too many old files next to it")))
}

/// Writes a temporary file next to another, with its owner and permissions.
fn sibling(path: &Path, bytes: &[u8]) -> io::Result<NamedTempFile> {
    let mut file = tempfile::Builder::new()
        .permissions(fs::Permissions::from_mode(0o666))
        .tempfile_in(folder(path))?;
    file.write_all(bytes)?;
    if let Ok(there) = fs::metadata(path) {
        // Only root can change the owner; other users already own the file.
        let _ = chown(file.path(), Some(there.uid()), Some(there.gid()));
        file.as_file().set_permissions(there.permissions())?;
    }
    file.as_file().sync_all()?;
    Ok(file)
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use super::*;

    #[test]
    fn replace_keeps_symlink_mode_and_other_files() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        fs::create_dir(at("shared")).unwrap();
        fs::write(at("shared/real.toml"), "old").unwrap();
        fs::set_permissions(at("shared/real.toml"), fs::Permissions::from_mode(0o640)).unwrap();
        symlink("shared/real.toml", at("m.toml")).unwrap();
        fs::write(at("m.toml.old"), "another").unwrap();

        assert_eq!(back_up(&at("m.toml")), Ok(at("m.toml.old.1")));
        assert_eq!(replace(&at("m.toml"), b"new"), Ok(()));
        assert!(at("m.toml").is_symlink());
        let read = |name: &str| fs::read_to_string(at(name)).unwrap();
        let mode = |name: &str| fs::metadata(at(name)).unwrap().permissions().mode() & 0o777;
        for (name, text) in [("shared/real.toml", "new"), ("m.toml.old.1", "old")] {
            assert_eq!((read(name).as_str(), mode(name)), (text, 0o640), "{name}");
        }
        assert_eq!(read("m.toml.old"), "another");
        assert_eq!(replace(&at("o.toml"), b"first"), Ok(()));
        fs::write(at("like"), "").unwrap();
        assert_eq!(
            (read("o.toml").as_str(), mode("o.toml")),
            ("first", mode("like"))
        );
        let count = |folder: &str| fs::read_dir(at(folder)).unwrap().count();
        assert_eq!(
            (count("shared"), count("")),
            (1, 6),
            "no temporary file is left"
        );
        let failure = replace(&at("no/such/folder"), b"x").unwrap_err();
        assert!(failure.message.contains("cannot write"), "{failure:?}");
    }

    #[test]
    fn check_output_overwrites_only_with_force_and_no_input() {
        let folder = tempfile::tempdir().unwrap();
        let file = |name: &str, text: &str| {
            let path = folder.path().join(name);
            fs::write(&path, text).unwrap();
            path
        };
        let (full, empty) = (file("full", "dear diary"), file("empty", ""));
        let new = folder.path().join("new");
        let none = Inputs::default();
        let inputs = Inputs::default().with("what is read", [folder.path().join("full")]);
        for force in [false, true] {
            assert_eq!(check_output("--x", &full, force, &none).is_ok(), force);
            for free in [&empty, &new, Path::new("/dev/null")] {
                assert_eq!(check_output("--x", free, force, &none), Ok(()), "{free:?}");
            }
            let failure = check_output("--x", &full, force, &inputs).unwrap_err();
            assert!(failure.message.ends_with("is what is read"), "{failure:?}");
            let failure = check_output("--x", folder.path(), force, &none).unwrap_err();
            assert!(failure.message.ends_with("is a folder"), "{failure:?}");
        }
        assert!(!new.exists());
    }
}
