//! The rules, judged from commands, inputs, outputs and status. They share no code with the axis.

use std::hash::{Hash, Hasher};

use ecaxis_axis::{
    AxisConfig, AxisStatus, Command, HomingStatus, Inputs, Mode, Outputs, PowerLossCause, State,
    Statusword, StopMethod, Trip,
};

use super::drive::{COUNTS_PER_UNIT, DT, MRPM_PER_UNIT};
use super::search::Violation;

/// Rounding to whole counts: of a step, and of the difference of two steps.
const STEP_ROUNDING: f64 = 1.5;
const CHANGE_ROUNDING: f64 = 2.5;

/// The axis waits this long for a drive that does not slow down, beyond speed ÷ acceleration.
const STOP_MARGIN_S: f64 = 2.2;

/// Consecutive fresh cycles of a speed beyond the limit until the axis must have tripped.
const OVERSPEED_CYCLES: u8 = 12;

/// The same for a velocity that contradicts the positions.
const CONTRADICTED_CYCLES: u8 = 20;

/// Consecutive cycles with zero or an unlisted word that are no reason to react.
const STRANGE_CYCLES: u8 = 3;

pub const POWER: &str = "1 no power without a command";
pub const STEP: &str = "2 no step beyond the limits";
pub const DONE: &str = "3 done only at the commanded target";
pub const REMOVAL: &str = "4 no removal of power at speed";
pub const CAUSE: &str = "5 a loss of power has a cause";
pub const GAIN: &str = "6 no gain of speed after a stop";
pub const STOPS: &str = "7 a stop ends at rest or trips";
pub const HOMED: &str = "8 homed by evidence only";
pub const SUPERVISED: &str = "9 supervised while powered";

pub const STRANGE: &str = "10 no reaction to a few strange words";
pub const ENDS: &str = "11 a stop without power is over";

/// Consecutive fresh cycles in which the drive shows no power, until a stop must be over.
const STOPPED_CYCLES: u8 = 20;

/// What a word says of the power.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Shown {
    Nothing,
    Off,
    Enabled,
    QuickStop,
    Fault,
}

/// Returns what a listed word says; `None` for zero, "not ready" and unlisted words.
fn shown(word: u16) -> Option<Shown> {
    Some(
        match State::from_statusword(Statusword::from_bits_retain(word)) {
            State::SwitchOnDisabled | State::ReadyToSwitchOn | State::SwitchedOn => Shown::Off,
            State::OperationEnabled => Shown::Enabled,
            State::QuickStopActive => Shown::QuickStop,
            State::FaultReactionActive | State::Fault => Shown::Fault,
            State::NotReadyToSwitchOn | State::Unknown(_) => return None,
        },
    )
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Target {
    Position(f64),
    Velocity(f64),
}

/// A stop that is not over: the speed of the set-point, and for how long the axis has moved.
#[derive(Debug, Clone, Copy, PartialEq)]
struct StopWatch {
    speed: f64,
    torque: f64,
    slowest: f64,
    moving_s: f64,
}

#[derive(Debug, Clone)]
pub struct Monitor {
    /// Enable was accepted, and the power was not lost since.
    permit: bool,
    /// The last listed word.
    pub shown: Shown,
    /// Operation enabled was shown while it was commanded.
    powered: bool,
    /// The axis has generated set-points since then, and for how many cycles.
    followed: u8,
    /// A command, trip or fault that ends the power.
    ended: bool,
    /// Power may be removed at speed.
    removes: bool,
    /// A command switches the mode of a drive that does so without power: the power is lost for that,
    /// and returns by the same command.
    switches: bool,
    target: Option<Target>,
    stop: Option<StopWatch>,
    home_low: bool,
    over_speed: u8,
    contradicted: u8,
    difference: f64,
    strange: u8,
    unfollowed: u8,
    /// Fresh cycles of a stop for which the drive shows no power.
    stopped: u8,
    /// Counts per cycle: of the target, and of the axis as it began to follow, by both reports.
    step: f64,
    taken_over: [f64; 2],
    /// The last position that was believed, and its age in cycles.
    position: f64,
    age: u16,
    before: Option<(AxisStatus, Outputs)>,
}

/// What happened in a cycle.
#[derive(Debug)]
pub struct Cycle<'a> {
    pub config: &'a AxisConfig,
    pub inputs: &'a Inputs,
    /// The accepted command, or an accepted external set-point.
    pub command: Option<Command>,
    pub set_point: bool,
    /// A coupled axis has a trip or a fault, which stops both: in the last cycle, and in this one.
    pub outside: [bool; 2],
    pub status: &'a AxisStatus,
    pub out: &'a Outputs,
}

