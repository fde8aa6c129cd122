//! Objects that the cycle writes, or whose values follow from other keys of the machine file. One
//! list for the `sdo` entries of the file and for the clients of the mailbox gateway.

use std::ops::RangeInclusive;

use ecaxis_ecat::object::NamedObject;
use ecaxis_esi as esi;

use super::AxisSetup;
use super::duration::show;
use super::problem::Problems;
use super::raw::{RawDevice, RawSdo};

/// What an `sdo` entry may write to an object of the cycle.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Permitted {
    Nothing,
    Zero,
    /// The mode of the device.
    Mode,
    /// The cycle, as 0x60C2 counts it.
    InterpolationTime,
    /// The cycle in ns, in subindex 2.
    SyncManagerCycle,
    /// Any value, if the object is not in the process data.
    IfNotMapped,
}

struct CycleObject {
    /// The objects of the first axis; further axes have theirs 0x800 higher.
    range: RangeInclusive<u16>,
    of_drive: bool,
    permitted: Permitted,
    /// The end of the message, after the object.
    reason: &'static str,
    advice: &'static str,
}

/// Objects that add to a target after its limits: position, velocity, torque.
pub(crate) const OFFSETS: [u16; 3] = [0x60b0, 0x60b1, 0x60b2];

const PROCESS_DATA: &str = "follows from `mode`, `modules`, `assignment` and `pdo`";
const PROCESS_DATA_ADVICE: &str = "choose the process data with these keys";
const TARGET: &str = "is a target of the axis, which the cycle writes";
const TARGET_ADVICE: &str = "give the axis a command instead";
const CYCLE_ADVICE: &str = "remove it from `sdo`: ecaxis writes the cycle";

const OBJECTS: [CycleObject; 12] = [
    of_device(0x1600..=0x17ff, PROCESS_DATA, PROCESS_DATA_ADVICE),
    of_device(0x1a00..=0x1bff, PROCESS_DATA, PROCESS_DATA_ADVICE),
    of_device(0x1c10..=0x1c2f, PROCESS_DATA, PROCESS_DATA_ADVICE),
    CycleObject {
        permitted: Permitted::SyncManagerCycle,
        ..of_device(0x1c30..=0x1c3f, "contradicts `bus.cycle`", CYCLE_ADVICE)
    },
    of_drive(
        0x6040..=0x6040,
        Permitted::Nothing,
        "commands the drive: an entry would act before Op",
        "remove it from `sdo`: the axis writes the Controlword in each cycle",
    ),
    of_drive(
        0x6060..=0x6060,
        Permitted::Mode,
        "contradicts `mode`",
        "remove it from `sdo`, or set `mode`",
    ),
    of_drive(0x6071..=0x6071, Permitted::Nothing, TARGET, TARGET_ADVICE),
    of_drive(0x607a..=0x607a, Permitted::Nothing, TARGET, TARGET_ADVICE),
    of_drive(0x60ff..=0x60ff, Permitted::Nothing, TARGET, TARGET_ADVICE),
    of_drive(
        0x60b8..=0x60b8,
        Permitted::IfNotMapped,
        "is in the process data, which overwrite it",
        "remove it from `sdo`: a `probe` step writes it",
    ),
    of_drive(
        0x60c2..=0x60c2,
        Permitted::InterpolationTime,
        "contradicts `bus.cycle`",
        CYCLE_ADVICE,
    ),
    of_drive(
        OFFSETS[0]..=OFFSETS[2],
        Permitted::Zero,
        "adds to every target of the axis, past its limits",
        "write 0, or leave it out",
    ),
];

const fn of_device(
    range: RangeInclusive<u16>,
    reason: &'static str,
    advice: &'static str,
) -> CycleObject {
    CycleObject {
        range,
        of_drive: false,
        permitted: Permitted::Nothing,
        reason,
        advice,
    }
}

const fn of_drive(
    range: RangeInclusive<u16>,
    permitted: Permitted,
    reason: &'static str,
    advice: &'static str,
) -> CycleObject {
    CycleObject {
        range,
        of_drive: true,
        permitted,
        reason,
        advice,
    }
}

