//! Quirks: how devices of other vendors differ from the standard. [`Quirks::TABLE`] has one entry
//! for each: key, value, point where it acts, description. Machine files, their schema and the test
//! of the documents read the table.

use crate::drive::CONTROL_PERIOD_NS;

/// The value of a quirk in a machine file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum QuirkValue {
    /// `true` or `false`; 1 or 0.
    Flag,
    /// A time in ns, up to [`QuirkValue::MAX_NS`].
    Time,
    /// A factor above 0.
    Factor,
    /// A distance in counts. Machine files use the unit of the axis.
    Distance,
    /// Modes of operation; a bit mask as in 0x6502.
    Modes,
    /// A torque in N·m, up to [`QuirkValue::MAX_TORQUE`] in either direction.
    Torque,
    /// A whole number within these limits.
    Whole(u32, u32),
}

impl QuirkValue {
    /// The longest time of a quirk, in ns.
    pub const MAX_NS: u64 = 60_000_000_000;
    /// The largest factor; the smallest one is its reciprocal.
    pub const MAX_FACTOR: f64 = 1e9;
    /// The largest torque, in N·m.
    pub const MAX_TORQUE: f64 = 1000.0;
    /// Modes of operation with the names of machine files.
    pub const MODES: [(&'static str, u8); 6] = [
        ("pp", 1),
        ("pv", 3),
        ("hm", 6),
        ("csp", 8),
        ("csv", 9),
        ("cst", 10),
    ];

    /// Returns the type and the value that turns the quirk off, as documents describe them.
    #[must_use]
    pub fn describe(self) -> (String, &'static str) {
        match self {
            Self::Flag => ("`true`, `false`".into(), "`false`"),
            Self::Time => ("time, up to 60 s".into(), "off"),
            Self::Factor => ("factor, 1e-9 to 1e9".into(), "1"),
            Self::Distance => ("unit".into(), "0"),
            Self::Torque => ("N·m, −1000 to 1000".into(), "0"),
            Self::Modes => ("list of modes".into(), "none"),
            Self::Whole(low, high) => (format!("{low} to {high}"), "off"),
        }
    }
}

/// The point of the device where a quirk acts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum QuirkPoint {
    /// The received Controlword.
    Controlword,
    /// The reported Statusword.
    Statusword,
    /// All inputs.
    Inputs,
    /// The working counter of any device.
    WorkingCounter,
    /// Mode of operation and its display.
    Mode,
    /// Target velocity and velocity actual value.
    Velocity,
    /// The frame of all positions.
    Position,
    /// The home position.
    Homing,
    /// Target torque and torque actual value.
    Torque,
    /// The unit of all positions.
    Unit,
    /// The shaft.
    Shaft,
    /// The mailbox of any device.
    Mailbox,
    /// State changes of any device.
    State,
}

impl QuirkPoint {
    /// Returns the objects that the quirk changes.
    #[must_use]
    pub fn objects(self) -> &'static str {
        match self {
            Self::Controlword => "0x6040",
            Self::Statusword => "0x6041",
            Self::Inputs => "all inputs",
            Self::WorkingCounter => "working counter",
            Self::Mode => "0x6060, 0x6061",
            Self::Velocity => "0x60FF, 0x606C",
            Self::Position => "0x6064, 0x607A",
            Self::Homing => "0x607C",
            Self::Torque => "0x6071, 0x6077",
            Self::Unit => "0x6091",
            Self::Shaft => "shaft",
            Self::Mailbox => "mailbox",
            Self::State => "AL status",
        }
    }

    /// True if devices without a drive have such quirks, too.
    #[must_use]
    pub fn is_of_any_device(self) -> bool {
        matches!(self, Self::Mailbox | Self::State | Self::WorkingCounter)
    }
}

/// An entry of [`Quirks::TABLE`].
#[derive(Debug, Clone, Copy)]
#[non_exhaustive]
pub struct Quirk {
    /// The key in a machine file.
    pub key: &'static str,
    /// The type of the value.
    pub value: QuirkValue,
    /// Where it acts.
    pub point: QuirkPoint,
    /// The description.
    pub text: &'static str,
    set: fn(&mut Quirks, f64),
}

