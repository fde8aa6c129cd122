//! Steps in which axes follow more than a target: gears, waves, tables.

use ecaxis_axis::setpoint::{
    Interpolation, Motion, PositionWave, SetpointError, Shape, Table, Wave,
};
use ecaxis_ecat::index::AxisIndex;
use toml::Spanned;

use super::ProgramChecker;
use super::target::TargetKind;
use crate::config::fields::KeyExt;
use crate::config::problem::{Problems, suggestion};
use crate::config::raw::{RawGear, RawWave};
use crate::config::{Action, AxisSetup, NamedCam, TableFile};
use crate::file;
use crate::file::unreadable;
use crate::signature::SignedKind;

/// The maximum length of a table in bytes.
const MAX_TABLE_BYTES: u64 = 64 << 20;

/// The default smoothing of a gear that follows actual positions, in ns.
const SMOOTHING_NS: u64 = 10_000_000;

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
        let master = self.axis(to, p)?.0;
        if axis == master {
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
        let actual = raw.actual.value().unwrap_or(false);
        // Actual positions are whole counts, so they need smoothing.
        let smoothing_ns = if actual { SMOOTHING_NS } else { 0 };
        Some(Action::Gear {
            axis,
            master,
            actual,
            ratio: raw.ratio.value().unwrap_or(1.0),
            offset: raw.offset.value(),
            cam,
            smoothing_ns: raw.smoothing.value().unwrap_or(smoothing_ns),
        })
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

    pub(super) fn table(
        &mut self,
        name: &Spanned<String>,
        file: &Spanned<String>,
        [speed, ramp]: [f64; 2],
        p: &mut Problems<'_>,
    ) -> Option<Action> {
        let path = self.folder.join(file.get_ref());
        let text = match file::read_text(&path, MAX_TABLE_BYTES) {
            Ok(text) => text,
            Err(error) => {
                let hint = "paths are relative to the machine file";
                p.add_hint(file.span(), unreadable(&path, &error), hint);
                return None;
            }
        };
        let used = p.files.add(SignedKind::Tables, &path, text.as_bytes());
        if let Err(error) = used {
            p.add_hint(file.span(), error.to_string(), error.hint());
            return None;
        }
        let (index, axis) = self.positioned(name, "table", p)?;
        let limits = &axis.config.limits;
        let table = Table::parse(&text, Interpolation::Cubic).and_then(|table| {
            table.check(limits.motion(), limits.position, 0.0, self.cycle_s)?;
            Ok(table)
        });
        match table {
            Ok(table) => {
                self.tables.push(TableFile { path, table });
                let table = self.tables.len() - 1;
                Some(Action::Table {
                    axis: index,
                    table,
                    speed,
                    ramp,
                })
            }
            Err(error) => {
                let message = format!("{}, {error}", path.display());
                let hint = "a row is time in seconds, position, and if you like velocity";
                p.add_hint(file.span(), message, hint);
                None
            }
        }
    }
}
