//! What clients of the gateway may not do: write without the key `write`, and write objects of the
//! cycle.

use ecaxis_ecat::index::{DeviceIndex, IndexVec};
use ecaxis_ecat::mailbox::coe::{Answer, Request};
use ecaxis_ecat::mailbox::{
    ERROR_SERVICE, ERROR_SIZE, Encode as _, HEADER, TYPE_COE, TYPE_ERROR, TYPE_FOE, TYPE_SOE,
    abort_code, error_body, foe,
};

use crate::config::{Machine, cycle_objects};
use crate::mailbox::{MailboxLayout, RawMessage};

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
    cycle: IndexVec<DeviceIndex, CycleObjects>,
}

/// The objects of a device that belong to the cycle.
#[derive(Debug)]
struct CycleObjects {
    /// Mapped to RxPDOs.
    outputs: Vec<u16>,
    is_drive: bool,
}

impl CycleObjects {
    fn contains(&self, index: u16) -> bool {
        self.outputs.contains(&index) || cycle_objects::contains(index, self.is_drive)
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
    pub(super) fn new(machine: &Machine, write: bool) -> Self {
        let cycle = machine.devices.enumerate().map(|(index, device)| {
            let layout = &device.selection.layout;
            CycleObjects {
                outputs: layout.rx.iter().map(|field| field.index).collect(),
                is_drive: machine.axes_of(index).next().is_some(),
            }
        });
        let cycle = cycle.collect();
        Self { write, cycle }
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
        match message.protocol {
            TYPE_COE => self.sdo_refusal(Some(device), message, in_transfer),
            TYPE_FOE => self.file_refusal(message),
            TYPE_SOE if soe_opcode(message) == Some(SOE_READ) => None,
            _ if self.write => None,
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
        let code = match request {
            Request::Upload { .. } | Request::Abort { .. } => None,
            Request::Information { opcode, .. } => {
                let known = INFORMATION.contains(&opcode);
                return (!known).then(|| mailbox_error(ERROR_SERVICE));
            }
            Request::UploadSegment { .. } => (!in_transfer).then_some(abort_code::INVALID_COMMAND),
            _ if !self.write => Some(abort_code::LOCAL_CONTROL),
            Request::DownloadSegment { .. } => {
                (!in_transfer).then_some(abort_code::INVALID_COMMAND)
            }
            Request::Download { index, .. } | Request::DownloadExpedited { index, .. } => {
                let cycle = device.and_then(|device| self.cycle.get(device));
                let protected = cycle.is_some_and(|cycle| cycle.contains(index));
                protected.then_some(abort_code::DEVICE_STATE)
            }
        };
        code.map(|code| sdo_abort(Some(&request), code))
    }

    fn file_refusal(&self, message: &RawMessage) -> Option<RawMessage> {
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
        (writes && !self.write).then(|| {
            let denied = foe::Message::Error {
                code: FOE_ACCESS_DENIED,
                text: b"the mailbox gateway is read-only",
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
}

fn soe_opcode(message: &RawMessage) -> Option<u8> {
    message.body.first().map(|first| first & SOE_OPCODE)
}
