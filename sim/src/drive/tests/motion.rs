//! The accuracy of the cyclic modes.

use super::*;
use crate::drive::objects::float;

/// A trapezoidal profile in turns: the position at a time, and the duration.
struct Trapezoid {
    distance: f64,
    speed: f64,
    acceleration: f64,
}

impl Trapezoid {
    fn duration(&self) -> f64 {
        self.distance / self.speed + self.speed / self.acceleration
    }

    fn at(&self, t: f64) -> f64 {
        let ramp = self.speed / self.acceleration;
        let rest = self.duration() - t;
        if t < ramp {
            0.5 * self.acceleration * t * t
        } else if rest > ramp {
            0.5 * self.speed * ramp + self.speed * (t - ramp)
        } else if rest > 0.0 {
            self.distance - 0.5 * self.acceleration * rest * rest
        } else {
            self.distance
        }
    }
}

const TRAPEZOID: Trapezoid = Trapezoid {
    distance: 10.0,
    speed: 25.0,
    acceleration: 150.0,
};

/// Runs the trapezoid in CSP, then half a second of rest. Returns the largest following error while
/// moving, and the range of the resting position relative to the target.
fn csp(rig: &mut Rig) -> (i64, i64, i64) {
    let start = rig.get(0x6064);
    let turn = f64::from(rig.counts_per_turn);
    let cycle = f64::from(u32::try_from(rig.cycle_ns).unwrap()) * 1e-9;
    let (mut worst, mut t) = (0, 0.0);
    while t < TRAPEZOID.duration() {
        t += cycle;
        #[expect(clippy::cast_possible_truncation)]
        let target = start + (turn * TRAPEZOID.at(t)).round() as i64;
        rig.set(0x607a, 0, target);
        rig.cycle();
        worst = worst.max(rig.get(0x60f4).abs());
    }
    let target = rig.get(0x607a);
    rig.run_ms(200);
    let (mut low, mut high) = (i64::MAX, i64::MIN);
    for _ in 0..500 {
        rig.cycle();
        let off = rig.get(0x6064) - target;
        (low, high) = (low.min(off), high.max(off));
    }
    assert_eq!(rig.drive.state(), State::OperationEnabled);
    assert_eq!(rig.word() & 0x3c00, 0x1000, "follows the command value");
    (worst, low, high)
}

#[test]
fn csp_follows_a_trapezoid_and_stands_still() {
    for (cycle_us, value, index) in [(250, 25, -5), (500, 5, -4), (1000, 1, -3), (2000, 2, -3)] {
        let mut rig = rig();
        rig.cycle_ns = cycle_us * 1000;
        rig.set(0x60c2, 1, value);
        rig.set(0x60c2, 2, index);
        rig.enable(8);
        for _ in 0..3 {
            let (worst, low, high) = csp(&mut rig);
            assert!(worst < 100, "{cycle_us} µs: {worst} counts");
            assert!(low >= -1 && high <= 1, "{cycle_us} µs: {low}..{high}");
        }
    }
}

#[test]
fn csp_holds_against_a_load() {
    let mut rig = rig();
    rig.enable(8);
    rig.drive.set_load_torque(0.05);
    rig.cycles(300);
    let (worst, low, high) = csp(&mut rig);
    assert!(
        worst < 100 && low >= -1 && high <= 1,
        "{worst} {low}..{high}"
    );
    assert!((rig.get(0x6077) - 422).abs() < 50, "{}", rig.get(0x6077));
}

#[test]
fn csp_stands_still_with_other_motors() {
    let default = PlantParams::default();
    let plants = [
        PlantParams {
            counts_per_turn: 131_072,
            ..default
        },
        PlantParams {
            counts_per_turn: 256,
            ..default
        },
        PlantParams {
            inertia: 2e-4,
            coulomb_friction: 0.02,
            ..default
        },
        PlantParams {
            inertia: 5e-6,
            coulomb_friction: 0.0,
            viscous_friction: 0.0,
            ..default
        },
    ];
    for plant in plants {
        let mut rig = Rig::new(plant);
        // The following error window is in counts, too.
        rig.set(0x6065, 0, i64::from(plant.counts_per_turn));
        rig.enable(8);
        let (worst, low, high) = csp(&mut rig);
        let bound = i64::from(plant.counts_per_turn) / 20;
        // Friction leaves a slow creep, below the resolution of a coarser encoder.
        let rest = (i64::from(plant.counts_per_turn) / 10_000).max(1);
        assert!(
            worst < bound && low >= -rest && high <= rest,
            "{worst} {low}..{high}"
        );
    }
}

