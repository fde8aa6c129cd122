//! Cams against their closed form, from the set-points of both axes in the same frame. Virtual time.

use std::path::Path;

use ecaxis_test_support::recordings::process_images;
use ecaxis_test_support::{
    assert_contains, faults, load, machine, recorded, run_badly, run_well, virtual_time,
};

/// An axis has 12 bytes out and 13 bytes in, at the same place of the image.
const REGION: usize = 13;
const COUNTS: f64 = 131_072.0;

fn text(cam: &str, steps: &str) -> String {
    let mut text = String::from("[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n");
    for (position, (name, velocity, acceleration)) in
        [("x", 10.0, 80.0), ("y", 30.0, 500.0)].iter().enumerate()
    {
        text += &format!(
            "[[device]]\nname = \"{name}\"\nesi = \"esi/SV1.xml\"\nposition = {position}\nmode = \"csp\"\n[device.axis]\nencoder = {COUNTS}\n\
             limits = {{ velocity = {velocity:.1}, acceleration = {acceleration:.1}, torque = 100.0, following_error = 4.0 }}\n"
        );
    }
    text + cam + steps
}

/// Returns the targets of both axes in every cycle in which both have power, in counts.
fn targets(recording: &Path) -> Vec<[i64; 2]> {
    let images = process_images(recording).into_iter();
    let images = images.filter(|(out, _)| out.len() >= 2 * REGION - 1);
    let axis = |out: &[u8], at: usize| {
        let word = u16::from_le_bytes([out[at], out[at + 1]]);
        let target = [out[at + 2], out[at + 3], out[at + 4], out[at + 5]];
        (word == 0x000f).then_some(i64::from(i32::from_le_bytes(target)))
    };
    let both = images.filter_map(|(out, _)| Some([axis(&out, 0)?, axis(&out, REGION)?]));
    both.collect()
}

/// The law 3-4-5 (VDI 2143).
fn law345(z: f64) -> f64 {
    z * z * z * (10.0 + z * (-15.0 + 6.0 * z))
}

/// The law 4-5-6-7.
fn law4567(z: f64) -> f64 {
    z * z * z * z * (35.0 + z * (-84.0 + z * (70.0 - 20.0 * z)))
}

/// Rest to rest by `law`: 2 turns of the follower from 1 to 5 of 8 turns of the master, and back
/// from 5 to 7.
fn closed_form(x: f64, law: fn(f64) -> f64) -> f64 {
    let at = x.rem_euclid(8.0);
    match at {
        _ if at < 1.0 => 0.0,
        _ if at < 5.0 => 2.0 * law((at - 1.0) / 4.0),
        _ if at < 7.0 => 2.0 - 2.0 * law((at - 5.0) / 2.0),
        _ => 0.0,
    }
}

const MOVES: &str = "[[step]]\nmove = { x = 30.0 }\n[[step]]\nvelocity = { x = -8.0 }\n[[step]]\nwait = { x.position = { below = -20.0 } }\n\
    [[step]]\nvelocity = { x = 6.5 }\nramp = 0.2\n[[step]]\nwait = { x.position = { above = 3.0 } }\n[[step]]\nmove = { x = 0.25 }\n";

#[test]
fn followers_are_on_their_cam_in_every_cycle() {
    for (law, form) in [("poly5", law345 as fn(f64) -> f64), ("poly7", law4567)] {
        let cam = format!(
            "[[cam]]\nname = \"c\"\nlaw = \"{law}\"\nrepeat = true\n\
             points = [[0.0, 0.0], [1.0, 0.0], [5.0, 2.0], [7.0, 0.0], [8.0, 0.0]]\n"
        );
        let steps = format!(
            "[[step]]\ngear = {{ y = {{ to = \"x\", cam = \"c\", offset = 0.0 }} }}\n{MOVES}"
        );
        let folder = tempfile::tempdir().expect("a folder");
        let (options, path) = recorded(faults(""), folder.path());
        run_well(machine(&text(&cam, &steps)), options);
        let seen = targets(&path);
        assert!(seen.len() > 5000, "{}", seen.len());
        let farthest = seen.iter().map(|[_, y]| *y).max();
        assert_eq!(farthest, Some(2 * COUNTS as i64), "{law}");
        for (cycle, [x, y]) in seen.iter().enumerate() {
            let exact = closed_form(*x as f64 / COUNTS, form) * COUNTS;
            // The master's set-point is rounded to counts; the slope is at most 2.2.
            let error = (*y as f64 - exact).abs();
            assert!(
                error <= 0.5 + 0.5 * 2.2,
                "{law}, cycle {cycle}: {error} counts"
            );
        }
    }
}

