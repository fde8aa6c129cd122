//! Output files. No function overwrites a file whose content could be lost.
//!
//! - [`write_new`]: creates a file that must not exist yet;
//! - [`may_replace`]: checks that a file is missing or is an earlier output of the same kind;
//! - [`replace`]: replaces a user's file and keeps a backup if required.

use std::ffi::OsString;
use std::fs::{self, File, OpenOptions};
use std::io::{self, ErrorKind, Read, Write};
use std::os::unix::fs::{FileTypeExt, MetadataExt, chown};
use std::path::{Path, PathBuf};

use crate::hints;
use crate::hints::Failure;
use crate::render::fault_report;

/// The maximum number of names tried for a file next to another.
const NAMES: u32 = 1000;

/// Creates a file that must not exist yet. The file is synced to disk on return.
pub(crate) fn write_new(path: &Path, bytes: &[u8]) -> Result<(), Failure> {
    create(path, bytes).map_err(|error| match error.kind() {
        ErrorKind::AlreadyExists => already_exists(path),
        _ => unwritable(path, &error),
    })
}

/// Returns the failure for a file that cannot be written.
pub(crate) fn unwritable(path: &Path, error: &io::Error) -> Failure {
    let message = format!("cannot write {}: {error}", path.display());
    Failure::new(hints::WRONG, message).hint(WRITABLE)
}

const WRITABLE: &str = "name a file in a folder that exists and can be written";

pub(crate) fn already_exists(path: &Path) -> Failure {
    Failure::new(hints::WRONG, format!("{} exists already", path.display()))
        .hint("existing files are not overwritten; name another file or remove that one")
}

