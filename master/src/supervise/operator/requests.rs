//! Turns requests, time and the axes' status into commands. No I/O, no clock.

use ecaxis_axis::units::UserUnits;
use ecaxis_axis::{AxisStatus, Command, CommandError, EnableBlocker, HomingStatus, Mode};
use ecaxis_ecat::index::{AxisIndex, GroupIndex, IndexVec};

use super::activity::Activity;
use super::{
    HOLD_TO_RUN_TIMEOUT, LimitShares, MAX_MANUAL_SPEED, Pending, Presence, RAMP, Request,
    RequestEvent,
};
use crate::clock::Nanos;
use crate::config::{AxisSetup, Machine};
use crate::rt::channel::Snapshot;
use crate::rt::gateway::NodeState;

/// The timeout in ns for an axis to follow after its set-point has arrived.
const SETTLE: Nanos = 5_000_000_000;
const MANUAL_PROFILE: &str = "by hand an axis moves with a part of its limits, and in PP this drive \
    moves with its own speed and ramp: move it by a program, or use it in CSP";
const READS_MODE: &str = "the axis is being enabled: its mode is read over CoE (0x6061)";
const STOPPED: &str = "its group has been stopped";

/// The state of one axis in manual mode.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct AxisActivity {
    pub doing: Activity,
    /// The reading of the mode since the axis was enabled, if it is not in the process data.
    mode: Option<ModeReading>,
    /// The time of the request. For a jog, the last request; for a move, the last time its
    /// set-point moved.
    pub since: Nanos,
    /// The number of the request; 0 once its result is reported.
    pub(super) request: u64,
}

/// The reading of a mode over CoE.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ModeReading {
    /// It starts when the axis has power.
    Needed,
    Pending,
    Confirmed,
}

/// The state of all axes in manual mode.
#[derive(Debug)]
pub(super) struct RequestController {
    pub hands: IndexVec<AxisIndex, AxisActivity>,
    pub news: Pending,
    /// Axes with power whose mode must be read over CoE before they are enabled.
    pub unread: Vec<AxisIndex>,
    /// Axes whose process data does not show their mode.
    hidden: IndexVec<AxisIndex, bool>,
    /// The maximum time in ns to wait for a drive.
    timeout: Nanos,
    shares: LimitShares,
    /// The number of the request that is being taken.
    number: u64,
}

/// The inputs of [`RequestController`].
#[derive(Debug, Clone, Copy)]
pub(super) struct RequestContext<'s> {
    pub now: Nanos,
    pub machine: &'s Machine,
    pub snapshot: &'s Snapshot,
}

impl RequestContext<'_> {
    fn setup(&self, axis: AxisIndex) -> Option<&AxisSetup> {
        self.machine.axes.get(axis)
    }

    fn group(&self, axis: AxisIndex) -> GroupIndex {
        self.machine.group_of_axis(axis)
    }

    fn mode(&self, axis: AxisIndex) -> Option<Mode> {
        Some(self.snapshot.axes.get(axis)?.mode)
    }

    /// Returns `true` if a stop has something to end: power, or a switch of the mode without power,
    /// after which power returns.
    fn is_commanded(&self, axis: AxisIndex) -> bool {
        let status = self.snapshot.axes.get(axis);
        status.is_some_and(|status| status.enabled || status.switching.is_some())
    }

    fn has_power(&self, axis: AxisIndex) -> bool {
        let status = self.snapshot.axes.get(axis);
        status.is_some_and(|status| status.enabled)
    }

    /// Returns `true` while the set-point moves. At constant velocity the set-point has arrived but
    /// still moves.
    fn moving(&self, axis: AxisIndex) -> bool {
        let status = self.snapshot.axes.get(axis);
        status.is_some_and(|s| s.enabled && (s.moving || s.target_velocity != 0.0))
    }

    fn stopped(&self, axis: AxisIndex) -> bool {
        let group = self.snapshot.groups.get(self.group(axis));
        group.is_some_and(|group| group.stopped.is_some())
    }
}

/// Commands with the indices of their axes.
pub(super) type Commands = Vec<(AxisIndex, Command)>;

impl RequestController {
    /// `hidden`: for each axis, true if its process data does not show its mode.
    pub fn new(hidden: Vec<bool>, timeout: Nanos, shares: LimitShares) -> Self {
        Self {
            hands: vec![AxisActivity::default(); hidden.len()].into(),
            news: Pending::new(),
            unread: Vec::new(),
            hidden: hidden.into(),
            timeout,
            shares,
            number: 0,
        }
    }