#[test]
fn csp_positions_wrap_at_32_bits() {
    let mut rig = Rig::new(PlantParams {
        initial_position: i32::MAX - 100,
        ..PlantParams::default()
    });
    rig.enable(8);
    assert_eq!(rig.get(0x6064), i64::from(i32::MAX) - 100);
    for n in 0..50 {
        rig.set(0x607a, 0, i64::from(i32::MAX) - 100 + n * 10);
        rig.cycle();
    }
    rig.cycles(200);
    assert!((rig.get(0x6064) - i64::from(i32::MIN) - 389).abs() <= 1);
    assert_eq!(rig.drive.state(), State::OperationEnabled);
}

#[test]
fn csv_reaches_its_speed() {
    let mut rig = rig();
    rig.enable(9);
    for rpm in [1500, -3000, 60, 0] {
        rig.set(0x60ff, 0, rpm);
        rig.cycles(400);
        let wanted = f64::from(i32::try_from(rpm).unwrap()) / 60.0;
        let mut worst: f64 = 0.0;
        for _ in 0..100 {
            rig.cycle();
            worst = worst.max((rig.drive.velocity_rev_s() - wanted).abs());
        }
        assert!(worst <= 0.01 * wanted.abs().max(2.0), "{rpm} rpm: {worst}");
        assert!((rig.get(0x606c) - rpm).abs() <= 2 + rpm.abs() / 100);
    }
}

#[test]
fn velocity_units_follow_0x60a9() {
    for (code, value) in [
        (0x00b4_4700, 600),
        (0xfdb4_4700, 600_000),
        (0x00b5_0300, 20_000),
    ] {
        let mut rig = rig();
        rig.set(0x60a9, 0, code);
        rig.enable(9);
        rig.set(0x60ff, 0, value);
        rig.cycles(300);
        assert!((rig.drive.velocity_rev_s() - 10.0).abs() < 0.1, "{code:x}");
        assert!((rig.get(0x606c) - value).abs() * 100 < value, "{code:x}");
    }
}

#[test]
fn cst_accelerates_against_friction_to_a_bounded_speed() {
    let mut rig = rig();
    rig.enable(10);
    rig.set(0x6071, 0, 20);
    rig.cycles(500);
    assert_eq!(rig.drive.velocity_rev_s(), 0.0, "friction is more");
    rig.set(0x6071, 0, 80);
    rig.cycles(100);
    assert!((rig.get(0x6077) - 80).abs() <= 1);
    let early = rig.drive.velocity_rev_s();
    rig.cycles(20_000);
    let late = rig.drive.velocity_rev_s();
    // (80 ‰ of 118.4 mN·m − 4 mN·m) / 20 µN·m·s
    assert!(early > 1.0 && (late - 43.5).abs() < 1.0);

    rig.set(0x6071, 0, 1000);
    rig.cycles(5_000);
    let fast = rig.drive.velocity_rev_s();
    assert!(fast < 100.5 && fast > 90.0, "0x6080 bounds it: {fast}");
    assert_ne!(rig.word() & 1 << 11, 0, "internal limit");
}

#[test]
fn drive_runs_are_reproducible_to_the_bit() {
    let run = || {
        let mut rig = rig();
        rig.enable(8);
        csp(&mut rig);
        rig.drive.velocity_rev_s().to_bits() ^ rig.get(0x6077).unsigned_abs()
    };
    assert_eq!(run(), run());
}

