//! Signatures of files (minisign), and the policy that says whose signatures count and which files
//! need one. A file is verified by the bytes that are then parsed, not by another read.

use std::fmt;
use std::io;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};

use minisign_verify::{Error as MinisignError, PublicKey, Signature};
use serde::Deserialize;

use crate::file;
use crate::file_digest::UsedFile;

/// The environment variable with the path of the policy.
pub const VARIABLE: &str = "ECAXIS_POLICY";
/// The policy without that variable, if the file exists.
const DEFAULT: &str = "/etc/ecaxis/policy.toml";
/// The maximum lengths of a policy and of a signature in bytes.
const MAX_POLICY_BYTES: u64 = 1 << 20;
const MAX_SIGNATURE_BYTES: u64 = 16 << 10;

/// The files that a policy distinguishes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SignedKind {
    /// The machine file.
    Machine,
    /// ESI files, and EEPROM images and EDS files that a machine file names.
    Esi,
    /// Set-point tables that a machine file names.
    Tables,
    /// Programs of devices.
    Firmware,
    /// Parameter files that a machine file names.
    Parameters,
}

impl fmt::Display for SignedKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Machine => "machine files",
            Self::Esi => "ESI files",
            Self::Tables => "set-point tables",
            Self::Firmware => "firmware",
            Self::Parameters => "parameter files",
        })
    }
}

/// The trusted keys, and the files that need a signature. The default trusts no key, needs no
/// signature and looks at none.
#[derive(Debug, Clone, Default)]
pub struct SignaturePolicy {
    keys: Vec<TrustedKey>,
    require: Vec<SignedKind>,
    not_before: Option<u64>,
}

#[derive(Debug, Clone)]
struct TrustedKey {
    /// The name in the policy, and the key ID as minisign prints it.
    shown: String,
    key: PublicKey,
}

/// The policy as written.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawPolicy {
    #[serde(default)]
    require: Vec<SignedKind>,
    not_before: Option<u64>,
    #[serde(default)]
    key: Vec<RawKey>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawKey {
    name: String,
    public: String,
}

/// The policy cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("cannot use the policy {}: {why}", path.display())]
pub struct PolicyError {
    pub path: PathBuf,
    pub why: String,
}

/// The reason why a file is refused.
#[derive(Debug, thiserror::Error)]
#[error("{} {why}", path.display())]
pub struct SignatureError {
    pub path: PathBuf,
    pub why: Refusal,
}

/// What is wrong with the signature of a file. The file is the subject of each text.
#[derive(Debug, thiserror::Error)]
pub enum Refusal {
    #[error("has no signature, and the policy requires one of {0}")]
    Missing(SignedKind),
    #[error("has a signature that cannot be read: {0}")]
    Unreadable(io::Error),
    #[error("has a damaged signature: its .minisig file is not from minisign")]
    Damaged,
    #[error("has a signature of the old format")]
    OldFormat,
    #[error("has a signature by the key {0}, which the policy does not list")]
    UnknownKey(String),
    #[error(
        "differs from what was signed: the file, the signature or its trusted comment was changed"
    )]
    Changed,
    #[error("has the signature of another file, `{0}`")]
    OtherFile(String),
    #[error("has a signature from before `not_before` of the policy, or without a time")]
    TooOld,
}

impl SignatureError {
    /// Returns what the user can do.
    #[must_use]
    pub fn hint(&self) -> &'static str {
        match self.why {
            Refusal::Missing(_) | Refusal::OldFormat => {
                "sign it with `minisign -Sm FILE` and a key that the policy lists"
            }
            Refusal::Unreadable(_) => "look at the permissions of the .minisig file",
            Refusal::Damaged => "copy file and signature again from where they were signed",
            Refusal::UnknownKey(_) => {
                "sign it with a key that the policy lists, or add the public key to the policy"
            }
            Refusal::Changed => {
                "restore file and signature, or check what has changed and sign the file again"
            }
            Refusal::OtherFile(_) => "restore the file of this name, or sign this one",
            Refusal::TooOld => "use the current file, or check this one and sign it again",
        }
    }
}

impl SignaturePolicy {
    /// Returns the policy that the environment names, or the default one if its file exists.
    ///
    /// # Errors
    /// Fails if the policy cannot be used: then no file may be.
    pub fn of_environment() -> Result<Self, PolicyError> {
        match std::env::var_os(VARIABLE) {
            Some(path) if path.is_empty() => Ok(Self::default()),
            Some(path) => Self::load(Path::new(&path)),
            None => match std::fs::symlink_metadata(DEFAULT) {
                Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(Self::default()),
                _ => Self::load(Path::new(DEFAULT)),
            },
        }
    }

    /// Reads a policy.
    ///
    /// # Errors
    /// Fails if the file cannot be read, if others may write to it, or if it is not a policy.
    pub fn load(path: &Path) -> Result<Self, PolicyError> {
        let failed = |why: String| PolicyError {
            path: path.to_owned(),
            why,
        };
        let text = file::read_text(path, MAX_POLICY_BYTES).map_err(|e| failed(e.to_string()))?;
        let mode = std::fs::metadata(path).map_err(|e| failed(e.to_string()))?;
        if mode.permissions().mode() & 0o022 != 0 {
            return Err(failed("its group or all users may write to it".to_owned()));
        }
        Self::parse(&text).map_err(failed)
    }

