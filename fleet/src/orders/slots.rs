//! The two slots of a machine: `current` and `previous`, links to the folders of unpacked bundles.

use std::collections::BTreeSet;
use std::fs;
use std::io::{ErrorKind, Write};
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::digest::FileDigest;
use super::files::{self, at};
use super::manifest::{MAX_MANIFEST, Manifest};
use super::signing::MAX_SIGNATURE;
use crate::error::{Error, Result};

const CURRENT: &str = "current";
const PREVIOUS: &str = "previous";
const JOURNAL: &str = "switch.json";

/// A switch that is not yet confirmed. It is on disk before the links change.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Switch {
    pub to: FileDigest,
    /// The slots before.
    pub current: Option<FileDigest>,
    pub previous: Option<FileDigest>,
    pub sender: String,
    /// The nonce of its order.
    #[serde(default)]
    pub nonce: Option<String>,
}

/// A bundle of a slot.
#[derive(Debug, Clone)]
pub struct Unpacked {
    pub id: FileDigest,
    pub text: Vec<u8>,
    pub signature: String,
    pub manifest: Manifest,
}

/// The folder of the slots.
#[derive(Debug, Clone)]
pub struct Slots {
    folder: PathBuf,
}

impl Slots {
    /// Opens the folder, which it creates.
    ///
    /// # Errors
    /// Fails if the folder cannot be created.
    pub fn open(folder: &Path) -> Result<Self> {
        fs::create_dir_all(folder).map_err(at(folder))?;
        let folder = folder.to_owned();
        Ok(Self { folder })
    }

    #[must_use]
    pub fn current(&self) -> Option<FileDigest> {
        self.target(CURRENT)
    }

    #[must_use]
    pub fn previous(&self) -> Option<FileDigest> {
        self.target(PREVIOUS)
    }

    fn target(&self, link: &str) -> Option<FileDigest> {
        let target = fs::read_link(self.folder.join(link)).ok()?;
        target.to_str()?.parse().ok()
    }

    /// Returns the folder of an unpacked bundle.
    #[must_use]
    pub fn path(&self, id: FileDigest) -> PathBuf {
        self.folder.join(id.to_string())
    }

    fn manifest_path(&self, id: FileDigest) -> PathBuf {
        self.folder.join(format!("{id}.json"))
    }

    /// Reads manifest and signature of an unpacked bundle.
    ///
    /// # Errors
    /// Fails if they were changed.
    pub fn unpacked(&self, id: FileDigest) -> Result<Unpacked> {
        let path = self.manifest_path(id);
        let text = files::read(&path, MAX_MANIFEST)?;
        if FileDigest::of(&text) != id {
            return Err(Error::new(format!("{} was changed", path.display())));
        }
        let signature = files::read(&super::signature_path(&path), MAX_SIGNATURE as u64)?;
        Ok(Unpacked {
            id,
            manifest: Manifest::parse(&text)?,
            text,
            signature: String::from_utf8_lossy(&signature).into_owned(),
        })
    }

    /// Unpacks a bundle; a slot in use stays as it is.
    ///
    /// # Errors
    /// Fails if a file cannot be written.
    pub fn unpack(&self, bundle: &Unpacked, contents: &[Vec<u8>]) -> Result<PathBuf> {
        let path = self.path(bundle.id);
        if self.current() == Some(bundle.id) || self.previous() == Some(bundle.id) {
            return Ok(path);
        }
        self.remove(bundle.id)?;
        let new = self.folder.join("new");
        if new.exists() {
            fs::remove_dir_all(&new).map_err(at(&new))?;
        }
        for (file, bytes) in bundle.manifest.files.iter().zip(contents) {
            let path = new.join(file.path.as_path());
            let folder = path.parent().unwrap_or(&new);
            fs::create_dir_all(folder).map_err(at(folder))?;
            let mut output = fs::File::create(&path).map_err(at(&path))?;
            let written = output.write_all(bytes).and_then(|()| output.sync_all());
            written.map_err(at(&path))?;
            for entry in path.ancestors().take_while(|entry| *entry != new) {
                files::sync_folder(entry).map_err(at(entry))?;
            }
        }
        let manifest = self.manifest_path(bundle.id);
        files::write(&manifest, &bundle.text)?;
        files::write(
            &super::signature_path(&manifest),
            bundle.signature.as_bytes(),
        )?;
        fs::rename(&new, &path).map_err(at(&path))?;
        files::sync_folder(&path).map_err(at(&path))?;
        Ok(path)
    }

