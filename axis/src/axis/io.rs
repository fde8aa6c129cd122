//! Inputs and outputs of an axis, as transmitted.

/// What shows that a drive has its targets, in a cycle without fresh inputs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
pub enum Delivery {
    /// Nothing.
    #[default]
    Unknown,
    /// A late answer: the drive has the targets of an earlier cycle.
    Earlier,
    /// The frame came back with the inputs of this drive and without those of another device.
    Now,
}

/// The inputs of one drive in one cycle. `None`: not mapped.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Inputs {
    /// 0x6041.
    pub statusword: u16,
    /// 0x6064.
    pub position: Option<i32>,
    /// 0x606C, in the unit of 0x60A9.
    pub velocity: Option<i32>,
    /// 0x6077.
    pub torque: Option<i16>,
    /// 0x6061.
    pub mode_display: Option<i8>,
    /// 0x603F.
    pub error_code: Option<u16>,
    /// 0x60B9.
    pub touch_probe_status: Option<u16>,
    /// 0x60BA, 0x60BB, 0x60BC, 0x60BD: positive and negative edge of probe 1, then of probe 2.
    pub touch_probe_positions: [Option<i32>; 4],
    /// Counts of the second encoder; `None` without fresh data of its device.
    pub second_position: Option<i32>,
    /// False if no answer arrived in time. The values are then old, and no decision uses them. The
    /// set-point continues for two consecutive cycles of this kind and then waits.
    pub fresh: bool,
    /// Whether the drive has its targets although the inputs are not fresh. The set-point then
    /// decelerates instead of waiting.
    pub delivery: Delivery,
}

/// The outputs of one drive in one cycle. Every field always has a safe value, mapped or not.
/// During a mode switch, the targets of both modes are valid.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Outputs {
    /// 0x6040.
    pub controlword: u16,
    /// 0x6060.
    pub mode: i8,
    /// 0x607A. Follows the actual position if the mode does not use it.
    pub target_position: i32,
    /// 0x60FF. 0 if the mode does not use it.
    pub target_velocity: i32,
    /// 0x6071. 0 if the mode does not use it.
    pub target_torque: i16,
    /// 0x6081, in the unit of 0x60A9.
    pub profile_velocity: u32,
    /// 0x6083 and 0x6084, in the unit of 0x60AA.
    pub profile_acceleration: u32,
    /// 0x60B1, added to the drive's velocity demand. 0 outside CSP.
    pub velocity_offset: i32,
    /// 0x60B8.
    pub touch_probe_function: u16,
    /// True if an output that controls the brake is to open it.
    pub brake_open: bool,
    /// 0x60B2, added to the drive's torque demand. 0 outside CSP.
    pub torque_offset: i16,
}