/// A flying saw: in step with the material from 2 to 6 turns, then back, once.
#[test]
fn a_flying_saw_moves_with_its_material() {
    let cam = "[[cam]]\nname = \"saw\"\npoints = [[0.0, 0.0], [2.0, 1.0, 1.0], [6.0, 5.0, 1.0], [8.0, 6.0], [14.0, 0.0]]\n";
    let steps = "[[step]]\ngear = { y = { to = \"x\", cam = \"saw\" } }\n[[step]]\nmove = { x = 20.0 }\nspeed = 0.3\n";
    let folder = tempfile::tempdir().expect("a folder");
    let (options, path) = recorded(faults(""), folder.path());
    run_well(machine(&text(cam, steps)), options);
    let mut in_step = 0;
    for [x, y] in targets(&path) {
        if (2.0..6.0).contains(&(x as f64 / COUNTS)) {
            in_step += 1;
            assert!((x - y - COUNTS as i64).abs() <= 1, "{x} {y}");
        }
    }
    assert!(in_step > 250, "{in_step}");
    assert_eq!(targets(&path).last().map(|[_, y]| *y), Some(0));
}

/// A phase shifts the follower within its limits, and nothing steps.
#[test]
fn a_phase_shifts_the_follower_in_motion() {
    let steps = "[[step]]\ngear = { y = { to = \"x\" } }\n[[step]]\nvelocity = { x = 8.0 }\n[[step]]\nphase = { y = 1.25 }\n\
        [[step]]\nphase = { y = -0.5 }\n[[step]]\nstop = [\"x\"]\n";
    let folder = tempfile::tempdir().expect("a folder");
    let (options, path) = recorded(faults(""), folder.path());
    run_well(machine(&text("", steps)), options);
    let seen = targets(&path);
    let [x, y] = *seen.last().expect("cycles");
    assert!((y - x - (0.75 * COUNTS) as i64).abs() <= 1, "{x} {y}");
    for w in seen.windows(3) {
        let change = w[2][1] - 2 * w[1][1] + w[0][1];
        assert!(
            change.abs() as f64 <= 500.0 * COUNTS * 1e-6 + 2.0,
            "{change}"
        );
    }
    // Without a master there is nothing to shift. A gear that the run may engage passes `check`.
    let alone = "[[step]]\nenable = true\n[[step]]\nif = { x.\"0x6064\" = { above = 1e6 } }\n\
        [[step.step]]\ngear = { y = { to = \"x\" } }\n[[step]]\nphase = { y = 1.0 }\n";
    let (error, _) = run_badly(machine(&text("", alone)), virtual_time());
    assert_contains(&error, &["step 3", "`y`", "follows no other axis"]);
}

/// The follower decelerates with its group when it cannot follow, and both end without power.
#[test]
fn a_cam_that_is_too_steep_stops_both_axes() {
    let cam = "[[cam]]\nname = \"c\"\npoints = [[0.0, 0.0], [5.0, 0.0], [5.2, 8.0], [9.0, 8.0]]\n";
    // How fast a wave is, `check` does not know.
    let steps = "[[step]]\ngear = { y = { to = \"x\", cam = \"c\" } }\n[[step]]\nsine = { x = { amplitude = 0.5, frequency = 1.5, periods = 3 } }\n";
    let cam = cam.replace("[5.0, 0.0], [5.2, 8.0]", "[0.1, 0.0], [0.4, 8.0]");
    let (error, summary) = run_badly(machine(&text(&cam, steps)), virtual_time());
    assert_contains(&error, &["`y`", "cannot follow within its limits"]);
    for axis in summary.expect("the cycle has run").axes {
        assert_ne!(axis.final_state, "Operation enabled");
    }
}

/// `check` compares the follower with its limits at the velocity of the master that it knows.
#[test]
fn a_cam_that_its_follower_cannot_follow_is_refused() {
    let steep =
        "[[cam]]\nname = \"c\"\npoints = [[0.0, 0.0], [5.0, 0.0], [5.2, 8.0], [9.0, 8.0]]\n";
    let gear = "[[step]]\ngear = { y = { to = \"x\", cam = \"c\" } }\n";
    let scaled = gear.replace("cam =", "ratio = 0.5, cam =");
    let flat = steep.replace("5.2, 8.0", "8.0, 8.0");
    // 8 of 0.2: 1.875 * 40 * v, and 5.7735 * 200 * v².
    for (cam, steps, message) in [
        (
            steep,
            format!("{gear}[[step]]\nmove = {{ x = 9.0 }}\n"),
            "at 5.1 of it, with 10 turn/s, the velocity of `x`, its velocity is 750 turn/s, and its limit 30",
        ),
        (
            &steep.replace("8.0", "0.8"),
            format!("{gear}[[step]]\nmove = {{ x = 9.0 }}\nspeed = 0.3\n"),
            "with 3 turn/s, the velocity of `x`, its acceleration is 1039",
        ),
        (
            steep,
            format!("{gear}[[step]]\nvelocity = {{ x = -0.5 }}\n"),
            "with 0.5 turn/s, the velocity of `x`, its velocity is 37.5",
        ),
        (
            steep,
            gear.to_owned(),
            "with 10 turn/s, `limits.velocity` of `x`",
        ),
        (
            steep,
            format!("{gear}[[step]]\nrepeat = 2\nstep = [{{ move = {{ x = 9.0 }} }}]\n"),
            "cannot follow the cam `c`",
        ),
    ] {
        let text = text(cam, &steps);
        let error = config(&text).expect_err(&steps);
        assert_contains(
            &error,
            &[
                "`y` cannot follow the cam `c`",
                message,
                "flatter, or its master slower",
            ],
        );
        let line = text
            .lines()
            .position(|line| line.starts_with("gear"))
            .expect("a line");
        assert!(error.contains(&format!(":{line}:")), "{error}");
    }
    for (cam, steps) in [
        (
            steep,
            format!("{gear}[[step]]\nmove = {{ x = 9.0 }}\nspeed = 0.02\n"),
        ),
        (
            flat.as_str(),
            format!("{scaled}[[step]]\nmove = {{ x = 9.0 }}\nspeed = 0.9\n"),
        ),
    ] {
        if let Err(error) = config(&text(cam, &steps)) {
            panic!("{error}");
        }
    }
}

