//! From requests, time and what the axes report to commands. No I/O, no clock.

use std::fmt;

use ecaxis_axis::units::UserUnits;
use ecaxis_axis::{AxisStatus, Command, HomingStatus, Mode, Refused};

use super::{LET_GO, MOST_SPEED, News, Pending, Presence, RAMP, Request};
use crate::clock::Nanos;
use crate::config::{AxisSetup, Machine};
use crate::rt::handover::Snapshot;

/// An axis whose set-point has arrived may take so long to follow.
const SETTLE: Nanos = 5_000_000_000;
const STOPPED: &str = "its group has been stopped";

/// What an axis is doing because somebody asked for it.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Doing {
    #[default]
    Nothing,
    Enabling,
    Disabling,
    /// At this velocity, as long as somebody keeps asking for it.
    Jogging {
        velocity: f64,
    },
    /// To a position, or by a distance.
    Moving {
        by: bool,
        value: f64,
    },
    Homing,
    Switching {
        to: Mode,
    },
    Resetting,
    Stopping,
}

impl Doing {
    fn moves(self) -> bool {
        matches!(
            self,
            Self::Jogging { .. } | Self::Moving { .. } | Self::Homing
        )
    }
}

impl fmt::Display for Doing {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Nothing => f.write_str("nothing"),
            Self::Enabling => f.write_str("enable"),
            Self::Disabling => f.write_str("disable"),
            Self::Jogging { velocity } => write!(f, "jog at {velocity}"),
            Self::Moving { by: true, value } => write!(f, "move by {value}"),
            Self::Moving { by: false, value } => write!(f, "move to {value}"),
            Self::Homing => f.write_str("home"),
            Self::Switching { to } => write!(f, "mode {to}"),
            Self::Resetting => f.write_str("reset"),
            Self::Stopping => f.write_str("stop"),
        }
    }
}

/// One axis in the operator's hand.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Hand {
    pub doing: Doing,
    /// When it was asked for; a jog: last. A move: when its set-point was last on its way.
    pub since: Nanos,
}

/// All axes.
#[derive(Debug)]
pub(super) struct Desk {
    pub hands: Vec<Hand>,
    pub news: Pending,
    /// Longest time for what only a drive can be waited for.
    patience: Nanos,
}

/// What a desk looks at.
#[derive(Debug, Clone, Copy)]
pub(super) struct Scene<'s> {
    pub now: Nanos,
    pub machine: &'s Machine,
    /// As in [`super::View`].
    pub axes: &'s [usize],
    pub snapshot: &'s Snapshot,
}

impl Scene<'_> {
    fn setup(&self, axis: usize) -> Option<&AxisSetup> {
        let device = self.machine.devices.get(*self.axes.get(axis)?)?;
        device.axis.as_ref()
    }

    fn group(&self, axis: usize) -> usize {
        let device = self.axes.get(axis);
        device.map_or(0, |&device| self.machine.group_of(device))
    }

    fn enabled(&self, axis: usize) -> bool {
        let status = self.snapshot.axes.get(axis);
        status.is_some_and(|status| status.enabled)
    }

    /// A velocity that is reached goes on: the set-point has arrived, and moves.
    fn moving(&self, axis: usize) -> bool {
        let status = self.snapshot.axes.get(axis);
        status.is_some_and(|s| s.enabled && (s.moving || s.target_velocity != 0.0))
    }

    fn stopped(&self, axis: usize) -> bool {
        let group = self.snapshot.groups.get(self.group(axis));
        group.is_some_and(|group| group.stopped.is_some())
    }
}

/// Commands for axes by their places.
pub(super) type Commands = Vec<(usize, Command)>;

impl Desk {
    pub fn new(axes: usize, patience: Nanos) -> Self {
        Self {
            hands: vec![Hand::default(); axes],
            news: Pending::new(),
            patience,
        }
    }

