//! Fault injection. A TOML script defines each fault with its location, start and duration. The
//! same seed reproduces a run.
//!
//! ```toml
//! seed = 7
//!
//! [[fault]]
//! at = "1.5s"           # omitted: from the start
//! for = "200ms"         # omitted: permanent
//! device = 0
//! kind = "refuse-state"
//! state = "safeop"
//! code = 0x001e
//! ```
//!
//! The kinds with their keys and effects:
//!
//! * `frame-loss` (`count` or `probability`): frames are lost, half of them before they reach any
//!   device
//! * `frame-corrupt` (`count` or `probability`; `device`, `port`): a bit flips in front of the port
//!   (default 0), or anywhere; error counters
//! * `frame-delay` (`count` or `probability`; `delay`): frames return late, other frames overtake
//!   them
//! * `frame-duplicate` (`count` or `probability`): frames return twice
//! * `link-break` (`device`, `port`): the cable at the port (default 0) is broken
//! * `silent`: the cable of the MainDevice is broken
//! * `power-off`, `absent` (`device`): no power; Init after the fault
//! * `swap` (`device`; `vendor`, `product`, `revision`, `serial`, `alias`): another device replaces
//!   it, in Init, without alias
//! * `identity` (`device`; `vendor`, `product`, `revision`): EEPROM and 0x1018 contain another
//!   identity
//! * `refuse-state` (`device`, `state`, `code`): the device refuses the state with this AL status
//!   code
//! * `sdo-abort` (`device`, `index`, `sub`, `code`): the device aborts the SDO
//! * `sdo-ignored` (`device`, `index`, `sub`): the device confirms the SDO, the object keeps its
//!   value
//! * `mailbox-silent` (`device`): requests stay in the mailbox without an answer
//! * `eoe-flood` (`device`): the device sends Ethernet broadcasts (EoE) without end
//! * `eoe-fragments` (`device`): fragments of its Ethernet frames are lost, repeated or contradictory
//! * `watchdog` (`device`): the process data watchdog expires once, despite outputs
//! * `sync-late` (`device`, `delay`): SYNC0 starts this much after its start time
//! * `clock-ignored` (`device`): the device does not take the distributed system time (0x0910), and
//!   does not count it
//! * `other-main-device` (`count` or `probability`; `state`): a frame of another MainDevice follows
//!   ours: it reads AL status, or requests the state from all devices
//! * `drive-fault` (`device`, `code`): the drive detects this error
//! * `stuck` (`device`, `state`): the drive does not leave this CiA 402 state
//! * `load` (`device`, `torque`): a torque (N·m) pulls the shaft towards negative positions
//! * `blocked` (`device`): the shaft does not turn
//! * `statusword` (`device`, `value`; `mask`, `count`): the Statusword in the process data has this
//!   value in the bits of the mask (default all), `count` times or while the fault lasts
//! * `zero-inputs` (`device`; `count`): all inputs of the drive are zero
//! * `position-shift` (`device`, `value`): all positions of the drive shift once by these counts
//! * `sto` (`device`): safe torque off; the drive is in Switch on disabled
//! * `enable-input` (`device`): the enable input is off; the drive reaches Ready to switch on
//! * `node-silent` (`device`, `node`): a node behind a gateway has no power
//! * `heartbeat-lost` (`device`, `node`): a node sends no heartbeat
//! * `node-error` (`device`, `node`): the status word names the node as the node in error
//! * `can-open` (`device`): the CAN cable at the gateway is unplugged
//! * `gateway-reset` (`device`): the CANopen side of the gateway restarts
//! * `control-ignored` (`device`): the gateway executes and acknowledges no command
//! * `emergency` (`device`, `code`): the device sends an emergency message and has no error
//!
//! ```
//! use ecaxis_sim::{FaultScript, Medium, Topology};
//!
//! let script = FaultScript::parse(
//!     "[[fault]]
//!     at = '10ms'
//!     device = 3
//!     kind = 'power-off'",
//! )?;
//! let ports = [Medium::Mii, Medium::Mii, Medium::None, Medium::None];
//! let one = Topology::by_order(&[ports]).unwrap();
//! let error = script.check(&one).unwrap_err();
//! assert_eq!(error.to_string(), "line 4: there is no device 3; the bus has 1, counted from 0");
//! # Ok::<(), ecaxis_sim::ScriptError>(())
//! ```

