//! The program memory.

use super::FirmwareOptions;
use super::image::{FirmwareHeader, HEADER, Unfit};
use crate::Nanos;
use crate::coe::Abort;
use crate::foe::FoeError;

/// A program that can run.
#[derive(Debug, Clone, Default)]
pub(crate) struct Program {
    /// What the device is once it runs; `None`: what it was made as.
    pub(super) header: Option<FirmwareHeader>,
    /// 0x1F56.
    pub(super) checksum: u32,
    /// As it was written; nothing of the one from the factory.
    file: Vec<u8>,
}

/// Times are the device's own.
#[derive(Debug, Clone)]
pub(crate) struct Flash {
    options: FirmwareOptions,
    /// Whom a file must be for: vendor, product.
    device: (u32, u32),
    pub(super) program: Option<Program>,
    /// A program that starts when Bootstrap is left.
    is_new: bool,
    /// Erased, and nothing has been written since.
    blank: bool,
    /// The file that is on its way is for this device, and what was here has been erased for it.
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

    /// The file of the program, where one was written.
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

    /// The local clock starts anew, and what was under way is over.
    pub(super) fn restart(&mut self) {
        (self.busy_from, self.busy_until) = (0, 0);
        (self.accepted, self.is_new) = (false, false);
    }

    /// A file begins to come.
    pub(crate) fn begin(&mut self) {
        self.accepted = false;
    }

    /// The next packet of a file. `Ok(Some)`: not now; so much of so much is done.
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

    /// Percent.
    fn progress(&self, now: Nanos) -> (u16, u16) {
        let passed = now.saturating_sub(self.busy_from).saturating_mul(100);
        let all = self.busy_until.saturating_sub(self.busy_from);
        let done = passed.checked_div(all).unwrap_or(100).min(100);
        (u16::try_from(done).unwrap_or(100), 100)
    }

    fn check(&self, head: &[u8]) -> Result<(), Unfit> {
        let header = FirmwareHeader::parse(head)?;
        if (header.vendor, header.product) == self.device {
            Ok(())
        } else {
            Err(Unfit::OtherDevice)
        }
    }

    fn program(&mut self, file: Vec<u8>) -> Result<(), Unfit> {
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

    /// All of a file is here, by FoE.
    pub(crate) fn finish(&mut self, file: Vec<u8>) -> Result<(), FoeError> {
        self.program(file).map_err(refusal)?;
        self.is_new = true;
        Ok(())
    }

    /// 0x1F50, into an erased memory.
    pub(super) fn download(&mut self, file: &[u8]) -> Result<(), Abort> {
        if self.program.is_some() {
            return Err(Abort::WRONG_STATE);
        }
        self.program(file.to_vec()).map_err(|unfit| match unfit {
            Unfit::NoHeader | Unfit::OtherDevice => Abort::VALUE,
            Unfit::Checksum => Abort::NOT_STORED,
        })
    }
}

fn refusal(unfit: Unfit) -> FoeError {
    match unfit {
        Unfit::NoHeader => FoeError::NoHeader,
        Unfit::OtherDevice => FoeError::OtherHardware,
        Unfit::Checksum => FoeError::Checksum,
    }
}
