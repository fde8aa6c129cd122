//! Drives with units other than those of the machine file: adopted values, rejections and warnings.

use ecaxis_ecat::index::AxisIndex;
use ecaxis_master::bringup::Step;
use ecaxis_master::config::Machine;
use ecaxis_master::session::Progress;
use ecaxis_test_support::bench::Bench;
use ecaxis_test_support::{machine, run, run_badly, run_well, virtual_time};

const HEAD: &str = r#"
[bus]
nic = "sim"
cycle = "1ms"

[[device]]
name = "x"
esi = "esi/EPOS4.xml"
position = 0
mode = "csp"
"#;

const AXIS: &str = r#"
[device.axis]
encoder = 2000
limits = { velocity = 50.0, acceleration = 500.0, following_error = 0.5 }
"#;

const MOVE: &str = "\n[[step]]\nmove = { x = 3.0 }\n";

const VELOCITY_UNIT: &str = "<Info><DefaultValue>#x00B44700</DefaultValue></Info>";
const BEFORE_0X60A8: &str = "<Object>\n                <Index>#x60A8</Index>";

/// Returns a machine with a changed ESI file, which also defines its simulated drive.
fn with_esi(from: &str, to: &str, text: &str) -> Machine {
    let bench = Bench::new();
    bench.change("esi/EPOS4.xml", |esi| esi.replacen(from, to, 1));
    bench.machine(text)
}

/// Adds an object to the drive.
fn with_object(object: &str, text: &str) -> Machine {
    let object =
        format!("<Object>{object}<Flags><Access>rw</Access></Flags></Object>{BEFORE_0X60A8}");
    with_esi(BEFORE_0X60A8, &object, text)
}

fn polarity(value: &str) -> String {
    format!(
        "<Index>#x607E</Index><Name>Polarity</Name><Type>USINT</Type><BitSize>8</BitSize><Info><DefaultValue>{value}</DefaultValue></Info>"
    )
}

/// Runs the machine. Returns the values adopted from the drive, and the warnings.
fn messages(machine: Machine) -> (Vec<String>, Vec<String>) {
    let (outcome, heard) = run(machine, virtual_time());
    if let Err(error) = outcome.result {
        panic!("{error}; {:?}", heard.warnings());
    }
    let taken = heard.0.iter().filter_map(|progress| match progress {
        Progress::Step(Step::Adopted { device, what }) => Some(format!("{device}: {what}")),
        _ => None,
    });
    let warnings = heard.warnings().into_iter();
    (taken.collect(), warnings.collect())
}

#[test]
fn matching_drive_units_cause_no_message() {
    let text = format!("{HEAD}{AXIS}{MOVE}");
    assert_eq!(messages(machine(&text)), (vec![], vec![]));
    let said = text.replace("encoder =", "velocity_unit = \"rpm\"\nencoder =");
    assert_eq!(messages(machine(&said)), (vec![], vec![]));
}

#[test]
fn a_velocity_unit_that_differs_from_the_drive_is_rejected() {
    let text =
        format!("{HEAD}{AXIS}{MOVE}").replace("encoder =", "velocity_unit = \"mrpm\"\nencoder =");
    let (error, summary) = run_badly(machine(&text), virtual_time());
    assert!(
        error.contains("`x` (position 0, station 0x1000): the drive's units are not those of the machine file: 0x60a9:00 is 0x00B44700 (rpm), expected mrpm"),
        "{error}"
    );
    assert!(summary.is_none(), "nothing has moved");
}

#[test]
fn a_written_velocity_unit_applies_to_the_drive_but_not_to_accelerations() {
    let sdo = "mode = \"csp\"\nsdo = [{ index = 0x60A9, value = 0xFDB44700 }, { index = 0x607F, value = 50000000 }]";
    let text = format!("{HEAD}{AXIS}{MOVE}").replace("mode = \"csp\"", sdo);
    assert_eq!(messages(machine(&text)), (vec![], vec![]));
}

