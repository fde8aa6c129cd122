//! The index of a library, kept between program starts. A file counts as unchanged if its length
//! and modification time are unchanged. The cache belongs to one version of the program, and a
//! checksum detects damage.

use std::collections::BTreeMap;
use std::fs::Metadata;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use serde::{Deserialize, Serialize};

use super::{MAX_BYTES, Record};
use crate::file;

/// The header of the index. Its number increases when the same file may give a different record.
const HEAD: &str = concat!("ecaxis-esi-index ", env!("CARGO_PKG_VERSION"), " 3 ");
/// The minimum age of a modification time. A younger file may change again within the same tick of
/// the file system's clock.
const SETTLED: Duration = Duration::from_secs(2);

/// The length and modification time of a file when it was read.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub(super) struct FileFingerprint {
    pub path: PathBuf,
    bytes: u64,
    /// The modification time in ns since 1970.
    changed: u128,
}

impl FileFingerprint {
    pub fn new(path: PathBuf, metadata: &Metadata) -> Self {
        let changed = metadata.modified().ok();
        let changed = changed.and_then(|time| time.duration_since(UNIX_EPOCH).ok());
        Self {
            path,
            bytes: metadata.len(),
            changed: changed.map_or(0, |time| time.as_nanos()),
        }
    }
}

impl FileFingerprint {
    /// Returns `true` if a further change would surely change the modification time.
    pub fn is_settled(&self) -> bool {
        let now = SystemTime::now().duration_since(UNIX_EPOCH);
        let now = now.map_or(0, |time| time.as_nanos());
        self.changed != 0 && self.changed.saturating_add(SETTLED.as_nanos()) < now
    }
}

/// Returns the FNV-1a hash.
pub(super) fn hash(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| {
        (hash ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3)
    })
}

pub(super) type Index = BTreeMap<FileFingerprint, Record>;

/// Returns an empty index if the file is missing or invalid.
pub(super) fn read(path: &Path) -> Index {
    let bytes = file::read(path, MAX_BYTES).unwrap_or_default();
    checked(&bytes).unwrap_or_default()
}

fn checked(bytes: &[u8]) -> Option<Index> {
    let rest = bytes.strip_prefix(HEAD.as_bytes())?;
    let (sum, body) = rest.split_at_checked(16)?;
    let body = body.strip_prefix(b"\n")?;
    if sum != format!("{:016x}", hash(body)).as_bytes() {
        return None;
    }
    let files: Vec<(FileFingerprint, Record)> = serde_json::from_slice(body).ok()?;
    Some(files.into_iter().collect())
}

/// Writes a temporary file and renames it, so that a reader never sees a partial file.
pub(super) fn write(path: &Path, index: &Index) {
    let files: Vec<(&FileFingerprint, &Record)> = index.iter().collect();
    let Ok(body) = serde_json::to_vec(&files) else {
        return;
    };
    let mut bytes = format!("{HEAD}{:016x}\n", hash(&body)).into_bytes();
    bytes.extend(body);
    let during = path.with_extension(format!("{}.tmp", std::process::id()));
    let written = path
        .parent()
        .map_or(Ok(()), std::fs::create_dir_all)
        .and_then(|()| std::fs::File::create(&during))
        .and_then(|mut file| file.write_all(&bytes))
        .and_then(|()| std::fs::rename(&during, path));
    if let Err(error) = written {
        let _ = std::fs::remove_file(&during);
        tracing::debug!(path = %path.display(), %error, "the index of the ESI library is not kept");
    }
}