    fn refuse(&mut self, axis: AxisIndex, why: String) {
        let request = self.number;
        self.news
            .push_back(RequestEvent::Refused { request, axis, why });
    }

    /// Handles a command that the cycle refused. The snapshot may not show yet what the axis does
    /// instead.
    pub fn refused(
        &mut self,
        axis: AxisIndex,
        reason: CommandError,
        scene: &RequestContext<'_>,
        out: &mut Commands,
    ) {
        let mut request = 0;
        if let Some(hand) = self.hands.get_mut(axis) {
            request = std::mem::take(&mut hand.request);
            let moved = hand.doing.moves();
            if moved && scene.moving(axis) {
                hand.stop(axis, scene.now, out);
            } else {
                hand.doing = Activity::Nothing;
                if moved && scene.is_commanded(axis) {
                    out.push((axis, Command::Stop));
                }
            }
        }
        let why = reason.to_string();
        self.news
            .push_back(RequestEvent::Refused { request, axis, why });
    }

    /// Reports finished activities. The snapshot must already show the effect of all commands.
    pub fn look(&mut self, scene: &RequestContext<'_>, out: &mut Commands) {
        for (axis, hand) in self.hands.enumerate_mut() {
            let Some(status) = scene.snapshot.axes.get(axis) else {
                continue;
            };
            if status.ready && hand.mode == Some(ModeReading::Needed) {
                hand.mode = Some(ModeReading::Pending);
                self.unread.push(axis);
            }
            let what = hand.doing;
            let Some(end) = hand.end(status, scene, axis, self.timeout) else {
                continue;
            };
            if what == Activity::Enabling && end.is_ok() && hand.reads_mode() {
                continue;
            }
            let request = std::mem::take(&mut hand.request);
            // Such a motion goes on, and its end by a stop or a fault is still watched.
            let goes_on = matches!(what, Activity::Turning { .. } | Activity::Pressing { .. });
            if goes_on && end.is_ok() {
                if request != 0 {
                    self.news.push_back(RequestEvent::Done {
                        request,
                        axis,
                        what,
                    });
                }
                continue;
            }
            hand.doing = Activity::Nothing;
            self.news.push_back(match end {
                Ok(()) => RequestEvent::Done {
                    request,
                    axis,
                    what,
                },
                Err(why) => {
                    if what == Activity::Enabling {
                        out.push((axis, Command::Disable));
                    }
                    RequestEvent::Failed {
                        request,
                        axis,
                        what,
                        why,
                    }
                }
            });
        }
    }

    /// Permits the motion of an axis whose mode was read, or fails its enabling. Returns true if the
    /// axis must be disabled.
    pub fn mode_was_read(&mut self, axis: AxisIndex, checked: Result<(), String>) -> bool {
        let waits = |hand: &&mut AxisActivity| hand.mode == Some(ModeReading::Pending);
        let Some(hand) = self.hands.get_mut(axis).filter(waits) else {
            return false;
        };
        let Err(why) = checked else {
            hand.mode = Some(ModeReading::Confirmed);
            return false;
        };
        (hand.doing, hand.mode) = (Activity::Nothing, Some(ModeReading::Needed));
        self.news.push_back(RequestEvent::Failed {
            request: std::mem::take(&mut hand.request),
            axis,
            what: Activity::Enabling,
            why,
        });
        true
    }

    /// Stops motion without an operator or a repeated jog request. Must be called before `take`.
    pub fn watch(&mut self, scene: &RequestContext<'_>, presence: Presence, out: &mut Commands) {
        for (axis, hand) in self.hands.enumerate_mut() {
            let late = scene.now.saturating_sub(hand.since) >= HOLD_TO_RUN_TIMEOUT;
            let moving = scene.moving(axis);
            match hand.doing {
                Activity::Jogging { .. } if late && presence == Presence::Here => {
                    let request = std::mem::take(&mut hand.request);
                    self.news.push_back(RequestEvent::LetGo { request, axis });
                    hand.stop(axis, scene.now, out);
                }
                Activity::Enabling if presence != Presence::Here => {
                    hand.begin(Activity::Disabling, scene.now);
                    out.push((axis, Command::Disable));
                }
                Activity::Stopping | Activity::Disabling => {}
                doing if presence != Presence::Here && (doing.moves() || moving) => {
                    let request = std::mem::take(&mut hand.request);
                    self.news.push_back(RequestEvent::LetGo { request, axis });
                    hand.stop(axis, scene.now, out);
                }
                _ => {}
            }
        }
    }