    /// The cycle did not take what was ordered of an axis. Whatever it is doing instead is not what was last asked for; the
    /// snapshot may not show it yet.
    pub fn refused(&mut self, axis: usize, reason: Refused, scene: &Scene<'_>, out: &mut Commands) {
        if let Some(hand) = self.hands.get_mut(axis) {
            let moved = hand.doing.moves();
            if moved && scene.moving(axis) {
                hand.stop(axis, scene.now, out);
            } else {
                hand.doing = Doing::Nothing;
                if moved && scene.enabled(axis) {
                    out.push((axis, Command::Stop));
                }
            }
        }
        let why = reason.to_string();
        self.news.push_back(News::Refused { axis, why });
    }

    /// What has come to its end since the last look; to be called only with a snapshot that shows what was ordered.
    pub fn look(&mut self, scene: &Scene<'_>, out: &mut Commands) {
        for (axis, hand) in self.hands.iter_mut().enumerate() {
            let Some(status) = scene.snapshot.axes.get(axis) else {
                continue;
            };
            let what = hand.doing;
            let Some(end) = hand.end(status, scene.stopped(axis), scene.now, self.patience) else {
                continue;
            };
            hand.doing = Doing::Nothing;
            self.news.push_back(match end {
                Ok(()) => News::Done { axis, what },
                Err(why) => {
                    if what == Doing::Enabling {
                        out.push((axis, Command::Disable));
                    }
                    News::Failed { axis, what, why }
                }
            });
        }
    }

    /// Whether anybody is there; to be called before what they ask for is taken.
    pub fn watch(&mut self, scene: &Scene<'_>, presence: Presence, out: &mut Commands) {
        for (axis, hand) in self.hands.iter_mut().enumerate() {
            let late = scene.now.saturating_sub(hand.since) >= LET_GO;
            let moving = scene.moving(axis);
            match hand.doing {
                Doing::Jogging { .. } if late && presence == Presence::Here => {
                    self.news.push_back(News::LetGo { axis });
                    hand.stop(axis, scene.now, out);
                }
                Doing::Enabling if presence != Presence::Here => {
                    hand.begin(Doing::Disabling, scene.now);
                    out.push((axis, Command::Disable));
                }
                Doing::Stopping | Doing::Disabling => {}
                doing if presence != Presence::Here && (doing.moves() || moving) => {
                    self.news.push_back(News::LetGo { axis });
                    hand.stop(axis, scene.now, out);
                }
                _ => {}
            }
        }
    }

    /// Whether something moves that somebody has to keep an eye on.
    pub fn moves(&self) -> bool {
        self.hands.iter().any(|hand| hand.doing.moves())
    }

    /// Brings to rest whatever moves.
    pub fn brake(&mut self, scene: &Scene<'_>, out: &mut Commands) {
        for (axis, hand) in self.hands.iter_mut().enumerate() {
            if hand.doing.moves() {
                hand.stop(axis, scene.now, out);
            }
        }
    }

    /// Takes one request of somebody who is there, or says why not.
    pub fn take(&mut self, request: Request, scene: &Scene<'_>, out: &mut Commands) {
        match request {
            Request::StopAll => {
                for (axis, hand) in self.hands.iter_mut().enumerate() {
                    if scene.enabled(axis) {
                        hand.stop(axis, scene.now, out);
                    }
                }
            }
            Request::EmergencyStop => {
                for (axis, hand) in self.hands.iter_mut().enumerate() {
                    hand.begin(Doing::Stopping, scene.now);
                    out.push((axis, Command::EmergencyStop));
                }
            }
            Request::Reset { axis } => self.reset(axis, scene, out),
            Request::Enable { axis } => {
                self.begin(axis, Doing::Enabling, Command::Enable, scene, out);
            }
            Request::Disable { axis } => {
                self.begin(axis, Doing::Disabling, Command::Disable, scene, out);
            }
            Request::Stop { axis } => {
                self.begin(axis, Doing::Stopping, Command::Stop, scene, out);
            }
            Request::SetMode { axis, mode } => {
                let doing = Doing::Switching { to: mode };
                self.begin(axis, doing, Command::SetMode(mode), scene, out);
            }
            Request::Jog { axis, velocity } => self.jog(axis, velocity, scene, out),
            Request::MoveBy { .. } | Request::MoveTo { .. } | Request::Home { .. } => {
                match motion(request, scene) {
                    Ok((axis, doing, command)) => self.begin(axis, doing, command, scene, out),
                    Err((axis, why)) => self.news.push_back(News::Refused { axis, why }),
                }
            }
        }
    }

