//! A bundle on disk: a folder with `manifest.json`, its signature, and the files under their digests.

use std::fs;
use std::path::{Component, Path, PathBuf};
use std::time::Duration;

use serde::Deserialize;

use super::digest::FileDigest;
use super::files::{self, at};
use super::manifest::{BundleFile, BundlePath, MAX_FILE, MAX_MANIFEST, Manifest};
use super::program;
use super::signing::{MAX_SIGNATURE, Signer};
use crate::error::{Error, Result};
use crate::keys::MachineId;

/// The name of the manifest in the folder of a bundle.
pub const MANIFEST: &str = "manifest.json";
const FILES: &str = "files";
const CHECK: Duration = Duration::from_secs(60);

/// What `ecaxis check --json` prints.
#[derive(Debug, Deserialize)]
pub struct Checked {
    pub sha256: FileDigest,
    files: Vec<CheckedFile>,
}

#[derive(Debug, Deserialize)]
struct CheckedFile {
    file: PathBuf,
    sha256: FileDigest,
}

/// Runs `ecaxis check`.
///
/// # Errors
/// Fails with the first problem of the machine file or its ESI files.
pub fn check(ecaxis: &str, machine_file: &Path) -> Result<Checked> {
    let file = machine_file.display().to_string();
    let words = [ecaxis, "check", "--json", &file].map(str::to_owned);
    let output = program::run(&words, CHECK, &mut || Ok(()))?;
    if !output.ok {
        return Err(Error::new(format!(
            "`ecaxis check` refuses it: {}",
            output.reason()
        )));
    }
    serde_json::from_str(&output.stdout)
        .map_err(|e| Error::new(format!("`ecaxis check --json` printed something else: {e}")))
}

/// Makes the bundle of a machine file in a new folder, and signs it if there is a key.
///
/// # Errors
/// Fails if the machine file has a problem, or a file cannot be read or written.
pub fn make(
    ecaxis: &str,
    machine: MachineId,
    machine_file: &Path,
    folder: &Path,
    time: u64,
    signer: Option<&Signer>,
) -> Result<Manifest> {
    let checked = check(ecaxis, machine_file)?;
    let version = program::run(
        &[ecaxis.to_owned(), "--version".to_owned()],
        CHECK,
        &mut || Ok(()),
    )?;
    let machine_file = fs::canonicalize(machine_file).map_err(at(machine_file))?;
    let mut sources = Vec::new();
    for file in &checked.files {
        let path = fs::canonicalize(&file.file).map_err(at(&file.file))?;
        let bytes = files::read(&path, MAX_FILE)?;
        if FileDigest::of(&bytes) != file.sha256 {
            return Err(Error::new(format!("{} changes", path.display())).help("make it again"));
        }
        let signature = super::signature_path(&path);
        if !sources.iter().any(|(known, _)| *known == path) {
            sources.push((path, bytes));
            if signature.exists() {
                let bytes = files::read(&signature, MAX_SIGNATURE as u64)?;
                sources.push((signature, bytes));
            }
        }
    }
    let root = common_folder(
        &machine_file,
        sources.iter().map(|(path, _)| path.as_path()),
    );
    let relative = |path: &Path| {
        let below = path.strip_prefix(&root).unwrap_or(path);
        let text = below
            .to_str()
            .ok_or_else(|| Error::new("a file name is not UTF-8"))?;
        BundlePath::try_from(text.to_owned()).map_err(Error::new)
    };
    let listed = sources.iter().map(|(path, bytes)| {
        Ok(BundleFile {
            path: relative(path)?,
            sha256: FileDigest::of(bytes),
            size: bytes.len() as u64,
        })
    });
    let listed = listed.collect::<Result<Vec<_>>>()?;
    let version = version.stdout.trim().replace("ecaxis ", "");
    let main = relative(&machine_file)?;
    let manifest = Manifest::new(machine, main, checked.sha256, time, version, listed)?;
    fs::create_dir(folder).map_err(at(folder))?;
    let kept = folder.join(FILES);
    fs::create_dir(&kept).map_err(at(&kept))?;
    for (_, bytes) in &sources {
        files::write(&kept.join(FileDigest::of(bytes).to_string()), bytes)?;
    }
    files::write(&folder.join(MANIFEST), &manifest.emit())?;
    if let Some(signer) = signer {
        sign(folder, time, signer)?;
    }
    Ok(manifest)
}

/// Returns the folder that has all files.
fn common_folder<'a>(machine_file: &Path, paths: impl Iterator<Item = &'a Path>) -> PathBuf {
    let first = machine_file.parent().unwrap_or(machine_file).to_owned();
    paths.fold(first, |common, path| {
        let both = common.components().zip(path.components());
        let same = both.take_while(|(a, b)| a == b).map(|(a, _)| a);
        same.collect::<Vec<Component<'_>>>().iter().collect()
    })
}

/// Signs the manifest of a bundle.
///
/// # Errors
/// Fails if the manifest cannot be read, or the signature not be written.
pub fn sign(folder: &Path, time: u64, signer: &Signer) -> Result<()> {
    let path = folder.join(MANIFEST);
    let text = files::read(&path, MAX_MANIFEST)?;
    Manifest::parse(&text)?;
    let signature = signer.sign(&text, MANIFEST, time)?;
    files::write(&super::signature_path(&path), signature.as_bytes())
}

/// A bundle that was read from its folder.
#[derive(Debug)]
pub struct Bundle {
    pub text: Vec<u8>,
    pub manifest: Manifest,
    pub signature: String,
    folder: PathBuf,
}

impl Bundle {
    /// Reads manifest and signature.
    ///
    /// # Errors
    /// Fails if one is missing or damaged.
    pub fn open(folder: &Path) -> Result<Self> {
        let path = folder.join(MANIFEST);
        let text = files::read(&path, MAX_MANIFEST)?;
        let manifest = Manifest::parse(&text)?;
        let path = super::signature_path(&path);
        let signature = files::read(&path, MAX_SIGNATURE as u64)
            .map_err(|e| e.help("sign it: `ecaxis-fleet bundle sign`, or `minisign -Sm`"))?;
        let signature = String::from_utf8(signature)
            .map_err(|_| Error::new(format!("{}: not a text", path.display())))?;
        Ok(Self {
            text,
            manifest,
            signature,
            folder: folder.to_owned(),
        })
    }

    /// Reads all files and checks their digests.
    ///
    /// # Errors
    /// Fails if a file is missing or changed.
    pub fn contents(&self) -> Result<Vec<Vec<u8>>> {
        let read = |file: &BundleFile| {
            let path = self.folder.join(FILES).join(file.sha256.to_string());
            let bytes = files::read(&path, file.size)?;
            match FileDigest::of(&bytes) == file.sha256 {
                true => Ok(bytes),
                false => Err(Error::new(format!("the file `{}` was changed", file.path))),
            }
        };
        self.manifest.files.iter().map(read).collect()
    }
}
