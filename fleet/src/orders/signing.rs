//! Signatures of orders and bundles, in the format of minisign.

use std::fmt;
use std::fs;
use std::path::Path;

use ct_codecs::{Base64, Decoder};
use minisign::{SecretKey, SecretKeyBox};
// `minisign` panics on a short signature; this crate refuses it.
use minisign_verify::{Error as VerifyError, PublicKey, Signature};
use serde::Deserialize;

use crate::error::{Error, Result};

/// The longest signature in bytes.
pub const MAX_SIGNATURE: usize = 16 << 10;
/// The longest file of a key in bytes.
const MAX_KEY: u64 = 16 << 10;
/// The bytes of a secret key that name the method of its password; zeros: it has none.
const KDF: std::ops::Range<usize> = 2..4;

/// What the holder of a key may do.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Right {
    /// Order a machine to start its program.
    Start,
    /// Order a machine to stop. [`Right::Start`] includes it.
    Stop,
    /// Order a machine to take a bundle, or to go back.
    Push,
    /// Order firmware and parameters.
    Update,
    /// Sign bundles.
    Bundle,
}

impl fmt::Display for Right {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Start => "start",
            Self::Stop => "stop",
            Self::Push => "push",
            Self::Update => "update",
            Self::Bundle => "bundle",
        })
    }
}

/// `[[key]]` of an agent's file.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KeyTable {
    /// The name of the sender in logs.
    pub name: String,
    /// The second line of minisign's file `*.pub`.
    pub public: String,
    pub rights: Vec<Right>,
}

/// A key that an agent trusts.
#[derive(Debug, Clone)]
pub struct TrustedKey {
    pub name: String,
    public: PublicKey,
    rights: Vec<Right>,
}

impl TrustedKey {
    /// Requires a right.
    ///
    /// # Errors
    /// Fails without it.
    pub fn require(&self, right: Right) -> Result<()> {
        let included = right == Right::Stop && self.rights.contains(&Right::Start);
        if included || self.rights.contains(&right) {
            return Ok(());
        }
        Err(Error::new(format!(
            "the key `{}` has no right `{right}` on this machine",
            self.name
        ))
        .help("`rights` in the file of the agent grants it"))
    }
}

/// The keys that an agent trusts.
#[derive(Debug, Clone, Default)]
pub struct Keyring(Vec<TrustedKey>);

impl Keyring {
    /// Reads the keys of an agent's file.
    ///
    /// # Errors
    /// Fails if a key is not one of minisign, or two are the same.
    pub fn new(tables: &[KeyTable]) -> Result<Self> {
        let read = |table: &KeyTable| {
            let public = PublicKey::from_base64(table.public.trim());
            let public = public.map_err(|_| {
                Error::new(format!("the key `{}` is not a public key", table.name))
                    .help("copy the second line of the file *.pub of minisign")
            })?;
            Ok(TrustedKey {
                name: table.name.clone(),
                public,
                rights: table.rights.clone(),
            })
        };
        for (n, table) in tables.iter().enumerate() {
            let same = |other: &&KeyTable| other.public.trim() == table.public.trim();
            if let Some(other) = tables[..n].iter().find(same) {
                let (a, b) = (&other.name, &table.name);
                return Err(Error::new(format!(
                    "`{a}` and `{b}` have the same public key"
                )));
            }
        }
        tables.iter().map(read).collect::<Result<_>>().map(Self)
    }

    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Verifies bytes and returns the key that signed them.
    ///
    /// # Errors
    /// Fails if the signature is damaged, by another key, or of other bytes.
    pub fn verify(&self, what: &str, bytes: &[u8], signature: &str) -> Result<&TrustedKey> {
        let damaged = || Error::new(format!("{what} has a damaged signature"));
        if signature.len() > MAX_SIGNATURE {
            return Err(damaged());
        }
        let decoded = Signature::decode(signature).map_err(|_| damaged())?;
        for key in &self.0 {
            let refused = match key.public.verify(bytes, &decoded, false) {
                Ok(()) => return Ok(key),
                Err(VerifyError::UnexpectedKeyId) => continue,
                Err(VerifyError::UnexpectedAlgorithm) => {
                    Error::new(format!("{what} has a signature of the old format"))
                        .help("sign it with minisign 0.10 or later, without `-l`")
                }
                Err(_) => Error::new(format!(
                    "{what} differs from what `{}` signed: wrong signature",
                    key.name
                ))
                .help("sign it again"),
            };
            return Err(refused);
        }
        Err(Error::new(format!(
            "{what} has a signature by a key that this machine does not list"
        ))
        .help("sign it with a key of the agent's file, or add the public key there"))
    }
}

/// A secret key of minisign.
pub struct Signer(SecretKey);

impl fmt::Debug for Signer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Signer")
    }
}

impl Signer {
    /// Reads the file of a secret key. Without a file, it asks for the password of an encrypted key.
    ///
    /// # Errors
    /// Fails if the file is not a secret key, or the password is wrong.
    pub fn load(path: &Path, password: Option<&Path>) -> Result<Self> {
        let text = read_text(path)?;
        let at = |e: minisign::PError| Error::new(format!("{}: {e}", path.display()));
        // `minisign -W` writes no checksum, which `into_unencrypted_secret_key` requires.
        let line = text.lines().nth(1).unwrap_or_default();
        let bytes = Base64::decode_to_vec(line.trim(), None).unwrap_or_default();
        if bytes.get(KDF) == Some(&[0, 0]) {
            return SecretKey::from_bytes(&bytes).map(Self).map_err(at);
        }
        let key = SecretKeyBox::from_string(&text).map_err(at)?;
        let password = password.map(read_text).transpose()?;
        let password = password.map(|text| text.trim_end_matches(['\r', '\n']).to_owned());
        key.into_secret_key(password).map(Self).map_err(at)
    }

    /// Signs bytes. The trusted comment has the name of the file.
    ///
    /// # Errors
    /// Fails if the system gives no random numbers.
    pub fn sign(&self, bytes: &[u8], name: &str, time: u64) -> Result<String> {
        let comment = format!("timestamp:{time}\tfile:{name}\thashed");
        let signature = minisign::sign(None, &self.0, bytes, Some(&comment), None);
        let failed = |e: minisign::PError| Error::new(format!("signing: {e}"));
        Ok(signature.map_err(failed)?.into_string())
    }
}

fn read_text(path: &Path) -> Result<String> {
    let at = |what: String| Error::new(format!("{}: {what}", path.display()));
    let size = fs::metadata(path).map_err(|e| at(e.to_string()))?.len();
    if size > MAX_KEY {
        return Err(at("the file is too long for a key".to_owned()));
    }
    fs::read_to_string(path).map_err(|e| at(e.to_string()))
}

#[cfg(test)]
impl From<SecretKey> for Signer {
    fn from(key: SecretKey) -> Self {
        Self(key)
    }
}
