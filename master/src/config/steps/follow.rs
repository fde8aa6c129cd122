//! Steps in which axes follow more than a target: gears, waves, tables.

use ecaxis_axis::setpoint::{
    Interpolation, Motion, PositionWave, SetpointError, Shape, Table, Wave,
};
use ecaxis_ecat::index::AxisIndex;
use toml::Spanned;

use super::ProgramChecker;
use super::target::TargetKind;
use crate::config::fields::KeyExt;
use crate::config::path::NamedPath;
use crate::config::problem::{Problems, Span, suggestion};
use crate::config::raw::{Named, RawGear, RawWave};
use crate::config::{Action, AxisSetup, LineShaftSetup, NamedCam, Step, StopSetup, csv};
use crate::rt::setpoint_generator::GearMaster;
use crate::text::rounded;

/// The default smoothing of a gear that follows actual positions, in ns.
const SMOOTHING_NS: u64 = 10_000_000;

/// The largest excess of a limit by the cycles of a follower, which differ in common time by the
/// drift of its clock.
pub(super) const CLOCK_MARGIN: f64 = 1.0 + 1e-3;

impl ProgramChecker<'_> {
    /// Returns an axis that follows positions in at least one of its modes.
    pub(super) fn positioned(
        &self,
        name: &Spanned<String>,
        verb: &str,
        p: &mut Problems<'_>,
    ) -> Option<(AxisIndex, &AxisSetup)> {
        let (index, axis) = self.axis(name, p)?;
        if self.any_mode(index, |mode| TargetKind::SetPoint.possible(mode, axis)) {
            return Some((index, axis));
        }
        let message = format!(
            "`{verb}` is not possible for `{}` in mode \"{}\"",
            name.get_ref(),
            axis.mode
        );
        p.add_hint(name.span(), message, "it needs CSP, or a position loop");
        None
    }

    pub(super) fn gear(
        &self,
        name: &Spanned<String>,
        raw: &RawGear,
        p: &mut Problems<'_>,
    ) -> Option<Action> {
        let axis = self.positioned(name, "gear", p)?.0;
        let to = raw.to.as_ref()?;
        let actual = raw.actual.value().unwrap_or(false);
        let mut shafts = self.line_shafts.enumerate();
        let shaft = shafts.find(|(_, shaft)| shaft.name == to.get_ref());
        let master = match shaft {
            Some((index, shaft)) => {
                let setup = shaft.setup.as_ref()?;
                if let Some(at) = raw.actual.place().filter(|_| actual) {
                    let message = "a line shaft has set-points only, no reported positions";
                    p.add_hint(at, message, "take `actual` out");
                    return None;
                }
                if raw.cam.is_none() {
                    let ratio = raw.ratio.value().unwrap_or(1.0).abs();
                    self.check_line_shaft(axis, (to.span(), ratio), setup, p)?;
                }
                GearMaster::LineShaft(index)
            }
            None if self.axis_named(to).is_none() && !self.line_shafts.is_empty() => {
                let shafts = self.line_shafts.iter().map(|shaft| shaft.name);
                let names = self.axes.iter().map(|axis| axis.name).chain(shafts);
                let hint = suggestion(to.get_ref(), names, "axes and line shafts");
                let message = format!("nothing to follow is named `{}`", to.get_ref());
                p.add_hint(to.span(), message, hint);
                return None;
            }
            None => GearMaster::Axis {
                axis: self.axis(to, p)?.0,
                actual,
            },
        };
        if master.axis() == Some(axis) {
            let message = format!("`{}` cannot follow itself", name.get_ref());
            p.add_hint(to.span(), message, "name another axis in `to`");
            return None;
        }
        if let Some(ratio) = raw.ratio.as_ref().filter(|ratio| *ratio.get_ref() == 0.0) {
            p.add(ratio.span(), "with a `ratio` of 0 nothing is followed");
            return None;
        }
        let cam = match &raw.cam {
            None => None,
            Some(name) => {
                let known = |cam: &NamedCam| cam.name == *name.get_ref();
                let Some(index) = self.cams.iter().position(known) else {
                    let message = format!("no cam is named `{}`", name.get_ref());
                    let names = self.cams.iter().map(|cam| cam.name.as_str());
                    let hint = match self.cams.is_empty() {
                        true => "add a [[cam]] with this `name`".to_owned(),
                        false => suggestion(name.get_ref(), names, "cams"),
                    };
                    p.add_hint(name.span(), message, hint);
                    return None;
                };
                Some(index)
            }
        };
        // Actual positions are whole counts, so they need smoothing.
        let smoothing_ns = if actual { SMOOTHING_NS } else { 0 };
        Some(Action::Gear {
            axis,
            master,
            ratio: raw.ratio.value().unwrap_or(1.0),
            offset: raw.offset.value(),
            cam,
            smoothing_ns: raw.smoothing.value().unwrap_or(smoothing_ns),
        })
    }

    /// Reports a follower that could not stay in gear with the stop of a line shaft, or at its
    /// velocity.
    fn check_line_shaft(
        &self,
        axis: AxisIndex,
        (at, ratio): (Span, f64),
        shaft: &LineShaftSetup,
        p: &mut Problems<'_>,
    ) -> Option<()> {
        let setup = self.axes.get(axis)?.setup?;
        let limits = &setup.config.limits;
        let rows = [
            ("velocity", "/s", shaft.config.velocity, limits.velocity),
            (
                "acceleration",
                "/s²",
                shaft.config.acceleration,
                limits.acceleration,
            ),
        ];
        for (what, per, of_shaft, limit) in rows {
            let needed = ratio * of_shaft * CLOCK_MARGIN;
            if needed > limit {
                let unit = format!("{}{per}", setup.unit);
                let message = format!(
                    "`{}` cannot follow `{}`: its {what} would be up to {} {unit}, and its limit is {}",
                    setup.name,
                    shaft.name,
                    rounded(needed),
                    rounded(limit),
                );
                let hint = format!("reduce the `ratio`, or `{what}` of the line shaft");
                p.add_hint(at, message, hint);
                return None;
            }
        }
        Some(())
    }

    pub(super) fn wave(
        &self,
        square: bool,
        name: &Spanned<String>,
        raw: &RawWave,
        p: &mut Problems<'_>,
    ) -> Option<Action> {
        let verb = if square { "square" } else { "sine" };
        let (index, axis) = self.positioned(name, verb, p)?;
        let (amplitude, frequency) = (raw.amplitude.as_ref()?, raw.frequency.as_ref()?);
        let shape = if square { Shape::Square } else { Shape::Sine };
        let limits = axis.config.limits.motion();
        let wave = Wave::new(
            shape,
            *amplitude.get_ref(),
            *frequency.get_ref(),
            raw.periods.value()?,
            self.cycle_s,
        );
        let checked = wave.and_then(|wave| {
            PositionWave::new(wave, Motion::default(), limits, None, self.cycle_s)?;
            Ok(wave)
        });
        match checked {
            Ok(wave) => Some(Action::Wave { axis: index, wave }),
            Err(error) => {
                let at = match error {
                    SetpointError::TooOften { .. } => frequency.span(),
                    _ => amplitude.span(),
                };
                let hint = "take a smaller amplitude or a lower frequency";
                p.add_hint(at, error.to_string(), hint);
                None
            }
        }
    }

    /// Returns the step that plays a table with each axis.
    pub(super) fn table(
        &mut self,
        files: &Named<String>,
        [speed, ramp]: [f64; 2],
        p: &mut Problems<'_>,
    ) -> Option<Action> {
        let mut tables = Vec::with_capacity(files.len());
        for (name, file) in files {
            let text = csv::text(file, self.folder, p)?;
            let path = self.folder.join(file.get_ref());
            let (index, axis) = self.positioned(name, "table", p)?;
            let limits = &axis.config.limits;
            let table = Table::parse(&text, Interpolation::Cubic).and_then(|table| {
                table.check(limits.motion(), limits.position, 0.0, self.cycle_s)?;
                Ok(table)
            });
            match table {
                Ok(table) => {
                    self.tables.push(table);
                    tables.push((index, self.tables.len() - 1));
                }
                Err(error) => {
                    let message = format!("{}, {error}", path.display());
                    let hint = "a row is time in seconds, position, and if you like velocity";
                    p.add_hint(file.span(), message, hint);
                    return None;
                }
            }
        }
        let names = files.iter().map(|(_, file)| file.get_ref().as_str());
        Some(Action::Table {
            name: names.collect::<Vec<_>>().join(", "),
            tables,
            speed,
            ramp,
        })
    }

    /// Returns the step that moves axes on a path of the machine file.
    pub(super) fn path(
        &self,
        name: &Spanned<String>,
        [speed, ramp]: [f64; 2],
        p: &mut Problems<'_>,
    ) -> Option<Action> {
        let known = |path: &&NamedPath| path.name == *name.get_ref();
        let Some(path) = self.paths.iter().find(known) else {
            let message = format!("no path is named `{}`", name.get_ref());
            let names = self.paths.iter().map(|path| path.name.as_str());
            let hint = match self.paths.is_empty() {
                true => "add a [[path]] with this `name`".to_owned(),
                false => suggestion(name.get_ref(), names, "paths"),
            };
            p.add_hint(name.span(), message, hint);
            return None;
        };
        if path.tables.is_empty() {
            return None;
        }
        for &(axis, _) in &path.tables {
            let axis = self.axes.get(axis)?;
            self.positioned(&Spanned::new(name.span(), axis.name.to_owned()), "path", p)?;
        }
        Some(Action::Table {
            name: format!("path `{}`", path.name),
            tables: path.tables.clone(),
            speed,
            ramp,
        })
    }
    /// Checks that axes that play tables together stop together, and are due in the same cycles: their
    /// tables share one time.
    pub(super) fn check_groups(&self, steps: &[Step], stop: &StopSetup, p: &mut Problems<'_>) {
        for step in steps {
            if let Action::Table { tables, .. } = &step.action {
                let group_of = |&(axis, _): &(AxisIndex, usize)| {
                    let device = self.axes.get(axis)?.device;
                    stop.groups.iter().position(|g| g.devices.contains(&device))
                };
                // A gateway steps its nodes in cycles of its own.
                let network_of = |&(axis, _): &(AxisIndex, usize)| {
                    let axis = self.axes.get(axis)?;
                    axis.setup?.node.map(|_| axis.device)
                };
                let mut networks = tables.iter().map(network_of);
                let first = networks.next();
                if networks.any(|network| Some(network) != first) {
                    let message = "the axes of this step are in different networks";
                    let hint = "move axes behind a gateway together with those behind the same one";
                    p.add_hint(self.place_of(step), message, hint);
                }
                let mut groups = tables.iter().map(group_of);
                let first = groups.next();
                if groups.any(|group| Some(group) != first) {
                    let message = "the axes of this step are in different groups";
                    let hint = "name all of them in one [[stop.group]]";
                    p.add_hint(self.place_of(step), message, hint);
                }
            }
            for inner in step.action.lists() {
                self.check_groups(inner, stop, p);
            }
        }
    }
}
