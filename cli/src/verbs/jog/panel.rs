//! The displayed state of the machine: copied from the view outside the cycle, drawn on another
//! thread.

use std::collections::VecDeque;

use ecaxis_axis::units::UserUnits;
use ecaxis_axis::{AxisStatus, HomingStatus, Mode, State};
use ecaxis_ecat::index::{AxisIndex, IndexVec};
use ecaxis_master::config::{AxisSetup, TorqueUnit};
use ecaxis_master::supervise::operator::{Activity, View};
use serde::Serialize;

/// The modes that an axis can be switched to.
const MODES: [Mode; 5] = [Mode::Csp, Mode::Csv, Mode::Cst, Mode::Pp, Mode::Pv];

#[derive(Debug, Clone, Default)]
pub(super) struct Panel {
    /// The time since the start of the run in s.
    pub time_s: f64,
    pub lost_frames: u64,
    pub wkc_errors: u64,
    pub locked: Option<bool>,
    pub axes: IndexVec<AxisIndex, AxisPanel>,
}

/// One axis; values in user units.
#[derive(Debug, Clone)]
pub(super) struct AxisPanel {
    pub name: String,
    pub unit: String,
    pub state: State,
    pub mode: Mode,
    /// The available modes, including `mode`.
    pub modes: Vec<Mode>,
    pub position: f64,
    pub velocity: f64,
    pub torque: f64,
    pub torque_unit: TorqueUnit,
    pub following_error: f64,
    pub target: f64,
    pub limits: Limits,
    pub doing: Activity,
    pub enabled: bool,
    pub homed: bool,
    pub held_by_range: bool,
    /// The fault, the trip, or the reason for waiting.
    pub trouble: Option<String>,
}

#[derive(Debug, Clone, Copy, Serialize)]
pub(super) struct Limits {
    pub position: Option<[f64; 2]>,
    pub velocity: f64,
    pub torque: f64,
    pub following_error: Option<f64>,
}

impl Panel {
    pub fn new(view: &View<'_>, began: u64) -> Self {
        let snapshot = view.snapshot;
        let axes = view.machine.axes.enumerate();
        let axes = axes.filter_map(|(axis, setup)| {
            let status = snapshot.axes.get(axis)?;
            let doing = view.hands.get(axis).map(|hand| hand.doing);
            let group = snapshot.groups.get(view.machine.group_of(setup.device));
            let stopped = group.is_some_and(|group| group.stopped.is_some());
            let doing = doing.unwrap_or_default();
            Some(AxisPanel::new(&setup.name, setup, status, doing, stopped))
        });
        Self {
            time_s: view.now.saturating_sub(began) as f64 * 1e-9,
            lost_frames: snapshot.counters.lost_frames,
            wkc_errors: snapshot.counters.wkc_errors,
            locked: snapshot.phase.map(|phase| phase.locked),
            axes: axes.collect(),
        }
    }
}

impl AxisPanel {
    fn new(
        name: &str,
        setup: &AxisSetup,
        status: &AxisStatus,
        doing: Activity,
        stopped: bool,
    ) -> Self {
        let config = &setup.config;
        let place = |position| config.scale.place(UserUnits(position)).0;
        let fits = |mode: &Mode| config.modes.contains(*mode) || *mode == config.mode;
        let trouble = match (status.fault, status.trip, status.waiting) {
            (Some(fault), ..) => Some(fault.to_string()),
            (_, Some(trip), _) => Some(trip.to_string()),
            _ if stopped => Some("its group has been stopped".to_owned()),
            (.., Some(waiting)) if doing == Activity::Enabling => Some(waiting.to_string()),
            _ => None,
        };
        Self {
            name: name.to_owned(),
            unit: setup.unit.clone(),
            state: status.state,
            mode: status.mode,
            modes: MODES.into_iter().filter(fits).collect(),
            position: place(status.position),
            velocity: status.velocity,
            torque: setup.torque.shown(status.torque),
            torque_unit: setup.torque.unit,
            following_error: status.following_error,
            target: place(status.target_position),
            limits: Limits {
                position: config.limits.position,
                velocity: config.limits.velocity,
                torque: setup.torque.shown(config.limits.torque),
                following_error: config.limits.following_error,
            },
            doing,
            enabled: status.enabled,
            homed: status.homed() || status.homing == HomingStatus::Attained,
            held_by_range: status.held_by_range,
            trouble,
        }
    }

