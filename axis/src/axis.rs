//! One axis: commands in, limited set-points out, supervision in between.
//!
//! [`Axis::step`] first reads and supervises the inputs. Then it runs stop, mode switch, homing and
//! power state machine. Finally it advances the set-point, limits it and closes the loops.
//!
//! A command only affects the next cycle. While the drive is not enabled by this axis, targets
//! follow actual values. So enabling never starts with a step of the target.
//!
//! All modes share one set-point in user units. The control law of a mode converts the set-point to
//! the drive's targets. A mode switch changes the control law and keeps the set-point.
//!
//! | file | contents |
//! |---|---|
//! | `config`, `io` | configuration; inputs and outputs of one cycle |
//! | `command` | commands and the checks that reject them |
//! | `plan` | advances the set-point |
//! | `control_law` | converts the set-point to the drive's targets |
//! | `mode_switch` | switches between modes |
//! | `mode_cycle` | mode switches of drives that need them without power |
//! | `home` | homing |
//! | `lead` | the second half of a gantry |
//! | `stop` | power, stops, brake, automatic fault reset |
//! | `correction` | backlash and pitch error between drive and load |
//! | `feedback` | values reported by the drive |
//! | `supervision` | supervision of these values; final limits of the set-point |
//! | `rest` | rest that is demanded while the axis keeps its power |
//! | `lost_frames` | lost frames and skipped cycles |
//! | `second_encoder` | a second encoder at the load, supervised |
//! | `report` | status |

use crate::cia402::{
    self, Controlword, Mode, Power, PowerProgress, PowerState, Request, State, Statusword,
};
use crate::compensation::Compensation;
use crate::limits::Limits;
use crate::profile_mode::Profile;
use crate::setpoint::Motion;
use crate::status::{CommandError, DriveFault, PowerLossCause, Trip};
use crate::touch_probe::Probes;
use crate::units::Counts;

mod command;
mod config;
mod control_law;
mod correction;
mod feedback;
mod home;
mod io;
mod lead;
mod lost_frames;
mod mode_cycle;
mod mode_switch;
mod plan;
mod report;
mod rest;
mod second_encoder;
mod stop;
mod supervision;

pub use command::Command;
pub use config::{AxisConfig, ConfigError, HomeReference};
pub use io::{Delivery, Inputs, Outputs};
pub use lead::Losses;
pub use second_encoder::SecondEncoder;

use config::ControlledQuantity;
use control_law::LoopState;
use correction::Correction;
use feedback::Actual;
use home::HomingRun;
use mode_switch::Switch;
use plan::Plan;
use stop::PowerGoal;

/// Shorter cycle times count as 0: they would make quotients overflow.
const SHORTEST_CYCLE_S: f64 = 1e-6;

/// Longest accepted cycle. A longer one would let the set-point jump.
const LONGEST_CYCLE_S: f64 = 0.1;

/// The highest override of velocities.
pub const MAX_RATE: f64 = 1.2;
/// A lower override stands for 0: no move could be planned with it.
pub const MIN_RATE: f64 = 1e-3;

