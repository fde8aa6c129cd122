//! What a drive itself says of its units, against the machine file: what was only assumed is taken from the drive, what the
//! file says is held against it.

use ecaxis_axis::homing::ParameterError;
use ecaxis_axis::scale::{Contradiction, Offered, same_motor};
use ecaxis_axis::{AccelerationUnit, Axis, ConfigError, Mode, Scale, VelocityUnit};
use ecaxis_esi as esi;

use super::{Action, AxisSetup, HomingSetup, Machine, Step, TorqueSetup, TorqueUnit, UnitFrom};

/// An axis after its drive has been asked.
#[derive(Debug, Clone, PartialEq)]
pub struct Adopted {
    pub setup: AxisSetup,
    /// By which torques of the program change, which are kept in percent of rated torque.
    pub torque_factor: f64,
    /// What was taken over from the drive, in words.
    pub taken: Vec<String>,
    /// With these the axis would move wrongly.
    pub wrong: Vec<UnitProblem>,
    /// Worth a look.
    pub doubtful: Vec<Contradiction>,
}

/// Why the axis cannot run with the drive's units.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum UnitProblem {
    #[error("{0}")]
    Contradiction(Contradiction),
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

/// Not said by the file, so the drive's word counts for more.
const fn assumed(from: UnitFrom) -> bool {
    matches!(from, UnitFrom::Nothing | UnitFrom::Esi)
}

impl AxisSetup {
    /// The same axis as the drive's units make it.
    #[must_use]
    pub fn adopt(&self, offered: &Offered) -> Adopted {
        let mut adopted = Adopted {
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
        let setup = &mut adopted.setup;
        let unit = setup.config.scale.velocity_unit();
        if let Err(source) = Axis::new(setup.config) {
            adopted.wrong.push(UnitProblem::Config { unit, source });
        }
        if let Some(homing) = &mut setup.homing {
            let config = &setup.config;
            match homing.homing.check(&config.scale, &config.limits) {
                Ok(()) => homing.rescale(&config.scale),
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

    /// 0x6076, where the file says what it must be.
    fn expected_rated_torque(&self) -> Option<u32> {
        let rated = self.torque.rated?;
        let said = matches!(self.torque.rated_from, UnitFrom::File | UnitFrom::Sdo);
        // `as` saturates; the figure is above zero.
        said.then(|| (rated * self.torque.counts_per_newton_metre).round() as u32)
    }

    /// Whether the axis would move wrongly, by a factor or in the wrong direction.
    fn is_wrong(&self, found: &Contradiction) -> bool {
        match *found {
            Contradiction::CountsPerTurn { .. } => true,
            // Zero is no unit; a drive that says so says nothing.
            Contradiction::PositionUnit { found: 0 }
            | Contradiction::VelocityUnit { found: 0, .. }
            | Contradiction::AccelerationUnit { found: 0, .. } => false,
            Contradiction::PositionUnit { .. } => true,
            Contradiction::VelocityUnit { found, .. } => {
                // What is not understood may be what the user knows it to be.
                VelocityUnit::from_si_code(found).is_some()
                    || self.velocity_unit_from != UnitFrom::File
            }
            Contradiction::AccelerationUnit { .. } => {
                let modes = self.config.modes;
                let homing = self.homing.as_ref();
                modes.contains(Mode::Pp)
                    || modes.contains(Mode::Pv)
                    || homing.is_some_and(|h| h.homing.acceleration.is_some())
            }
            Contradiction::RatedTorque { .. } => {
                self.torque.unit != TorqueUnit::Percent && self.torque.rated_from != UnitFrom::File
            }
            // Position and velocity must at least have the same direction.
            Contradiction::Polarity { found } => matches!(found & 0xc0, 0x40 | 0x80),
            _ => false,
        }
    }
}

impl Adopted {
    fn take_velocity_unit(&mut self, offered: &Offered) {
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
        setup.velocity_unit_from = UnitFrom::Drive;
    }

    fn take_acceleration_unit(&mut self, offered: &Offered) {
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
        setup.acceleration_unit_from = UnitFrom::Drive;
    }

    fn take_torque_constant(&mut self, offered: &Offered) {
        /// µNm/A.
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
                torque.constant_from = UnitFrom::Drive;
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
                // `as` saturates; the figure is above zero.
                let expected = (said * COUNTS).round() as u32;
                if !same_motor(expected, found) {
                    let found = Contradiction::TorqueConstant { expected, found };
                    self.doubtful.push(found);
                }
            }
            _ => {}
        }
    }

    /// What is in the file's unit of torque stays what it is there.
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

    fn take_rated_torque(&mut self, offered: &Offered) {
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
        // Zero is a contradiction in itself, and is found with the others.
        let rated = f64::from(count) / before.counts_per_newton_metre;
        let Some(torque) = before.with_rated(rated, UnitFrom::Drive) else {
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

impl HomingSetup {
    /// The SDOs' values in the drive's units.
    fn rescale(&mut self, scale: &Scale) {
        // Which of the two an axis has does not change.
        for maxon in [false, true] {
            for object in self.homing.objects(scale, maxon) {
                let place = (object.index, object.subindex);
                let bytes = object.value.to_le_bytes();
                let same = self.startup.iter_mut().find(|s| (s.index, s.sub) == place);
                if let Some(sdo) = same {
                    sdo.data = bytes[..usize::from(object.bytes)].to_vec();
                }
            }
        }
    }
}

impl Adopted {
    /// Start-up SDOs that have other values now.
    pub(crate) fn changed(&self, startup: &[esi::StartupSdo]) -> Vec<esi::StartupSdo> {
        let now = self.setup.homing.iter().flat_map(|h| &h.startup);
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
    /// Makes an axis what its drive's units make it.
    pub(crate) fn adopt(&mut self, device: usize, adopted: &Adopted) {
        scale_torques(&mut self.steps, device, adopted.torque_factor);
        let Some(config) = self.devices.get_mut(device) else {
            return;
        };
        for sdo in adopted.changed(&config.selection.startup) {
            let startup = config.selection.startup.iter_mut();
            for old in startup.filter(|s| (s.index, s.sub) == (sdo.index, sdo.sub)) {
                old.data.clone_from(&sdo.data);
            }
        }
        config.axis = Some(adopted.setup.clone());
    }
}

fn scale_torques(steps: &mut [Step], device: usize, factor: f64) {
    for step in steps {
        match &mut step.action {
            Action::Torque { targets, .. } => {
                for (axis, percent) in targets {
                    if *axis == device {
                        *percent *= factor;
                    }
                }
            }
            Action::Repeat { steps, .. } => scale_torques(steps, device, factor),
            _ => {}
        }
    }
}

#[cfg(test)]
#[path = "adopt_tests.rs"]
mod tests;