    /// Returns `true` while anything moves that the operator must supervise.
    pub fn moves(&self) -> bool {
        self.hands.iter().any(|hand| hand.doing.moves())
    }

    /// Executes one request of a present operator, or reports why it is refused.
    pub fn take(
        &mut self,
        number: u64,
        request: Request,
        scene: &RequestContext<'_>,
        out: &mut Commands,
    ) {
        self.number = number;
        let moves = matches!(
            request,
            Request::Jog { .. }
                | Request::MoveBy { .. }
                | Request::MoveTo { .. }
                | Request::Home { .. }
                | Request::Velocity { .. }
                | Request::Torque { .. }
        );
        if let Some(axis) = request.axis().filter(|_| moves)
            && self.hands.get(axis).is_some_and(AxisActivity::reads_mode)
        {
            self.refuse(axis, READS_MODE.to_owned());
            return;
        }
        match request {
            Request::StopAll => {
                for (axis, hand) in self.hands.enumerate_mut() {
                    if scene.is_commanded(axis) || hand.doing == Activity::Enabling {
                        let (doing, command) = hand.end_of_activity(scene.has_power(axis));
                        hand.begin(doing, scene.now);
                        out.push((axis, command));
                    }
                }
            }
            Request::EmergencyStop => {
                for (axis, hand) in self.hands.enumerate_mut() {
                    hand.begin(Activity::Stopping, scene.now);
                    out.push((axis, Command::EmergencyStop));
                }
            }
            Request::Reset { axis } => self.reset(axis, scene, out),
            Request::Enable { axis } => {
                self.begin(axis, Activity::Enabling, Command::Enable, scene, out);
            }
            Request::Disable { axis } => {
                self.begin(axis, Activity::Disabling, Command::Disable, scene, out);
            }
            Request::Stop { axis } => {
                let hand = self.hands.get(axis).copied().unwrap_or_default();
                let (doing, command) = hand.end_of_activity(scene.has_power(axis));
                self.begin(axis, doing, command, scene, out);
            }
            Request::SetMode { axis, mode } => {
                let doing = Activity::Switching { to: mode };
                self.begin(axis, doing, Command::SetMode(mode), scene, out);
            }
            Request::QuickStop { axis } => {
                self.begin(axis, Activity::Stopping, Command::QuickStop, scene, out);
            }
            Request::Jog { axis, velocity } => self.jog(axis, velocity, scene, out),
            Request::MoveBy { .. }
            | Request::MoveTo { .. }
            | Request::Home { .. }
            | Request::Velocity { .. }
            | Request::Torque { .. } => match self.motion(request, scene) {
                Ok((axis, doing, command)) => self.begin(axis, doing, command, scene, out),
                Err((axis, why)) => self.refuse(axis, why),
            },
            // The loop that serves the operator takes these.
            Request::SetOutput { .. }
            | Request::Node { .. }
            | Request::SimInput(_)
            | Request::Override { .. }
            | Request::Hold { .. }
            | Request::Program(_) => {}
        }
    }

    fn begin(
        &mut self,
        axis: AxisIndex,
        doing: Activity,
        command: Command,
        scene: &RequestContext<'_>,
        out: &mut Commands,
    ) {
        if let Some(hand) = self.hands.get_mut(axis) {
            hand.preempt(doing, axis, out);
            hand.begin(doing, scene.now);
            hand.replace(axis, self.number, &mut self.news);
            if doing == Activity::Enabling && self.hidden.get(axis) == Some(&true) {
                hand.mode = Some(ModeReading::Needed);
            }
            out.push((axis, command));
        }
    }

    fn jog(
        &mut self,
        axis: AxisIndex,
        velocity: f64,
        scene: &RequestContext<'_>,
        out: &mut Commands,
    ) {
        let Some(setup) = scene.setup(axis) else {
            return;
        };
        let most = MAX_MANUAL_SPEED * setup.config.limits.velocity;
        // Written so that NaN is rejected, too.
        if !(-most..=most).contains(&velocity) {
            let unit = &setup.unit;
            let why = format!("{velocity} {unit}/s is more than the {most} {unit}/s of a jog");
            self.refuse(axis, why);
            return;
        }
        if velocity != 0.0 && scene.mode(axis) == Some(Mode::Pp) {
            let why =
                "a jog needs CSP, CSV or PV; the axis is in PP, where the drive takes positions";
            self.refuse(axis, why.to_owned());
            return;
        }
        let Some(hand) = self.hands.get_mut(axis) else {
            return;
        };
        if matches!(hand.doing, Activity::Jogging { .. }) {
            hand.request = self.number;
        } else {
            hand.replace(axis, self.number, &mut self.news);
        }
        if velocity == 0.0 {
            hand.stop(axis, scene.now, out);
            return;
        }
        let doing = Activity::Jogging { velocity };
        let goes_on = hand.doing == doing;
        hand.begin(doing, scene.now);
        if !goes_on {
            let ramp = RAMP;
            out.push((axis, Command::Velocity { velocity, ramp }));
        }
    }