/// One axis: commands in, limited set-points out, supervision in between. Call it once per cycle.
#[derive(Debug, Clone)]
pub struct Axis {
    config: AxisConfig,
    /// `limits.position` of the file; [`Axis::share_range`] narrows the one in `config`.
    own_range: Option<[f64; 2]>,
    compensation: Compensation,
    correction: Correction,
    second: second_encoder::SecondPosition,
    /// The active mode; its targets apply.
    mode: Mode,
    switch: Option<Switch>,
    switch_failed: Option<Mode>,
    mode_cycle: Option<mode_cycle::ModeCycle>,
    memory: PowerState,
    statusword: Statusword,
    state: State,
    mode_display: Option<i8>,
    controlword: Controlword,
    goal: PowerGoal,
    reset: bool,
    reset_failed: bool,
    actual: Actual,
    control: Control,
    plan: Plan,
    /// The target of the last accepted move, until another command or a stop replaces it. It is
    /// independent of the set-point, which a stop or a loss of power moves elsewhere.
    commanded_target: Option<f64>,
    rest: rest::Rest,
    /// Override of all velocities, from 0 to [`MAX_RATE`].
    rate: f64,
    motion: Motion,
    loop_state: LoopState,
    derived: control_law::DerivedConstants,
    profile: Profile,
    home: HomingRun,
    probes: Probes,
    probe_mapped: bool,
    brake_state: stop::BrakeState,
    auto_reset: stop::Resets,
    /// Times in seconds for which the axis has been in target and at rest.
    settled_s: f64,
    rested_s: f64,
    /// The commanded position of the last cycle; the actual position if no position is commanded.
    sent: Counts,
    previous_target: Counts,
    dt_s: f64,
    /// True if the inputs of this cycle are fresh.
    fresh: bool,
    supervision: supervision::SupervisionState,
    held_by_range: bool,
    guarded_cycles: u32,
    stale_cycles: u32,
    /// Number of answers still expected from before a gap in the cycle.
    stale_answers: u8,
    /// Cycles since the last frame that is known to have reached the drive.
    undelivered_cycles: u32,
    /// Consecutive fresh cycles without Statusword bit 12.
    unfollowed_cycles: u8,
    /// True after cycles without a plan: the set-point continues from the drive's position and
    /// velocity.
    interrupted: bool,
    /// External set-point of this cycle.
    external_setpoint: Option<Motion>,
    /// True if it is that of a leader.
    led: bool,
    /// Torque feed-forward of this cycle from outside, percent of rated torque.
    torque_feedforward: f64,
    /// Consecutive fresh cycles with a Statusword that is not believed.
    unlisted_cycles: u8,
    /// Time in seconds for which such a Statusword has delayed enabling.
    unlisted_s: f64,
    /// The cause of the last stop, or of the last loss of power, since the axis was enabled.
    power_loss_cause: Option<PowerLossCause>,
    fault: Option<DriveFault>,
    trip: Option<Trip>,
    /// True if the trip has occurred in this cycle. No status shows it yet, so a reset is for an
    /// earlier one.
    trip_is_new: bool,
}

/// Whether the drive has power by our command, and follows set-points.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Control {
    /// No power by our command. Targets follow actual values.
    Unpowered,
    /// Operation enabled by our command; mode, position or Statusword bit 12 are still missing.
    /// Targets follow actual values.
    Powered,
    /// The drive follows the set-points of the plan.
    Following,
}

impl Axis {
    /// Creates a disabled axis. Fails if the configuration is contradictory or out of range.
    pub fn new(config: AxisConfig) -> Result<Self, ConfigError> {
        Self::compensated(config, Compensation::default())
    }

    /// Creates a disabled axis whose load has these errors. The limits of `config` are those of the
    /// load ([`Compensation::load_limits`]).
    pub fn compensated(
        config: AxisConfig,
        compensation: Compensation,
    ) -> Result<Self, ConfigError> {
        config.check()?;
        Ok(Self {
            memory: PowerState::new(),
            statusword: Statusword::empty(),
            state: State::NotReadyToSwitchOn,
            mode_display: None,
            controlword: Controlword::DISABLE_VOLTAGE_COMMAND,
            goal: PowerGoal::Off,
            reset: false,
            reset_failed: false,
            actual: Actual::new(
                config.supervision.acceleration.is_some()
                    || config.modes.with(config.mode).contains(Mode::Cst),
            ),
            control: Control::Unpowered,
            mode: config.mode,
            switch: None,
            switch_failed: None,
            mode_cycle: None,
            plan: Plan::braking(&config, config.mode),
            commanded_target: None,
            rest: rest::Rest::default(),
            rate: 1.0,
            motion: Motion::default(),
            loop_state: LoopState::default(),
            derived: control_law::DerivedConstants::new(&config),
            profile: Profile::new(),
            home: HomingRun::of(&config),
            probes: Probes::new(),
            probe_mapped: false,
            brake_state: stop::BrakeState::default(),
            auto_reset: stop::Resets::default(),
            settled_s: 0.0,
            rested_s: 0.0,
            sent: Counts::default(),
            previous_target: Counts::default(),
            dt_s: 0.0,
            fresh: false,
            supervision: supervision::SupervisionState::default(),
            held_by_range: false,
            guarded_cycles: 0,
            stale_cycles: 0,
            stale_answers: 0,
            undelivered_cycles: 0,
            unfollowed_cycles: 0,
            interrupted: false,
            unlisted_cycles: 0,
            unlisted_s: 0.0,
            power_loss_cause: None,
            external_setpoint: None,
            led: false,
            torque_feedforward: 0.0,
            fault: None,
            trip: None,
            trip_is_new: false,
            compensation,
            correction: Correction::default(),
            second: second_encoder::SecondPosition::default(),
            own_range: config.limits.position,
            config,
        })
    }

