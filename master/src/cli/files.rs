//! Files that verbs write: what was there before is not lost.
//!
//! - [`keep`]: a file that must not exist yet;
//! - [`may_replace`]: whether a file holds nothing but what is written anew every time;
//! - [`replace`]: somebody's file, with another text.

use std::ffi::OsString;
use std::fs::{self, File, OpenOptions};
use std::io::{self, ErrorKind, Read, Write};
use std::os::unix::fs::{FileTypeExt, MetadataExt, chown};
use std::path::{Path, PathBuf};

use super::{Failure, hints, story};

/// Names that are tried for a file beside another.
const NAMES: u32 = 1000;

/// A file that must not exist yet. It is on the disk when this returns.
pub(crate) fn keep(path: &Path, bytes: &[u8]) -> Result<(), Failure> {
    create(path, bytes).map_err(|error| match error.kind() {
        ErrorKind::AlreadyExists => in_the_way(path),
        _ => unwritable(path, &error),
    })
}

/// A file that was named and cannot be written.
pub(crate) fn unwritable(path: &Path, error: &io::Error) -> Failure {
    let message = format!("cannot write {}: {error}", path.display());
    Failure::new(hints::WRONG, message).hint(WRITABLE)
}

const WRITABLE: &str = "name a file in a folder that exists and can be written";

pub(crate) fn in_the_way(path: &Path) -> Failure {
    Failure::new(hints::WRONG, format!("{} exists already", path.display()))
        .hint("nothing is written over; name another file or remove that one")
}

/// All of it or nothing.
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

/// The name, too, is on the disk then, where the file system can tell.
fn sync_folder(path: &Path) {
    let _ = File::open(folder(path)).and_then(|folder| folder.sync_all());
}

fn folder(path: &Path) -> &Path {
    match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    }
}

/// What may be written over: a file of the kind that is written.
#[derive(Debug)]
pub(crate) struct Kind {
    /// What shows it.
    sign: Sign,
    what: &'static str,
    pub instead: &'static str,
}

