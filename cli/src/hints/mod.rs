//! The message and the advice for each failure.

use std::io::ErrorKind;
use std::path::Path;

use ecaxis_axis::cia402::describe;
use ecaxis_axis::scale::UnitMismatch;
use ecaxis_axis::{CommandError, EnableBlocker, HomingError, State, Trip, VelocityUnit};
use ecaxis_ecat::al_status_code::{SYNC_MANAGER_WATCHDOG, al_status_hint};
use ecaxis_ecat::mailbox::abort_code as abort;
use ecaxis_esi::{SDO_OF_MACHINE_FILE, address};
use ecaxis_master::acyclic::{AlState, StateError};
use ecaxis_master::config::{ConfigError, LimitConflict, Nic, UnitProblem};
use ecaxis_master::link::second_end::SecondEnd;
use ecaxis_master::mailbox::{CoeCause, SdoError};
use ecaxis_master::report::{Cause, Error};
use ecaxis_master::rt::gateway::NodeState;
use ecaxis_sim::ServeError;

pub(crate) use crate::failure::{FAILED, Failure, INTERRUPTED, WRONG};

mod fault_report;
mod firmware;
mod host;
mod service;

pub(crate) use fault_report::diagnosed;
pub(crate) use firmware::{firmware, shared_bus};
pub(crate) use host::{capabilities, concern, denied, interface, interfaces, overload};
use service::{FRAMES, eeprom, eoe, information, parameter, tap};
pub(crate) use service::{image, restore, with_other_main_device};

/// Returns the advice for the error code of an emergency message, as for 0x603F.
pub(crate) fn emergency(code: u16) -> &'static str {
    describe(code).hint
}

/// Adds advice for a recording without EtherCAT frames.
pub(crate) fn no_ethercat(failure: Failure, one_interface: bool) -> Failure {
    failure.hint(if one_interface {
        "omit `--interface` to use all"
    } else {
        "record on the interface of the bus: frames of EtherType 0x88a4, or UDP port 34980"
    })
}

