//! Process data by name: which bits of which device a step reads or sets.

use ecaxis_esi as esi;
use ecaxis_esi::layout::Field;
use toml::Spanned;

use super::problem::{Problems, suggestion};
use super::raw::RawSignal;
use super::steps::Known;
use super::{DeviceConfig, Signal};

/// Axes write these themselves (CiA 402, ETG.6010).
const AXIS_OUTPUTS: [u16; 7] = [0x6040, 0x6060, 0x6071, 0x607a, 0x60b1, 0x60b2, 0x60ff];

/// What can be read, or set, of one device.
struct Candidates<'d> {
    fields: &'d [Field],
    pdos: &'d [esi::Pdo],
}

impl<'d> Candidates<'d> {
    /// The names that a field answers to besides its address: its own, its PDO's where that has no other, and both.
    fn names(&self, field: &Field) -> Vec<String> {
        let mut names = vec![field.name.clone()];
        if let Some(pdo) = self.pdos.iter().find(|pdo| pdo.index == field.pdo) {
            names.push(format!("{}/{}", pdo.name, field.name));
            let single = self.fields.iter().filter(|f| f.pdo == field.pdo).count() == 1;
            if single {
                names.push(pdo.name.clone());
            }
        }
        names
    }

    fn find(&self, wanted: &str) -> Vec<&'d Field> {
        let address = address(wanted);
        let same = |name: &String| name.trim().eq_ignore_ascii_case(wanted.trim());
        let all = self.fields.iter();
        all.filter(|field| match address {
            Some(address) => address == (field.index, field.sub),
            None => self.names(field).iter().any(same),
        })
        .collect()
    }

    /// The shortest name that means this field alone.
    fn name(&self, field: &Field) -> String {
        let mut names = self.names(field);
        names.rotate_left(1);
        names.retain(|name| !name.trim().is_empty() && self.find(name).len() == 1);
        let shortest = names.into_iter().min_by_key(String::len);
        shortest.unwrap_or_else(|| show(field))
    }
}

fn show(field: &Field) -> String {
    format!("0x{:04X}:{:02}", field.index, field.sub)
}

/// `0x6000:01`; `None` where it is a name.
fn address(text: &str) -> Option<(u16, u8)> {
    let (index, sub) = text.trim().split_once(':').unwrap_or((text.trim(), "0"));
    let index = index
        .strip_prefix("0x")
        .or_else(|| index.strip_prefix("0X"))?;
    let sub = sub.trim_start_matches("0x");
    Some((
        u16::from_str_radix(index, 16).ok()?,
        u8::from_str_radix(sub, 16).ok()?,
    ))
}

/// An input of the machine, to be waited for.
pub(crate) fn input(
    raw: &RawSignal,
    devices: &[Known<'_>],
    p: &mut Problems<'_>,
) -> Option<Signal> {
    let (index, device) = device(&raw.device, devices, p)?;
    let candidates = Candidates {
        fields: &device.selection.layout.tx,
        pdos: &device.selection.tx,
    };
    one(&raw.name, "input", index, device, &candidates, p)
}

/// An output of the machine that no axis writes.
pub(crate) fn output(
    raw: &RawSignal,
    devices: &[Known<'_>],
    p: &mut Problems<'_>,
) -> Option<Signal> {
    let (index, device) = device(&raw.device, devices, p)?;
    let candidates = Candidates {
        fields: &device.selection.layout.rx,
        pdos: &device.selection.rx,
    };
    let signal = one(&raw.name, "output", index, device, &candidates, p)?;
    if device.axis.is_some() && AXIS_OUTPUTS.contains(&signal.field.index) {
        let message = format!("`{}` is written by the axis itself", signal.name);
        p.add_hint(raw.name.span(), message, "give the axis a command instead");
        return None;
    }
    Some(signal)
}

fn device<'d>(
    name: &Spanned<String>,
    devices: &[Known<'d>],
    p: &mut Problems<'_>,
) -> Option<(usize, &'d DeviceConfig)> {
    let Some(index) = devices.iter().position(|d| d.name == name.get_ref()) else {
        let message = format!("no device is named `{}`", name.get_ref());
        let known = devices.iter().map(|d| d.name);
        let hint = suggestion(name.get_ref(), known, "devices");
        p.add_hint(name.span(), message, hint);
        return None;
    };
    // Nothing can be said of a device that is wrong itself, and that has been said.
    Some((index, devices[index].device?))
}

fn one(
    name: &Spanned<String>,
    what: &str,
    index: usize,
    device: &DeviceConfig,
    candidates: &Candidates<'_>,
    p: &mut Problems<'_>,
) -> Option<Signal> {
    let wanted = name.get_ref();
    let found = candidates.find(wanted);
    let field = match found.as_slice() {
        [field] => *field,
        [] => {
            let message = format!(
                "`{}` has no {what} \"{wanted}\" in its process data",
                device.name
            );
            let names: Vec<String> = candidates
                .fields
                .iter()
                .map(|field| candidates.name(field))
                .collect();
            let hint = if names.is_empty() {
                format!("it has no {what}s at all")
            } else {
                let names = names.iter().map(String::as_str);
                suggestion(wanted, names, &format!("its {what}s"))
            };
            p.add_hint(name.span(), message, hint);
            return None;
        }
        several => {
            let message = format!(
                "\"{wanted}\" is the name of several {what}s of `{}`",
                device.name
            );
            let names: Vec<String> = several.iter().map(|f| candidates.name(f)).collect();
            let names = names.iter().map(|n| format!("\"{n}\"")).collect::<Vec<_>>();
            p.add_hint(
                name.span(),
                message,
                format!("write one of {}", names.join(", ")),
            );
            return None;
        }
    };
    if !(1..=64).contains(&field.bit_len) {
        let message = format!(
            "\"{wanted}\" has {} bits and is not a number",
            field.bit_len
        );
        p.add(name.span(), message);
        return None;
    }
    Some(Signal {
        device: index,
        name: format!("{}.{}", device.name, candidates.name(field)),
        field: field.clone(),
    })
}
