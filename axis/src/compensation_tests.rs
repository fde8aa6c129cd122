use super::*;

const LIMITS: Limits = Limits {
    position: Some([-100.0, 400.0]),
    velocity: 200.0,
    acceleration: 2000.0,
    jerk: None,
    torque: 100.0,
    following_error: None,
};

const ERRORS: &[[f64; 2]] = &[
    [0.0, 0.0],
    [50.0, 0.03],
    [100.0, -0.01],
    [180.0, 0.05],
    [300.0, 0.02],
];

fn table(errors: &[[f64; 2]]) -> Result<Compensation, CompensationError> {
    let mechanics = Mechanics {
        errors,
        ..Mechanics::default()
    };
    Compensation::new(&mechanics, &LIMITS)
}

/// The table as given, without rounded corners.
fn linear(errors: &[[f64; 2]], at: f64) -> f64 {
    let ends = [errors[0], errors[errors.len() - 1]];
    if at <= ends[0][0] {
        return ends[0][1];
    }
    for pair in errors.windows(2) {
        let [[from, a], [to, b]] = [pair[0], pair[1]];
        if at <= to {
            return a + (b - a) * (at - from) / (to - from);
        }
    }
    ends[1][1]
}

#[test]
fn the_table_is_linear_between_points_and_rounded_at_them() {
    let made = table(ERRORS).expect("a table");
    let mut farthest = 0.0_f64;
    for n in -2000..40_000 {
        let at = f64::from(n) * 0.01;
        let [error, slope] = made.error(at);
        farthest = farthest.max((error - linear(ERRORS, at)).abs());
        // Continuous, with the slope that it says.
        let [next, _] = made.error(at + 1e-4);
        assert!((next - error - slope * 1e-4).abs() < 1e-9, "{at}");
    }
    assert!(farthest > 0.0 && farthest < 8e-5, "{farthest}");
}

#[test]
fn the_inverse_is_exact() {
    let made = table(ERRORS).expect("a table");
    for n in -3000..50_000 {
        let load = f64::from(n) * 0.0077;
        let back = made.load(made.screw(load));
        assert!((back - load).abs() < 1e-10, "{load}: {back}");
    }
}

#[test]
fn a_table_of_a_period_repeats() {
    let mechanics = Mechanics {
        errors: &[[0.0, 0.01], [90.0, 0.2], [200.0, -0.2], [360.0, 0.01]],
        period: Some(360.0),
        ..Mechanics::default()
    };
    let made = Compensation::new(&mechanics, &LIMITS).expect("a table");
    for n in 0..3600 {
        let at = f64::from(n) * 0.1;
        let [a, _] = made.error(at);
        let [b, _] = made.error(at - 720.0);
        assert!((a - b).abs() < 1e-12);
        let [next, slope] = made.error(at + 0.1);
        assert!((next - a).abs() <= 0.1 * 0.006, "{at}");
        assert!(slope.abs() < 0.006);
    }
    let other = Mechanics {
        errors: &[[0.0, 0.01], [360.0, 0.02]],
        ..mechanics
    };
    let error = Compensation::new(&other, &LIMITS).expect_err("a step");
    assert_eq!(error, CompensationError::Period { period: 360.0 });
}

#[test]
fn wrong_tables_are_refused() {
    let text = |errors: &[[f64; 2]]| table(errors).expect_err("wrong").to_string();
    assert!(text(&[[0.0, 0.0]]).contains("2 to 100000 points"));
    assert!(text(&[[0.0, 0.0], [1.0, f64::NAN]]).contains("point 2 is not finite"));
    assert!(text(&[[0.0, 0.0], [0.0, 0.0]]).contains("does not come after 0"));
    assert!(text(&[[0.0, 0.0], [1.0, 0.1]]).contains("changes by 10.0 %"));
    assert!(text(&[[0.0, 0.0], [0.1, 0.001], [0.2, -0.001]]).contains("bends too much"));
    for backlash in [0.0, -0.1, f64::NAN, f64::INFINITY] {
        let mechanics = Mechanics {
            backlash: Some(backlash),
            ..Mechanics::default()
        };
        let error = Compensation::new(&mechanics, &LIMITS).expect_err("wrong");
        assert!(matches!(error, CompensationError::Backlash(_)));
    }
}

#[test]
fn the_load_leaves_shares_of_the_limits_to_the_correction() {
    let mechanics = Mechanics {
        errors: ERRORS,
        backlash: Some(0.05),
        ..Mechanics::default()
    };
    let made = Compensation::new(&mechanics, &LIMITS).expect("a correction");
    let load = made.load_limits(&LIMITS);
    assert!((load.velocity - 190.0 / 1.0008).abs() < 1e-9, "{load:?}");
    assert!((load.jerk() - 32_000.0 / 1.0008).abs() < 1e-6, "{load:?}");
    assert!(
        (load.acceleration - 1600.0 / 1.0008).abs() < 1e-9,
        "{load:?}"
    );
    assert_eq!(Compensation::default().load_limits(&LIMITS), LIMITS);
}
