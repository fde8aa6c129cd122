//! Targets of recordings. A recording never overwrites a file of another kind.

use std::path::Path;

use ecaxis_master::config::Machine;
use ecaxis_master::link::capture;

use crate::args::files::{RECORDING, TargetFile, existing, may_replace};
use crate::hints;
use crate::hints::Failure;

/// Fails if a run must not write its frames to `target`.
pub(crate) fn check(
    target: &Path,
    machine: &Machine,
    faults: Option<&Path>,
) -> Result<(), Failure> {
    check_distinct(target, Some(machine), faults, None)
}

/// Fails if frames must not be written to `target`. `input` is a file that is read, with its
/// description.
pub(crate) fn check_distinct(
    target: &Path,
    machine: Option<&Machine>,
    faults: Option<&Path>,
    input: Option<(&Path, &str)>,
) -> Result<(), Failure> {
    let files = machine.into_iter().flat_map(|machine| {
        let esi = machine.devices.iter().map(|d| d.esi_path.as_path());
        let esi = esi.map(|path| (path, "an ESI file of this machine"));
        std::iter::once((machine.path.as_path(), "the machine file")).chain(esi)
    });
    let inputs = files
        .chain(faults.map(|path| (path, "the fault script")))
        .chain(input);
    may_replace("--record", target, &RECORDING, inputs)
}

/// Fails if the parts of a limited recording would overwrite another file.
pub(crate) fn check_parts(target: &Path) -> Result<(), Failure> {
    let parts = capture::parts_of(target).unwrap_or_default();
    for part in parts {
        if let Ok(TargetFile::Taken(what)) = existing(&part, &RECORDING) {
            let message = format!("--record-limit: {} {what}", part.display());
            return Err(Failure::new(hints::WRONG, message).hint(RECORDING.instead));
        }
    }
    Ok(())
}

/// The minimum size: the first of four parts should hold the bring-up of a long bus.
const SMALLEST: u64 = 10_000_000;

/// Parses a size such as `100MB` or `2 GiB` into bytes.
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

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn recording_replaces_only_recordings() {
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
        let machine = ecaxis_master::config::load(&demo).unwrap();
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
    fn check_parts_rejects_other_files() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("run.pcapng");
        assert_eq!(check_parts(&path), Ok(()));
        fs::write(folder.path().join("run.0001.pcapng"), "\n\r\r\n").unwrap();
        fs::write(folder.path().join("run.notes.pcapng"), "no part").unwrap();
        assert_eq!(check_parts(&path), Ok(()));
        fs::write(folder.path().join("run.0002.pcapng"), "notes").unwrap();
        let failure = check_parts(&path).unwrap_err();
        assert!(failure.message.contains("run.0002.pcapng"), "{failure:?}");
    }
}
