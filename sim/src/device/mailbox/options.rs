//! Mailbox properties of a device that an ESI does not contain.

use crate::coe::MissingSubindices;
use crate::foe::FoeOptions;
use crate::quirks::Quirks;

/// Mailbox properties of a device that an ESI does not contain.
#[derive(Debug, Clone)]
pub struct MailboxOptions {
    /// The time in ns from fetching a request to its answer.
    pub processing_ns: u64,
    /// Overrides the ESI: support of SDO Information.
    pub sdo_info: Option<bool>,
    /// Overrides the ESI: support of complete access.
    pub complete_access: Option<bool>,
    /// Aborts have the index without its low byte.
    pub abort_index_word: bool,
    /// An SDO request of the device precedes each answer.
    pub sends_requests: bool,
    /// An emergency of the device precedes each answer.
    pub sends_emergencies: bool,
    /// Subindices that the dictionary counts and the device does not have.
    pub missing: MissingSubindices,
    /// Support of segmented transfers. Without it, objects longer than a mailbox are rejected
    /// (abort 0x06010005). Most ESI files do not mention existing support.
    pub segmented: bool,
    /// Maximum bytes of an object in a segmented transfer (abort 0x05040005).
    pub sdo_buffer: usize,
    /// The pause of the client after which the device aborts a segmented transfer (0x05040000).
    /// `None`: no time-out.
    pub sdo_timeout_ns: Option<u64>,
    /// Rejects downloads to objects that process data write (abort 0x06010006).
    pub refuse_mapped: bool,
    /// Overrides the ESI: support of FoE.
    pub has_foe: Option<bool>,
    /// Properties of the file access.
    pub foe: FoeOptions,
}

impl MailboxOptions {
    /// Returns the options with the quirks of a device.
    pub(crate) fn with(mut self, quirks: &Quirks) -> Self {
        if quirks.complete_access_refused {
            self.complete_access = Some(false);
        }
        if let Some(delay) = quirks.mailbox_slow {
            self.processing_ns += delay.0;
        }
        self.abort_index_word |= quirks.abort_index_word;
        self.sends_requests |= quirks.unsolicited_requests;
        self.sends_emergencies |= quirks.unsolicited_emergencies;
        self.missing.last |= quirks.last_subindex_missing;
        self.missing.assignment |= quirks.assignment_subindices_missing;
        self.foe.is_full |= quirks.foe_disk_full;
        self.foe.is_illegal |= quirks.foe_illegal;
        if let Some(time) = quirks.foe_busy {
            self.foe.busy_ns = time.0;
        }
        self
    }
}

impl Default for MailboxOptions {
    fn default() -> Self {
        Self {
            processing_ns: 100_000,
            sdo_info: None,
            complete_access: None,
            abort_index_word: false,
            sends_requests: false,
            sends_emergencies: false,
            missing: MissingSubindices::default(),
            segmented: true,
            sdo_buffer: 64 << 10,
            sdo_timeout_ns: None,
            refuse_mapped: false,
            has_foe: None,
            foe: FoeOptions::default(),
        }
    }
}