/// Returns the speed after 0.3 s, in rev/s: CSV at 10 rev/s with these limits on a drive with
/// 0x6072.
fn speed_with(max_torque: i64, max_speed: i64, mapped: &[u16]) -> f64 {
    let mut store = ObjectStore::default();
    for unit in [0x60a9, 0x60aa] {
        store.ensure(unit, 0, "SI unit", 32, Access::default(), &[]);
    }
    store.ensure(0x6072, 0, "Max torque", 16, Access::default(), &[]);
    let mut rig = rig();
    rig.drive = Drive::new(&mut store, PlantParams::default());
    rig.store = store;
    let slots: Vec<EntryHandle> = mapped.iter().map(|index| rig.slot(*index, 0)).collect();
    rig.drive.set_mapped(&slots);
    rig.set(0x60c2, 1, 1);
    rig.set(0x6065, 0, 0xffff_ffff);
    rig.enable(9);
    rig.set(0x6072, 0, max_torque);
    rig.set(0x6080, 0, max_speed);
    rig.set(0x60ff, 0, 600);
    rig.run_ms(300);
    rig.drive.velocity_rev_s()
}

#[test]
fn limits_of_zero_act_only_if_mapped() {
    let moves = |speed: f64| (speed - 10.0).abs() < 0.1;
    assert!(moves(speed_with(0, 0, &[])));
    assert!(moves(speed_with(1000, 6000, &[0x6072, 0x6080])));
    assert!(moves(speed_with(0, 6000, &[0x6080])));
    assert!(moves(speed_with(1000, 0, &[0x6072])));
    assert_eq!(speed_with(0, 6000, &[0x6072]), 0.0);
    assert!(speed_with(1000, 0, &[0x6080]).abs() < 0.01);
    // A limit below the target, mapped or not.
    for mapped in [&[][..], &[0x6080]] {
        assert!((speed_with(0, 300, mapped) - 5.0).abs() < 0.1);
    }
}

/// A mapped limit changes with the process data, not with the drive's background task.
#[test]
fn mapped_torque_limit_acts_in_the_next_control_cycle() {
    let mut store = ObjectStore::default();
    let limit = store.ensure(0x6072, 0, "Max torque", 16, Access::default(), &[]);
    let mut drive = Drive::new(&mut store, PlantParams::default());
    drive.set_mapped(&[limit]);
    for permille in [1000, 0, 500] {
        store.set(limit, permille);
        drive.sync(&store);
        drive.control(&mut store, true);
        let expected = 3.2e-3 * float(permille);
        assert!((drive.parameters.current.forward - expected).abs() < 1e-3);
    }
}

/// 0x6072, 0x6073, 0x60E0, 0x60E1: the torque on a blocked shaft, with 118.4 mN·m and 3.2 A rated.
#[test]
fn torque_and_current_limits_act_in_their_direction() {
    let objects = [
        (0x6072, 0, 16, "Max torque"),
        (0x6073, 0, 16, "Max current"),
        (0x60e0, 0, 16, "Positive torque limit value"),
        (0x60e1, 0, 16, "Negative torque limit value"),
    ];
    // Limits as written; torque upwards and downwards.
    let rows = [
        ([0, 0, 0, 0], 2000, -2000),
        ([1500, 0, 0, 0], 1500, -1500),
        ([0, 1200, 0, 0], 1200, -1200),
        ([0, 0, 800, 0], 800, -2000),
        ([0, 0, 0, 700], 2000, -700),
        ([500, 1200, 800, 300], 500, -300),
    ];
    for (limits, up, down) in rows {
        let mut rig = Rig::with(PlantParams::default(), &objects);
        for ((index, ..), limit) in objects.iter().zip(limits) {
            rig.set(*index, 0, limit);
        }
        for mode in [9, 10] {
            rig.enable(mode);
            rig.drive.set_blocked(true);
            for (torque, expected) in [(2000, up), (-2000, down)] {
                rig.set(0x6071, 0, torque);
                rig.set(0x60ff, 0, 3 * torque);
                rig.run_ms(40);
                let actual = rig.get(0x6077);
                let limited = rig.word() & 1 << 11 != 0;
                if mode == 10 {
                    assert!((actual - expected).abs() <= 5, "{limits:?}: {actual}");
                    assert_eq!(limited, expected != torque, "{limits:?}");
                } else if expected != torque {
                    assert!((actual - expected).abs() <= 5, "{limits:?}: {actual}");
                    assert!(limited, "{limits:?}");
                }
            }
        }
    }
}
