//! ESI files on disk: single files with their references, or a folder of files as a library.
//!
//! [`load`] reads a file together with the module files that it refers to. [`Library`] indexes a
//! folder by vendor, product and revision and finds the best description of a device. `cache`
//! keeps the index between program starts, so that only changed files are read again.

mod cache;
#[cfg(test)]
mod tests;

use std::collections::BTreeSet;
use std::fmt;
use std::io;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use ecaxis_esi as esi;
use serde::{Deserialize, Serialize};

use crate::file;
use crate::signature::{SignatureError, SignaturePolicy, SignedKind, VerifiedFiles};

/// The maximum number of files in a library. More files indicate a wrong path.
const MAX_FILES: usize = 10_000;
/// The maximum number of files that one file may refer to, directly and indirectly.
const MAX_REFERENCES: usize = 64;
/// The maximum length of an ESI file in bytes.
const MAX_BYTES: u64 = 256 << 20;

#[derive(Debug, thiserror::Error)]
pub enum LoadError {
    #[error("cannot read {}: {source}", path.display())]
    Read { path: PathBuf, source: io::Error },
    #[error("{}:{source}", path.display())]
    Esi {
        path: PathBuf,
        source: Box<esi::EsiError>,
    },
    #[error("{}: {source}", path.display())]
    Sii {
        path: PathBuf,
        source: esi::sii::SiiError,
    },
    #[error(transparent)]
    Signature(#[from] SignatureError),
}

/// The EEPROM image of a device, from a file.
#[derive(Debug)]
pub struct SiiImage {
    pub path: PathBuf,
    pub bytes: Vec<u8>,
    pub sii: esi::sii::Sii,
}

/// Reads the file of an EEPROM image, verifies it and adds it to `used`.
pub(crate) fn load_sii(path: &Path, used: &mut VerifiedFiles<'_>) -> Result<SiiImage, LoadError> {
    /// More than the EEPROM interface of a SubDevice can address.
    const MAX_BYTES: u64 = 512 * 1024;
    let bytes = file::read(path, MAX_BYTES).map_err(|source| LoadError::Read {
        path: path.to_owned(),
        source,
    })?;
    used.add(SignedKind::Esi, path, &bytes)?;
    let sii = esi::sii::parse(&bytes).map_err(|source| LoadError::Sii {
        path: path.to_owned(),
        source,
    })?;
    Ok(SiiImage {
        path: path.to_owned(),
        bytes,
        sii,
    })
}

fn read(path: &Path) -> Result<Vec<u8>, LoadError> {
    let failed = |source| LoadError::Read {
        path: path.to_owned(),
        source,
    };
    file::read(path, MAX_BYTES).map_err(failed)
}

fn parse(
    path: &Path,
    wanted: &dyn Fn(&esi::DeviceHeader) -> bool,
    used: &mut VerifiedFiles<'_>,
) -> Result<esi::EsiFile, LoadError> {
    let bytes = read(path)?;
    used.add(SignedKind::Esi, path, &bytes)?;
    esi::parse_where(&bytes, wanted).map_err(|source| LoadError::Esi {
        path: path.to_owned(),
        source: Box::new(source),
    })
}

/// Reads a file for the index of a library. Signatures count when a file is loaded.
fn index(path: &Path) -> Result<esi::EsiFile, LoadError> {
    let policy = SignaturePolicy::default();
    parse(path, &|_| false, &mut VerifiedFiles::new(&policy))
}

/// Reads an ESI file with the devices that `wanted` accepts, and adds the modules of the files that
/// its `InfoReference`s name, from the same folder. A referenced file that cannot be read is a
/// warning of the file. Signatures are not looked at.
pub fn load(
    path: &Path,
    wanted: &dyn Fn(&esi::DeviceHeader) -> bool,
) -> Result<esi::EsiFile, LoadError> {
    let policy = SignaturePolicy::default();
    load_with(path, wanted, &mut VerifiedFiles::new(&policy))
}

/// Like [`load`]; verifies the files that it reads and adds them to `used`.
pub(crate) fn load_with(
    path: &Path,
    wanted: &dyn Fn(&esi::DeviceHeader) -> bool,
    used: &mut VerifiedFiles<'_>,
) -> Result<esi::EsiFile, LoadError> {
    let mut file = parse(path, wanted, used)?;
    let folder = path.parent().unwrap_or(Path::new(""));
    let mut waiting = std::mem::take(&mut file.references);
    let mut seen: BTreeSet<String> = path
        .file_name()
        .map(|name| name.to_string_lossy().into_owned())
        .into_iter()
        .collect();
    while let Some(name) = waiting.pop() {
        // References may contain paths with foreign separators, and their case may differ from the
        // file's.
        let name = name
            .rsplit(['/', '\\'])
            .next()
            .unwrap_or_default()
            .to_owned();
        if name.is_empty() || !seen.insert(name.clone()) {
            continue;
        }
        file.references.push(name.clone());
        let added = if seen.len() > MAX_REFERENCES {
            Err("too many files are referred to".to_owned())
        } else {
            match sibling(folder, &name).map(|path| parse(&path, &|_| false, used)) {
                Ok(Ok(file)) => Ok(file),
                Ok(Err(error @ LoadError::Signature(_))) => return Err(error),
                Ok(Err(error)) => Err(error.to_string()),
                Err(problem) => Err(problem),
            }
        };
        match added {
            Ok(other) => {
                waiting.extend(other.references);
                for mut module in other.modules {
                    if file.modules.iter().all(|known| known.ident != module.ident) {
                        module.file = Some(name.clone());
                        file.modules.push(module);
                    }
                }
                file.warnings
                    .extend(other.warnings.into_iter().map(|warning| {
                        let file = Some(name.clone());
                        esi::Warning { file, ..warning }
                    }));
            }
            Err(problem) => file.warnings.push(esi::Warning {
                file: None,
                left_out: true,
                position: esi::Position { line: 1, column: 1 },
                path: "EtherCATInfo/InfoReference".to_owned(),
                message: format!("{name:?}: {problem}"),
            }),
        }
    }
    Ok(file)
}

fn sibling(folder: &Path, name: &str) -> Result<PathBuf, String> {
    let exact = folder.join(name);
    if exact.is_file() {
        return Ok(exact);
    }
    let folder = if folder.as_os_str().is_empty() {
        Path::new(".")
    } else {
        folder
    };
    let entries = std::fs::read_dir(folder).map_err(|e| e.to_string())?;
    entries
        .flatten()
        .find(|entry| {
            entry
                .file_name()
                .to_string_lossy()
                .eq_ignore_ascii_case(name)
        })
        .map(|entry| entry.path())
        .ok_or_else(|| "the file is not in the same folder".to_owned())
}

/// Returns the path of a library's index in the user's cache folder, one file per library.
#[must_use]
pub fn cache_file(folder: &Path) -> Option<PathBuf> {
    let absolute = std::fs::canonicalize(folder).ok()?;
    let base = match std::env::var_os("XDG_CACHE_HOME") {
        Some(base) if !base.is_empty() => PathBuf::from(base),
        _ => {
            PathBuf::from(std::env::var_os("HOME").filter(|home| !home.is_empty())?).join(".cache")
        }
    };
    // The name must only differ between folders and stay the same across versions.
    let hash = cache::hash(absolute.as_os_str().as_encoded_bytes());
    Some(base.join("ecaxis").join(format!("esi-{hash:016x}.json")))
}

/// The rule that decides which revisions of a device a description covers.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash)]
pub enum RevisionMatch {
    Equal,
    /// The device's revision is equal to the described one or newer.
    #[default]
    Newer,
    /// The high words are the same.
    HighWord,
    /// The low words are the same.
    LowWord,
    /// Any revision of the product.
    Ignore,
}

impl RevisionMatch {
    const ALL: [(Self, &'static str); 5] = [
        (Self::Equal, "equal"),
        (Self::Newer, "newer"),
        (Self::HighWord, "high-word"),
        (Self::LowWord, "low-word"),
        (Self::Ignore, "ignore"),
    ];

    /// Returns `true` if a description of revision `described` covers a device of revision `found`.
    #[must_use]
    pub fn accepts(self, described: u32, found: u32) -> bool {
        match self {
            Self::Equal => described == found,
            Self::Newer => found >= described,
            Self::HighWord => found >> 16 == described >> 16,
            Self::LowWord => found & 0xffff == described & 0xffff,
            Self::Ignore => true,
        }
    }
}

impl fmt::Display for RevisionMatch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = Self::ALL.iter().find(|(rule, _)| rule == self);
        f.write_str(name.map_or("", |(_, name)| name))
    }
}