/// Maps an error of the master to a failure. Hints depend on whether the bus is real.
pub(crate) fn failure(error: &Error, nic: &Nic) -> Failure {
    let failure = Failure::new(FAILED, error.to_string());
    let hint = match &*error.cause {
        Cause::Open(open) => return interface(failure, open),
        Cause::NoAnswer { second_end: Some(end) } => second_end(end),
        Cause::NoAnswer { second_end: None } => {
            return match nic {
                Nic::Interface(name) => failure
                    .hint(format!("is `{name}` the right interface? {}", interfaces()))
                    .hint("check that the first SubDevice has power and its IN port is connected"),
                Nic::Sim => failure.hint("check the fault script: it may silence the bus"),
            };
        }
        Cause::Silent { .. } | Cause::Datagram(_) | Cause::NotTaken { .. } => {
            let failure = failure.hint(FRAMES);
            return if error.is_in_bring_up() {
                failure.hint("record the bring-up with `--record`")
            } else {
                failure
            };
        }
        Cause::Scan(_) => FRAMES.to_owned(),
        Cause::NotFound { .. } | Cause::Ambiguous { .. } => {
            return Failure { code: WRONG, ..failure }
                .hint("`ecaxis scan` shows the devices on the bus");
        }
        Cause::Eeprom(error) => eeprom(*error).to_owned(),
        Cause::Sii(_) | Cause::DamagedEeprom(_) => {
            "`ecaxis eeprom verify` shows the problems, `ecaxis esi sii` generates an image from an ESI file, `ecaxis eeprom write` repairs the EEPROM".to_owned()
        }
        Cause::EepromChanged => {
            "start again, and do not exchange devices or write EEPROMs meanwhile".to_owned()
        }
        Cause::NoMailbox => {
            "devices without a mailbox, such as digital terminals, have no parameters".to_owned()
        }
        Cause::WrongState { .. } => "bring it to Init first, or switch it off and on".to_owned(),
        Cause::Eoe { source, .. } => eoe(source),
        Cause::Tap { source, step, name } => tap(source, *step, name),
        Cause::Sdo(source) if error.is_in_bring_up() => sdo(source, "bring-up"),
        Cause::Sdo(source) => parameter(source),
        Cause::Information(source) => information(source).to_owned(),
        Cause::Missing { .. } => {
            "check the power of the first one missing and the cable to it, or remove its [[device]] from the file; `ecaxis compare` shows all differences".to_owned()
        }
        Cause::Reversed { .. } => {
            "swap its two cables: its IN (port 0) leads towards this computer; `ecaxis scan` shows the ports".to_owned()
        }
        Cause::Unexpected { position, .. } => {
            format!("add a [[device]] with `position = {position}`, or disconnect it")
        }
        Cause::Identity { .. } => {
            "check the order of the devices; for another model or firmware, name its ESI file with `esi`, or pick with `product` and `revision`; `identity = \">=\"` accepts newer revisions as well; `ecaxis compare` shows all differences".to_owned()
        }
        Cause::Modules { .. } => {
            "plug the modules in the order of `modules`, or correct `modules`: the list is complete, with \"-\" for an empty slot; `ecaxis compare` shows all differences".to_owned()
        }
        // Not an object of modules or PDOs.
        Cause::NotReady { cause, .. }
            if matches!(**cause, Cause::StartUp { index: 0x2000..=0xefff, .. }) =>
        {
            "switch the device off and on, and end other programs at its mailbox; if it has modules, check their supply and slots (`ecaxis compare`)".to_owned()
        }
        Cause::NotReady { .. } => {
            "check the supply of the device and of its modules, and the modules in its slots; `ecaxis compare` compares them with the file".to_owned()
        }
        Cause::Serial { found, .. } => {
            format!("if the device was replaced on purpose, write `serial = {found}` or omit `serial`")
        }
        Cause::Settings { .. } => {
            "`ecaxis sdo compare` shows all differences; save a new file with `ecaxis sdo dump`, or correct the value in it".to_owned()
        }
        Cause::OtherFirmware { .. } => {
            "update the firmware of the device (`ecaxis firmware update`), or save the parameters of a device with this firmware".to_owned()
        }
        Cause::NotLocated { .. } => {
            "set the device's alias or ID switch, or find it by `position`".to_owned()
        }
        Cause::StartUp { index, sub, source, origin, .. } => pdo_selection((*index, *sub), source, origin)
            .map_or_else(|| sdo(source, origin), str::to_owned),
        Cause::StartUpIdn { source, origin, .. } => sdo(source, origin),
        Cause::IdnValue { .. } => "correct the value in `idn`; `ecaxis soe read` shows the attribute".into(),
        Cause::NotHeld { .. } => {
            "the device rounds or limits the value, or another object has changed it: write the value that it holds, or omit `verify` for this object".to_owned()
        }
        Cause::Watchdog { .. } => {
            "without its watchdog the drive keeps moving when the outputs fail: ask its vendor how to enable it".to_owned()
        }
        Cause::Units { problems } => {
            return problems.iter().map(units).fold(failure, Failure::hint);
        }
        Cause::Mapping { .. } => {
            "the drive's firmware has another PDO mapping than the ESI file: use the ESI file of that firmware".to_owned()
        }
        Cause::MailboxMoved { .. } => {
            "the EEPROM has no usable mailbox: write `mailbox = \"esi\"`, or use the ESI file of the device's firmware".to_owned()
        }
        Cause::Fmmus { .. } => {
            "choose fewer PDOs, so that fewer SyncManagers carry process data (`assignment`, `pdo`)".to_owned()
        }
        Cause::NoStart => {
            "frames are lost or the computer is overloaded: check cables, and stop other programs".to_owned()
        }
        Cause::ClockDoesNotFollow => {
            "connect it in front of all other devices with a clock, or write `dc = \"off\"`".into()
        }
        Cause::NoClock => {
            "run the device without distributed clock: `dc = \"off\"`".to_owned()
        }
        Cause::State(state) => self::state(state),
        Cause::MailboxGateway { .. } => {
            "end the program that has this port, or name another with `bind` under [mailbox_gateway]".to_owned()
        }
        Cause::Record(_) => "name a file that can be written, on a disk with room".to_owned(),
        Cause::Replay(_) => {
            // The recording is a user input.
            return Failure { code: WRONG, ..failure }
                .hint("a replay needs a complete recording of a run of this machine file, made with `ecaxis run --record`");
        }
        Cause::NotMapped(object) => format!(
            "add \"{}\" to the device's `pdo` lists, or omit them to use the ESI's",
            address(object.index, object.sub),
        ),
        Cause::NoProcessData { .. } => {
            "`ecaxis explain` shows the expected layout; a device without an FMMU left answers no process data".to_owned()
        }
        Cause::NoInputs { .. } => {
            "switch the device off and on; if it happens again, ask its vendor when its firmware fills the inputs".to_owned()
        }
        Cause::PhaseNotLocked { .. } => {
            "wake-ups are too irregular: run with real-time priority (`ecaxis run` warns if it has none), or a longer `cycle`".to_owned()
        }
        Cause::NotEnabled { state, code, waiting, .. } => not_enabled(*state, *code, *waiting),
        Cause::NodeNotOperational { .. } => {
            "the gateway starts a node after it has booted and taken its configuration: check its power, node-ID and bit rate, and the node's `objects` (`ecaxis explain` lists what the gateway writes)".to_owned()
        }
        Cause::WrongMode { .. } => {
            "the drive refused the mode: check 0x6502 (supported drive modes), and that no parameter forbids it".to_owned()
        }
        Cause::Trip { trip: Trip::FollowingError { .. }, limits, .. } if !limits.is_empty() => {
            allows_less(limits)
        }
        Cause::DriveFault { code: Some(FOLLOWING_ERROR), report, .. } if !report.limits.is_empty() => {
            allows_less(&report.limits)
        }
        Cause::DriveFault { code: Some(code), .. } => describe(*code).hint.to_owned(),
        Cause::DriveFault { code: None, .. } => "read 0x603F and the error history 0x1003 of the drive".to_owned(),
        Cause::Trip { trip, .. } => self::trip(trip).to_owned(),
        Cause::BusLost { answered: false, .. } => {
            "check cables and power; `lost_frames` sets how many bad cycles are tolerated".to_owned()
        }
        Cause::BusLost { answered: true, wkc, .. } => fault_report::working_counter(*wkc).to_owned(),
        Cause::LeftOp { code, .. } => al_status(*code).to_owned(),
        Cause::Absent => "connect the device, or take its axes out of the program".to_owned(),
        Cause::HeldOutput { .. } => "leave it out of `pdo.rx`: an optional device cannot keep its own value".to_owned(),
        Cause::OtherUnits => "give the axis its units in the machine file: `encoder`, `velocity_unit`, `acceleration_unit`".to_owned(),
        Cause::NodeLost { state: NodeState::NoAcknowledgement, .. } => {
            "check that the gateway is the NMT master of its network and that no other program writes its control word".to_owned()
        }
        Cause::NodeLost { .. } => "check the drive's power, the CAN cable and its terminators; a CANopen tool reads the drive's error history (0x1003)".to_owned(),
        Cause::Gone => "check the device's power and the cable to it".to_owned(),
        Cause::LeftOpBriefly { .. } => "look for loose connectors and supply dips".to_owned(),
        Cause::NotReached { .. } => {
            "check load and tuning, or give the axis a wider `target_window`".to_owned()
        }
        Cause::ProbeNotArmed { input, .. } => format!(
            "check that the drive has a digital input configured as touch probe {input} (0x60B8 and 0x60B9 in its manual)"
        ),
        Cause::NotProbed { input, edge, .. } => format!(
            "check the sensor, its wiring, and that the drive's digital input is configured as touch probe {input}; an input that is {} when the search begins shows no such edge; search farther with `to` or `by`, or for the other `edge`",
            if *edge == "rising" { "already on" } else { "off" }
        ),
        Cause::StepTimeout { .. } => "check the drive's state and fault; the step waits for `bus.enable_timeout`, or for the longest stop time of an axis".to_owned(),
        Cause::NotSwitched { .. } => {
            return failure
                .hint("check 0x6502 (supported drive modes) and the mode's requirements in the drive's manual")
                .hint(MODE_CHANGE);
        }
        Cause::NotHomed { error, .. } => not_homed(*error).to_owned(),
        Cause::VariableRange { .. } => "test the variable with `if` before this step, or correct its range under [variables]".to_owned(),
        Cause::Alarm { .. } => "remove its cause, then start again".to_owned(),
        Cause::StartMissed { .. } => "enable the axes first, and choose a later instant".to_owned(),
        Cause::WaitTimeout { .. } => "check the sensor and its wiring, or give the step a longer `timeout`".to_owned(),
        Cause::TooLarge(_) => "map fewer objects with `pdo.rx` and `pdo.tx`".to_owned(),
        Cause::ClockNotSettled { .. } => "frames reach the clocks too irregularly, or the device has a faulty clock: run with real-time priority, or with `dc = \"off\"`".to_owned(),
        Cause::PowerLostWithoutCause { .. } => "an error in ecaxis: keep the recording and the fault report, and report it".to_owned(),
        Cause::NotDisabled { .. } => "the drive ignores its Controlword: switch its power off by hand, then check its fault".to_owned(),
        Cause::Refused { by_axis, .. } => {
            refused(by_axis.as_deref(), error.device().map_or("", |device| &device.name))
        }
        Cause::Axis(_) => "check the step and the axis' limits in the machine file".to_owned(),
        Cause::EmergencyStop { .. } => "release it, then run again; `[stop] emergency` in the machine file says what it is".to_owned(),
        Cause::FollowLost { cause: Some(cause), .. } => {
            return Failure { hints: self::failure(cause, nic).hints, ..failure };
        }
        Cause::FollowLost { cause: None, .. } => "keep the followed axis under power and within what the follower's limits and range allow".to_owned(),
        Cause::LineShaftWaits { .. } => "start the step when `line_shafts` of the server's state shows \"running\"".to_owned(),
        Cause::LineShaftEnded { .. } => "restore the stream of set-points, then `reset`, `enable` and start the program again".to_owned(),
        Cause::EnableRefused { .. } => "`reset` an axis that has stopped; for one that still moves, find out what moves it".to_owned(),
        Cause::GroupStopped { cause, .. } => {
            let cause = self::failure(cause, nic).hints.into_iter();
            let back = "once the cause is known, restart the group with the steps `reset` and `enable`";
            return cause.fold(failure, Failure::hint).hint(back);
        }
        Cause::Unsupervised => "the computer is overloaded: reserve a CPU for the cycle (`cpu` in [bus]) and run `ecaxis doctor`".to_owned(),
        Cause::Controller => "its message is on stderr; the axes were stopped".to_owned(),
        Cause::Panicked(_) => "this is a defect of ecaxis: please report it with the machine file and, if you can, `--record`".to_owned(),
        Cause::Interrupted => {
            let failure = Failure { code: INTERRUPTED, ..failure };
            return match error.device() {
                Some(_) => failure.hint("the device is back in its original state; the same command starts again"),
                None => failure,
            };
        }
        Cause::Sim(_) | Cause::Thread(_) | Cause::Link(_) => return failure,
    };
    failure.hint(hint)
}

