//! The axes of a device.

use ecaxis_esi as esi;
use toml::Spanned;

use super::super::axis::control::vendor_method_note;
use super::super::axis_setup::add_startup;
use super::super::fields::KeyExt;
use super::super::problem::Problems;
use super::super::raw::{RawAxis, RawCompensation, RawDevice, RawSdo, RawSecondEncoder};
use super::super::{AxisSetup, axis, drive_limits, drive_units};

/// An axis; its setup is missing if it is invalid and has been reported.
pub(crate) struct CheckedAxis {
    pub name: String,
    pub setup: Option<AxisSetup>,
    pub brake_output: Option<Spanned<String>>,
    pub compensation: Option<RawCompensation>,
    pub second_encoder: Option<RawSecondEncoder>,
}

/// Checks the axes of a device, and adds their start-up SDOs and notes to the selection. `mode`:
/// `None` if it is invalid.
pub(super) fn check(
    device: &RawDevice,
    numbers: &[u16],
    mode: Option<esi::Mode>,
    mut selection: Option<&mut esi::Selection>,
    p: &mut Problems<'_>,
) -> Vec<CheckedAxis> {
    let mut axes = Vec::new();
    for (axis, &number) in device.axes.0.iter().zip(numbers) {
        let name = name(axis, device, p);
        let checked =
            mode.and_then(|mode| setup(axis, number, device, mode, selection.as_deref_mut(), p));
        axes.push(CheckedAxis {
            setup: checked.map(|setup| AxisSetup {
                name: name.clone(),
                ..setup
            }),
            name,
            brake_output: axis.brake.output.clone(),
            compensation: axis.compensation.clone(),
            second_encoder: axis.second_encoder.clone(),
        });
    }
    axes
}

/// Returns the number of each axis in its drive, from 0: those of the list, unless they are given.
pub(super) fn numbers(raw: &RawDevice, p: &mut Problems<'_>) -> Vec<u16> {
    let mut numbers = Vec::new();
    for (place, axis) in (0..).zip(&raw.axes.0) {
        let number = axis.number.value().map_or(place, |number| number - 1);
        if numbers.contains(&number) || number >= esi::axis::MAX_AXES {
            let at = axis.number.place().unwrap_or(axis.span.clone());
            let message = match number < esi::axis::MAX_AXES {
                true => format!("the drive has axis {} once", number + 1),
                false => format!("a drive has at most {} axes", esi::axis::MAX_AXES),
            };
            p.add_hint(at, message, "`number` counts the axes of the drive from 1");
        }
        numbers.push(number);
    }
    numbers
}

/// Returns the name of an axis: its own, or that of its device if the device has no other axis.
fn name(axis: &RawAxis, raw: &RawDevice, p: &mut Problems<'_>) -> String {
    let of_device = raw.name.as_ref().map(|name| name.get_ref().clone());
    match &axis.name {
        Some(name) => name.get_ref().clone(),
        None => {
            if raw.axes.0.len() > 1 {
                let message = "an axis of a drive with several axes needs a `name`";
                p.add_hint(axis.span.clone(), message, "name it: `name = \"x\"`");
            }
            of_device.unwrap_or_default()
        }
    }
}

/// Checks one axis of a device, and adds its start-up SDOs and notes to the selection.
fn setup(
    raw: &RawAxis,
    number: u16,
    device: &RawDevice,
    mode: esi::Mode,
    selection: Option<&mut esi::Selection>,
    p: &mut Problems<'_>,
) -> Option<AxisSetup> {
    let sdos: Vec<RawSdo> = device
        .sdo
        .iter()
        .filter_map(|sdo| sdo.of_axis(number))
        .collect();
    let mut setup = {
        let seen = selection
            .as_deref()
            .map(|selection| selection.of_axis(number));
        axis::setup(raw, &sdos, mode, seen.as_deref(), p)?
    };
    setup.number = number;
    if let Some(homing) = &mut setup.homing {
        for sdo in &mut homing.startup {
            sdo.index = esi::axis::object(sdo.index, number);
        }
    }
    if let Some(selection) = selection {
        let seen = selection.of_axis(number);
        setup.torque_limit = axis::torque_limit(raw, &setup, &sdos, &seen, p);
        if let Some(homing) = &setup.homing {
            add_startup(&mut selection.startup, &homing.startup);
        }
        add_startup(&mut selection.startup, setup.torque_limit.startup());
        let seen = selection.of_axis(number);
        let mut notes = drive_limits::check(&setup, &sdos, &seen, p);
        notes.extend(drive_units::check(&setup, &sdos, &seen, p));
        notes.extend(setup.torque_limit.note());
        notes.extend(axis::ambiguous_start(&setup.config, &setup.unit));
        let homing = setup.homing.as_ref();
        notes.extend(homing.and_then(|homing| vendor_method_note(homing, &seen)));
        let warnings = notes.iter().map(|note| format!("warning: {note}"));
        selection.notes.extend(warnings);
    }
    Some(setup)
}
