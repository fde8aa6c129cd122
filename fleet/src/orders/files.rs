//! Files that are complete or absent.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::Path;

use crate::error::{Error, Result};

/// Returns an error with the path.
pub fn at(path: &Path) -> impl Fn(io::Error) -> Error + '_ {
    move |error| Error::new(format!("{}: {error}", path.display()))
}

/// Writes a file so that it is complete or absent, whenever the process ends.
///
/// # Errors
/// Fails if the file cannot be written.
pub fn write(path: &Path, bytes: &[u8]) -> Result<()> {
    let mut temporary = path.as_os_str().to_owned();
    temporary.push(".new");
    let temporary = std::path::PathBuf::from(temporary);
    let written = (|| {
        let mut file = File::create(&temporary)?;
        file.write_all(bytes)?;
        file.sync_all()?;
        fs::rename(&temporary, path)?;
        sync_folder(path)
    })();
    written.map_err(at(path))
}

/// Stores the entries of the folder that has this path.
///
/// # Errors
/// Fails if the folder cannot be opened.
pub fn sync_folder(path: &Path) -> io::Result<()> {
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty());
    File::open(folder.unwrap_or(Path::new(".")))?.sync_all()
}

/// Reads a file of at most `most` bytes.
///
/// # Errors
/// Fails if the file is longer or cannot be read.
pub fn read(path: &Path, most: u64) -> Result<Vec<u8>> {
    use io::Read;
    let mut bytes = Vec::new();
    let file = File::open(path).map_err(at(path))?;
    file.take(most + 1)
        .read_to_end(&mut bytes)
        .map_err(at(path))?;
    if bytes.len() as u64 > most {
        return Err(Error::new(format!(
            "{}: the file is longer than {most} bytes",
            path.display()
        )));
    }
    Ok(bytes)
}
