//! Sercos drives outside the cycle: the reset of their errors (S-0-0099), and what they say about a
//! failure.

use std::collections::VecDeque;
use std::sync::mpsc::Sender;
use std::time::Duration;

use ecaxis_ecat::index::{AxisIndex, DeviceIndex};
use ecaxis_ecat::mailbox::soe::{Attribute, DataLength, Display, Idn, format_value};
use tokio::sync::mpsc;

use super::Supervisor;
use crate::clock;
use crate::config::Machine;
use crate::mailbox::{DeviceMailbox, IdnElement, Mailboxes};
use crate::report::{Progress, SercosDiagnosis};

/// The time for S-0-0099. The axis waits for the end of the fault by its own timers.
const RESET_TIMEOUT: Duration = Duration::from_secs(2);
/// Pending resets; a machine has fewer axes with a fault at the same time.
const RESETS: usize = 256;
/// The longest diagnostic message in characters.
const MAX_MESSAGE: usize = 120;

/// Reads what a drive says about a failure.
pub(super) async fn diagnose(
    mailbox: &DeviceMailbox,
    drive: u8,
    timeout: Duration,
) -> SercosDiagnosis {
    let read = async |idn| {
        let value = mailbox.read_idn(IdnElement::value(drive, idn));
        clock::timeout(timeout, value).await?.ok()
    };
    let number = read(Idn::DIAGNOSTIC_NUMBER).await;
    let message = read(Idn::DIAGNOSTIC_MESSAGE).await;
    let class_1 = read(Idn::CLASS_1_DIAGNOSTIC).await;
    let text = Attribute::new(DataLength::List(1), Display::Text);
    let message = message.map(|bytes| {
        let message = format_value(text, &bytes);
        message.chars().take(MAX_MESSAGE).collect::<String>()
    });
    SercosDiagnosis {
        number: number.and_then(|bytes| Some(u32::from_le_bytes(*bytes.first_chunk()?))),
        message: message.filter(|message| !message.is_empty()),
        class_1: class_1.and_then(|bytes| Some(u16::from_le_bytes(*bytes.first_chunk()?))),
    }
}

/// Returns the device and the drive of an axis on a Sercos drive.
pub(super) fn drive_of(machine: &Machine, axis: AxisIndex) -> Option<(DeviceIndex, u8)> {
    let setup = machine.axes.get(axis)?;
    let device = machine.devices.get(setup.device)?;
    let drive = u8::try_from(setup.number).ok()?;
    device.device.soe_only().map(|_| (setup.device, drive))
}

/// The resets that the cycle has requested.
#[derive(Debug)]
pub(crate) struct ResetQueue {
    requests: mpsc::Sender<AxisIndex>,
}

/// The other end of a [`ResetQueue`].
pub(super) struct ResetTask {
    requests: mpsc::Receiver<AxisIndex>,
    mailboxes: Mailboxes,
    machine: std::sync::Arc<Machine>,
    progress: Sender<Progress>,
}

impl Supervisor {
    /// Opens the queue of resets and returns the task that executes them.
    pub(super) fn open_resets(&mut self) -> ResetTask {
        let (requests, taken) = mpsc::channel(RESETS);
        self.resets = Some(ResetQueue { requests });
        ResetTask {
            requests: taken,
            mailboxes: self.mailboxes.clone(),
            machine: std::sync::Arc::clone(&self.machine),
            progress: self.progress.clone(),
        }
    }

    pub(super) fn request_reset(&self, axis: AxisIndex) {
        if let Some(queue) = &self.resets {
            // A full queue contains a request of each axis already.
            let _ = queue.requests.try_send(axis);
        }
    }
}

impl ResetTask {
    /// Executes S-0-0099 for each request. A failure is a warning: the axis reports that its fault
    /// stays.
    pub(super) async fn run(mut self) {
        let mut waiting = VecDeque::new();
        loop {
            let axis = match waiting.pop_front() {
                Some(axis) => axis,
                None => match self.requests.recv().await {
                    Some(axis) => axis,
                    None => return,
                },
            };
            self.execute(axis).await;
            // A request during the command belongs to the same reset: an axis sends several pulses.
            while let Ok(other) = self.requests.try_recv() {
                if other != axis && !waiting.contains(&other) {
                    waiting.push_back(other);
                }
            }
        }
    }

    async fn execute(&self, axis: AxisIndex) {
        let Some((device, drive)) = drive_of(&self.machine, axis) else {
            return;
        };
        let Some(mailbox) = self.mailboxes.urgent(device) else {
            return;
        };
        let reset = mailbox.execute_command((drive, Idn::RESET_CLASS_1), RESET_TIMEOUT);
        // A silent device must not delay the resets of others for longer.
        let failed = match clock::timeout(RESET_TIMEOUT, reset).await {
            Some(Ok(())) => return,
            Some(Err(error)) => error.to_string(),
            None => "the drive does not answer".to_owned(),
        };
        let name = &self.machine.axes[axis].name;
        let warning = format!("`{name}`: the reset of its Sercos drive failed: {failed}");
        let _ = self.progress.send(Progress::Warning(warning));
    }
}