impl FromStr for RevisionMatch {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        if text == ">=" {
            return Ok(Self::Newer);
        }
        let found = Self::ALL.iter().find(|(_, name)| *name == text);
        found.map(|(rule, _)| *rule).ok_or_else(|| {
            format!("{text:?} is not a rule; there are equal, newer (>=), high-word, low-word and ignore")
        })
    }
}

/// One device in one file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Entry {
    /// The path relative to the library's folder.
    pub file: PathBuf,
    pub vendor: u32,
    pub vendor_name: String,
    pub product: u32,
    pub revision: u32,
    pub type_name: String,
    pub name: String,
}

/// A folder of ESI files, including its subfolders.
#[derive(Debug)]
pub struct Library {
    folder: PathBuf,
    /// The devices, sorted by vendor, product and revision.
    entries: Vec<Entry>,
    /// Files that are not ESI files, with the reason.
    unusable: Vec<(PathBuf, String)>,
    /// The number of files that were read; the others came from the cache.
    read: usize,
}

impl Library {
    /// Indexes `folder`. With a `cache` file, only changed files are read. A cache that cannot be
    /// read or written is ignored.
    pub fn open(folder: &Path, cache: Option<&Path>) -> Result<Self, LoadError> {
        let mut files = Vec::new();
        collect(folder, &mut files).map_err(|source| LoadError::Read {
            path: folder.to_owned(),
            source,
        })?;
        files.sort_by(|a, b| a.path.cmp(&b.path));
        let known = cache.map(cache::read).unwrap_or_default();
        let mut fresh = cache::Index::default();
        let (mut entries, mut unusable, mut read) = (Vec::new(), Vec::new(), 0);
        for file in files {
            let record = match known.get(&file) {
                Some(record) => record.clone(),
                None => {
                    read += 1;
                    describe(folder, &file.path)
                }
            };
            match &record {
                Ok(devices) => entries.extend(devices.iter().cloned()),
                Err(problem) => unusable.push((file.path.clone(), problem.clone())),
            }
            if file.is_settled() {
                fresh.insert(file, record);
            }
        }
        entries.sort_by_key(|e| (e.vendor, e.product, e.revision));
        if let Some(cache) = cache.filter(|_| read > 0 || known.len() != fresh.len()) {
            cache::write(cache, &fresh);
        }
        Ok(Self {
            folder: folder.to_owned(),
            entries,
            unusable,
            read,
        })
    }

