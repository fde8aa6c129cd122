//! A drive that may answer anything: a drive of the standard, and settings that deviate from it.

use ecaxis_axis::{AxisConfig, Delivery, Inputs, Outputs, State};

/// The cycle. Long, so that the time-outs of the axis take few cycles.
pub const DT: f64 = 0.01;
pub const COUNTS_PER_UNIT: f64 = 400.0;
pub const MRPM_PER_UNIT: f64 = 12_000.0;

/// Friction and the drive's quick stop, counts per second².
const BRAKING: f64 = 4000.0 * COUNTS_PER_UNIT;
/// A load that falls, and an axis beyond its velocity limit, counts per second.
const FALL: f64 = -40.0 * COUNTS_PER_UNIT;
const RUNAWAY: f64 = 300.0 * COUNTS_PER_UNIT;
/// A shift of the origin, counts: ten times the distance of a cycle at the velocity limit.
const SHIFT: f64 = 20.0 * COUNTS_PER_UNIT;
/// The search for home, counts per second, and its duration in cycles.
const SEARCH: f64 = -20.0 * COUNTS_PER_UNIT;
const SEARCH_CYCLES: u8 = 3;

/// Where an axis stands after a homing whose position the drive does not keep, counts.
const ELSEWHERE: f64 = 15.0 * COUNTS_PER_UNIT;