fn violation(rule: &'static str, detail: String) -> Result<(), Violation> {
    Err(Violation { rule, detail })
}

const fn word(out: &Outputs) -> u16 {
    out.controlword & 0x0F
}

impl Monitor {
    pub const fn new() -> Self {
        Self {
            permit: false,
            shown: Shown::Nothing,
            powered: false,
            followed: 0,
            ended: false,
            removes: false,
            switches: false,
            target: None,
            stop: None,
            home_low: false,
            over_speed: 0,
            contradicted: 0,
            difference: 0.0,
            strange: 0,
            unfollowed: 0,
            stopped: 0,
            step: 0.0,
            taken_over: [0.0; 2],
            position: 0.0,
            age: 0,
            before: None,
        }
    }

    pub fn check(&mut self, cycle: &Cycle<'_>) -> Result<(), Violation> {
        let Cycle {
            config,
            inputs,
            status,
            out,
            ..
        } = *cycle;
        let Some((was, sent)) = self.before.replace((*status, *out)) else {
            self.position = f64::from(inputs.position.unwrap_or_default());
            return Ok(());
        };
        let before = self.shown;
        let listed = shown(inputs.statusword);
        if inputs.fresh {
            self.shown = listed.unwrap_or(self.shown);
            self.strange = match listed {
                Some(_) => 0,
                None => self.strange.saturating_add(1),
            };
            let low = inputs.statusword & 0x1000 == 0;
            self.unfollowed = if low {
                self.unfollowed.saturating_add(1)
            } else {
                0
            };
        }
        // Positions next to a word that is not listed are not believed.
        let believed = inputs.fresh && listed.is_some();
        let position = f64::from(inputs.position.unwrap_or_default());
        self.age = self.age.saturating_add(1);
        let moved = (position - self.position) / f64::from(self.age);
        if believed {
            (self.position, self.age) = (position, 0);
        }
        let reported = f64::from(inputs.velocity.unwrap_or_default()) / MRPM_PER_UNIT;
        let standstill = config.limits.velocity * 0.01;
        // The speed on which both reports agree.
        let speed = (moved / COUNTS_PER_UNIT / DT).abs().min(reported.abs());
        let moves = believed && speed > standstill * 2.0;
        self.note_commands(cycle, &was);

        // Rule 5, and the end of the permit.
        let lost = self.powered && inputs.fresh && listed.is_some() && self.shown != Shown::Enabled;
        let released = self.powered && word(out) != 0x0F;
        // Rule 10.
        let reacts = was.trip.is_none()
            && matches!(
                status.trip,
                Some(Trip::PowerLost { .. } | Trip::UnlistedStatusword { .. })
            );
        if self.powered && reacts && inputs.fresh && (1..=STRANGE_CYCLES).contains(&self.strange) {
            return violation(
                STRANGE,
                format!("{} cycles, trip {:?}", self.strange, status.trip),
            );
        }

        // The power of a mode switch is removed, not lost.
        let early = lost && self.switches && !self.ended && word(&sent) == 0x0F;
        if early || (lost || released) && !self.is_cause(cycle, &was) {
            let (shown, cause) = (self.shown, status.power_loss_cause);
            return violation(
                CAUSE,
                format!(
                    "{cause:?}: drive {shown:?}, Controlword {:#06x}",
                    out.controlword
                ),
            );
        }
        if lost || released {
            let enabled_now = cycle.command == Some(Command::Enable);
            (self.powered, self.followed) = (false, 0);
            self.permit &= enabled_now || self.switches;
        }
        if self.ended && self.switches {
            self.permit &= self.powered;
            self.switches = false;
        }

        // Rule 1.
        let powers = out.controlword & 7 == 7;
        let keeps = word(&sent) == 0x0F && word(out) == 0x0F && self.shown == Shown::Enabled;
        if powers && !self.permit && !keeps {
            return violation(POWER, format!("Controlword {:#06x}", out.controlword));
        }

        // Rule 4.
        let had_power = matches!(before, Shown::Enabled | Shown::QuickStop);
        let has_power = matches!(self.shown, Shown::Enabled | Shown::QuickStop);
        let kept = matches!(word(&sent), 0x0F | 0x02);
        let removed = !matches!(word(out), 0x0F | 0x02);
        let harder = status
            .stop
            .is_some_and(|stop| stop.method == StopMethod::DisableVoltage)
            && status.trip.is_some();
        if had_power && has_power && kept && removed && moves && !self.removes && !harder {
            return violation(
                REMOVAL,
                format!("Controlword {:#06x} at {reported:.1}", out.controlword),
            );
        }

        self.check_steps(cycle, &was, &sent, reported)?;
        self.check_done(cycle)?;
        let fastest = (moved / COUNTS_PER_UNIT / DT).abs().max(reported.abs());
        // Rule 11.
        let powerless = status.stop.is_some() && self.shown == Shown::Off;
        match powerless {
            true if believed => self.stopped = self.stopped.saturating_add(1),
            true => {}
            false => self.stopped = 0,
        }
        if self.stopped >= STOPPED_CYCLES {
            return violation(ENDS, format!("after {} cycles without power", self.stopped));
        }
        self.check_stop(cycle, &was, reported, [speed, fastest], moves)?;
        self.check_homing(cycle, &was)?;

        // Rule 9: a speed far beyond the limit, seen in the positions, is a trip.
        let live = self.followed > 0
            && self.shown == Shown::Enabled
            && was.mode != Mode::Hm
            && status.homing != HomingStatus::Running;
        let distance = (moved / COUNTS_PER_UNIT / DT).abs();
        let fast = distance > config.limits.velocity * 1.25;
        let jumps = distance > config.limits.velocity * 5.0;
        if live && jumps && believed && !self.ended {
            return violation(
                SUPERVISED,
                format!("a jump of {moved} counts without a trip"),
            );
        }
        if believed {
            let count = self.over_speed.saturating_add(1);
            self.over_speed = if live && fast { count } else { 0 };
        }
        // A difference whose sign changes may be one of the delay.
        let difference = moved / COUNTS_PER_UNIT / DT - reported;
        let contradicts = difference.abs() > config.limits.velocity * 0.25;
        if believed {
            let same = difference * self.difference > 0.0;
            let count = if same {
                self.contradicted.saturating_add(1)
            } else {
                1
            };
            self.contradicted = if live && contradicts { count } else { 0 };
            self.difference = difference;
        }
        if self.contradicted >= CONTRADICTED_CYCLES && status.trip.is_none() && !self.ended {
            return violation(
                SUPERVISED,
                format!("{moved} counts per cycle, {reported} reported"),
            );
        }
        if self.over_speed >= OVERSPEED_CYCLES && status.trip.is_none() && !self.ended {
            return violation(
                SUPERVISED,
                format!("{moved} counts per cycle without a trip"),
            );
        }

        if self.shown == Shown::Enabled && word(out) == 0x0F && self.permit {
            self.powered = true;
        }
        if self.followed == 0 {
            let most = config.limits.velocity * DT * COUNTS_PER_UNIT;
            let taken = [moved, reported * DT * COUNTS_PER_UNIT];
            self.taken_over = taken.map(|step| step.clamp(-most, most));
        }
        if self.powered && status.enabled {
            self.switches &= status.switching.is_some() || status.homing == HomingStatus::Running;
            self.followed = self.followed.saturating_add(1).min(3);
        }
        if status.trip.is_some() || status.fault.is_some() && !status.resetting {
            self.permit &= self.powered;
        }
        Ok(())
    }

