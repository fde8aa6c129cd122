//! Commands of the topic: a `JointState` for the joints, checked as a whole.
//!
//! `ros2_control` fills each array with the values of the joints that have this interface. An array
//! may therefore be shorter than `name`. NaN means no command.

use ecaxis_client::SetPoint;

use crate::joints::{Interface, Joint};
use crate::messages::JointState;

/// Returns the set-point of each joint, in units of its axis; `None` without a command. `modes` are
/// the modes of operation of the joints.
///
/// # Errors
/// Says why the whole message is refused.
pub fn read_command(
    message: &JointState,
    joints: &[Joint],
    modes: &[i8],
) -> Result<Vec<Option<SetPoint>>, String> {
    let arrays = [
        (Interface::Position, &message.position),
        (Interface::Velocity, &message.velocity),
        (Interface::Effort, &message.effort),
    ];
    let find = |name: &String| joints.iter().position(|joint| joint.name == *name);
    let found: Vec<Option<usize>> = message.name.iter().map(find).collect();
    for (at, name) in message.name.iter().enumerate() {
        if message.name[..at].contains(name) {
            return Err(format!("joint `{name}` is in the message twice"));
        }
    }
    let mut values = vec![[None; 3]; joints.len()];
    for (column, (interface, array)) in arrays.into_iter().enumerate() {
        let places = places(interface, array.len(), &found, joints, modes)?;
        for (place, value) in places.into_iter().zip(array) {
            if let Some(joint) = place
                && !value.is_nan()
            {
                values[joint][column] = Some(*value);
            }
        }
    }
    let joints = joints.iter().zip(modes);
    values
        .into_iter()
        .zip(joints)
        .map(|(row, (joint, mode))| wanted(row, joint, *mode))
        .collect()
}

/// Returns the joints to which the values of an array belong.
fn places(
    interface: Interface,
    count: usize,
    found: &[Option<usize>],
    joints: &[Joint],
    modes: &[i8],
) -> Result<Vec<Option<usize>>, String> {
    if count == 0 {
        return Ok(Vec::new());
    }
    if count == found.len() {
        return Ok(found.to_vec());
    }
    let names = found.len();
    if count > names || found.contains(&None) {
        return Err(format!(
            "`{interface}` has {count} values for {names} names"
        ));
    }
    let has = |index: &usize| match joints[*index].interfaces.as_slice() {
        [] => modes.get(*index).and_then(|mode| Interface::of_mode(*mode)) == Some(interface),
        list => list.contains(&interface),
    };
    let places: Vec<_> = found.iter().flatten().copied().filter(has).collect();
    if places.len() == count {
        return Ok(places.into_iter().map(Some).collect());
    }
    let with = places
        .iter()
        .map(|index| joints[*index].name.as_str())
        .collect::<Vec<_>>()
        .join(", ");
    let with = if with.is_empty() { "no joint" } else { &with };
    Err(format!(
        "`{interface}` has {count} values for {names} names; {with} has this interface: \
         set --interfaces"
    ))
}

fn wanted(values: [Option<f64>; 3], joint: &Joint, mode: i8) -> Result<Option<SetPoint>, String> {
    let name = &joint.name;
    let Some(interface) = Interface::of_mode(mode) else {
        return Ok(None);
    };
    let value = values[interface as usize];
    let Some(value) = value else {
        if values.iter().all(Option::is_none) {
            return Ok(None);
        }
        return Err(format!(
            "`{name}` takes `{interface}` in its mode; the message has none: change the mode"
        ));
    };
    if !value.is_finite() {
        return Err(format!("`{interface}` of `{name}` is not a finite number"));
    }
    let Some(value) = joint.axis_value(interface, value) else {
        return Err(format!(
            "the effort of `{name}` is not known: set --effort {}=N·m",
            joint.axis
        ));
    };
    match interface {
        Interface::Position => {
            if let Some([low, high]) = joint.range
                && !(low..=high).contains(&value)
            {
                let ends = [low * joint.scale, high * joint.scale];
                let [low, high] = [ends[0].min(ends[1]), ends[0].max(ends[1])];
                let value = value * joint.scale;
                return Err(format!(
                    "`{name}` to {value:.6}: outside the range {low:.6} to {high:.6}"
                ));
            }
            Ok(Some(SetPoint::Position(value)))
        }
        Interface::Velocity if value.abs() > joint.limits.velocity => {
            let limit = joint.limits.velocity * joint.scale.abs();
            let value = value * joint.scale;
            Err(format!(
                "velocity {value:.6} of `{name}`: the limit is {limit:.6}"
            ))
        }
        Interface::Velocity => Ok(Some(SetPoint::Velocity(value))),
        Interface::Effort => match joint.max_torque {
            Some(most) if value.abs() > most => Err(format!(
                "{value:.1} % of the rated torque for `{name}`: the limit is {most:.1} %"
            )),
            _ => Ok(Some(SetPoint::Torque(value))),
        },
    }
}

