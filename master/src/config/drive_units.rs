//! Compares the units that the drive reports with the machine file. Assumed units are taken from
//! the drive; units from the file are checked.

use ecaxis_axis::homing::ParameterError;
use ecaxis_axis::scale::{DriveUnits, UnitMismatch, same_motor};
use ecaxis_axis::{AccelerationUnit, Axis, ConfigError, Mode, Scale, VelocityUnit};
use ecaxis_ecat::index::AxisIndex;
use ecaxis_esi as esi;

use super::drive_limits::{LimitConflict, after_startup};
use super::problem::Problems;
use super::raw::RawSdo;
use super::sdo::little_endian;
use super::{Action, AxisSetup, HomingSetup, Machine, Step, TorqueSetup, TorqueUnit, UnitSource};

/// An axis setup with the drive's units.
#[derive(Debug, Clone, PartialEq)]
pub struct AdoptedUnits {
    pub setup: AxisSetup,
    /// The factor for the program's torques, which are stored in percent of rated torque.
    pub torque_factor: f64,
    /// Texts of the values taken from the drive.
    pub taken: Vec<String>,
    /// Contradictions with which the axis would move incorrectly.
    pub wrong: Vec<UnitProblem>,
    /// Differences that need not be errors.
    pub doubtful: Vec<UnitMismatch>,
}

/// A reason why the axis cannot run with the drive's units.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum UnitProblem {
    #[error("{0}")]
    Contradiction(UnitMismatch),
    #[error("{0}: the drive's positions jump there")]
    PositionRange(LimitConflict),
    #[error("0x6076:00 is not there, so torques in {unit} mean nothing")]
    NoRatedTorque { unit: &'static str },
    #[error("0x3001:05 says no torque constant, so torques in A mean nothing")]
    NoTorqueConstant,
    #[error("{source} (velocities in {unit} by 0x60A9, torques by 0x6076)")]
    Config {
        unit: VelocityUnit,
        source: ConfigError,
    },
    #[error("{source} (velocities in {unit} by 0x60A9)")]
    Homing {
        unit: VelocityUnit,
        source: ParameterError,
    },
}

/// Returns `true` if the file does not give the unit, so that the drive's value takes precedence.
const fn assumed(from: UnitSource) -> bool {
    matches!(from, UnitSource::Nothing | UnitSource::Esi)
}

impl AxisSetup {
    /// Returns the axis setup with the drive's units.
    #[must_use]
    pub fn adopt(&self, offered: &DriveUnits) -> AdoptedUnits {
        let mut adopted = AdoptedUnits {
            setup: self.clone(),
            torque_factor: 1.0,
            taken: Vec::new(),
            wrong: Vec::new(),
            doubtful: Vec::new(),
        };
        adopted.take_velocity_unit(offered);
        adopted.take_acceleration_unit(offered);
        adopted.take_torque_constant(offered);
        adopted.take_rated_torque(offered);
        adopted.setup.rescale_torque_limit();
        let setup = &mut adopted.setup;
        let unit = setup.config.scale.velocity_unit();
        if let Err(source) = Axis::new(setup.config) {
            adopted.wrong.push(UnitProblem::Config { unit, source });
        }
        if let Some(homing) = &mut setup.homing {
            let config = &setup.config;
            match homing.homing.check(&config.scale, &config.limits) {
                Ok(()) => homing.rescale(&config.scale, setup.number),
                Err(source) => adopted.wrong.push(UnitProblem::Homing { unit, source }),
            }
        }
        let expected = adopted.setup.expected_rated_torque();
        for found in offered.contradictions(&adopted.setup.config.scale, expected) {
            if adopted.setup.is_wrong(&found) {
                adopted.wrong.push(UnitProblem::Contradiction(found));
            } else {
                adopted.doubtful.push(found);
            }
        }
        adopted
    }

