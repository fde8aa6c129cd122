//! Faults on demand: a TOML script says what goes wrong, when, where and for how long. The same
//! seed gives the same run.
//!
//! ```toml
//! seed = 7
//!
//! [[fault]]
//! at = "1.5s"           # omitted: from the start
//! for = "200ms"         # omitted: for good
//! device = 0
//! kind = "refuse-state"
//! state = "safeop"
//! code = 0x001e
//! ```
//!
//! | kind | keys | what happens |
//! |---|---|---|
//! | `frame-loss` | `count` or `probability` | frames vanish, half of them before any device has seen them |
//! | `frame-corrupt` | `count` or `probability`; `device`, `port` | a bit turns over in front of the device's port (0), or anywhere; error counters |
//! | `frame-delay` | `count` or `probability`; `delay` | frames come back late, and others before them |
//! | `frame-duplicate` | `count` or `probability` | frames come back twice |
//! | `link-break` | `device`, `port` | the cable at the port (0) is broken |
//! | `silent` | | the MainDevice's cable is broken |
//! | `power-off`, `absent` | `device` | no power; back in Init |
//! | `swap` | `device`; `vendor`, `product`, `revision`, `serial`, `alias` | another device in its place, in Init, without alias |
//! | `identity` | `device`; `vendor`, `product`, `revision` | EEPROM and 0x1018 say something else |
//! | `refuse-state` | `device`, `state`, `code` | the state is refused with this AL status code |
//! | `sdo-abort` | `device`, `index`, `sub`, `code` | the SDO is aborted |
//! | `sdo-ignored` | `device`, `index`, `sub` | the SDO is confirmed, the object keeps its value |
//! | `mailbox-silent` | `device` | requests stay in the mailbox and are not answered |
//! | `watchdog` | `device` | the watchdog of its process data expires once, whatever comes |
//! | `sync-late` | `device`, `delay` | SYNC0 begins so much later than its start time says |
//! | `other-main-device` | `count` or `probability`; `state` | behind frames of ours comes one of another MainDevice: it reads AL status, or sends all devices to the state |
//! | `drive-fault` | `device`, `code` | the drive detects this error |
//! | `stuck` | `device`, `state` | the drive does not leave this CiA 402 state |
//! | `load` | `device`, `torque` | a torque (N·m) pulls the shaft towards negative positions |
//! | `blocked` | `device` | the shaft does not turn |
//! | `emergency` | `device`, `code` | an emergency message, nothing else |

mod frames;
mod kinds;
mod script;
#[cfg(test)]
mod tests;

use crate::Nanos;
use crate::device::{Identification, SimDevice};
use crate::random::Random;
pub(crate) use frames::Corrupted;
pub use script::{Fault, FaultKind, FaultScript, Hits, NewIdentity, ScriptError};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Phase {
    Pending,
    Active,
    Over,
}

#[derive(Debug)]
struct Running {
    fault: Fault,
    phase: Phase,
    /// Frames still to strike.
    left: u32,
    /// Frames it has struck.
    struck: u64,
    /// What the device was known by before.
    saved: Identification,
}

/// What has become of a fault of the script.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FaultReport {
    /// Line of the script.
    pub line: u32,
    /// The kind as the script names it.
    pub name: &'static str,
    pub began: bool,
    pub ended: bool,
    /// How many frames it has struck; `None` where it does not concern single frames.
    pub frames: Option<u64>,
}

/// The script while it runs.
#[derive(Debug)]
pub(crate) struct Faults {
    running: Vec<Running>,
    random: Random,
    /// One that is active may strike frames.
    concerns_frames: bool,
    /// Devices that have been replaced since somebody asked.
    replaced: Vec<usize>,
}

impl Faults {
    pub(crate) fn new(seed: u64) -> Self {
        Self {
            running: Vec::new(),
            random: Random::new(seed),
            concerns_frames: false,
            replaced: Vec::new(),
        }
    }

    pub(crate) fn set(&mut self, script: FaultScript) {
        if let Some(seed) = script.seed {
            self.random = Random::new(seed);
        }
        let running = script.faults.into_iter().map(|fault| Running {
            left: match fault.kind.hits() {
                Some(Hits::Next(count)) => count,
                _ => 0,
            },
            fault,
            phase: Phase::Pending,
            struck: 0,
            saved: Identification::default(),
        });
        // Those that still act must be ended first; they end now.
        for old in &mut self.running {
            if old.phase == Phase::Active {
                old.fault.duration = Some(0);
            }
        }
        self.running.retain(|old| old.phase == Phase::Active);
        self.running.extend(running);
    }

    /// Time of the next start or end that is still to be applied.
    pub(crate) fn next_change(&self) -> Option<Nanos> {
        let due = self.running.iter().filter_map(|r| match r.phase {
            Phase::Pending => Some(r.fault.at),
            Phase::Active => Some(r.fault.at.saturating_add(r.fault.duration?)),
            Phase::Over => None,
        });
        due.min()
    }

