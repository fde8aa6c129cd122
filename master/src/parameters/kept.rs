//! The parameter file that a machine file names for a device.

use std::path::{Path, PathBuf};

use ecaxis_esi::Device;

use super::Parameter;
use super::dump::Dump;
use crate::file::{self, unreadable};
use crate::signature::{SignedKind, VerifiedFiles};

/// The maximum size of a parameter file in bytes.
pub const MAX_BYTES: u64 = 64 << 20;

/// The objects that say for which firmware and model the parameters are: vendor, product, revision
/// (0x1018), Manufacturer software version.
const MODEL: [(u16, u8); 4] = [(0x1018, 1), (0x1018, 2), (0x1018, 3), (0x100a, 0)];

/// A parameter file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct KeptParameters {
    pub path: PathBuf,
    pub dump: Dump,
}

impl KeptParameters {
    /// Reads the file of a device of a machine. An error is a message with a hint.
    pub(crate) fn read(
        path: &Path,
        device: &Device,
        files: &mut VerifiedFiles<'_>,
    ) -> Result<Self, (String, String)> {
        let text = file::read_text(path, MAX_BYTES).map_err(|error| {
            let hint =
                "paths are relative to the machine file; save one with `ecaxis sdo dump` before you add the key";
            (unreadable(path, &error), hint.to_owned())
        })?;
        files
            .add(SignedKind::Parameters, path, text.as_bytes())
            .map_err(|error| (error.to_string(), error.hint().to_owned()))?;
        let shown = path.display();
        let dump = Dump::parse(&text).map_err(|error| {
            let hint = "`ecaxis sdo dump` writes such files; `value` may be changed by hand";
            (format!("{shown}: {error}"), hint.to_owned())
        })?;
        let (found, wanted) = (dump.device.identity(), device.identity);
        if (found.vendor, found.product) != (wanted.vendor, wanted.product) {
            let message = format!("{shown} is of {found}, the ESI describes {wanted}");
            return Err((message, "name a file of the same product".to_owned()));
        }
        Ok(Self {
            path: path.to_owned(),
            dump,
        })
    }

    /// Returns true if the file was saved from the device with this serial number. Devices without
    /// serial number cannot be distinguished.
    #[must_use]
    pub fn is_of(&self, serial: u32) -> bool {
        serial != 0 && serial == self.dump.device.serial
    }

    /// Returns what must be equal in the device before its settings are written.
    pub fn model(&self) -> impl Iterator<Item = &Parameter> {
        let parameters = self.dump.parameters.iter();
        parameters.filter(|p| MODEL.contains(&(p.at.index, p.at.sub)))
    }
}