    /// Returns the expected value of 0x6076 if the file gives the rated torque.
    fn expected_rated_torque(&self) -> Option<u32> {
        let rated = self.torque.rated?;
        let said = matches!(self.torque.rated_from, UnitSource::File | UnitSource::Sdo);
        // `as` saturates; the value is positive.
        said.then(|| (rated * self.torque.counts_per_newton_metre).round() as u32)
    }

    /// Returns `true` if the axis commands torques, whose direction must be that of its positions.
    fn commands_torque(&self) -> bool {
        let config = &self.config;
        config.modes.contains(Mode::Cst) || config.loops.csp.acceleration != 0.0
    }

    /// Returns a note if no source gives the unit of the drive's velocities.
    pub(crate) fn assumed_velocity_unit(&self) -> Option<String> {
        let unit = self.config.scale.velocity_unit();
        (self.velocity_unit_from == UnitSource::Nothing).then(|| {
            format!(
                "velocities are assumed to be in {unit}: the drive has no 0x60A9; write the unit of its manual as `velocity_unit`"
            )
        })
    }

    /// Returns `true` if the axis would move by a wrong factor or in the wrong direction.
    fn is_wrong(&self, found: &UnitMismatch) -> bool {
        match *found {
            UnitMismatch::CountsPerTurn { .. } => true,
            // Zero is not a unit: the drive does not report one.
            UnitMismatch::PositionUnit { found: 0 }
            | UnitMismatch::VelocityUnit { found: 0, .. }
            | UnitMismatch::AccelerationUnit { found: 0, .. } => false,
            UnitMismatch::PositionUnit { .. } => true,
            UnitMismatch::VelocityUnit { found, .. } => {
                // The user may know a unit that this program does not support.
                VelocityUnit::from_si_code(found).is_some()
                    || self.velocity_unit_from != UnitSource::File
            }
            UnitMismatch::AccelerationUnit { .. } => {
                let modes = self.config.modes;
                let homing = self.homing.as_ref();
                modes.contains(Mode::Pp)
                    || modes.contains(Mode::Pv)
                    || homing.is_some_and(|h| h.homing.acceleration.is_some())
            }
            UnitMismatch::RatedTorque { .. } => {
                self.torque.unit != TorqueUnit::Percent
                    && self.torque.rated_from != UnitSource::File
            }
            UnitMismatch::GearAlone { .. } => found.is_impossible_gear(),
            // Position and velocity must have the same polarity. CiA 402-2 does not say whether
            // torques have it too, and drives differ.
            UnitMismatch::Polarity { found } => {
                matches!(found & 0xc0, 0x40 | 0x80) || self.commands_torque()
            }
            _ => false,
        }
    }
}

impl AdoptedUnits {
    fn take_velocity_unit(&mut self, offered: &DriveUnits) {
        let setup = &mut self.setup;
        let known = offered.velocity_unit.and_then(VelocityUnit::from_si_code);
        let before = setup.config.scale.velocity_unit();
        let Some(unit) = known.filter(|_| assumed(setup.velocity_unit_from)) else {
            return;
        };
        if unit != before {
            setup.config.scale = setup.config.scale.with_velocity_unit(unit);
            self.taken.push(format!(
                "velocities in {unit}, as the drive says in 0x60A9, not in {before}"
            ));
        }
        setup.velocity_unit_from = UnitSource::Drive;
    }

    fn take_acceleration_unit(&mut self, offered: &DriveUnits) {
        let setup = &mut self.setup;
        let known = offered
            .acceleration_unit
            .and_then(AccelerationUnit::from_si_code);
        let before = setup.config.scale.acceleration_unit();
        let Some(unit) = known.filter(|_| assumed(setup.acceleration_unit_from)) else {
            return;
        };
        if unit != before {
            setup.config.scale = setup.config.scale.with_acceleration_unit(unit);
            self.taken.push(format!(
                "accelerations in {unit}, as the drive says in 0x60AA, not in {before}"
            ));
        }
        setup.acceleration_unit_from = UnitSource::Drive;
    }

