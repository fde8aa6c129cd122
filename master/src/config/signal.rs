//! Process data by name: the bits of a device that a step reads or sets.

use ecaxis_ecat::data_type::{DataType, Kind};
use ecaxis_ecat::index::{AxisIndex, DeviceIndex, IndexVec};
use ecaxis_esi as esi;
use ecaxis_esi::layout::Field;

use toml::Spanned;

use super::problem::{Problems, suggestion};
use super::raw::RawSignal;
use super::roles::OwnerKind;
use super::steps::ResolvedDevice;
use super::{AxisRef, DeviceConfig, InputRef, Machine, OutputRef};
use crate::rt::image::NumericFormat;

/// Process data that the program reads or sets.
#[derive(Debug, Clone, PartialEq)]
pub struct Signal {
    pub device: DeviceIndex,
    /// The name with its device's name: `io.Input 3`.
    pub name: String,
    pub field: Field,
}

impl Signal {
    #[must_use]
    pub fn kind(&self) -> NumericFormat {
        let bits = u32::from(self.field.bit_len);
        match DataType::named(&self.field.data_type, bits).map(|known| (known.kind, known.bits)) {
            Some((Kind::Real, 32)) if bits == 32 => NumericFormat::Real,
            Some((Kind::Signed, _)) => NumericFormat::Signed,
            _ => NumericFormat::Unsigned,
        }
    }

    /// Returns the lowest and highest value, and whether only integers are possible.
    /// True if the signal has whole numbers only.
    pub(crate) fn is_whole(&self) -> bool {
        let (_, _, whole) = self.range();
        whole
    }

    pub(super) fn range(&self) -> (f64, f64, bool) {
        let steps = f64::from(self.field.bit_len).exp2();
        match self.kind() {
            NumericFormat::Real => (f64::from(f32::MIN), f64::from(f32::MAX), false),
            NumericFormat::Signed => (-steps / 2.0, steps / 2.0 - 1.0, true),
            NumericFormat::Unsigned => (0.0, steps - 1.0, true),
        }
    }
}

/// The direction of a signal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum SignalDirection {
    In,
    Out,
}

impl SignalDirection {
    pub(super) fn noun(self) -> &'static str {
        match self {
            Self::In => "input",
            Self::Out => "output",
        }
    }
}

/// A name without a matching axis or process data.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{message}; {hint}")]
pub struct NameError {
    pub message: String,
    pub hint: String,
    /// `true` if the device's name is wrong, not the signal's.
    device: bool,
}

/// The readable or writable fields of one device.
struct Candidates<'d> {
    fields: &'d [Field],
    pdos: &'d [esi::Pdo],
}

impl<'d> Candidates<'d> {
    fn new(device: &'d DeviceConfig, direction: SignalDirection) -> Self {
        let selection = &device.selection;
        match direction {
            SignalDirection::In => Self {
                fields: &selection.layout.tx,
                pdos: &selection.tx,
            },
            SignalDirection::Out => Self {
                fields: &selection.layout.rx,
                pdos: &selection.rx,
            },
        }
    }

    /// Returns the names of a field besides its address: its own, `PDO/entry`, and the PDO's name
    /// if it has one entry.
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
        let mut found: Vec<&Field> = Vec::new();
        for field in all.filter(|field| match address {
            Some(address) => address == (field.index, field.sub),
            None => self.names(field).iter().any(same),
        }) {
            // An object that several PDOs map has the same value in all of them.
            let repeats = |first: &&Field| {
                (first.index, first.sub) == (field.index, field.sub) && first.pdo != field.pdo
            };
            if !found.iter().any(repeats) {
                found.push(field);
            }
        }
        found
    }

    /// Returns the shortest unique name of a field.
    fn name(&self, field: &Field) -> String {
        let mut names = self.names(field);
        names.rotate_left(1);
        names.retain(|name| !name.trim().is_empty() && self.find(name).len() == 1);
        let shortest = names.into_iter().min_by_key(String::len);
        shortest.unwrap_or_else(|| show(field))
    }
}