/// Returns the row of an object. `is_drive`: the device has axes.
fn row(index: u16, is_drive: bool) -> Option<&'static CycleObject> {
    let mut rows = OBJECTS.iter();
    let of_axis = esi::axis::of(index).map_or(index, |(_, same)| same);
    rows.find(|row| row.range.contains(&of_axis) && (is_drive || !row.of_drive))
}

/// True if the cycle writes the object, or if its values are built on it. `is_drive`: the device
/// has axes.
pub(crate) fn contains(index: u16, is_drive: bool) -> bool {
    row(index, is_drive).is_some()
}

/// Reports `sdo` entries that contradict the process data, the mode, the cycle, or `homing`.
pub(super) fn check(
    raw: &RawDevice,
    selection: &esi::Selection,
    axes: &[&AxisSetup],
    cycle_ns: u64,
    p: &mut Problems<'_>,
) {
    let is_drive = !raw.axes.0.is_empty();
    let homing = axes.iter().filter_map(|axis| axis.homing.as_ref());
    let homing: Vec<_> = homing.flat_map(|homing| &homing.startup).collect();
    for sdo in &raw.sdo {
        let (index, sub) = sdo.address();
        let object = NamedObject { index, sub };
        if let Some(row) = row(index, is_drive)
            && !is_permitted(row.permitted, sdo, raw, selection, cycle_ns)
        {
            let value = match row.permitted {
                Permitted::InterpolationTime => interpolation_time(sdo, raw, selection)
                    .map_or(String::new(), |ns| format!(", {},", show(ns))),
                _ => String::new(),
            };
            let message = format!("{object}{value} {}", row.reason);
            p.add_hint(sdo.span.clone(), message, row.advice);
        }
        let written = homing
            .iter()
            .find(|own| (own.index, own.sub) == (index, sub));
        let number = |data: &[u8]| super::sdo::little_endian(data, false);
        let last = selection.startup.iter().find(|own| {
            (own.index, own.sub) == (index, sub) && own.origin == esi::SDO_OF_MACHINE_FILE
        });
        if let (Some(written), Some(own)) = (written, last)
            && number(&written.data) != number(&own.data)
        {
            let message = format!("{object} follows from `homing`");
            p.add_hint(sdo.span.clone(), message, "remove it from `sdo`");
        }
    }
}

fn is_permitted(
    permitted: Permitted,
    sdo: &RawSdo,
    raw: &RawDevice,
    selection: &esi::Selection,
    cycle_ns: u64,
) -> bool {
    let value = sdo.value.get_ref().integer();
    match permitted {
        Permitted::Nothing => false,
        Permitted::Zero => value == Some(0),
        Permitted::Mode => selection.mode.map(|mode| i64::from(mode.code())) == value,
        Permitted::InterpolationTime => {
            let alone = selection.mode == Some(esi::Mode::Cst) && value == Some(0);
            alone || interpolation_time(sdo, raw, selection) == Some(cycle_ns)
        }
        Permitted::SyncManagerCycle => {
            sdo.address().1 != 2 || value.and_then(|ns| u64::try_from(ns).ok()) == Some(cycle_ns)
        }
        Permitted::IfNotMapped => selection.layout.rx_field(sdo.index, 0).is_none(),
    }
}

/// Returns 0x60C2 in ns as it is with the entries of the file.
fn interpolation_time(sdo: &RawSdo, raw: &RawDevice, selection: &esi::Selection) -> Option<u64> {
    /// The exponent of milliseconds, the default of CiA 402-2.
    const MILLISECONDS: i64 = -3;
    let of_sub = |sub: u8| {
        let address = (sdo.index, sub);
        let own = raw.sdo.iter().rev().find(|own| own.address() == address);
        let derived = || {
            let mut all = selection.startup.iter();
            let derived = all.find(|own| (own.index, own.sub) == address)?;
            let byte = *derived.data.first()?;
            Some(match sub {
                1 => i64::from(byte),
                _ => i64::from(i8::from_le_bytes([byte])),
            })
        };
        match own {
            Some(own) => own.value.get_ref().integer(),
            None => derived(),
        }
    };
    let value = u64::try_from(of_sub(1)?).ok()?;
    let power = u32::try_from(9 + of_sub(2).unwrap_or(MILLISECONDS)).ok()?;
    10_u64.checked_pow(power)?.checked_mul(value)
}
