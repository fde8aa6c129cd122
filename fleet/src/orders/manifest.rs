//! The manifest of a bundle: the files of a machine with their digests.

use std::collections::BTreeSet;
use std::fmt;
use std::path::Path;

use serde::{Deserialize, Serialize};

use super::digest::FileDigest;
use crate::error::{Error, Result};
use crate::keys::MachineId;

/// The longest manifest in bytes.
pub const MAX_MANIFEST: u64 = 1 << 20;
/// The longest file of a bundle in bytes.
pub const MAX_FILE: u64 = 64 << 20;
/// All files of a bundle in bytes.
const MAX_BYTES: u64 = 256 << 20;
const MAX_FILES: usize = 1000;
const MAX_PATH: usize = 255;
const MAX_DEPTH: usize = 8;
/// The version of the format.
const FORMAT: u32 = 1;

/// A relative path that stays in its folder.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(into = "String", try_from = "String")]
pub struct BundlePath(String);

impl TryFrom<String> for BundlePath {
    type Error = String;

    fn try_from(text: String) -> std::result::Result<Self, String> {
        let allowed = |part: &str| {
            let bad = |c: char| c.is_control() || c == '\\';
            !matches!(part, "" | "." | "..") && !part.contains(bad)
        };
        if text.len() > MAX_PATH
            || text.split('/').count() > MAX_DEPTH
            || !text.split('/').all(allowed)
        {
            let text: String = text.chars().take(MAX_PATH).collect();
            return Err(format!(
                "`{}` is not a path below the folder of a bundle",
                text.escape_debug()
            ));
        }
        Ok(Self(text))
    }
}

impl From<BundlePath> for String {
    fn from(path: BundlePath) -> Self {
        path.0
    }
}

impl BundlePath {
    #[must_use]
    pub fn as_path(&self) -> &Path {
        Path::new(&self.0)
    }

    /// True if this path has no folder: a file name.
    #[must_use]
    pub fn is_name(&self) -> bool {
        !self.0.contains('/')
    }
}

impl fmt::Display for BundlePath {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// A file by its content.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FileRef {
    pub sha256: FileDigest,
    /// In bytes.
    pub size: u64,
}

impl FileRef {
    #[must_use]
    pub fn of(bytes: &[u8]) -> Self {
        Self {
            sha256: FileDigest::of(bytes),
            size: bytes.len() as u64,
        }
    }
}

/// A file of a bundle.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BundleFile {
    pub path: BundlePath,
    pub sha256: FileDigest,
    /// In bytes.
    pub size: u64,
}

impl BundleFile {
    #[must_use]
    pub fn content(&self) -> FileRef {
        FileRef {
            sha256: self.sha256,
            size: self.size,
        }
    }
}

/// The manifest of a bundle. Its id is the digest of its text.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// The version of the format: 1.
    pub ecaxis_bundle: u32,
    /// The machine for which the bundle is.
    pub machine: MachineId,
    /// The machine file, one of `files`.
    pub machine_file: BundlePath,
    /// The digest of the machine, as `ecaxis check` prints it.
    pub machine_sha256: FileDigest,
    /// In seconds since 1970.
    pub created: u64,
    /// The version of ecaxis that checked the files.
    pub ecaxis: String,
    pub files: Vec<BundleFile>,
}

impl Manifest {
    /// Returns the manifest of these files.
    ///
    /// # Errors
    /// Fails if the files exceed the limits of a bundle.
    pub fn new(
        machine: MachineId,
        machine_file: BundlePath,
        machine_sha256: FileDigest,
        created: u64,
        ecaxis: String,
        files: Vec<BundleFile>,
    ) -> Result<Self> {
        let manifest = Self {
            ecaxis_bundle: FORMAT,
            machine,
            machine_file,
            machine_sha256,
            created,
            ecaxis,
            files,
        };
        manifest.check()?;
        Ok(manifest)
    }

    /// Reads a manifest and checks its limits.
    ///
    /// # Errors
    /// Fails if the text is not a manifest, or exceeds a limit.
    pub fn parse(bytes: &[u8]) -> Result<Self> {
        if bytes.len() as u64 > MAX_MANIFEST {
            return Err(Error::new(format!(
                "the manifest is longer than {MAX_MANIFEST} bytes"
            )));
        }
        let manifest: Self = serde_json::from_slice(bytes)
            .map_err(|e| Error::new(format!("the manifest of the bundle is damaged: {e}")))?;
        manifest.check()?;
        Ok(manifest)
    }

    /// Returns the text.
    #[must_use]
    pub fn emit(&self) -> Vec<u8> {
        let mut text = serde_json::to_vec_pretty(self).unwrap_or_default();
        text.push(b'\n');
        text
    }

    fn check(&self) -> Result<()> {
        let fail = |what: String| Err(Error::new(format!("the bundle is refused: {what}")));
        if self.ecaxis_bundle != FORMAT {
            return fail(format!(
                "its format is {}, not {FORMAT}",
                self.ecaxis_bundle
            ));
        }
        if self.files.len() > MAX_FILES {
            return fail(format!("it has more than {MAX_FILES} files"));
        }
        let mut paths = BTreeSet::new();
        let mut total = 0_u64;
        for file in &self.files {
            if file.size > MAX_FILE {
                return fail(format!("`{}` is longer than {MAX_FILE} bytes", file.path));
            }
            total = total.saturating_add(file.size);
            if !paths.insert(file.path.as_path()) {
                return fail(format!("`{}` is listed twice", file.path));
            }
        }
        if total > MAX_BYTES {
            return fail(format!("its files have more than {MAX_BYTES} bytes"));
        }
        let folder_of_another = |path: &&Path| path.ancestors().skip(1).any(|a| paths.contains(a));
        if let Some(path) = paths.iter().find(|path| folder_of_another(path)) {
            return fail(format!("a file is the folder of `{}`", path.display()));
        }
        if !paths.contains(self.machine_file.as_path()) {
            return fail(format!(
                "its machine file `{}` is missing",
                self.machine_file
            ));
        }
        Ok(())
    }
}
