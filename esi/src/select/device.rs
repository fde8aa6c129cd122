//! Finds a device in a file.

use std::fmt;

use super::SelectError;
use crate::model::{Device, EsiFile, Identity, Warning};

/// The known properties of a device; `None` matches every device.
#[derive(Debug, Clone, Copy, Default)]
pub struct DeviceQuery<'a> {
    /// `Type` or `Name` of the device, case-insensitive.
    pub name: Option<&'a str>,
    /// The product code; `None`: any.
    pub product: Option<u32>,
    /// The revision number; `None`: any.
    pub revision: Option<u32>,
}

impl fmt::Display for DeviceQuery<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut parts = Vec::new();
        if let Some(name) = self.name {
            parts.push(format!("{name:?}"));
        }
        if let Some(product) = self.product {
            parts.push(format!("product 0x{product:08x}"));
        }
        if let Some(revision) = self.revision {
            parts.push(format!("revision 0x{revision:08x}"));
        }
        if parts.is_empty() {
            parts.push("any device".to_owned());
        }
        f.write_str(&parts.join(", "))
    }
}

impl DeviceQuery<'_> {
    /// Returns `true` if a device of this identity, `Type` and `Name` matches.
    #[must_use]
    pub fn matches(&self, identity: Identity, type_name: &str, name: &str) -> bool {
        let is_named = |wanted: &str| {
            let wanted = wanted.trim();
            type_name.eq_ignore_ascii_case(wanted) || name.eq_ignore_ascii_case(wanted)
        };
        self.name.is_none_or(is_named)
            && self.product.is_none_or(|wanted| wanted == identity.product)
            && (self.revision).is_none_or(|wanted| wanted == identity.revision)
    }
}

/// Returns the device that matches `query`. If several revisions of one product match, returns the
/// newest.
pub fn find_device<'a>(
    file: &'a EsiFile,
    query: &DeviceQuery<'_>,
) -> Result<&'a Device, SelectError> {
    if file.devices.is_empty() && file.skipped.is_empty() {
        return Err(SelectError::NoDevices);
    }
    let is_wanted =
        |device: &&Device| query.matches(device.identity, &device.type_name, &device.name);
    let matching: Vec<&Device> = file.devices.iter().filter(is_wanted).collect();
    let Some(newest) = matching
        .iter()
        .copied()
        .max_by_key(|device| device.identity.revision)
    else {
        let available = list(file.headers());
        return Err(SelectError::NoSuchDevice {
            query: query.to_string(),
            available,
            unreadable: unreadable(file),
        });
    };
    if matching
        .iter()
        .any(|device| device.identity.product != newest.identity.product)
    {
        let available = list(
            matching
                .iter()
                .map(|d| (d.identity, &*d.type_name, &*d.name)),
        );
        return Err(SelectError::Ambiguous {
            query: query.to_string(),
            available,
        });
    }
    Ok(newest)
}

/// Returns the read errors that removed whole devices from the file.
fn unreadable(file: &EsiFile) -> String {
    let of = |warning: &Warning, device: &Device| {
        let rest = warning.path.strip_prefix(device.path.as_str());
        rest.is_some_and(|rest| rest.is_empty() || rest.starts_with('/'))
    };
    let lost = file.warnings.iter().filter(|warning| {
        warning.left_out
            && warning.path.contains("/Devices/Device[")
            && !file.devices.iter().any(|device| of(warning, device))
    });
    lost.map(|w| {
        format!(
            "; a device is left out, {} {}: {}",
            w.position, w.path, w.message
        )
    })
    .collect()
}

fn list<'a>(devices: impl Iterator<Item = (Identity, &'a str, &'a str)>) -> String {
    const SHOWN: usize = 12;
    let texts: Vec<String> = devices
        .map(|(id, type_name, name)| {
            format!(
                "{type_name} ({name}, product 0x{:08x} revision 0x{:08x})",
                id.product, id.revision
            )
        })
        .collect();
    let more = texts.len().saturating_sub(SHOWN);
    let mut text = texts.into_iter().take(SHOWN).collect::<Vec<_>>().join("; ");
    if more > 0 {
        text.push_str(&format!("; and {more} more"));
    }
    text
}
