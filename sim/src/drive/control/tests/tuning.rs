//! Gains written during operation.

use proptest::prelude::*;

use super::*;

const GAINS: [(u16, u8); 4] = [(0x30a0, 2), (0x30a1, 5), (0x30a2, 5), (0x30a3, 5)];

#[test]
fn gains_written_in_operation_act_within_10_ms() {
    let mut rig = Rig::new(PlantParams::default());
    rig.enable(8);
    rig.drive.set_load_torque(0.03);
    rig.run_ms(300);
    let asked = |rig: &Rig| rig.drive.controller.current_demand();
    let holding = asked(&rig);
    assert!((holding - 0.03 / 37e-3).abs() < 0.15, "{holding}");
    // Without P, I and D only the integral remains, and it no longer changes.
    for sub in [1, 2, 3] {
        rig.set(0x30a1, sub, 0);
    }
    rig.run_ms(11);
    rig.drive.set_load_torque(0.2);
    let left = asked(&rig);
    rig.run_ms(20);
    assert_eq!(asked(&rig), left);
    assert!(rig.get(0x6064) < -100, "nothing holds it");
}

/// Runs a move with these gains: every value stays finite. With good gains the drive then works
/// again.
fn survives(values: &[u32], mode: i64, structure: i64) -> Result<(), TestCaseError> {
    let mut rig = Rig::new(PlantParams::default());
    rig.set(0x6065, 0, 0xffff_ffff);
    rig.enable(mode);
    rig.set(0x3000, 2, structure);
    let all = GAINS
        .iter()
        .flat_map(|&(index, subs)| (1..=subs).map(move |sub| (index, sub)));
    for ((index, sub), value) in all.zip(values) {
        rig.set(index, sub, i64::from(*value));
    }
    rig.set(0x607a, 0, 100_000);
    rig.set(0x60ff, 0, 3000);
    rig.set(0x6071, 0, 500);
    rig.run_ms(100);
    let c = &rig.drive.controller;
    for value in [
        rig.drive.plant.velocity(),
        rig.drive.plant.current(),
        c.velocity(),
        c.averaged_velocity(),
        c.current_demand(),
        c.thermal_level(),
    ] {
        prop_assert!(value.is_finite());
    }
    // With good gains again, the drive must recover.
    let tuned = Rig::new(PlantParams::default());
    for (index, subs) in GAINS {
        for sub in 1..=subs {
            let value = tuned.store.get(tuned.slot(index, sub));
            rig.set(index, sub, value);
        }
    }
    rig.set(0x6040, 0, 0);
    rig.run_ms(3000);
    rig.enable(9);
    rig.set(0x60ff, 0, 600);
    rig.run_ms(1500);
    let speed = rig.drive.velocity_rev_s();
    prop_assert!((speed - 10.0).abs() < 0.5, "{}", speed);
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]

    #[test]
    fn drive_survives_any_gains(
        values in proptest::collection::vec(
            prop_oneof![Just(0), Just(1), Just(u32::MAX), any::<u32>(), 0..100_000_u32],
            17,
        ),
        mode in prop_oneof![Just(8_i64), Just(9), Just(10)],
        observed in any::<bool>(),
    ) {
        survives(&values, mode, structure(observed))?;
    }
}

/// Plant parameters, plausible or not.
fn number() -> impl Strategy<Value = f64> {
    prop_oneof![
        Just(0.0),
        Just(-1.0),
        Just(f64::NAN),
        Just(f64::INFINITY),
        1e-9..1e-3,
        1e-3..1e3,
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(60))]

    /// Impossible motors do not end the simulation.
    #[test]
    fn drive_survives_any_plant(
        n in proptest::collection::vec(number(), 10),
        counts_per_turn in prop_oneof![Just(0), Just(1), Just(u32::MAX), 16..100_000_u32],
        initial_position in any::<i32>(),
        mode in prop_oneof![Just(1_i64), Just(3), Just(8), Just(9), Just(10)],
        observed in any::<bool>(),
    ) {
        let mut rig = Rig::new(PlantParams {
            counts_per_turn,
            initial_position,
            inertia: n[0],
            viscous_friction: n[1],
            coulomb_friction: n[2],
            load_torque: n[3],
            torque_constant: n[4],
            resistance: n[5],
            inductance: n[6],
            supply_voltage: n[7],
            nominal_current: n[8],
            current_limit: n[9],
            ..PlantParams::default()
        });
        rig.set(0x3000, 2, structure(observed));
        rig.set(0x6060, 0, mode);
        for word in [0x06, 0x0f, 0x1f] {
            rig.set(0x6040, 0, word);
            rig.set(0x607a, 0, 100_000);
            rig.set(0x60ff, 0, 3000);
            rig.set(0x6071, 0, 500);
            rig.run_ms(20);
        }
    }
}