#[test]
fn an_assumed_velocity_unit_is_replaced_by_that_of_the_drive() {
    let text = format!("{HEAD}{AXIS}{MOVE}");
    let (taken, warnings) = messages(with_esi(VELOCITY_UNIT, "", &text));
    assert_eq!(
        taken,
        ["x: velocities in rpm, as the drive says in 0x60A9, not in counts/s"]
    );
    assert!(warnings.is_empty(), "{warnings:?}");
}

#[test]
fn the_drive_velocity_unit_scales_velocities() {
    let text =
        format!("{HEAD}{AXIS}\n[[step]]\nvelocity = {{ x = 10.0 }}\n[[step]]\ndwell = \"1s\"\n")
            .replace("\"csp\"", "\"csv\"");
    for machine in [machine(&text), with_esi(VELOCITY_UNIT, "", &text)] {
        let summary = run_well(machine, virtual_time());
        // 20 ms to speed, a second at 10 turns/s, and the same again to rest.
        let position = summary.axes[0].final_position;
        assert!((9.5..11.0).contains(&position), "{position}");
    }
}

#[test]
fn a_different_encoder_resolution_is_rejected() {
    let encoder = "<Index>#x608F</Index><Name>Position encoder resolution</Name><Type>DT608F</Type><BitSize>80</BitSize><Info>\
        <SubItem><Name>Highest</Name><Info><DefaultValue>2</DefaultValue></Info></SubItem>\
        <SubItem><Name>Increments</Name><Info><DefaultValue>4096</DefaultValue></Info></SubItem>\
        <SubItem><Name>Turns</Name><Info><DefaultValue>1</DefaultValue></Info></SubItem></Info>";
    let data_type = "<DataType><Name>DT608F</Name><BitSize>80</BitSize>\
        <SubItem><SubIdx>0</SubIdx><Name>Highest</Name><Type>USINT</Type><BitSize>8</BitSize><BitOffs>0</BitOffs></SubItem>\
        <SubItem><SubIdx>1</SubIdx><Name>Increments</Name><Type>UDINT</Type><BitSize>32</BitSize><BitOffs>16</BitOffs></SubItem>\
        <SubItem><SubIdx>2</SubIdx><Name>Turns</Name><Type>UDINT</Type><BitSize>32</BitSize><BitOffs>48</BitOffs></SubItem></DataType>";
    let object =
        format!("<Object>{encoder}<Flags><Access>rw</Access></Flags></Object>{BEFORE_0X60A8}");
    let bench = Bench::new();
    bench.change("esi/EPOS4.xml", |esi| {
        let esi = esi.replacen(BEFORE_0X60A8, &object, 1);
        esi.replacen("<DataTypes>", &format!("<DataTypes>{data_type}"), 1)
    });
    let run_with = |counts: &str| {
        let text = format!("{HEAD}{AXIS}{MOVE}").replace("2000", counts);
        run(bench.machine(&text), virtual_time()).0.result
    };
    let error = run_with("2000").expect_err("twice the way").to_string();
    assert!(
        error.contains("0x608f:01 makes 4096 counts per motor turn, expected 2000"),
        "{error}"
    );
    run_with("4096").expect("the same encoder");
}

#[test]
fn an_inverting_drive_causes_a_warning_and_a_partly_inverting_one_is_rejected() {
    let text = format!("{HEAD}{AXIS}{MOVE}");
    let (_, warnings) = messages(with_object(&polarity("192"), &text));
    let [warning] = warnings.as_slice() else {
        panic!("{warnings:?}")
    };
    assert!(
        warning.contains("0x607e:00 is 0xC0, expected 0x00: set 0x607E to 0"),
        "{warning}"
    );
    let (error, _) = run_badly(with_object(&polarity("128"), &text), virtual_time());
    assert!(error.contains("0x607e:00 is 0x80"), "{error}");
}

