//! `ecaxis bench` as a process: its output and its files. No time is asserted.

use ecaxis_test_support::program::{self, Ran};
use ecaxis_test_support::{assert_contains, assert_fits, assert_well_formed};

fn bench(line: &str) -> Ran {
    program::run(["bench"].into_iter().chain(line.split(' ')))
}

#[test]
fn json_contains_every_value_with_its_unit() {
    let folder = tempfile::tempdir().expect("a folder");
    let page = folder.path().join("report.html");
    let page = page.to_str().expect("UTF-8");
    let line = "--sim --axes 3 --cycle 2ms --seconds 1 --rounds 1 --against sleep --json --html";
    let report = bench(&format!("{line} {page}")).exits(0).json();
    for list in ["facts", "settings", "variants", "ratios", "remarks"] {
        assert!(report[list].is_array(), "{list}: {report:#}");
    }
    let variants = report["variants"].as_array().expect("variants");
    let names: Vec<_> = variants.iter().map(|v| v["name"].as_str()).collect();
    assert_eq!(names, [Some("ecaxis"), Some("sleeping")]);
    for variant in variants {
        let cycles = variant["cycles"].as_u64().expect("a number");
        assert!(cycles > 0);
        assert_eq!(variant["counters"]["cycles"], variant["cycles"]);
        for measure in ["wake_up_lateness", "work"] {
            let dist = &variant[measure];
            assert_eq!(dist["count"].as_u64(), Some(cycles), "{measure}");
            let (p50, max) = (dist["p50_ns"].as_u64(), dist["max_ns"].as_u64());
            assert!(p50.is_some() && p50 <= max, "{dist}");
            let steps = dist["histogram"].as_array().expect("steps");
            let sum: u64 = steps.iter().filter_map(|step| step[1].as_u64()).sum();
            assert_eq!(sum, cycles);
        }
        for number in [
            "cpu_ns_per_cycle",
            "cpu_percent",
            "context_switches_per_cycle",
        ] {
            assert!(variant[number].is_f64(), "{number}");
        }
        assert!(variant["used"]["minor_faults"].is_u64());
        assert!(variant["taken"]["steal_ns"].is_u64());
    }
    let ratio = &report["ratios"][0];
    assert_eq!(ratio["measure"], "wake_up_lateness");
    assert_eq!(
        (&ratio["of"], &ratio["to"]),
        (&"ecaxis".into(), &"sleeping".into())
    );
    assert!(ratio["p50"].is_f64());
    // The charts: lateness, release to input, work; also the phase if it locked.
    let page = std::fs::read_to_string(page).expect("written");
    let (charts, paths) = assert_well_formed(&page);
    assert!(charts >= 3 && paths >= 2 * 3, "{charts}, {paths}");
}

#[test]
fn the_table_fits_a_terminal() {
    let line = "--sim --axes 1 --cycle 2ms --seconds 1";
    let table = bench(line).exits(0).out;
    assert_fits(&table);
    let columns = ["Wake-up lateness", "Release to input", "Work", "p99.9"];
    assert_contains(&table, &[&columns[..], &["Counted"]].concat());
}

#[test]
fn invalid_command_lines_exit_with_2() {
    for (line, part) in [
        ("--cycle 1", "\"1\" has no unit"),
        ("--against nothing-of-the-kind", "not cyclictest, sleep"),
        ("--axes 0", "0 is not in 1..=1000"),
        ("--machine nowhere.toml", "cannot read nowhere.toml"),
        ("--cycle 1ms --spin 2ms", "--spin must not exceed --cycle"),
        (
            "--sim --against Cargo.toml",
            "leave --sim and --machine out",
        ),
        (
            "--machine configs/demo.toml --sim --cycle 123us",
            "the machine's cycle is 1 ms",
        ),
        ("--enable", "required arguments were not provided"),
    ] {
        bench(line).fails(2, &["error: ", part]);
    }
}