fn show(field: &Field) -> String {
    esi::address(field.index, field.sub).to_string()
}

/// Parses an address such as `0x6000:01`; returns `None` for a name.
fn address(text: &str) -> Option<(u16, u8)> {
    let (index, sub) = text.trim().split_once(':').unwrap_or((text.trim(), "0"));
    let index = index
        .strip_prefix("0x")
        .or_else(|| index.strip_prefix("0X"))?;
    Some((
        u16::from_str_radix(index, 16).ok()?,
        esi::Address::sub_of(sub)?,
    ))
}

/// Splits a text such as `io.Output 3` behind the name of its device; returns the length of the
/// name. Device names may contain dots.
pub(super) fn split_device(
    word: &str,
    devices: &IndexVec<DeviceIndex, ResolvedDevice<'_>>,
) -> Option<usize> {
    let named = |d: &ResolvedDevice<'_>| {
        word.strip_prefix(d.name)?
            .strip_prefix('.')
            .map(|_| d.name.len())
    };
    devices
        .iter()
        .filter_map(named)
        .max()
        .or_else(|| word.find('.'))
}

/// Returns the signal of a text such as `io.Input 3`; `None` if the device is invalid, which has been
/// reported.
pub(crate) fn of_text(
    word: &str,
    devices: &IndexVec<DeviceIndex, ResolvedDevice<'_>>,
    way: SignalDirection,
) -> Result<Option<Signal>, NameError> {
    let Some(split) = split_device(word, devices) else {
        let message = format!("\"{word}\" names no input and no output");
        let hint = "write a device and its signal: \"io.Input 3\"";
        return Err(NameError::of_signal(message, hint));
    };
    let (device, name) = (&word[..split], &word[split + 1..]);
    let index = DeviceIndex(place(device, devices.iter().map(|d| d.name))?);
    let config = devices[index].device;
    let found = config.map(|config| one(name, way, index, config));
    found.transpose()
}

/// Returns an output from a text such as `io.Output 3`.
pub(crate) fn output_of_text(
    text: &Spanned<String>,
    devices: &IndexVec<DeviceIndex, ResolvedDevice<'_>>,
    p: &mut Problems<'_>,
) -> Option<Signal> {
    let word = text.get_ref();
    let Some(split) = split_device(word, devices) else {
        let message = format!("\"{word}\" names no output");
        p.add_hint(
            text.span(),
            message,
            "write a device and its output: \"io.Output 3\"",
        );
        return None;
    };
    let raw = RawSignal {
        device: Some(Spanned::new(text.span(), word[..split].to_owned())),
        name: Spanned::new(text.span(), word[split + 1..].to_owned()),
    };
    resolve(&raw, devices, SignalDirection::Out, p)
}

/// Returns an input or an output of the machine.
pub(crate) fn resolve(
    raw: &RawSignal,
    devices: &IndexVec<DeviceIndex, ResolvedDevice<'_>>,
    way: SignalDirection,
    p: &mut Problems<'_>,
) -> Option<Signal> {
    let names = devices.iter().map(|d| d.name);
    let device = raw.device.as_ref()?;
    let found = place(device.get_ref(), names).and_then(|index| {
        let index = DeviceIndex(index);
        // An invalid device has already been reported.
        let device = devices[index].device;
        device
            .map(|device| one(raw.name.get_ref(), way, index, device))
            .transpose()
    });
    found.unwrap_or_else(|error| {
        let at = if error.device { device } else { &raw.name };
        p.add_hint(at.span(), error.message, error.hint);
        None
    })
}

pub(super) fn place<'n>(
    name: &str,
    mut names: impl Iterator<Item = &'n str> + Clone,
) -> Result<usize, NameError> {
    let all = names.clone();
    let found = names.position(|n| n == name);
    found.ok_or_else(|| NameError {
        message: format!("no device is named `{name}`"),
        hint: suggestion(name, all, "devices"),
        device: true,
    })
}

