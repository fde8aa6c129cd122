//! Machines that are part of the program: the demonstration of `ecaxis run`, and the starter that
//! `ecaxis init` writes.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use ecaxis_master::config::{self, Machine};
use ecaxis_master::signature::SignaturePolicy;

use crate::failure::{Failure, WRONG};
use crate::hints;

/// The name of the demonstration where other machines have their path.
const DEMONSTRATION: &str = "the demonstration";

const DEMO: &str = include_str!("../../configs/demo.toml");

/// The commented machine file of a new user. It uses the ESI files of [`ESI`].
pub(crate) const STARTER: &str = include_str!("../../configs/starter.toml");

/// The ESI files of both machines, with their path relative to the machine file.
pub(crate) const ESI: [(&str, &str); 2] = [
    ("esi/EPOS4.xml", include_str!("../../configs/esi/EPOS4.xml")),
    ("esi/IDX.xml", include_str!("../../configs/esi/IDX.xml")),
];

/// The name of the JSON schema next to a machine file.
pub(crate) const SCHEMA: &str = "ecaxis.schema.json";

/// Returns the JSON schema of the machine file as text.
pub(crate) fn schema() -> String {
    format!("{:#}\n", config::schema::machine_file())
}

/// Returns a machine file with the line that names its schema to editors.
pub(crate) fn with_schema(text: &str) -> String {
    format!("#:schema ./{SCHEMA}\n{text}")
}

/// Returns the demonstration. Its files exist only while they are read.
pub(crate) fn demonstration() -> Result<Machine, Failure> {
    let unpacked = |error: io::Error| {
        let message = format!("cannot unpack the demonstration: {error}");
        Failure::new(WRONG, message).hint("set TMPDIR to a folder that can be written")
    };
    let folder = tempfile::tempdir().map_err(unpacked)?;
    let file = folder.path().join("demo.toml");
    write(&file, DEMO).map_err(unpacked)?;
    for (name, text) in ESI {
        write(&folder.path().join(name), text).map_err(unpacked)?;
    }
    // The files are part of the program.
    let policy = SignaturePolicy::default();
    let loaded = config::load_with(&file, &policy);
    let machine = loaded.map_err(|error| hints::config(&file, &error))?;
    Ok(renamed(machine, folder.path()))
}

/// Replaces the paths of the unpacked files, which are removed, by their names.
fn renamed(mut machine: Machine, folder: &Path) -> Machine {
    machine.path = PathBuf::from(DEMONSTRATION);
    for device in machine.devices.iter_mut() {
        if let Ok(name) = device.esi_path.strip_prefix(folder) {
            device.esi_path = name.to_owned();
        }
    }
    machine
}

/// Writes a file, and its folder if it is missing.
fn write(path: &Path, text: &str) -> io::Result<()> {
    if let Some(folder) = path.parent() {
        fs::create_dir_all(folder)?;
    }
    fs::write(path, text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn demonstration_is_complete_without_its_files() {
        let machine = demonstration().unwrap();
        assert_eq!(machine.path.to_str(), Some(DEMONSTRATION));
        assert_eq!(machine.axes.len(), 2);
        let esi: Vec<_> = machine
            .devices
            .iter()
            .map(|d| d.esi_path.to_str())
            .collect();
        assert_eq!(esi, ESI.map(|(name, _)| Some(name)));
    }
}