    /// True if the status names a cause that exists.
    fn is_cause(&self, cycle: &Cycle<'_>, was: &AxisStatus) -> bool {
        let trip = cycle.status.trip.is_some();
        match cycle.status.power_loss_cause {
            Some(PowerLossCause::Command) => self.ended || self.switches,
            Some(PowerLossCause::Fault) => self.ended,
            // A reset may have acknowledged the trip in its first cycle.
            Some(PowerLossCause::Trip) => {
                trip || self.ended || cycle.command == Some(Command::ResetFault)
            }
            Some(PowerLossCause::Outside) => cycle.outside.contains(&true) || self.ended,
            Some(PowerLossCause::Coasting) => was.target_torque == 0.0,
            Some(_) | None => false,
        }
    }

    fn note_commands(&mut self, cycle: &Cycle<'_>, was: &AxisStatus) {
        let (config, status) = (cycle.config, cycle.status);
        let start = StopWatch {
            speed: was.target_velocity.abs().max(status.velocity.abs()),
            torque: was.target_torque.abs(),
            slowest: f64::INFINITY,
            moving_s: 0.0,
        };
        let mut stops = false;
        match cycle.command {
            Some(Command::Enable) => {
                (self.permit, self.ended, self.removes) = (true, false, false);
                (self.stop, self.target) = (None, None);
            }
            Some(Command::Disable | Command::QuickStop) => {
                (self.ended, stops, self.target) = (true, true, None);
            }
            Some(Command::EmergencyStop) => {
                (self.ended, stops, self.target) = (true, true, None);
                self.removes |= config.supervision.emergency == StopMethod::DisableVoltage;
            }
            Some(Command::DisableVoltage) => {
                (self.ended, self.removes, stops, self.target) = (true, true, true, None);
            }
            Some(Command::HoldHoming) => (stops, self.target) = (true, None),
            Some(Command::Stop) => {
                // Power does not return after a stop.
                self.ended |= self.switches;
                (stops, self.target) = (true, None);
            }
            Some(Command::MoveTo { position, .. }) => {
                (self.stop, self.target) = (None, Some(Target::Position(position)));
            }
            Some(Command::MoveBy { .. }) => (self.stop, self.target) = (None, None),
            Some(Command::Velocity { velocity, .. }) => {
                (self.stop, self.target) = (None, Some(Target::Velocity(velocity)));
            }
            Some(Command::Torque { .. }) => (self.stop, self.target) = (None, None),
            Some(Command::SetMode(_)) => {
                (self.stop, self.target) = (None, None);
                self.switches |= config.mode_change_unpowered && self.powered;
            }
            Some(Command::Home { .. }) => {
                (self.stop, self.target) = (None, None);
                self.home_low = false;
                self.switches |= config.mode_change_unpowered && self.powered;
            }
            Some(Command::ResetFault | Command::ArmProbe { .. } | Command::DisarmProbe { .. })
            | None => {}
        }
        if cycle.set_point {
            (self.stop, self.target, stops) = (None, None, false);
        }
        // A fault remains until its reset has ended; Enable is accepted before.
        let fault = status.fault.is_some() && !status.resetting;
        if cycle.outside.contains(&true) {
            (self.ended, self.target) = (true, None);
            stops |= cycle.outside[0];
        }
        // A reset may have acknowledged the trip of a stop that still runs.
        if status.stop.is_some() {
            self.target = None;
        }
        if status.trip.is_some() || fault {
            stops |= was.trip.is_none() && was.fault.is_none();
            (self.ended, self.target) = (true, None);
            self.removes |= fault || config.supervision.reaction == StopMethod::DisableVoltage;
        }
        if stops {
            self.stop.get_or_insert(start);
        }
    }

