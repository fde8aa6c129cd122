//! Files under their digest, fetched in chunks.

use std::collections::BTreeSet;
use std::fs::{self, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::Duration;

use super::digest::FileDigest;
use super::files::{self, at};
use super::manifest::FileRef;
use crate::error::{Error, Result};

/// The longest chunk in bytes.
pub const CHUNK: usize = 256 << 10;
/// The tries for one chunk.
const TRIES: u32 = 5;

/// Where an agent gets files.
pub trait FileSource: Send + Sync {
    /// Returns the bytes from `offset` on, at most [`CHUNK`].
    ///
    /// # Errors
    /// Fails if no sender answers.
    fn chunk(&self, digest: FileDigest, offset: u64) -> Result<Vec<u8>>;
}

/// A folder of files under their digests. A transfer that was interrupted continues.
#[derive(Debug, Clone)]
pub struct FileStore {
    folder: PathBuf,
    pause: Duration,
}

impl FileStore {
    /// Opens the folder, which it creates.
    ///
    /// # Errors
    /// Fails if the folder cannot be created.
    pub fn open(folder: &Path, pause: Duration) -> Result<Self> {
        fs::create_dir_all(folder).map_err(at(folder))?;
        Ok(Self {
            folder: folder.to_owned(),
            pause,
        })
    }

    /// Returns the bytes of a file, which it fetches if they are not here.
    ///
    /// # Errors
    /// Fails if the source has not the file, or another one.
    pub fn get(
        &self,
        file: FileRef,
        source: &dyn FileSource,
        tick: &mut dyn FnMut(u64),
    ) -> Result<Vec<u8>> {
        let path = self.folder.join(file.sha256.to_string());
        if let Ok(bytes) = files::read(&path, file.size)
            && FileRef::of(&bytes) == file
        {
            return Ok(bytes);
        }
        let part = path.with_extension("part");
        let mut bytes = files::read(&part, file.size).unwrap_or_default();
        let mut written = OpenOptions::new();
        let mut written = written.create(true).write(true).truncate(false).open(&part);
        let output = written
            .as_mut()
            .map_err(|e| at(&part)(std::io::Error::other(e.to_string())))?;
        output.set_len(bytes.len() as u64).map_err(at(&part))?;
        std::io::Seek::seek(output, std::io::SeekFrom::End(0)).map_err(at(&part))?;
        while (bytes.len() as u64) < file.size {
            tick(bytes.len() as u64);
            let chunk = self.chunk(file, bytes.len() as u64, source)?;
            output.write_all(&chunk).map_err(at(&part))?;
            bytes.extend_from_slice(&chunk);
        }
        if FileRef::of(&bytes) != file {
            fs::remove_file(&part).map_err(at(&part))?;
            return Err(Error::new(format!(
                "the file {} arrived with another content",
                file.sha256
            ))
            .help("send the order again"));
        }
        output.sync_all().map_err(at(&part))?;
        fs::rename(&part, &path).map_err(at(&path))?;
        Ok(bytes)
    }

    fn chunk(&self, file: FileRef, offset: u64, source: &dyn FileSource) -> Result<Vec<u8>> {
        let mut tried = 0;
        loop {
            tried += 1;
            match source.chunk(file.sha256, offset) {
                Ok(chunk)
                    if !chunk.is_empty()
                        && chunk.len() <= CHUNK
                        && offset + chunk.len() as u64 <= file.size =>
                {
                    return Ok(chunk);
                }
                Ok(_) if tried >= TRIES => {
                    let what = format!("the sender has another file than {}", file.sha256);
                    return Err(Error::new(what));
                }
                Err(error) if tried >= TRIES => return Err(error),
                _ => std::thread::sleep(self.pause),
            }
        }
    }

    /// Removes all files but these and their parts.
    ///
    /// # Errors
    /// Fails if the folder cannot be read.
    pub fn keep(&self, kept: &BTreeSet<FileDigest>) -> Result<()> {
        let folder = &self.folder;
        for entry in fs::read_dir(folder).map_err(at(folder))?.flatten() {
            let name = entry.file_name();
            let digest = name.to_str().and_then(|name| name.split('.').next());
            let digest = digest.and_then(|digest| digest.parse().ok());
            if digest.is_none_or(|digest| !kept.contains(&digest)) {
                fs::remove_file(entry.path()).map_err(at(folder))?;
            }
        }
        Ok(())
    }
}