    fn take_torque_constant(&mut self, offered: &DriveUnits) {
        /// The number of µNm/A per Nm/A.
        const COUNTS: f64 = 1e6;
        let before = self.setup.torque;
        match (before.constant, offered.torque_constant) {
            (None, Some(found @ 1..)) if before.unit == TorqueUnit::Amperes => {
                let constant = f64::from(found) / COUNTS;
                self.taken.push(format!(
                    "a torque constant of {constant} Nm/A, as the drive says in 0x3001:05"
                ));
                let torque = &mut self.setup.torque;
                torque.constant = Some(constant);
                torque.constant_from = UnitSource::Drive;
                let known = torque.rated.map(|rated| (rated, torque.rated_from));
                if let Some(torque) = known.and_then(|(rated, from)| torque.with_rated(rated, from))
                {
                    self.rescale(torque);
                }
            }
            (None, _) if before.unit == TorqueUnit::Amperes => {
                self.wrong.push(UnitProblem::NoTorqueConstant);
            }
            (Some(said), Some(found)) => {
                // `as` saturates; the value is positive.
                let expected = (said * COUNTS).round() as u32;
                if !same_motor(expected, found) {
                    let found = UnitMismatch::TorqueConstant { expected, found };
                    self.doubtful.push(found);
                }
            }
            _ => {}
        }
    }

    /// Rescales torques so that their values in the file's unit stay the same.
    fn rescale(&mut self, torque: TorqueSetup) {
        let factor = torque.percent_per_unit / self.setup.torque.percent_per_unit;
        let config = &mut self.setup.config;
        if torque.limit_said {
            config.limits.torque *= factor;
            config.torque_slope *= factor;
        }
        if let Some(watch) = &mut config.supervision.torque {
            watch.percent *= factor;
        }
        self.torque_factor *= factor;
        self.setup.torque = torque;
    }

    fn take_rated_torque(&mut self, offered: &DriveUnits) {
        let before = self.setup.torque;
        if before.unit == TorqueUnit::Percent || !assumed(before.rated_from) {
            return;
        }
        let Some(count) = offered.rated_torque else {
            if before.rated.is_none() {
                let unit = before.unit.sign();
                self.wrong.push(UnitProblem::NoRatedTorque { unit });
            }
            return;
        };
        // A rated torque of zero is reported with the contradictions.
        let rated = f64::from(count) / before.counts_per_newton_metre;
        let Some(torque) = before.with_rated(rated, UnitSource::Drive) else {
            return;
        };
        self.rescale(torque);
        if before.rated != Some(rated) {
            let was = before
                .rated
                .map_or(String::new(), |was| format!(", not {was} Nm"));
            self.taken.push(format!(
                "a rated torque of {rated} Nm, as the drive says in 0x6076{was}"
            ));
        }
    }
}

/// The objects from which counts per motor turn follow.
const COUNTS: [u16; 3] = [0x608f, 0x6091, 0x6092];

