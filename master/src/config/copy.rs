//! `[[copy]]`: inputs of a device that the cycle copies to outputs (ETG.1500, feature 1201:
//! communication between SubDevices through the MainDevice).

use std::ops::Range;

use ecaxis_ecat::index::{DeviceIndex, IndexVec};
use ecaxis_esi::layout::{Field, PdoLayout};

use toml::Spanned;

use super::fields::KeyExt;
use super::problem::Problems;
use super::raw::RawCopy;
use super::roles::{OutputOwner, OwnerKind, ProcessDataRoles};
use super::signal::{self, NameError, SignalDirection};
use super::steps::ResolvedDevice;
use super::{DeviceConfig, Signal};
use crate::rt::config::ProcessDataCopy;
use crate::text::pluralize;

/// Inputs that are copied to outputs in every cycle.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CopySetup {
    /// The inputs.
    pub from: BitRange,
    /// The outputs. Nothing else writes them.
    pub to: BitRange,
    /// `true` for the frames of a safety connection, which also reach a device that has returned.
    pub fsoe: bool,
    /// The line of its `[[copy]]` in the machine file.
    pub line: u32,
}

impl CopySetup {
    pub(super) fn rt(&self) -> ProcessDataCopy {
        ProcessDataCopy {
            from: (self.from.device, self.from.bits.start as usize),
            to: (self.to.device, self.to.bits.start as usize),
            bits: self.to.bits.len(),
        }
    }
}

/// Bits of the outputs or inputs of a device.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BitRange {
    pub device: DeviceIndex,
    /// The name with its device's name: `io.Input 3`, `io.pdo.0x1a00`, `io.bytes.4..10`.
    pub name: String,
    /// The bits from the start of the device's process data in this direction.
    pub bits: Range<u32>,
}

impl BitRange {
    pub(super) fn of(signal: &Signal) -> Self {
        Self {
            device: signal.device,
            name: signal.name.clone(),
            bits: bits_of(&signal.field),
        }
    }

    pub(super) fn overlaps(&self, device: DeviceIndex, bits: &Range<u32>) -> bool {
        self.device == device && overlap(&self.bits, bits)
    }

    /// Returns the length as text: whole bytes if possible.
    #[must_use]
    pub fn length(&self) -> String {
        match self.bits.len() {
            bits if bits % 8 == 0 => pluralize(bits / 8, "byte"),
            bits => pluralize(bits, "bit"),
        }
    }
}

fn overlap(a: &Range<u32>, b: &Range<u32>) -> bool {
    a.start < b.end && b.start < a.end
}

/// Returns the bits of a field.
pub(super) fn bits_of(field: &Field) -> Range<u32> {
    field.bit_offset..field.bit_offset.saturating_add(field.bit_len.into())
}

/// Returns the valid copies, which own their outputs.
pub(crate) fn check(
    raw: &[RawCopy],
    devices: &IndexVec<DeviceIndex, ResolvedDevice<'_>>,
    roles: &mut ProcessDataRoles,
    p: &mut Problems<'_>,
) -> Vec<CopySetup> {
    let mut copies: Vec<CopySetup> = Vec::new();
    for raw in raw {
        let (Some(from_text), Some(to_text)) = (&raw.from, &raw.to) else {
            continue;
        };
        let from = range(from_text, SignalDirection::In, devices, p);
        let to = range(to_text, SignalDirection::Out, devices, p);
        let (Some(from), Some(to)) = (from, to) else {
            continue;
        };
        let line = p.line(&raw.span);
        let named = |range: &BitRange, way| {
            let device = devices[range.device].device;
            device.is_some_and(|device| names_fsoe(device, way, &range.bits))
        };
        let fsoe = raw.fsoe.value().unwrap_or_else(|| {
            named(&from, SignalDirection::In) || named(&to, SignalDirection::Out)
        });
        let kind = match fsoe {
            true => OwnerKind::SafetyCopy,
            false => OwnerKind::Copy,
        };
        let owner = OutputOwner::new(kind, "", line);
        if !roles.claim_at(to.clone(), owner, to_text.span(), p) {
            continue;
        }
        if from.bits.len() != to.bits.len() {
            let (at, other) = (p.line(&from_text.span()), from.length());
            let message = format!(
                "`{}` has {}, and `{}` in line {at} has {other}",
                to.name,
                to.length(),
                from.name,
            );
            p.add_hint(
                to_text.span(),
                message,
                "both ends of a copy have one length",
            );
            continue;
        }
        copies.push(CopySetup {
            from,
            to,
            fsoe,
            line,
        });
    }
    copies
}

/// Returns true if the ESI names an entry of these bits, or its PDO, after FSoE.
fn names_fsoe(device: &DeviceConfig, way: SignalDirection, bits: &Range<u32>) -> bool {
    let selection = &device.selection;
    let (fields, pdos) = match way {
        SignalDirection::In => (&selection.layout.tx, &selection.tx),
        SignalDirection::Out => (&selection.layout.rx, &selection.rx),
    };
    let named = |name: &str| name.to_ascii_lowercase().contains("fsoe");
    let mut own = fields.iter().filter(|field| overlap(&bits_of(field), bits));
    own.any(|field| {
        let pdo = pdos.iter().find(|pdo| pdo.index == field.pdo);
        named(&field.name) || pdo.is_some_and(|pdo| named(&pdo.name))
    })
}

