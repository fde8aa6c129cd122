//! Bytes → image contents. All offsets come from outside and may point anywhere.

use super::warning::{
    SiiWarning, StringRefs, WarningKind, Warnings, repeated, strings_of, trailing_bytes,
};
use super::{
    General, HEADER_BYTES, MailboxAreas, Protocols, Sii, SiiDc, SiiEntry, SiiFmmuDetail, SiiPdo,
    SiiSyncManager, category, checksum, fmmu_use, sm_use,
};
use crate::model::{FmmuUse, Identity};

/// An EEPROM image is unreadable.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum SiiError {
    /// The image is shorter than its header.
    #[error("the image has {len} bytes, the header alone needs 128")]
    TooShort {
        /// The length in bytes.
        len: usize,
    },
    /// A category exceeds the image.
    #[error("category {category} at byte 0x{offset:x} claims {claimed} bytes, {left} are left")]
    Category {
        /// The category type.
        category: u16,
        /// The byte offset of the category.
        offset: usize,
        /// The length in its header, in bytes.
        claimed: usize,
        /// The bytes up to the end of the image.
        left: usize,
    },
    /// The entries of a PDO exceed its category.
    #[error(
        "category {category} at byte 0x{offset:x}: PDO 0x{pdo:04x} claims {entries} entries, more than the category holds"
    )]
    Pdo {
        /// The category type.
        category: u16,
        /// The byte offset of the category.
        offset: usize,
        /// The index of the PDO.
        pdo: u16,
        /// The number of entries in its header.
        entries: u8,
    },
}

/// The offset of the checksum.
const CHECKSUM: usize = 14;

pub(super) fn image(bytes: &[u8]) -> Result<(Sii, Vec<SiiWarning>), SiiError> {
    let Some((header, body)) = bytes.split_at_checked(HEADER_BYTES) else {
        return Err(SiiError::TooShort { len: bytes.len() });
    };
    let mut sii = read_header(header);
    let mut notes = Warnings::default();
    let right = checksum(&sii.config);
    let found = byte(header, CHECKSUM);
    if right != found {
        notes.add(CHECKSUM, None, WarningKind::Checksum { found, right });
    }
    let (found, ended) = categories(body)?;
    sii.ended = ended;
    if !ended {
        notes.add(bytes.len(), None, WarningKind::NoEnd);
    }
    if ended && found.is_empty() {
        notes.add(HEADER_BYTES, None, WarningKind::NoCategories);
    }
    repeated(&found, &mut notes);
    let strings = found.iter().find(|c| c.kind == category::STRINGS);
    let strings = strings
        .map(|c| strings_of(c, &mut notes))
        .unwrap_or_default();
    for here in &found {
        let (kind, data) = (here.kind, here.data);
        trailing_bytes(here, &mut notes);
        let mut strings = StringRefs {
            table: &strings,
            here: *here,
            notes: &mut notes,
        };
        match kind {
            category::STRINGS => {}
            category::GENERAL => sii.general = Some(general(data, &mut strings)),
            category::FMMU => sii.fmmus = fmmus(data),
            category::SYNC_MANAGER => {
                sii.sync_managers = data.chunks_exact(8).map(sync_manager).collect()
            }
            category::TX_PDO => sii.tx_pdos.extend(pdos(data, &mut strings)?),
            category::RX_PDO => sii.rx_pdos.extend(pdos(data, &mut strings)?),
            category::DC => {
                sii.dc = data
                    .chunks_exact(24)
                    .enumerate()
                    .map(|(n, chunk)| dc(chunk, n * 24, &mut strings))
                    .collect();
            }
            category::FMMU_DETAILS => {
                sii.fmmu_details = data.chunks_exact(4).map(fmmu_detail).collect();
            }
            category::SYNC_UNIT => {
                sii.sync_units = data
                    .chunks_exact(2)
                    .map(|unit| byte(unit, 0) & 0x0f)
                    .collect();
            }
            _ => sii.others.push((kind, data.to_vec())),
        }
    }
    Ok((sii, notes.0))
}

fn read_header(header: &[u8]) -> Sii {
    let mut config = [0; 14];
    for (to, from) in config.iter_mut().zip(header) {
        *to = *from;
    }
    let areas = |at: usize| MailboxAreas {
        receive_offset: word(header, at),
        receive_size: word(header, at + 2),
        send_offset: word(header, at + 4),
        send_size: word(header, at + 6),
    };
    Sii {
        config,
        alias: word(header, 8),
        checksum_ok: byte(header, 14) == checksum(&config),
        identity: Identity {
            vendor: double_word(header, 0x10),
            product: double_word(header, 0x14),
            revision: double_word(header, 0x18),
        },
        serial: double_word(header, 0x1c),
        bootstrap: areas(0x28),
        mailbox: areas(0x30),
        protocols: Protocols(word(header, 0x38)),
        byte_size: (u32::from(word(header, 0x7c)) + 1) * 128,
        ..Sii::default()
    }
}

