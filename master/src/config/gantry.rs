//! `[[gantry]]`: two axes that move as one.

use ecaxis_ecat::index::AxisIndex;
use toml::Spanned;

use super::device::CheckedDevice;
use super::fields::KeyExt;
use super::problem::{Problems, Span, suggestion};
use super::raw::RawGantry;
use super::{AxisSetup, Machine, StopSetup};
use crate::rt::gantry::GantryConfig;
use ecaxis_axis::Mode;

/// A gantry and its place in the file.
pub(crate) struct CheckedGantry {
    pub config: GantryConfig,
    span: Span,
}

/// Checks the gantries. Both halves get the lower ones of their limits.
pub(crate) fn check(
    raw: &[RawGantry],
    devices: &mut [CheckedDevice],
    p: &mut Problems<'_>,
) -> Vec<CheckedGantry> {
    let mut gantries: Vec<CheckedGantry> = Vec::new();
    for raw in raw {
        let Some((axes, names)) = halves(raw, devices, &gantries, p) else {
            continue;
        };
        let (Some(max_skew), Some(place)) = (raw.max_skew.value(), raw.max_skew.place()) else {
            continue;
        };
        let max_homing_skew = raw.max_homing_skew.value().unwrap_or(max_skew);
        let places = [Some(place), raw.max_homing_skew.place()];
        for (value, place) in [max_skew, max_homing_skew].into_iter().zip(places) {
            if let Some(place) = place.filter(|_| value <= 0.0) {
                let hint = "write the largest skew that the machine bears";
                p.add_hint(place, "a skew limit is above 0", hint);
            }
        }
        join(axes, &names, devices, p);
        gantries.push(CheckedGantry {
            config: GantryConfig {
                axes,
                max_skew,
                max_homing_skew,
            },
            span: raw.span.clone(),
        });
    }
    gantries
}

