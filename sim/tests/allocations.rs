//! A cycle allocates nothing: frames, SYNC0, process data, drives.

mod common;

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use common::*;
use ecaxis_esi::model::Device;
use ecaxis_sim::Transit;
use ecaxis_sim::frame::FrameBuilder;

struct Counting;

thread_local! {
    static COUNT: Cell<Option<u64>> = const { Cell::new(None) };
}

fn count() {
    COUNT.with(|c| c.set(c.get().map(|n| n + 1)));
}

// SAFETY: passes everything on to the system allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count();
        // SAFETY: the caller's promises are passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        count();
        // SAFETY: the caller's promises are passed on.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Makes a drive of the device: the drive creates the objects it needs itself.
fn as_drive(mut device: Device) -> Device {
    device.profile = Some(402);
    device
}

#[test]
fn cycling_does_not_allocate() {
    let mut bus = Bus::new(vec![sim(&as_drive(coe_device())), sim(&coe_device())]);
    bus.address_all();
    for (station, logical) in [(0x1001, 0), (0x1002, 16)] {
        bus.preop(station);
        bus.sm(station, 2, 0x1100, 4, 0x64);
        bus.sm(station, 3, 0x1200, 4, 0x20);
        bus.fmmu(station, 0, logical, 4, 0x1100, 2);
        bus.fmmu(station, 1, logical, 4, 0x1200, 1);
        bus.write(station, 0x9a0, &1_000_000_u32.to_le_bytes());
        let now = bus.segment.device(0).unwrap().system_time(bus.now).unwrap();
        bus.write(station, 0x990, &(now + 10_000_000).to_le_bytes());
        bus.write(station, 0x980, &[0, 3]);
        bus.to(station, SAFEOP);
        bus.request(station, 8);
    }
    bus.wait(20_000_000);
    let template = FrameBuilder::default()
        .datagram(14, 0x1001, 0x910, &[0; 8])
        .logical(12, 0, &[0; 32])
        .datagram(7, 0, 0x130, &[0; 2])
        .build();
    let mut bytes = template.clone();
    COUNT.with(|c| c.set(Some(0)));
    for n in 1..2_000 {
        bytes.copy_from_slice(&template);
        let result = bus.segment.transit(&mut bytes, bus.now + n * 1_000_000);
        if result == Transit::Lost {
            break;
        }
    }
    let allocations = COUNT.with(|c| c.replace(None));
    assert_eq!(allocations, Some(0));
    assert_eq!(bytes[bytes.len() - 2..], [2, 0], "both answered to the end");
    assert_eq!(bytes[bytes.len() - 4], 8, "both in Op");
}
