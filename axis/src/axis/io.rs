//! What an axis gets from its drive and gives to it, as it is on the wire.

/// One cycle's inputs of one drive. `None`: not mapped.
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
    /// 0x60BA, 0x60BB, 0x60BC, 0x60BD: probe 1 positive and negative edge, probe 2 positive and negative edge.
    pub touch_probe_positions: [Option<i32>; 4],
    /// `false`: no answer came in time; the values are old and no decision is made on them. The set-point runs on for two
    /// such cycles in a row, then it waits.
    pub fresh: bool,
    /// Where not fresh: the answer to an earlier frame came late. It proves that the targets arrive, so the set-point
    /// decelerates instead of waiting.
    pub late: bool,
}

/// One cycle's outputs of one drive. Every field is always a safe value, whichever of them are mapped. While the mode is
/// being switched, the targets of both modes are valid.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Outputs {
    /// 0x6040.
    pub controlword: u16,
    /// 0x6060.
    pub mode: i8,
    /// 0x607A. Follows the actual position where it does not count.
    pub target_position: i32,
    /// 0x60FF. 0 where it does not count.
    pub target_velocity: i32,
    /// 0x6071. 0 where it does not count.
    pub target_torque: i16,
    /// 0x6081, in the unit of 0x60A9.
    pub profile_velocity: u32,
    /// 0x6083, in the unit of 0x60A9 per second; also for 0x6084.
    pub profile_acceleration: u32,
    /// 0x60B1, added to the drive's own velocity demand. 0 outside CSP.
    pub velocity_offset: i32,
    /// 0x60B8.
    pub touch_probe_function: u16,
    /// The brake is to be open, where an output opens it.
    pub brake_open: bool,
    /// 0x60B2, added to the drive's own torque demand. 0 outside CSP.
    pub torque_offset: i16,
}
