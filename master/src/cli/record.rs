//! Where a recording goes: never over a file that is something else.

use std::fs::{self, File, OpenOptions};
use std::io::{self, ErrorKind, Read};
use std::os::unix::fs::{FileTypeExt, MetadataExt};
use std::path::Path;

use ecaxis::config::Machine;
use ecaxis::link::capture;

use super::{Failure, hints};

/// How a pcapng file begins, in either byte order.
const MAGIC: [u8; 4] = [0x0a, 0x0d, 0x0d, 0x0a];

/// Whether a run may write its frames to `target`.
pub(crate) fn check(
    target: &Path,
    machine: &Machine,
    faults: Option<&Path>,
) -> Result<(), Failure> {
    let shown = target.display();
    let refuse = |what: String| Failure::new(hints::WRONG, format!("--record: {what}"));
    let inputs = [(machine.path.as_path(), "the machine file")]
        .into_iter()
        .chain(faults.map(|path| (path, "the fault script")))
        .chain(
            machine
                .devices
                .iter()
                .map(|d| (d.esi_path.as_path(), "an ESI file of this machine")),
        );
    for (input, what) in inputs {
        if same_file(input, target) {
            return Err(refuse(format!("{shown} is {what}")).hint(NEW));
        }
    }
    match existing(target) {
        Ok(Existing::Free) => Ok(()),
        Ok(Existing::Taken(what)) => Err(refuse(format!("{shown} {what}")).hint(NEW)),
        Err(e) => {
            let failure = refuse(format!("cannot write {shown}: {e}"));
            Err(failure.hint("name a file in a folder that exists and can be written"))
        }
    }
}

/// Whether the parts of a recording with a limit would be written over something else.
pub(crate) fn check_parts(target: &Path) -> Result<(), Failure> {
    let parts = capture::parts_of(target).unwrap_or_default();
    for part in parts {
        if let Ok(Existing::Taken(what)) = existing(&part) {
            let message = format!("--record-limit: {} {what}", part.display());
            return Err(Failure::new(hints::WRONG, message).hint(NEW));
        }
    }
    Ok(())
}

/// The first of four parts should hold the bring-up, also of a long bus.
const SMALLEST: u64 = 10_000_000;

/// A size as people write it (`100MB`, `2 GiB`), in bytes.
pub(crate) fn size(text: &str) -> Result<u64, String> {
    const UNITS: [(&str, u64); 7] = [
        ("GiB", 1 << 30),
        ("MiB", 1 << 20),
        ("KiB", 1 << 10),
        ("GB", 1_000_000_000),
        ("MB", 1_000_000),
        ("kB", 1_000),
        ("B", 1),
    ];
    let text = text.trim();
    let unit = UNITS
        .iter()
        .find_map(|(unit, scale)| Some((text.strip_suffix(unit)?, scale)));
    let (number, scale) = unit.ok_or("a number and a unit, such as 100MB or 2GiB")?;
    let number: u64 = number
        .trim()
        .parse()
        .map_err(|_| "a whole number in front of the unit")?;
    match number.checked_mul(*scale) {
        Some(bytes @ SMALLEST..) => Ok(bytes),
        Some(_) => Err("at least 10MB, so that a quarter of it holds the way to Op".to_owned()),
        None => Err("too much".to_owned()),
    }
}

const NEW: &str = "name a new file, or a recording to write over";

fn same_file(a: &Path, b: &Path) -> bool {
    match (fs::metadata(a), fs::metadata(b)) {
        (Ok(a), Ok(b)) => (a.dev(), a.ino()) == (b.dev(), b.ino()),
        _ => false,
    }
}

