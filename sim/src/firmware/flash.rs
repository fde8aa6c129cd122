//! The program memory.

use super::FirmwareOptions;
use super::image::{FirmwareHeader, HEADER, ImageError};
use crate::Nanos;
use crate::coe::Abort;
use crate::foe::FoeError;

/// An executable program.
#[derive(Debug, Clone, Default)]
pub(crate) struct Program {
    /// The header of the program; `None`: the factory program.
    pub(super) header: Option<FirmwareHeader>,
    /// The checksum, 0x1F56.
    pub(super) checksum: u32,
    /// The file as written; empty for the factory program.
    file: Vec<u8>,
}

/// The program memory. All times are local times of the device.
#[derive(Debug, Clone)]
pub(crate) struct Flash {
    options: FirmwareOptions,
    /// The vendor and product that a file must match.
    device: (u32, u32),
    pub(super) program: Option<Program>,
    /// True if a new program starts on leaving Bootstrap.
    is_new: bool,
    /// True while the memory is erased and unwritten.
    blank: bool,
    /// True if the current file matches this device and the memory has been erased for it.
    accepted: bool,
    busy_from: Nanos,
    busy_until: Nanos,
}

impl Flash {
    pub(crate) fn new(options: FirmwareOptions, device: (u32, u32)) -> Self {
        Self {
            options,
            device,
            program: Some(Program::default()),
            is_new: false,
            blank: false,
            accepted: false,
            busy_from: 0,
            busy_until: 0,
        }
    }

    pub(crate) fn capacity(&self) -> usize {
        self.options.capacity
    }

    /// Returns the file of the program if one was written.
    pub(crate) fn file(&self) -> Option<&[u8]> {
        let file = self.program.as_ref().map(|program| &program.file[..]);
        file.filter(|file| !file.is_empty())
    }

    pub(crate) fn is_new(&self) -> bool {
        self.is_new
    }

    pub(crate) fn erase_ns(&self) -> Nanos {
        self.options.erase_ns
    }

    pub(crate) fn restart_ns(&self) -> Nanos {
        self.options.restart_ns
    }

    pub(crate) fn erase(&mut self) {
        self.program = None;
        (self.blank, self.is_new) = (true, false);
    }

    /// Cancels pending operations, because the local clock restarts.
    pub(super) fn restart(&mut self) {
        (self.busy_from, self.busy_until) = (0, 0);
        (self.accepted, self.is_new) = (false, false);
    }

    /// Starts the reception of a file.
    pub(crate) fn begin(&mut self) {
        self.accepted = false;
    }

    /// Takes the next packet of a file. `Ok(Some)`: busy, with the progress as (done, total).
    pub(crate) fn take(
        &mut self,
        so_far: &[u8],
        packet: &[u8],
        is_last: bool,
        now: Nanos,
    ) -> Result<Option<(u16, u16)>, FoeError> {
        if now < self.busy_until {
            return Ok(Some(self.progress(now)));
        }
        let len = so_far.len() + packet.len();
        if len > self.options.capacity {
            return Err(FoeError::DiskFull);
        }
        if !self.accepted && (len >= HEADER || is_last) {
            let mut head = so_far.to_vec();
            head.extend(packet.iter().take(HEADER));
            self.check(&head).map_err(refusal)?;
            self.accepted = true;
            if !self.blank {
                self.erase();
                self.busy(now, self.options.erase_ns);
                return Ok(Some(self.progress(now)));
            }
        }
        self.blank &= !self.accepted;
        let pages = |len: usize| len.checked_div(self.options.page);
        if pages(so_far.len()) != pages(len) {
            self.busy(now, self.options.page_ns);
        }
        Ok(None)
    }

    fn busy(&mut self, now: Nanos, time: Nanos) {
        (self.busy_from, self.busy_until) = (now, now.saturating_add(time));
    }

    /// Returns the progress in percent, as (done, 100).
    fn progress(&self, now: Nanos) -> (u16, u16) {
        let passed = now.saturating_sub(self.busy_from).saturating_mul(100);
        let all = self.busy_until.saturating_sub(self.busy_from);
        let done = passed.checked_div(all).unwrap_or(100).min(100);
        (u16::try_from(done).unwrap_or(100), 100)
    }

    fn check(&self, head: &[u8]) -> Result<(), ImageError> {
        let header = FirmwareHeader::parse(head)?;
        if (header.vendor, header.product) == self.device {
            Ok(())
        } else {
            Err(ImageError::OtherDevice)
        }
    }

    fn program(&mut self, file: Vec<u8>) -> Result<(), ImageError> {
        self.check(&file)?;
        self.blank = false;
        let (header, checksum) = FirmwareHeader::verify(&file)?;
        self.program = Some(Program {
            header: Some(header),
            checksum,
            file,
        });
        Ok(())
    }

    /// Completes a file that was received through FoE.
    pub(crate) fn finish(&mut self, file: Vec<u8>) -> Result<(), FoeError> {
        self.program(file).map_err(refusal)?;
        self.is_new = true;
        Ok(())
    }

    /// Writes the program through 0x1F50. The memory must be erased.
    pub(super) fn download(&mut self, file: &[u8]) -> Result<(), Abort> {
        if self.program.is_some() {
            return Err(Abort::WRONG_STATE);
        }
        self.program(file.to_vec()).map_err(|unfit| match unfit {
            ImageError::NoHeader | ImageError::OtherDevice => Abort::VALUE,
            ImageError::Checksum => Abort::NOT_STORED,
        })
    }
}

fn refusal(unfit: ImageError) -> FoeError {
    match unfit {
        ImageError::NoHeader => FoeError::NoHeader,
        ImageError::OtherDevice => FoeError::OtherHardware,
        ImageError::Checksum => FoeError::Checksum,
    }
}