    /// Returns a motion.
    fn motion(
        &mut self,
        request: Request,
        scene: &RequestContext<'_>,
    ) -> Result<Motion, (AxisIndex, String)> {
        let LimitShares { speed: most, ramp } = self.shares;
        let check = |axis: AxisIndex, speed: f64| {
            let fixed = scene.setup(axis).is_some_and(|s| s.config.profile_fixed);
            if fixed && ramp < 1.0 && scene.mode(axis) == Some(Mode::Pp) {
                return Err((axis, MANUAL_PROFILE.to_owned()));
            }
            if speed > 0.0 && speed <= most {
                return Ok(());
            }
            let [speed, most] = [speed, most].map(|part| part * 100.0);
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
                check(axis, speed)?;
                let doing = Activity::Moving {
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
                check(axis, speed)?;
                let doing = Activity::Moving {
                    by: false,
                    value: position,
                };
                Ok((axis, doing, self.move_to(axis, position, speed, scene)))
            }
            Request::Velocity { axis, velocity } => {
                let limit = scene.setup(axis).map(|s| most * s.config.limits.velocity);
                // Written so that NaN is rejected, too.
                if !limit.is_some_and(|limit| (-limit..=limit).contains(&velocity)) {
                    let limit = limit.unwrap_or_default();
                    let why = format!("{velocity} is not a velocity between -{limit} and {limit}");
                    return Err((axis, why));
                }
                let doing = Activity::Turning { velocity };
                Ok((axis, doing, Command::Velocity { velocity, ramp }))
            }
            Request::Torque {
                axis,
                percent,
                ramp_s,
            } => {
                let doing = Activity::Pressing { percent };
                Ok((axis, doing, Command::Torque { percent, ramp_s }))
            }
            Request::Home { axis } => {
                let setup = scene.setup(axis).and_then(|setup| setup.homing.as_ref());
                let Some(homing) = setup else {
                    return Err((
                        axis,
                        "the machine file does not configure its homing".to_owned(),
                    ));
                };
                let timeout_s = homing.timeout_ns as f64 * 1e-9;
                Ok((axis, Activity::Homing, Command::Home { timeout_s }))
            }
            _ => Err((AxisIndex::default(), "not a motion".to_owned())),
        }
    }

    /// Returns the command of a move to a position, on a modulo axis in its direction.
    fn move_to(
        &self,
        axis: AxisIndex,
        position: f64,
        speed: f64,
        scene: &RequestContext<'_>,
    ) -> Command {
        let there = scene.setup(axis).zip(scene.snapshot.axes.get(axis));
        let position = there.map_or(position, |(setup, status)| {
            let from = UserUnits(status.target_position);
            let scale = &setup.config.scale;
            scale.destination(from, UserUnits(position), setup.way).0
        });
        Command::MoveTo {
            position,
            speed,
            ramp: self.shares.ramp,
        }
    }

    /// Resets an axis and everything that stopped with it.
    fn reset(&mut self, axis: AxisIndex, scene: &RequestContext<'_>, out: &mut Commands) {
        let group = scene.group(axis);
        let stopped = scene.stopped(axis);
        for (other, hand) in self.hands.enumerate_mut() {
            let status = scene.snapshot.axes.get(other);
            let ill = status.is_some_and(|s| s.fault.is_some() || s.trip.is_some());
            let with_it =
                group != GroupIndex::MACHINE && scene.group(other) == group && (ill || stopped);
            // A reset of all axes names each of them, and each resets the others with it.
            let with_it = with_it && hand.doing != Activity::Resetting;
            if other == axis || with_it {
                hand.preempt(Activity::Resetting, other, out);
                hand.begin(Activity::Resetting, scene.now);
                let number = if other == axis { self.number } else { 0 };
                hand.replace(other, number, &mut self.news);
                out.push((other, Command::ResetFault));
            }
        }
    }
}

impl AxisActivity {
    /// Returns true until the mode is confirmed: the axis must not move before.
    const fn reads_mode(&self) -> bool {
        matches!(self.mode, Some(ModeReading::Needed | ModeReading::Pending))
    }

