//! Bytes → image contents. All offsets come from outside and may point anywhere.

use std::collections::BTreeSet;

use super::warning::{
    SiiWarning, StringRefs, WarningKind, Warnings, occurs_once, strings_of, trailing_bytes,
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
}

/// The offset of the checksum.
const CHECKSUM: usize = 14;

pub(super) fn image(bytes: &[u8]) -> Result<(Sii, Vec<SiiWarning>), SiiError> {
    let bytes = bytes.get(..chip_length(bytes)).unwrap_or(bytes);
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
    let size = usize::try_from(sii.byte_size).unwrap_or(usize::MAX);
    let Categories { found, end, length } = categories(body, size, &mut notes);
    sii.ended = matches!(end, End::Mark);
    match end {
        End::Mark if found.is_empty() => {
            notes.add(HEADER_BYTES, None, WarningKind::NoCategories);
        }
        End::Missing => notes.add(bytes.len(), None, WarningKind::NoEnd),
        End::Mark | End::Damage => {}
    }
    if length > size {
        notes.add(size, None, WarningKind::BeyondSize { length, size });
    }
    let strings = found.iter().find(|c| c.kind == category::STRINGS);
    let strings = strings
        .map(|c| strings_of(c, &mut notes))
        .unwrap_or_default();
    let mut unique = Vec::new();
    for here in &found {
        let (kind, data) = (here.kind, here.data);
        if unique.contains(&kind) {
            notes.add(here.offset, Some(kind), WarningKind::Repeated);
            continue;
        }
        if occurs_once(kind) {
            unique.push(kind);
        }
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
            // PDOs may be spread over several categories.
            category::TX_PDO => add_pdos(&mut sii.tx_pdos, data, &mut strings),
            category::RX_PDO => add_pdos(&mut sii.rx_pdos, data, &mut strings),
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
    let Warnings { all, damage } = notes;
    sii.damage = damage;
    Ok((sii, all))
}

/// Returns the length of the chip that the bytes were read from: from there its beginning repeats,
/// because a chip ignores the upper address bits. Returns the number of bytes if nothing repeats.
pub(super) fn chip_length(bytes: &[u8]) -> usize {
    /// Configuration, identity and serial number.
    const COMPARED: usize = 0x20;
    /// The smallest usual chip, 16 KiBit.
    const SMALLEST: usize = 2048;
    let Some(beginning) = bytes.get(..COMPARED) else {
        return bytes.len();
    };
    if beginning.iter().all(|byte| Some(byte) == beginning.first()) {
        return bytes.len();
    }
    let powers = (0..usize::BITS).filter_map(|n| SMALLEST.checked_shl(n));
    let mut lengths = powers.take_while(|length| *length < bytes.len());
    let repeats = |length: &usize| {
        bytes
            .get(*length..)
            .is_some_and(|b| b.starts_with(beginning))
    };
    lengths.find(repeats).unwrap_or(bytes.len())
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

/// Why the list of categories ends.
enum End {
    Mark,
    /// The image ends without an end mark.
    Missing,
    /// A category exceeds the image.
    Damage,
}

struct Categories<'a> {
    found: Vec<Category<'a>>,
    end: End,
    /// The length of the image up to the end of the list.
    length: usize,
}

/// Returns all categories up to the end. `size`: the size of the EEPROM that the image states. Some
/// are too small, but then the list has an end. Without one, what follows the size are the remains
/// of another image.
fn categories<'a>(body: &'a [u8], size: usize, notes: &mut Warnings) -> Categories<'a> {
    let (whole, cut) = walk(body);
    let stated = body.get(..size.saturating_sub(HEADER_BYTES));
    // Some chips read as ones beyond their end. Those are not an end mark.
    let beyond = body.get(size.saturating_sub(HEADER_BYTES)..);
    let is_blank = beyond.is_some_and(|b| !b.is_empty() && b.iter().all(|byte| *byte == 0xff));
    let (list, cut) = match (&whole.end, stated) {
        (End::Mark, _) if !is_blank => (whole, cut),
        (_, Some(stated)) => walk(stated),
        _ => (whole, cut),
    };
    if let Some((offset, kind, remark)) = cut {
        notes.add(offset, Some(kind), remark);
    }
    list
}

/// Walks through the list. Returns also the category that exceeds the body: offset, type, problem.
fn walk(body: &[u8]) -> (Categories<'_>, Option<(usize, u16, WarningKind)>) {
    let (mut found, mut cut) = (Vec::new(), None);
    let mut rest = body;
    let end = loop {
        let offset = HEADER_BYTES + body.len() - rest.len();
        let Some((kind, after)) = rest.split_at_checked(2) else {
            break End::Missing;
        };
        let kind = word(kind, 0);
        if kind == category::END {
            rest = after;
            break End::Mark;
        }
        let Some((length, after)) = after.split_at_checked(2) else {
            break End::Missing;
        };
        let claimed = usize::from(word(length, 0)) * 2;
        let Some((data, after)) = after.split_at_checked(claimed) else {
            let left = after.len();
            cut = Some((offset, kind, WarningKind::Truncated { claimed, left }));
            break End::Damage;
        };
        let offset = offset + 4;
        found.push(Category { kind, offset, data });
        rest = after;
    };
    let length = HEADER_BYTES + body.len() - rest.len();
    (Categories { found, end, length }, cut)
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

/// Adds the PDOs of one more category. The first description of a PDO counts.
fn add_pdos(all: &mut Vec<SiiPdo>, data: &[u8], strings: &mut StringRefs<'_>) {
    let known: BTreeSet<u16> = all.iter().map(|pdo| pdo.index).collect();
    let added = pdos(data, strings);
    if added.iter().any(|pdo| known.contains(&pdo.index)) {
        let Category { kind, offset, .. } = strings.here;
        strings.notes.add(offset, Some(kind), WarningKind::Repeated);
    }
    all.extend(added.into_iter().filter(|pdo| !known.contains(&pdo.index)));
}

/// Returns the PDOs up to the first that exceeds the category.
fn pdos(data: &[u8], strings: &mut StringRefs<'_>) -> Vec<SiiPdo> {
    let mut found = Vec::new();
    let mut at = 0;
    while let Some(head) = data.get(at..at + 8) {
        let (index, count) = (word(head, 0), byte(head, 2));
        let first = at + 8;
        let end = first + usize::from(count) * 8;
        let Some(entries) = data.get(first..end) else {
            let remark = WarningKind::Pdo {
                pdo: index,
                entries: count,
            };
            let offset = strings.here.offset + at;
            strings.notes.add(offset, Some(strings.here.kind), remark);
            break;
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
    found
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