#[derive(Clone, Copy)]
pub(super) struct Category<'a> {
    pub kind: u16,
    /// The offset of the data from the start of the image.
    pub offset: usize,
    pub data: &'a [u8],
}

/// Returns all categories up to the end mark, and whether the end mark exists.
fn categories(body: &[u8]) -> Result<(Vec<Category<'_>>, bool), SiiError> {
    let mut found = Vec::new();
    let mut rest = body;
    loop {
        let Some((kind, after)) = rest.split_at_checked(2) else {
            return Ok((found, false));
        };
        let kind = word(kind, 0);
        if kind == category::END {
            return Ok((found, true));
        }
        let Some((length, after)) = after.split_at_checked(2) else {
            return Ok((found, false));
        };
        let claimed = usize::from(word(length, 0)) * 2;
        let Some((data, after)) = after.split_at_checked(claimed) else {
            let offset = HEADER_BYTES + body.len() - rest.len();
            return Err(SiiError::Category {
                category: kind,
                offset,
                claimed,
                left: after.len(),
            });
        };
        let offset = HEADER_BYTES + body.len() - after.len() - claimed;
        found.push(Category { kind, offset, data });
        rest = after;
    }
}

fn general(data: &[u8], strings: &mut StringRefs<'_>) -> General {
    General {
        group: strings.text(0),
        image: strings.text(1),
        order: strings.text(2),
        name: strings.text(3),
        coe_details: byte(data, 5),
        foe: byte(data, 6) != 0,
        eoe: byte(data, 7) != 0,
        flags: byte(data, 11),
        ebus_ma: i16::from_le_bytes(word(data, 12).to_le_bytes()),
        ports: word(data, 16),
        identification_address: word(data, 18),
    }
}

fn fmmu_detail(data: &[u8]) -> SiiFmmuDetail {
    let flags = byte(data, 0);
    SiiFmmuDetail {
        op_only: flags & 1 != 0,
        sm: Some(byte(data, 2)).filter(|_| flags & 2 != 0),
        su: Some(byte(data, 3)).filter(|_| flags & 4 != 0),
    }
}

fn fmmus(data: &[u8]) -> Vec<FmmuUse> {
    // The last byte may be padding to a whole word.
    let used = match data.split_last() {
        Some((0xff, before)) => before,
        _ => data,
    };
    used.iter().map(|&code| fmmu_use(code)).collect()
}

fn sync_manager(data: &[u8]) -> SiiSyncManager {
    SiiSyncManager {
        start_address: word(data, 0),
        len: word(data, 2),
        control: byte(data, 4),
        enable: byte(data, 6),
        usage: sm_use(byte(data, 7)),
    }
}

fn pdos(data: &[u8], strings: &mut StringRefs<'_>) -> Result<Vec<SiiPdo>, SiiError> {
    let mut found = Vec::new();
    let mut at = 0;
    while let Some(head) = data.get(at..at + 8) {
        let (index, count) = (word(head, 0), byte(head, 2));
        let first = at + 8;
        let end = first + usize::from(count) * 8;
        let Some(entries) = data.get(first..end) else {
            return Err(SiiError::Pdo {
                category: strings.here.kind,
                offset: strings.here.offset + at,
                pdo: index,
                entries: count,
            });
        };
        found.push(SiiPdo {
            index,
            name: strings.text(at + 5),
            sm: Some(byte(head, 3)).filter(|sm| *sm != 0xff),
            synchronization: byte(head, 4),
            flags: word(head, 6),
            entries: entries
                .chunks_exact(8)
                .enumerate()
                .map(|(n, entry)| SiiEntry {
                    index: word(entry, 0),
                    sub: byte(entry, 2),
                    name: strings.text(first + n * 8 + 3),
                    data_type: byte(entry, 4),
                    bit_len: byte(entry, 5),
                    flags: word(entry, 6),
                })
                .collect(),
        });
        at = end;
    }
    Ok(found)
}

/// Reads a DC mode. `at` is the offset of the mode in its category.
fn dc(data: &[u8], at: usize, strings: &mut StringRefs<'_>) -> SiiDc {
    let signed = |at| i32::from_le_bytes(double_word(data, at).to_le_bytes());
    let factor = |at| i16::from_le_bytes(word(data, at).to_le_bytes());
    SiiDc {
        cycle0_ns: double_word(data, 0),
        shift0_ns: signed(4),
        shift1_ns: signed(8),
        sync1_factor: factor(12),
        assign_activate: word(data, 14),
        sync0_factor: factor(16),
        name: strings.text(at + 18),
        description: strings.text(at + 19),
    }
}

/// Little-endian reads. Bytes beyond the end read as 0, because older categories are shorter.
pub(super) fn byte(data: &[u8], at: usize) -> u8 {
    data.get(at).copied().unwrap_or(0)
}

fn word(data: &[u8], at: usize) -> u16 {
    u16::from_le_bytes([byte(data, at), byte(data, at + 1)])
}

fn double_word(data: &[u8], at: usize) -> u32 {
    u32::from(word(data, at)) | u32::from(word(data, at + 2)) << 16
}
