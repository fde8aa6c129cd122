//! Outputs that follow the position of an axis, against the ideal moments from the set-points that
//! the drive receives.
//!
//! `ECAXIS_POSITION_SEEDS` sets the number of seeds (default 12).

use std::fmt::Write as _;

use ecaxis_test_support::bench::Bench;
use ecaxis_test_support::random::Random;
use ecaxis_test_support::recordings::process_images;
use ecaxis_test_support::{assert_contains, faults, machine, recorded, run_badly, run_well};

/// The axis has 12 bytes out and 13 bytes in; the terminal follows.
const TERMINAL: usize = 13;
const COUNTS: f64 = 131_072.0;
const DT: f64 = 0.001;

fn text(outputs: &str, steps: &str) -> String {
    format!(
        "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n\
         [[device]]\nname = \"x\"\nesi = \"esi/SV1.xml\"\nposition = 0\nmode = \"csp\"\n[device.axis]\nencoder = {COUNTS}\n\
         limits = {{ position = [-60.0, 60.0], velocity = 20.0, acceleration = 300.0, jerk = 30000.0, torque = 100.0, following_error = 2.0 }}\n\
         [[device]]\nname = \"io\"\nesi = \"esi/IO8.xml\"\nposition = 1\n{outputs}{steps}"
    )
}

/// Returns the target in turns and the outputs of every cycle with power.
fn cycles(recording: &std::path::Path) -> Vec<(f64, u8)> {
    let images = process_images(recording).into_iter();
    let images = images.filter(|(out, _)| out.len() > TERMINAL);
    let powered = images.filter(|(out, _)| u16::from_le_bytes([out[0], out[1]]) == 0x000f);
    powered
        .map(|(out, _)| {
            let target = i32::from_le_bytes([out[2], out[3], out[4], out[5]]);
            (f64::from(target) / COUNTS, out[TERMINAL])
        })
        .collect()
}

/// Returns the times in s at which a signal changes, with its new value. `at(n)`: the value in cycle
/// `n` minus the threshold is linear between cycles.
fn crossings(
    targets: &[(f64, u8)],
    [low, high]: [f64; 2],
    period: Option<f64>,
) -> Vec<(f64, bool)> {
    // Steps of a hundredth of a cycle are exact enough for an error of a cycle.
    const FINE: usize = 100;
    let inside = |at: f64| {
        let at = period.map_or(at, |period| at.rem_euclid(period));
        low <= at && at < high
    };
    let mut all = Vec::new();
    let mut before = targets.first().is_some_and(|first| inside(first.0));
    for (cycle, pair) in targets.windows(2).enumerate() {
        for part in 1..=FINE {
            let share = part as f64 / FINE as f64;
            let now = inside(pair[0].0 + (pair[1].0 - pair[0].0) * share);
            if now != before {
                all.push(((cycle as f64 + share) * DT, now));
                before = now;
            }
        }
    }
    all
}

fn switches(targets: &[(f64, u8)], bit: u8) -> Vec<(f64, bool)> {
    let on = |at: &(f64, u8)| at.1 >> bit & 1 != 0;
    let pairs = targets.windows(2).enumerate();
    let changes = pairs.filter(|(_, pair)| on(&pair[0]) != on(&pair[1]));
    changes
        .map(|(cycle, pair)| ((cycle + 1) as f64 * DT, on(&pair[1])))
        .collect()
}

#[test]
fn outputs_switch_within_a_cycle_of_the_ideal() {
    let seeds = std::env::var("ECAXIS_POSITION_SEEDS");
    let seeds = seeds.map_or(12, |n| n.parse().expect("a number"));
    let mut worst = [0.0_f64; 2];
    for seed in 1..=seeds {
        let mut random = Random::new(seed);
        let lead_ms = [0, 0, 2, 5][usize::try_from(random.below(4)).expect("small")];
        let outputs = format!(
            "[[position_output]]\noutput = \"io.Output 1\"\naxis = \"x\"\nranges = [[5.0, 11.0], [15.0, 18.5]]\nlead = \"{lead_ms}ms\"\n\
             [[position_output]]\noutput = \"io.Output 2\"\naxis = \"x\"\nperiod = 2.5\nranges = [[0.5, 1.5]]\nlead = \"{lead_ms}ms\"\n"
        );
        // Motions between places outside the ranges, so that each edge is passed at speed.
        let places = [1.8, 11.8, 24.3, -3.2, 36.8];
        let mut steps = String::new();
        let mut last = 99;
        for _ in 0..6 {
            let place = random.below(5);
            if place == last {
                continue;
            }
            last = place;
            let (to, speed) = (
                places[usize::try_from(place).expect("small")],
                40 + random.below(61),
            );
            let _ = write!(
                steps,
                "[[step]]\nmove = {{ x = {to} }}\nspeed = {}\nramp = {}\n",
                speed as f64 / 100.0,
                (30 + random.below(71)) as f64 / 100.0,
            );
        }
        let folder = tempfile::tempdir().expect("a folder");
        let (options, path) = recorded(faults(""), folder.path());
        run_well(machine(&text(&outputs, &steps)), options);
        let seen = cycles(&path);
        for (bit, ranges, period) in [
            (0, &[[5.0, 11.0], [15.0, 18.5]][..], None),
            (1, &[[0.5, 1.5]], Some(2.5)),
        ] {
            let ideal = ranges
                .iter()
                .flat_map(|range| crossings(&seen, *range, period));
            let mut ideal: Vec<_> = ideal.collect();
            ideal.sort_by(|a, b| a.0.total_cmp(&b.0));
            let real = switches(&seen, bit);
            assert_eq!(real.len(), ideal.len(), "seed {seed}, output {bit}");
            assert!(!real.is_empty() || seed > 1);
            for (real, ideal) in real.iter().zip(&ideal) {
                assert_eq!(real.1, ideal.1, "seed {seed}");
                let late = real.0 - (ideal.0 - f64::from(lead_ms) * DT);
                worst[usize::from(lead_ms > 0)] = worst[usize::from(lead_ms > 0)].max(late.abs());
                // A jerk during the lead is not known when the output must switch.
                let unknown = if lead_ms > 0 { 0.3 * DT } else { 0.0 };
                assert!(
                    late > -0.01 * DT - unknown && late <= 1.01 * DT + unknown,
                    "seed {seed}, output {bit}, lead {lead_ms} ms: {late}"
                );
            }
        }
    }
    println!(
        "worst without and with a lead, in cycles: {:?}",
        worst.map(|s| s / DT)
    );
}

