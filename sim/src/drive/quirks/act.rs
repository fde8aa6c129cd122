//! What the quirks of Controlword, Statusword, mode, position and brake do in each control cycle.

use crate::drive::modes::{Mode, SetPoints, bit};
use crate::drive::state::State;
use crate::quirks::{Cycles, Quirks};

/// The time from an event to the shift of all positions: 30 ms.
const SHIFT: Cycles = Cycles(75);
/// A Statusword that CiA 402 does not list.
const UNLISTED: u16 = 0x0256;

const FAULT_RESET: u16 = 1 << 7;
const HALT: u16 = 1 << 8;

/// The control cycles since an event; none before it.
#[derive(Debug, Clone, Copy, Default)]
struct Since(Option<u32>);

impl Since {
    fn begin(&mut self) {
        self.0 = Some(0);
    }

    /// Counts while `on`, from its beginning.
    fn count(&mut self, on: bool) {
        self.0 = match self.0 {
            Some(cycles) if on => Some(cycles.saturating_add(1)),
            None if on => Some(0),
            _ => None,
        };
    }

    fn step(&mut self) {
        self.0 = self.0.map(|cycles| cycles.saturating_add(1));
    }

    /// True before the time is over.
    fn within(self, time: Option<Cycles>) -> bool {
        matches!((self.0, time), (Some(since), Some(time)) if since < time.0)
    }

    /// True once the time is over.
    fn after(self, time: Cycles) -> bool {
        self.0.is_some_and(|since| since >= time.0)
    }

    fn is_at(self, time: Cycles) -> bool {
        self.0 == Some(time.0)
    }
}

/// The drive after a control cycle.
pub(in crate::drive) struct Seen<'a> {
    pub state: State,
    pub mode: Option<Mode>,
    pub in_op: bool,
    pub set_points: &'a SetPoints,
    /// The mode's bits of the Statusword by the standard.
    pub bits: u16,
}

/// The quirks of a drive with the times of their events.
#[derive(Debug, Clone)]
pub(in crate::drive) struct ActiveQuirks {
    quirks: Quirks,
    any: bool,
    in_op: Since,
    state: State,
    /// The state has changed to Ready to switch on or Switched on.
    changed: Since,
    enabled: Since,
    /// Bit 12 is set by the standard.
    bit12: Since,
    /// The set-points have not changed while bit 12 is set by the standard.
    resting: Since,
    last: SetPoints,
    homing: Since,
    /// Homing is attained, and the time since it became so, also in another mode.
    attained: (bool, Since),
    reset: Since,
    /// The mode of the last cycle, its age, and the mode of 0x6061.
    mode: (Option<Mode>, Since),
    shown_mode: Option<Mode>,
    /// 0x6040 outside Op: as it was at the end of Op, and as a client has written it since.
    sdo_controlword: (i64, bool),
    /// The brake has been commanded to close.
    closing: Since,
}

impl ActiveQuirks {
    pub(in crate::drive) fn new(quirks: Quirks) -> Self {
        Self {
            any: quirks.any(),
            quirks,
            in_op: Since::default(),
            state: State::NotReadyToSwitchOn,
            changed: Since::default(),
            enabled: Since::default(),
            bit12: Since::default(),
            resting: Since::default(),
            last: SetPoints::default(),
            homing: Since::default(),
            attained: (false, Since::default()),
            reset: Since::default(),
            mode: (None, Since::default()),
            shown_mode: None,
            sdo_controlword: (0, false),
            // Closed at power-on.
            closing: Since(Some(u32::MAX)),
        }
    }

    /// True if at least one quirk is on.
    pub(in crate::drive) fn any(&self) -> bool {
        self.any
    }

    /// Returns the Controlword that the drive obeys.
    pub(in crate::drive) fn controlword(&self, received: u16) -> u16 {
        let q = &self.quirks;
        let mut word = received;
        let enabled = self.state == State::OperationEnabled;
        let quick_stop = word & 0x86 == 0x02;
        if quick_stop && q.quick_stop_removes_power {
            word &= !0x0f;
        }
        let shutdown = word & 0x87 == 0x06;
        if enabled && (quick_stop && q.quick_stop_ignored || shutdown && q.shutdown_ignored) {
            word |= 0x0f;
        }
        if q.halt_ignored {
            word &= !HALT;
        }
        if q.reset_held.is_some_and(|time| !self.reset.after(time)) {
            word &= !FAULT_RESET;
        }
        word
    }