mod frames;
mod keys;
mod script;
#[cfg(test)]
mod tests;

use crate::Nanos;
use crate::device::{Identification, InputFault, SimDevice};
use crate::eoe::EoeFaults;
use crate::gateway::GatewayFault;
use crate::random::Random;
pub(crate) use frames::BitFlip;
pub(crate) use script::{Fault, FaultKind, FrameSelection};
pub use script::{FaultScript, ScriptError};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Phase {
    Pending,
    Active,
    Over,
}

#[derive(Debug)]
struct ActiveFault {
    fault: Fault,
    phase: Phase,
    /// The number of frames still to affect.
    left: u32,
    /// The number of frames affected so far.
    struck: u64,
    /// The previous identity of the device.
    saved: Identification,
}

/// The progress of a fault of the script.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub struct FaultProgress {
    /// The line in the script.
    pub line: u32,
    /// The kind as written in the script.
    pub name: &'static str,
    /// True once the fault has started.
    pub began: bool,
    /// True once the fault is over.
    pub ended: bool,
    /// The number of affected frames; `None` for faults that do not affect single frames.
    pub frames: Option<u64>,
}

/// A running script.
#[derive(Debug)]
pub(crate) struct Faults {
    running: Vec<ActiveFault>,
    random: Random,
    /// True if an active fault may affect frames.
    concerns_frames: bool,
    /// Devices replaced since the last [`Self::take_replaced`].
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
        let running = script.faults.into_iter().map(|fault| ActiveFault {
            left: match fault.kind.hits() {
                Some(FrameSelection::Next(count)) => count,
                _ => 0,
            },
            fault,
            phase: Phase::Pending,
            struck: 0,
            saved: Identification::default(),
        });
        // Faults of the previous script that are still active end now.
        for old in &mut self.running {
            if old.phase == Phase::Active {
                old.fault.duration = Some(0);
            }
        }
        self.running.retain(|old| old.phase == Phase::Active);
        self.running.extend(running);
    }

    /// Returns the time of the next pending start or end of a fault.
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
            device.refuse_idns(&[]);
            let mut idns = Vec::new();
            device.ignored_writes.clear();
            let mut held = None;
            let (mut silent, mut late, mut ignored) = (false, 0, false);
            let mut ethernet = EoeFaults::default();
            for fault in self.active().filter(|fault| fault.device == n) {
                match fault.kind {
                    FaultKind::RefuseState { state, code } => device.refusals.push((state, code)),
                    FaultKind::SdoAbort { index, sub, code } => {
                        device.forced_aborts.push((index, sub, code));
                        idns.push((sub, index, u16::try_from(code).unwrap_or(0x800b)));
                    }
                    FaultKind::SdoIgnored { index, sub } => {
                        device.ignored_writes.push((index, sub));
                    }
                    FaultKind::MailboxSilent => silent = true,
                    FaultKind::EoeFlood => ethernet.flood = true,
                    FaultKind::EoeFragments => ethernet.fragments = true,
                    FaultKind::SyncLate { delay } => late = delay,
                    FaultKind::ClockIgnored => ignored = true,
                    FaultKind::Stuck { state } => held = Some(state),
                    _ => {}
                }
            }
            device.refuse_idns(&idns);
            device.hold_drive_in(held);
            device.silence_mailbox(silent);
            device.disturb_ethernet(ethernet);
            device.disturb_clock(late, ignored);
        }
        let concerns_frames = self.active().any(|fault| fault.kind.hits().is_some());
        self.concerns_frames = concerns_frames;
    }

    pub(crate) fn reports(&self) -> impl Iterator<Item = FaultProgress> + '_ {
        self.running.iter().map(|running| FaultProgress {
            line: running.fault.line,
            name: running.fault.name,
            began: running.phase != Phase::Pending,
            ended: running.phase == Phase::Over,
            frames: running.fault.kind.hits().map(|_| running.struck),
        })
    }

    /// Returns the devices replaced since the last call.
    pub(crate) fn take_replaced(&mut self) -> Vec<usize> {
        std::mem::take(&mut self.replaced)
    }

    fn active(&self) -> impl Iterator<Item = &Fault> {
        self.running
            .iter()
            .filter(|r| r.phase == Phase::Active)
            .map(|r| &r.fault)
    }

    /// True if the device has no power.
    pub(crate) fn is_off(&self, device: usize) -> bool {
        self.active()
            .any(|fault| fault.device == device && fault.kind == FaultKind::PowerOff)
    }

    /// True if the cable at the port is broken.
    pub(crate) fn is_cut(&self, device: usize, port: u8) -> bool {
        self.active()
            .any(|fault| fault.device == device && fault.kind == FaultKind::LinkBreak { port })
    }

    /// Returns the times at which cables will lose their link, before `end`: at the port of a device;
    /// without a port at all of them; without a device at the MainDevice.
    pub(crate) fn cuts_before(&self, end: Nanos) -> impl Iterator<Item = Cut> + '_ {
        let pending = self.running.iter().filter(|r| r.phase == Phase::Pending);
        let pending = pending.map(|r| &r.fault).filter(move |f| f.at < end);
        pending.filter_map(|fault| {
            let (device, port) = match fault.kind {
                FaultKind::LinkBreak { port } => (Some(fault.device), Some(port)),
                FaultKind::PowerOff => (Some(fault.device), None),
                FaultKind::Silent => (None, None),
                _ => return None,
            };
            Some(Cut {
                at: fault.at,
                device,
                port,
            })
        })
    }

    /// True if the cable at the MainDevice is unplugged.
    pub(crate) fn is_silent(&self) -> bool {
        self.active().any(|fault| fault.kind == FaultKind::Silent)
    }
}

