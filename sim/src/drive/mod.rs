//! A CiA 402 drive: what happens between Controlword and Statusword, and between the target and the
//! motor shaft.
//!
//! * `objects`: the objects it lives on, as slots of the device's store
//! * `state`, `fault`: the power state machine, error codes, emergencies
//! * `supervise`, `publish`: what stops the axis by itself; what the drive shows of itself
//! * `modes`, `profile`: set-points of CSP, CSV, CST, PP, PV and HM
//! * `io`, `touch_probe`, `track`: inputs, latched positions, and the switches along the axis
//! * `control`: position and velocity loops at 0.4 ms, current loop at 0.04 ms, gains
//! * `plant`: motor, load, friction, encoder
//!
//! The device calls [`Drive::sync`] when process data takes effect and [`Drive::control`] every 0.4 ms
//! of its own time. Neither allocates. State and mask values are this crate's own: a misreading must
//! not pass on both sides of the wire.

mod control;
mod fault;
mod io;
mod modes;
mod objects;
mod plant;
mod profile;
mod publish;
mod state;
mod supervise;
#[cfg(test)]
mod tests;
mod touch_probe;
mod track;

pub use fault::{DeviceError, Emergency};
pub use io::input;
pub use plant::PlantParams;
pub use state::State;
pub use track::Track;

use control::{Bounds, Controller, Demand, Tuning};
use fault::Faults;
use io::Inputs as DigitalInputs;
use modes::{Cycle, Frame, Mode, Motion, SetPoints};
use objects::{HomingParameters, Objects, Parameters};
use plant::Plant;
use state::{Inputs, Power, Request, Stop};
use touch_probe::TouchProbes;

use crate::Nanos;
use crate::coe::store::{ObjectStore, Slot};

/// Position and velocity loop.
pub const CONTROL_PERIOD_NS: Nanos = 400_000;
/// The same in seconds.
const CONTROL_STEP: f64 = 400e-6;

/// Parameters are looked at anew after so many control cycles, as a drive's background task does.
const PARAMETER_CYCLES: u32 = 5;
/// The control parameters every so many of these.
const TUNING_ROUNDS: u32 = 5;
/// A stop is over when the axis stands, or so many cycles after it should: a load may keep it moving.
const SETTLE_CYCLES: u32 = 250;

#[derive(Debug, Clone)]
pub struct Drive {
    objects: Objects,
    parameters: Parameters,
    parameters_age: u32,
    /// The store's edits when parameters, and control parameters, were read last; `None`: to be read again.
    parameters_edits: Option<u64>,
    tuning_edits: Option<u64>,
    homing: HomingParameters,
    tuning: Tuning,
    tuning_age: u32,
    params: PlantParams,
    plant: Plant,
    controller: Controller,
    power: Power,
    faults: Faults,
    motion: Motion,
    inputs: DigitalInputs,
    probes: TouchProbes,
    mode: Option<Mode>,
    frame: Frame,
    set_points: SetPoints,
    /// A SYNC since Op was entered: there is a Controlword to obey.
    commanded: bool,
    in_op: bool,
    /// Controlword edges since the last control cycle.
    start: bool,
    reset: bool,
    /// The stop whose ramp is running, and for how long its end is overdue.
    stopping: Option<Stop>,
    overdue: u32,
    following_cycles: u32,
    following_error: bool,
    warning: bool,
    /// What the last control cycle demanded, and whether that was limited, while the objects do not show it yet.
    unseen: Option<(Demand, bool)>,
}

impl Drive {
    pub fn new(store: &mut ObjectStore, plant: PlantParams) -> Self {
        let objects = Objects::bind(store, &plant);
        let parameters = objects.parameters(store, &plant);
        let tuning = objects.tuning(store);
        let motor = Plant::new(&plant);
        let counts = motor.counts();
        let inputs = DigitalInputs::new(&plant, &motor);
        let mut drive = Self {
            frame: Frame {
                min: parameters.range_min,
                width: parameters.range_width,
                shift: 0,
                polarity: parameters.polarity,
            },
            objects,
            parameters,
            parameters_age: 0,
            parameters_edits: None,
            tuning_edits: None,
            homing: HomingParameters::default(),
            params: plant,
            controller: Controller::new(&tuning, &plant, &motor),
            tuning,
            tuning_age: 0,
            plant: motor,
            power: Power::new(plant.enable_cycles),
            faults: Faults::default(),
            motion: Motion::new(counts),
            inputs,
            probes: TouchProbes::default(),
            mode: None,
            set_points: SetPoints::default(),
            commanded: false,
            in_op: false,
            start: false,
            reset: false,
            stopping: None,
            overdue: 0,
            following_cycles: 0,
            following_error: false,
            warning: false,
            unseen: None,
        };
        drive.read_parameters(store);
        drive.show_inputs(store);
        drive.publish(store, &Demand::Off, false);
        drive
    }

