//! The command line.

use std::path::PathBuf;
use std::str::FromStr;

use clap::Parser;

use crate::joints::Interface;

/// A ROS 2 node over `ecaxis serve`. It needs no ROS installation.
#[derive(Debug, Clone, Parser)]
#[command(name = "ecaxis-ros2", version)]
pub struct Options {
    /// The control socket of the server
    pub socket: PathBuf,
    /// The name of the node
    #[arg(long, default_value = "ecaxis")]
    pub name: String,
    /// The namespace of the node
    #[arg(long, default_value = "/")]
    pub namespace: String,
    /// The DDS domain
    #[arg(long, env = "ROS_DOMAIN_ID", default_value_t = 0)]
    #[arg(value_parser = clap::value_parser!(u16).range(0..=232))]
    pub domain: u16,
    /// The topic of the joint states
    #[arg(long, default_value = "/joint_states")]
    pub states: String,
    /// The topic of commands (sensor_msgs/JointState)
    #[arg(long, default_value = "/joint_commands")]
    pub commands: String,
    /// The topic of trajectories (trajectory_msgs/JointTrajectory)
    #[arg(long, default_value = "/joint_trajectory")]
    pub trajectories: String,
    /// Joint states per second; at most one per cycle
    #[arg(long, default_value_t = 500.0, value_parser = positive)]
    pub rate: f64,
    /// A joint that moves stops after this time without a command, ms
    #[arg(long, default_value_t = 100.0, value_parser = positive)]
    pub stale_ms: f64,
    /// The farthest first command from the axis, rad or m
    #[arg(long, default_value_t = 0.01, value_parser = positive)]
    pub start_tolerance: f64,
    /// Smooths the steps of position commands, ms
    #[arg(long, default_value_t = 10.0, value_parser = positive)]
    pub smoothing_ms: f64,
    /// Names the joint of an axis
    #[arg(long = "joint", value_name = "AXIS=JOINT")]
    pub joints: Vec<Setting<String>>,
    /// The rad or m in one unit of an axis
    #[arg(long = "scale", value_name = "AXIS=FACTOR")]
    pub scales: Vec<Setting<f64>>,
    /// The N·m or N of a joint at 100 % of the rated torque
    #[arg(long = "effort", value_name = "AXIS=EFFORT")]
    pub efforts: Vec<Setting<f64>>,
    /// The command interfaces that ros2_control has for a joint: position, velocity, effort
    #[arg(long = "interfaces", value_name = "AXIS=NAME,...")]
    pub interface_lists: Vec<Setting<String>>,
}

/// A value for an axis.
#[derive(Debug, Clone, PartialEq)]
pub struct Setting<T> {
    pub axis: String,
    pub value: T,
}

impl<T: FromStr> FromStr for Setting<T> {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (axis, value) = text.split_once('=').ok_or("write AXIS=VALUE")?;
        let value = value
            .parse()
            .map_err(|_| format!("`{value}` is not a valid value"))?;
        Ok(Self {
            axis: axis.to_owned(),
            value,
        })
    }
}

fn positive(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(value) if value > 0.0 && f64::is_finite(value) => Ok(value),
        _ => Err("not a number above 0".to_owned()),
    }
}

fn value_of<'o, T>(settings: &'o [Setting<T>], axis: &str) -> Option<&'o T> {
    let mut settings = settings.iter().rev();
    settings
        .find(|setting| setting.axis == axis)
        .map(|setting| &setting.value)
}

impl Options {
    /// Checks what the parser does not.
    ///
    /// # Errors
    /// Names the option.
    pub fn check(&self) -> Result<(), String> {
        for (option, settings) in [("--scale", &self.scales), ("--effort", &self.efforts)] {
            for Setting { axis, value } in settings {
                if !value.is_finite() || *value == 0.0 {
                    return Err(format!(
                        "{option} {axis}={value}: not a number other than 0"
                    ));
                }
            }
        }
        for Setting { axis, value } in &self.interface_lists {
            interfaces(value).map_err(|name| {
                format!("--interfaces {axis}={value}: `{name}` is not position, velocity or effort")
            })?;
        }
        Ok(())
    }

    /// Returns the axes that options name.
    pub fn axes(&self) -> impl Iterator<Item = &str> {
        let texts = self.joints.iter().chain(&self.interface_lists);
        let numbers = self.scales.iter().chain(&self.efforts);
        texts
            .map(|s| s.axis.as_str())
            .chain(numbers.map(|s| s.axis.as_str()))
    }

    #[must_use]
    pub fn joint_name(&self, axis: &str) -> String {
        value_of(&self.joints, axis)
            .map_or(axis, String::as_str)
            .to_owned()
    }

    #[must_use]
    pub fn scale(&self, axis: &str) -> Option<f64> {
        value_of(&self.scales, axis).copied()
    }

    #[must_use]
    pub fn rated_effort(&self, axis: &str) -> Option<f64> {
        value_of(&self.efforts, axis).copied()
    }

    #[must_use]
    pub fn interfaces(&self, axis: &str) -> Vec<Interface> {
        let list = value_of(&self.interface_lists, axis);
        list.and_then(|list| interfaces(list).ok())
            .unwrap_or_default()
    }
}

fn interfaces(list: &str) -> Result<Vec<Interface>, &str> {
    let find = |name| {
        Interface::ALL
            .into_iter()
            .find(|one| one.name() == name)
            .ok_or(name)
    };
    list.split(',').map(str::trim).map(find).collect()
}
