//! `second_encoder` of an axis: an encoder at the load that is compared with the axis.

use ecaxis_axis::SecondEncoder;
use ecaxis_ecat::data_type::{DataType, Kind};
use ecaxis_ecat::index::{DeviceIndex, IndexVec};

use super::fields::KeyExt;
use super::problem::{Problems, Span};
use super::raw::RawSecondEncoder;
use super::roles::{InputUse, ProcessDataRoles, UsedInput};
use super::signal::{self, SignalDirection};
use super::steps::ResolvedDevice;
use super::{AxisSetup, Signal, StopSetup};

/// An encoder of the axis with this name.
pub(crate) struct CheckedEncoder {
    axis: String,
    encoder: SecondEncoder,
    input: Signal,
    place: Span,
}

/// Checks the encoders of these axes.
pub(crate) fn check(
    encoders: &[(String, RawSecondEncoder)],
    devices: &IndexVec<DeviceIndex, ResolvedDevice<'_>>,
    p: &mut Problems<'_>,
) -> Vec<CheckedEncoder> {
    let checked = encoders.iter().filter_map(|(axis, raw)| {
        let text = raw.input.as_ref()?;
        let counts_per_unit = raw.counts_per_unit.value()?;
        let max_difference = raw.max_difference.value()?;
        let mut ok = true;
        if let Some(at) = raw
            .counts_per_unit
            .place()
            .filter(|_| counts_per_unit == 0.0)
        {
            let hint = "write the counts that the encoder makes in one unit of the axis";
            p.add_hint(at, "an encoder has counts", hint);
            ok = false;
        }
        if let Some(at) = raw.max_difference.place().filter(|_| max_difference <= 0.0) {
            let hint = "write the largest difference of a sound machine, and some reserve";
            p.add_hint(at, "`max_difference` is above 0", hint);
            ok = false;
        }
        let input = match signal::of_text(text.get_ref(), devices, SignalDirection::In) {
            Ok(input) => input?,
            Err(error) => {
                let (message, hint) = error.parts();
                p.add_hint(text.span(), message, hint);
                return None;
            }
        };
        let bits = u32::from(input.field.bit_len);
        let kind = DataType::named(&input.field.data_type, bits).map(|known| known.kind);
        if bits != 32 || kind == Some(Kind::Real) {
            let message = format!("`{}` has no 32 bits of counts", input.name);
            p.add_hint(text.span(), message, "an encoder has a DINT or UDINT");
            ok = false;
        }
        ok.then(|| CheckedEncoder {
            axis: axis.clone(),
            encoder: SecondEncoder {
                counts_per_unit,
                max_difference,
                offset: raw.offset.value(),
                unsigned: kind == Some(Kind::Unsigned),
            },
            input,
            place: text.span(),
        })
    });
    checked.collect()
}

impl CheckedEncoder {
    /// Adds the encoder to its axis. Both must stop together: the axis would move without the
    /// encoder.
    pub(crate) fn add_to(
        self,
        axes: &mut [AxisSetup],
        stop: &StopSetup,
        roles: &mut ProcessDataRoles,
        p: &mut Problems<'_>,
    ) {
        let group = |device| stop.groups.iter().position(|g| g.devices.contains(&device));
        let Some(axis) = axes.iter_mut().find(|axis| axis.name == self.axis) else {
            return;
        };
        if group(axis.device) != group(self.input.device) {
            let message = format!(
                "`{}` and its axis `{}` are in different groups",
                self.input.name, axis.name
            );
            let hint = "name both devices in one [[stop.group]]";
            p.add_hint(self.place, message, hint);
            return;
        }
        let used = UsedInput {
            usage: InputUse::SecondEncoder,
            signal: self.input.clone(),
            place: self.place,
        };
        roles.add_input(&used, Some(axis.device), stop, p);
        axis.config.second_encoder = Some(self.encoder);
        axis.second_encoder = Some(self.input);
    }
}
