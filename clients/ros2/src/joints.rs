//! The joints: an axis each, in SI units, with its limits in units of the axis.

use std::fmt;

use ecaxis_axis::setpoint::MotionLimits;
use serde_json::Value;

use crate::options::Options;

/// The kind of values that a joint takes: an array of `JointState`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Interface {
    Position,
    Velocity,
    Effort,
}

impl Interface {
    pub const ALL: [Self; 3] = [Self::Position, Self::Velocity, Self::Effort];

    /// Returns the interface of a mode of operation (0x6061).
    #[must_use]
    pub fn of_mode(code: i8) -> Option<Self> {
        match code {
            1 | 8 => Some(Self::Position),
            3 | 9 => Some(Self::Velocity),
            4 | 10 => Some(Self::Effort),
            _ => None,
        }
    }

    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Position => "position",
            Self::Velocity => "velocity",
            Self::Effort => "effort",
        }
    }
}

impl fmt::Display for Interface {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// A joint.
#[derive(Debug, Clone)]
pub struct Joint {
    /// The name in ROS.
    pub name: String,
    /// The name in the machine file.
    pub axis: String,
    /// The index of the axis in `machine`.
    pub index: usize,
    /// The SI units in one unit of the axis.
    pub scale: f64,
    /// The N·m or N at 100 % of the rated torque.
    pub rated_effort: Option<f64>,
    /// The interfaces that `ros2_control` has for the joint; empty: that of the mode.
    pub interfaces: Vec<Interface>,
    pub limits: MotionLimits,
    pub range: Option<[f64; 2]>,
    /// Percent of the rated torque.
    pub max_torque: Option<f64>,
    pub modes: Vec<String>,
    pub has_homing: bool,
}

impl Joint {
    /// Returns the joints of a machine.
    ///
    /// # Errors
    /// Fails if an option names no axis, two joints have one name, or the machine is incomplete.
    pub fn of_machine(machine: &Value, options: &Options) -> Result<Vec<Self>, String> {
        let axes = machine["axes"]
            .as_array()
            .ok_or("the server names no axes")?;
        let joints: Result<Vec<_>, _> = axes
            .iter()
            .enumerate()
            .map(|(index, axis)| joint(index, axis, options))
            .collect();
        let joints = joints?;
        let axis_names: Vec<_> = joints.iter().map(|joint| joint.axis.as_str()).collect();
        for name in options.axes() {
            if !axis_names.contains(&name) {
                let known = axis_names.join(", ");
                return Err(format!("the machine has no axis `{name}`; it has {known}"));
            }
        }
        for (at, joint) in joints.iter().enumerate() {
            if joints[..at].iter().any(|other| other.name == joint.name) {
                return Err(format!(
                    "two joints are called `{}`: rename one with --joint",
                    joint.name
                ));
            }
        }
        Ok(joints)
    }

    /// Returns a value of an interface in units of the axis, or percent of the rated torque.
    #[must_use]
    pub fn axis_value(&self, interface: Interface, value: f64) -> Option<f64> {
        match interface {
            Interface::Position | Interface::Velocity => Some(value / self.scale),
            Interface::Effort => Some(value / self.rated_effort? * 100.0),
        }
    }

    /// Returns a torque in percent as effort; NaN without the effort at 100 %.
    #[must_use]
    pub fn effort(&self, percent: f64) -> f64 {
        self.rated_effort
            .map_or(f64::NAN, |rated| percent * rated / 100.0)
    }
}

fn joint(index: usize, axis: &Value, options: &Options) -> Result<Joint, String> {
    let name = axis["name"]
        .as_str()
        .ok_or("an axis has no name")?
        .to_owned();
    let limit = |key: &str| axis["limits"][key].as_f64();
    let needed = |key: &str| limit(key).ok_or_else(|| format!("`{name}` has no limit of {key}"));
    let limits = MotionLimits {
        velocity: needed("velocity")?,
        acceleration: needed("acceleration")?,
        // Unused: set-points have no limit of jerk.
        jerk: limit("jerk").unwrap_or(1e9),
    };
    let range = match axis["limits"]["position"].as_array().map(Vec::as_slice) {
        Some([low, high]) => low
            .as_f64()
            .zip(high.as_f64())
            .map(|(low, high)| [low, high]),
        _ => None,
    };
    let modes = axis["modes"].as_array().into_iter().flatten();
    let scale = options.scale(&name).or(axis["si"].as_f64()).unwrap_or(1.0);
    Ok(Joint {
        name: options.joint_name(&name),
        index,
        scale,
        rated_effort: options.rated_effort(&name),
        interfaces: options.interfaces(&name),
        limits,
        range,
        max_torque: limit("torque"),
        modes: modes.filter_map(Value::as_str).map(str::to_owned).collect(),
        has_homing: axis["homing"].as_bool().unwrap_or(false),
        axis: name,
    })
}
