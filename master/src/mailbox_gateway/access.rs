//! What clients of the gateway may not do: write without the key `write`, write objects of the
//! cycle, and write to a drive with power what could move or reset an axis.

use ecaxis_ecat::index::{AxisIndex, DeviceIndex, IndexVec};
use ecaxis_ecat::mailbox::coe::{Answer, Request};
use ecaxis_ecat::mailbox::{
    ERROR_SERVICE, ERROR_SIZE, Encode as _, HEADER, TYPE_COE, TYPE_ERROR, TYPE_FOE, TYPE_SOE,
    abort_code, error_body, foe,
};

use tokio::sync::watch;

use super::live::Live;
use crate::config::{Machine, cycle_objects};
use crate::mailbox::{MailboxLayout, NamedObject, RawMessage};
use crate::parameters::class::classify;

/// FoE: access denied (ETG.1000.6 Table 93).
const FOE_ACCESS_DENIED: u32 = 0x8002;
/// SDO Information: the requests of a client.
const INFORMATION: [u8; 3] = [1, 3, 5];
/// SoE: a read request.
const SOE_READ: u8 = 1;
/// SoE: the bits of the opcode.
const SOE_OPCODE: u8 = 0x07;

/// The rights of all clients.
#[derive(Debug)]
pub(super) struct Access {
    write: bool,
    devices: IndexVec<DeviceIndex, DeviceRules>,
    live: watch::Receiver<Live>,
}

/// What decides about writes to a device.
#[derive(Debug)]
struct DeviceRules {
    vendor: u32,
    /// The objects that are mapped to RxPDOs.
    outputs: Vec<u16>,
    axes: Vec<AxisIndex>,
}

impl DeviceRules {
    fn is_of_cycle(&self, index: u16) -> bool {
        self.outputs.contains(&index) || cycle_objects::contains(index, !self.axes.is_empty())
    }

    /// Returns true if the object may be written while an axis of the device has power. Complete
    /// access writes all subindices.
    fn is_written_with_power(&self, index: u16, sub: u8, complete: bool) -> bool {
        let last = if complete { u8::MAX } else { sub };
        (sub..=last).all(|sub| {
            // A word in a name gives no class that may be written with power.
            let (class, _) = classify(self.vendor, NamedObject { index, sub }, "");
            class.is_written_with_power()
        })
    }
}

/// Returns an SDO abort that answers a request, with the object of the request.
pub(super) fn sdo_abort(request: Option<&Request<'_>>, code: u32) -> RawMessage {
    let (index, sub) = match request {
        Some(
            Request::Upload { index, sub, .. }
            | Request::Download { index, sub, .. }
            | Request::DownloadExpedited { index, sub, .. }
            | Request::Abort { index, sub, .. },
        ) => (*index, *sub),
        _ => (0, 0),
    };
    RawMessage {
        channel: 0,
        protocol: TYPE_COE,
        body: Answer::Abort { index, sub, code }.body(),
    }
}

/// Returns a mailbox error reply.
pub(super) fn mailbox_error(code: u16) -> RawMessage {
    RawMessage {
        channel: 0,
        protocol: TYPE_ERROR,
        body: error_body(code),
    }
}

impl Access {
    pub(super) fn new(machine: &Machine, write: bool, live: watch::Receiver<Live>) -> Self {
        let devices = machine.devices.enumerate().map(|(index, device)| {
            let selection = &device.selection;
            DeviceRules {
                vendor: selection.identity.vendor,
                outputs: selection.layout.rx.iter().map(|f| f.index).collect(),
                axes: machine.axes_of(index).map(|(axis, _)| axis).collect(),
            }
        });
        Self {
            write,
            devices: devices.collect(),
            live,
        }
    }

    /// Returns true if an axis of the device has power, or if that is not known.
    fn has_power(&self, device: &DeviceRules) -> bool {
        let live = self.live.borrow();
        let mut axes = device.axes.iter();
        axes.any(|axis| live.power.get(*axis) != Some(&false))
    }