    pub(crate) fn apply(&mut self, now: Nanos, devices: &mut [SimDevice]) {
        for running in &mut self.running {
            let device = devices.get_mut(running.fault.device);
            let end = running
                .fault
                .duration
                .map(|d| running.fault.at.saturating_add(d));
            match (running.phase, device) {
                (Phase::Pending, device) if running.fault.at <= now => {
                    running.phase = Phase::Active;
                    if let Some(device) = device {
                        running.start(device);
                        self.replaced.extend(running.replaces());
                    }
                }
                (Phase::Active, device) if end.is_some_and(|end| end <= now) => {
                    running.phase = Phase::Over;
                    if let Some(device) = device {
                        running.end(device);
                        self.replaced.extend(running.replaces());
                    }
                }
                _ => {}
            }
        }
        for (n, device) in devices.iter_mut().enumerate() {
            device.refusals.clear();
            device.forced_aborts.clear();
            device.ignored_writes.clear();
            let mut held = None;
            let (mut silent, mut late) = (false, 0);
            for fault in self.active().filter(|fault| fault.device == n) {
                match fault.kind {
                    FaultKind::RefuseState { state, code } => device.refusals.push((state, code)),
                    FaultKind::SdoAbort { index, sub, code } => {
                        device.forced_aborts.push((index, sub, code));
                    }
                    FaultKind::SdoIgnored { index, sub } => {
                        device.ignored_writes.push((index, sub));
                    }
                    FaultKind::MailboxSilent => silent = true,
                    FaultKind::SyncLate { delay } => late = delay,
                    FaultKind::Stuck { state } => held = Some(state),
                    _ => {}
                }
            }
            device.hold_drive_in(held);
            device.silence_mailbox(silent);
            device.delay_sync(late);
        }
        let concerns_frames = self.active().any(|fault| fault.kind.hits().is_some());
        self.concerns_frames = concerns_frames;
    }

    pub(crate) fn reports(&self) -> impl Iterator<Item = FaultReport> + '_ {
        self.running.iter().map(|running| FaultReport {
            line: running.fault.line,
            name: running.fault.name,
            began: running.phase != Phase::Pending,
            ended: running.phase == Phase::Over,
            frames: running.fault.kind.hits().map(|_| running.struck),
        })
    }

    /// Devices that have become others since the last call.
    pub(crate) fn take_replaced(&mut self) -> Vec<usize> {
        std::mem::take(&mut self.replaced)
    }

    fn active(&self) -> impl Iterator<Item = &Fault> {
        self.running
            .iter()
            .filter(|r| r.phase == Phase::Active)
            .map(|r| &r.fault)
    }

    /// The device has no power.
    pub(crate) fn is_off(&self, device: usize) -> bool {
        self.active()
            .any(|fault| fault.device == device && fault.kind == FaultKind::PowerOff)
    }

    /// The cable at the port is broken.
    pub(crate) fn is_cut(&self, device: usize, port: u8) -> bool {
        self.active()
            .any(|fault| fault.device == device && fault.kind == FaultKind::LinkBreak { port })
    }

    /// The cable at the MainDevice is unplugged.
    pub(crate) fn is_silent(&self) -> bool {
        self.active().any(|fault| fault.kind == FaultKind::Silent)
    }
}

impl Running {
    fn start(&mut self, device: &mut SimDevice) {
        match self.fault.kind {
            FaultKind::DriveFault { code } => {
                if let Some(drive) = device.drive_mut() {
                    drive.inject_fault(code);
                }
            }
            FaultKind::Watchdog => device.expire_watchdog(),
            FaultKind::Load { torque } => load(device, torque),
            FaultKind::Blocked => block(device, true),
            FaultKind::Emergency { code } => device.inject_emergency(code),
            FaultKind::NodeSilent { node } => silence(device, node, true),
            FaultKind::Identity(new) | FaultKind::Swap(new) => {
                self.saved = device.identification();
                device.identify(&Identification {
                    numbers: [new.vendor, new.product, new.revision, new.serial],
                    alias: new.alias,
                });
            }
            _ => {}
        }
    }

    fn end(&self, device: &mut SimDevice) {
        match self.fault.kind {
            FaultKind::Identity(_) | FaultKind::Swap(_) => device.identify(&self.saved),
            FaultKind::Load { .. } => load(device, 0.0),
            FaultKind::Blocked => block(device, false),
            FaultKind::NodeSilent { node } => silence(device, node, false),
            _ => {}
        }
    }

    fn replaces(&self) -> Option<usize> {
        matches!(self.fault.kind, FaultKind::Swap(_)).then_some(self.fault.device)
    }
}

fn load(device: &mut SimDevice, torque: f64) {
    if let Some(drive) = device.drive_mut() {
        drive.set_load_torque(torque);
    }
}

fn block(device: &mut SimDevice, blocked: bool) {
    if let Some(drive) = device.drive_mut() {
        drive.set_blocked(blocked);
    }
}

fn silence(device: &mut SimDevice, node: u8, silent: bool) {
    if let Some(gateway) = device.gateway_mut() {
        gateway.set_node_silent(node, silent);
    }
}
