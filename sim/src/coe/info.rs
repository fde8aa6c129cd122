//! SDO Information (ETG.1000.6 §5.6.3): the objects, their names and their types. Responses longer
//! than a mailbox are sent in fragments that count down to 0.

use ecaxis_esi::model::{Access, Direction, ObjectCode, Writable};

use super::object_dictionary::Item;
use super::objects::Dictionary;
use super::{Abort, datatype, service};
use crate::device::mailbox::{Answer, Detail, MailboxCapacity};

/// CoE header and SDO Information header.
const HEADERS: usize = 6;
/// Flag in the first byte, next to the opcode: more fragments follow.
const INCOMPLETE: u8 = 0x80;

mod opcode {
    pub(super) const LIST_REQUEST: u8 = 1;
    pub(super) const OBJECT_REQUEST: u8 = 3;
    pub(super) const ENTRY_REQUEST: u8 = 5;
    pub(super) const ERROR: u8 = 7;
}

/// Value info of an entry description: the requested and the returned fields.
mod value_info {
    pub(super) const UNIT: u8 = 0x08;
    pub(super) const DEFAULT: u8 = 0x10;
    pub(super) const MIN: u8 = 0x20;
    pub(super) const MAX: u8 = 0x40;
    /// Access rights, category and mapping are always returned.
    pub(super) const ALWAYS: u8 = 0x07;
}

/// Answers a request. `request` starts behind the CoE header.
pub(super) fn request(
    dictionary: &Dictionary<'_>,
    message: &[u8],
    room: MailboxCapacity,
) -> Answer {
    let Some((&[opcode, _, _, _], body)) = message.split_first_chunk() else {
        return Answer::Error(Detail::TooShort);
    };
    let opcode = opcode & !INCOMPLETE;
    let expected = match opcode {
        opcode::LIST_REQUEST | opcode::OBJECT_REQUEST => 2,
        opcode::ENTRY_REQUEST => 4,
        _ => 0,
    };
    if body.len() < expected {
        return Answer::Error(Detail::TooShort);
    }
    let index = body.first_chunk().map_or(0, |b| u16::from_le_bytes(*b));
    let answer = match (opcode, body) {
        (opcode::LIST_REQUEST, _) => list(dictionary, index),
        (opcode::OBJECT_REQUEST, _) => object(dictionary, index),
        (opcode::ENTRY_REQUEST, [_, _, sub, asked, ..]) => entry(dictionary, index, *sub, *asked),
        _ => Err(Abort::COMMAND),
    };
    let (opcode, data) = match answer {
        Ok(data) => (opcode + 1, data),
        Err(abort) => (opcode::ERROR, abort.0.to_le_bytes().to_vec()),
    };
    // A fragment ends between two indices.
    match fragments(opcode, &data, room.send.saturating_sub(HEADERS) & !1) {
        Some(fragments) => Answer::Parts(fragments),
        None => Answer::Error(Detail::NoMoreMemory),
    }
}

/// Returns `None` if the mailbox is too small for a fragment or there are too many fragments.
fn fragments(opcode: u8, data: &[u8], room: usize) -> Option<Vec<Vec<u8>>> {
    if room == 0 {
        return None;
    }
    let count = data.len().div_ceil(room).max(1);
    let mut left = u16::try_from(count).ok()?;
    let mut out = Vec::with_capacity(count);
    for part in data.chunks(room) {
        left -= 1;
        let mut message = super::header(service::SDO_INFORMATION).to_vec();
        let more = if left > 0 { INCOMPLETE } else { 0 };
        message.extend_from_slice(&[opcode | more, 0]);
        message.extend_from_slice(&left.to_le_bytes());
        message.extend_from_slice(part);
        out.push(message);
    }
    Some(out)
}

/// Returns a list of indices. List type 0 returns the lengths of lists 1 to 5.
fn list(dictionary: &Dictionary<'_>, kind: u16) -> Result<Vec<u8>, Abort> {
    let mut out = kind.to_le_bytes().to_vec();
    match kind {
        0 => {
            for kind in 1..=5 {
                let count = indices(dictionary, kind).count();
                let count = u16::try_from(count).unwrap_or(u16::MAX);
                out.extend_from_slice(&count.to_le_bytes());
            }
        }
        1..=5 => out.extend(indices(dictionary, kind).flat_map(u16::to_le_bytes)),
        _ => return Err(Abort::UNSUPPORTED_ACCESS),
    }
    Ok(out)
}

