//! DC operation mode and its times for this bus cycle.

use super::SelectError;
use crate::model::{DcMode, Device, Position, SyncTime};

/// The DC register values of one device.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct DcSettings {
    /// The name of the mode.
    pub name: String,
    /// The position of the `OpMode`.
    pub position: Position,
    /// Low byte → 0x0980, high byte → 0x0981.
    pub assign_activate: u16,
    /// SYNC0 cycle time in ns, register 0x09A0.
    pub sync0_cycle_ns: u32,
    /// SYNC0 shift in ns.
    pub sync0_shift_ns: i32,
    /// The time from SYNC0 to SYNC1 in ns, register 0x09A4: SYNC1 cycle − SYNC0 cycle + shift.
    pub sync1_delay_ns: u32,
}

impl DcSettings {
    /// Returns `true` if the device generates SYNC1.
    #[must_use]
    pub fn activates_sync1(&self) -> bool {
        self.assign_activate & SYNC1 != 0
    }

    /// Returns `true` if the device generates SYNC0 or SYNC1. Others only use the system time.
    #[must_use]
    pub fn activates_sync(&self) -> bool {
        self.assign_activate & (SYNC0 | SYNC1) != 0
    }
}

const SYNC0: u16 = 0x0200;
const SYNC1: u16 = 0x0400;

/// Returns the OpMode that applies; `None`: the ESI has none, or the user disabled DC.
/// AssignActivate 0 means no distributed clock.
///
/// Without a user's choice, a module's `DcOpModeName` decides. Otherwise a synchronous drive uses
/// the first OpMode that activates the clock, and other devices use the first OpMode.
pub(super) fn choose<'a>(
    device: &'a Device,
    wanted: Option<&str>,
    by_module: Option<&str>,
    synchronous: bool,
) -> Result<Option<&'a DcMode>, SelectError> {
    let named = |name: &str| {
        device.dc_modes.iter().find(|mode| {
            mode.name.eq_ignore_ascii_case(name) || mode.description.eq_ignore_ascii_case(name)
        })
    };
    Ok(match wanted {
        Some(name) => match named(name) {
            Some(mode) => Some(mode),
            None if name.eq_ignore_ascii_case("off") || name.eq_ignore_ascii_case("none") => None,
            None => {
                let names: Vec<String> = device
                    .dc_modes
                    .iter()
                    .map(|mode| {
                        format!(
                            "{:?} (AssignActivate 0x{:03x})",
                            mode.name, mode.assign_activate
                        )
                    })
                    .chain(["\"off\"".to_owned()])
                    .collect();
                return Err(SelectError::NoSuchDcMode {
                    device: device.name.clone(),
                    wanted: name.to_owned(),
                    offered: names.join(", "),
                });
            }
        },
        None => by_module
            .and_then(named)
            .or_else(|| {
                device
                    .dc_modes
                    .iter()
                    .find(|mode| synchronous && mode.assign_activate != 0)
            })
            .or(device.dc_modes.first()),
    })
}

pub(super) fn settings(mode: &DcMode, cycle_ns: u64) -> Result<DcSettings, SelectError> {
    let error = |what| SelectError::DcOutOfRange {
        mode: mode.name.clone(),
        cycle_ns,
        what,
    };
    let bus = i128::from(cycle_ns);
    // An active SYNC signal without cycle and factor uses the bus cycle. SYNC1 depends on the cycle of
    // SYNC0, also if only SYNC1 is active.
    let sync0 = match cycle(mode.sync0, bus) {
        0 if mode.assign_activate & (SYNC0 | SYNC1) != 0 => bus,
        cycle => cycle,
    };
    let sync1_cycle = match cycle(mode.sync1, bus) {
        0 => sync0,
        cycle => cycle,
    };
    let sync1_delay = match mode.assign_activate & SYNC1 {
        0 => 0,
        // SYNC1 cannot come before SYNC0: then it follows the SYNC0 before.
        _ => {
            let delay = sync1_cycle - sync0 + shift(mode.sync1, sync0);
            match delay < 0 {
                true => delay.rem_euclid(sync0.max(1)),
                false => delay,
            }
        }
    };
    Ok(DcSettings {
        name: mode.name.clone(),
        position: mode.position,
        assign_activate: mode.assign_activate,
        sync0_cycle_ns: u32::try_from(sync0).map_err(|_| error("a SYNC0 cycle"))?,
        sync0_shift_ns: i32::try_from(shift(mode.sync0, sync0))
            .map_err(|_| error("a SYNC0 shift"))?,
        sync1_delay_ns: u32::try_from(sync1_delay).map_err(|_| error("a SYNC1 delay"))?,
    })
}

fn cycle(time: SyncTime, base: i128) -> i128 {
    if time.cycle_ns != 0 {
        i128::from(time.cycle_ns)
    } else {
        scaled(time.factor, base)
    }
}

fn shift(time: SyncTime, base: i128) -> i128 {
    i128::from(time.shift_ns) + scaled(time.shift_factor, base)
}

/// ETG.2000: a positive factor multiplies, a negative factor divides.
fn scaled(factor: i32, base: i128) -> i128 {
    match i128::from(factor) {
        0 => 0,
        factor if factor > 0 => base * factor,
        factor => base / -factor,
    }
}