/// Returns the hint for a replayed run whose recording is of another bus.
pub(crate) fn replayed(error: &Error, devices: usize) -> Option<String> {
    let shown = match &*error.cause {
        Cause::Missing { found: 1, .. } => "1 SubDevice".to_owned(),
        Cause::Missing { found, .. } => format!("{found} SubDevices"),
        Cause::Unexpected { .. } => "more SubDevices".to_owned(),
        Cause::Identity { .. } | Cause::Serial { .. } | Cause::NotLocated { .. } => {
            "other SubDevices".to_owned()
        }
        _ => return None,
    };
    Some(format!(
        "the recording is of another machine or of an incomplete bus: it shows {shown}, the file has {devices}"
    ))
}

/// Returns the hint for a refused command. `name`: the axis that refused it.
fn refused(reason: Option<&CommandError>, name: &str) -> String {
    match reason {
        Some(CommandError::NotEnabled { .. }) => {
            format!("enable the axis in an earlier step: `enable = [\"{name}\"]`")
        }
        Some(CommandError::StillMoving { .. }) => format!(
            "stop the axis in an earlier step: `velocity = {{ {name} = 0.0 }}` or `stop = [\"{name}\"]`"
        ),
        Some(CommandError::Following) => {
            format!("end following in an earlier step: `stop = [\"{name}\"]`")
        }
        Some(CommandError::WrongMode { needs, .. }) => format!(
            "switch the mode in an earlier step: `mode = {{ {name} = \"{}\" }}`",
            needs.to_string().to_lowercase()
        ),
        Some(CommandError::Faulted(_) | CommandError::Tripped(_) | CommandError::GroupStopped) => {
            format!(
                "once the cause is known, reset the axis in an earlier step: `reset = [\"{name}\"]`"
            )
        }
        Some(CommandError::ModeNotOffered { .. } | CommandError::NoModeDisplay) => {
            "map 0x6060, 0x6061 and the mode's targets with `pdo.rx` and `pdo.tx`".to_owned()
        }
        Some(CommandError::NoProbe) => {
            "map 0x60B8, 0x60B9 and 0x60BA to 0x60BD with `pdo.rx` and `pdo.tx`".to_owned()
        }
        _ => "check the step and the axis' limits in the machine file".to_owned(),
    }
}