    /// Returns `limits.position` of the file.
    #[must_use]
    pub const fn own_range(&self) -> Option<[f64; 2]> {
        self.own_range
    }

    /// Returns the limits with which reported values are compared: those of the file.
    fn own_limits(&self) -> Limits {
        Limits {
            position: self.own_range,
            ..self.config.limits
        }
    }

    /// Returns the error for a position outside the range in force.
    fn outside(&self, position: f64, [low, high]: [f64; 2]) -> CommandError {
        match self.config.limits.position == self.own_range {
            true => CommandError::OutsideRange {
                position,
                low,
                high,
            },
            false => CommandError::OutsideSharedRange {
                position,
                low,
                high,
            },
        }
    }

    /// Returns the configuration. `limits.position` is that in force: [`Axis::share_range`].
    #[must_use]
    pub const fn config(&self) -> &AxisConfig {
        &self.config
    }

    /// Adds the drive's error code to the reported fault. Ignored without a fault; the first code
    /// remains. RT: O(1).
    pub fn note_error_code(&mut self, code: u16) {
        if let Some(fault) = &mut self.fault
            && code != 0
        {
            fault.code.get_or_insert(code);
        }
    }

    /// Accepts a command for the next cycle, or rejects it and changes nothing. RT: O(1), never
    /// blocks or allocates.
    pub fn command(&mut self, command: Command) -> Result<(), CommandError> {
        self.take(command)
    }

    /// Multiplies the velocity of moves and velocities by `rate`, from 0 to [`MAX_RATE`], within the
    /// limits of the axis. At 0 a motion decelerates with its own limits and waits on its way; a
    /// later rate continues it. Stops, homing, torques and set-points from outside do not change.
    /// An invalid rate, or one below [`MIN_RATE`], counts as 0. RT: O(1), plans at most once per cycle.
    pub const fn set_rate(&mut self, rate: f64) {
        // Written so that NaN is rejected, too.
        let valid = rate >= MIN_RATE && rate <= MAX_RATE;
        self.rate = if valid { rate } else { 0.0 };
    }

    /// Sets the position of the next cycle from outside: for groups, streams and user controllers.
    ///
    /// Call it before every [`Axis::step`], or between [`Axis::observe`] and [`Axis::act`]. After a
    /// cycle without a call the axis decelerates and holds.
    ///
    /// Rejects a position outside the range, and a step that exceeds the velocity or acceleration
    /// limit. After a rejected position the axis decelerates. RT: O(1), never blocks or allocates.
    pub fn set_point(&mut self, position: f64) -> Result<(), CommandError> {
        self.take_set_point(position)
    }

    /// Adds a torque feed-forward to the external set-point of this cycle, in percent of rated
    /// torque: 0x60B2 in CSP, within the torque limit. Call it after [`Axis::set_point`].
    ///
    /// Has no effect without an accepted set-point. RT: O(1), never blocks or allocates.
    pub fn set_torque_feedforward(&mut self, percent: f64) {
        if percent.is_finite() && self.external_setpoint.is_some() {
            self.torque_feedforward = percent;
        }
    }

    /// Runs one cycle of `dt_s` seconds, the nominal cycle time (1 µs to 0.1 s). A longer time is
    /// cut to 0.1 s; a shorter or invalid one counts as 0. RT: O(1), never blocks or allocates.
    pub fn step(&mut self, inputs: &Inputs, dt_s: f64) -> Outputs {
        self.observe(inputs, dt_s);
        self.act()
    }

