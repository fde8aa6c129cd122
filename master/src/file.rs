//! Reads whole files. A name may lead to an endless device or to a pipe without a writer. Therefore
//! only regular files are read, up to a size that the caller sets.

use std::fs::File;
use std::io::{Error, ErrorKind, Read, Result};
use std::path::Path;

/// Reads a regular file of at most `max_bytes` bytes.
///
/// # Errors
/// Fails if the file cannot be read, is not a regular file, or is longer.
pub fn read(path: &Path, max_bytes: u64) -> Result<Vec<u8>> {
    // Checked before opening: opening a pipe waits for its writer.
    let metadata = std::fs::metadata(path)?;
    if metadata.is_dir() {
        return Err(ErrorKind::IsADirectory.into());
    }
    if !metadata.is_file() {
        return Err(Error::new(ErrorKind::InvalidInput, "not a regular file"));
    }
    let mut bytes = Vec::new();
    // The length may have changed since, and files in /proc report 0.
    let taken = File::open(path)?.take(max_bytes.saturating_add(1));
    let read = { taken }.read_to_end(&mut bytes)?;
    if u64::try_from(read).is_ok_and(|read| read <= max_bytes) {
        return Ok(bytes);
    }
    let message = format!("longer than {max_bytes} bytes");
    Err(Error::new(ErrorKind::FileTooLarge, message))
}

/// Reads a UTF-8 text file of at most `max_bytes` bytes.
///
/// # Errors
/// Fails like [`read`], and if the bytes are not UTF-8.
pub fn read_text(path: &Path, max_bytes: u64) -> Result<String> {
    let bytes = read(path, max_bytes)?;
    String::from_utf8(bytes).map_err(|error| Error::new(ErrorKind::InvalidData, error))
}

/// Returns the reason why a file cannot be read.
pub(crate) fn unreadable(path: &Path, error: &Error) -> String {
    match error.kind() {
        ErrorKind::IsADirectory => format!("{} is a folder, not a file", path.display()),
        _ => format!("cannot read {}: {error}", path.display()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_regular_files_up_to_a_size_are_read() {
        let kind = |path: &str, max| read(Path::new(path), max).map_err(|error| error.kind());
        assert_eq!(kind("/dev/zero", 10), Err(ErrorKind::InvalidInput));
        assert_eq!(kind("/proc", 10), Err(ErrorKind::IsADirectory));
        assert_eq!(kind("/nothing/there", 10), Err(ErrorKind::NotFound));
        let this = concat!(env!("CARGO_MANIFEST_DIR"), "/src/file.rs");
        let len = std::fs::metadata(this).unwrap().len();
        assert_eq!(kind(this, len - 1), Err(ErrorKind::FileTooLarge));
        assert_eq!(kind(this, len).map(|bytes| bytes.len() as u64), Ok(len));
        // Its metadata report a length of 0.
        assert!(kind("/proc/self/stat", 1).is_err());
        assert!(kind("/proc/self/stat", 4096).is_ok_and(|bytes| !bytes.is_empty()));
    }
}