fn not_homed(error: HomingError) -> &'static str {
    match error {
        HomingError::Timeout { .. } => {
            "check the switch or sensor of the method, its wiring and its side (0x60FD shows the drive's inputs; on the simulated bus, `track` of [device.sim] places switches); a long travel needs a higher `homing.search` or a longer `homing.timeout`"
        }
        HomingError::Drive => {
            "the search reached the other limit switch or found no index pulse: check switches, their wiring and the drive's digital inputs, and the direction of `homing.method`"
        }
        HomingError::NeverCleared => {
            "this drive does not clear Statusword bit 12 when homing starts: check its homing method (0x6098), or switch it off and on before the next homing"
        }
        HomingError::Elsewhere { .. } => {
            "the drive did not keep the home offset, or counts it with the other sign (0x607C; maxon 0x30B0): compare it with `homing.position`"
        }
        HomingError::ModeRefused => {
            "check 0x6502 (supported drive modes): this drive may not support homing; a slow drive needs a longer `mode_time`, one that changes its mode only without power needs `mode_change = \"no-power\"`"
        }
        HomingError::PowerLost => "check the drive's fault (0x603F) and its supply",
        HomingError::Aborted | HomingError::Held => "home the axis again before any absolute move",
    }
}

/// Returns what to change in the machine file or in the drive.
fn units(problem: &UnitProblem) -> String {
    let found = match problem {
        UnitProblem::Contradiction(found) => found,
        UnitProblem::PositionRange(_) => {
            return "write 0 to 0x607B:01 and :02 with `sdo`: ecaxis counts on where 32 bits end"
                .to_owned();
        }
        UnitProblem::NoRatedTorque { .. } => {
            return "add `rated_torque = 0.1` (Nm), or give torques in percent".to_owned();
        }
        UnitProblem::NoTorqueConstant => {
            return "add `torque_constant = 0.0385` (Nm/A), or give torques in percent".to_owned();
        }
        UnitProblem::Config { .. } | UnitProblem::Homing { .. } => {
            return "write a finer or coarser unit with `sdo = [{ index = 0x60A9, value = … }]`, or change the axis' limits".to_owned();
        }
    };
    match *found {
        UnitMismatch::VelocityUnit {
            expected,
            found: code,
        } => {
            let write = format!(
                "write `sdo = [{{ index = 0x60A9, value = 0x{:08X} }}]`",
                expected.si_code()
            );
            match VelocityUnit::from_si_code(code) {
                Some(unit) => {
                    format!("{write}, or `velocity_unit = \"{unit}\"`, or omit `velocity_unit`")
                }
                None => write,
            }
        }
        UnitMismatch::CountsPerTurn {
            index: 0x608F,
            found: counts,
            ..
        } => format!(
            "write `encoder = {counts}`, or correct the drive's encoder resolution (0x608F)"
        ),
        UnitMismatch::RatedTorque { found: 1.., .. } => {
            "correct `sdo`, or the drive's motor data; `rated_torque` takes precedence".to_owned()
        }
        ref other => other.advice().to_owned(),
    }
}