    /// Runs the first half of [`Axis::step`]: reads and supervises the inputs. Afterwards
    /// [`Axis::status`] shows this cycle, and commands can react to it. RT: O(1), never blocks or
    /// allocates.
    pub fn observe(&mut self, inputs: &Inputs, dt_s: f64) {
        let dt_s = if dt_s >= SHORTEST_CYCLE_S {
            dt_s.min(LONGEST_CYCLE_S)
        } else {
            0.0
        };
        self.dt_s = dt_s;
        self.fresh = inputs.fresh && self.stale_answers == 0;
        self.stale_answers = self.stale_answers.saturating_sub(1);
        if self.fresh && self.is_unlisted(inputs.statusword) {
            // The frame has arrived, and its values are not believed.
            self.stale_cycles = 0;
            self.undelivered_cycles = 0;
            self.fresh = false;
            self.count_unlisted(inputs.statusword);
        } else if self.fresh {
            self.unlisted_cycles = 0;
            self.unlisted_s = 0.0;
            self.read(inputs);
            self.supervise();
        } else {
            self.stale_cycles = self.stale_cycles.saturating_add(1);
            self.undelivered_cycles = self.undelivered_cycles.saturating_add(1);
            let under_way = match inputs.delivery {
                Delivery::Unknown => u32::MAX,
                Delivery::Earlier => 1 + u32::from(self.config.answers_late),
                Delivery::Now => 0,
            };
            self.undelivered_cycles = self.undelivered_cycles.min(under_way);
            self.supervision.lost(self.previous_target);
        }
        self.actual.pass(dt_s);
    }

    /// Runs the second half of [`Axis::step`]: computes the outputs from inputs and commands. RT:
    /// O(1), never blocks or allocates.
    pub fn act(&mut self) -> Outputs {
        let (fresh, dt_s) = (self.fresh, self.dt_s);
        self.settle_stop(fresh, dt_s);
        self.settle_reset(dt_s);
        self.settle_mode(fresh, dt_s);
        self.settle_mode_cycle(fresh, dt_s);
        self.settle_homing(fresh, dt_s);
        self.switch_power(fresh, dt_s);
        if fresh {
            self.update_control();
        }
        let (sent, play) = (self.sent, self.play_state());
        if !self.follows() {
            self.track_actual();
        } else if self.setpoint_frozen() {
            self.freeze();
        } else if self.stale_cycles > lost_frames::RIDE_THROUGH_CYCLES {
            self.slow_down(dt_s);
        } else {
            self.advance(fresh, dt_s);
            self.close_loops(fresh, dt_s);
        }
        self.settle_rest(fresh, dt_s);
        self.settle_brake();
        self.external_setpoint = None;
        self.led = false;
        self.previous_target = sent;
        self.keep_play(play);
        self.update_settling_times(dt_s);
        let outputs = self.outputs();
        self.torque_feedforward = 0.0;
        self.trip_is_new = false;
        outputs
    }

    fn read(&mut self, inputs: &Inputs) {
        self.stale_cycles = 0;
        self.undelivered_cycles = 0;
        self.statusword = Statusword::from_bits_retain(inputs.statusword);
        self.mode_display = inputs.mode_display;
        // Homing shifts the position origin.
        let fastest = if self.mode == Mode::Hm {
            self.config.limits.velocity * 2.0
        } else {
            f64::INFINITY
        };
        self.actual
            .read(inputs, &self.config.scale, &self.compensation, fastest);
        self.read_second_encoder(inputs);
        self.probe_mapped = inputs.touch_probe_status.is_some();
        if let Some(status) = inputs.touch_probe_status {
            let (actual, scale) = (&self.actual, &self.config.scale);
            let compensation = &self.compensation;
            let stop = self.probes.step(status, |slot| {
                let raw = inputs.touch_probe_positions.get(slot).copied().flatten()?;
                let near = actual.counts().unwrap_or_default();
                let latched = scale.position_to_user(near.unwrap_next(raw)).0;
                Some(actual.load_at(latched, compensation))
            });
            // The homing sequence stops the axis itself.
            if stop && !self.home.running() {
                self.stop();
            }
        }
        if let Some(code) = inputs.error_code {
            self.note_error_code(code);
        }
    }