    /// Returns the switch that is not yet confirmed.
    ///
    /// # Errors
    /// Fails if its file is damaged.
    pub fn pending(&self) -> Result<Option<Switch>> {
        let path = self.folder.join(JOURNAL);
        if !path.exists() {
            return Ok(None);
        }
        let text = files::read(&path, MAX_MANIFEST)?;
        let switch = serde_json::from_slice(&text);
        switch
            .map(Some)
            .map_err(|e| Error::new(format!("{}: {e}", path.display())))
    }

    /// Makes a bundle the current one. The switch is pending until it is confirmed or undone.
    ///
    /// # Errors
    /// Fails if a link cannot be written.
    pub fn switch(&self, switch: &Switch) -> Result<()> {
        let text = serde_json::to_vec(switch).unwrap_or_default();
        files::write(&self.folder.join(JOURNAL), &text)?;
        self.link(PREVIOUS, switch.current)?;
        self.link(CURRENT, Some(switch.to))
    }

    /// Goes back to the slots before a switch.
    ///
    /// # Errors
    /// Fails if a link cannot be written.
    pub fn undo(&self, switch: &Switch) -> Result<()> {
        self.link(CURRENT, switch.current)?;
        self.link(PREVIOUS, switch.previous)
    }

    /// Ends a switch.
    ///
    /// # Errors
    /// Fails if its file cannot be removed.
    pub fn confirm(&self) -> Result<()> {
        let journal = self.folder.join(JOURNAL);
        if journal.exists() {
            fs::remove_file(&journal).map_err(at(&journal))?;
            // A loss of power must not revive the switch.
            files::sync_folder(&journal).map_err(at(&journal))?;
        }
        Ok(())
    }

    /// Removes the bundles that no slot has. Returns the files in use; `None` during a switch,
    /// which removes nothing.
    ///
    /// # Errors
    /// Fails if a file cannot be removed.
    pub fn clean(&self) -> Result<Option<BTreeSet<FileDigest>>> {
        if self.pending()?.is_some() {
            return Ok(None);
        }
        for link in [CURRENT, PREVIOUS] {
            let path = self.folder.join(link);
            let absent =
                fs::symlink_metadata(&path).is_err_and(|e| e.kind() == ErrorKind::NotFound);
            if !absent && self.target(link).is_none() {
                let what = format!("{} is not a link to the digest of a bundle", path.display());
                return Err(Error::new(what).help("restore the link; nothing was removed"));
            }
        }
        let used = [self.current(), self.previous()];
        let entries = fs::read_dir(&self.folder).map_err(at(&self.folder))?;
        for entry in entries.flatten() {
            let name = entry.file_name();
            // Also a manifest whose bundle was not unpacked to its end.
            let id = name.to_str().and_then(|name| name.split('.').next());
            let id = id.and_then(|id| id.parse().ok());
            if let Some(id) = id.filter(|id| !used.contains(&Some(*id))) {
                self.remove(id)?;
            }
        }
        let kept = used
            .into_iter()
            .flatten()
            .filter_map(|id| self.unpacked(id).ok());
        let files = kept.flat_map(|unpacked| unpacked.manifest.files);
        Ok(Some(files.map(|file| file.sha256).collect()))
    }

    /// Removes an unpacked bundle.
    fn remove(&self, id: FileDigest) -> Result<()> {
        let (path, manifest) = (self.path(id), self.manifest_path(id));
        if path.exists() {
            fs::remove_dir_all(&path).map_err(at(&path))?;
        }
        for file in [super::signature_path(&manifest), manifest] {
            if file.exists() {
                fs::remove_file(&file).map_err(at(&file))?;
            }
        }
        Ok(())
    }

    fn link(&self, name: &str, target: Option<FileDigest>) -> Result<()> {
        let path = self.folder.join(name);
        let new = self.folder.join("link.new");
        let done = (|| {
            let _ = fs::remove_file(&new);
            match target {
                Some(id) => {
                    symlink(id.to_string(), &new)?;
                    fs::rename(&new, &path)?;
                }
                None if path.is_symlink() => fs::remove_file(&path)?,
                None => {}
            }
            files::sync_folder(&path)
        })();
        done.map_err(at(&path))
    }
}