/// Returns what to plug or to write where the frames arrive at another interface.
fn second_end(end: &SecondEnd) -> String {
    let SecondEnd {
        nic,
        second,
        processed_by,
    } = end;
    match processed_by {
        0 => format!(
            "plug the cable of `{nic}` into the IN port of the first SubDevice; for a ring whose IN port is at `{second}`, write `nic = \"{second}\"` and `redundant = \"{nic}\"` into [bus], or name both: `{second},{nic}`"
        ),
        _ => format!(
            "a ring needs both interfaces: write `redundant = \"{second}\"` into [bus], or name both: `{nic},{second}`; for a line, unplug `{second}`"
        ),
    }
}

/// How a list such as 0x1C12 is written.
const ORDER_OF_A_LIST: &str =
    "write in this order: subindex 0 = 0, the entries, subindex 0 = their number";

/// The advice for a device that does not let its PDO assignment be changed.
const KEPT_ASSIGNMENT: &str = "the device keeps its PDO assignment: `ecaxis sdo read` shows its PDOs (0x1C12, 0x1C13); use the ESI file of its firmware, or choose these PDOs with `mode` or `assignment`";

/// Returns the hint for a refused PDO assignment or mapping that is not the user's own.
fn pdo_selection((index, sub): (u16, u8), error: &SdoError, origin: &str) -> Option<&'static str> {
    let is_assignment = matches!(index, 0x1c10..=0x1c2f);
    let is_mapping = matches!(index, 0x1600..=0x17ff | 0x1a00..=0x1bff);
    let code = error.abort_code()?;
    if origin == SDO_OF_MACHINE_FILE || !is_assignment && !is_mapping {
        return None;
    }
    Some(match code {
        abort::SUBINDEX_0_NOT_ZERO => {
            "the device has not emptied this list (subindex 0 = 0): switch it off and on; if it refuses again, its PDOs are fixed: use the ESI file of its firmware"
        }
        abort::UNSUPPORTED_ACCESS..=abort::READ_ONLY if is_assignment => KEPT_ASSIGNMENT,
        abort::OUT_OF_RANGE..=abort::MAX_BELOW_MIN | abort::INCOMPATIBLE_PARAMETERS
            if is_assignment && sub == 0 =>
        {
            KEPT_ASSIGNMENT
        }
        abort::UNSUPPORTED_ACCESS..=abort::READ_ONLY => {
            "the device keeps the contents of this PDO: omit `pdo`, or list in it what `ecaxis sdo read` shows; or use the ESI file of its firmware"
        }
        code if abort::is_no_such_object(code) && is_assignment => {
            "the device has fewer PDOs than its ESI file, or fixed ones: use the ESI file of its firmware"
        }
        abort::OUT_OF_RANGE..=abort::MAX_BELOW_MIN
        | abort::NOT_MAPPABLE..=abort::INCOMPATIBLE_PARAMETERS
            if is_assignment =>
        {
            "the device does not accept this PDO, alone or with the others of its SyncManager: choose other PDOs with `mode`, `assignment` or `pdo`"
        }
        abort::INCOMPATIBLE_PARAMETERS => {
            "the device cannot map this object with the others of the PDO: choose fewer or other objects with `pdo.rx` and `pdo.tx`"
        }
        abort::DEVICE_STATE => {
            "the device changes its PDOs in PreOp only, and its modules must be ready: switch it off and on, and end other programs at its mailbox"
        }
        _ => return None,
    })
}

