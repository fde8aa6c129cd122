//! The EEPROM interface of one SubDevice: registers 0x0500 to 0x050F (ETG.1000.4, clause on the SII).

use std::time::Duration;

use super::{Registers, ServiceError};
use crate::bringup::{AlState, DeviceRef};
use crate::mailbox::Wire;
use crate::stop::Stop;

const ACCESS: u16 = 0x0500;
const CONTROL: u16 = 0x0502;
const DATA: u16 = 0x0508;

/// 0x0500: the EEPROM is lent to the device's own processor; it is taken from it by force.
const LENT: u8 = 0x01;
const FORCE: u8 = 0x02;
/// 0x0501: the device's processor is using it.
const IN_USE: u8 = 0x01;

const WRITE_ENABLE: u16 = 0x0001;
const EIGHT_BYTES: u16 = 0x0040;
const READ: u16 = 0x0100;
const WRITE: u16 = 0x0200;
const RELOAD: u16 = 0x0400;
const NOT_LOADED: u16 = 0x1000;
const REFUSED: u16 = 0x2000;
const NOT_ENABLED: u16 = 0x4000;
const BUSY: u16 = 0x8000;

/// Word that tells the size, in KiBit less one.
const SIZE: u32 = 0x3e;
/// Where categories start; less no image has.
const HEADER_BYTES: usize = 0x80;
/// Largest image that is read: 4 MiBit, what the interface can address and then some.
const MAX_BYTES: usize = 512 * 1024;

const POLL: Duration = Duration::from_micros(200);
/// For one word; a write takes ten milliseconds at most.
const TIMEOUT: Duration = Duration::from_secs(1);
/// A chip that is still writing does not acknowledge.
const TRIES: u32 = 5;
const RETRY: Duration = Duration::from_millis(10);

/// Why the EEPROM did not do what it was asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum EepromError {
    #[error("the device's own processor is using it")]
    InUse,
    #[error("word 0x{word:04x}: still busy after {} ms", TIMEOUT.as_millis())]
    Busy { word: u32 },
    #[error("word 0x{word:04x}: the chip does not acknowledge (status 0x{status:04x})")]
    NotAcknowledged { word: u32, status: u16 },
    #[error("word 0x{word:04x}: writing is not permitted (status 0x{status:04x})")]
    WriteProtected { word: u32, status: u16 },
    /// By what is read behind its end, which is its beginning again.
    #[error("the image is longer than the chip, which holds {bytes} bytes")]
    Smaller { bytes: usize },
    #[error("word 0x{word:04x}: 0x{wanted:04x} was written, 0x{found:04x} is there")]
    NotKept { word: u32, wanted: u16, found: u16 },
}

/// Whether an EEPROM may be taken from the device's own processor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Claim {
    /// Only where it is not lent.
    IfFree,
    Force,
}

impl Claim {
    /// In Init a device has no use for its EEPROM; some MainDevices leave it lent there.
    #[must_use]
    pub fn of(state: AlState) -> Self {
        match state {
            AlState::Init => Self::Force,
            _ => Self::IfFree,
        }
    }
}

/// Bytes that a chip holds by the image in it; as much as the controller reads by itself where it does not say.
#[must_use]
pub fn size_of(image: &[u8]) -> usize {
    let at = usize::try_from(SIZE * 2).unwrap_or(usize::MAX);
    let word = image.get(at..).and_then(<[u8]>::first_chunk);
    word.map_or(HEADER_BYTES, |word| said(*word))
}

fn said(word: [u8; 2]) -> usize {
    let kibit = usize::from(u16::from_le_bytes(word)).saturating_add(1);
    kibit.saturating_mul(128).clamp(HEADER_BYTES, MAX_BYTES)
}

