//! The diagnosis history, 0x10F3 (ETG.1020). It keeps the messages of a device until a client reads
//! them.

use ecaxis_esi::model::{Access, ObjectCode, Writable};

use super::Abort;
use super::object_dictionary::ObjectStore;

const HISTORY: u16 = 0x10f3;
const MOST: u8 = 1;
const NEWEST: u8 = 2;
const ACKNOWLEDGED: u8 = 3;
const AVAILABLE: u8 = 4;
const FLAGS: u8 = 5;
const FIRST: u8 = 6;
/// The capacity of the history. Further messages overwrite the oldest one.
const MESSAGES: u8 = 8;
const LAST: u8 = FIRST + MESSAGES - 1;
/// Bits of a message: code, flags, text, time.
const MESSAGE_BITS: u32 = 128;
/// Flag (0x10F3:05): unacknowledged messages were overwritten.
const OVERWRITTEN: i64 = 1 << 5;
/// Low word of a diagnosis code whose high word is the error code of an emergency.
const ERROR_CODE: u32 = 0xe800;
/// Message flags: error, no parameters.
const ERROR: u16 = 2;

/// Adds the history to the device. Items that the ESI describes are kept.
pub(crate) fn create(store: &mut ObjectStore) {
    let ro = Access::default();
    let rw = Access {
        read: true,
        write: Writable::Always,
    };
    store.describe(HISTORY, ObjectCode::Record, "Diagnosis history");
    store.ensure(HISTORY, 0, "SubIndex 000", 8, ro, &[LAST]);
    store.ensure(HISTORY, MOST, "Maximum messages", 8, ro, &[MESSAGES]);
    store.ensure(HISTORY, NEWEST, "Newest message", 8, ro, &[]);
    store.ensure(
        HISTORY,
        ACKNOWLEDGED,
        "Newest acknowledged message",
        8,
        rw,
        &[],
    );
    let available = store.ensure(HISTORY, AVAILABLE, "New messages available", 1, ro, &[]);
    store.set_type(available, "BOOL");
    store.ensure(HISTORY, FLAGS, "Flags", 16, rw, &[]);
    for sub in FIRST..=LAST {
        let name = format!("Diagnosis message {}", sub - FIRST + 1);
        let message = store.ensure(HISTORY, sub, &name, MESSAGE_BITS, ro, &[]);
        store.set_type(message, "OCTET_STRING");
    }
}

/// Adds the error code of an emergency at the device time in ns. Without a history, nothing
/// changes.
pub(crate) fn add(store: &mut ObjectStore, error: u16, time: u64) {
    if !store.has_object(HISTORY) {
        return;
    }
    let sub = match get(store, NEWEST) {
        newest @ FIRST..LAST => newest + 1,
        _ => FIRST,
    };
    let mut message = [0; MESSAGE_BITS as usize / 8];
    let code = u32::from(error) << 16 | ERROR_CODE;
    message[..4].copy_from_slice(&code.to_le_bytes());
    message[4..6].copy_from_slice(&ERROR.to_le_bytes());
    message[8..].copy_from_slice(&time.to_le_bytes());
    let Some(slot) = store.slot(HISTORY, sub) else {
        return;
    };
    let bytes = store.bytes_mut(slot);
    let is_taken = bytes.iter().any(|byte| *byte != 0);
    for (to, from) in bytes.iter_mut().zip(message) {
        *to = from;
    }
    if is_taken && get(store, AVAILABLE) != 0 {
        set(store, FLAGS, i64::from(get(store, FLAGS)) | OVERWRITTEN);
    }
    set(store, NEWEST, i64::from(sub));
    set(store, AVAILABLE, 1);
}

/// True for the object that acknowledges messages.
pub(crate) fn is_acknowledgement(index: u16, sub: u8) -> bool {
    (index, sub) == (HISTORY, ACKNOWLEDGED)
}

/// Acknowledges the messages up to this subindex; 0 clears the history.
pub(crate) fn acknowledge(store: &mut ObjectStore, up_to: u8) -> Result<(), Abort> {
    match up_to {
        0 => {
            for sub in FIRST..=LAST {
                if let Some(slot) = store.slot(HISTORY, sub) {
                    store.bytes_mut(slot).fill(0);
                }
            }
            set(store, NEWEST, 0);
        }
        FIRST..=LAST if get(store, NEWEST) != 0 => {}
        _ => return Err(Abort::VALUE),
    }
    set(store, ACKNOWLEDGED, i64::from(up_to));
    let new = get(store, NEWEST) != up_to;
    set(store, AVAILABLE, i64::from(new));
    Ok(())
}

fn get(store: &ObjectStore, sub: u8) -> u8 {
    let value = store.slot(HISTORY, sub).map(|slot| store.get(slot));
    value.map_or(0, |value| value as u8)
}

fn set(store: &mut ObjectStore, sub: u8, value: i64) {
    if let Some(slot) = store.slot(HISTORY, sub) {
        store.set(slot, value);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(store: &ObjectStore, sub: u8) -> &[u8] {
        store
            .slot(HISTORY, sub)
            .map_or(&[], |slot| store.bytes(slot))
    }

    #[test]
    fn history_overwrites_the_oldest_message() {
        let mut store = ObjectStore::default();
        add(&mut store, 0x3220, 5);
        assert!(!store.has_object(HISTORY), "a device without a history");
        create(&mut store);
        assert_eq!(get(&store, NEWEST), 0);
        for n in 0..MESSAGES {
            add(&mut store, 0x3220, u64::from(n));
            assert_eq!(get(&store, NEWEST), FIRST + n);
        }
        assert_eq!(get(&store, FLAGS), 0);
        let reported = [0x00, 0xe8, 0x20, 0x32, 2, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0];
        assert_eq!(message(&store, FIRST + 1), reported);
        add(&mut store, 0x8611, 99);
        assert_eq!(get(&store, NEWEST), FIRST);
        assert_eq!(message(&store, FIRST)[2..4], [0x11, 0x86]);
        assert_eq!(i64::from(get(&store, FLAGS)), OVERWRITTEN);
    }

    #[test]
    fn history_reports_only_unacknowledged_messages_as_new() {
        let mut store = ObjectStore::default();
        create(&mut store);
        for refused in [1, FIRST, LAST + 1] {
            assert_eq!(acknowledge(&mut store, refused), Err(Abort::VALUE));
        }
        add(&mut store, 0x3220, 5);
        add(&mut store, 0x3221, 6);
        for (up_to, available) in [(FIRST, 1), (FIRST + 1, 0)] {
            assert_eq!(acknowledge(&mut store, up_to), Ok(()));
            assert_eq!(get(&store, AVAILABLE), available);
        }
        assert_eq!(acknowledge(&mut store, 0), Ok(()));
        assert_eq!((get(&store, NEWEST), get(&store, AVAILABLE)), (0, 0));
        assert_eq!(message(&store, FIRST), [0; 16]);
    }
}
