//! The index of a library from one start to the next. A file counts as unchanged while its length and its time of
//! change are; the cache belongs to one version of this program.

use std::collections::BTreeMap;
use std::fs::Metadata;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;

use serde::{Deserialize, Serialize};

use super::Record;

const VERSION: &str = env!("CARGO_PKG_VERSION");

/// A file as it was when it was read.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub(super) struct Stamp {
    pub path: PathBuf,
    bytes: u64,
    /// Nanoseconds since 1970.
    changed: u128,
}

impl Stamp {
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

pub(super) type Index = BTreeMap<Stamp, Record>;

#[derive(Serialize, Deserialize)]
struct Stored {
    version: String,
    files: Vec<(Stamp, Record)>,
}

pub(super) fn read(path: &Path) -> Index {
    let stored = std::fs::read(path).ok();
    let stored = stored.and_then(|bytes| serde_json::from_slice::<Stored>(&bytes).ok());
    stored
        .filter(|stored| stored.version == VERSION)
        .map(|stored| stored.files.into_iter().collect())
        .unwrap_or_default()
}

/// Written beside and renamed, so that a reader never sees half of it.
pub(super) fn write(path: &Path, index: &Index) {
    let stored = Stored {
        version: VERSION.to_owned(),
        files: index
            .iter()
            .map(|(stamp, record)| (stamp.clone(), record.clone()))
            .collect(),
    };
    let Ok(bytes) = serde_json::to_vec(&stored) else {
        return;
    };
    let beside = path.with_extension(format!("{}.tmp", std::process::id()));
    let written = path
        .parent()
        .map_or(Ok(()), std::fs::create_dir_all)
        .and_then(|()| std::fs::File::create(&beside))
        .and_then(|mut file| file.write_all(&bytes))
        .and_then(|()| std::fs::rename(&beside, path));
    if let Err(error) = written {
        let _ = std::fs::remove_file(&beside);
        tracing::debug!(path = %path.display(), %error, "the index of the ESI library is not kept");
    }
}
