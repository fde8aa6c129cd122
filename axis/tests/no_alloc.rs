//! Nothing an axis does in a cycle allocates: commands, refusals, faults and trips included.

mod common;

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use common::{DT, Rig};
use ecaxis_axis::{Command, Mode};

struct Counting;

thread_local! {
    static ALLOCATIONS: Cell<u64> = const { Cell::new(0) };
}

// SAFETY: every call is passed on unchanged to the system's allocator; counting touches only a const-initialised
// thread-local without a destructor, which does not allocate.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.with(|n| n.set(n.get() + 1));
        // SAFETY: the caller keeps the contract of `alloc`.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        // SAFETY: `at` came from `alloc` above, that is, from the system's allocator, with this layout.
        unsafe { System.dealloc(at, layout) }
    }
}

#[global_allocator]
static COUNTING: Counting = Counting;

#[test]
fn a_cycle_does_not_allocate() {
    let go = Command::MoveTo {
        position: 50.0,
        speed: 1.0,
        ramp: 1.0,
    };
    let mut rig = Rig::of(Mode::Csp);
    let before = ALLOCATIONS.with(Cell::get);
    let mut refused = 0;
    for round in 0..5000u32 {
        let command = match round % 1000 {
            1 => Some(Command::ResetFault),
            200 => Some(Command::Enable),
            230 => Some(go),
            500 => Some(Command::MoveTo {
                position: f64::NAN,
                speed: 1.0,
                ramp: 1.0,
            }),
            600 => Some(Command::Stop),
            900 => Some(go),
            _ => None,
        };
        refused += u32::from(command.is_some_and(|command| rig.axis.command(command).is_err()));
        if round % 1000 == 700 {
            rig.drive.blocked = round >= 3000;
        }
        if round % 1000 == 980 {
            rig.drive.fault();
        }
        let mut inputs = rig.drive.inputs();
        inputs.fresh = round % 7 != 0;
        rig.drive.cycle(&rig.out, DT);
        rig.out = rig.axis.step(&inputs, DT);
        let _ = rig.axis.status();
    }
    let allocations = ALLOCATIONS.with(Cell::get) - before;
    assert!(refused >= 5);
    assert_eq!(allocations, 0);
}
