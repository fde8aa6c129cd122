//! A CiA 402 drive, from Controlword to Statusword and from the target to the motor shaft.
//!
//! * `objects`: the drive's objects, as slots of the device's store
//! * `state`, `fault`: the power state machine, error codes, emergencies
//! * `supervise`, `publish`: checks that stop the axis; Statusword and actual values
//! * `modes`, `profile`: set-points of CSP, CSV, CST, PP, PV and HM
//! * `io`, `touch_probe`, `travel`: inputs, latched positions, and the switches along the axis
//! * `control`: position and velocity loops at 0.4 ms, current loop at 0.04 ms, gains
//! * `plant`: motor, load, friction, encoder
//! * `mechanics`: backlash and pitch error between motor and load
//! * `quirks`: how drives of other vendors differ
//!
//! The device calls `Drive::sync` when process data takes effect and `Drive::control` every 0.4
//! ms of its own time. Neither allocates. This crate defines its own state and mask values, so that
//! a misread standard cannot cancel out between MainDevice and simulator.
//!
//! ```
//! use ecaxis_sim::{DeviceOptions, PlantParams, Track};
//!
//! // A linear axis with limit switches; it starts on the negative one.
//! let track = Track {
//!     negative_limit: Some(0),
//!     positive_limit: Some(100_000),
//!     ..Track::default()
//! };
//! let options = DeviceOptions {
//!     plant: PlantParams { track, ..PlantParams::default() },
//!     ..DeviceOptions::default()
//! };
//! assert_eq!(options.plant.initial_position, 0);
//! ```

mod control;
mod fault;
mod io;
mod mechanics;
mod modes;
mod objects;
mod plant;
mod profile;
mod publish;
mod quirks;
mod state;
mod supervise;
#[cfg(test)]
mod tests;
mod touch_probe;
mod travel;

pub(crate) use fault::{DeviceError, Emergency};
pub use io::input;
pub use mechanics::PitchError;
pub use plant::{ElasticLoad, PlantParams};
pub use state::State;
pub use travel::Track;

use control::{Bounds, Controller, Demand, Tuning};
use fault::Faults;
use io::Inputs as DigitalInputs;
use mechanics::Mechanics;
use modes::{Cycle, Mode, Motion, PositionFrame, SetPoints};
use objects::{AXIS_STRIDE, GearSlots, HomingParameters, Objects, Parameters};
use plant::Plant;
use quirks::{ActiveQuirks, Gear, Seen};
use state::{Inputs, Power, Request, Stop};
use touch_probe::TouchProbes;

use crate::Nanos;
use crate::coe::object_dictionary::{EntryHandle, ObjectStore};

/// The period of the position and velocity loops, in ns.
pub(crate) const CONTROL_PERIOD_NS: Nanos = 400_000;
/// [`CONTROL_PERIOD_NS`] in seconds.
const CONTROL_STEP: f64 = 400e-6;

/// The axes of a device (CiA 402-1).
const MAX_AXES: u16 = 8;
const CONTROLWORD: u16 = 0x6040;

/// Control cycles between two reads of the parameters. A real drive's background task also reads
/// them late.
const PARAMETER_CYCLES: u32 = 5;
/// Parameter reads between two reads of the control parameters.
const TUNING_ROUNDS: u32 = 5;
/// Control cycles after the end of a ramp until a stop ends although the axis still moves. A load
/// may keep it moving.
const SETTLE_CYCLES: u32 = 250;

/// A simulated drive: CiA 402 state machine, control loops, motor and load.
#[derive(Debug, Clone)]
pub struct Drive {
    objects: Objects,
    parameters: Parameters,
    parameters_age: u32,
    /// The store's edit count when the parameters and the control parameters were last read. `None`
    /// forces a new read.
    parameters_edits: Option<u64>,
    tuning_edits: Option<u64>,
    homing: HomingParameters,
    tuning: Tuning,
    tuning_age: u32,
    params: PlantParams,
    plant: Plant,
    /// The load with an encoder of its own.
    mechanics: Option<Mechanics>,
    controller: Controller,
    power: Power,
    faults: Faults,
    motion: Motion,
    inputs: DigitalInputs,
    probes: TouchProbes,
    mode: Option<Mode>,
    frame: PositionFrame,
    set_points: SetPoints,
    quirks: ActiveQuirks,
    gear: Option<Gear>,
    /// The Controlword of the process data.
    received: u16,
    /// True after the first SYNC in Op: the Controlword is valid.
    commanded: bool,
    in_op: bool,
    /// Controlword edges since the last control cycle.
    start: bool,
    reset: bool,
    /// The stop whose ramp is running, and the control cycles since the ramp ended.
    stopping: Option<Stop>,
    overdue: u32,
    following_cycles: u32,
    following_error: bool,
    warning: bool,
    /// The demand of the last control cycle and whether it was limited. `None` after
    /// [`Drive::show`].
    unseen: Option<(Demand, bool)>,
}

