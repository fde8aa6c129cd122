//! Random writes to a drive's objects: no panic, and the position stays finite.

use proptest::prelude::*;

use super::*;

/// Every object that the drive reads.
const OBJECTS: [(u16, u8); 52] = [
    (0x6007, 0),
    (0x6040, 0),
    (0x605a, 0),
    (0x605b, 0),
    (0x605c, 0),
    (0x605d, 0),
    (0x605e, 0),
    (0x6060, 0),
    (0x6065, 0),
    (0x6066, 0),
    (0x6067, 0),
    (0x6068, 0),
    (0x606d, 0),
    (0x606e, 0),
    (0x606f, 0),
    (0x6070, 0),
    (0x6071, 0),
    (0x6072, 0),
    (0x6073, 0),
    (0x6076, 0),
    (0x607a, 0),
    (0x607b, 1),
    (0x607b, 2),
    (0x607c, 0),
    (0x607d, 1),
    (0x607d, 2),
    (0x607f, 0),
    (0x6080, 0),
    (0x6081, 0),
    (0x6083, 0),
    (0x6084, 0),
    (0x6085, 0),
    (0x6098, 0),
    (0x6099, 1),
    (0x6099, 2),
    (0x609a, 0),
    (0x60a9, 0),
    (0x60aa, 0),
    (0x60b0, 0),
    (0x60b1, 0),
    (0x60b2, 0),
    (0x60b8, 0),
    (0x60c2, 1),
    (0x60c2, 2),
    (0x60c5, 0),
    (0x60d0, 1),
    (0x60e0, 0),
    (0x60e1, 0),
    (0x60f8, 0),
    (0x60fe, 1),
    (0x60fe, 2),
    (0x60ff, 0),
];

const RESULTS: [u16; 5] = [0x60b9, 0x60ba, 0x60bb, 0x60bc, 0x60bd];

/// Returns a drive on a dictionary in which every object has this length and sign.
fn rig_of(bits: u32, signed: bool) -> Rig {
    let mut rig = rig();
    rig.store = ObjectStore::default();
    let results = RESULTS.map(|index| (index, 0));
    for (index, sub) in OBJECTS.into_iter().chain(results) {
        let item = ecaxis_esi::model::ObjectItem {
            sub,
            type_name: if signed { "LINT" } else { "ULINT" }.into(),
            bit_len: bits,
            ..Default::default()
        };
        rig.store
            .ensure(index, sub, "object", item.bit_len, item.access, &[]);
    }
    rig.drive = Drive::new(
        &mut rig.store,
        PlantParams {
            track: Track {
                negative_limit: Some(-3000),
                positive_limit: Some(3000),
                home: Some((500, 600)),
                probes: [Some((100, 120)), None],
                index: Some(77),
                ends: Some((-4000, 4000)),
                normally_closed: 0,
            },
            ..PlantParams::default()
        },
    );
    rig
}

fn value() -> impl Strategy<Value = i64> {
    prop_oneof![
        3 => -3_i64..=40,
        2 => -100_000_i64..=100_000,
        1 => any::<i64>(),
        1 => prop::sample::select(vec![
            i64::MIN, i64::MAX, i64::from(i32::MIN), i64::from(i32::MAX), 0x7f00_0000, 0x8000_0000, 0xffff_ffff, 0x7fb4_0300,
        ]),
    ]
}

/// One step of a MainDevice: an object or a valid Controlword, then some cycles.
#[derive(Debug, Clone)]
enum Step {
    Write(usize, i64),
    Control(i64),
    Mode(i64),
    Input(u8, bool),
    Op(bool),
    Blocked(bool),
}

fn step() -> impl Strategy<Value = Step> {
    prop_oneof![
        6 => (0..OBJECTS.len(), value()).prop_map(|(object, value)| Step::Write(object, value)),
        5 => prop::sample::select(vec![0x06, 0x07, 0x0f, 0x1f, 0x3f, 0x5f, 0x10f, 0x0b, 0x00, 0x80, 0x21f])
            .prop_map(Step::Control),
        2 => prop::sample::select(vec![1, 3, 6, 8, 9, 10]).prop_map(Step::Mode),
        1 => (0_u8..40, any::<bool>()).prop_map(|(bit, on)| Step::Input(bit, on)),
        1 => prop::bool::weighted(0.8).prop_map(Step::Op),
        1 => any::<bool>().prop_map(Step::Blocked),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    #[test]
    fn drive_survives_any_object_value(
        bits in prop::sample::select(vec![8, 16, 32, 64]),
        signed in any::<bool>(),
        mode in prop::sample::select(vec![1, 3, 6, 8, 9, 10]),
        steps in prop::collection::vec((step(), 0_u32..20), 1..60),
    ) {
        let mut rig = rig_of(bits, signed);
        rig.set(0x6060, 0, mode);
        rig.cycles(10);
        for word in [0x06, 0x07, 0x0f] {
            rig.set(0x6040, 0, word);
            rig.cycles(10);
        }
        prop_assert_eq!(rig.drive.state(), State::OperationEnabled);
        for (step, cycles) in steps {
            match step {
                Step::Write(object, value) => {
                    let (index, sub) = OBJECTS[object];
                    rig.set(index, sub, value);
                }
                Step::Control(word) => rig.set(0x6040, 0, word),
                Step::Mode(mode) => rig.set(0x6060, 0, mode),
                Step::Input(bit, on) => rig.drive.set_input(bit, on, 0.5),
                Step::Op(on) => rig.in_op = on,
                Step::Blocked(on) => rig.drive.set_blocked(on),
            }
            rig.cycles(cycles);
            prop_assert!(rig.drive.velocity_rev_s().is_finite());
            let counts = rig.drive.plant.counts();
            prop_assert!((-4000..=4000).contains(&counts), "{counts}");
            while rig.drive.take_emergency().is_some() {}
        }
    }
}