/// The loss of a link.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Cut {
    pub at: Nanos,
    pub device: Option<usize>,
    pub port: Option<u8>,
}

impl ActiveFault {
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
            FaultKind::Inputs(fault) => device.disturb_inputs(fault),
            FaultKind::PositionShift { counts } => {
                if let Some(drive) = device.drive_mut() {
                    drive.shift_positions(counts);
                }
            }
            FaultKind::Sto => sto(device, true),
            FaultKind::EnableInput => enable_input(device, false),
            FaultKind::Emergency { code } => device.inject_emergency(code),
            FaultKind::Gateway(fault) => disturb(device, fault, true),
            FaultKind::Input { index, sub, value } => {
                device.set_input(index, sub, value);
            }
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
            FaultKind::Inputs(_) => device.disturb_inputs(InputFault::default()),
            FaultKind::Sto => sto(device, false),
            FaultKind::EnableInput => enable_input(device, true),
            FaultKind::Gateway(fault) => disturb(device, fault, false),
            FaultKind::Input { index, sub, .. } => {
                device.set_input(index, sub, 0);
            }
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

fn sto(device: &mut SimDevice, on: bool) {
    for drive in device.axes_mut() {
        drive.set_sto(on);
    }
}

fn enable_input(device: &mut SimDevice, on: bool) {
    for drive in device.axes_mut() {
        drive.set_enable_input(on);
    }
}

fn disturb(device: &mut SimDevice, fault: GatewayFault, begins: bool) {
    if let Some(gateway) = device.gateway_mut() {
        gateway.disturb(fault, begins);
    }
}
