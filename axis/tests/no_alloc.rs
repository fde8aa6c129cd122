//! The cycle of an axis allocates nothing, including commands, rejections, faults and trips.

use crate::common::{DT, Rig};
use crate::counting::allocations;
use ecaxis_axis::{Command, Mode};

#[test]
fn a_cycle_does_not_allocate() {
    let go = Command::MoveTo {
        position: 50.0,
        speed: 1.0,
        ramp: 1.0,
    };
    let mut rig = Rig::of(Mode::Csp);
    let before = allocations();
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
    let allocations = allocations() - before;
    assert!(refused >= 5);
    assert_eq!(allocations, 0);
}
