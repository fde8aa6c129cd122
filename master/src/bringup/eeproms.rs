//! Reads what ethercrab's scan needs of all EEPROMs, on all devices at the same time.
//! `link::scan_answers` then answers the scan.

use std::convert::Infallible;
use std::time::Duration;

use ecaxis_ecat::registers;
use ecaxis_ecat::sii::control::ERRORS;
use ecaxis_ecat::sii::{FIRST_CATEGORY, SIZE, category};

use super::identify::{damaged_eeprom, name_at};
use crate::acyclic::eeprom::{Eeprom, EepromAccess, declared_size, with_eeprom};
use crate::acyclic::enumerate::FIRST_STATION;
use crate::acyclic::{AlState, DeviceRef, al};
use crate::concurrent::try_join_all;
use crate::config::Machine;
use crate::datagram::DatagramClient;
use crate::link::scan_answers::{EepromWords, ScanFindings};
use crate::mailbox::MailboxTransport;
use crate::report::{Cause, Error};

const STEP: &str = "reading its EEPROM";

/// Vendor, product, revision and serial number.
const IDENTITY: u16 = 0x08;
const IDENTITY_WORDS: u16 = 8;
/// The standard mailboxes and their protocols.
const MAILBOXES: u16 = 0x18;
const MAILBOX_WORDS: u16 = 5;
/// What ethercrab reads of the category General, and the byte of the order code's text number.
const GENERAL_WORDS: u16 = 9;
const ORDER_TEXT: u32 = 2;
/// ethercrab fails at a ninth SyncManager. One has four words.
const MANAGER_WORDS: u16 = 9 * 4;
/// ethercrab ends a search after as many categories without content.
const MAX_EMPTY: u16 = 32;
/// An EEPROM with more categories is not read ahead.
const MAX_CATEGORIES: usize = 64;

/// Brings all devices to Init, assigns the station addresses of ethercrab, and reads the EEPROMs. A
/// device that does not answer, stays in another state or has an EEPROM with errors is missing in
/// the result: ethercrab reads it itself, and fails as the device does.
///
/// # Errors
/// [`Cause::DamagedEeprom`].
pub(super) async fn read_ahead(
    wire: &DatagramClient,
    machine: &Machine,
    count: u16,
) -> Result<ScanFindings, Error> {
    if wire.any_status().await != Ok(AlState::Init.code()) {
        let init = [AlState::Init.code(), 0];
        let _ = wire.write_all(registers::AL_CONTROL, &init).await;
    }
    let stations = (0..count).map(async |position| {
        let station = FIRST_STATION.saturating_add(position).to_le_bytes();
        let _ = wire
            .write_at(position, registers::STATION_ADDRESS, &station)
            .await;
        Ok::<_, Infallible>(())
    });
    let Ok(_) = try_join_all(stations).await;
    let each = (0..count).map(async |position| {
        let device = DeviceRef {
            name: name_at(machine, position),
            position,
            station: FIRST_STATION.saturating_add(position),
        };
        if !reaches_init(wire, device.station).await {
            return Ok(None);
        }
        let words = read_one(wire, &device).await?;
        Ok::<_, Error>(Some((device.station, words)))
    });
    let in_init = try_join_all(each).await?;
    let all_in_init = in_init.iter().all(Option::is_some).then_some(count);
    let eeproms = in_init.into_iter().flatten();
    let eeproms = eeproms.filter_map(|(station, words)| Some((station, words?)));
    Ok(ScanFindings {
        eeproms: eeproms.collect(),
        all_in_init,
        as_line: None,
    })
}

/// Returns the words that ethercrab needs; `None` if it must read them itself.
async fn read_one(wire: &DatagramClient, device: &DeviceRef) -> Result<Option<EepromWords>, Error> {
    let access = EepromAccess::Force;
    let words = with_eeprom(wire, device, STEP, access, async |eeprom| {
        let words = EepromWords::default();
        let mut ahead = ReadAhead { eeprom, words };
        let read = ahead.whole().await?;
        Ok::<_, Error>(read.map(|()| ahead.words))
    });
    match words.await {
        Ok(Some(words)) => Ok(Some(words)),
        Ok(None) => match damaged_eeprom(wire, device, AlState::Init).await {
            Some(damaged) => Err(damaged),
            None => Ok(None),
        },
        Err(error) => {
            tracing::debug!("{error}; not read ahead");
            Ok(None)
        }
    }
}

/// Compares the identities with those that the devices still have: a device may be exchanged
/// between the read and the scan.
///
/// # Errors
/// [`Cause::EepromChanged`]; as [`with_eeprom`].
pub(super) async fn compare(
    wire: &DatagramClient,
    machine: &Machine,
    ahead: &ScanFindings,
) -> Result<(), Error> {
    let each = ahead.eeproms.iter().map(async |(&station, words)| {
        let position = station.saturating_sub(FIRST_STATION);
        let device = DeviceRef {
            name: name_at(machine, position),
            position,
            station,
        };
        let access = EepromAccess::Force;
        let mut identity = [0; 2 * IDENTITY_WORDS as usize];
        with_eeprom(wire, &device, STEP, access, async |eeprom| {
            eeprom.read(IDENTITY.into(), &mut identity).await
        })
        .await?;
        let before = (IDENTITY..).map_while(|word| words.word(word));
        match before.zip(identity.as_chunks().0).all(|(a, b)| a == *b) {
            true => Ok(()),
            false => Err(Cause::EepromChanged.with_device(&device)),
        }
    });
    try_join_all(each).await.map(drop)
}