fn config(text: &str) -> Result<ecaxis_master::config::Machine, String> {
    let file = ecaxis_test_support::root().join("configs/m.toml");
    ecaxis_master::config::parse(&file, text).map_err(|error| error.to_string())
}

/// A line shaft may stop at any place of the cam: its deceleration is added to the acceleration.
#[test]
fn a_cam_of_a_line_shaft_leaves_acceleration_for_its_stop() {
    let cam = "[[cam]]\nname = \"c\"\npoints = [[0.0, 0.0], [5.0, 0.0], [8.0, 8.0], [9.0, 8.0]]\n";
    let gear = "[[step]]\ngear = { y = { to = \"s\", cam = \"c\" } }\n";
    // 8 of 3: 5.7735 · 8/9 · 5² and the slope of 1.875 · 8/3 · 100, both with the margin of the clocks.
    for (acceleration, refused) in [(50.0, false), (100.0, true)] {
        let shaft = format!(
            "[[line_shaft]]\nname = \"s\"\nvelocity = 5.0\nacceleration = {acceleration:.1}\n"
        );
        let parsed = config(&text(&format!("{cam}{shaft}"), gear));
        assert_eq!(parsed.is_err(), refused, "{parsed:?}");
        if let Err(error) = parsed {
            let part = "its acceleration is 629";
            assert_contains(&error, &["`y` cannot follow the cam `c`", part, "of `s`"]);
        }
    }
}

/// A mistake in a cam is the only one that is reported: its name is known to the steps.
#[test]
fn a_wrong_cam_is_reported_once() {
    let cam = "[[cam]]\nname = \"c\"\nfile = \"none.csv\"\n";
    let gear = "[[step]]\ngear = { y = { to = \"x\", cam = \"c\" } }\n";
    let error = config(&text(cam, gear)).expect_err("no file");
    assert_contains(&error, &["none.csv"]);
    assert!(!error.contains("no cam is named"), "{error}");
}

#[test]
fn wrong_cams_are_refused() {
    let cam = "[[cam]]\nname = \"c\"\npoints = [[0.0, 0.0], [4.0, 2.0]]\n";
    for (from, to, message) in [
        ("[4.0, 2.0]", "[4.0]", "a point has 2 or 3 numbers"),
        ("[4.0, 2.0]", "[0.0, 2.0]", "does not come after"),
        (", [4.0, 2.0]", "", "a cam has 2 to"),
        ("[4.0, 2.0]", "[4.0, 2.0, 1.0]", "ends with slope 0"),
        (
            "[4.0, 2.0]]",
            "[4.0, 2.0, 1.0]]\nrepeat = true",
            "a repeated cam needs equal ones",
        ),
        (
            "points =",
            "law = \"poly3\"\npoints =",
            "`law` cannot be \"poly3\"",
        ),
        (
            "points = [[0.0, 0.0], [4.0, 2.0]]",
            "",
            "either `points` or a `file`",
        ),
        (
            "points = [[0.0, 0.0], [4.0, 2.0]]",
            "file = \"none.csv\"",
            "none.csv",
        ),
        ("\"c\"", "\"d\"", "no cam is named `c`"),
    ] {
        let steps = "[[step]]\ngear = { y = { to = \"x\", cam = \"c\" } }\n";
        let text = text(&cam.replacen(from, to, 1), steps);
        let path = ecaxis_test_support::root().join("configs/m.toml");
        let error = ecaxis_master::config::parse(&path, &text).expect_err(to);
        assert_contains(&error.to_string(), &[message]);
    }
}

#[test]
fn the_labeller_runs() {
    let summary = run_well(load("labeller.toml"), virtual_time());
    assert_eq!(summary.program_runs, 1);
}