enum Existing {
    /// Nothing that would be lost.
    Free,
    Taken(&'static str),
}

/// Tries what recording will do, and leaves everything as it was.
fn existing(target: &Path) -> io::Result<Existing> {
    let kind = match fs::metadata(target) {
        Ok(metadata) => metadata.file_type(),
        Err(e) if e.kind() == ErrorKind::NotFound => {
            drop(File::create(target)?);
            // The file, not a link that leads to it.
            fs::remove_file(fs::canonicalize(target)?)?;
            return Ok(Existing::Free);
        }
        Err(e) => return Err(e),
    };
    if kind.is_dir() {
        return Ok(Existing::Taken("is a folder"));
    }
    if kind.is_block_device() {
        return Ok(Existing::Taken("is a disk"));
    }
    // A pipe into a program, a null device: opening it could block, and nothing is kept there.
    if !kind.is_file() {
        return Ok(Existing::Free);
    }
    let mut file = OpenOptions::new().read(true).write(true).open(target)?;
    let mut head = Vec::new();
    file.by_ref().take(4).read_to_end(&mut head)?;
    Ok(if head.is_empty() || head == MAGIC {
        Existing::Free
    } else {
        Existing::Taken("exists and is not a recording (pcapng)")
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_nothing_and_recordings_are_written_over() {
        let folder = tempfile::tempdir().unwrap();
        let configs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs");
        let copy = |name: &str| {
            let to = folder.path().join(name);
            fs::create_dir_all(to.parent().unwrap()).unwrap();
            fs::copy(configs.join(name), &to).unwrap();
            to
        };
        let demo = copy("demo.toml");
        let esi = copy("esi/EPOS4.xml");
        copy("esi/IDX.xml");
        let machine = ecaxis::config::load(&demo).unwrap();
        let file = |name: &str, bytes: &[u8]| {
            let path = folder.path().join(name);
            fs::write(&path, bytes).unwrap();
            path
        };
        let faults = file("faults.toml", b"");
        let link = folder.path().join("link");
        std::os::unix::fs::symlink(&demo, &link).unwrap();
        let dangling = folder.path().join("dangling");
        std::os::unix::fs::symlink(folder.path().join("new"), &dangling).unwrap();

        let check = |path: &Path| check(path, &machine, Some(&faults));
        let new = folder.path().join("new.pcapng");
        for good in [
            new.clone(),
            dangling.clone(),
            file("empty", b""),
            file("old.pcapng", b"\n\r\r\n and more"),
            "/dev/null".into(),
        ] {
            assert_eq!(check(&good), Ok(()), "{}", good.display());
        }
        assert!(!new.exists());
        assert!(!dangling.exists() && dangling.is_symlink());
        for (bad, what) in [
            (demo.clone(), "the machine file"),
            (link, "the machine file"),
            (esi.clone(), "an ESI file"),
            (faults.clone(), "the fault script"),
            (folder.path().to_owned(), "is a folder"),
            (file("notes.txt", b"dear diary"), "is not a recording"),
            (file("short", b"\n\r"), "is not a recording"),
            (folder.path().join("no/such/folder"), "cannot write"),
        ] {
            let failure = check(&bad).unwrap_err();
            assert_eq!(failure.code, hints::WRONG);
            assert!(failure.message.contains(what), "{failure:?}");
            assert!(!failure.hints.is_empty());
        }
        for (copy, name) in [(demo, "demo.toml"), (esi, "esi/EPOS4.xml")] {
            assert_eq!(
                fs::read(copy).unwrap(),
                fs::read(configs.join(name)).unwrap()
            );
        }
    }

    #[test]
    fn sizes() {
        for (text, bytes) in [
            ("100MB", 100_000_000),
            (" 2 GiB ", 2 << 30),
            ("10000kB", 10_000_000),
            ("10000000B", 10_000_000),
        ] {
            assert_eq!(size(text), Ok(bytes), "{text}");
        }
        for bad in [
            "",
            "MB",
            "100",
            "1.5MB",
            "-1MB",
            "9MB",
            "99999999999999GB",
            "1MBit",
        ] {
            assert!(size(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn parts_that_are_something_else() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("run.pcapng");
        assert_eq!(check_parts(&path), Ok(()));
        fs::write(folder.path().join("run.0001.pcapng"), MAGIC).unwrap();
        fs::write(folder.path().join("run.notes.pcapng"), "no part").unwrap();
        assert_eq!(check_parts(&path), Ok(()));
        fs::write(folder.path().join("run.0002.pcapng"), "notes").unwrap();
        let failure = check_parts(&path).unwrap_err();
        assert!(failure.message.contains("run.0002.pcapng"), "{failure:?}");
    }
}