#[cfg(test)]
mod tests {
    use ecaxis_axis::setpoint::MotionLimits;

    use super::*;

    const CSP: i8 = 8;
    const CSV: i8 = 9;
    const CST: i8 = 10;

    pub(crate) fn joint(name: &str, index: usize) -> Joint {
        Joint {
            name: name.to_owned(),
            axis: name.to_owned(),
            index,
            scale: 1e-3,
            rated_effort: Some(2.0),
            interfaces: Vec::new(),
            limits: MotionLimits {
                velocity: 100.0,
                acceleration: 1000.0,
                jerk: 1e9,
            },
            range: Some([-60.0, 60.0]),
            max_torque: Some(50.0),
            modes: Vec::new(),
            has_homing: false,
        }
    }

    fn message(names: &[&str], position: &[f64], velocity: &[f64], effort: &[f64]) -> JointState {
        JointState {
            name: names.iter().map(|name| (*name).to_owned()).collect(),
            position: position.to_vec(),
            velocity: velocity.to_vec(),
            effort: effort.to_vec(),
            ..JointState::default()
        }
    }

    #[test]
    fn commands_have_the_units_of_the_axes() {
        let joints = [joint("a", 0), joint("b", 1), joint("c", 2)];
        let sent = message(
            &["c", "a", "b"],
            &[9.0, 0.02, 9.0],
            &[9.0, 9.0, 0.05],
            &[0.5, 9.0, 9.0],
        );
        let read = read_command(&sent, &joints, &[CSP, CSV, CST]).unwrap();
        assert_eq!(
            read,
            [
                Some(SetPoint::Position(20.0)),
                Some(SetPoint::Velocity(50.0)),
                Some(SetPoint::Torque(25.0)),
            ]
        );
    }

    #[test]
    fn short_arrays_belong_to_the_joints_with_the_interface() {
        let mut joints = [joint("a", 0), joint("b", 1), joint("c", 2)];
        let sent = message(&["a", "b", "c"], &[0.01, 0.03], &[0.05], &[]);
        let expected = [
            Some(SetPoint::Position(10.0)),
            Some(SetPoint::Velocity(50.0)),
            Some(SetPoint::Position(30.0)),
        ];
        // From the modes, or from the options.
        assert_eq!(
            read_command(&sent, &joints, &[CSP, CSV, CSP]).unwrap(),
            expected
        );
        joints[0].interfaces = vec![Interface::Position];
        joints[1].interfaces = vec![Interface::Velocity];
        joints[2].interfaces = vec![Interface::Position];
        assert_eq!(
            read_command(&sent, &joints, &[CSP, CSV, CSP]).unwrap(),
            expected
        );
        let error = read_command(&sent, &joints, &[CSP, CSP, CSP]).unwrap_err();
        assert!(error.contains("`b` takes `position`"), "{error}");
        joints[2].interfaces = vec![Interface::Velocity];
        let error = read_command(&sent, &joints, &[CSP, CSV, CSP]).unwrap_err();
        assert!(
            error.contains("2 values for 3 names; a has this interface"),
            "{error}"
        );
    }

    #[test]
    fn joints_of_others_and_missing_values_are_no_commands() {
        let joints = [joint("a", 0), joint("b", 1)];
        let sent = message(&["other", "b"], &[5.0, f64::NAN], &[], &[]);
        assert_eq!(
            read_command(&sent, &joints, &[CSP, CSP]).unwrap(),
            [None, None]
        );
        assert_eq!(
            read_command(&JointState::default(), &joints, &[CSP, CSP]).unwrap(),
            [None, None]
        );
    }

    #[test]
    fn impossible_commands_are_refused_whole() {
        let mut joints = [joint("a", 0), joint("b", 1)];
        joints[1].rated_effort = None;
        for (sent, modes, part) in [
            (
                message(&["a", "b"], &[0.01, 0.061], &[], &[]),
                [CSP, CSP],
                "`b` to 0.061000: outside",
            ),
            (
                message(&["a", "b"], &[f64::INFINITY, 0.0], &[], &[]),
                [CSP, CSP],
                "not a finite",
            ),
            (
                message(&["a", "b"], &[], &[0.11, 0.0], &[]),
                [CSV, CSV],
                "the limit is 0.1",
            ),
            (
                message(&["a"], &[], &[], &[1.1]),
                [CST, CST],
                "55.0 % of the rated torque",
            ),
            (message(&["b"], &[], &[], &[0.1]), [CST, CST], "--effort b="),
            (
                message(&["a", "a"], &[0.0, 0.0], &[], &[]),
                [CSP, CSP],
                "twice",
            ),
            (
                message(&["a"], &[0.0, 0.0], &[], &[]),
                [CSP, CSP],
                "2 values for 1 names",
            ),
            (
                message(&["a", "other"], &[0.0], &[], &[]),
                [CSP, CSP],
                "1 values for 2 names",
            ),
        ] {
            let error = read_command(&sent, &joints, &modes).unwrap_err();
            assert!(error.contains(part), "{error}");
        }
    }
}