impl Drive {
    pub(crate) fn new(store: &mut ObjectStore, plant: PlantParams) -> Self {
        Self::of_axis(store, 0, plant)
    }

    /// Creates a drive for each axis of a device: each Controlword of the dictionary.
    pub(crate) fn of_axes(store: &mut ObjectStore, plants: &[PlantParams]) -> Box<[Self]> {
        let own = |axis: &u16| *axis == 0 || store.has_object(CONTROLWORD + axis * AXIS_STRIDE);
        let axes: Vec<u16> = (0..MAX_AXES).filter(own).collect();
        let plant = |axis: u16| plants.get(usize::from(axis)).copied().unwrap_or_default();
        let drives = axes.into_iter();
        drives
            .map(|axis| Self::of_axis(store, axis, plant(axis)))
            .collect()
    }

    fn of_axis(store: &mut ObjectStore, axis: u16, plant: PlantParams) -> Self {
        let gear = Gear::new(GearSlots::bind(store, axis, &plant), &plant);
        let plant = gear.as_ref().map_or(plant, |gear| gear.plant(store));
        let objects = Objects::bind(store, axis, &plant);
        let parameters = objects.parameters(store, &plant);
        let tuning = objects.tuning(store);
        let motor = Plant::new(&plant);
        let counts = motor.counts();
        let mechanics = Some(Mechanics::new(plant.backlash, plant.pitch_error, &motor));
        let has_load_encoder = objects.load_position.is_some();
        let inputs = DigitalInputs::new(&plant, &motor);
        let mut drive = Self {
            frame: PositionFrame {
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
            mechanics: mechanics.filter(|_| has_load_encoder),
            plant: motor,
            power: Power::new(plant.enable_cycles),
            faults: Faults::default(),
            motion: Motion::new(counts),
            inputs,
            probes: TouchProbes::default(),
            mode: None,
            set_points: SetPoints::default(),
            quirks: ActiveQuirks::new(plant.quirks),
            gear,
            received: 0,
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
        drive.plant.set_brake(drive.params.quirks.has_brake());
        drive.read_parameters(store);
        drive.show_inputs(store);
        drive.publish(store, &Demand::Off, false);
        drive
    }

    /// Sets the objects that the output process data carries. Call it after every change of the
    /// mapping. A mapped limit of zero acts; an unmapped limit of zero means "no limit".
    pub(crate) fn set_mapped(&mut self, mapped: &[EntryHandle]) {
        self.objects.set_mapped(mapped);
        (self.parameters_edits, self.tuning_edits) = (None, None);
    }

    /// Applies the set-points on SYNC0, or on a SyncManager event without distributed clocks.
    pub(crate) fn sync(&mut self, store: &ObjectStore) {
        let o = &self.objects;
        let word = store.get(o.controlword).to_le_bytes();
        self.received = u16::from_le_bytes([word[0], word[1]]);
        let controlword = if self.quirks.any() {
            self.quirks.controlword(self.received)
        } else {
            self.received
        };
        let rose = controlword & !self.set_points.controlword;
        let polarity = self.frame.polarity;
        self.set_points = SetPoints {
            controlword,
            position: self.frame.turned(objects::int(store, o.target_position)),
            velocity: polarity.velocity(objects::int(store, o.target_velocity)),
            torque: polarity.torque(objects::int(store, o.target_torque)),
            position_offset: polarity.way(objects::int(store, o.position_offset)),
            velocity_offset: polarity.velocity(objects::int(store, o.velocity_offset)),
            torque_offset: polarity.torque(objects::int(store, o.torque_offset)),
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

    /// Runs one control cycle, every 0.4 ms of device time. Set-points and Controlword act only in
    /// Op.
    pub(crate) fn control(&mut self, store: &mut ObjectStore, in_op: bool) {
        self.begin_control(store);
        self.turn_alone();
        self.end_control(store, in_op);
        self.show(store);
    }

    /// Runs the first part of a control cycle: reads the parameters.
    pub(crate) fn begin_control(&mut self, store: &ObjectStore) {
        self.parameters_age += 1;
        // Parameters written before a start apply to that start.
        if self.parameters_age >= PARAMETER_CYCLES || self.start {
            self.read_parameters(store);
        }
    }

    /// Runs the second part for a motor alone.
    pub(crate) fn turn_alone(&mut self) {
        self.controller.turn(&mut self.plant);
    }

    /// Runs the second part: the motors. A batch is faster than one motor after the other.
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
                        alone => alone.into_iter().flatten().for_each(Self::turn_alone),
                    }
                }
            }
        }
    }

    /// Runs the third part: inputs, state machine, mode and supervision.
    pub(crate) fn end_control(&mut self, store: &mut ObjectStore, in_op: bool) {
        self.controller.observe(&self.plant);
        if let Some(mechanics) = &mut self.mechanics {
            mechanics.follow(&self.plant);
        }
        self.watch_inputs(store);
        self.connect(in_op);
        self.select_mode(store);
        self.step_power(store);
        let demand = self.demand();
        self.supervise(&demand);
        if self.quirks.any() {
            self.step_quirks(store);
        }
        // A new fault starts its ramp in the next cycle, but cuts the power at once.
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

    /// Advances the quirks.
    fn step_quirks(&mut self, store: &ObjectStore) {
        if self.params.quirks.has_brake() {
            let outputs = self.objects.io.outputs(store);
            let closed = self.quirks.brake_is_closed(self.power.powered(), outputs);
            self.plant.set_brake(closed);
        }
        let bits = self.mode.map_or(0, |mode| {
            let velocity = self.controller.velocity();
            self.motion
                .status(mode, self.follows(), velocity, &self.parameters)
        });
        let shift = self.quirks.step(
            self.received,
            &Seen {
                state: self.power.state(),
                mode: self.mode,
                in_op: self.in_op,
                set_points: &self.set_points,
                bits,
            },
        );
        self.shift_positions(shift);
    }

    /// Shifts all positions by a number of counts; the shaft does not turn. The drive takes the
    /// next set-point in the new frame.
    pub fn shift_positions(&mut self, counts: i64) {
        if counts != 0 {
            self.frame.shift += counts;
            self.motion.shift(counts, &self.frame);
        }
    }

    /// True while all inputs are zero.
    pub(crate) fn inputs_are_zero(&self) -> bool {
        self.quirks.inputs_are_zero()
    }

    /// Writes the results of the last control cycle to the objects. Call it before anything reads
    /// the objects or changes the drive other than by the next control cycle.
    pub(crate) fn show(&mut self, store: &mut ObjectStore) {
        self.show_in(store);
        self.unseen = None;
    }

    /// As [`Drive::show`], for a copy of the objects.
    pub(crate) fn show_in(&self, store: &mut ObjectStore) {
        if let Some((demand, limited)) = &self.unseen {
            self.publish(store, demand, *limited);
        }
    }

    /// Runs one control period without power.
    pub(crate) fn coast(&mut self) {
        if self.params.quirks.has_brake() {
            self.plant.set_brake(true);
        }
        self.controller.coast(&mut self.plant);
    }

    /// Returns the next emergency to send, oldest first.
    pub(crate) fn take_emergency(&mut self) -> Option<Emergency> {
        self.faults.take_emergency()
    }

    /// Raises a fault without a lasting cause: the reaction runs, then a reset clears it.
    pub fn inject_fault(&mut self, code: u16) {
        self.raise(code, self.parameters.options.fault_ramp());
    }

    /// Clears a fault in the next control cycle, unless its cause persists.
    pub(crate) fn reset_fault(&mut self) {
        self.reset = true;
    }

    /// Sets a lasting fault cause. Resets fail until `None` removes the cause.
    pub fn set_fault_cause(&mut self, code: Option<u16>) {
        self.faults.set_cause(code);
        if let Some(code) = code {
            self.inject_fault(code);
        }
    }

    /// Keeps the drive in this state once it is reached, even on a fault.
    pub fn hold_in(&mut self, state: Option<State>) {
        self.power.hold_in(state);
    }

    /// Requests safe torque off, or ends the request: no torque, in Switch on disabled.
    pub fn set_sto(&mut self, on: bool) {
        self.power.set_sto(on);
    }

    /// Switches the enable input. Without it the drive removes the torque and reaches Ready to
    /// switch on.
    pub fn set_enable_input(&mut self, on: bool) {
        self.power.set_disabled(!on);
    }

    /// True if the entry is the Statusword of this axis.
    pub(crate) fn shows_statusword(&self, slot: EntryHandle) -> bool {
        self.objects.statusword == slot
    }

    /// True if the shaft turns or is about to turn without power.
    pub(crate) fn turns_without_power(&self) -> bool {
        self.plant.velocity() != 0.0 || self.plant.falls()
    }

    /// Takes over the position from before a loss of power, with an absolute encoder.
    pub(crate) fn keep_position(&mut self, before: &Self, store: &mut ObjectStore) {
        if !self.params.quirks.absolute_encoder {
            return;
        }
        self.take_shaft(before);
        self.publish(store, &Demand::Off, false);
    }

    /// Takes over the shaft and the position frame of a drive with another number of counts per
    /// turn.
    fn take_shaft(&mut self, before: &Self) {
        self.plant.take_shaft(&before.plant);
        let turn = |drive: &Self| i64::from(drive.params.counts_per_turn);
        self.frame.shift = before.frame.shift * turn(self) / turn(before).max(1);
        self.controller = Controller::new(&self.tuning, &self.params, &self.plant);
        self.inputs = DigitalInputs::new(&self.params, &self.plant);
        if let Some(mechanics) = &mut self.mechanics {
            *mechanics = Mechanics::new(self.params.backlash, self.params.pitch_error, &self.plant);
        }
        let counts = self.plant.counts();
        self.motion = before.motion.clone();
        self.motion.forget_homing();
        self.motion.restart(counts, 0.0, &self.frame);
        self.parameters_edits = None;
    }

    /// Changes the unit of positions as 0x6091 demands.
    fn change_gear(&mut self, store: &ObjectStore) {
        let Some(gear) = self.gear.as_ref().filter(|_| !self.power.powered()) else {
            return;
        };
        let params = gear.plant(store);
        if params.counts_per_turn == self.params.counts_per_turn {
            return;
        }
        let before = self.clone();
        self.params = params;
        self.plant = Plant::new(&params);
        self.take_shaft(&before);
    }

    /// Sets an external signal on an input of 0x60FD ([`input`]), in parallel to the track's
    /// switch. The input changes in the next control cycle. A touch probe latches the position at
    /// the fraction `after` (0 to 1) of the control period.
    pub fn set_input(&mut self, bit: u8, on: bool, after: f64) {
        self.inputs.set(bit, on, after);
    }

    /// Returns 0x60FE as driven at the terminals.
    #[must_use]
    pub(crate) fn outputs(&self, store: &ObjectStore) -> u32 {
        self.objects.io.outputs(store)
    }

    /// Sets Statusword bit 7.
    pub fn set_warning(&mut self, on: bool) {
        self.warning = on;
    }

    /// Sets the torque that pulls towards negative positions, in N·m.
    pub fn set_load_torque(&mut self, torque: f64) {
        let own = self.params.quirks.load_torque;
        self.plant.set_load_torque(own + torque);
    }

    /// Blocks or releases the shaft.
    pub fn set_blocked(&mut self, blocked: bool) {
        self.plant.set_blocked(blocked);
    }

    /// Returns the state of the CiA 402 state machine.
    #[must_use]
    pub fn state(&self) -> State {
        self.power.state()
    }

    /// True while the output stage drives the motor.
    #[must_use]
    pub fn power_on(&self) -> bool {
        self.power.powered()
    }

    /// Returns the shaft's position in the frame of 0x6064, but never wrapped.
    #[must_use]
    pub fn position_counts(&self) -> i64 {
        self.plant.counts() + self.frame.shift
    }

    /// Returns the shaft's true speed, not the drive's estimate.
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

    /// True while set-points move the axis.
    fn follows(&self) -> bool {
        self.power.state() == State::OperationEnabled && self.power.stop().is_none()
    }

    /// Reads the parameters. Skips the read if the store has no new edits.
    fn read_parameters(&mut self, store: &ObjectStore) {
        self.parameters_age = 0;
        let edits = Some(store.edits()).filter(|_| !self.objects.parameters_are_mapped());
        if edits.is_none() || self.parameters_edits != edits {
            self.change_gear(store);
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

    /// Evaluates switches and touch probes.
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
        let powered = self.power.powered();
        let wanted = self
            .quirks
            .next_mode(store.get_signed(self.objects.mode), powered);
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
        let mut request =
            (self.in_op && self.commanded).then(|| Request::decode(self.set_points.controlword));
        if self.quirks.any() {
            let object = store.get(self.objects.controlword);
            let by_sdo = self.quirks.sdo_controlword(object, self.in_op);
            request = request.or(by_sdo.map(Request::decode));
        }
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
            // A stop starts from the actual motion, not from the demanded one. So does an axis that
            // is enabled again during a stop.
            if self.power.powered() {
                self.restart_motion();
            }
        }
    }

    fn stands(&self) -> bool {
        self.is_slow(self.controller.velocity())
    }

    /// True below a tenth of a turn per second, which counts as standstill.
    fn is_slow(&self, velocity: f64) -> bool {
        velocity.abs() < 0.1 * f64::from(self.params.counts_per_turn)
    }

    /// True if the mode obeys Controlword bit 8. Cyclic modes do so only if the drive has 0x605D.
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