    /// Ends a control cycle. `received` is the Controlword of the process data. Returns the distance
    /// by which all positions shift now.
    pub(in crate::drive) fn step(&mut self, received: u16, seen: &Seen<'_>) -> i64 {
        self.in_op.count(seen.in_op);
        self.reset.count(received & FAULT_RESET != 0);
        if seen.state != self.state {
            self.state = seen.state;
            let below = matches!(seen.state, State::ReadyToSwitchOn | State::SwitchedOn);
            self.changed = Since(below.then_some(0));
        } else {
            self.changed.step();
        }
        let set_points = SetPoints {
            controlword: 0,
            ..*seen.set_points
        };
        let follows = seen.bits & bit::MODE_12 != 0;
        self.resting.count(follows && set_points == self.last);
        self.last = set_points;
        self.bit12.count(follows);
        let homing = seen.mode == Some(Mode::Homing);
        self.homing.count(homing && seen.set_points.starts());
        let attained = homing && follows;
        if attained && !self.attained.0 {
            self.attained.1.begin();
        } else {
            self.attained.1.step();
        }
        self.attained.0 = attained;
        if seen.mode != self.mode.0 {
            self.mode = (seen.mode, Since(Some(0)));
        } else {
            self.mode.1.step();
        }
        if !self.mode.1.within(self.quirks.mode_shown_late) {
            self.shown_mode = seen.mode;
        }
        match seen.state {
            State::OperationEnabled if self.enabled.0.is_none() => self.enabled.begin(),
            _ => self.enabled.step(),
        }
        let at = |since: Since, shift: i64| if since.is_at(SHIFT) { shift } else { 0 };
        at(self.enabled, self.quirks.shift_after_enable)
            + at(self.attained.1, self.quirks.shift_after_homing)
    }

    /// Returns the Statusword that the drive reports.
    pub(in crate::drive) fn statusword(&self, standard: u16, mode: Option<Mode>) -> u16 {
        let q = &self.quirks;
        if self.changed.within(q.unlisted_statusword) {
            return UNLISTED;
        }
        if self.changed.within(q.zero_statusword) {
            return 0;
        }
        let mut word = standard;
        if mode.is_some_and(Mode::is_cyclic) {
            let late = q.bit12_late.is_some_and(|time| !self.bit12.after(time));
            let rests = q
                .bit12_lost_at_rest
                .is_some_and(|time| self.resting.after(time));
            if q.bit12_never || late || rests {
                word &= !bit::MODE_12;
            }
        }
        if mode == Some(Mode::Homing)
            && q.homed_before.is_some()
            && (self.homing.0.is_none() || self.homing.within(q.homed_before))
        {
            word = (word | bit::MODE_12 | bit::TARGET_REACHED) & !bit::MODE_13;
        }
        word
    }

    /// Returns the Controlword that a client has written outside Op. `object` is 0x6040.
    pub(in crate::drive) fn sdo_controlword(&mut self, object: i64, in_op: bool) -> Option<u16> {
        if in_op || !self.quirks.controlword_by_sdo {
            self.sdo_controlword = (object, false);
            return None;
        }
        let (before, written) = &mut self.sdo_controlword;
        *written |= *before != object;
        *before = object;
        let [low, high, ..] = object.to_le_bytes();
        written.then_some(u16::from_le_bytes([low, high]))
    }

    /// Returns true while the brake is closed. `outputs` is 0x60FE.
    pub(in crate::drive) fn brake_is_closed(&mut self, powered: bool, outputs: u32) -> bool {
        let opens = match self.quirks.brake_bit {
            Some(bit) => outputs >> bit & 1 != 0,
            None => powered,
        };
        self.closing.count(!opens);
        self.closing.after(self.quirks.brake.unwrap_or(Cycles(0)))
    }

    /// Returns the mode of 0x6061.
    pub(in crate::drive) fn shown_mode(&self) -> Option<Mode> {
        let hidden = self.quirks.mode_shown_enabled && self.state != State::OperationEnabled;
        self.shown_mode.filter(|_| !hidden)
    }

    /// True while all inputs are zero.
    pub(in crate::drive) fn inputs_are_zero(&self) -> bool {
        self.any && self.in_op.within(self.quirks.zero_inputs)
    }

    /// Returns the mode that the drive changes to; `None`: it keeps its mode.
    pub(in crate::drive) fn next_mode(&self, code: i64, powered: bool) -> Option<Mode> {
        let q = &self.quirks;
        if !q.supports(code) || powered && q.mode_without_power {
            return None;
        }
        Mode::from_code(code)
    }
}
