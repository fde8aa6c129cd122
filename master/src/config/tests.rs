mod flow;
mod mistakes;
mod wrong_programs;

use std::path::PathBuf;

use ecaxis_ecat::index::{AxisIndex, DeviceIndex};

use super::*;

/// A drive with CSP and CSV but without CST, with 0x60C2 and one writable object.
const ESI: &str = r##"<?xml version="1.0" encoding="utf-8"?>
<EtherCATInfo><Vendor><Id>#x1234</Id><Name>Test</Name></Vendor><Descriptions><Devices>
<Device Physics="YY"><Type ProductCode="#x10" RevisionNo="#x1">D1</Type><Name>Drive one</Name>
<Profile><ProfileNo>402</ProfileNo><Dictionary><DataTypes>
<DataType><Name>UDINT</Name><BitSize>32</BitSize></DataType>
<DataType><Name>USINT</Name><BitSize>8</BitSize></DataType>
<DataType><Name>SINT</Name><BitSize>8</BitSize></DataType>
<DataType><Name>DT60C2</Name><BitSize>32</BitSize>
<SubItem><SubIdx>0</SubIdx><Name>n</Name><Type>USINT</Type><BitSize>8</BitSize><BitOffs>0</BitOffs><Flags><Access>ro</Access></Flags></SubItem>
<SubItem><SubIdx>1</SubIdx><Name>value</Name><Type>USINT</Type><BitSize>8</BitSize><BitOffs>16</BitOffs><Flags><Access>rw</Access></Flags></SubItem>
<SubItem><SubIdx>2</SubIdx><Name>index</Name><Type>SINT</Type><BitSize>8</BitSize><BitOffs>24</BitOffs><Flags><Access>rw</Access></Flags></SubItem>
</DataType></DataTypes><Objects>
<Object><Index>#x6065</Index><Name>Following error window</Name><Type>UDINT</Type><BitSize>32</BitSize><Info><DefaultData>D0070000</DefaultData></Info><Flags><Access>rw</Access></Flags></Object>
<Object><Index>#x60A9</Index><Name>Velocity unit</Name><Type>UDINT</Type><BitSize>32</BitSize><Info><DefaultData>0047B4FD</DefaultData></Info><Flags><Access>rw</Access></Flags></Object>
<Object><Index>#x60C2</Index><Name>Interpolation time</Name><Type>DT60C2</Type><BitSize>32</BitSize><Flags><Access>rw</Access></Flags></Object>
</Objects></Dictionary></Profile>
<Fmmu>Outputs</Fmmu><Fmmu>Inputs</Fmmu><Fmmu>MBoxState</Fmmu>
<Sm MinSize="48" MaxSize="48" DefaultSize="48" StartAddress="#x1000" ControlByte="#x26" Enable="1">MBoxOut</Sm>
<Sm MinSize="48" MaxSize="48" DefaultSize="48" StartAddress="#x1030" ControlByte="#x22" Enable="1">MBoxIn</Sm>
<Sm StartAddress="#x1100" ControlByte="#x64" Enable="1">Outputs</Sm>
<Sm StartAddress="#x1200" ControlByte="#x20" Enable="1">Inputs</Sm>
<RxPdo Sm="2"><Index>#x1600</Index><Name>Out</Name>
<Entry><Index>#x6040</Index><SubIndex>0</SubIndex><BitLen>16</BitLen><Name>Controlword</Name><DataType>UINT</DataType></Entry>
<Entry><Index>#x607A</Index><SubIndex>0</SubIndex><BitLen>32</BitLen><Name>Target position</Name><DataType>DINT</DataType></Entry>
<Entry><Index>#x60FF</Index><SubIndex>0</SubIndex><BitLen>32</BitLen><Name>Target velocity</Name><DataType>DINT</DataType></Entry></RxPdo>
<TxPdo Sm="3"><Index>#x1A00</Index><Name>In</Name>
<Entry><Index>#x6041</Index><SubIndex>0</SubIndex><BitLen>16</BitLen><Name>Statusword</Name><DataType>UINT</DataType></Entry>
<Entry><Index>#x6064</Index><SubIndex>0</SubIndex><BitLen>32</BitLen><Name>Actual position</Name><DataType>DINT</DataType></Entry>
<Entry><Index>#x606C</Index><SubIndex>0</SubIndex><BitLen>32</BitLen><Name>Actual velocity</Name><DataType>DINT</DataType></Entry></TxPdo>
<Mailbox DataLinkLayer="1"><CoE SdoInfo="0" PdoAssign="1" PdoConfig="1" CompleteAccess="1"/></Mailbox>
<Dc><OpMode><Name>DC</Name><Desc>DC</Desc><AssignActivate>#x300</AssignActivate><CycleTimeSync0 Factor="1">0</CycleTimeSync0></OpMode></Dc>
</Device></Devices></Descriptions></EtherCATInfo>
"##;