    /// Tells which objects the output process data carries, each time that is decided anew. A limit of
    /// zero that is received acts; one that is only an object without a value does not.
    pub fn set_mapped(&mut self, mapped: &[Slot]) {
        self.objects.set_mapped(mapped);
        (self.parameters_edits, self.tuning_edits) = (None, None);
    }

    /// SYNC0, or a SyncManager event where there is no distributed clock: set-points take effect.
    pub fn sync(&mut self, store: &ObjectStore) {
        let o = &self.objects;
        let word = store.get(o.controlword).to_le_bytes();
        let controlword = u16::from_le_bytes([word[0], word[1]]);
        let rose = controlword & !self.set_points.controlword;
        let polarity = self.frame.polarity;
        self.set_points = SetPoints {
            controlword,
            position: self.frame.turned(objects::int(store, o.target_position)),
            velocity: polarity.velocity(objects::int(store, o.target_velocity)),
            torque: objects::int(store, o.target_torque),
            position_offset: polarity.way(objects::int(store, o.position_offset)),
            velocity_offset: polarity.velocity(objects::int(store, o.velocity_offset)),
            torque_offset: objects::int(store, o.torque_offset),
        };
        if self.objects.limits_are_mapped() {
            self.parameters_age = PARAMETER_CYCLES;
        }
        if !self.in_op {
            return;
        }
        self.commanded = true;
        self.start |= rose & 1 << 4 != 0;
        self.reset |= rose & 1 << 7 != 0;
        if let Some(mode) = self.mode
            && self.follows()
        {
            self.motion
                .take(mode, &self.set_points, &self.parameters, &self.frame);
        }
    }

    /// One control cycle, every 0.4 ms of device time. Set-points and Controlword count only in Op.
    pub fn control(&mut self, store: &mut ObjectStore, in_op: bool) {
        self.begin_control(store);
        self.controller.turn(&mut self.plant);
        self.end_control(store, in_op);
        self.show(store);
    }

    /// The first part of a control cycle.
    pub(crate) fn begin_control(&mut self, store: &ObjectStore) {
        self.parameters_age += 1;
        // What was written before a start counts for what it starts.
        if self.parameters_age >= PARAMETER_CYCLES || self.start {
            self.read_parameters(store);
        }
    }

    /// The second part: the motors. Several at once take less time than one after the other.
    pub(crate) fn turn(drives: [Option<&mut Self>; 4]) {
        fn parts(drive: &mut Drive) -> (&mut Controller, &mut Plant) {
            (&mut drive.controller, &mut drive.plant)
        }
        match drives {
            [Some(a), Some(b), Some(c), Some(d)] => {
                Controller::turn_together([a, b, c, d].map(parts));
            }
            [a, b, c, d] => {
                for pair in [[a, b], [c, d]] {
                    match pair {
                        [Some(a), Some(b)] => Controller::turn_together([a, b].map(parts)),
                        alone => alone
                            .into_iter()
                            .flatten()
                            .for_each(|drive| drive.controller.turn(&mut drive.plant)),
                    }
                }
            }
        }
    }

    /// The third part: what the drive makes of it.
    pub(crate) fn end_control(&mut self, store: &mut ObjectStore, in_op: bool) {
        self.controller.observe(&self.plant);
        self.watch_inputs(store);
        self.connect(in_op);
        self.select_mode(store);
        self.step_power(store);
        let demand = self.demand();
        self.supervise(&demand);
        // A fault found just now begins its ramp in the next cycle, but cuts the power at once.
        let demand = if self.power.powered() {
            demand
        } else {
            Demand::Off
        };
        let bounds = Bounds {
            current: self.parameters.current,
            speed: self.parameters.max_speed,
        };
        let limited = self.controller.ask(demand, &bounds);
        if let Some(code) = self.faults.take_unrecorded() {
            self.objects.record(store, code);
        }
        self.unseen = Some((demand, limited));
    }