    /// Returns the answer to a message that the device must not receive. `in_transfer`: the device
    /// is reserved for a transfer of this client.
    pub(super) fn refusal(
        &self,
        device: DeviceIndex,
        layout: &MailboxLayout,
        message: &RawMessage,
        in_transfer: bool,
    ) -> Option<RawMessage> {
        if !message.fits(layout) {
            return Some(mailbox_error(ERROR_SIZE));
        }
        let has_power = || {
            let device = self.devices.get(device);
            device.is_some_and(|device| self.has_power(device))
        };
        match message.protocol {
            TYPE_COE => self.sdo_refusal(Some(device), message, in_transfer),
            TYPE_FOE => {
                let reason = match (self.write, has_power()) {
                    (false, _) => Some("the mailbox gateway is read-only"),
                    (true, true) => Some("an axis of the device has power"),
                    (true, false) => None,
                };
                file_refusal(message, reason)
            }
            TYPE_SOE if soe_opcode(message) == Some(SOE_READ) => None,
            _ if self.write && !has_power() => None,
            _ => Some(mailbox_error(ERROR_SERVICE)),
        }
    }

    /// As [`Access::refusal`]. `None` as the device is the MainDevice.
    pub(super) fn sdo_refusal(
        &self,
        device: Option<DeviceIndex>,
        message: &RawMessage,
        in_transfer: bool,
    ) -> Option<RawMessage> {
        let mailbox = message.mailbox();
        let request = match Request::parse(&mailbox) {
            Ok(Some(request)) => request,
            // Emergencies and PDOs are no requests.
            Ok(None) => return Some(mailbox_error(ERROR_SERVICE)),
            Err(_) => return Some(sdo_abort(None, abort_code::INVALID_COMMAND)),
        };
        let device = device.and_then(|device| self.devices.get(device));
        let code = match request {
            Request::Upload { .. } | Request::Abort { .. } => None,
            Request::Information { opcode, .. } => {
                let known = INFORMATION.contains(&opcode);
                return (!known).then(|| mailbox_error(ERROR_SERVICE));
            }
            Request::UploadSegment { .. } => (!in_transfer).then_some(abort_code::INVALID_COMMAND),
            _ if !self.write => Some(abort_code::LOCAL_CONTROL),
            Request::DownloadSegment { .. } if !in_transfer => Some(abort_code::INVALID_COMMAND),
            // The request that began the transfer had the object.
            Request::DownloadSegment { .. } => {
                let with_power = device.is_some_and(|device| self.has_power(device));
                with_power.then_some(abort_code::DEVICE_STATE)
            }
            Request::Download {
                index,
                sub,
                complete,
                ..
            } => self.download_refusal(device, index, sub, complete),
            Request::DownloadExpedited { index, sub, .. } => {
                self.download_refusal(device, index, sub, false)
            }
        };
        code.map(|code| sdo_abort(Some(&request), code))
    }

    /// Returns the abort code for a download that the device must not receive.
    fn download_refusal(
        &self,
        device: Option<&DeviceRules>,
        index: u16,
        sub: u8,
        complete: bool,
    ) -> Option<u32> {
        let device = device?;
        let refused = device.is_of_cycle(index)
            || (!device.is_written_with_power(index, sub, complete) && self.has_power(device));
        refused.then_some(abort_code::DEVICE_STATE)
    }
}

/// Returns the answer to a damaged message of FoE, and to one that writes if it may not.
fn file_refusal(message: &RawMessage, reason: Option<&str>) -> Option<RawMessage> {
    let writes = match foe::Message::parse(&message.mailbox()) {
        Ok(
            foe::Message::Read { .. }
            | foe::Message::Ack { .. }
            | foe::Message::Error { .. }
            | foe::Message::Busy { .. },
        ) => false,
        Ok(_) => true,
        Err(_) => return Some(mailbox_error(ERROR_SERVICE)),
    };
    reason.filter(|_| writes).map(|reason| {
        let denied = foe::Message::Error {
            code: FOE_ACCESS_DENIED,
            text: reason.as_bytes(),
        };
        let mut mailbox = Vec::new();
        denied.emit(0, 64, &mut mailbox);
        let length = mailbox.first().copied().map_or(0, usize::from);
        let body = mailbox.get(HEADER..HEADER + length).unwrap_or_default();
        RawMessage {
            channel: 0,
            protocol: TYPE_FOE,
            body: body.to_vec(),
        }
    })
}

fn soe_opcode(message: &RawMessage) -> Option<u8> {
    message.body.first().map(|first| first & SOE_OPCODE)
}