pub(super) const GOOD: &str = r#"repeat = 2

[bus]
nic = "sim"
cycle = "1ms"

[[device]]
name = "x"
esi = "D1.xml"
position = 0
mode = "csp"
sdo = [{ index = 0x6065, value = 2500 }]

[device.axis]
unit = "mm"
per_turn = 5.0
encoder = 2000
limits = { position = [-50.0, 50.0], velocity = 200.0, acceleration = 2000.0, torque = 100.0, following_error = 1.0 }

[[device]]
name = "v"
esi = "D1.xml"
position = 1
mode = "csv"

[device.axis]
encoder = 2000
limits = { velocity = 50, acceleration = 500 }

[[step]]
move = { x = 50.0 }
speed = 0.5
ramp = 0.3

[[step]]
velocity = { v = 25.0 }

[[step]]
dwell = "500ms"
"#;

pub(super) fn with_esi(text: &str) -> Result<Machine, ConfigError> {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("D1.xml"), ESI).unwrap();
    std::fs::write(folder.path().join("cut.xml"), &ESI[..2000]).unwrap();
    parse(&folder.path().join("m.toml"), text)
}

/// Returns the problems of the good file with one text replaced.
fn broken(from: &str, to: &str) -> Vec<Problem> {
    assert!(GOOD.contains(from), "{from}");
    problems(&GOOD.replacen(from, to, 1))
}

fn problems(text: &str) -> Vec<Problem> {
    match with_esi(text) {
        Err(ConfigError::Problems(problems)) => problems,
        other => panic!("expected problems: {other:?}"),
    }
}

/// Expects one problem with this message, hint (or part of it) and marked text.
fn one(from: &str, to: &str, message: &str, hint: &str, marked: &str) {
    let found = broken(from, to);
    let [problem] = found.as_slice() else {
        panic!("{from} → {to}: {found:#?}")
    };
    let at: String = problem
        .source_line
        .chars()
        .skip(problem.column as usize - 1)
        .take(problem.width as usize)
        .collect();
    assert!(problem.message.contains(message), "{problem}");
    assert!(
        problem.hint.as_deref().unwrap_or_default().contains(hint),
        "{problem}"
    );
    assert_eq!(at, marked, "{problem}");
    assert!(problem.line >= 1);
}

#[test]
fn config_parses_a_good_file() {
    let machine = with_esi(GOOD).unwrap();
    assert_eq!(machine.repeat, 2);
    let expected = Bus {
        written: vec![("nic", 4), ("cycle", 5)],
        ..Bus::default()
    };
    assert_eq!(machine.bus, expected);
    assert_eq!(machine.devices.len(), 2);
    let x = &machine.devices[DeviceIndex(0)];
    assert_eq!(
        (x.name.as_str(), x.at, x.line),
        ("x", Locator::Position(0), 7)
    );
    assert!(Arc::ptr_eq(&x.esi, &machine.devices[DeviceIndex(1)].esi));
    let axis = &machine.axes[AxisIndex(0)];
    assert_eq!((axis.unit.as_str(), axis.mode), ("mm", esi::Mode::Csp));
    assert_eq!(
        axis.config.scale.velocity_unit(),
        ecaxis_axis::VelocityUnit::MILLI_RPM
    );
    assert_eq!(axis.config.limits.position, Some([-50.0, 50.0]));
    let user = x.selection.startup.last().unwrap();
    assert_eq!(
        (user.index, user.data.as_slice()),
        (0x6065, [0xc4, 9, 0, 0].as_slice())
    );
    assert_eq!(machine.axes[AxisIndex(1)].config.limits.torque, 100.0);
    let steps: Vec<_> = machine.steps.iter().map(|s| s.action.clone()).collect();
    assert_eq!(
        steps,
        [
            Action::Move {
                relative: false,
                targets: vec![(AxisIndex(0), 50.0)],
                speed: 0.5,
                ramp: 0.3,
                together: false,
            },
            Action::Velocity {
                targets: vec![(AxisIndex(1), 25.0)],
                ramp: 1.0
            },
            Action::Dwell { ns: 500_000_000 },
        ]
    );
    let numbers: Vec<_> = machine.steps.iter().map(|s| s.number.as_str()).collect();
    assert_eq!(numbers, ["1", "2", "3"]);
}

