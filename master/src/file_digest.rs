//! Identifies what a machine runs by the contents of its files (SHA-256).

use std::fmt;
use std::path::{Path, PathBuf};

use sha2::{Digest as _, Sha256};

/// A SHA-256 digest; shown as 64 hexadecimal digits.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct FileDigest([u8; 32]);

impl FileDigest {
    #[must_use]
    pub fn of(bytes: &[u8]) -> Self {
        Self(Sha256::digest(bytes).into())
    }

    /// Returns the digest of a machine file and the files that it names: of the contents of all,
    /// and the names of the others without their folders.
    #[must_use]
    pub fn of_machine(machine: &UsedFile, others: &[UsedFile]) -> Self {
        let named = |file: &UsedFile| {
            let name = file.path.file_name().unwrap_or_default();
            (Self::of(name.as_encoded_bytes()), file.sha256)
        };
        let mut others: Vec<_> = others.iter().map(named).collect();
        others.sort_unstable();
        let mut all = Sha256::new_with_prefix(machine.sha256.0);
        for (Self(name), Self(contents)) in others {
            all.update(name);
            all.update(contents);
        }
        Self(all.finalize().into())
    }
}

impl fmt::Display for FileDigest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl fmt::Debug for FileDigest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

/// A file that was read.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UsedFile {
    pub path: PathBuf,
    pub sha256: FileDigest,
    /// The trusted key of a verified signature, with its name.
    pub signed_by: Option<String>,
}

impl UsedFile {
    #[must_use]
    pub fn new(path: &Path, bytes: &[u8]) -> Self {
        Self {
            path: path.to_owned(),
            sha256: FileDigest::of(bytes),
            signed_by: None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn digest_depends_on_contents_and_names_not_on_folders() {
        // FIPS 180-4, the example of one block.
        let abc = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
        assert_eq!(FileDigest::of(b"abc").to_string(), abc);
        let file = |path: &str, text: &str| UsedFile::new(Path::new(path), text.as_bytes());
        let of = |machine: &str, others: [(&str, &str); 2]| {
            let others = others.map(|(path, text)| file(path, text));
            FileDigest::of_machine(&file(machine, "m"), &others)
        };
        let here = of("a/m.toml", [("a/d.xml", "1"), ("a/e.xml", "2")]);
        assert_eq!(here, of("b/n.toml", [("c/e.xml", "2"), ("d.xml", "1")]));
        assert_ne!(here, of("a/m.toml", [("a/d.xml", "1"), ("a/e.xml", "3")]));
        assert_ne!(here, of("a/m.toml", [("a/d.xml", "2"), ("a/e.xml", "1")]));
    }
}