    fn parse(text: &str) -> Result<Self, String> {
        let raw: RawPolicy = toml::from_str(text).map_err(|e| e.to_string().trim().to_owned())?;
        let keys = raw.key.into_iter().map(|RawKey { name, public }| {
            let public = public.trim();
            let key = PublicKey::from_base64(public)
                .map_err(|_| format!("the key `{name}` is not a public key of minisign"))?;
            let shown = format!("{name} ({})", key_id(public));
            Ok(TrustedKey { shown, key })
        });
        let keys = keys.collect::<Result<Vec<_>, String>>()?;
        if keys.is_empty() && !raw.require.is_empty() {
            return Err("`require` needs a [[key]]".to_owned());
        }
        Ok(Self {
            keys,
            require: raw.require,
            not_before: raw.not_before,
        })
    }

    /// Verifies the bytes of a file with the signature next to it, `FILE.minisig`. Without trusted
    /// keys, signatures are not looked at.
    ///
    /// # Errors
    /// Fails if the signature is wrong, or is missing where the policy requires one.
    pub fn verify(
        &self,
        kind: SignedKind,
        path: &Path,
        bytes: &[u8],
    ) -> Result<UsedFile, SignatureError> {
        let signed_by = self.signer(kind, path, bytes);
        let signed_by = signed_by.map_err(|why| SignatureError {
            path: path.to_owned(),
            why,
        })?;
        Ok(UsedFile {
            signed_by,
            ..UsedFile::new(path, bytes)
        })
    }

    fn signer(
        &self,
        kind: SignedKind,
        path: &Path,
        bytes: &[u8],
    ) -> Result<Option<String>, Refusal> {
        if self.keys.is_empty() {
            return Ok(None);
        }
        let mut signature_path = path.as_os_str().to_owned();
        signature_path.push(".minisig");
        let text = match file::read_text(Path::new(&signature_path), MAX_SIGNATURE_BYTES) {
            Ok(text) => text,
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                return match self.require.contains(&kind) {
                    true => Err(Refusal::Missing(kind)),
                    false => Ok(None),
                };
            }
            Err(error) if error.kind() == io::ErrorKind::InvalidData => {
                return Err(Refusal::Damaged);
            }
            Err(error) => return Err(Refusal::Unreadable(error)),
        };
        let signature = Signature::decode(&text).map_err(|_| Refusal::Damaged)?;
        let key = self.keys.iter().find_map(|trusted| {
            match trusted.key.verify(bytes, &signature, false) {
                Err(MinisignError::UnexpectedKeyId) => None,
                Err(MinisignError::UnexpectedAlgorithm) => Some(Err(Refusal::OldFormat)),
                Err(_) => Some(Err(Refusal::Changed)),
                Ok(()) => Some(Ok(&trusted.shown)),
            }
        });
        let id = || key_id(text.lines().nth(1).unwrap_or_default());
        let key = key.unwrap_or_else(|| Err(Refusal::UnknownKey(id())))?;
        self.check_comment(signature.trusted_comment(), path)?;
        Ok(Some(key.clone()))
    }

    /// Checks what minisign writes into a trusted comment: `timestamp:…\tfile:…`. A comment of the
    /// user's own may lack the file.
    fn check_comment(&self, comment: &str, path: &Path) -> Result<(), Refusal> {
        let value = |key: &str| comment.split('\t').find_map(|part| part.strip_prefix(key));
        if let Some(name) = value("file:")
            && path.file_name() != Some(name.as_ref())
        {
            return Err(Refusal::OtherFile(name.to_owned()));
        }
        let time = value("timestamp:").and_then(|time| time.parse::<u64>().ok());
        match self.not_before {
            Some(earliest) if time.is_none_or(|time| time < earliest) => Err(Refusal::TooOld),
            _ => Ok(()),
        }
    }
}

/// Returns the key ID of a public key or signature in base64, as minisign prints it: bytes 2 to 9,
/// the most significant last.
fn key_id(base64: &str) -> String {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut bits = 0_u128;
    for byte in base64.bytes().chain(std::iter::repeat(b'A')).take(14) {
        let digit = DIGITS.iter().position(|digit| *digit == byte);
        bits = bits << 6 | digit.unwrap_or(0) as u128;
    }
    // 14 digits are 84 bits: the 10 bytes and 4 bits more.
    let bytes = (bits << (128 - 84)).to_be_bytes();
    let id = bytes.into_iter().skip(2).take(8).rev();
    id.map(|byte| format!("{byte:02X}")).collect()
}

/// The files that were read for a machine, each verified before its content counts.
#[derive(Debug)]
pub struct VerifiedFiles<'p> {
    policy: &'p SignaturePolicy,
    pub files: Vec<UsedFile>,
}

impl<'p> VerifiedFiles<'p> {
    #[must_use]
    pub fn new(policy: &'p SignaturePolicy) -> Self {
        Self {
            policy,
            files: Vec::new(),
        }
    }

    /// Verifies a file by the bytes that the caller has read, and adds it.
    ///
    /// # Errors
    /// Fails like [`SignaturePolicy::verify`].
    pub fn add(
        &mut self,
        kind: SignedKind,
        path: &Path,
        bytes: &[u8],
    ) -> Result<(), SignatureError> {
        let file = self.policy.verify(kind, path, bytes)?;
        self.files.push(file);
        Ok(())
    }
}

#[cfg(test)]
mod tests;
