//! Tests of SyncManagers with single accesses.

use super::sm::*;

const MEMORY: usize = 0x3000;
/// Buffered and mailbox, read and written by the MainDevice.
const BUFFER_IN: u8 = 0x20;
const BUFFER_OUT: u8 = 0x64;
const MAILBOX_IN: u8 = 0x22;
const MAILBOX_OUT: u8 = 0x26;

fn sm(control: u8, len: u8) -> SyncManager {
    let mut sm = SyncManager::default();
    assert!(sm.configure(&[0x00, 0x10, len, 0, control, 0, 1, 0]));
    sm
}

/// Performs one access in a frame. Returns the address of its first byte.
fn frame(sm: &mut SyncManager, filled: BufferOwner, offset: usize, len: usize) -> Option<usize> {
    let (_, place) = sm.access(filled, offset, len, MEMORY);
    sm.end_frame();
    place
}

#[test]
fn full_mailbox_rejects_writes_until_the_device_has_fetched_it() {
    let mut sm = sm(MAILBOX_OUT, 0x30);
    assert_eq!(frame(&mut sm, BufferOwner::ByDevice, 0, 0x30), None);
    assert_eq!(
        frame(&mut sm, BufferOwner::ByMainDevice, 0, 0x30),
        Some(0x1000),
        "empty"
    );
    assert_eq!(sm.status(), 0x09, "full, written");
    assert!(sm.device_event() && !sm.main_device_event());
    assert_eq!(frame(&mut sm, BufferOwner::ByMainDevice, 0, 0x30), None);
    sm.full = false;
    sm.note_full();
    assert_eq!(sm.status(), 0x02, "empty, read");
    assert!(frame(&mut sm, BufferOwner::ByMainDevice, 0, 0x30).is_some());
}

#[test]
fn mailbox_is_read_once_and_only_when_full() {
    let mut sm = sm(MAILBOX_IN, 0x30);
    assert_eq!(frame(&mut sm, BufferOwner::ByDevice, 0, 0x30), None);
    sm.full = true;
    sm.note_full();
    assert_eq!(sm.status(), 0x09);
    assert!(frame(&mut sm, BufferOwner::ByDevice, 0, 0x30).is_some());
    assert_eq!(sm.status(), 0x02);
    assert_eq!(frame(&mut sm, BufferOwner::ByDevice, 0, 0x30), None);
}

#[test]
fn access_begins_with_the_first_byte_and_ends_with_the_last() {
    for control in [MAILBOX_OUT, BUFFER_OUT] {
        let mut sm = sm(control, 0x30);
        let mut write = |offset, len| frame(&mut sm, BufferOwner::ByMainDevice, offset, len);
        assert_eq!(write(0x2f, 1), None, "not opened");
        assert_eq!(write(0, 0x10), Some(0x1000));
        assert_eq!(write(4, 4), Some(0x1004), "any byte once it is open");
        assert_eq!(write(0, 1), Some(0x1000), "the first again");
        assert_eq!(write(0x2f, 1), Some(0x102f));
        assert_eq!(write(0x2f, 1), None, "closed again");
    }
}

#[test]
fn last_byte_is_accessed_once_in_a_frame() {
    let mut sm = sm(BUFFER_OUT, 4);
    let place = |sm: &mut SyncManager, offset, len| {
        sm.access(BufferOwner::ByMainDevice, offset, len, MEMORY)
    };
    assert_eq!(place(&mut sm, 0, 4), (4, Some(0x1000)));
    assert_eq!(place(&mut sm, 0, 4), (3, Some(0x1000)));
    assert_eq!(place(&mut sm, 3, 1), (1, None));
    assert!(sm.end_frame());
    assert_eq!(place(&mut sm, 0, 4), (4, Some(0x1004)));
}