/// Does a piece of work on a device's EEPROM. Where it was lent to the device it is again afterwards, however the work ends. `step`
/// says what is done.
///
/// # Errors
/// Of [`Eeprom::claim`] and of giving it back; [`ServiceError::Stopped`]; the work's own come first.
pub async fn with_eeprom<W: Wire, T, E: From<ServiceError>>(
    wire: &W,
    device: &DeviceRef,
    step: &'static str,
    claim: Claim,
    work: impl AsyncFnOnce(&Eeprom<'_, W>) -> Result<T, E>,
) -> Result<T, E> {
    let stop = wire.stop();
    let whole = async {
        let eeprom = Eeprom::claim(wire, device, step, claim).await?;
        let done = match stop.unless(work(&eeprom)).await {
            Some(done) => done,
            None => Err(eeprom.stopped().into()),
        };
        let back = eeprom.give_back().await;
        let done = done?;
        back?;
        Ok(done)
    };
    stop.hold(whole).await
}

/// The EEPROM of one device, held until [`Eeprom::give_back`].
#[derive(Debug)]
pub struct Eeprom<'a, W> {
    registers: Registers<'a, W>,
    /// 0x0500 as it was found.
    access: u8,
}

impl<'a, W: Wire> Eeprom<'a, W> {
    /// `step` says what it is wanted for.
    ///
    /// # Errors
    /// [`EepromError::InUse`] where it is lent and may not be taken.
    pub async fn claim(
        wire: &'a W,
        device: &'a DeviceRef,
        step: &'static str,
        claim: Claim,
    ) -> Result<Self, ServiceError> {
        let registers = Registers { wire, device, step };
        let [access, in_use] = registers.read(ACCESS).await?;
        let eeprom = Self { registers, access };
        if access & LENT != 0 || in_use & IN_USE != 0 {
            if claim == Claim::IfFree {
                return Err(eeprom.failed(EepromError::InUse));
            }
            eeprom.registers.write(ACCESS, &[FORCE]).await?;
            eeprom.registers.write(ACCESS, &[0]).await?;
        }
        Ok(eeprom)
    }

    /// Lends it again to whom it was lent.
    ///
    /// # Errors
    /// Of the wire.
    pub async fn give_back(self) -> Result<(), ServiceError> {
        if self.access & LENT == 0 {
            return Ok(());
        }
        self.registers.write(ACCESS, &[LENT]).await
    }

    /// As many bytes from a word on.
    ///
    /// # Errors
    /// [`ServiceError::Eeprom`], or of the wire.
    pub async fn read(&self, word: u32, bytes: &mut [u8]) -> Result<(), ServiceError> {
        let mut word = word;
        let mut rest = bytes;
        while !rest.is_empty() {
            let status = self.command(word, READ).await?;
            let data: [u8; 8] = self.registers.read(DATA).await?;
            let brought = if status & EIGHT_BYTES != 0 { 8 } else { 4 };
            let (now, later) = rest.split_at_mut(brought.min(rest.len()));
            for (to, from) in now.iter_mut().zip(data) {
                *to = from;
            }
            rest = later;
            word = word.saturating_add(if brought == 8 { 4 } else { 2 });
        }
        Ok(())
    }

    /// The image up to the mark at the end of its last category, whatever it says of its size; where it has no end, what can be
    /// addressed. `progress` is told bytes read and bytes there are at most.
    ///
    /// # Errors
    /// As [`Eeprom::read`].
    pub async fn image(
        &self,
        progress: &mut dyn FnMut(usize, usize),
    ) -> Result<Vec<u8>, ServiceError> {
        let size = self.size().await?;
        let mut image = vec![0; HEADER_BYTES];
        self.read(0, &mut image).await?;
        loop {
            let at = image.len();
            progress(at, size.max(at));
            let Some(head) = self.next(&mut image, MAX_BYTES, 4).await? else {
                return Ok(image);
            };
            let [k0, k1, n0, n1] = head;
            // The end mark is one word; what follows belongs to nothing. Zeros beyond what the image says to be are no categories.
            if u16::from_le_bytes([k0, k1]) == 0xffff || head == [0; 4] && at >= size {
                image.truncate(at + 2);
                return Ok(image);
            }
            let bytes = usize::from(u16::from_le_bytes([n0, n1])) * 2;
            if self.next(&mut image, MAX_BYTES, bytes).await?.is_none() {
                return Ok(image);
            }
        }
    }

    /// All that the chip holds, as the image says; the whole image at least.
    ///
    /// # Errors
    /// As [`Eeprom::read`].
    pub async fn all(
        &self,
        progress: &mut dyn FnMut(usize, usize),
    ) -> Result<Vec<u8>, ServiceError> {
        let size = self.size().await?;
        let image = self.image(progress).await?;
        self.longer(image, size, progress).await
    }