#[test]
fn axis_accepts_custom_units_and_records_the_velocity_unit_source() {
    for (text, shown) in [("custom:slots", "slots"), ("μm", "µm"), ("°", "°")] {
        let machine = with_esi(&GOOD.replace("\"mm\"", &format!("\"{text}\""))).unwrap();
        assert_eq!(machine.axes[AxisIndex(0)].unit, shown);
    }
    let from = |text: &str| with_esi(text).unwrap().axes[AxisIndex(0)].velocity_unit_from;
    assert_eq!(from(GOOD), UnitSource::Esi);
    let said = GOOD.replace("unit = \"mm\"", "unit = \"mm\"\nvelocity_unit = \"rpm\"");
    assert_eq!(from(&said), UnitSource::File);
    let written = GOOD.replace(
        "{ index = 0x6065, value = 2500 }",
        "{ index = 0x60A9, value = 0x00B44700 }",
    );
    assert_eq!(from(&written), UnitSource::Sdo);
}

#[test]
fn axis_scale_uses_gear_feed_and_modulo() {
    let axis = |keys: &str| {
        let text = GOOD.replace(
            "[device.axis]\nencoder",
            &format!("[device.axis]\n{keys}\nencoder"),
        );
        with_esi(&text).unwrap().axes[AxisIndex(1)].clone()
    };
    for (keys, per_turn) in [
        ("gear = [3, 1]", 1.0 / 3.0),
        ("feed = 10", 10.0),
        ("gear = [676, 49]\nfeed = 360.0", 360.0 * 49.0 / 676.0),
        ("per_turn = 2.5", 2.5),
    ] {
        let scale = axis(keys).config.scale;
        assert_eq!(scale.units_per_turn(), per_turn, "{keys}");
    }
    let turntable = axis("unit = \"deg\"\nfeed = 360.0\nmodulo = 360.0\nway = \"positive\"");
    assert_eq!(turntable.config.scale.modulo(), Some(360.0));
    assert_eq!(turntable.way, ecaxis_axis::scale::ModuloDirection::Positive);
    assert_eq!(axis("").config.scale.modulo(), None);
}

#[test]
fn axis_converts_torques_in_nm_and_a() {
    let axis = |keys: &str| {
        let text = GOOD.replace(
            "unit = \"mm\"",
            &format!("{keys}\nsupervise = {{ torque = 0.05 }}"),
        );
        let text = text.replace("torque = 100.0", "torque = 0.1");
        with_esi(&text).unwrap().axes[AxisIndex(0)].clone()
    };
    for (keys, limit, supervised, from) in [
        // This vendor's 0x6076 counts mNm.
        (
            "torque_unit = \"Nm\"\nrated_torque = 0.2",
            50.0,
            25.0,
            UnitSource::File,
        ),
        (
            "torque_unit = \"A\"\ntorque_constant = 0.5\nrated_torque = 0.2",
            25.0,
            12.5,
            UnitSource::File,
        ),
        // Unknown until the drive reports it: fractions of the limit.
        ("torque_unit = \"Nm\"", 100.0, 50.0, UnitSource::Nothing),
        ("torque_unit = \"percent\"", 0.1, 0.05, UnitSource::Nothing),
    ] {
        let axis = axis(keys);
        let watched = axis.config.supervision.torque.unwrap().percent;
        assert!((axis.config.limits.torque - limit).abs() < 1e-9, "{keys}");
        assert!((watched - supervised).abs() < 1e-9, "{keys}");
        assert_eq!(axis.torque.rated_from, from, "{keys}");
        assert!((axis.torque.shown(limit) - 0.1).abs() < 1e-12, "{keys}");
    }
}