/// Returns the hint for an SDO error. `origin` is the source of the request; [`SDO_OF_MACHINE_FILE`] for the
/// user's own list.
fn sdo(error: &SdoError, origin: &str) -> String {
    let own = origin == SDO_OF_MACHINE_FILE;
    match error.cause {
        CoeCause::Abort(code) => match code {
            code if abort::is_no_such_object(code) && own => {
                "the drive has no such object: check `index` and `sub` in `sdo`"
            }
            code if abort::is_no_such_object(code) => {
                "the drive has no such object: its firmware does not match the ESI file"
            }
            abort::OUT_OF_RANGE..=abort::MAX_BELOW_MIN if origin.contains("cycle") => {
                "the drive does not take this cycle time: try another `cycle`"
            }
            abort::OUT_OF_RANGE..=abort::MAX_BELOW_MIN if own => {
                "the value is outside what the drive allows: check `value` in `sdo`"
            }
            abort::OUT_OF_RANGE..=abort::MAX_BELOW_MIN => {
                "the value is outside what the drive allows: its firmware does not match the ESI file"
            }
            abort::SUBINDEX_0_NOT_ZERO if own => ORDER_OF_A_LIST,
            abort::SUBINDEX_0_NOT_ZERO => {
                "the drive has not emptied this list (subindex 0 = 0): switch it off and on"
            }
            abort::UNSUPPORTED_ACCESS..=abort::READ_ONLY if own => {
                "the object cannot be written: remove it from `sdo`"
            }
            abort::UNSUPPORTED_ACCESS..=abort::READ_ONLY => {
                "the drive does not permit this access to the object: its firmware does not match the ESI file"
            }
            abort::TYPE_MISMATCH..=abort::DATA_TOO_SHORT if own => {
                "the object has another length in the drive: set its `type` in `sdo`"
            }
            abort::TYPE_MISMATCH..=abort::DATA_TOO_SHORT => "the object has another length in the drive: its firmware does not match the ESI file",
            abort::NOT_MAPPABLE | abort::PDO_TOO_LONG if origin.starts_with("pdo.") => {
                "the drive cannot map this: remove it from `pdo.rx` or `pdo.tx`"
            }
            abort::NOT_MAPPABLE | abort::PDO_TOO_LONG => {
                "the drive cannot map what the ESI file lists: choose other objects with `pdo.rx` and `pdo.tx`"
            }
            abort::LOCAL_CONTROL => "the drive is under local control: end its panel or commissioning tool; an object that is mapped now may not be writable either",
            abort::NO_MEMORY | abort::NOT_STORED | abort::HARDWARE => "the drive cannot store it now: switch it off and on, then check its own error history",
            abort::INCOMPATIBLE_PARAMETERS | abort::INTERNAL_INCOMPATIBILITY if own => "the value contradicts another setting of the drive: the order of `sdo` matters, and the mode must allow it",
            abort::INCOMPATIBLE_PARAMETERS | abort::INTERNAL_INCOMPATIBILITY => "the value contradicts another setting that the drive holds: `ecaxis sdo compare` shows what differs from a saved file, `ecaxis sdo defaults` loads the drive's defaults",
            abort::DEVICE_STATE => "the drive refuses it in its present state: switch it off and on",
            _ => "look the code up in the drive's manual; `ecaxis explain` shows where the value comes from",
        },
        CoeCause::Soe(code) => soe(code),
        CoeCause::Command(_) => "read S-0-0095 and S-0-0390 of the drive: they say why it does not execute the command",
        CoeCause::Timeout { .. } => "the drive does not answer its mailbox: switch it off and on",
        CoeCause::Gone | CoeCause::Wire(_) => "check the device's power and the cable to it",
        _ => "record the exchange with `--record`",
    }
    .to_owned()
}

