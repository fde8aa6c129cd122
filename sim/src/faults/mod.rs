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

mod script;

use crate::Nanos;
use crate::device::SimDevice;
use crate::random::Random;
pub use script::{Fault, FaultKind, FaultScript, ScriptError};

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
    /// Frames still to lose.
    left: u32,
    /// EEPROM words 8–13 before an identity fault.
    saved: [u32; 3],
}

/// What happens to one frame.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Loss {
    pub(crate) on_the_way_out: bool,
    pub(crate) on_the_way_back: bool,
}

/// The script while it runs.
#[derive(Debug)]
pub(crate) struct Faults {
    running: Vec<Running>,
    random: Random,
}

impl Faults {
    pub(crate) fn new(seed: u64) -> Self {
        Self {
            running: Vec::new(),
            random: Random::new(seed),
        }
    }

    pub(crate) fn set(&mut self, script: FaultScript) {
        if let Some(seed) = script.seed {
            self.random = Random::new(seed);
        }
        let running = script.faults.into_iter().map(|fault| Running {
            left: match fault.kind {
                FaultKind::FrameLoss {
                    count: Some(count), ..
                } => count,
                _ => 0,
            },
            fault,
            phase: Phase::Pending,
            saved: [0; 3],
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
                    }
                }
                (Phase::Active, device) if end.is_some_and(|end| end <= now) => {
                    running.phase = Phase::Over;
                    if let Some(device) = device {
                        running.end(device);
                    }
                }
                _ => {}
            }
        }
        for (n, device) in devices.iter_mut().enumerate() {
            device.refusals.clear();
            device.forced_aborts.clear();
            let mut held = None;
            for fault in self.active().filter(|fault| fault.device == n) {
                match fault.kind {
                    FaultKind::RefuseState { state, code } => device.refusals.push((state, code)),
                    FaultKind::SdoAbort { index, sub, code } => {
                        device.forced_aborts.push((index, sub, code));
                    }
                    FaultKind::Stuck { state } => held = Some(state),
                    _ => {}
                }
            }
            device.hold_drive_in(held);
        }
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
            .any(|fault| fault.device == device && fault.kind == FaultKind::Absent)
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

    /// Decides about the frame that is sent now.
    pub(crate) fn lose(&mut self) -> Loss {
        let mut loss = Loss::default();
        for n in 0..self.running.len() {
            let Some(running) = self.running.get_mut(n).filter(|r| r.phase == Phase::Active) else {
                continue;
            };
            let lost = match running.fault.kind {
                FaultKind::FrameLoss { count: Some(_), .. } => {
                    let lost = running.left > 0;
                    running.left = running.left.saturating_sub(1);
                    lost
                }
                FaultKind::FrameLoss {
                    probability: Some(p),
                    ..
                } => self.random.chance(p),
                _ => false,
            };
            if lost {
                let out = self.random.next() & 1 == 0;
                loss.on_the_way_out |= out;
                loss.on_the_way_back |= !out;
            }
        }
        loss
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
            FaultKind::Emergency { code } => device.inject_emergency(code),
            FaultKind::NodeSilent { node } => silence(device, node, true),
            FaultKind::Identity {
                vendor,
                product,
                revision,
            } => {
                for (n, value) in [vendor, product, revision].into_iter().enumerate() {
                    let word = 8 + n as u32 * 2;
                    let rom = &device.esc.eeprom;
                    let old = u32::from(rom.word(word)) | u32::from(rom.word(word + 1)) << 16;
                    if let Some(saved) = self.saved.get_mut(n) {
                        *saved = old;
                    }
                    patch(device, n, value.unwrap_or(old));
                }
            }
            _ => {}
        }
    }

    fn end(&self, device: &mut SimDevice) {
        match self.fault.kind {
            FaultKind::Identity { .. } => {
                for (n, value) in self.saved.into_iter().enumerate() {
                    patch(device, n, value);
                }
            }
            FaultKind::NodeSilent { node } => silence(device, node, false),
            _ => {}
        }
    }
}

fn silence(device: &mut SimDevice, node: u8, silent: bool) {
    if let Some(gateway) = device.gateway_mut() {
        gateway.set_node_silent(node, silent);
    }
}

/// Vendor, product and revision are SII words 8, 10 and 12 and 0x1018:01 to 03.
fn patch(device: &mut SimDevice, n: usize, value: u32) {
    device.patch_identity(8 + n * 2, n as u8 + 1, value);
}