    /// Rule 2.
    fn check_steps(
        &mut self,
        cycle: &Cycle<'_>,
        was: &AxisStatus,
        sent: &Outputs,
        reported: f64,
    ) -> Result<(), Violation> {
        let Cycle {
            config,
            inputs,
            status,
            out,
            ..
        } = *cycle;
        let limits = &config.limits;
        let step = f64::from(out.target_position.wrapping_sub(sent.target_position));
        let step_before = std::mem::replace(&mut self.step, step);
        let live =
            self.powered && self.shown == Shown::Enabled && word(out) == 0x0F && word(sent) == 0x0F;
        let steady = |mode: Mode| {
            status.mode == mode
                && was.mode == mode
                && status.switching.is_none()
                && was.switching.is_none()
                && inputs.mode_display == Some(mode.code())
        };
        let window = limits.velocity * 0.01;
        let most_change = limits.acceleration * DT;
        if live && steady(Mode::Csp) {
            let actual = f64::from(
                out.target_position
                    .wrapping_sub(inputs.position.unwrap_or_default()),
            );
            if self.followed == 0 {
                // Until the axis follows, and in that cycle, the target is where the axis is.
                let coasts = reported.abs() * (config.dead_time_s + 2.0 * DT) * COUNTS_PER_UNIT;
                if inputs.fresh && actual.abs() > coasts + STEP_ROUNDING {
                    return violation(STEP, format!("enabled with a step of {actual} counts"));
                }
            } else {
                let most = limits.velocity * DT * COUNTS_PER_UNIT + STEP_ROUNDING;
                if step.abs() > most {
                    return violation(STEP, format!("{step} counts in a cycle, limit {most}"));
                }
                // A frozen target stands, and continues from rest.
                let frozen = status.stale_cycles > 2 || was.stale_cycles > 2;
                // In its first cycle, a motion that is taken over has already been braked.
                let first = (most_change + window) * DT * COUNTS_PER_UNIT;
                let slack = if self.followed == 1 { first } else { 0.0 };
                let from = match self.followed {
                    1 => self.taken_over,
                    _ => [step_before, if frozen { 0.0 } else { step_before }],
                };
                let change = from.map(|from| (step - from).abs());
                let change = change[0].min(change[1]);
                let most = most_change * DT * COUNTS_PER_UNIT + CHANGE_ROUNDING + slack;
                if change > most && !(frozen && step == 0.0) {
                    return violation(
                        STEP,
                        format!("a velocity step of {change} counts per cycle, limit {most}"),
                    );
                }
            }
        }
        if live && steady(Mode::Csv) && self.followed > 0 {
            let parts = if config.loops.csv.is_some() { 2.0 } else { 1.0 };
            let resumed = status.stale_cycles > 2 || was.stale_cycles > 2;
            let change = f64::from(out.target_velocity.abs_diff(sent.target_velocity));
            let most = parts * most_change * MRPM_PER_UNIT + 2.0;
            if change > most && !resumed {
                return violation(STEP, format!("a velocity step of {change}, limit {most}"));
            }
        }
        if live && steady(Mode::Csv) && self.followed == 0 && status.enabled && inputs.fresh {
            let from = reported.clamp(-limits.velocity, limits.velocity);
            let change = (f64::from(out.target_velocity) / MRPM_PER_UNIT - from).abs();
            let most = 2.0 * most_change + window;
            if change > most {
                return violation(STEP, format!("enabled with a velocity step of {change}"));
            }
        }
        if live && steady(Mode::Cst) && self.followed > 0 && config.loops.cst.is_none() {
            let change = f64::from(out.target_torque.abs_diff(sent.target_torque));
            let most = config.torque_slope * DT * 10.0 + 1.0;
            if change > most {
                return violation(STEP, format!("a torque step of {change}, limit {most}"));
            }
        }
        let beyond = f64::from(out.target_velocity.abs()) > limits.velocity * MRPM_PER_UNIT + 1.0
            || f64::from(out.target_torque.abs()) > limits.torque * 10.0
            || f64::from(out.profile_velocity) > limits.velocity * MRPM_PER_UNIT + 1.0;
        if beyond {
            return violation(STEP, "a target beyond the limits".to_string());
        }
        Ok(())
    }

