//! The EEPROM interface of one SubDevice: registers 0x0500 to 0x050F (SII clause of ETG.1000.4).

use std::time::Duration;

use super::Registers;
use crate::acyclic::{AlState, DeviceRef};
use crate::cancel::CancelToken;
use crate::mailbox::MailboxTransport;
use crate::report::EEPROM_TIMEOUT;
pub use crate::report::EepromError;
use crate::report::{Cause, Error};
use ecaxis_ecat::registers;
use ecaxis_ecat::sii::{self, HEADER_BYTES, control::*};
use ecaxis_esi::sii::chip_length;

/// 0x0500: the PDI has access to the EEPROM; the MainDevice can take it by force.
const LENT: u8 = 0x01;
const FORCE: u8 = 0x02;
/// 0x0501: the PDI is using the EEPROM.
const IN_USE: u8 = 0x01;

/// The word address of the size.
const SIZE: u32 = sii::SIZE as u32;
/// The maximum length of an image in bytes: 4 MiBit, more than the interface can address.
const MAX_BYTES: usize = 512 * 1024;

/// The bytes of a category that are read before the end of the chip is checked again.
const PIECE: usize = 1024;

const POLL: Duration = Duration::from_micros(200);
/// The number of attempts. A chip that is still writing does not acknowledge.
const MAX_ATTEMPTS: u32 = 5;
const RETRY: Duration = Duration::from_millis(10);

/// Whether the MainDevice may take the EEPROM from the PDI.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EepromAccess {
    /// Only if the PDI does not have access.
    IfFree,
    Force,
}

impl EepromAccess {
    /// Returns the access for an AL state. In Init a device does not need its EEPROM, but some
    /// MainDevices leave it assigned to the PDI.
    #[must_use]
    pub fn of(state: AlState) -> Self {
        match state {
            AlState::Init => Self::Force,
            _ => Self::IfFree,
        }
    }
}

/// Returns the size of a chip in bytes according to its image; the header's length if the image is
/// too short.
#[must_use]
pub fn size_of(image: &[u8]) -> usize {
    let at = usize::try_from(SIZE * 2).unwrap_or(usize::MAX);
    let word = image.get(at..).and_then(<[u8]>::first_chunk);
    word.map_or(HEADER_BYTES, |word| declared_size(*word))
}

/// Returns the size in bytes that the size word declares.
pub(crate) fn declared_size(word: [u8; 2]) -> usize {
    let kibit = usize::from(u16::from_le_bytes(word)).saturating_add(1);
    kibit.saturating_mul(128).clamp(HEADER_BYTES, MAX_BYTES)
}

fn is_not_acknowledged(error: &Error) -> bool {
    matches!(
        *error.cause,
        Cause::Eeprom(EepromError::NotAcknowledged { .. })
    )
}

/// Runs `work` on a device's EEPROM. Afterwards the PDI has its access again, even after an error.
/// `step` describes the operation.
///
/// # Errors
/// As [`Eeprom::claim`] and [`Eeprom::release`]; [`Cause::Interrupted`]. Errors of the work take
/// precedence.
pub async fn with_eeprom<W: MailboxTransport, T, E: From<Error>>(
    wire: &W,
    device: &DeviceRef,
    step: &'static str,
    claim: EepromAccess,
    work: impl AsyncFnOnce(&Eeprom<'_, W>) -> Result<T, E>,
) -> Result<T, E> {
    let stop = wire.stop();
    let whole = async {
        let eeprom = Eeprom::claim(wire, device, step, claim).await?;
        let done = match stop.run_until_cancelled(work(&eeprom)).await {
            Some(done) => done,
            None => Err(eeprom.stopped().into()),
        };
        let back = eeprom.release().await;
        let done = done?;
        back?;
        Ok(done)
    };
    stop.shield(whole).await
}

/// Access to the EEPROM of one device, held until [`Eeprom::release`].
#[derive(Debug)]
pub struct Eeprom<'a, W> {
    registers: Registers<'a, W>,
    /// 0x0500 before the access.
    access: u8,
}