impl Quirk {
    /// Turns the quirk on with a value in the unit of [`Quirk::value`].
    pub fn set(&self, quirks: &mut Quirks, value: f64) {
        (self.set)(quirks, value);
    }
}

/// A value as the drive needs it.
trait FromNumber {
    fn from_number(value: f64) -> Self;
}

/// A time in control cycles of a drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd)]
pub struct Cycles(pub(crate) u32);

/// A time in ns.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd)]
pub struct Delay(pub u64);

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "saturates"
)]
mod from_number {
    use super::{CONTROL_PERIOD_NS, Cycles, Delay, FromNumber};

    impl FromNumber for bool {
        fn from_number(value: f64) -> Self {
            value != 0.0
        }
    }

    impl FromNumber for f64 {
        fn from_number(value: f64) -> Self {
            value
        }
    }

    impl FromNumber for i64 {
        fn from_number(value: f64) -> Self {
            value as Self
        }
    }

    impl FromNumber for u32 {
        fn from_number(value: f64) -> Self {
            value as Self
        }
    }

    impl FromNumber for Option<Cycles> {
        fn from_number(value: f64) -> Self {
            let cycles = value as u64 / CONTROL_PERIOD_NS;
            Some(Cycles(u32::try_from(cycles).unwrap_or(u32::MAX)))
        }
    }

    impl FromNumber for Option<Delay> {
        fn from_number(value: f64) -> Self {
            Some(Delay(value as u64))
        }
    }

    impl FromNumber for Option<f64> {
        fn from_number(value: f64) -> Self {
            Some(value)
        }
    }

    impl FromNumber for Option<u32> {
        fn from_number(value: f64) -> Self {
            Some(value as u32)
        }
    }
}