/// Returns the bits that a text such as `io.Input 3`, `io.pdo.0x1A00` or `io.bytes.4..10` names.
fn range(
    text: &Spanned<String>,
    way: SignalDirection,
    devices: &IndexVec<DeviceIndex, ResolvedDevice<'_>>,
    p: &mut Problems<'_>,
) -> Option<BitRange> {
    let word = text.get_ref();
    let Some(split) = signal::split_device(word, devices) else {
        let message = format!("\"{word}\" names no {}", way.noun());
        let hint = match way {
            SignalDirection::In => "write a device and its input: \"io.Input 1\"",
            SignalDirection::Out => "write a device and its output: \"io.Output 1\"",
        };
        p.add_hint(text.span(), message, hint);
        return None;
    };
    let names = devices.iter().map(|d| d.name);
    let found = signal::place(&word[..split], names).and_then(|index| {
        let index = DeviceIndex(index);
        // An invalid device has already been reported.
        let Some(device) = devices[index].device else {
            return Ok(None);
        };
        let (name, bits) = of_device(&word[split + 1..], way, device)?;
        let name = format!("{}.{name}", device.name);
        Ok(Some(BitRange {
            device: index,
            name,
            bits,
        }))
    });
    found.unwrap_or_else(|error: NameError| {
        p.add_hint(text.span(), error.message, error.hint);
        None
    })
}

/// Returns the bits of a device's process data with their name.
fn of_device(
    wanted: &str,
    way: SignalDirection,
    device: &DeviceConfig,
) -> Result<(String, Range<u32>), NameError> {
    let wanted = wanted.trim();
    if let Some(index) = wanted.strip_prefix("pdo.") {
        return pdo(index, way, device);
    }
    if let Some(range) = wanted.strip_prefix("bytes.") {
        return bytes(range, way, device);
    }
    let found = signal::field(wanted, way, device).map_err(|error| {
        let other = match way {
            SignalDirection::In => SignalDirection::Out,
            SignalDirection::Out => SignalDirection::In,
        };
        match signal::field(wanted, other, device) {
            Ok(_) => NameError::of_signal(error.message, "a copy goes from inputs to outputs"),
            Err(_) => error,
        }
    });
    let (field, name) = found?;
    Ok((name, bits_of(field)))
}

fn pdo(
    wanted: &str,
    way: SignalDirection,
    device: &DeviceConfig,
) -> Result<(String, Range<u32>), NameError> {
    let pdos = match way {
        SignalDirection::In => &device.selection.layout.tx_pdos,
        SignalDirection::Out => &device.selection.layout.rx_pdos,
    };
    let digits = wanted.strip_prefix("0x").or(wanted.strip_prefix("0X"));
    let index = digits.and_then(|digits| u16::from_str_radix(digits, 16).ok());
    let found = |pdo: &&PdoLayout| Some(pdo.index) == index && pdo.bit_len > 0;
    let Some(pdo) = pdos.iter().find(found) else {
        let message = format!(
            "`{}` has no PDO \"{wanted}\" in its {}s",
            device.name,
            way.noun()
        );
        let known: Vec<String> = pdos.iter().map(|p| format!("0x{:04x}", p.index)).collect();
        let hint = match known.as_slice() {
            [] => format!("it has no {}s at all", way.noun()),
            known => format!("its PDOs: {}", known.join(", ")),
        };
        return Err(NameError::of_signal(message, hint));
    };
    let end = pdo.bit_offset.saturating_add(pdo.bit_len);
    Ok((format!("pdo.0x{:04x}", pdo.index), pdo.bit_offset..end))
}

fn bytes(
    wanted: &str,
    way: SignalDirection,
    device: &DeviceConfig,
) -> Result<(String, Range<u32>), NameError> {
    let len = match way {
        SignalDirection::In => device.selection.layout.tx_bytes(),
        SignalDirection::Out => device.selection.layout.rx_bytes(),
    };
    let ends = wanted.split_once("..").and_then(|(first, end)| {
        let [first, end] = [first, end].map(|n| n.trim().parse::<u16>().ok());
        Some(first?..end?)
    });
    let Some(range) = ends.filter(|range| range.start < range.end) else {
        return Err(NameError::of_signal(
            format!("\"bytes.{wanted}\" is not a range of bytes"),
            "write the first byte and the byte behind the last: \"bytes.4..10\" are six bytes",
        ));
    };
    if usize::from(range.end) > len {
        let message = format!(
            "`{}` has {} of {}s, and \"bytes.{wanted}\" ends behind byte {}",
            device.name,
            pluralize(len, "byte"),
            way.noun(),
            range.end - 1,
        );
        let hint = match len {
            0 => format!("it has no {}s at all", way.noun()),
            len => format!("all of them are \"bytes.0..{len}\""),
        };
        return Err(NameError::of_signal(message, hint));
    }
    let name = format!("bytes.{}..{}", range.start, range.end);
    Ok((name, u32::from(range.start) * 8..u32::from(range.end) * 8))
}

#[cfg(test)]
#[path = "copy_tests.rs"]
mod tests;