impl<'a, W: MailboxTransport> Eeprom<'a, W> {
    /// Takes access to the EEPROM. `step` describes the operation.
    ///
    /// # Errors
    /// [`EepromError::InUse`] if the PDI has access and may not lose it.
    pub async fn claim(
        wire: &'a W,
        device: &'a DeviceRef,
        step: &'static str,
        claim: EepromAccess,
    ) -> Result<Self, Error> {
        let registers = Registers { wire, device, step };
        let [access, in_use] = registers.read(registers::EEPROM_CONFIGURATION).await?;
        let eeprom = Self { registers, access };
        if access & LENT != 0 || in_use & IN_USE != 0 {
            if claim == EepromAccess::IfFree {
                return Err(eeprom.failed(EepromError::InUse));
            }
            eeprom
                .registers
                .write(registers::EEPROM_CONFIGURATION, &[FORCE])
                .await?;
            eeprom
                .registers
                .write(registers::EEPROM_CONFIGURATION, &[0])
                .await?;
        }
        Ok(eeprom)
    }

    /// Returns access to the PDI if it had it before.
    ///
    /// # Errors
    /// As [`Registers::write`].
    pub async fn release(self) -> Result<(), Error> {
        if self.access & LENT == 0 {
            return Ok(());
        }
        self.registers
            .write(registers::EEPROM_CONFIGURATION, &[LENT])
            .await
    }

