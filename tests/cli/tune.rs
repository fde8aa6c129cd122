//! `ecaxis tune` as a process, on simulated drives whose inertia and friction are known.

use std::path::Path;

use ecaxis_test_support::program::{self, Ran};
use ecaxis_test_support::{assert_contains, assert_well_formed, root};
use serde_json::Value;

/// Motor of the simulated drive: kg·m², N·m·s/rad, N·m, and rated torque in N·m.
const INERTIA: f64 = 3.6e-5;
const VISCOUS: f64 = 2e-5;
const COULOMB: f64 = 4e-3;
const RATED: f64 = 0.1184;

/// An axis in each of the modes. In CST it may turn far.
fn machine(folder: &Path, rest: &str) -> String {
    let esi = root().join("configs/esi/EPOS4.xml");
    let axis = |name: &str, mode: &str, limits: &str| {
        format!(
            "[[device]]\nname = \"{name}\"\nesi = \"{}\"\nposition = {}\nmode = \"{mode}\"\n\
             [device.axis]\nunit = \"turn\"\nencoder = 2000\nrated_torque = {RATED}\ntorque_constant = 0.037\n\
             limits = {{ {limits}, acceleration = 500.0 }}\n",
            esi.display(),
            ["p", "v", "t"]
                .iter()
                .position(|known| *known == name)
                .expect("known"),
        )
    };
    let text = format!(
        "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n{}{rest}{}{}",
        axis(
            "p",
            "csp",
            "position = [-20.0, 20.0], velocity = 50.0, torque = 100.0"
        ),
        axis("v", "csv", "velocity = 50.0, torque = 100.0"),
        axis("t", "cst", "velocity = 100.0, torque = 300.0"),
    );
    let path = folder.join("m.toml");
    std::fs::write(&path, text).expect("written");
    path.to_str().expect("UTF-8").to_owned()
}

fn tune(file: &str, line: &str) -> Ran {
    program::run(["tune", file].into_iter().chain(line.split(' ')))
}

fn within(found: &Value, expected: f64, share: f64, what: &str) {
    let found = found.as_f64().unwrap_or_else(|| panic!("{what}: {found}"));
    let error = found / expected - 1.0;
    assert!(
        error.abs() <= share,
        "{what}: {found} instead of {expected}"
    );
}

#[test]
fn estimates_are_within_5_percent_in_each_mode() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = machine(folder.path(), "");
    for (axis, options) in [
        (
            "p",
            "--travel 15 --from 0.4 --to 40 --period 10s --amplitude 1",
        ),
        (
            "v",
            "--travel 15 --from 0.4 --to 40 --period 10s --amplitude 1",
        ),
        (
            "t",
            "--travel 60 --from 1 --to 100 --period 8s --amplitude 1",
        ),
        (
            "t",
            "--travel 60 --from 1 --to 60 --period 8s --form prbs --amplitude 0.05",
        ),
    ] {
        let report = tune(&file, &format!("{axis} --sim --virtual --json {options}"));
        let report = report.exits(0).json();
        let found = &report["estimates"];
        let motor = &found["motor"];
        within(
            &motor["inertia"],
            INERTIA,
            0.05,
            &format!("{axis}: inertia"),
        );
        // The slow motion of a short PRBS hides the friction.
        if options.contains("prbs") {
            continue;
        }
        within(
            &motor["viscous"],
            VISCOUS,
            0.05,
            &format!("{axis}: viscous friction"),
        );
        let coulomb = COULOMB / RATED * 100.0;
        within(
            &found["coulomb_friction"],
            coulomb,
            0.05,
            &format!("{axis}: Coulomb friction"),
        );
        if axis == "t" {
            // Three cycles, and half of one for which a torque is held.
            within(&found["torque_dead_time_s"], 3.5e-3, 0.05, "t: dead time");
        }
        for (_, own) in report["loops"].as_object().expect("loops") {
            let Some(margins) = own.get("margins") else {
                continue;
            };
            assert!(margins["phase_deg"].as_f64() >= Some(45.0), "{margins}");
            assert!(margins["rise_db"].as_f64() >= Some(6.0), "{margins}");
        }
    }
}

/// A load on an elastic shaft: its frequencies, and the inertia of both masses.
#[test]
fn the_resonance_of_two_masses_is_estimated_within_5_percent() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = machine(folder.path(), "");
    let text = std::fs::read_to_string(&file).expect("the file");
    let load =
        "[device.sim]\nmotor = { inertia = 3e-5, load_inertia = 2.5e-5, antiresonance = 22.0 }\n";
    std::fs::write(&file, text + load).expect("written");
    let line = "t --sim --virtual --json --travel 60 --from 1 --to 60 --period 16s --amplitude 1";
    let report = tune(&file, line).exits(0).json();
    let found = &report["estimates"];
    within(&found["motor"]["inertia"], 5.5e-5, 0.05, "inertia");
    within(&found["antiresonance_hz"], 22.0, 0.05, "antiresonance");
    let resonance = 22.0 * (5.5_f64 / 3.0).sqrt();
    within(&found["resonance_hz"], resonance, 0.05, "resonance");
}