/// A device that takes longer is left to ethercrab.
async fn reaches_init(wire: &DatagramClient, station: u16) -> bool {
    const TIMEOUT: u64 = 100_000_000;
    const POLL: Duration = Duration::from_micros(200);
    let end = wire.now().saturating_add(TIMEOUT);
    while let Ok(Some((status, _))) = al::read_status(wire, station).await {
        if status == AlState::Init.code() {
            return true;
        }
        if wire.now() >= end {
            return false;
        }
        wire.delay(POLL).await;
    }
    false
}

/// Reads the same words as ethercrab.
struct ReadAhead<'e, 'w> {
    eeprom: &'e Eeprom<'w, DatagramClient>,
    words: EepromWords,
}

/// The first word of a category's content, and the number of words.
type Content = (u16, u16);

impl ReadAhead<'_, '_> {
    /// Returns `None` if the contents may be damaged, or the interface reports errors.
    async fn whole(&mut self) -> Result<Option<()>, Error> {
        self.read(IDENTITY, IDENTITY_WORDS).await?;
        self.read(MAILBOXES, MAILBOX_WORDS).await?;
        let Some([strings, general, managers]) = self.categories().await? else {
            return Ok(None);
        };
        if let Some((start, words)) = managers {
            self.read(start, words.min(MANAGER_WORDS)).await?;
        }
        if let Some((start, words)) = general {
            self.read(start, words.min(GENERAL_WORDS)).await?;
            let order = self.byte(2 * u32::from(start) + ORDER_TEXT).await?;
            if let (1.., Some(strings)) = (order, strings) {
                self.text(strings, order).await?;
            }
        }
        Ok((self.words.status() & ERRORS == 0).then_some(()))
    }

    /// Searches the categories Strings, General and SyncManager. Returns `None` if the search leaves
    /// the chip.
    async fn categories(&mut self) -> Result<Option<[Option<Content>; 3]>, Error> {
        const WANTED: [u16; 3] = [category::STRINGS, category::GENERAL, category::SYNC_MANAGER];
        let size = declared_size(self.word(SIZE).await?.to_le_bytes()) / 2;
        let mut found = [None; 3];
        let (mut word, mut empty) = (FIRST_CATEGORY, 0);
        for _ in 0..MAX_CATEGORIES {
            let kind = self.word(word).await?;
            if kind == category::END {
                return Ok(Some(found));
            }
            let words = self.word(word.saturating_add(1)).await?;
            empty += u16::from(words == 0);
            let content = word.checked_add(2);
            let next = content.and_then(|content| content.checked_add(words));
            let (Some(content), Some(next)) = (content, next) else {
                return Ok(None);
            };
            if usize::from(next) > size {
                return Ok(None);
            }
            for (wanted, found) in WANTED.into_iter().zip(&mut found) {
                if kind == wanted {
                    found.get_or_insert((content, words));
                }
            }
            if empty >= MAX_EMPTY || found.iter().all(Option::is_some) {
                return Ok(Some(found));
            }
            word = next;
        }
        Ok(None)
    }

    /// Reads a text. In front of it are the number of texts, and the texts before, each with its
    /// length.
    async fn text(&mut self, (start, words): Content, number: u8) -> Result<(), Error> {
        let mut at = 2 * u32::from(start);
        let end = at + 2 * u32::from(words);
        if self.byte(at).await? < number - 1 {
            return Ok(());
        }
        at += 1;
        for _ in 1..number {
            at += 1 + u32::from(self.byte(at).await?);
            if at >= end {
                return Ok(());
            }
        }
        let last = at + u32::from(self.byte(at).await?);
        let [first, last] = [at + 1, last.min(end)].map(|at| u16::try_from(at / 2));
        let (Ok(first), Ok(last)) = (first, last) else {
            return Ok(());
        };
        // ethercrab's last read begins at one of these words.
        let words = last.saturating_sub(first) + 1 + self.words.per_read();
        self.read(first, words).await
    }

    async fn byte(&mut self, at: u32) -> Result<u8, Error> {
        let word = self.word(u16::try_from(at / 2).unwrap_or(u16::MAX)).await?;
        let [low, high] = word.to_le_bytes();
        Ok(if at.is_multiple_of(2) { low } else { high })
    }

    async fn word(&mut self, word: u16) -> Result<u16, Error> {
        self.read(word, 1).await?;
        Ok(self.words.word(word).map_or(0xffff, u16::from_le_bytes))
    }

    /// Reads what is missing of whole reads from `word` on.
    async fn read(&mut self, word: u16, words: u16) -> Result<(), Error> {
        let mut done = 0;
        while done < words.next_multiple_of(self.words.per_read()) {
            let Some(at) = word.checked_add(done) else {
                break;
            };
            done += match self.words.word(at) {
                Some(_) => 1,
                None => {
                    let (status, data) = self.eeprom.read_once(at.into()).await?;
                    self.words.add(at, status, data)
                }
            };
        }
        Ok(())
    }
}