    /// Shows in the objects what the last control cycle left. To be called before anybody reads them or does anything to
    /// the drive but to let it go on.
    pub(crate) fn show(&mut self, store: &mut ObjectStore) {
        self.show_in(store);
        self.unseen = None;
    }

    /// As [`Drive::show`], in a copy of the objects.
    pub(crate) fn show_in(&self, store: &mut ObjectStore) {
        if let Some((demand, limited)) = &self.unseen {
            self.publish(store, demand, *limited);
        }
    }

    /// One control period without power.
    pub(crate) fn coast(&mut self) {
        self.controller.coast(&mut self.plant);
    }

    /// The next emergency to send, oldest first.
    pub fn take_emergency(&mut self) -> Option<Emergency> {
        self.faults.take_emergency()
    }

    /// A fault whose cause is gone at once: the reaction runs, then a reset clears it.
    pub fn inject_fault(&mut self, code: u16) {
        self.raise(code, self.parameters.options.fault_ramp());
    }

    /// A fault whose cause stays, so that resets fail, until `None` takes it away.
    pub fn set_fault_cause(&mut self, code: Option<u16>) {
        self.faults.set_cause(code);
        if let Some(code) = code {
            self.inject_fault(code);
        }
    }

    /// The drive never leaves this state once it is in it, not even by a fault.
    pub fn hold_in(&mut self, state: Option<State>) {
        self.power.hold_in(state);
    }

    /// A wire to one of the inputs of 0x60FD ([`input`]), in parallel to the track's switch. It is seen
    /// in the next control cycle, but a touch probe latches where the axis was `after` (0 to 1) of the
    /// control period had passed.
    pub fn set_input(&mut self, bit: u8, on: bool, after: f64) {
        self.inputs.set(bit, on, after);
    }

    /// 0x60FE as it reaches the terminals.
    #[must_use]
    pub fn outputs(&self, store: &ObjectStore) -> u32 {
        self.objects.io.outputs(store)
    }

    /// Statusword bit 7.
    pub fn set_warning(&mut self, on: bool) {
        self.warning = on;
    }

    /// Torque pulling towards negative positions, N·m.
    pub fn set_load_torque(&mut self, torque: f64) {
        self.plant.set_load_torque(torque);
    }

    /// A shaft that does not turn, whatever the motor does.
    pub fn set_blocked(&mut self, blocked: bool) {
        self.plant.set_blocked(blocked);
    }

    #[must_use]
    pub fn state(&self) -> State {
        self.power.state()
    }

    /// The output stage drives the motor.
    #[must_use]
    pub fn power_on(&self) -> bool {
        self.power.powered()
    }

    /// The shaft's position in 0x6064's frame, but never wrapped.
    #[must_use]
    pub fn position_counts(&self) -> i64 {
        self.plant.counts() + self.frame.shift
    }

    /// The shaft's true speed, not what the drive observes.
    #[must_use]
    pub fn velocity_rev_s(&self) -> f64 {
        self.plant.velocity() / std::f64::consts::TAU
    }

    fn enabled(&self) -> bool {
        matches!(
            self.power.state(),
            State::OperationEnabled | State::QuickStopActive
        )
    }

    /// Set-points move the axis.
    fn follows(&self) -> bool {
        self.power.state() == State::OperationEnabled && self.power.stop().is_none()
    }

    /// What the objects say now; where nobody has written to them since, that is known.
    fn read_parameters(&mut self, store: &ObjectStore) {
        self.parameters_age = 0;
        let edits = Some(store.edits()).filter(|_| !self.objects.parameters_are_mapped());
        if edits.is_none() || self.parameters_edits != edits {
            self.parameters_edits = edits;
            self.parameters = self.objects.parameters(store, &self.params);
            self.homing = self.objects.homing(store, &self.params);
            self.frame.min = self.parameters.range_min;
            self.frame.width = self.parameters.range_width;
            self.frame.polarity = self.parameters.polarity;
            let (polarity, live) = self.objects.io.wiring(store);
            self.inputs.configure(polarity, live);
        }
        self.inputs.refresh();
        self.tuning_age += 1;
        if self.tuning_age < TUNING_ROUNDS {
            return;
        }
        self.tuning_age = 0;
        if edits.is_none() || self.tuning_edits != edits {
            self.tuning_edits = edits;
            let tuning = self.objects.tuning(store);
            if tuning != self.tuning {
                self.controller.tune(&tuning);
                self.tuning = tuning;
            }
        }
    }