#[test]
fn bus_spin_is_automatic_or_fixed() {
    for (said, spin) in [
        ("repeat = 2", Spin::Auto),
        ("spin = \"auto\"", Spin::Auto),
        ("spin = \"100us\"", Spin::For(100_000)),
        ("spin = \"0us\"", Spin::For(0)),
        ("spin = 0", Spin::For(0)),
    ] {
        let text = GOOD
            .replace("nic = \"sim\"", said)
            .replace("[bus]\nrepeat = 2", "[bus]");
        assert_eq!(with_esi(&text).unwrap().bus.spin, spin, "{said}");
    }
}

#[test]
fn devices_are_sorted_and_steps_keep_their_axes() {
    let swapped = GOOD
        .replace("position = 1", "position = 9")
        .replace("position = 0", "position = 1");
    let machine = with_esi(&swapped.replace("position = 9", "position = 0")).unwrap();
    assert_eq!(machine.devices[DeviceIndex(0)].name, "v");
    assert_eq!(
        machine.steps[0].action,
        Action::Move {
            relative: false,
            targets: vec![(AxisIndex(1), 50.0)],
            speed: 0.5,
            ramp: 0.3,
            together: false,
        }
    );
}

/// Returns the CPU time of this thread in s.
fn cpu_seconds() -> f64 {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9
}

/// Ten times the steps take about ten times as long, with and without mistakes.
#[test]
fn checking_is_linear_in_the_steps() {
    let text = |steps: usize, wrong: &str| {
        let step = |n: usize| format!("[[step]]\nmove = {{ x = {}.0 }}{wrong}\n", n % 7);
        let steps: String = (0..steps).map(step).collect();
        GOOD.replace("repeat = 2\n", "") + &steps
    };
    for wrong in ["", "\nspede = 5"] {
        let shortest = |steps: usize| {
            let text = text(steps, wrong);
            let once = || {
                let begun = cpu_seconds();
                assert_eq!(with_esi(&text).is_ok(), wrong.is_empty());
                cpu_seconds() - begun
            };
            (0..3).map(|_| once()).fold(f64::INFINITY, f64::min)
        };
        let ratio = shortest(9_000) / shortest(900);
        assert!(ratio < 30.0, "{ratio}");
    }
}

proptest::proptest! {
    #[test]
    fn parse_never_panics(cut in 0..GOOD.len(), with in ".{0,8}", len in 0..12_usize) {
        let mut text = GOOD.to_owned();
        let end = (cut + len).min(text.len());
        text.replace_range(cut..end, &with);
        if let Err(e) = parse(Path::new("m.toml"), &text) {
            proptest::prop_assert!(!e.to_string().is_empty());
        }
    }
}

#[test]
fn alignment_needs_a_cycle_that_divides_a_second_and_sync0() {
    let cycle = "cycle = \"1ms\"";
    let aligned = |cycle: &str| format!("cycle = \"{cycle}\"\ncommon_time = \"align\"");
    let machine = with_esi(&GOOD.replacen(cycle, &aligned("1ms"), 1)).expect("good");
    assert_eq!(machine.bus.common_time, CommonTimeUse::Align);
    let found = broken(cycle, &aligned("3ms"));
    let text = "a second is not a whole number of cycles of 3 ms";
    assert!(found.iter().any(|p| p.message.contains(text)), "{found:#?}");
    let off = GOOD
        .replacen(cycle, &aligned("1ms"), 1)
        .replace("mode = \"cs", "dc = \"off\"\nmode = \"cs");
    let found = problems(&off);
    assert!(
        found
            .iter()
            .any(|p| p.message.contains("no device has SYNC0")),
        "{found:#?}"
    );
}