/// Checks the units that the file's `sdo` entries set in the drive, and those of the ESI. Returns
/// what need not be an error.
pub(super) fn check(
    axis: &AxisSetup,
    sdos: &[RawSdo],
    selection: &esi::Selection,
    p: &mut Problems<'_>,
) -> Vec<String> {
    let number = |index: u16, sub: u8| {
        let bytes = after_startup(selection, index, sub)?;
        u32::try_from(little_endian(&bytes, false)).ok()
    };
    let ratio = |index: u16| Some([number(index, 1)?, number(index, 2)?]);
    let offered = DriveUnits {
        encoder_resolution: ratio(0x608f),
        gear_ratio: ratio(0x6091),
        feed_constant: ratio(0x6092),
        position_unit: number(0x60a8, 0),
        velocity_unit: number(0x60a9, 0),
        polarity: number(0x607e, 0).map(|polarity| polarity.to_le_bytes()[0]),
        ..DriveUnits::default()
    };
    let written = |index: u16| sdos.iter().rev().find(|sdo| sdo.index == index);
    let mut notes = Vec::new();
    for found in offered.contradictions(&axis.config.scale, None) {
        let (index, _) = found.object();
        // An ESI's default is not what the drive holds, so it proves nothing.
        let is_certain = !COUNTS.contains(&index)
            || COUNTS.iter().all(|index| {
                written(*index).is_some() || selection.dictionary.item(*index, 1).is_none()
            });
        let is_wrong = axis.is_wrong(&found);
        match written(index) {
            Some(own) if is_wrong && is_certain => {
                p.add_hint(own.value.span(), found.to_string(), found.advice());
            }
            Some(_) => notes.push(found.to_string()),
            None if is_wrong => notes.push(format!("{found} (in the ESI; the drive is asked)")),
            None => {}
        }
    }
    let has_velocity = |index: u16| {
        let layout = &selection.layout;
        layout.rx_field(index, 0).is_some() || layout.tx_field(index, 0).is_some()
    };
    if [0x606c, 0x60b1, 0x60ff, 0x6081]
        .into_iter()
        .any(has_velocity)
    {
        notes.extend(axis.assumed_velocity_unit());
    }
    notes
}

impl HomingSetup {
    /// Converts the SDOs' values to the drive's units.
    pub(super) fn rescale(&mut self, scale: &Scale, axis: u16) {
        // An axis has only one of the two object sets.
        for maxon in [false, true] {
            for object in self.homing.objects(scale, maxon) {
                let index = esi::axis::object(object.index, axis);
                let place = (index, object.subindex);
                let bytes = object.value.to_le_bytes();
                let same = self.startup.iter_mut().find(|s| (s.index, s.sub) == place);
                if let Some(sdo) = same {
                    sdo.data = bytes[..usize::from(object.bytes)].to_vec();
                }
            }
        }
    }
}

impl AdoptedUnits {
    /// Returns start-up SDOs whose values have changed.
    pub(crate) fn changed(&self, startup: &[esi::StartupSdo]) -> Vec<esi::StartupSdo> {
        let now = self.setup.homing.iter().flat_map(|h| &h.startup);
        let now = now.chain(self.setup.torque_limit.startup());
        now.filter(|sdo| {
            let same = |s: &&esi::StartupSdo| (s.index, s.sub) == (sdo.index, sdo.sub);
            startup
                .iter()
                .rev()
                .find(same)
                .is_some_and(|s| s.data != sdo.data)
        })
        .cloned()
        .collect()
    }
}

impl Machine {
    /// Applies the drive's units to an axis and to its steps.
    pub(crate) fn adopt(&mut self, axis: AxisIndex, adopted: &AdoptedUnits) {
        scale_torques(&mut self.steps, axis, adopted.torque_factor);
        let Some(setup) = self.axes.get_mut(axis) else {
            return;
        };
        setup.clone_from(&adopted.setup);
        let Some(config) = self.devices.get_mut(setup.device) else {
            return;
        };
        for sdo in adopted.changed(&config.selection.startup) {
            let startup = config.selection.startup.iter_mut();
            for old in startup.filter(|s| (s.index, s.sub) == (sdo.index, sdo.sub)) {
                old.data.clone_from(&sdo.data);
            }
        }
    }
}

fn scale_torques(steps: &mut [Step], axis: AxisIndex, factor: f64) {
    for step in steps {
        match &mut step.action {
            Action::Torque { targets, .. } => {
                for (target, percent) in targets {
                    if *target == axis {
                        *percent *= factor;
                    }
                }
            }
            action => {
                for step in action.inner_mut() {
                    scale_torques(std::slice::from_mut(step), axis, factor);
                }
            }
        }
    }
}

#[cfg(test)]
#[path = "drive_units_tests.rs"]
mod tests;