/// Returns the hint for an SoE error code.
const fn soe(code: u16) -> &'static str {
    match code {
        0x1001 => "the drive has no such IDN: S-0-0017 lists those that it has",
        0x7002 | 0x7003 => {
            "the value has another length in the drive: its attribute shows it (`ecaxis soe read`)"
        }
        0x7005 | 0x7012 => {
            "the state does not allow it: end what drives the device, or enable the drive first"
        }
        0x7006 | 0x7007 => {
            "the value is outside of minimum and maximum: `ecaxis soe read` shows them"
        }
        0x700a => {
            "process data carries this value: write it with the program, or remove it from S-0-0024"
        }
        0x8001..=0x8009 | 0x2001..=0x6005 => {
            "the drive does not have or protects this element; its value may be accessible"
        }
        0x800a => "count the drives of a device from 0: `--drive 0` is the first one",
        _ => "look the IDN up in the drive's manual",
    }
}

fn state(error: &StateError) -> String {
    match error {
        StateError::Refused {
            wanted: AlState::Op,
            code: SYNC_MANAGER_WATCHDOG,
            ..
        } => NO_OUTPUTS.to_owned(),
        StateError::Refused { code, .. } => al_status(*code).to_owned(),
        StateError::Timeout { code, .. } if *code != 0 => al_status(*code).to_owned(),
        StateError::Timeout { .. } => {
            "switch the device off and on, then check its own display or error history".to_owned()
        }
        StateError::Gone { .. } => "check the device's power and the cable to it".to_owned(),
        StateError::Wire { .. } => "check the cables".to_owned(),
    }
}

/// The advice for a device that refuses Op because its watchdog has seen no outputs.
const NO_OUTPUTS: &str = "no outputs have reached the device in SafeOp, or too rarely for its watchdog: `ecaxis explain` shows its outputs; give it a longer `watchdog` than `cycle`, and look for lost frames in front of it";

/// Returns the advice for an AL status code (ETG.1020).
pub(crate) fn al_status(code: u16) -> &'static str {
    al_status_hint(code).unwrap_or("look the code up in the device's manual")
}

/// The advice for a drive that does not change its mode in Operation enabled.
const MODE_CHANGE: &str = "a slow drive needs a longer `mode_time`; one that changes its mode only without power needs `mode_change = \"no-power\"`";

fn not_enabled(state: State, code: Option<u16>, waiting: Option<EnableBlocker>) -> String {
    match waiting {
        Some(EnableBlocker::Mode { .. }) => {
            return "check that 0x6060 is mapped or written and that 0x6502 has the mode; for a drive that shows it in 0x6061 only in Operation enabled set `mode_display = \"enabled\"`".to_owned();
        }
        Some(EnableBlocker::Follows { .. }) => {
            return "look for a limit switch, a closed brake or an internal limit; for a drive that does not serve bit 12 in this mode set `follows_bit = false`".to_owned();
        }
        Some(EnableBlocker::Position) => {
            return "map 0x6064 with `pdo.tx`; check the drive's encoder".to_owned();
        }
        _ => {}
    }
    match (state, code) {
        (State::Fault | State::FaultReactionActive, Some(code)) if code != 0 => describe(code).hint.to_owned(),
        (State::Fault | State::FaultReactionActive, _) => "read the drive's error history (0x1003)".to_owned(),
        _ => "check the supply of the power stage, STO and enable inputs, and that no other tool controls the drive".to_owned(),
    }
}

/// The CiA 402 error code of a following error.
const FOLLOWING_ERROR: u16 = 0x8611;

/// Returns the hint for a following error of an axis whose drive has lower limits than the file.
fn allows_less(limits: &[LimitConflict]) -> String {
    let each: Vec<_> = limits.iter().map(ToString::to_string).collect();
    format!(
        "the drive allows less than the machine file: {}",
        each.join("; ")
    )
}

