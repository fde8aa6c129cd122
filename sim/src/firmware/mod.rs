//! Firmware of simulated devices: the program memory, and the boot loader that is left when there is no program in it.
//!
//! * `image`: firmware files
//! * `flash`: what is in the program memory, and how a new program gets there
//! * `boot`: the processor: program or boot loader, and the objects that make it change between them
//!
//! Two ways lead to a new program, as with drives on the market. Over FoE in Bootstrap; it starts when Bootstrap is left for Init, which
//! resets the device. And by the objects of CiA 302-3: 0x1F51 stops the program, which leaves the boot loader in PreOp, clears it and starts the new one; 0x1F50 takes it.
//! Stopping and starting restart the processor, so that neither of them is answered.
//! What is in the program memory outlives the power, and so does what is not: a device that lost its power while it was written has
//! only its boot loader. That one goes to Init, PreOp and Bootstrap, and knows few objects.

mod boot;
mod flash;
mod image;

pub(crate) use boot::{Next, PROGRAM_IDENTIFICATION, Processor, boot_objects};
pub(crate) use flash::Flash;
pub use image::{FirmwareHeader, HEADER};

use crate::Nanos;

/// How a device's program memory behaves.
#[derive(Debug, Clone)]
pub struct FirmwareOptions {
    /// Bytes of the longest firmware file.
    pub capacity: usize,
    /// What erasing takes; over FoE the device says BUSY meanwhile.
    pub erase_ns: Nanos,
    /// Bytes that are programmed at a time, and what that takes.
    pub page: usize,
    pub page_ns: Nanos,
    /// From a reset until the processor looks after its controller again.
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