#[test]
fn an_output_is_off_without_power_and_in_a_stop() {
    let outputs =
        "[[position_output]]\noutput = \"io.Output 1\"\naxis = \"x\"\nranges = [[-60.0, 60.0]]\n";
    let steps =
        "[[step]]\nenable = true\n[[step]]\nvelocity = { x = 10.0 }\n[[step]]\ndwell = \"2s\"\n";
    for fault in [
        "kind = \"drive-fault\"\ncode = 0x8611",
        // A trip, found while the axis acts.
        "kind = \"position-shift\"\nvalue = 500000",
    ] {
        let folder = tempfile::tempdir().expect("a folder");
        let script = format!("[[fault]]\n{fault}\ndevice = 0\nat = \"1s\"\n");
        let (options, path) = recorded(faults(&script), folder.path());
        run_badly(machine(&text(outputs, steps)), options);
        let images = process_images(&path);
        let mut on = 0;
        for (out, data) in images
            .iter()
            .filter(|(out, data)| out.len().min(data.len()) > TERMINAL)
        {
            let statusword = u16::from_le_bytes([data[0], data[1]]);
            let powered = statusword & 0x6f == 0x27;
            if out[TERMINAL] & 1 != 0 {
                on += 1;
                // The Statusword answers the outputs before it.
                assert!(powered || statusword & 0x08 != 0, "{statusword:#06x}");
                assert_eq!(out[0] & 0x0f, 0x0f, "on in the cycle of the stop: {fault}");
            }
        }
        assert!(on > 300, "{on}");
        let last = images
            .iter()
            .rev()
            .find(|(out, _)| out.len() > TERMINAL)
            .expect("cycles");
        assert_eq!(last.0[TERMINAL] & 1, 0);
    }
}

/// A group without axes is never reset, so its output would come back on unasked.
#[test]
fn an_output_in_a_group_of_devices_alone_is_refused() {
    let outputs =
        "[[position_output]]\noutput = \"io.Output 1\"\naxis = \"x\"\nranges = [[1.0, 2.0]]\n";
    let group = "[[stop.group]]\nname = \"g\"\ndevices = [\"io\"]\n";
    for (outside, refused) in [("continue", true), ("stop", false)] {
        let group = format!("{group}outside = \"{outside}\"\n");
        let parsed = Bench::new().parse(&text(&format!("{outputs}{group}"), ""));
        assert_eq!(parsed.is_err(), refused, "{parsed:?}");
        if let Err(error) = parsed {
            assert_contains(
                &error,
                &["`io.Output 1` would come on by itself", "group `g`"],
            );
        }
    }
}

#[test]
fn wrong_position_outputs_are_refused() {
    let one =
        "[[position_output]]\noutput = \"io.Output 1\"\naxis = \"x\"\nranges = [[1.0, 2.0]]\n";
    for (from, to, message) in [
        ("\"x\"", "\"y\"", "no axis is named `y`"),
        ("Output 1", "Output 9", "Output 9"),
        ("[[1.0, 2.0]]", "[]", "no range is given"),
        (
            "[[1.0, 2.0]]",
            "[[2.0, 1.0]]",
            "the range from 2 to 1 is empty",
        ),
        ("[[1.0, 2.0]]", "[[1.0, 61.0]]", "not within -60 to 60"),
        (
            "[[1.0, 2.0]]",
            "[[1.0, 2.0]]\nperiod = 1.5",
            "not within 0 to 1.5",
        ),
        (
            "[[1.0, 2.0]]",
            "[[1.0, 2.0]]\nperiod = -1.0",
            "a `period` is above 0",
        ),
        (
            "[[1.0, 2.0]]",
            "[[1.0, 2.0]]\nlead = \"2s\"",
            "`lead` of 2 s",
        ),
        (
            "[[1.0, 2.0]]\n",
            &format!("[[1.0, 2.0]]\n{one}"),
            "is switched by the position_output",
        ),
        (
            "[[1.0, 2.0]]\n",
            "[[1.0, 2.0]]\n[[step]]\nset = { io.\"Output 1\" = true }\n",
            "is set by the step",
        ),
        (
            "[[1.0, 2.0]]\n",
            "[[1.0, 2.0]]\n[[copy]]\nfrom = \"io.Input 1\"\nto = \"io.Output 1\"\n",
            "position_output in line",
        ),
    ] {
        let text = text(&one.replacen(from, to, 1), "");
        let error = ecaxis_master::config::parse(
            &ecaxis_test_support::root().join("configs/m.toml"),
            &text,
        )
        .expect_err(to);
        assert_contains(&error.to_string(), &[message]);
    }
}