/// Returns the objects of a list: 1 all, 2 mappable into RxPDOs, 3 mappable into TxPDOs, 4 stored
/// by a store command, 5 start-up settings.
fn indices<'a>(dictionary: &'a Dictionary<'_>, kind: u16) -> impl Iterator<Item = u16> + 'a {
    let (store, pdo) = (&*dictionary.store, &*dictionary.pdo);
    let belongs = move |item: &Item| match kind {
        1 => true,
        2 => pdo.mappable(Direction::Rx, item),
        3 => pdo.mappable(Direction::Tx, item),
        4 => item.backup,
        _ => item.setting,
    };
    store.indices().filter(move |index| {
        store
            .object(*index)
            .filter_map(|slot| store.item(slot))
            .any(belongs)
    })
}

fn object(dictionary: &Dictionary<'_>, index: u16) -> Result<Vec<u8>, Abort> {
    let store = &*dictionary.store;
    if !store.has_object(index) {
        return Err(Abort::NO_OBJECT);
    }
    let type_of = |sub| {
        let item = store.slot(index, sub).and_then(|slot| store.item(slot));
        item.map_or(0, |item| item.data_type)
    };
    let (code, data_type): (u8, u16) = match store.object_code(index) {
        ObjectCode::Var => (7, type_of(0)),
        ObjectCode::Array => (8, type_of(1)),
        ObjectCode::Record => (9, record_type(index)),
    };
    let mut out = index.to_le_bytes().to_vec();
    out.extend_from_slice(&data_type.to_le_bytes());
    out.extend_from_slice(&[store.highest_sub(index), code]);
    out.extend_from_slice(store.object_name(index).as_bytes());
    Ok(out)
}

/// Returns the type code that the standard assigns to a known record.
fn record_type(index: u16) -> u16 {
    match index {
        0x1018 => 0x0023,
        0x1600..=0x17ff | 0x1a00..=0x1bff => 0x0021,
        _ => datatype::RECORD,
    }
}

fn entry(dictionary: &Dictionary<'_>, index: u16, sub: u8, asked: u8) -> Result<Vec<u8>, Abort> {
    let store = &*dictionary.store;
    let found = dictionary.slot(index, sub);
    let Some((slot, item)) = found.and_then(|slot| Some((slot, store.item(slot)?))) else {
        return Err(match store.has_object(index) {
            true => Abort::NO_SUBINDEX,
            false => Abort::NO_OBJECT,
        });
    };
    let unit = (item.unit != 0).then(|| item.unit.to_le_bytes());
    let optional: [(u8, Option<&[u8]>); 4] = [
        (value_info::UNIT, unit.as_ref().map(<[u8; 4]>::as_slice)),
        (
            value_info::DEFAULT,
            item.has_default.then(|| store.default_bytes(slot)),
        ),
        (value_info::MIN, item.min.as_deref()),
        (value_info::MAX, item.max.as_deref()),
    ];
    let reported = optional.map(|(bit, value)| (bit, value.filter(|_| asked & bit != 0)));
    let info = reported
        .iter()
        .filter(|(_, value)| value.is_some())
        .fold(asked & value_info::ALWAYS, |info, (bit, _)| info | bit);
    let bits = u16::try_from(item.bit_len).unwrap_or(u16::MAX);
    let mut out = index.to_le_bytes().to_vec();
    out.extend_from_slice(&[sub, info]);
    out.extend_from_slice(&item.data_type.to_le_bytes());
    out.extend_from_slice(&bits.to_le_bytes());
    out.extend_from_slice(&object_access(dictionary, item).to_le_bytes());
    for value in reported.iter().filter_map(|(_, value)| *value) {
        out.extend_from_slice(value);
    }
    out.extend_from_slice(item.name.as_bytes());
    Ok(out)
}

/// Returns the access bits of an object. Bits 0 to 2: readable in PreOp, SafeOp, Op. Bits 3 to 5:
/// writable there. Bits 6 and 7: mappable into RxPDOs and TxPDOs. Bit 8: backup. Bit 9: setting.
fn object_access(dictionary: &Dictionary<'_>, item: &Item) -> u16 {
    let Access { read, write } = item.access;
    let (pre_op, safe_op, op) = match write {
        Writable::Never => (false, false, false),
        Writable::Always => (true, true, true),
        Writable::Only {
            pre_op,
            safe_op,
            op,
        } => (pre_op, safe_op, op),
    };
    let mappable = |direction| dictionary.pdo.mappable(direction, item);
    let bits = [
        read,
        read,
        read,
        pre_op,
        safe_op,
        op,
        mappable(Direction::Rx),
        mappable(Direction::Tx),
        item.backup,
        item.setting,
    ];
    let bits = bits.into_iter().enumerate();
    bits.fold(0, |word, (n, bit)| word | u16::from(bit) << n)
}
