//! What is shown of the machine: taken from the view beside the cycle, drawn elsewhere.

use std::collections::VecDeque;

use ecaxis::config::{AxisSetup, TorqueUnit};
use ecaxis::supervise::manual::{Doing, View};
use ecaxis_axis::units::UserUnits;
use ecaxis_axis::{AxisStatus, HomingStatus, Mode, State};
use serde::Serialize;

/// Modes that an axis can be told to be in.
const MODES: [Mode; 5] = [Mode::Csp, Mode::Csv, Mode::Cst, Mode::Pp, Mode::Pv];

#[derive(Debug, Clone, Default)]
pub(super) struct Panel {
    /// Of the run.
    pub time_s: f64,
    pub lost_frames: u64,
    pub wkc_errors: u64,
    pub locked: Option<bool>,
    pub axes: Vec<AxisPanel>,
}

/// One axis; values in its units.
#[derive(Debug, Clone)]
pub(super) struct AxisPanel {
    pub name: String,
    pub unit: String,
    pub state: State,
    pub mode: Mode,
    /// That it can be switched to, `mode` among them.
    pub modes: Vec<Mode>,
    pub position: f64,
    pub velocity: f64,
    pub torque: f64,
    pub torque_unit: TorqueUnit,
    pub following_error: f64,
    pub target: f64,
    pub limits: Limits,
    pub doing: Doing,
    pub enabled: bool,
    pub homed: bool,
    pub held_by_range: bool,
    /// Fault, trip, or why it waits.
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
        let axes = view.axes.iter().enumerate();
        let axes = axes.filter_map(|(axis, &device)| {
            let device = view.machine.devices.get(device)?;
            let setup = device.axis.as_ref()?;
            let status = snapshot.axes.get(axis)?;
            let doing = view.hands.get(axis).map(|hand| hand.doing);
            let group = snapshot
                .groups
                .get(view.machine.group_of(*view.axes.get(axis)?));
            let stopped = group.is_some_and(|group| group.stopped.is_some());
            let doing = doing.unwrap_or_default();
            Some(AxisPanel::new(&device.name, setup, status, doing, stopped))
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
        doing: Doing,
        stopped: bool,
    ) -> Self {
        let config = &setup.config;
        let place = |position| config.scale.place(UserUnits(position)).0;
        let fits = |mode: &Mode| config.modes.contains(*mode) || *mode == config.mode;
        let trouble = match (status.fault, status.trip, status.waiting) {
            (Some(fault), ..) => Some(fault.to_string()),
            (_, Some(trip), _) => Some(trip.to_string()),
            _ if stopped => Some("its group has been stopped".to_owned()),
            (.., Some(waiting)) if doing == Doing::Enabling => Some(waiting.to_string()),
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
            homed: status.homed || status.homing == HomingStatus::Attained,
            held_by_range: status.held_by_range,
            trouble,
        }
    }

    /// What an axis is doing for the operator, with its unit.
    pub fn doing(&self) -> String {
        let unit = &self.unit;
        match self.doing {
            Doing::Nothing if self.enabled => "holds".to_owned(),
            Doing::Nothing => "no power".to_owned(),
            Doing::Jogging { .. } if self.held_by_range => "jogs, at the end of its range".into(),
            Doing::Jogging { velocity } => format!("jogs at {} {unit}/s", number(velocity)),
            Doing::Moving { by: true, value } => format!("moves by {} {unit}", number(value)),
            Doing::Moving { by: false, value } => format!("moves to {} {unit}", number(value)),
            Doing::Enabling => "is being enabled".to_owned(),
            Doing::Disabling => "is being disabled".to_owned(),
            Doing::Homing => "looks for home".to_owned(),
            Doing::Switching { to } => format!("is switched to {to}"),
            Doing::Resetting => "is being reset".to_owned(),
            Doing::Stopping => "brakes".to_owned(),
        }
    }
}

/// Without zeros at its end, and without a negative zero.
pub(super) fn number(x: f64) -> String {
    let text = format!("{x:.4}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    if text == "-0" {
        "0".to_owned()
    } else {
        text.to_owned()
    }
}

/// The last things that happened.
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

    pub fn tell(&mut self, text: String, bad: bool) {
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

    /// `a0`, `a1` …: enabled at 1.5 mm of −50 to 50, at most 100 mm/s.
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
            doing: Doing::Nothing,
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