#[test]
fn torques_in_newton_metres_use_the_motor_data_of_the_drive() {
    let text =
        format!("{HEAD}{AXIS}\n[[step]]\ntorque = {{ x = 0.005 }}\n[[step]]\ndwell = \"50ms\"\n")
            .replace("\"csp\"", "\"cst\"")
            .replace("encoder =", "torque_unit = \"Nm\"\nencoder =")
            .replace("following_error = 0.5", "torque = 0.05");
    let machine = machine(&text);
    let setup = &machine.axes[AxisIndex(0)];
    assert_eq!(setup.torque.rated, Some(0.1), "as the ESI says");
    assert!((setup.config.limits.torque - 50.0).abs() < 1e-9);
    let (taken, warnings) = messages(machine);
    let [taken] = taken.as_slice() else {
        panic!("{taken:?}")
    };
    assert!(
        taken.starts_with("x: a rated torque of ")
            && taken.ends_with("as the drive says in 0x6076, not 0.1 Nm"),
        "{taken}"
    );
    assert!(warnings.is_empty(), "{warnings:?}");
}

#[test]
fn a_modulo_axis_follows_its_direction() {
    for (way, targets, end) in [
        ("shortest", &[350.0, 80.0][..], 80.0),
        ("shortest", &[350.0], -10.0),
        ("shortest", &[170.0, 300.0], 300.0),
        ("positive", &[350.0, 10.0], 370.0),
        ("negative", &[10.0], -350.0),
    ] {
        let mut text = format!("{HEAD}{AXIS}")
            .replace(
                "encoder =",
                &format!("unit = \"deg\"\ngear = [3, 1]\nfeed = 360.0\nmodulo = 360.0\nway = \"{way}\"\nencoder ="),
            )
            .replace("velocity = 50.0, acceleration = 500.0, following_error = 0.5", "velocity = 3600.0, acceleration = 36000.0");
        for target in targets {
            text += &format!("\n[[step]]\nmove = {{ x = {target} }}\n");
        }
        let summary = run_well(machine(&text), virtual_time());
        let position = summary.axes[0].target_position;
        // 6000 counts per turn of the table.
        assert!(
            (position - end).abs() < 0.1,
            "{way} {targets:?}: {position}"
        );
    }
}

const VENDOR: &str = "#x00000E0A";

/// In this test, a maxon drive's 0x3001:05 is 37 mNm/A, and its rated torque is 0.1184 Nm.
#[test]
fn a_maxon_drive_provides_its_torque_constant() {
    let axis = AXIS
        .replace("encoder", "torque_unit = \"A\"\nencoder")
        .replace("following_error = 0.5", "torque = 3.0");
    let text =
        format!("{HEAD}{axis}\n[[step]]\ntorque = {{ x = 0.4 }}\n[[step]]\ndwell = \"1200ms\"\n")
            .replace("\"csp\"", "\"cst\"");
    let (outcome, heard) = run(with_esi(VENDOR, "#x000000FB", &text), virtual_time());
    outcome.result.expect("runs");
    let taken: Vec<&str> = heard
        .0
        .iter()
        .filter_map(|progress| match progress {
            Progress::Step(Step::Adopted { what, .. }) => Some(what.as_str()),
            _ => None,
        })
        .collect();
    assert!(
        taken.contains(&"a torque constant of 0.037 Nm/A, as the drive says in 0x3001:05"),
        "{taken:?}"
    );
    let torques: Vec<f64> = heard
        .0
        .iter()
        .filter_map(|progress| match progress {
            Progress::Status(status) => Some(status.axes[0].torque),
            _ => None,
        })
        .collect();
    assert!(
        torques.iter().any(|t| (t - 0.4).abs() < 0.02),
        "{torques:?}"
    );
    let said = text
        .replace("x = 0.4", "x = 0.1")
        .replace("encoder", "torque_constant = 0.05\nencoder");
    let (_, warnings) = messages(with_esi(VENDOR, "#x000000FB", &said));
    assert!(
        warnings
            .iter()
            .any(|w| w.contains("0x3001:05 is 37000 µNm/A, expected 50000")),
        "{warnings:?}"
    );
}