    /// More of it: so many bytes from its beginning, no more than can be addressed.
    ///
    /// # Errors
    /// As [`Eeprom::read`].
    pub async fn longer(
        &self,
        mut image: Vec<u8>,
        bytes: usize,
        progress: &mut dyn FnMut(usize, usize),
    ) -> Result<Vec<u8>, ServiceError> {
        let bytes = bytes.min(MAX_BYTES);
        while image.len() < bytes && self.next(&mut image, bytes, 64).await?.is_some() {
            progress(image.len(), bytes);
        }
        Ok(image)
    }

    /// Bytes that the chip holds, as the image itself says.
    ///
    /// # Errors
    /// As [`Eeprom::read`].
    pub async fn size(&self) -> Result<usize, ServiceError> {
        let mut size = [0; 2];
        self.read(SIZE, &mut size).await?;
        Ok(said(size))
    }

    /// Appends so many bytes, up to `size` in all; `None` where there are none.
    async fn next(
        &self,
        image: &mut Vec<u8>,
        size: usize,
        bytes: usize,
    ) -> Result<Option<[u8; 4]>, ServiceError> {
        let at = image.len();
        let end = at.saturating_add(bytes).min(size);
        if end == at && bytes > 0 {
            return Ok(None);
        }
        image.resize(end, 0xff);
        let word = u32::try_from(at / 2).unwrap_or(u32::MAX);
        let new = image.get_mut(at..).unwrap_or_default();
        self.read(word, new).await?;
        let mut head = [0xff; 4];
        for (to, from) in head.iter_mut().zip(new) {
            *to = *from;
        }
        Ok(Some(head))
    }

    /// Writes one word. Reads nothing back.
    ///
    /// # Errors
    /// [`ServiceError::Eeprom`], or of the wire.
    pub async fn write(&self, word: u32, value: [u8; 2]) -> Result<(), ServiceError> {
        self.registers.write(DATA, &value).await?;
        self.command(word, WRITE | WRITE_ENABLE).await.map(drop)
    }

    /// Lets the controller read its configuration anew; the alias counts from then on at the earliest.
    ///
    /// # Errors
    /// As [`Eeprom::write`].
    pub async fn reload(&self) -> Result<(), ServiceError> {
        self.command(0, RELOAD).await.map(drop)
    }

    /// Returns the status when the command is done.
    async fn command(&self, word: u32, command: u16) -> Result<u16, ServiceError> {
        let [c0, c1] = command.to_le_bytes();
        let [a0, a1, a2, a3] = word.to_le_bytes();
        let mut status = 0;
        for attempt in 0..TRIES {
            if attempt > 0 {
                self.registers.wire.delay(RETRY).await;
            }
            self.registers
                .write(CONTROL, &[c0, c1, a0, a1, a2, a3])
                .await?;
            status = self.done(word).await?;
            let failed = status & (REFUSED | NOT_ENABLED);
            if failed == 0 {
                return Ok(status);
            }
            // An error stays until a command of nothing is written.
            self.registers.write(CONTROL, &[0, 0]).await?;
            if failed & NOT_ENABLED != 0 {
                return Err(self.failed(EepromError::WriteProtected { word, status }));
            }
        }
        Err(self.failed(EepromError::NotAcknowledged { word, status }))
    }

    async fn done(&self, word: u32) -> Result<u16, ServiceError> {
        let wire = self.registers.wire;
        let time = u64::try_from(TIMEOUT.as_nanos()).unwrap_or(u64::MAX);
        let end = wire.now().saturating_add(time);
        loop {
            let status = u16::from_le_bytes(self.registers.read(CONTROL).await?);
            if status & BUSY == 0 {
                // A controller whose own reading failed can still be read by us.
                return Ok(status & !NOT_LOADED);
            }
            if wire.now() >= end {
                return Err(self.failed(EepromError::Busy { word }));
            }
            wire.delay(POLL).await;
        }
    }

    pub(super) fn stop(&self) -> &Stop {
        self.registers.wire.stop()
    }

    pub(super) fn stopped(&self) -> ServiceError {
        ServiceError::Stopped {
            device: self.registers.device.clone(),
            step: self.registers.step,
        }
    }

    pub(super) fn failed(&self, source: EepromError) -> ServiceError {
        ServiceError::Eeprom {
            device: self.registers.device.clone(),
            step: self.registers.step,
            source,
        }
    }
}
