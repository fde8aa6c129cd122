use proptest::prelude::*;

use super::super::TableRate;
use super::super::test_support::Sequence;
use super::*;

const DT: f64 = 0.001;

const LIMITS: MotionLimits = MotionLimits {
    velocity: 200.0,
    acceleration: 2000.0,
    jerk: 40_000.0,
};

const UP_AND_DOWN: &str = "\u{feff}time; position
# two seconds up
0; 0
1; 5
2; 10   # top

3; 5
4; 0
";

fn run(table: &Table) -> (u32, Motion) {
    let start = Motion::at(table.ends()[0]);
    let mut playback = Playback::new(table, start, LIMITS, 0.0).unwrap();
    let mut sequence = Sequence::from(start, LIMITS, DT);
    let mut cycles = 0;
    while !playback.finished(sequence.motion) {
        let next = playback
            .with_table(table)
            .advance(sequence.motion, Rate::WHOLE, DT);
        sequence.then(next).unwrap();
        cycles += 1;
    }
    assert!(!playback.interrupted());
    (cycles, sequence.motion)
}

#[test]
fn table_is_parsed_and_followed() {
    let table = Table::parse(UP_AND_DOWN, Interpolation::Cubic).unwrap();
    assert_eq!(
        (table.len(), table.duration_s(), table.ends()),
        (5, 4.0, [0.0, 0.0])
    );
    table.check(LIMITS, Some([0.0, 10.0]), 0.0, DT).unwrap();
    let (cycles, end) = run(&table);
    assert!((4000..=4001).contains(&cycles), "{cycles}");
    assert!(end.stands_at(0.0));
    // Blanks, velocities, no heading.
    let table = Table::parse("0 0 0\n0.5\t10  40 \n1 20 0", Interpolation::Cubic).unwrap();
    table.check(LIMITS, None, 0.0, DT).unwrap();
    assert!(run(&table).1.stands_at(20.0));
    let slow = Table::parse("t,p\n0,0\n1,1\n2,2.0e0\n", Interpolation::Linear).unwrap();
    slow.check(LIMITS, None, 5.0, DT).unwrap();
    assert!(run(&slow).1.stands_at(2.0));
}

#[test]
fn errors_name_their_line() {
    for (text, line, what) in [
        ("", 1, "a table needs two rows"),
        ("time,position\n0,0\n", 2, "a table needs two rows"),
        ("0,0\n1,x\n", 2, "`x` is not a number"),
        ("0,0\n\n# remark\n1;2;3;4\n", 4, "4 columns"),
        ("0,0\n1\n", 2, "1 columns"),
        ("0,0\n1,\n", 2, "`` is not a number"),
        ("a,b\nc,d\n", 2, "`c` is not a number"),
        ("0,0\n1,0,0\n", 2, "3 columns"),
        ("0,0\n1,1\n1,2\n", 3, "time 1 s does not come after 1 s"),
        ("0,0\n1,NaN\n", 2, "position is NaN"),
        ("0,0\n1,inf\n", 2, "position is inf"),
        ("0,0\n1e300,1\n", 2, "time is 1e300"),
    ] {
        let error = Table::parse(text, Interpolation::Linear).unwrap_err();
        assert_eq!(error.line, line, "{text:?}");
        assert!(error.to_string().contains(what), "{text:?}: {error}");
    }
}

#[test]
fn the_whole_table_is_checked_before_the_first_cycle() {
    for (text, interpolation, line, what) in [
        (
            "0,0\n1,1\n1.01,4\n2,4",
            Interpolation::Linear,
            3,
            "acceleration",
        ),
        (
            "0,0,0\n1,5,0\n1.02,9.5,0\n2,9.5,0",
            Interpolation::Cubic,
            3,
            "velocity",
        ),
        ("0,0,0\n1,49,90\n2,49,0", Interpolation::Cubic, 2, "range"),
        ("0,0,0\n1,51,0\n2,49,0", Interpolation::Cubic, 2, "range"),
        ("0,0,1\n1,1,0", Interpolation::Cubic, 1, "stand still"),
        ("0,0,0\n1,1,1", Interpolation::Cubic, 2, "stand still"),
        ("0,0\n1,3\n", Interpolation::Linear, 1, "acceleration"),
        (
            "0,0\n0.0004,0\n",
            Interpolation::Linear,
            2,
            "less than a cycle",
        ),
    ] {
        let table = Table::parse(text, interpolation).unwrap();
        let error = table
            .check(LIMITS, Some([-50.0, 50.0]), 0.0, DT)
            .expect_err(text);
        assert_eq!(error.line, line, "{text:?}: {error}");
        assert!(error.to_string().contains(what), "{text:?}: {error}");
    }
    let table = Table::parse(UP_AND_DOWN, Interpolation::Cubic).unwrap();
    assert!(table.check(LIMITS, Some([0.0, 10.0]), 0.1, DT).is_err());
    assert!(
        table
            .check(LIMITS, Some([0.0, 10.0]), f64::NAN, DT)
            .is_err()
    );
    assert!(table.check(LIMITS.scaled(0.0), None, 0.0, DT).is_err());
}

