//! Writes the result of a scan as a machine file.

use std::path::Path;

use ecaxis_master::config::{self, ConfigError};
use ecaxis_master::text::pluralize;
use ecaxis_tools::scan::write::{self, MARK, MISSING, MachineFile, OutputPath};

use super::ScanResult;
use crate::access::bus;
use crate::args::files::replace;
use crate::hints::{self, Failure};
use crate::render::{note, result};
use crate::starter::{self, SCHEMA};

/// Fails if the file exists, because it may contain manual changes.
pub(super) fn refuse(path: &Path, force: bool) -> Result<(), Failure> {
    if force || !path.exists() {
        return Ok(());
    }
    let message = format!("{} is there already", path.display());
    let hint = match path.extension() {
        Some(extension) if extension == "sii" => "`--force` overwrites EEPROM images",
        _ => {
            "name another file, `--force` overwrites it, `ecaxis compare FILE --apply` only changes what differs"
        }
    };
    Err(Failure::new(hints::WRONG, message).hint(hint))
}

/// Writes the machine file of an ENI file.
pub(super) fn imported(path: &Path, text: &str, force: bool) -> Result<(), Failure> {
    write_with_schema(path, text, force)?;
    let file = path.display();
    result(&format!(
        "{file}: the machine of the ENI file; the bus is as it says\n\
         next: add axes, `ecaxis check {file}`; `ecaxis eni import` lists what is not sent\n"
    ))
}

fn write_with_schema(path: &Path, text: &str, force: bool) -> Result<(), Failure> {
    replace(path, starter::with_schema(text).as_bytes())?;
    // A schema that is there may be of a newer version.
    let schema = path.with_file_name(SCHEMA);
    if force || !schema.exists() {
        replace(&schema, starter::schema().as_bytes())?;
    }
    Ok(())
}

pub(super) fn machine_file(
    seen: &ScanResult,
    redundant: Option<&str>,
    path: &Path,
    library: bool,
    force: bool,
) -> Result<(), Failure> {
    let place = OutputPath {
        nic: &seen.nic,
        redundant,
        folder: path.parent().unwrap_or(Path::new("")),
    };
    let MachineFile { text, images } = write::machine_file(&seen.scan, &seen.described, place);
    for (image, _) in &images {
        if image == path {
            let message = format!("{} is the EEPROM image of a device", path.display());
            return Err(Failure::new(hints::WRONG, message).hint("name another file"));
        }
        refuse(image, force)?;
    }
    for (image, bytes) in &images {
        replace(image, bytes)?;
    }
    write_with_schema(path, &text, force)?;
    let devices = seen.scan.devices.len();
    let axes = text.matches("[device.axis]").count();
    let of_them = if axes == 1 { "an axis" } else { "axes" };
    let file = path.display();
    let devices = pluralize(devices, "device");
    let mut reported = format!("{file}: {devices}, {axes} of them {of_them}\n");
    let checks = text.lines().filter(|line| line.contains(MARK));
    // The first lines of the file explain the mark.
    let checks = checks.filter(|line| !line.starts_with("# Written")).count();
    reported += &format!("{checks} lines are marked \"{MARK}\" and need a check\n");
    reported += &format!("next: `ecaxis check {file}`, then `ecaxis run {file} --no-enable`\n");
    if !seen.scan.asked {
        bus::warn("the devices were not asked: units, limits and modules in the file are guesses");
    }
    let help = if library {
        "  = help: put their vendors' files into the folder of ESI files, and scan again with --force"
    } else {
        "  = help: name the folder of ESI files with `--esi`"
    };
    let missing = text.matches(MISSING).count();
    if missing > 0 {
        let devices = pluralize(missing, "device");
        bus::warn(format_args!(
            "no ESI file describes {devices}, and no whole EEPROM: the file cannot be run yet"
        ));
        note(help);
    } else if !images.is_empty() {
        let devices = pluralize(images.len(), "device");
        bus::warn(format_args!(
            "no ESI file describes {devices}: the file uses the EEPROM images (`sii`), which lack start-up commands and objects"
        ));
        note(help);
    }
    if missing == 0
        && let Err(ConfigError::Problems(problems)) = config::load(path)
    {
        let problems = pluralize(problems.len(), "problem");
        bus::warn(format_args!(
            "the file has {problems}: `ecaxis check {file}` shows them"
        ));
    }
    result(&reported)
}