/// Words that the table of the standard does not list, and zero.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Word {
    #[default]
    State,
    Zero,
    Unlisted,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Bit {
    #[default]
    Standard,
    Low,
    High,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Moves {
    /// Follows the targets with power; brakes without it.
    #[default]
    Obeys,
    Stands,
    /// Keeps its velocity, whatever it receives.
    Coasts,
    Falls,
    RunsAway,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Shows {
    #[default]
    Right,
    /// 0x606C is always 0.
    Zero,
    /// 0x606C in another unit.
    Tenfold,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum ModeShown {
    #[default]
    Requested,
    /// The drive does not change its mode.
    Kept,
    /// No mode.
    Zero,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Frames {
    #[default]
    Arrive,
    Lost,
    Late,
    /// A counter that the drive shares with another device is wrong.
    Shared,
}

/// What deviates from the standard.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct Settings {
    pub word: Word,
    pub bit10: Bit,
    pub bit12: Bit,
    pub bit13: Bit,
    pub moves: Moves,
    pub shows: Shows,
    pub mode: ModeShown,
    pub frames: Frames,
    /// The drive ignores the Controlword.
    pub deaf: bool,
    /// The drive does not keep the configured home position.
    pub elsewhere: bool,
}

impl Settings {
    /// Returns the number of deviations.
    pub fn deviations(&self) -> usize {
        let standard = Self::default();
        usize::from(self.word != standard.word)
            + usize::from(self.bit10 != standard.bit10)
            + usize::from(self.bit12 != standard.bit12)
            + usize::from(self.bit13 != standard.bit13)
            + usize::from(self.moves != standard.moves)
            + usize::from(self.shows != standard.shows)
            + usize::from(self.mode != standard.mode)
            + usize::from(self.frames != standard.frames)
            + usize::from(self.deaf)
            + usize::from(self.elsewhere)
    }
}

/// A change of the drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Change {
    Word(Word),
    Bit10(Bit),
    Bit12(Bit),
    Bit13(Bit),
    Moves(Moves),
    Shows(Shows),
    Mode(ModeShown),
    Frames(Frames),
    Deaf(bool),
    Elsewhere(bool),
    /// The drive enters a state by itself.
    State(State),
    /// The drive shifts its origin.
    Shift,
}

/// Every change: a deviation, its end, or an event.
pub const CHANGES: [Change; 37] = [
    Change::Word(Word::State),
    Change::Word(Word::Zero),
    Change::Word(Word::Unlisted),
    Change::Bit10(Bit::Standard),
    Change::Bit10(Bit::Low),
    Change::Bit10(Bit::High),
    Change::Bit12(Bit::Standard),
    Change::Bit12(Bit::Low),
    Change::Bit12(Bit::High),
    Change::Bit13(Bit::Standard),
    Change::Bit13(Bit::High),
    Change::Moves(Moves::Obeys),
    Change::Moves(Moves::Stands),
    Change::Moves(Moves::Coasts),
    Change::Moves(Moves::Falls),
    Change::Moves(Moves::RunsAway),
    Change::Shows(Shows::Right),
    Change::Shows(Shows::Zero),
    Change::Shows(Shows::Tenfold),
    Change::Mode(ModeShown::Requested),
    Change::Mode(ModeShown::Kept),
    Change::Mode(ModeShown::Zero),
    Change::Frames(Frames::Arrive),
    Change::Frames(Frames::Lost),
    Change::Frames(Frames::Late),
    Change::Frames(Frames::Shared),
    Change::Deaf(true),
    Change::Deaf(false),
    Change::Elsewhere(true),
    Change::Elsewhere(false),
    Change::State(State::SwitchOnDisabled),
    Change::State(State::ReadyToSwitchOn),
    Change::State(State::SwitchedOn),
    Change::State(State::OperationEnabled),
    Change::State(State::QuickStopActive),
    Change::State(State::FaultReactionActive),
    Change::Shift,
];

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Homing {
    NotStarted,
    Searching(u8),
    Done,
}

#[derive(Debug, Clone)]
pub struct Drive {
    pub settings: Settings,
    /// The mode changes without power only.
    mode_unpowered: bool,
    /// The mode is shown in Operation enabled only.
    mode_enabled: bool,
    pub state: State,
    pub mode: i8,
    pub homing: Homing,
    /// Counts and counts per second.
    pub position: f64,
    pub velocity: f64,
    torque: i16,
    set_point: Option<f64>,
    acknowledged: bool,
    controlword: u16,
}

impl Drive {
    /// Creates a drive for which the axis has the right keys.
    pub fn new(config: &AxisConfig) -> Self {
        Self {
            settings: Settings::default(),
            mode_unpowered: config.mode_change_unpowered,
            mode_enabled: config.mode_display_enabled,
            state: State::NotReadyToSwitchOn,
            mode: 0,
            homing: Homing::NotStarted,
            position: 0.0,
            velocity: 0.0,
            torque: 0,
            set_point: None,
            acknowledged: false,
            controlword: 0,
        }
    }

    /// Applies a change. Returns false if it changes nothing.
    pub fn change(&mut self, change: Change) -> bool {
        let before = (self.settings, self.state);
        let settings = &mut self.settings;
        match change {
            Change::Word(word) => settings.word = word,
            Change::Bit10(bit) => settings.bit10 = bit,
            Change::Bit12(bit) => settings.bit12 = bit,
            Change::Bit13(bit) => settings.bit13 = bit,
            Change::Moves(moves) => settings.moves = moves,
            Change::Shows(shows) => settings.shows = shows,
            Change::Mode(mode) => settings.mode = mode,
            Change::Frames(frames) => settings.frames = frames,
            Change::Deaf(deaf) => settings.deaf = deaf,
            Change::Elsewhere(elsewhere) => settings.elsewhere = elsewhere,
            Change::State(state) => self.state = state,
            Change::Shift => self.position += SHIFT,
        }
        before != (self.settings, self.state) || change == Change::Shift
    }

    /// Receives the outputs and moves for one cycle.
    pub fn cycle(&mut self, out: &Outputs) {
        let received = self.settings.frames != Frames::Lost;
        let before = self.position;
        if received {
            self.obey(out);
        }
        self.velocity = match self.settings.moves {
            Moves::Stands => 0.0,
            Moves::Coasts => self.velocity,
            Moves::Falls => FALL,
            Moves::RunsAway => RUNAWAY,
            Moves::Obeys if self.state == State::OperationEnabled => self.follow(out, received),
            Moves::Obeys => {
                let less = BRAKING * DT;
                self.velocity - self.velocity.clamp(-less, less)
            }
        };
        let target = f64::from(out.target_position.wrapping_sub(self.raw()));
        let csp = self.settings.moves == Moves::Obeys
            && (self.state, self.mode) == (State::OperationEnabled, 8);
        match csp && received {
            true => self.position += target,
            false => self.position = before + self.velocity * DT,
        }
        self.seek_home();
    }

    fn seek_home(&mut self) {
        if let Homing::Searching(cycles) = self.homing {
            let cycles = (cycles + 1).min(SEARCH_CYCLES);
            self.homing = Homing::Searching(cycles);
            if cycles == SEARCH_CYCLES && self.settings.moves == Moves::Obeys {
                (self.homing, self.velocity) = (Homing::Done, 0.0);
                self.position = if self.settings.elsewhere {
                    ELSEWHERE
                } else {
                    0.0
                };
            }
        }
    }

    /// Returns the velocity of a drive that follows its targets.
    fn follow(&self, out: &Outputs, received: bool) -> f64 {
        let halted = self.controlword & 0x100 != 0;
        let ramp = |target: f64| {
            let most = f64::from(out.profile_acceleration) / MRPM_PER_UNIT * COUNTS_PER_UNIT * DT;
            self.velocity + (target - self.velocity).clamp(-most, most)
        };
        match self.mode {
            8 if received => f64::from(out.target_position.wrapping_sub(self.raw())) / DT,
            8 => 0.0,
            _ if !received => self.velocity,
            9 => f64::from(out.target_velocity) / MRPM_PER_UNIT * COUNTS_PER_UNIT,
            10 => self.velocity + f64::from(out.target_torque) * 1000.0 * DT,
            _ if halted => ramp(0.0),
            3 => ramp(f64::from(out.target_velocity) / MRPM_PER_UNIT * COUNTS_PER_UNIT),
            1 => self.set_point.map_or(0.0, |target| {
                let most = f64::from(out.profile_velocity) / MRPM_PER_UNIT * COUNTS_PER_UNIT;
                ((target - self.position) / DT).clamp(-most, most)
            }),
            6 if matches!(self.homing, Homing::Searching(_)) => SEARCH,
            _ => 0.0,
        }
    }

    fn obey(&mut self, out: &Outputs) {
        let rose = out.controlword & !self.controlword & 0x10 != 0;
        let edge = out.controlword & !self.controlword & 0x80 != 0;
        self.controlword = out.controlword;
        let powered = matches!(
            self.state,
            State::SwitchedOn | State::OperationEnabled | State::QuickStopActive
        );
        let changes = !(self.mode_unpowered && powered);
        if changes && self.settings.mode != ModeShown::Kept && self.mode != out.mode {
            self.mode = out.mode;
            (self.set_point, self.acknowledged) = (None, false);
        }
        if self.settings.deaf {
            return;
        }
        let w = out.controlword & 0x0F;
        let (voltage, quick, on) = (w & 2 != 0, w & 4 == 0, w & 1 != 0);
        self.state = match self.state {
            State::NotReadyToSwitchOn => State::SwitchOnDisabled,
            State::SwitchOnDisabled if w & 7 == 6 => State::ReadyToSwitchOn,
            State::ReadyToSwitchOn if w & 7 == 7 => State::SwitchedOn,
            State::SwitchedOn if w == 0x0F => State::OperationEnabled,
            State::SwitchedOn if voltage && !quick && !on => State::ReadyToSwitchOn,
            State::ReadyToSwitchOn | State::SwitchedOn if !voltage || quick => {
                State::SwitchOnDisabled
            }
            State::OperationEnabled if !voltage => State::SwitchOnDisabled,
            State::OperationEnabled if quick => State::QuickStopActive,
            State::OperationEnabled if !on => State::ReadyToSwitchOn,
            State::OperationEnabled if w == 7 => State::SwitchedOn,
            State::QuickStopActive if !voltage => State::SwitchOnDisabled,
            State::QuickStopActive if w == 0x0F => State::OperationEnabled,
            State::FaultReactionActive => State::Fault,
            State::Fault if edge => State::SwitchOnDisabled,
            same => same,
        };
        if self.state != State::OperationEnabled {
            (self.set_point, self.acknowledged) = (None, false);
            return;
        }
        match self.mode {
            1 if rose => {
                self.set_point = Some(f64::from(out.target_position));
                self.acknowledged = true;
            }
            1 => self.acknowledged &= out.controlword & 0x10 != 0,
            6 if rose => self.homing = Homing::Searching(0),
            6 if out.controlword & 0x10 == 0 && matches!(self.homing, Homing::Searching(_)) => {
                self.homing = Homing::NotStarted;
            }
            _ => {}
        }
    }

    fn raw(&self) -> i32 {
        (self.position.round() as i64) as i32
    }

    pub fn statusword(&self) -> u16 {
        let word = match self.settings.word {
            Word::Zero => return 0x0000,
            Word::Unlisted => 0x0256,
            Word::State => match self.state {
                State::SwitchOnDisabled => 0x0250,
                State::ReadyToSwitchOn => 0x0231,
                State::SwitchedOn => 0x0233,
                State::OperationEnabled => 0x0237,
                State::QuickStopActive => 0x0217,
                State::FaultReactionActive => 0x021F,
                State::Fault => 0x0218,
                State::NotReadyToSwitchOn | State::Unknown(_) => 0x0200,
            },
        };
        let on = self.state == State::OperationEnabled;
        let stands = self.velocity == 0.0;
        let (standard_10, standard_12) = match self.mode {
            1 => (
                self.set_point.is_none_or(|at| at == self.position),
                self.acknowledged,
            ),
            3 => (false, stands),
            6 => (
                !matches!(self.homing, Homing::Searching(_)),
                self.homing == Homing::Done,
            ),
            _ => (false, on),
        };
        let bit = |setting: Bit, standard: bool, n: u32| {
            let set = match setting {
                Bit::Standard => standard,
                Bit::Low => false,
                Bit::High => true,
            };
            u16::from(set) << n
        };
        let Settings {
            bit10,
            bit12,
            bit13,
            ..
        } = self.settings;
        word | bit(bit10, standard_10, 10) | bit(bit12, standard_12, 12) | bit(bit13, false, 13)
    }

    pub fn inputs(&self) -> Inputs {
        let velocity = self.velocity / COUNTS_PER_UNIT * MRPM_PER_UNIT;
        let shown = match self.settings.shows {
            Shows::Right => velocity,
            Shows::Zero => 0.0,
            Shows::Tenfold => velocity * 10.0,
        };
        Inputs {
            statusword: self.statusword(),
            position: Some(self.raw()),
            velocity: Some(shown.round() as i32),
            torque: Some(self.torque),
            mode_display: Some(match self.settings.mode {
                ModeShown::Zero => 0,
                _ if self.mode_enabled && self.state != State::OperationEnabled => 0,
                ModeShown::Requested | ModeShown::Kept => self.mode,
            }),
            fresh: self.settings.frames == Frames::Arrive,
            delivery: match self.settings.frames {
                Frames::Late => Delivery::Earlier,
                Frames::Shared => Delivery::Now,
                _ => Delivery::Unknown,
            },
            ..Inputs::default()
        }
    }
}