    /// Returns the axis' current motion with its unit.
    pub fn doing(&self) -> String {
        let unit = &self.unit;
        match self.doing {
            Activity::Nothing if self.enabled => "holds".to_owned(),
            Activity::Nothing => "no power".to_owned(),
            Activity::Jogging { .. } if self.held_by_range => {
                "jogs, at the end of its range".into()
            }
            Activity::Jogging { velocity } => format!("jogs at {} {unit}/s", number(velocity)),
            Activity::Moving { by: true, value } => format!("moves by {} {unit}", number(value)),
            Activity::Moving { by: false, value } => format!("moves to {} {unit}", number(value)),
            Activity::Enabling => "is being enabled".to_owned(),
            Activity::Disabling => "is being disabled".to_owned(),
            Activity::Turning { velocity } => format!("turns at {} {unit}/s", number(velocity)),
            Activity::Pressing { percent } => format!("presses with {} %", number(percent)),
            Activity::Homing => "looks for home".to_owned(),
            Activity::Switching { to } => format!("is switched to {to}"),
            Activity::Resetting => "is being reset".to_owned(),
            Activity::Stopping => "brakes".to_owned(),
        }
    }
}

/// Formats a number without trailing zeros and without negative zero.
pub(super) fn number(x: f64) -> String {
    let text = format!("{x:.4}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    if text == "-0" {
        "0".to_owned()
    } else {
        text.to_owned()
    }
}

/// The latest messages.
#[derive(Debug, Clone, Default)]
pub(super) struct Messages(VecDeque<Message>);

#[derive(Debug, Clone, PartialEq)]
pub(super) struct Message {
    pub text: String,
    pub bad: bool,
    pub times: u32,
}

impl Messages {
    const MOST: usize = 50;

    pub fn show(&mut self, text: String, bad: bool) {
        match self.0.back_mut() {
            Some(last) if last.text == text => {
                last.times = last.times.saturating_add(1);
            }
            _ => self.0.push_back(Message {
                text,
                bad,
                times: 1,
            }),
        }
        if self.0.len() > Self::MOST {
            self.0.pop_front();
        }
    }

    pub fn last(&self, most: usize) -> impl Iterator<Item = &Message> {
        self.0.iter().skip(self.0.len().saturating_sub(most))
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// Returns axes `a0`, `a1` …: enabled, at 1.5 mm, range −50 to 50 mm, at most 100 mm/s.
    pub fn panel(axes: usize) -> Panel {
        let axis = |n: usize| AxisPanel {
            name: format!("a{n}"),
            unit: "mm".to_owned(),
            state: State::OperationEnabled,
            mode: Mode::Csp,
            modes: vec![Mode::Csp],
            position: 1.5,
            velocity: 0.0,
            torque: 0.0,
            torque_unit: TorqueUnit::Percent,
            following_error: 0.0,
            target: 1.5,
            limits: Limits {
                position: Some([-50.0, 50.0]),
                velocity: 100.0,
                torque: 100.0,
                following_error: None,
            },
            doing: Activity::Nothing,
            enabled: true,
            homed: false,
            held_by_range: false,
            trouble: None,
        };
        Panel {
            axes: (0..axes).map(axis).collect(),
            ..Panel::default()
        }
    }

    #[test]
    fn numbers_are_short() {
        for (x, text) in [
            (0.0, "0"),
            (-0.00001, "0"),
            (12.5, "12.5"),
            (-3.0, "-3"),
            (0.1234567, "0.1235"),
        ] {
            assert_eq!(number(x), text);
        }
    }
}