impl NameError {
    /// Returns the message and the hint.
    #[must_use]
    pub fn parts(&self) -> (&str, &str) {
        (&self.message, &self.hint)
    }

    pub(super) fn of_signal(message: String, hint: impl Into<String>) -> Self {
        Self {
            message,
            hint: hint.into(),
            device: false,
        }
    }

    /// Returns the error of a name that is neither an input nor an output.
    pub(super) fn or(self, output: Self) -> Self {
        let guesses = |error: &Self| error.hint.starts_with("did you mean");
        match guesses(&output) && !guesses(&self) {
            true => output,
            false => self,
        }
    }
}

/// Returns a field of a device's process data with its shortest unique name.
pub(super) fn field<'d>(
    wanted: &str,
    way: SignalDirection,
    device: &'d DeviceConfig,
) -> Result<(&'d Field, String), NameError> {
    let what = way.noun();
    let candidates = Candidates::new(device, way);
    let found = candidates.find(wanted);
    let names = |fields: &[&Field]| -> Vec<String> {
        let names = fields.iter().map(|field| candidates.name(field));
        names.collect()
    };
    match found.as_slice() {
        [field] => Ok((field, candidates.name(field))),
        [] => {
            let message = format!(
                "`{}` has no {what} \"{wanted}\" in its process data",
                device.name
            );
            let names = names(&candidates.fields.iter().collect::<Vec<_>>());
            let hint = if names.is_empty() {
                format!("it has no {what}s at all")
            } else {
                let names = names.iter().map(String::as_str);
                suggestion(wanted, names, &format!("its {what}s"))
            };
            Err(NameError::of_signal(message, hint))
        }
        several => {
            let message = format!(
                "\"{wanted}\" is the name of several {what}s of `{}`",
                device.name
            );
            let names = names(several).into_iter().map(|n| format!("\"{n}\""));
            let names = names.collect::<Vec<_>>().join(", ");
            Err(NameError::of_signal(
                message,
                format!("write one of {names}"),
            ))
        }
    }
}

fn one(
    wanted: &str,
    way: SignalDirection,
    index: DeviceIndex,
    device: &DeviceConfig,
) -> Result<Signal, NameError> {
    let (field, name) = field(wanted, way, device)?;
    let signal = Signal {
        device: index,
        name: format!("{}.{name}", device.name),
        field: field.clone(),
    };
    if !(1..=64).contains(&field.bit_len) {
        let message = format!("`{}` has {} bits", signal.name, field.bit_len);
        return Err(NameError::of_signal(
            message,
            "numbers have 64 bits at most",
        ));
    }
    Ok(signal)
}

/// Names that a controller resolves before the machine runs.
impl Machine {
    /// Returns the inputs and the outputs of a device that steps may name.
    #[must_use]
    pub fn signals_of(&self, index: DeviceIndex) -> [Vec<Signal>; 2] {
        let device = &self.devices[index];
        [SignalDirection::In, SignalDirection::Out].map(|way| {
            let candidates = Candidates::new(device, way);
            let fields = candidates.fields.iter();
            let named =
                fields.filter_map(|field| one(&candidates.name(field), way, index, device).ok());
            let free = |signal: &Signal| {
                let conflict = || self.roles.command_conflict(signal, OwnerKind::Controller);
                way == SignalDirection::In || conflict().is_none()
            };
            named.filter(free).collect()
        })
    }

    /// Returns the axis with this name.
    ///
    /// # Errors
    /// Fails if no axis has the name.
    pub fn axis(&self, name: &str) -> Result<AxisRef, NameError> {
        let names = self.axes.iter().map(|axis| axis.name.as_str());
        let at = place(name, names.clone()).map_err(|error| NameError {
            message: format!("no axis is named `{name}`"),
            hint: suggestion(name, names, "axes"),
            ..error
        })?;
        Ok(AxisRef(AxisIndex(at)))
    }