    fn switch_power(&mut self, fresh: bool, dt_s: f64) {
        let blind = self.lacks_position();
        let power = match self.goal {
            PowerGoal::On if !blind => Power::Enabled,
            PowerGoal::On | PowerGoal::Off => Power::Disabled,
            PowerGoal::Stopping(stop) => stop.power(),
        };
        let request = Request {
            power,
            reset_fault: self.reset,
            hold: !self.mode_confirmed() && !self.config.mode_display_enabled,
            quick_stop_ends: self.config.quick_stop_ends,
            without_transition_16: self.config.quick_stop.is_some_and(|option| !option.stays()),
        };
        // While frames are lost, timers of the drive's state and of reset pulses stand still.
        let dt_s = if fresh { dt_s } else { 0.0 };
        let (memory, step) = cia402::step_in(self.memory, self.state, request, dt_s);
        self.memory = memory;
        self.controlword = step.controlword;
        if step.progress == PowerProgress::ResetFailed {
            self.reset = false;
            self.reset_failed = true;
            self.goal = PowerGoal::Off;
        }
    }

    /// True if a position set-point is required and no position is reported.
    fn lacks_position(&self) -> bool {
        self.config.control(self.mode) == ControlledQuantity::Position
            && self.actual.counts().is_none()
    }

    /// Returns true if the drive is in Operation enabled by our command.
    pub(crate) const fn has_control(&self) -> bool {
        !matches!(self.control, Control::Unpowered)
    }

    /// Returns true if the drive follows the set-points of the plan.
    const fn follows(&self) -> bool {
        matches!(self.control, Control::Following)
    }

    /// Updates power and following after fresh inputs. A loss of power or of bit 12 that was not
    /// commanded has already stopped the axis ([`Axis::supervise`]).
    fn update_control(&mut self) {
        let on = self.goal == PowerGoal::On;
        let operates = self.state == State::OperationEnabled;
        let ready = operates
            && self.mode_confirmed()
            && self.reported_to_follow()
            && !self.lacks_position();
        if !operates || !self.has_control() && !on {
            self.release();
            return;
        }
        match self.control {
            Control::Unpowered => {
                self.control = Control::Powered;
                self.start_supervision();
                if ready {
                    self.begin_following();
                }
            }
            Control::Powered if ready && on => self.begin_following(),
            Control::Following if !ready && self.switch.is_none() => {
                self.control = Control::Powered;
                self.forget_target();
            }
            Control::Powered | Control::Following => {}
        }
    }

    /// Starts the set-point from the present motion. An axis that has begun to move since the enable
    /// command decelerates within its limits.
    fn begin_following(&mut self) {
        self.track_actual();
        self.start_supervision();
        self.control = Control::Following;
        let velocity = self.held_velocity();
        let commands = matches!(
            self.controlled_quantity(),
            ControlledQuantity::Position | ControlledQuantity::Velocity
        );
        if velocity != 0.0 && commands {
            self.motion = self.motion_at_actual(velocity);
            self.track_play();
        }
        self.demand_rest();
    }

    /// Gives the set-point back to the drive's report, without power.
    fn release(&mut self) {
        self.control = Control::Unpowered;
        self.forget_target();
        self.permit_motion();
        self.end_switch();
    }

    fn start_supervision(&mut self) {
        self.supervision =
            supervision::SupervisionState::starting_at(self.actual.position(), &self.own_limits());
    }

    /// Forgets the commanded target: nothing is "done" at it any more.
    const fn forget_target(&mut self) {
        self.commanded_target = None;
    }

    /// Sets the targets to the reported values, so that enabling causes no step.
    fn track_actual(&mut self) {
        self.sent = self.actual.counts().unwrap_or_default();
        self.motion = Motion::at(self.reported_load());
        self.track_play();
        self.loop_state = LoopState::default();
        self.profile = Profile::new();
        self.plan = Plan::braking(&self.config, self.mode);
        self.held_by_range = false;
        self.interrupted = false;
    }
}