#[test]
fn a_load_that_the_simulation_cannot_resolve_is_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    for keys in [
        "inertia = 1e-9, load_inertia = 10.0, antiresonance = 1000.0",
        "load_inertia = 1.0, antiresonance = 10.0, damping = 1.0",
    ] {
        let file = machine(folder.path(), "");
        let text = std::fs::read_to_string(&file).expect("the file");
        let text = text + &format!("[device.sim]\nmotor = {{ {keys} }}\n");
        std::fs::write(&file, text).expect("written");
        let refused = program::run(["check", &file]).exits(2);
        assert_contains(
            &refused.err,
            &["motor and load swing with", "`load_inertia`"],
        );
    }
}

/// A proposed loop runs the axis that it was measured on.
#[test]
fn an_axis_moves_with_the_proposed_gains() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = machine(folder.path(), "");
    let line = "t --sim --virtual --json --travel 60 --from 1 --to 100 --period 8s --amplitude 1";
    let report = tune(&file, line).exits(0).json();
    let keys = report["keys"].as_array().expect("lines");
    let keys: Vec<_> = keys.iter().filter_map(Value::as_str).collect();
    let text = std::fs::read_to_string(&file).expect("the file");
    let text = format!(
        "{text}{}\n[[step]]\nmove = {{ t = 3.0 }}\nspeed = 0.1\n",
        keys.join("\n")
    );
    std::fs::write(&file, text).expect("written");
    let report = program::run(["run", &file, "--sim", "--virtual", "--json"]);
    let report = report.exits(0).json();
    let axes = report["summary"]["axes"].as_array().expect("axes");
    let axis = axes
        .iter()
        .find(|axis| axis["name"] == "t")
        .expect("the axis");
    let position = axis["final_position"].as_f64().expect("a position");
    assert!((position - 3.0).abs() < 0.02, "{axis:#}");
}

#[test]
fn text_and_page_are_readable() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = machine(folder.path(), "");
    let page = folder.path().join("x.html");
    let samples = folder.path().join("x.csv");
    let line = format!(
        "p --sim --virtual --page {} --samples {}",
        page.display(),
        samples.display()
    );
    let ran = tune(&file, &line).exits(0);
    for text in ["inertia", "kg·m²", "dead_time = ", "0x30A1:01", "degrees"] {
        assert_contains(&ran.out, &[text]);
    }
    let page = std::fs::read_to_string(&page).expect("a page");
    assert_well_formed(&page);
    assert_eq!(page.matches("<svg").count(), 6);
    let samples = std::fs::read_to_string(&samples).expect("samples");
    assert_eq!(samples.lines().count(), 24_000 + 2);
    // Files are not overwritten.
    let again = tune(&file, &line).exits(2);
    assert_contains(&again.err, &["exists already"]);
}

#[test]
fn gains_are_written_on_request_only() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = machine(folder.path(), "");
    let ran = tune(&file, "p --sim --virtual --travel 4 --from 1 --apply").exits(0);
    assert_contains(&ran.err, &["0x30a1:01 position P: "]);
    assert_contains(&ran.err, &["(it was "]);
}

#[test]
fn mistakes_are_explained_and_move_nothing() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = machine(folder.path(), "");
    for (line, text) in [
        ("q", "no axis is called `q`"),
        ("p --amplitude 1.5", "--amplitude 1.5: at most 1"),
        ("p --amplitude 0", "--amplitude 0: a number above 0"),
        ("p --travel nan", "--travel NaN: a number above 0"),
        ("p --phase 90", "--phase 90: 0 to 80"),
        ("p --from 600", "frequencies from 600 to 200 Hz"),
        ("p --period 0.01ms", "a period of 0.00001 s"),
        ("p --form prbs", "the axis needs mode cst"),
        ("p --period 200s --periods 100", "more than 4000000"),
        ("p --periods 1", "1 is not in 2..=100"),
        ("p --form square", "possible values"),
        (
            "p --virtual --nic nosuch0",
            "--virtual needs the simulated bus",
        ),
    ] {
        let sim = if line.contains("--nic") { "" } else { " --sim" };
        let ran = tune(&file, &format!("{line}{sim}")).exits(2);
        assert_contains(&ran.err, &[text]);
        assert!(!ran.err.contains("Operation enabled"), "{}", ran.err);
    }
    // Beyond the range of the axis: the set-point is rejected, and the axis stops.
    let ran = tune(
        &file,
        "p --sim --virtual --travel 80 --amplitude 1 --from 0.1 --to 2 --period 20s",
    );
    let ran = ran.exits(1);
    assert_contains(&ran.err, &["a set-point was rejected"]);
}

/// Without 0x6077 and without a torque of its own, nothing can be estimated.
#[test]
fn friction_that_holds_the_axis_is_reported() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = machine(folder.path(), "");
    let ran = tune(&file, "t --sim --virtual --amplitude 0.01").exits(1);
    assert_contains(&ran.err, &["use a larger amplitude"]);
}