    /// Takes the number of the next request. The present one has no other outcome.
    fn replace(&mut self, axis: AxisIndex, number: u64, news: &mut Pending) {
        let request = std::mem::replace(&mut self.request, number);
        if request != 0 {
            news.push_back(RequestEvent::Replaced { request, axis });
        }
    }

    fn begin(&mut self, doing: Activity, now: Nanos) {
        (self.doing, self.since) = (doing, now);
    }

    /// Stops the present motion before the next activity. Most activities leave the set-point
    /// alone, and a motion may be refused. Without this stop the axis would move unsupervised. A
    /// motion accepted in the same cycle takes over without braking.
    fn preempt(&self, next: Activity, axis: AxisIndex, out: &mut Commands) {
        let jogs = matches!(self.doing, Activity::Jogging { .. });
        let brakes = matches!(next, Activity::Stopping | Activity::Disabling);
        if !brakes && (jogs || (self.doing.moves() && !next.moves())) {
            out.push((axis, Command::Stop));
        }
    }

    /// Returns what stops the axis. One that is being enabled gets no power. One that has it keeps
    /// it: it may carry a load.
    fn end_of_activity(&self, has_power: bool) -> (Activity, Command) {
        match self.doing {
            Activity::Enabling if !has_power => (Activity::Disabling, Command::Disable),
            _ => (Activity::Stopping, Command::Stop),
        }
    }

    fn stop(&mut self, axis: AxisIndex, now: Nanos, out: &mut Commands) {
        self.begin(Activity::Stopping, now);
        out.push((axis, Command::Stop));
    }

    /// Returns the result of the current activity once it has ended.
    fn end(
        &mut self,
        status: &AxisStatus,
        scene: &RequestContext<'_>,
        axis: AxisIndex,
        timeout: Nanos,
    ) -> Option<Result<(), String>> {
        let (now, stopped) = (scene.now, scene.stopped(axis));
        let waited = now.saturating_sub(self.since);
        // A mode switch may need a time without power.
        let powerless = !status.enabled && status.switching.is_none();
        if self.doing.moves() && (stopped || powerless) {
            let why = if stopped {
                STOPPED
            } else {
                "the axis has no power any more"
            };
            return Some(Err(why.to_owned()));
        }
        let done = match self.doing {
            // A jog ends when its requests end.
            Activity::Nothing | Activity::Jogging { .. } => return None,
            Activity::Enabling if stopped => return Some(Err(STOPPED.to_owned())),
            Activity::Enabling => {
                if status.waiting == Some(EnableBlocker::Held) {
                    self.since = now;
                }
                status.ready
            }
            Activity::Disabling => !status.state.has_power(),
            // Zero torque does not stop an axis.
            Activity::Stopping => {
                let coasts = status.mode == Mode::Cst && !status.at_rest;
                !(status.enabled && (status.moving || coasts))
            }
            Activity::Turning { .. } => return status.in_target.then_some(Ok(())),
            Activity::Pressing { .. } => return (!status.moving).then_some(Ok(())),
            Activity::Moving { .. } => {
                // A move that something has replaced ends elsewhere.
                let there = status.in_target && status.commanded_target.is_some();
                if status.moving && !status.held_by_range {
                    self.since = now;
                } else if !there && waited > SETTLE {
                    return Some(Err(format!(
                        "not reached, stands at {:.4}",
                        status.position
                    )));
                }
                return there.then_some(Ok(()));
            }
            Activity::Homing => {
                return match status.homing {
                    HomingStatus::Failed(error) => Some(Err(error.to_string())),
                    HomingStatus::None => Some(Err("the axis has not begun it".to_owned())),
                    HomingStatus::Attained if status.switching.is_none() && status.ready => {
                        Some(Ok(()))
                    }
                    _ => None,
                };
            }
            Activity::Switching { to } => {
                if status.switch_failed == Some(to) {
                    return Some(Err("the drive does not show it".to_owned()));
                }
                status.mode == to && status.switching.is_none()
            }
            Activity::Resetting => {
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
        (waited > timeout).then(|| {
            let node = scene.snapshot.nodes.get(axis).copied().flatten();
            let lost = node.filter(|state| *state != NodeState::Operational);
            Err(match (lost, status.waiting) {
                (Some(state), _) => format!("its node on the CAN network is {state}"),
                (None, Some(waiting)) if self.doing == Activity::Enabling => waiting.to_string(),
                _ => format!("not done in time; the drive is in {}", status.state),
            })
        })
    }
}

type Motion = (AxisIndex, Activity, Command);