#[test]
fn playback_starts_at_the_position_of_the_axis() {
    let table = Table::parse(UP_AND_DOWN, Interpolation::Cubic).unwrap();
    assert_eq!(
        Playback::new(&table, Motion::at(1.0), LIMITS, 0.0),
        Err(SetpointError::Elsewhere {
            at: 1.0,
            expected: 0.0
        })
    );
    assert!(Playback::new(&table, Motion::at(1.0), LIMITS, 1.0).is_ok());
    let moving = Motion {
        velocity: 1.0,
        ..Motion::at(0.0)
    };
    assert!(Playback::new(&table, moving, LIMITS, 0.0).is_err());
}

proptest! {
    /// A checked table keeps the limits in every cycle; after an interruption the axis stops within
    /// them.
    #[test]
    fn playback_keeps_the_limits(
        steps in prop::collection::vec((0.001..0.3f64, -1.0..1.0f64), 1..30), cubic in any::<bool>(),
        held_up in prop::option::of(0u32..2000),
    ) {
        let interpolation = if cubic { Interpolation::Cubic } else { Interpolation::Linear };
        let range = Some([-2.0, 2.0]);
        let table = |size: f64| {
            let mut text = String::from("0,0\n0.2,0\n");
            let mut time = 0.2;
            for (step, position) in &steps {
                time += step;
                text += &format!("{time},{}\n", position * size);
            }
            text += &format!("{}, 0", time + 0.2);
            Table::parse(&text, interpolation).unwrap()
        };
        // As large as allowed, within a factor of two.
        let mut size = 20.0;
        while table(size).check(LIMITS, range, 0.0, DT).is_err() {
            size /= 2.0;
            prop_assert!(size > 1e-9);
        }
        let table = table(size);
        let mut playback = Playback::new(&table, Motion::at(0.0), LIMITS, 0.0).unwrap();
        let mut sequence = Sequence::from(Motion::at(0.0), LIMITS, DT);
        for cycle in 0..20_000 {
            if held_up == Some(cycle) {
                sequence.hold_up();
            }
            let next = playback
                .with_table(&table)
                .advance(sequence.motion, Rate::WHOLE, DT);
            sequence.then(next)?;
            prop_assert!(next.position.abs() <= 2.0 + 1e-9);
            if playback.finished(next) {
                break;
            }
        }
        prop_assert!(playback.finished(sequence.motion));
        prop_assert!(playback.interrupted() || sequence.motion.stands_at(0.0));
    }

    #[test]
    fn any_text_is_parsed_or_rejected(text in "[-0-9eE.,; \t\n#a-zNI+]{0,200}", noise in ".{0,100}") {
        for text in [&text, &noise] {
            if let Ok(table) = Table::parse(text, Interpolation::Cubic)
                && table.check(LIMITS, None, 0.0, DT).is_ok()
            {
                prop_assert!(table.duration_s() > 0.0);
            }
        }
    }
}

proptest! {
    /// Two tables in step, with a rate that changes at any time: velocity and acceleration stay
    /// within the limits, both keep their common time, and both end exactly.
    #[test]
    fn rates_keep_the_limits_of_tables_and_their_common_time(
        ends in prop::collection::vec(-1.0..1.0f64, 2..8), scale in 0.3..2.0f64,
        rates in prop::collection::vec((prop_oneof![Just(0.0), 0.05..1.0f64], 1u32..300), 1..8),
    ) {
        // Rows in time with the distance, so that the tables use much of their limits.
        let rows = |factor: f64| {
            let mut text = String::from("0, 0, 0\n");
            for (index, end) in ends.iter().enumerate() {
                text += &format!("{}, {}, 0\n", 0.2 * (index + 1) as f64, end * factor * scale);
            }
            Table::parse(&text, Interpolation::Cubic).unwrap()
        };
        let tables = [rows(1.0), rows(-0.7)];
        let limits = MotionLimits { acceleration: 600.0, ..LIMITS };
        prop_assume!(tables.iter().all(|table| table.check(limits, None, 0.0, DT).is_ok()));
        let start = Motion::at(0.0);
        let mut players = [0, 1].map(|index| (Playback::new(&tables[index], start, limits, 0.0).unwrap(), start));
        let mut rate = TableRate::WHOLE;
        for (wanted, cycles) in rates.into_iter().chain([(0.0, 3000), (1.0, 20_000)]) {
            for _ in 0..cycles {
                let rate = rate.advance(Rate::new(wanted), DT, |course| {
                    players.iter().zip(&tables).all(|((play, _), table)| {
                        play.keeps(table, &limits, course, DT)
                    })
                });
                for ((play, motion), table) in players.iter_mut().zip(&tables) {
                    let next = play.with_table(table).advance(*motion, rate, DT);
                    let change = (next.velocity - motion.velocity).abs();
                    prop_assert!(change <= limits.acceleration * DT * (1.0 + 1e-9));
                    prop_assert!(next.velocity.abs() <= limits.velocity + 1e-9);
                    *motion = next;
                }
                let [(_, a), (_, b)] = players;
                prop_assert!((a.position * -0.7 - b.position).abs() <= 1e-9);
            }
            prop_assert!(wanted > 0.0 || cycles < 3000 || players.iter().all(|(_, motion)| motion.velocity == 0.0));
        }
        for ((play, motion), table) in players.iter().zip(&tables) {
            prop_assert!(play.finished(*motion) && motion.stands_at(table.ends()[1]));
        }
    }
}