#[test]
fn three_buffers_never_mix_old_and_new() {
    let mut sm = sm(BUFFER_IN, 4);
    assert_eq!(
        frame(&mut sm, BufferOwner::ByDevice, 0, 4),
        None,
        "nothing written"
    );
    assert_eq!(sm.status(), 0x30);
    assert_eq!(sm.device_writes_at(MEMORY), 0x1000);
    sm.device_wrote();
    assert_eq!(sm.status(), 0x01, "first buffer, written");
    // The read opens the first buffer. Two device writes meanwhile go to other buffers.
    assert_eq!(frame(&mut sm, BufferOwner::ByDevice, 0, 2), Some(0x1000));
    assert_eq!(sm.status(), 0x40, "read buffer in use");
    for _ in 0..2 {
        assert_ne!(sm.device_writes_at(MEMORY), 0x1000);
        sm.device_wrote();
    }
    let newest = sm.latest_at(MEMORY);
    assert_eq!(frame(&mut sm, BufferOwner::ByDevice, 2, 2), Some(0x1002));
    assert_eq!(frame(&mut sm, BufferOwner::ByDevice, 0, 4), Some(newest));
    assert_eq!(frame(&mut sm, BufferOwner::ByDevice, 0, 4), Some(newest));
}

#[test]
fn device_reads_outputs_only_when_they_are_complete() {
    let mut sm = sm(BUFFER_OUT, 4);
    frame(&mut sm, BufferOwner::ByMainDevice, 0, 4);
    assert!(sm.has_data() && sm.device_event());
    let complete = sm.device_reads_at(MEMORY);
    assert!(!sm.device_event());
    let place = frame(&mut sm, BufferOwner::ByMainDevice, 0, 2);
    assert_ne!(place, Some(complete));
    assert_eq!(sm.device_reads_at(MEMORY), complete);
}

#[test]
fn single_byte_passes_in_both_directions_and_raises_events() {
    let mut sm = sm(BUFFER_OUT, 1);
    assert_eq!(
        sm.access(BufferOwner::ByDevice, 0, 1, MEMORY),
        (1, Some(0x1000))
    );
    assert!(!sm.end_frame());
    for _ in 0..2 {
        assert_eq!(
            sm.access(BufferOwner::ByMainDevice, 0, 1, MEMORY),
            (1, Some(0x1000))
        );
    }
    assert!(sm.end_frame(), "the watchdog wants to know");
}

#[test]
fn closed_sm_rejects_accesses_and_is_empty_after_opening() {
    for control in [BUFFER_OUT, MAILBOX_OUT] {
        let mut sm = sm(control, 4);
        frame(&mut sm, BufferOwner::ByMainDevice, 0, 4);
        sm.close(true);
        assert!(sm.guards());
        assert_eq!(frame(&mut sm, BufferOwner::ByMainDevice, 0, 4), None);
        assert_eq!(frame(&mut sm, BufferOwner::ByDevice, 0, 4), None);
        sm.close(false);
        assert!(!sm.has_data() && !sm.full);
        assert!(frame(&mut sm, BufferOwner::ByMainDevice, 0, 4).is_some());
    }
}

#[test]
fn enabled_sm_keeps_its_area_until_disabled() {
    let mut sm = sm(0x64, 0x30);
    sm.configure(&[0x00, 0x20, 0x10, 0, 0x20, 0, 1, 0]);
    assert_eq!((sm.start, sm.watchdog), (0x1000, true));
    assert!(sm.configure(&[0x00, 0x20, 0x10, 0, 0x20, 0, 0, 0]));
    assert!(!sm.guards(), "disabled: plain memory");
    sm.configure(&[0x00, 0x20, 0x10, 0, 0x20, 0, 1, 0]);
    assert_eq!((sm.start, sm.watchdog), (0x2000, false));
    assert!(!SyncManager::default().guards());
}

#[test]
fn reserved_modes_reject_every_access() {
    for control in [0x01, 0x03, 0x05] {
        let mut sm = sm(control, 4);
        assert_eq!(frame(&mut sm, BufferOwner::ByDevice, 0, 4), None);
        assert_eq!(frame(&mut sm, BufferOwner::ByMainDevice, 0, 4), None);
    }
}