    /// Returns a library with the devices of one file.
    pub fn of_file(path: &Path) -> Result<Self, LoadError> {
        let file = PathBuf::from(path.file_name().unwrap_or_default());
        let mut entries = devices(&file, index(path)?);
        entries.sort_by_key(|e| (e.vendor, e.product, e.revision));
        Ok(Self {
            folder: path.parent().unwrap_or(Path::new("")).to_owned(),
            entries,
            unusable: Vec::new(),
            read: 1,
        })
    }

    #[must_use]
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    #[must_use]
    pub fn entries(&self) -> &[Entry] {
        &self.entries
    }

    #[must_use]
    pub fn unusable(&self) -> &[(PathBuf, String)] {
        &self.unusable
    }

    #[must_use]
    pub fn files_read(&self) -> usize {
        self.read
    }

    /// Returns the best description of a device. Among those that `rule` accepts, this is the
    /// nearest one below the device's revision, otherwise the nearest above.
    #[must_use]
    pub fn find(&self, device: esi::Identity, rule: RevisionMatch) -> Option<&Entry> {
        let of_product = self
            .entries
            .iter()
            .filter(|e| (e.vendor, e.product) == (device.vendor, device.product));
        of_product
            .filter(|e| rule.accepts(e.revision, device.revision))
            .min_by_key(|e| {
                (
                    e.revision > device.revision,
                    e.revision.abs_diff(device.revision),
                )
            })
    }
}

/// The index entry of one file: its devices, or the reason why it has none.
type Record = Result<Vec<Entry>, String>;

fn describe(folder: &Path, file: &Path) -> Record {
    let parsed = index(&folder.join(file)).map_err(|error| match error {
        LoadError::Esi { source, .. } => source.to_string(),
        LoadError::Read { source, .. } => source.to_string(),
        LoadError::Sii { source, .. } => source.to_string(),
        LoadError::Signature(source) => source.to_string(),
    })?;
    Ok(devices(file, parsed))
}

fn devices(file: &Path, mut parsed: esi::EsiFile) -> Vec<Entry> {
    let skipped = std::mem::take(&mut parsed.skipped);
    let vendor_name = |id| parsed.vendor_name(id).to_owned();
    let entry = |device: esi::DeviceHeader| Entry {
        file: file.to_owned(),
        vendor: device.identity.vendor,
        vendor_name: vendor_name(device.identity.vendor),
        product: device.identity.product,
        revision: device.identity.revision,
        type_name: device.type_name,
        name: device.name,
    };
    skipped.into_iter().map(entry).collect()
}

/// Collects every `.xml` file below the folder.
fn collect(folder: &Path, files: &mut Vec<cache::FileFingerprint>) -> io::Result<()> {
    let mut folders = vec![PathBuf::new()];
    while let Some(below) = folders.pop() {
        for entry in std::fs::read_dir(folder.join(&below))? {
            let entry = entry?;
            let path = below.join(entry.file_name());
            let kind = entry.file_type()?;
            let is_xml = path
                .extension()
                .is_some_and(|extension| extension.eq_ignore_ascii_case("xml"));
            if kind.is_dir() {
                folders.push(path);
            } else if is_xml && let Ok(metadata) = std::fs::metadata(entry.path()) {
                files.push(cache::FileFingerprint::new(path, &metadata));
            }
            if files.len() > MAX_FILES || folders.len() > MAX_FILES {
                let message = format!("more than {MAX_FILES} files or folders: not an ESI library");
                return Err(io::Error::other(message));
            }
        }
    }
    Ok(())
}