fn trip(trip: &Trip) -> &'static str {
    match trip {
        Trip::FollowingError { .. } => {
            "is the axis free to move and tuned? lower `speed` and `ramp`, or raise `limits.following_error` and the drive's 0x6065; an error that grows with the velocity needs `dead_time`"
        }
        Trip::PositionLimit { .. } => {
            "move the axis back by hand, or check `limits.position` and `offset`"
        }
        Trip::OverVelocity { .. } => "check `encoder`, `per_turn` and the drive's tuning",
        Trip::PowerLost { .. } => "check STO, enable inputs and the supply of the power stage",
        Trip::OverTorque { .. } => "check for a blocked load, or supervise a higher torque",
        Trip::OverAcceleration { .. } => "check the load and the drive's tuning",
        Trip::EmergencyStop => "find out why it was pressed, then reset and enable the axis again",
        Trip::SetPointNotTaken => "the drive must be in profile position mode with 0x607A mapped",
        Trip::NotFollowing { .. } => {
            "look for a limit switch, a closed brake or an internal limit; for a drive that does not serve bit 12 in this mode set `follows_bit = false`"
        }
        Trip::HaltIgnored { .. } => {
            "check the drive's halt option code (0x605D) and its deceleration (0x6084, 0x609A); run the axis in CSP if the drive has no halt"
        }
        Trip::UnlistedStatusword { .. } => {
            "compare the Statusword with the drive's manual; check the supply of the drive and whether 0x6041 is mapped where the ESI says"
        }
        Trip::PositionJump { .. } => {
            "home the axis again; the drive shifts 0x6064 on its own: check its encoder, its homing and its position range (0x607B)"
        }
        Trip::VelocityContradiction { .. } => {
            "check the drive's velocity unit (0x60A9, `velocity_unit`), `encoder` and `per_turn`"
        }
        Trip::NotStopped { .. } => {
            "check the drive's quick stop (0x605A, 0x6085), its torque limit and the load; `stop_timeout` sets how long a stop may take"
        }
        Trip::EncoderDifference { .. } => {
            "look for a slipping coupling, a wrong `counts_per_unit` or backlash; home the axis again"
        }
        Trip::HalfMoves { .. } => {
            "a load that falls needs a brake; check why the other half has no power: its STO and enable inputs, its supply"
        }
        Trip::Skew { .. } | Trip::HomingSkew { .. } => {
            "look for what holds one half of the gantry; decouple the halves to move them alone"
        }
        Trip::ModeNotShown { .. } => {
            "check that 0x6060 is mapped and that 0x6502 has the mode; a slower drive needs a longer `mode_time`"
        }
        Trip::ModeLost { .. } => "another tool changes the drive's mode: disconnect it",
    }
}

/// Maps an error of the simulated bus on an interface to a failure.
pub(crate) fn serve(error: &ServeError) -> Failure {
    let failure = Failure::new(FAILED, error.to_string());
    match error {
        ServeError::NoSuchInterface(_) | ServeError::NotEthernet(_) => Failure {
            code: WRONG,
            ..failure
        }
        .hint(interfaces()),
        ServeError::NotPermitted(_) => failure.hint(capabilities()),
        ServeError::Gone(_) | ServeError::Io { .. } => failure,
    }
}

/// Maps an error of a machine file to a failure.
pub(crate) fn config(path: &Path, error: &ConfigError) -> Failure {
    let failure = Failure::new(WRONG, error.to_string());
    match error {
        ConfigError::Io { source, .. } if source.kind() == ErrorKind::NotFound => {
            failure.hint(machine_files(path))
        }
        ConfigError::Io { source, .. } if source.kind() == ErrorKind::IsADirectory => {
            failure.hint("name the machine file in it")
        }
        ConfigError::Io { .. } => failure.hint("check the file's permissions"),
        ConfigError::NotText { .. } => failure.hint("a machine file is TOML, in UTF-8"),
        ConfigError::Policy(_) => failure.hint(POLICY),
        ConfigError::Signature(error) => failure.hint(error.hint()),
        ConfigError::Problems(problems) if problems.len() > 1 => {
            let message = format!(
                "{error}\n\n{} problems in {}",
                problems.len(),
                path.display()
            );
            Failure::new(WRONG, message)
        }
        ConfigError::Problems(_) => failure,
    }
}

/// The advice for a policy that cannot be used.
pub(crate) const POLICY: &str = "correct the file that ECAXIS_POLICY or /etc/ecaxis/policy.toml names; docs/signatures.md describes it";

/// Suggests machine files in the neighbourhood of a missing one.
fn machine_files(path: &Path) -> String {
    let nearby = [
        path.parent().unwrap_or(Path::new("")),
        Path::new("."),
        Path::new("configs"),
    ];
    for folder in nearby {
        let folder = if folder.as_os_str().is_empty() {
            Path::new(".")
        } else {
            folder
        };
        let Ok(entries) = std::fs::read_dir(folder) else {
            continue;
        };
        let mut names: Vec<String> = entries
            .flatten()
            .map(|e| e.path())
            .filter(|p| p.extension().is_some_and(|e| e == "toml"))
            .filter(|p| {
                ecaxis_master::file::read_text(p, 1 << 20).is_ok_and(|text| text.contains("[bus]"))
            })
            .map(|p| p.strip_prefix("./").unwrap_or(&p).display().to_string())
            .collect();
        names.sort();
        names.truncate(3);
        if !names.is_empty() {
            return format!("machine files nearby: {}", names.join(", "));
        }
    }
    "`ecaxis init DIR` writes a machine file to start from".to_owned()
}

#[cfg(test)]
mod tests;
