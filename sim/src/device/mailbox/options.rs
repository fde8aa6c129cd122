//! What an ESI does not say about a device's mailbox.

use crate::foe::FoeOptions;

#[derive(Debug, Clone)]
pub struct MailboxOptions {
    /// From fetching a request to its answer.
    pub processing_ns: u64,
    /// SDO Information whatever the ESI says.
    pub sdo_info: Option<bool>,
    /// Complete access whatever the ESI says.
    pub complete_access: Option<bool>,
    /// Without it, objects longer than a mailbox are refused (abort 0x06010005). Most ESI files of devices that have it do
    /// not say so.
    pub segmented: bool,
    /// Longest object, in bytes, that segments may carry (abort 0x05040005).
    pub sdo_buffer: usize,
    /// Pause of the client in a segmented transfer after which the device aborts it (0x05040000); `None`: it waits for ever.
    pub sdo_timeout_ns: Option<u64>,
    /// Refuses downloads to objects that process data write (abort 0x06010006).
    pub refuse_mapped: bool,
    /// File access whatever the ESI says.
    pub has_foe: Option<bool>,
    pub foe: FoeOptions,
}

impl Default for MailboxOptions {
    fn default() -> Self {
        Self {
            processing_ns: 100_000,
            sdo_info: None,
            complete_access: None,
            segmented: true,
            sdo_buffer: 64 << 10,
            sdo_timeout_ns: None,
            refuse_mapped: false,
            has_foe: None,
            foe: FoeOptions::default(),
        }
    }
}