    /// Rule 3.
    fn check_done(&self, cycle: &Cycle<'_>) -> Result<(), Violation> {
        let Cycle {
            config,
            inputs,
            status,
            ..
        } = *cycle;
        let count = 1.0 / COUNTS_PER_UNIT;
        match self.target {
            Some(Target::Position(target)) => {
                let off = (status.position - target).abs();
                if status.in_target && off > config.target_window + count {
                    return violation(DONE, format!("in target {off} off"));
                }
                if let Some(error) = status.final_error_counts {
                    let expected = ((target - status.position) * COUNTS_PER_UNIT).round();
                    if (error as f64 - expected).abs() > 1.0 {
                        return violation(
                            DONE,
                            format!("arrived with an error of {error}, it is {expected}"),
                        );
                    }
                }
            }
            Some(Target::Velocity(target)) if status.in_target && inputs.fresh => {
                let off = (status.velocity - target).abs();
                let most = (target.abs() * 0.02).max(config.limits.velocity * 0.1);
                if off > most {
                    return violation(DONE, format!("in target at a velocity {off} off"));
                }
            }
            _ => {}
        }
        Ok(())
    }

    /// Rules 6 and 7.
    fn check_stop(
        &mut self,
        cycle: &Cycle<'_>,
        was: &AxisStatus,
        reported: f64,
        [speed, fastest]: [f64; 2],
        moves: bool,
    ) -> Result<(), Violation> {
        let Cycle {
            config,
            inputs,
            status,
            out,
            ..
        } = *cycle;
        let Some(watch) = &mut self.stop else {
            return Ok(());
        };
        let resumed = was.stale_cycles > 2 || status.stale_cycles > 2;
        let uncertain = resumed
            || status.switching.is_some()
            || was.switching.is_some()
            || status.mode != was.mode;
        let set_point = status.target_velocity.abs();
        let ours = matches!(status.mode, Mode::Csp | Mode::Csv)
            || status.mode == Mode::Cst && config.loops.cst.is_some();
        if ours && status.enabled && word(out) == 0x0F {
            // Before, the set-point was not the axis's own.
            if !was.enabled {
                watch.speed = set_point;
            }
            // A set-point that takes over the motion of the drive may have its speed. In a mode
            // switch it follows the position of a drive that does not follow.
            let most = match uncertain {
                true if self.unfollowed > 0 => f64::INFINITY,
                true => watch.speed.max(fastest) + config.limits.velocity * 0.01,
                false => watch.speed,
            };
            if set_point > most + 1e-6 {
                return violation(
                    GAIN,
                    format!("the set-point gains speed: {} to {set_point}", watch.speed),
                );
            }
            watch.speed = set_point;
        }
        let torque = status.target_torque;
        let pushes = torque * reported >= 0.0;
        if status.mode == Mode::Cst && config.loops.cst.is_none() && status.enabled && !uncertain {
            if pushes && torque.abs() > watch.torque + 1e-6 {
                return violation(GAIN, format!("the torque grows to {torque}"));
            }
            watch.torque = torque.abs();
        }
        // Bit 4 starts a move in PP and homing in HM.
        let starts = word(out) == 0x0F && out.controlword & 0x10 != 0;
        let halted = out.controlword & 0x100 != 0;
        if starts && !halted && matches!(status.mode, Mode::Pp | Mode::Hm) {
            return violation(GAIN, "a motion starts after the stop".to_string());
        }
        if inputs.fresh {
            let slows = speed < watch.slowest - config.limits.velocity * 0.01;
            if !moves || slows {
                watch.moving_s = 0.0;
            } else {
                watch.moving_s += DT;
            }
            watch.slowest = if moves {
                watch.slowest.min(speed)
            } else {
                f64::INFINITY
            };
        }
        let most_s = config.limits.velocity / config.limits.acceleration + STOP_MARGIN_S;
        let powered = self.shown == Shown::Enabled && word(out) == 0x0F;
        if powered && watch.moving_s > most_s && status.trip.is_none() {
            return violation(STOPS, format!("still at {speed:.1} after {most_s:.2} s"));
        }
        Ok(())
    }