    fn begin(
        &mut self,
        axis: usize,
        doing: Doing,
        command: Command,
        scene: &Scene<'_>,
        out: &mut Commands,
    ) {
        if let Some(hand) = self.hands.get_mut(axis) {
            hand.give_way(doing, axis, out);
            hand.begin(doing, scene.now);
            out.push((axis, command));
        }
    }

    fn jog(&mut self, axis: usize, velocity: f64, scene: &Scene<'_>, out: &mut Commands) {
        let (Some(hand), Some(setup)) = (self.hands.get_mut(axis), scene.setup(axis)) else {
            return;
        };
        let most = MOST_SPEED * setup.config.limits.velocity;
        // What is no number is not within anything.
        if !(-most..=most).contains(&velocity) {
            let unit = &setup.unit;
            let why = format!("{velocity} {unit}/s is more than the {most} {unit}/s of a jog");
            self.news.push_back(News::Refused { axis, why });
            return;
        }
        if velocity == 0.0 {
            hand.stop(axis, scene.now, out);
            return;
        }
        let doing = Doing::Jogging { velocity };
        let goes_on = hand.doing == doing;
        hand.begin(doing, scene.now);
        if !goes_on {
            let ramp = RAMP;
            out.push((axis, Command::Velocity { velocity, ramp }));
        }
    }

    /// With everything that stopped together with it.
    fn reset(&mut self, axis: usize, scene: &Scene<'_>, out: &mut Commands) {
        let group = scene.group(axis);
        let stopped = scene.stopped(axis);
        for (other, hand) in self.hands.iter_mut().enumerate() {
            let status = scene.snapshot.axes.get(other);
            let ill = status.is_some_and(|s| s.fault.is_some() || s.trip.is_some());
            let with_it = group != 0 && scene.group(other) == group && (ill || stopped);
            if other == axis || with_it {
                hand.give_way(Doing::Resetting, other, out);
                hand.begin(Doing::Resetting, scene.now);
                out.push((other, Command::ResetFault));
            }
        }
    }
}

impl Hand {
    fn begin(&mut self, doing: Doing, now: Nanos) {
        (self.doing, self.since) = (doing, now);
    }

    /// Before something else takes its place. Most of it leaves the set-point alone, and a motion may be refused: nothing that
    /// nobody watches any more goes on behind it. What is taken in the same cycle takes over without braking first.
    fn give_way(&self, next: Doing, axis: usize, out: &mut Commands) {
        let jogs = matches!(self.doing, Doing::Jogging { .. });
        let brakes = matches!(next, Doing::Stopping | Doing::Disabling);
        if !brakes && (jogs || (self.doing.moves() && !next.moves())) {
            out.push((axis, Command::Stop));
        }
    }

    fn stop(&mut self, axis: usize, now: Nanos, out: &mut Commands) {
        self.begin(Doing::Stopping, now);
        out.push((axis, Command::Stop));
    }