    fn show_inputs(&mut self, store: &mut ObjectStore) {
        if let Some(inputs) = self.inputs.take_change() {
            self.objects.io.publish(store, inputs);
        }
    }

    /// Switches, probes.
    fn watch_inputs(&mut self, store: &mut ObjectStore) {
        self.inputs.advance(&self.plant);
        self.show_inputs(store);
        if let Some(slots) = &self.objects.probes {
            self.probes.step(store, slots, &self.inputs, &self.frame);
        }
    }

    fn connect(&mut self, in_op: bool) {
        if in_op == self.in_op {
            return;
        }
        self.in_op = in_op;
        self.commanded = false;
        self.start = false;
        self.reset = false;
        if in_op {
            return;
        }
        if self.enabled() {
            self.lose_connection(DeviceError::BusDown);
        } else {
            self.power.abandon();
        }
    }

    fn select_mode(&mut self, store: &ObjectStore) {
        let wanted = Mode::from_code(store.get_signed(self.objects.mode));
        if wanted.is_some() && wanted != self.mode {
            self.mode = wanted;
            self.read_parameters(store);
            self.motion.forget_homing();
            if self.follows() {
                self.restart_motion();
            }
        }
    }

    fn restart_motion(&mut self) {
        self.motion.restart(
            self.controller.counts(),
            self.controller.velocity(),
            &self.frame,
        );
        self.following_cycles = 0;
    }

    fn step_power(&mut self, store: &ObjectStore) {
        let request =
            (self.in_op && self.commanded).then(|| Request::decode(self.set_points.controlword));
        let reset = std::mem::take(&mut self.reset) && self.faults.cause().is_none();
        let stopped = self.stopping.is_some()
            && self.stopping == self.power.stop()
            && self.overdue > 0
            && (self.stands() || self.overdue > SETTLE_CYCLES);
        let transition = self.power.step(&Inputs {
            request,
            reset,
            stopped,
            options: self.parameters.options,
        });
        match transition {
            Some(4 | 16) => {
                self.read_parameters(store);
                self.motion.forget_homing();
                self.restart_motion();
            }
            Some(15) => {
                self.faults.clear();
                self.following_error = false;
            }
            _ => {}
        }
        if self.power.stop() != self.stopping {
            self.stopping = self.power.stop();
            self.overdue = 0;
            // A stop starts from what the axis does, not from what it was asked to do; an axis that is
            // enabled again in the middle of a stop goes on from there, too.
            if self.power.powered() {
                self.restart_motion();
            }
        }
    }

    fn stands(&self) -> bool {
        self.is_slow(self.controller.velocity())
    }

    /// Below a tenth of a turn a second: as good as standing.
    fn is_slow(&self, velocity: f64) -> bool {
        velocity.abs() < 0.1 * f64::from(self.params.counts_per_turn)
    }

    /// Profile modes and homing always know Controlword bit 8, the cyclic modes only where 0x605D says
    /// what it does.
    fn halts(&self, mode: Mode) -> bool {
        !mode.is_cyclic() || self.parameters.options.halt.is_some()
    }

    fn demand(&mut self) -> Demand {
        let start = std::mem::take(&mut self.start);
        if !self.power.powered() {
            return Demand::Off;
        }
        let cycle = Cycle {
            parameters: &self.parameters,
            homing: &self.homing,
            set_points: &self.set_points,
            start,
            halted: self.set_points.halt() && self.mode.is_some_and(|mode| self.halts(mode)),
            counts: self.controller.counts(),
            velocity: self.controller.velocity(),
            stands: self.stands(),
            current: self.controller.current(),
            inputs: &self.inputs,
        };
        if let Some(stop) = self.power.stop() {
            let (demand, over) = self.motion.stop(stop.ramp, self.mode, &cycle);
            self.overdue = self.overdue.saturating_add(u32::from(over));
            return demand;
        }
        match self.mode {
            Some(mode) => self.motion.demand(mode, &cycle, &mut self.frame),
            None => self.motion.hold(),
        }
    }
}