    /// Reads bytes from a word on.
    ///
    /// # Errors
    /// [`Cause::Eeprom`], and as [`Registers::read`].
    pub async fn read(&self, word: u32, bytes: &mut [u8]) -> Result<(), Error> {
        let mut word = word;
        let mut rest = bytes;
        while !rest.is_empty() {
            let (status, data) = self.read_once(word).await?;
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

    /// Returns 0x0502 and the four or eight bytes that one read brings
    /// ([`EIGHT_BYTES`]).
    ///
    /// # Errors
    /// As [`Eeprom::read`].
    pub async fn read_once(&self, word: u32) -> Result<(u16, [u8; 8]), Error> {
        self.command(word, READ).await
    }

    /// Reads the image up to the end mark of its categories, independent of its size word. Without
    /// an end mark, reads up to the end of the chip, where its beginning repeats or where it no
    /// longer acknowledges. `progress` receives the bytes read and the expected maximum.
    ///
    /// # Errors
    /// As [`Eeprom::read`].
    pub async fn image(&self, progress: &mut dyn FnMut(usize, usize)) -> Result<Vec<u8>, Error> {
        let size = self.size().await?;
        let mut image = vec![0; HEADER_BYTES];
        self.read(0, &mut image).await?;
        // The bytes of the present category that are not read yet.
        let mut left = 0;
        loop {
            let at = image.len();
            progress(at, size.max(at));
            let bytes = if left > 0 { left.min(PIECE) } else { 4 };
            let head = match self.next(&mut image, MAX_BYTES, bytes).await {
                Err(error) if at >= size && is_not_acknowledged(&error) => {
                    image.truncate(at);
                    return Ok(image);
                }
                head => head?,
            };
            let Some(head) = head else {
                return Ok(image);
            };
            let chip = chip_length(&image);
            if chip < image.len() {
                image.truncate(chip);
                return Ok(image);
            }
            if left > 0 {
                left = left.saturating_sub(bytes);
                continue;
            }
            let [k0, k1, n0, n1] = head;
            // The end mark is one word, so the rest is cut off. Zeros beyond the declared size are
            // not categories.
            if u16::from_le_bytes([k0, k1]) == 0xffff || head == [0; 4] && at >= size {
                image.truncate(at + 2);
                return Ok(image);
            }
            left = usize::from(u16::from_le_bytes([n0, n1])) * 2;
        }
    }

    /// Reads the whole chip according to its size word, at least the whole image.
    ///
    /// # Errors
    /// As [`Eeprom::read`].
    pub async fn all(&self, progress: &mut dyn FnMut(usize, usize)) -> Result<Vec<u8>, Error> {
        let size = self.size().await?;
        let image = self.image(progress).await?;
        self.longer(image, size, progress).await
    }

    /// Extends an image to `bytes` bytes, at most what can be addressed.
    ///
    /// # Errors
    /// As [`Eeprom::read`].
    pub async fn longer(
        &self,
        mut image: Vec<u8>,
        bytes: usize,
        progress: &mut dyn FnMut(usize, usize),
    ) -> Result<Vec<u8>, Error> {
        let bytes = bytes.min(MAX_BYTES);
        while image.len() < bytes && self.next(&mut image, bytes, 64).await?.is_some() {
            progress(image.len(), bytes);
        }
        Ok(image)
    }

    /// Returns the size of the chip in bytes according to its size word.
    ///
    /// # Errors
    /// As [`Eeprom::read`].
    pub async fn size(&self) -> Result<usize, Error> {
        let mut size = [0; 2];
        self.read(SIZE, &mut size).await?;
        Ok(declared_size(size))
    }

    /// Appends up to `bytes` bytes, `size` in total; returns `None` at the end.
    async fn next(
        &self,
        image: &mut Vec<u8>,
        size: usize,
        bytes: usize,
    ) -> Result<Option<[u8; 4]>, Error> {
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

    /// Writes one word without reading it back.
    ///
    /// # Errors
    /// [`Cause::Eeprom`], and as [`Registers::write`].
    pub async fn write(&self, word: u32, value: [u8; 2]) -> Result<(), Error> {
        self.registers.write(registers::EEPROM_DATA, &value).await?;
        self.command(word, WRITE | WRITE_ENABLE).await.map(drop)
    }

    /// Makes the controller reload its configuration. The alias may take effect only later.
    ///
    /// # Errors
    /// As [`Eeprom::write`].
    pub async fn reload(&self) -> Result<(), Error> {
        self.command(0, RELOAD).await.map(drop)
    }

    /// Runs a command. Returns the status when it is done, and the data register.
    async fn command(&self, word: u32, command: u16) -> Result<(u16, [u8; 8]), Error> {
        let [c0, c1] = command.to_le_bytes();
        let [a0, a1, a2, a3] = word.to_le_bytes();
        let mut status = 0;
        for attempt in 0..MAX_ATTEMPTS {
            if attempt > 0 {
                self.registers.wire.delay(RETRY).await;
            }
            self.registers
                .write(registers::EEPROM_CONTROL, &[c0, c1, a0, a1, a2, a3])
                .await?;
            let data;
            (status, data) = self.done(word).await?;
            let failed = status & (REFUSED | NOT_ENABLED);
            if failed == 0 {
                return Ok((status, data));
            }
            // The error remains until an empty command is written.
            self.registers
                .write(registers::EEPROM_CONTROL, &[0, 0])
                .await?;
            if failed & NOT_ENABLED != 0 {
                return Err(self.failed(EepromError::WriteProtected { word, status }));
            }
        }
        Err(self.failed(EepromError::NotAcknowledged { word, status }))
    }

    /// Waits for the end of a command. One datagram reads control, address and data.
    async fn done(&self, word: u32) -> Result<(u16, [u8; 8]), Error> {
        let wire = self.registers.wire;
        let time = u64::try_from(EEPROM_TIMEOUT.as_nanos()).unwrap_or(u64::MAX);
        let end = wire.now().saturating_add(time);
        loop {
            let [s0, s1, _, _, _, _, data @ ..]: [u8; 14] =
                self.registers.read(registers::EEPROM_CONTROL).await?;
            let status = u16::from_le_bytes([s0, s1]);
            if status & BUSY == 0 {
                return Ok((status, data));
            }
            if wire.now() >= end {
                return Err(self.failed(EepromError::Busy { word }));
            }
            wire.delay(POLL).await;
        }
    }

    pub(super) fn stop(&self) -> &CancelToken {
        self.registers.wire.stop()
    }

    pub(super) fn stopped(&self) -> Error {
        self.registers.error(Cause::Interrupted)
    }

    pub(super) fn failed(&self, source: EepromError) -> Error {
        self.registers.error(Cause::Eeprom(source))
    }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use super::*;
    use crate::mailbox::DatagramError;

    /// A chip that ignores upper address bits, or acknowledges none beyond its end.
    struct Chip {
        bytes: Vec<u8>,
        wraps: bool,
        word: Cell<u32>,
        reads: Cell<usize>,
    }

    impl Chip {
        /// Has the given header and one category up to the end of the chip.
        fn without_end_mark(size: usize, size_word: u16, wraps: bool) -> Self {
            let mut bytes: Vec<u8> = (0..size)
                .map(|n| (7 * n + n / 256).to_le_bytes()[0])
                .collect();
            bytes[0x7c..0x7e].copy_from_slice(&size_word.to_le_bytes());
            let words = u16::try_from((size - HEADER_BYTES - 4) / 2).expect("small");
            bytes[0x80..0x82].copy_from_slice(&0x0900_u16.to_le_bytes());
            bytes[0x82..0x84].copy_from_slice(&words.to_le_bytes());
            Self {
                bytes,
                wraps,
                word: Cell::new(0),
                reads: Cell::new(0),
            }
        }

        fn image(&self) -> Vec<u8> {
            let device = DeviceRef {
                name: "x".to_owned(),
                position: 0,
                station: 0x1001,
            };
            let image = with_eeprom(self, &device, "reading", EepromAccess::IfFree, async |e| {
                e.image(&mut |_, _| {}).await
            });
            let image: Result<Vec<u8>, Error> =
                crate::sys::executor::block_on(image).expect("carried");
            image.expect("an image")
        }
    }

    impl MailboxTransport for Chip {
        async fn read(&self, _: u16, register: u16, to: &mut [u8]) -> Result<u16, DatagramError> {
            let at = usize::try_from(self.word.get()).expect("small") * 2;
            let beyond = at >= self.bytes.len() && !self.wraps;
            to.fill(0);
            if register == registers::EEPROM_CONTROL {
                let (status, data) = to.split_at_mut(2);
                if beyond {
                    status.copy_from_slice(&REFUSED.to_le_bytes());
                }
                for (n, byte) in data.iter_mut().skip(4).enumerate() {
                    *byte = self.bytes[(at + n) % self.bytes.len()];
                }
            }
            Ok(1)
        }

        async fn write(&self, _: u16, register: u16, data: &[u8]) -> Result<u16, DatagramError> {
            if let (registers::EEPROM_CONTROL, [_, _, word @ ..]) = (register, data)
                && let Some(word) = word.first_chunk()
            {
                self.word.set(u32::from_le_bytes(*word));
                self.reads.set(self.reads.get() + 1);
            }
            Ok(1)
        }

        async fn delay(&self, _: Duration) {}

        fn now(&self) -> u64 {
            0
        }
    }

    /// Word 0x3E is the size in KiBit minus one. A chip ignores upper address bits (Atmel AT24C16
    /// data sheet, "Device addressing"), others do not acknowledge (ETG.1000.4, bit 13 of 0x0502).
    #[test]
    fn image_without_end_mark_ends_with_the_chip() {
        for (size, size_word) in [(2048, 15), (2048, 1), (2048, 0xffff), (4096, 15)] {
            for wraps in [true, false] {
                if !wraps && size_word == 0xffff {
                    continue;
                }
                let chip = Chip::without_end_mark(size, size_word, wraps);
                assert_eq!(chip.image(), chip.bytes, "{size} {size_word} {wraps}");
                let most = (size + 2 * PIECE) / 4;
                assert!(chip.reads.get() <= most, "{} reads", chip.reads.get());
            }
        }
    }
}
