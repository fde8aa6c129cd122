//! Targets of recordings.

use std::path::Path;

use ecaxis_master::link::capture;

use crate::args::files::{Inputs, check_output};
use crate::failure::{Failure, WRONG};

/// Fails if the parts of a limited recording would overwrite another file, such as a part of an
/// older recording.
pub(crate) fn check_parts(target: &Path, force: bool, inputs: &Inputs) -> Result<(), Failure> {
    for part in capture::parts_of(target).unwrap_or_default() {
        check_output("--record-limit", &part, true, inputs)?;
        let old = std::fs::metadata(&part).is_ok_and(|file| file.len() > 0);
        if old && !force {
            let shown = part.display();
            let message = format!("--record-limit: {shown} is a part of an older recording");
            return Err(Failure::new(WRONG, message)
                .hint("name another file, or overwrite the older recording with `--force`"));
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
    use super::*;

    #[test]
    fn recording_never_overwrites_an_input() {
        let configs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs");
        let machine = ecaxis_master::config::load(&configs.join("demo.toml")).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let faults = folder.path().join("faults.toml");
        std::fs::write(&faults, "").unwrap();
        let link = folder.path().join("link");
        std::os::unix::fs::symlink(&machine.path, &link).unwrap();
        let inputs = Inputs::from_machine(&machine).with("the fault script", [&faults]);
        for (bad, what) in [
            (configs.join("demo.toml"), "the machine file"),
            (link, "the machine file"),
            (configs.join("esi/EPOS4.xml"), "an ESI file"),
            (faults.clone(), "the fault script"),
        ] {
            let failure = check_output("--record", &bad, true, &inputs).unwrap_err();
            assert!(failure.message.contains(what), "{failure:?}");
        }
        let new = folder.path().join("new.pcapng");
        assert_eq!(check_output("--record", &new, false, &inputs), Ok(()));
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
    fn check_parts_finds_numbered_files() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("run.pcapng");
        std::fs::write(folder.path().join("run.notes.pcapng"), "no part").unwrap();
        assert_eq!(check_parts(&path, false, &Inputs::default()), Ok(()));
        std::fs::write(folder.path().join("run.0002.pcapng"), "part").unwrap();
        let failure = check_parts(&path, false, &Inputs::default()).unwrap_err();
        let expected = "run.0002.pcapng is a part of an older recording";
        assert!(failure.message.ends_with(expected), "{failure:?}");
        assert!(failure.hints[0].contains("`--force`"), "{failure:?}");
        assert_eq!(check_parts(&path, true, &Inputs::default()), Ok(()));
    }
}