/// Creates the file completely or not at all.
fn create(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut file = File::create_new(path)?;
    let written = file.write_all(bytes).and_then(|()| file.sync_all());
    if written.is_err() {
        let _ = fs::remove_file(path);
    }
    written?;
    sync_folder(path);
    Ok(())
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

/// The kind of an output file. Only files of the same kind may be overwritten.
#[derive(Debug)]
pub(crate) struct FileKind {
    /// How a file of this kind is recognized.
    sign: FileSignature,
    what: &'static str,
    pub instead: &'static str,
}

#[derive(Debug)]
enum FileSignature {
    /// Every file of this kind begins with these bytes.
    Begins(&'static [u8]),
    /// A predicate on the first [`EARLY`] bytes.
    Early(fn(&str) -> bool),
}

const EARLY: usize = 4096;

impl FileSignature {
    fn within(&self) -> usize {
        match self {
            Self::Begins(bytes) => bytes.len(),
            Self::Early(_) => EARLY,
        }
    }

    fn shows(&self, head: &[u8]) -> bool {
        match self {
            Self::Begins(bytes) => head == *bytes,
            Self::Early(shows) => shows(&String::from_utf8_lossy(head)),
        }
    }
}

/// A pcapng recording in either byte order.
pub(crate) const RECORDING: FileKind = FileKind {
    sign: FileSignature::Begins(&[0x0a, 0x0d, 0x0d, 0x0a]),
    what: "a recording (pcapng)",
    instead: "name a new file, or a recording to overwrite",
};
pub(crate) const PAGE: FileKind = FileKind {
    sign: FileSignature::Begins(b"<!DOCTYPE html>"),
    what: "a report (HTML)",
    instead: "name a new file, or a report to overwrite",
};
pub(crate) const FIGURES: FileKind = FileKind {
    sign: FileSignature::Begins(b"{"),
    what: "a file of figures (JSON)",
    instead: "name a new file, or a file of figures to overwrite",
};

pub(crate) const STORY: FileKind = FileKind {
    sign: FileSignature::Early(fault_report::is_page),
    what: "a fault report",
    instead: "name a new file, or a fault report to overwrite",
};
/// The JSON data next to [`STORY`].
pub(crate) const STORY_DATA: FileKind = FileKind {
    sign: FileSignature::Begins(br#"{"headline":"#),
    what: "the data of a fault report (JSON)",
    instead: "the data are written next to the page: name another page",
};

/// A trace as `crate::args::trace` writes it.
pub(crate) const TRACE: FileKind = FileKind {
    sign: FileSignature::Begins(b"time_ns,position,device,"),
    what: "a trace of `ecaxis sim` (CSV)",
    instead: "name a new file, or a trace to overwrite",
};

/// Fails if `target`, given with `option`, must not be overwritten. `inputs` are the files that are
/// read, each with its description.
pub(crate) fn may_replace<'p>(
    option: &str,
    target: &Path,
    kind: &FileKind,
    inputs: impl IntoIterator<Item = (&'p Path, &'p str)>,
) -> Result<(), Failure> {
    let shown = target.display();
    let refuse = |what: String| Failure::new(hints::WRONG, format!("{option}: {what}"));
    for (input, what) in inputs {
        if same_file(input, target) {
            return Err(refuse(format!("{shown} is {what}")).hint(kind.instead));
        }
    }
    match existing(target, kind) {
        Ok(TargetFile::Free) => Ok(()),
        Ok(TargetFile::Taken(what)) => Err(refuse(format!("{shown} {what}")).hint(kind.instead)),
        Err(e) => {
            let failure = refuse(format!("cannot write {shown}: {e}"));
            Err(failure.hint(WRITABLE))
        }
    }
}

fn same_file(a: &Path, b: &Path) -> bool {
    match (fs::metadata(a), fs::metadata(b)) {
        (Ok(a), Ok(b)) => (a.dev(), a.ino()) == (b.dev(), b.ino()),
        _ => false,
    }
}

#[derive(Debug)]
pub(crate) enum TargetFile {
    /// The target holds nothing that would be lost.
    Free,
    Taken(String),
}

/// Checks whether the target can be written and leaves it unchanged.
pub(crate) fn existing(target: &Path, kind: &FileKind) -> io::Result<TargetFile> {
    let taken = |what: &str| Ok(TargetFile::Taken(what.to_owned()));
    let file_type = match fs::metadata(target) {
        Ok(metadata) => metadata.file_type(),
        Err(e) if e.kind() == ErrorKind::NotFound => {
            drop(File::create(target)?);
            // Remove the created file, not a symlink that leads to it.
            fs::remove_file(fs::canonicalize(target)?)?;
            return Ok(TargetFile::Free);
        }
        Err(e) => return Err(e),
    };
    if file_type.is_dir() {
        return taken("is a folder");
    }
    if file_type.is_block_device() {
        return taken("is a disk");
    }
    // Opening a pipe or a device could block, and it holds no data.
    if !file_type.is_file() {
        return Ok(TargetFile::Free);
    }
    let file = OpenOptions::new().read(true).write(true).open(target)?;
    let most = u64::try_from(kind.sign.within()).unwrap_or(u64::MAX);
    let mut head = Vec::new();
    file.take(most).read_to_end(&mut head)?;
    if head.is_empty() || kind.sign.shows(&head) {
        return Ok(TargetFile::Free);
    }
    taken(&format!("exists and is not {}", kind.what))
}

/// What happens to the replaced text.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum BackupPolicy {
    Kept,
    Lost,
}

/// Replaces the text of a file atomically, or creates the file. Symlinks and permissions are kept.
/// Returns the path of the backup.
pub(crate) fn replace(
    path: &Path,
    text: &str,
    old: BackupPolicy,
) -> Result<Option<PathBuf>, Failure> {
    let failed = |e: io::Error| unwritable(path, &e);
    let target = resolve_symlink(path).map_err(failed)?;
    let there = match fs::metadata(&target) {
        Ok(there) => Some(there),
        Err(e) if e.kind() == ErrorKind::NotFound => None,
        Err(e) => return Err(failed(e)),
    };
    let as_before = |sibling: &Path| -> io::Result<()> {
        let Some(there) = &there else { return Ok(()) };
        // Only root can change the owner; other users already own the file.
        let _ = chown(sibling, Some(there.uid()), Some(there.gid()));
        fs::set_permissions(sibling, there.permissions())
    };
    let kept = match (old, &there) {
        (BackupPolicy::Kept, Some(_)) => {
            let old = fs::read(&target).map_err(failed)?;
            let kept = write_sibling(path, &old, |n| match n {
                0 => ".old".to_owned(),
                n => format!(".old.{n}"),
            })
            .map_err(failed)?;
            as_before(&kept).map_err(failed)?;
            Some(kept)
        }
        _ => None,
    };
    let pid = std::process::id();
    let new =
        write_sibling(&target, text.as_bytes(), |n| format!(".{pid}.{n}.new")).map_err(failed)?;
    let moved = as_before(&new).and_then(|()| fs::rename(&new, &target));
    if moved.is_err() {
        let _ = fs::remove_file(&new);
    }
    moved.map_err(failed)?;
    sync_folder(&target);
    Ok(kept)
}

/// Writes a new file next to another, under the first free name.
fn write_sibling(path: &Path, bytes: &[u8], ending: impl Fn(u32) -> String) -> io::Result<PathBuf> {
    for n in 0..NAMES {
        let mut name = OsString::from(path);
        name.push(ending(n));
        match create(Path::new(&name), bytes) {
            Err(e) if e.kind() == ErrorKind::AlreadyExists => {}
            created => return created.map(|()| name.into()),
        }
    }
    Err(io::Error::other("too many old files next to it"))
}

/// Returns the target of a symlink; the target need not exist.
fn resolve_symlink(path: &Path) -> io::Result<PathBuf> {
    match fs::canonicalize(path) {
        Err(e) if e.kind() == ErrorKind::NotFound => Ok(match fs::read_link(path) {
            Ok(target) => folder(path).join(target),
            Err(_) => path.to_owned(),
        }),
        found => found,
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::{PermissionsExt, symlink};

    use super::*;

    fn names(folder: &Path) -> Vec<String> {
        let entries = fs::read_dir(folder).unwrap();
        let mut names: Vec<String> = entries
            .map(|e| e.unwrap().file_name().to_string_lossy().into_owned())
            .collect();
        names.sort();
        names
    }

    #[test]
    fn replace_keeps_symlink_mode_and_other_files() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        fs::create_dir(at("shared")).unwrap();
        fs::write(at("shared/real.toml"), "old").unwrap();
        fs::set_permissions(at("shared/real.toml"), fs::Permissions::from_mode(0o640)).unwrap();
        symlink("shared/real.toml", at("m.toml")).unwrap();
        fs::write(at("m.toml.new"), "a neighbour").unwrap();
        fs::write(at("m.toml.old"), "another").unwrap();

        let kept = replace(&at("m.toml"), "new", BackupPolicy::Kept).unwrap();
        assert_eq!(kept, Some(at("m.toml.old.1")));
        assert!(at("m.toml").is_symlink());
        let read = |name: &str| fs::read_to_string(at(name)).unwrap();
        let mode = |name: &str| fs::metadata(at(name)).unwrap().permissions().mode() & 0o777;
        assert_eq!(
            (read("m.toml"), mode("shared/real.toml")),
            ("new".into(), 0o640)
        );
        assert_eq!(
            (read("m.toml.old.1"), mode("m.toml.old.1")),
            ("old".into(), 0o640)
        );
        assert_eq!(read("m.toml.new"), "a neighbour");
        assert_eq!(read("m.toml.old"), "another");
        assert_eq!(names(&at("shared")), ["real.toml"]);

        assert_eq!(
            replace(&at("m.toml"), "newer", BackupPolicy::Lost),
            Ok(None)
        );
        assert_eq!(read("shared/real.toml"), "newer");
        // A dangling symlink to a file that does not exist.
        symlink("shared/more.toml", at("n.toml")).unwrap();
        for (name, real) in [("n.toml", "shared/more.toml"), ("o.toml", "o.toml")] {
            assert_eq!(replace(&at(name), "first", BackupPolicy::Kept), Ok(None));
            assert_eq!(read(real), "first");
        }
        assert!(at("n.toml").is_symlink());
        let here = ["m.toml", "m.toml.new", "m.toml.old", "m.toml.old.1"];
        assert_eq!(names(folder.path())[..4], here);
        assert_eq!(names(folder.path())[4..], ["n.toml", "o.toml", "shared"]);
        let failure = replace(&at("no/such/folder"), "x", BackupPolicy::Kept).unwrap_err();
        assert!(failure.message.contains("cannot write"), "{failure:?}");
    }

    #[test]
    fn may_replace_accepts_only_files_of_the_same_kind() {
        let folder = tempfile::tempdir().unwrap();
        let file = |name: &str, bytes: &[u8]| {
            let path = folder.path().join(name);
            fs::write(&path, bytes).unwrap();
            path
        };
        let page = file("page.html", b"<!DOCTYPE html>\n<html>");
        let figures = file("figures.json", b"{\n}");
        let recording = file("run.pcapng", b"\n\r\r\n and more");
        let story = file("story", b"`y` is gone\n\nThe run ended with: nothing\n");
        let data = file("story.json", b"{\"headline\":\"`y` is gone\"}");
        let notes = file("notes", b"dear\n\ndiary\n\nThe run ended with: rain");
        let new = folder.path().join("new");
        for (kind, own) in [
            (&PAGE, &page),
            (&FIGURES, &figures),
            (&RECORDING, &recording),
            (&STORY, &story),
            (&STORY_DATA, &data),
        ] {
            for target in [&page, &figures, &recording, &story, &notes, &new] {
                let done = may_replace("--x", target, kind, []);
                let free = target == own || *target == new;
                assert_eq!(done.is_ok(), free, "{kind:?}, {}", target.display());
                if let Err(failure) = done {
                    assert_eq!(failure.code, hints::WRONG);
                    assert!(failure.message.contains(kind.what), "{failure:?}");
                }
            }
            // An input must not be overwritten even if it has the right kind.
            let inputs = [(own.as_path(), "what is read")];
            let failure = may_replace("--x", own, kind, inputs).unwrap_err();
            assert!(failure.message.ends_with("is what is read"), "{failure:?}");
        }
        assert!(!new.exists());
    }
}