#[derive(Debug)]
enum Sign {
    /// Every such file begins with it.
    Begins(&'static [u8]),
    /// By the first [`EARLY`] of its bytes.
    Early(fn(&str) -> bool),
}

const EARLY: usize = 4096;

impl Sign {
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

/// pcapng, in either byte order.
pub(crate) const RECORDING: Kind = Kind {
    sign: Sign::Begins(&[0x0a, 0x0d, 0x0d, 0x0a]),
    what: "a recording (pcapng)",
    instead: "name a new file, or a recording to write over",
};
pub(crate) const PAGE: Kind = Kind {
    sign: Sign::Begins(b"<!DOCTYPE html>"),
    what: "a report (HTML)",
    instead: "name a new file, or a report to write over",
};
pub(crate) const FIGURES: Kind = Kind {
    sign: Sign::Begins(b"{"),
    what: "a file of figures (JSON)",
    instead: "name a new file, or a file of figures to write over",
};

pub(crate) const STORY: Kind = Kind {
    sign: Sign::Early(story::is_page),
    what: "a fault story",
    instead: "name a new file, or a story to write over",
};
/// What is beside [`STORY`].
pub(crate) const STORY_DATA: Kind = Kind {
    sign: Sign::Begins(br#"{"headline":"#),
    what: "the data of a fault story (JSON)",
    instead: "the data go beside the page: name another page",
};

/// As [`super::trace`] writes it.
pub(crate) const TRACE: Kind = Kind {
    sign: Sign::Begins(b"time_ns,position,device,"),
    what: "a trace of `ecaxis sim` (CSV)",
    instead: "name a new file, or a trace to write over",
};

/// Whether `target`, which `option` names, may be written over; `inputs` are read, and what they are.
pub(crate) fn may_replace<'p>(
    option: &str,
    target: &Path,
    kind: &Kind,
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
        Ok(Existing::Free) => Ok(()),
        Ok(Existing::Taken(what)) => Err(refuse(format!("{shown} {what}")).hint(kind.instead)),
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
pub(crate) enum Existing {
    /// Nothing that would be lost.
    Free,
    Taken(String),
}

/// Tries what writing will do, and leaves everything as it was.
pub(crate) fn existing(target: &Path, kind: &Kind) -> io::Result<Existing> {
    let taken = |what: &str| Ok(Existing::Taken(what.to_owned()));
    let file_type = match fs::metadata(target) {
        Ok(metadata) => metadata.file_type(),
        Err(e) if e.kind() == ErrorKind::NotFound => {
            drop(File::create(target)?);
            // The file, not a link that leads to it.
            fs::remove_file(fs::canonicalize(target)?)?;
            return Ok(Existing::Free);
        }
        Err(e) => return Err(e),
    };
    if file_type.is_dir() {
        return taken("is a folder");
    }
    if file_type.is_block_device() {
        return taken("is a disk");
    }
    // A pipe into a program, a null device: opening it could block, and nothing is kept there.
    if !file_type.is_file() {
        return Ok(Existing::Free);
    }
    let file = OpenOptions::new().read(true).write(true).open(target)?;
    let most = u64::try_from(kind.sign.within()).unwrap_or(u64::MAX);
    let mut head = Vec::new();
    file.take(most).read_to_end(&mut head)?;
    if head.is_empty() || kind.sign.shows(&head) {
        return Ok(Existing::Free);
    }
    taken(&format!("exists and is not {}", kind.what))
}

/// What becomes of the text that is replaced.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Old {
    Kept,
    Lost,
}

/// Gives a file, or one that does not exist yet, another text: it has the old one or the new one at any time. A link still leads to
/// it, and it is as readable as before. Returns where the old text is kept.
pub(crate) fn replace(path: &Path, text: &str, old: Old) -> Result<Option<PathBuf>, Failure> {
    let failed = |e: io::Error| unwritable(path, &e);
    let target = led_to(path).map_err(failed)?;
    let there = match fs::metadata(&target) {
        Ok(there) => Some(there),
        Err(e) if e.kind() == ErrorKind::NotFound => None,
        Err(e) => return Err(failed(e)),
    };
    let as_before = |beside: &Path| -> io::Result<()> {
        let Some(there) = &there else { return Ok(()) };
        // Root alone can; everybody else has made the file their own.
        let _ = chown(beside, Some(there.uid()), Some(there.gid()));
        fs::set_permissions(beside, there.permissions())
    };
    let kept = match (old, &there) {
        (Old::Kept, Some(_)) => {
            let old = fs::read(&target).map_err(failed)?;
            let kept = beside(path, &old, |n| match n {
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
    let new = beside(&target, text.as_bytes(), |n| format!(".{pid}.{n}.new")).map_err(failed)?;
    let moved = as_before(&new).and_then(|()| fs::rename(&new, &target));
    if moved.is_err() {
        let _ = fs::remove_file(&new);
    }
    moved.map_err(failed)?;
    sync_folder(&target);
    Ok(kept)
}

/// A new file beside another, under the first free name.
fn beside(path: &Path, bytes: &[u8], ending: impl Fn(u32) -> String) -> io::Result<PathBuf> {
    for n in 0..NAMES {
        let mut name = OsString::from(path);
        name.push(ending(n));
        match create(Path::new(&name), bytes) {
            Err(e) if e.kind() == ErrorKind::AlreadyExists => {}
            created => return created.map(|()| name.into()),
        }
    }
    Err(io::Error::other("too many old files beside it"))
}

/// The file itself, where a link leads to it; it need not exist.
fn led_to(path: &Path) -> io::Result<PathBuf> {
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
    fn somebodys_file_keeps_its_place_its_mode_and_its_neighbours() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        fs::create_dir(at("shared")).unwrap();
        fs::write(at("shared/real.toml"), "old").unwrap();
        fs::set_permissions(at("shared/real.toml"), fs::Permissions::from_mode(0o640)).unwrap();
        symlink("shared/real.toml", at("m.toml")).unwrap();
        fs::write(at("m.toml.new"), "a neighbour").unwrap();
        fs::write(at("m.toml.old"), "another").unwrap();

        let kept = replace(&at("m.toml"), "new", Old::Kept).unwrap();
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

        assert_eq!(replace(&at("m.toml"), "newer", Old::Lost), Ok(None));
        assert_eq!(read("shared/real.toml"), "newer");
        // A link that leads nowhere yet, and a file that is not there.
        symlink("shared/more.toml", at("n.toml")).unwrap();
        for (name, real) in [("n.toml", "shared/more.toml"), ("o.toml", "o.toml")] {
            assert_eq!(replace(&at(name), "first", Old::Kept), Ok(None));
            assert_eq!(read(real), "first");
        }
        assert!(at("n.toml").is_symlink());
        let here = ["m.toml", "m.toml.new", "m.toml.old", "m.toml.old.1"];
        assert_eq!(names(folder.path())[..4], here);
        assert_eq!(names(folder.path())[4..], ["n.toml", "o.toml", "shared"]);
        let failure = replace(&at("no/such/folder"), "x", Old::Kept).unwrap_err();
        assert!(failure.message.contains("cannot write"), "{failure:?}");
    }

    #[test]
    fn only_what_is_written_anew_every_time_is_written_over() {
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
            // Not even one of its kind that is read.
            let inputs = [(own.as_path(), "what is read")];
            let failure = may_replace("--x", own, kind, inputs).unwrap_err();
            assert!(failure.message.ends_with("is what is read"), "{failure:?}");
        }
        assert!(!new.exists());
    }
}