/// Returns the axes of a gantry.
fn halves<'r>(
    raw: &'r RawGantry,
    devices: &[CheckedDevice],
    others: &[CheckedGantry],
    p: &mut Problems<'_>,
) -> Option<([AxisIndex; 2], [&'r Spanned<String>; 2])> {
    let names = raw.axes.as_ref()?.0.iter().collect::<Vec<_>>();
    let Ok(names) = <[&Spanned<String>; 2]>::try_from(names) else {
        let hint = "write the first and the second half: `axes = [\"x1\", \"x2\"]`";
        let at = raw.axes.iter().flat_map(|names| &names.0).next();
        let at = at.map_or(raw.span.clone(), Spanned::span);
        p.add_hint(at, "a gantry has two axes", hint);
        return None;
    };
    let mut found = [AxisIndex::default(); 2];
    for (to, name) in found.iter_mut().zip(names) {
        let known: Vec<_> = named(devices).map(|axis| axis.name.as_str()).collect();
        let Some(index) = known.iter().position(|known| known == name.get_ref()) else {
            let hint = suggestion(name.get_ref(), known, "axes");
            let message = format!("no axis is named `{}`", name.get_ref());
            p.add_hint(name.span(), message, hint);
            return None;
        };
        *to = AxisIndex(index);
        let taken = others.iter().find(|g| g.config.axes.contains(to));
        if let Some(other) = taken {
            let hint = format!("line {} has it", p.line(&other.span));
            let message = format!("`{}` is in another gantry", name.get_ref());
            p.add_hint(name.span(), message, hint);
            return None;
        }
    }
    if found[0] == found[1] {
        let message = "the halves of a gantry are two axes";
        p.add_hint(names[1].span(), message, "name both of them");
        return None;
    }
    Some((found, names))
}

fn named(devices: &[CheckedDevice]) -> impl Iterator<Item = &super::device::CheckedAxis> {
    let named = devices.iter().filter(|device| device.name.is_some());
    named.flat_map(|device| &device.axes)
}

/// Gives both halves the lower ones of their limits. Reports what differs and must not.
fn join(
    axes: [AxisIndex; 2],
    names: &[&Spanned<String>; 2],
    devices: &mut [CheckedDevice],
    p: &mut Problems<'_>,
) {
    let all = devices.iter_mut().filter(|device| device.name.is_some());
    let mut all: Vec<_> = all.flat_map(|device| &mut device.axes).collect();
    let both = all.get_disjoint_mut(axes.map(|AxisIndex(n)| n));
    // An invalid axis has been reported.
    let Ok([Some(first), Some(second)]) = both.map(|both| both.map(|axis| axis.setup.as_mut()))
    else {
        return;
    };
    let [a, b] = names.map(|name| name.get_ref());
    for (half, name) in [(&*first, names[0]), (&*second, names[1])] {
        let config = &half.config;
        if config.mode_change_unpowered {
            let message = format!("`{}` has `mode_change = \"no-power\"`", name.get_ref());
            p.add_hint(
                name.span(),
                message,
                "homing would remove the power of one half: use drives that change their mode with power",
            );
        }
        if config.mode != Mode::Csp {
            let message = format!("`{}` is not in CSP", name.get_ref());
            let hint = "write `mode = \"csp\"`: both halves of a gantry follow positions";
            p.add_hint(name.span(), message, hint);
            return;
        }
        if half.node.is_some() {
            let message = format!("`{}` is behind a gateway", name.get_ref());
            let hint = "both halves of a gantry need their set-points in the same cycle";
            p.add_hint(name.span(), message, hint);
        }
    }
    if first.unit != second.unit {
        let message = format!(
            "`{a}` has the unit {} and `{b}` has {}",
            first.unit, second.unit
        );
        p.add_hint(
            names[1].span(),
            message,
            "give both halves of the gantry the same unit",
        );
    }
    if first.homing.is_some() != second.homing.is_some() {
        let without = if first.homing.is_some() { b } else { a };
        let message =
            format!("`{without}` has no homing, and the other half of the gantry has one");
        let hint = "write `homing` for both halves, or for neither";
        p.add_hint(names[1].span(), message, hint);
    }
    if first.config.scale.modulo().is_some() || second.config.scale.modulo().is_some() {
        let hint = "remove `modulo`: a gantry does not turn";
        p.add_hint(names[0].span(), "a half of a gantry is a modulo axis", hint);
    }
    if !share_limits(first, second) {
        let message = format!("`{a}` and `{b}` have no position in common");
        let hint = "give both halves of the gantry the same `limits.position`";
        p.add_hint(names[1].span(), message, hint);
    }
}

/// Returns false if the ranges have no position in common.
fn share_limits(first: &mut AxisSetup, second: &mut AxisSetup) -> bool {
    let [a, b] = [&mut first.config, &mut second.config];
    let limited = a.jerk_limited || b.jerk_limited;
    let jerk = a.limits.jerk().min(b.limits.jerk());
    let range = match (a.limits.position, b.limits.position) {
        (Some(a), Some(b)) => Some([a[0].max(b[0]), a[1].min(b[1])]),
        (a, b) => a.or(b),
    };
    if range.is_some_and(|[low, high]| low >= high) {
        return false;
    }
    let velocity = a.limits.velocity.min(b.limits.velocity);
    let acceleration = a.limits.acceleration.min(b.limits.acceleration);
    for config in [a, b] {
        config.jerk_limited = limited;
        config.limits.velocity = velocity;
        config.limits.acceleration = acceleration;
        config.limits.jerk = Some(jerk);
        config.limits.position = range;
    }
    true
}

/// Checks that both halves of a gantry stop together.
pub(crate) fn check_groups(
    gantries: &[CheckedGantry],
    axes: &[AxisSetup],
    stop: &StopSetup,
    p: &mut Problems<'_>,
) {
    let group_of = |AxisIndex(axis): AxisIndex| {
        let device = axes.get(axis)?.device;
        stop.groups.iter().position(|g| g.devices.contains(&device))
    };
    for gantry in gantries {
        let [first, second] = gantry.config.axes.map(group_of);
        if first != second {
            let message = "the halves of this gantry are in different groups";
            let hint = "name both axes in one [[stop.group]]";
            p.add_hint(gantry.span.clone(), message, hint);
        }
    }
}

impl Machine {
    /// Returns the other half of the gantry of an axis.
    #[must_use]
    pub fn other_half(&self, axis: AxisIndex) -> Option<AxisIndex> {
        self.gantries.iter().find_map(|gantry| {
            let [first, second] = gantry.axes;
            match axis {
                _ if axis == first => Some(second),
                _ if axis == second => Some(first),
                _ => None,
            }
        })
    }
}
