//! Parameter files: TOML with one line per object.
//!
//! ```toml
//! format = 2
//!
//! [device]
//! name = "EPOS4"
//! vendor = 0x000000fb
//!
//! [parameters]
//! "0x6065:00" = { name = "Following error window", type = "UDINT", access = "rw", value = 2000 }
//! ```

use std::collections::BTreeMap;

use ecaxis_esi::{Address, Identity};
use serde::Deserialize;

use super::{DataType, Parameter};
use crate::mailbox::NamedObject;
use crate::text::quoted;

/// The device of the parameters.
#[derive(Debug, Clone, Default, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Origin {
    pub name: String,
    pub vendor: u32,
    pub product: u32,
    pub revision: u32,
    #[serde(default)]
    pub serial: u32,
}

impl Origin {
    #[must_use]
    pub fn identity(&self) -> Identity {
        Identity {
            vendor: self.vendor,
            product: self.product,
            revision: self.revision,
        }
    }
}

#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Dump {
    pub device: Origin,
    /// Sorted by index and subindex.
    pub parameters: Vec<Parameter>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Raw {
    #[serde(default = "first_format")]
    format: u32,
    device: Origin,
    parameters: BTreeMap<String, Line>,
}

/// The format number. Subindices are hexadecimal; they were decimal in files without a format
/// number.
const FORMAT: u32 = 2;

fn first_format() -> u32 {
    1
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Line {
    #[serde(default)]
    name: String,
    #[serde(rename = "type")]
    data_type: String,
    #[serde(default)]
    access: String,
    value: toml::Value,
}

/// The access of objects that a restore may write.
const READ_WRITE: &str = "rw";
const READ_ONLY: &str = "ro";

/// An error in a file. The message is complete except for the file name.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DumpError {
    #[error("{0}")]
    Toml(String),
    #[error("format {0} is not known, only those up to {FORMAT}")]
    Format(u32),
    #[error("[parameters] \"{0}\": not an object, such as \"0x6065:00\"")]
    Address(String),
    #[error("[parameters] \"{key}\": unknown type `{name}`")]
    Type { key: String, name: String },
    #[error("[parameters] \"{key}\": access is \"ro\" or \"rw\", not \"{access}\"")]
    Access { key: String, access: String },
    #[error("[parameters] \"{key}\": {source}")]
    Value {
        key: String,
        source: super::ValueError,
    },
    #[error("[parameters] \"{0}\": a value is a number, a text, true or false")]
    NoValue(String),
}

impl Dump {
    /// Formats the file.
    #[must_use]
    pub fn to_toml(&self) -> String {
        let Origin {
            name,
            vendor,
            product,
            revision,
            serial,
        } = &self.device;
        let mut text = format!(
            "# Parameters of a device, by `ecaxis sdo dump`. `ecaxis sdo restore` writes back those with access \"rw\".\n\nformat = {FORMAT}\n\n[device]\nname = {}\nvendor = {vendor:#010x}\nproduct = {product:#010x}\nrevision = {revision:#010x}\nserial = {serial}\n\n[parameters]\n",
            quoted(name),
        );
        for parameter in &self.parameters {
            let comment = parameter.meaning();
            let comment = comment.map_or(String::new(), |text| format!(" # {text}"));
            text += &format!(
                "\"{}\" = {{ name = {}, type = {}, access = \"{}\", value = {} }}{comment}\n",
                parameter.at.number(),
                quoted(&parameter.name),
                quoted(&parameter.data_type.to_string()),
                if parameter.writable {
                    READ_WRITE
                } else {
                    READ_ONLY
                },
                value(parameter),
            );
        }
        text
    }

    /// Parses a file.
    ///
    /// # Errors
    /// [`DumpError`].
    pub fn parse(text: &str) -> Result<Self, DumpError> {
        let raw: Raw = toml::from_str(text).map_err(|error| DumpError::Toml(error.to_string()))?;
        let mut parameters = Vec::with_capacity(raw.parameters.len());
        let format = raw.format;
        if !(1..=FORMAT).contains(&format) {
            return Err(DumpError::Format(format));
        }
        for (key, line) in raw.parameters {
            parameters.push(line.parameter(key, format)?);
        }
        parameters.sort_by_key(|p| (p.at.index, p.at.sub));
        Ok(Self {
            device: raw.device,
            parameters,
        })
    }
}

impl Line {
    fn parameter(self, key: String, format: u32) -> Result<Parameter, DumpError> {
        let Some(at) = place(&key, format) else {
            return Err(DumpError::Address(key));
        };
        let Some(data_type) = DataType::named(&self.data_type, 0) else {
            let name = self.data_type;
            return Err(DumpError::Type { key, name });
        };
        let writable = match self.access.as_str() {
            READ_WRITE => true,
            READ_ONLY | "" => false,
            _ => {
                let access = self.access;
                return Err(DumpError::Access { key, access });
            }
        };
        let written = match self.value {
            toml::Value::String(text) => text,
            toml::Value::Integer(n) => n.to_string(),
            toml::Value::Float(x) => x.to_string(),
            toml::Value::Boolean(b) => b.to_string(),
            _ => return Err(DumpError::NoValue(key)),
        };
        match data_type.read(&written) {
            Ok(value) => Ok(Parameter {
                at,
                name: self.name,
                data_type,
                writable,
                value,
            }),
            Err(source) => Err(DumpError::Value { key, source }),
        }
    }
}

fn place(key: &str, format: u32) -> Option<NamedObject> {
    let (index, sub) = key.split_once(':')?;
    let hexadecimal = sub.starts_with("0x") || sub.starts_with("0X");
    let sub = match format {
        1 if !hexadecimal => sub.parse().ok()?,
        _ => Address::sub_of(sub)?,
    };
    // A name instead of a number would match a standard object.
    let number = index.starts_with(|c: char| c.is_ascii_digit());
    let index = super::lookup::find(None, index).ok()?.index;
    number.then_some(NamedObject { index, sub })
}

/// Formats numbers and booleans as TOML values, everything else as text.
fn value(parameter: &Parameter) -> String {
    let shown = parameter.shown();
    let bare = match parameter.data_type.kind {
        super::Kind::Unsigned | super::Kind::Signed => {
            shown.parse::<i64>().is_ok() || matches!(shown.as_str(), "true" | "false")
        }
        super::Kind::Real => {
            let plain = shown.contains('.') && !shown.contains('e');
            plain || matches!(shown.as_str(), "inf" | "-inf" | "nan")
        }
        _ => false,
    };
    if bare { shown } else { quoted(&shown) }
}
