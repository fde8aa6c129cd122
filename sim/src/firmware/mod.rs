//! Firmware of simulated devices: the program memory and the boot loader.
//!
//! * `image`: firmware files
//! * `flash`: the program memory and its programming
//! * `boot`: the processor with program or boot loader, and the objects that switch between them
//!
//! Two methods write a new program, as in commercial drives:
//!
//! * FoE in Bootstrap. The program starts on the change from Bootstrap to Init, which resets the
//!   device.
//! * The objects of CiA 302-3. 0x1F51 stops the program, which leaves the boot loader in PreOp,
//!   then clears the memory and starts the new program. 0x1F50 receives the program. Stop and start
//!   restart the processor, so they have no answer.
//!
//! The program memory survives a power cycle. A power loss during programming leaves only the boot
//! loader. The boot loader supports Init, PreOp and Bootstrap, and few objects.

mod boot;
mod flash;
mod image;

pub(crate) use boot::{BootLoader, Next, PROGRAM_IDENTIFICATION, boot_objects};
pub(crate) use flash::Flash;
pub use image::FirmwareHeader;

use crate::Nanos;

/// The behaviour of the program memory of a device.
#[derive(Debug, Clone)]
pub struct FirmwareOptions {
    /// Maximum bytes of a firmware file.
    pub capacity: usize,
    /// The duration of erasing in ns. Over FoE, the device answers BUSY meanwhile.
    pub erase_ns: Nanos,
    /// The bytes per programming step; the next field is its duration.
    pub page: usize,
    /// The duration of a programming step in ns.
    pub page_ns: Nanos,
    /// The time from a reset until the processor services its controller again, in ns.
    pub restart_ns: Nanos,
}

impl Default for FirmwareOptions {
    fn default() -> Self {
        Self {
            capacity: 4 << 20,
            erase_ns: 400_000_000,
            page: 4096,
            page_ns: 3_000_000,
            restart_ns: 250_000_000,
        }
    }
}