    /// Rule 8.
    fn check_homing(&mut self, cycle: &Cycle<'_>, was: &AxisStatus) -> Result<(), Violation> {
        let Cycle {
            config,
            inputs,
            status,
            ..
        } = *cycle;
        let ends = status.homing == HomingStatus::Attained && was.homing != HomingStatus::Attained;
        let rises = status.homed() && !was.homed() || ends;
        let in_homing = inputs.mode_display == Some(Mode::Hm.code());
        if in_homing && inputs.fresh && self.shown == Shown::Enabled && self.strange == 0 {
            self.home_low |= inputs.statusword & 0x1000 == 0;
        }
        if rises && !self.home_low {
            return violation(HOMED, "homed, and bit 12 was never low".to_string());
        }
        if status.homed()
            && !was.homed()
            && let Some(home) = config.home
            && let Some(expected) = home.position
        {
            let off = (self.position / COUNTS_PER_UNIT - expected).abs();
            if off > home.window + 1.0 / COUNTS_PER_UNIT {
                return violation(HOMED, format!("homed {off} from home"));
            }
        }
        Ok(())
    }

    /// Adds the reduced state of the rules to a key.
    pub fn reduce(&self, hasher: &mut impl Hasher) {
        let class = |n: u8, bounds: &[u8]| bounds.iter().filter(|&&bound| n >= bound).count();
        (
            (self.permit, self.shown, self.powered, self.followed),
            (self.ended, self.removes, self.switches),
            self.target.map(|target| std::mem::discriminant(&target)),
            self.stop
                .map(|stop| (stop.moving_s > 1.0, stop.moving_s > 2.0)),
            self.home_low,
            (
                class(self.over_speed, &[1, 5]),
                class(self.contradicted, &[1, 8]),
            ),
            class(self.strange, &[1, 3, 10]),
            class(self.unfollowed, &[1, 9, 10, 11]),
            class(self.stopped, &[1, 10]),
        )
            .hash(hasher);
    }
}