    /// Returns an input by its device's name and its own name. Valid names are the entry's name in
    /// the ESI, its PDO's name, `PDO/entry`, and an address such as `0x6000:01`.
    ///
    /// # Errors
    /// Fails if no input or several inputs have this name.
    pub fn input(&mut self, device: &str, name: &str) -> Result<InputRef, NameError> {
        let signal = self.signal(device, name, SignalDirection::In)?;
        Ok(InputRef(known(&mut self.inputs, signal)))
    }

    /// Returns an output for a controller. Names are as for inputs.
    ///
    /// # Errors
    /// Fails if no output or several outputs have this name, or if it has another owner
    /// ([`ProcessDataRoles`](super::ProcessDataRoles)).
    pub fn output(&mut self, device: &str, name: &str) -> Result<OutputRef, NameError> {
        let signal = self.signal(device, name, SignalDirection::Out)?;
        self.claim_output(signal, OwnerKind::Controller)
    }

    fn claim_output(&mut self, signal: Signal, owner: OwnerKind) -> Result<OutputRef, NameError> {
        let claimed = self.roles.claim_command(&signal, owner);
        claimed.map_err(|conflict| NameError::of_signal(conflict.message, conflict.hint))?;
        Ok(OutputRef(known(&mut self.outputs, signal)))
    }

    /// Fails if clients may not set an output: it has no such name, or another owner.
    ///
    /// # Errors
    /// As [`Machine::output`].
    pub fn check_client_output(&self, device: &str, name: &str) -> Result<(), NameError> {
        let signal = self.signal(device, name, SignalDirection::Out)?;
        let conflict = self.roles.command_conflict(&signal, OwnerKind::Client);
        conflict.map_or(Ok(()), |conflict| {
            Err(NameError::of_signal(conflict.message, conflict.hint))
        })
    }

    /// Makes all inputs readable, and all outputs without another owner settable by clients. Leaves out
    /// fields of more than 64 bits. `inputs` then has one signal for each input.
    pub fn use_all_signals(&mut self) -> Vec<(OutputRef, Signal)> {
        let mut names = Vec::new();
        for device in &self.devices {
            let candidates = Candidates::new(device, SignalDirection::In);
            let inputs = candidates.fields.iter().map(|field| candidates.name(field));
            names.extend(inputs.map(|name| (device.name.clone(), name, SignalDirection::In)));
            let candidates = Candidates::new(device, SignalDirection::Out);
            let outputs = candidates.fields.iter().map(|field| candidates.name(field));
            names.extend(outputs.map(|name| (device.name.clone(), name, SignalDirection::Out)));
        }
        let mut outputs = Vec::new();
        for (device, name, direction) in names {
            match direction {
                SignalDirection::In => {
                    let _ = self.input(&device, &name);
                }
                SignalDirection::Out => {
                    let signal = self.signal(&device, &name, SignalDirection::Out);
                    let claimed = signal.and_then(|s| self.claim_output(s, OwnerKind::Client));
                    if let Ok(output) = claimed
                        && !outputs.iter().any(|(known, _)| *known == output)
                    {
                        outputs.push((output, self.outputs[output.0].clone()));
                    }
                }
            }
        }
        outputs
    }

    pub(super) fn signal(
        &self,
        device: &str,
        name: &str,
        way: SignalDirection,
    ) -> Result<Signal, NameError> {
        let names = self.devices.iter().map(|d| d.name.as_str());
        let index = DeviceIndex(place(device, names)?);
        one(name, way, index, &self.devices[index])
    }
}

/// Returns the index of a signal among those in use.
pub(crate) fn known(signals: &mut Vec<Signal>, signal: Signal) -> usize {
    if let Some(known) = signals.iter().position(|s| *s == signal) {
        return known;
    }
    signals.push(signal);
    signals.len() - 1
}