    /// How what it is doing has ended, if it has.
    fn end(
        &mut self,
        status: &AxisStatus,
        stopped: bool,
        now: Nanos,
        patience: Nanos,
    ) -> Option<Result<(), String>> {
        let waited = now.saturating_sub(self.since);
        if self.doing.moves() && (stopped || !status.enabled) {
            let why = if stopped {
                STOPPED
            } else {
                "the axis has no power any more"
            };
            return Some(Err(why.to_owned()));
        }
        let done = match self.doing {
            // It ends by being let go.
            Doing::Nothing | Doing::Jogging { .. } => return None,
            Doing::Enabling if stopped => return Some(Err(STOPPED.to_owned())),
            Doing::Enabling => status.ready,
            Doing::Disabling => !status.state.has_power(),
            Doing::Stopping => !(status.enabled && status.moving),
            Doing::Moving { .. } => {
                if status.moving && !status.held_by_range {
                    self.since = now;
                } else if !status.in_target && waited > SETTLE {
                    return Some(Err(format!(
                        "not reached, stands at {:.4}",
                        status.position
                    )));
                }
                return status.in_target.then_some(Ok(()));
            }
            Doing::Homing => {
                return match status.homing {
                    HomingStatus::Failed(error) => Some(Err(error.to_string())),
                    HomingStatus::None => Some(Err("the axis has not begun it".to_owned())),
                    HomingStatus::Attained if status.switching.is_none() && status.ready => {
                        Some(Ok(()))
                    }
                    _ => None,
                };
            }
            Doing::Switching { to } => {
                if status.switch_failed == Some(to) {
                    return Some(Err("the drive does not show it".to_owned()));
                }
                status.mode == to && status.switching.is_none()
            }
            Doing::Resetting => {
                if status.reset_failed {
                    return Some(Err(status.fault.map_or_else(
                        || "the drive stays in Fault".to_owned(),
                        |fault| fault.to_string(),
                    )));
                }
                !status.resetting && status.fault.is_none() && status.trip.is_none() && !stopped
            }
        };
        if done {
            return Some(Ok(()));
        }
        (waited > patience).then(|| {
            Err(match status.waiting {
                Some(waiting) if self.doing == Doing::Enabling => waiting.to_string(),
                _ => format!("not done in time; the drive is in {}", status.state),
            })
        })
    }
}

type Motion = (usize, Doing, Command);

/// A motion that ends by itself.
fn motion(request: Request, scene: &Scene<'_>) -> Result<Motion, (usize, String)> {
    let ramp = RAMP;
    let slow = |axis: usize, speed: f64| {
        if speed > 0.0 && speed <= MOST_SPEED {
            return Ok(());
        }
        let [speed, most] = [speed, MOST_SPEED].map(|part| part * 100.0);
        Err((
            axis,
            format!("{speed} % is not a speed above 0 and up to {most} %"),
        ))
    };
    match request {
        Request::MoveBy {
            axis,
            distance,
            speed,
        } => {
            slow(axis, speed)?;
            let doing = Doing::Moving {
                by: true,
                value: distance,
            };
            let command = Command::MoveBy {
                distance,
                speed,
                ramp,
            };
            Ok((axis, doing, command))
        }
        Request::MoveTo {
            axis,
            position,
            speed,
        } => {
            slow(axis, speed)?;
            let doing = Doing::Moving {
                by: false,
                value: position,
            };
            let there = scene.setup(axis).zip(scene.snapshot.axes.get(axis));
            let there = there.map_or(position, |(setup, status)| {
                let from = UserUnits(status.target_position);
                let scale = &setup.config.scale;
                scale.destination(from, UserUnits(position), setup.way).0
            });
            let command = Command::MoveTo {
                position: there,
                speed,
                ramp,
            };
            Ok((axis, doing, command))
        }
        Request::Home { axis } => {
            let setup = scene.setup(axis).and_then(|setup| setup.homing.as_ref());
            let Some(homing) = setup else {
                return Err((
                    axis,
                    "the machine file says nothing of its homing".to_owned(),
                ));
            };
            let timeout_s = homing.timeout_ns as f64 * 1e-9;
            Ok((axis, Doing::Homing, Command::Home { timeout_s }))
        }
        _ => Err((0, "not a motion".to_owned())),
    }
}