macro_rules! quirks {
    ($($(#[doc = $doc:literal])+ $key:ident: $type:ty = $value:ident$(($low:literal, $high:literal))? at $point:ident,)*) => {
        /// The quirks of a device; by default none. Times are rounded down to control cycles.
        #[derive(Debug, Clone, Copy, PartialEq, Default)]
        #[non_exhaustive]
        pub struct Quirks {
            $($(#[doc = $doc])+ pub $key: $type,)*
        }

        impl Quirks {
            /// Every quirk.
            pub const TABLE: &[Quirk] = &[$(Quirk {
                key: stringify!($key),
                value: QuirkValue::$value$(($low, $high))?,
                point: QuirkPoint::$point,
                text: concat!($($doc),+).trim_ascii(),
                set: |quirks, value| quirks.$key = FromNumber::from_number(value),
            },)*];
        }
    };
}

quirks! {
    /// Bit 12 is never set in CSP, CSV and CST
    bit12_never: bool = Flag at Statusword,
    /// Bit 12 is set this much later in CSP, CSV and CST
    bit12_late: Option<Cycles> = Time at Statusword,
    /// Bit 12 is cleared in CSP, CSV and CST when the set-points have rested for this time, until
    /// they change
    bit12_lost_at_rest: Option<Cycles> = Time at Statusword,
    /// Bits 10 and 12 of an earlier homing are set in HM, up to this time after bit 4 of the
    /// Controlword has been set
    homed_before: Option<Cycles> = Time at Statusword,
    /// The Statusword is 0x0256, an unlisted value, for this time after a change to Ready to switch
    /// on or Switched on
    unlisted_statusword: Option<Cycles> = Time at Statusword,
    /// The Statusword is zero for this time after a change to Ready to switch on or Switched on
    zero_statusword: Option<Cycles> = Time at Statusword,
    /// All inputs are zero for this time after the change to Op
    zero_inputs: Option<Cycles> = Time at Inputs,
    /// Bit 8 (halt) has no effect
    halt_ignored: bool = Flag at Controlword,
    /// Quick stop has no effect in Operation enabled
    quick_stop_ignored: bool = Flag at Controlword,
    /// Quick stop acts as disable voltage
    quick_stop_removes_power: bool = Flag at Controlword,
    /// Shutdown has no effect in Operation enabled
    shutdown_ignored: bool = Flag at Controlword,
    /// Writes of 0x6040 by SDO act before Op
    controlword_by_sdo: bool = Flag at Controlword,
    /// Bit 7 resets a fault only after it has been set for this time
    reset_held: Option<Cycles> = Time at Controlword,
    /// 0x6061 shows a new mode this much later
    mode_shown_late: Option<Cycles> = Time at Mode,
    /// 0x6061 shows the mode only in Operation enabled, otherwise 0
    mode_shown_enabled: bool = Flag at Mode,
    /// The mode changes only without power
    mode_without_power: bool = Flag at Mode,
    /// Modes that 0x6502 does not list; the drive stays in its previous mode
    unsupported_modes: u32 = Modes at Mode,
    /// The unit of velocities is larger by this factor than the unit in the dictionary
    velocity_factor: Option<f64> = Factor at Velocity,
    /// All positions shift by this distance 30 ms after the axis is enabled for the first time
    shift_after_enable: i64 = Distance at Position,
    /// All positions shift by this distance 30 ms after each homing
    shift_after_homing: i64 = Distance at Position,
    /// The drive uses 0x607C (or 0x30B0) with the opposite sign
    home_offset_negated: bool = Flag at Homing,
    /// The drive confirms writes to 0x607C (or 0x30B0) and keeps the old value
    home_offset_not_kept: bool = Flag at Homing,
    /// This bit of 0x607E inverts torques too; 5 is a bit of its own
    torque_polarity_bit: Option<u32> = Whole(5, 7) at Torque,
    /// Counts of the encoder per turn; 0x6091:01 of them are 0x6091:02 units of positions
    gear_encoder: Option<u32> = Whole(1, 2_147_483_647) at Unit,
    /// Position and home position survive a loss of power; the axis is where it stopped
    absolute_encoder: bool = Flag at Position,
    /// A torque pulls the shaft towards negative positions, with and without power
    load_torque: f64 = Torque at Shaft,
    /// A holding brake closes this time after the loss of power; its torque is twice the rated
    /// torque
    brake: Option<Cycles> = Time at Shaft,
    /// The holding brake is open while this bit of 0x60FE is set, instead of with the power
    brake_bit: Option<u32> = Whole(0, 31) at Shaft,
    /// An SDO abort has the index without its low byte, as with 16-bit access to the mailbox
    abort_index_word: bool = Flag at Mailbox,
    /// Complete access by SDO is refused with 0x06010000
    complete_access_refused: bool = Flag at Mailbox,
    /// An answer in the mailbox takes this much longer
    mailbox_slow: Option<Delay> = Time at Mailbox,
    /// Requests stay in the mailbox without an answer for this time after the device has left Init
    mailbox_late: Option<Delay> = Time at Mailbox,
    /// An emergency of the device, 0xFF00, precedes each answer in the mailbox
    unsolicited_emergencies: bool = Flag at Mailbox,
    /// An SDO request of the device, the upload of 0x1000, precedes each answer in the mailbox
    unsolicited_requests: bool = Flag at Mailbox,
    /// The last subindex that subindex 0 counts does not exist, except in PDOs, their assignment and
    /// module lists
    last_subindex_missing: bool = Flag at Mailbox,
    /// 0x1C10 to 0x1C1F have no subindex except 0
    assignment_subindices_missing: bool = Flag at Mailbox,
    /// The first data packet of a file write is refused with FoE error 0x8003 (disk full)
    foe_disk_full: bool = Flag at Mailbox,
    /// A request to read or write a file is refused with FoE error 0x8004 (illegal)
    foe_illegal: bool = Flag at Mailbox,
    /// The first data packet of a file write is answered with busy for this time
    foe_busy: Option<Delay> = Time at Mailbox,
    /// The device never fills its inputs; the working counter has no share of them
    inputs_unfilled: bool = Flag at WorkingCounter,
    /// A ControlByte that is not exactly that of the ESI leads to a refusal of SafeOp with 0x001D or
    /// 0x001E
    exact_control_byte: bool = Flag at State,
    /// A refused state change sets the AL status code, and not the error bit
    error_bit_missing: bool = Flag at State,
}

impl Quirks {
    /// True if at least one quirk is on.
    pub(crate) fn any(&self) -> bool {
        *self != Self::default()
    }
}
