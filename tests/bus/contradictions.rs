//! Keys and `sdo` entries that contradict the drive, the process data or the cycle: what `check`
//! accepts, notes and rejects, and what the drive receives.

use ecaxis_ecat::index::{AxisIndex, DeviceIndex};
use ecaxis_master::config::{Machine, TorqueLimit};
use ecaxis_master::session::Options;
use ecaxis_test_support::bench::Bench;
use ecaxis_test_support::{case, fixture, run, run_badly, run_well, virtual_time};

fn drive(device: &str, axis: &str) -> String {
    format!(
        r#"
[bus]
nic = "sim"
cycle = "2ms"

[[device]]
name = "x"
esi = "esi/EPOS4.xml"
position = 0
mode = "csp"
{device}

[device.axis]
encoder = 2000
{axis}
"#
    )
}

/// Axes without steps hold their position until the end.
fn shortly() -> Options {
    Options {
        limit: Some(200_000_000),
        ..virtual_time()
    }
}

const LIMITS: &str = "limits = { position = [-40.0, 40.0], velocity = 20.0, acceleration = 200.0 }";

fn notes(machine: &Machine) -> String {
    machine.devices[DeviceIndex(0)].selection.notes.join("\n")
}

/// Returns the bytes of a start-up SDO.
fn startup(machine: &Machine, index: u16, sub: u8) -> Option<Vec<u8>> {
    let startup = &machine.devices[DeviceIndex(0)].selection.startup;
    let mut written = startup.iter().rev();
    let sdo = written.find(|sdo| (sdo.index, sdo.sub) == (index, sub))?;
    Some(sdo.data.clone())
}

/// Adds objects to the drive's dictionary.
fn with_objects(objects: &str) -> Bench {
    let bench = Bench::new();
    bench.change("esi/EPOS4.xml", |esi| {
        esi.replacen("</Objects>", &format!("{objects}</Objects>"), 1)
    });
    bench
}

fn object(index: &str, kind: &str, bits: u8, info: &str) -> String {
    format!(
        "<Object><Index>#x{index}</Index><Name>{index}</Name><Type>{kind}</Type><BitSize>{bits}</BitSize>\
         <Info>{info}</Info><Flags><Access>rw</Access></Flags></Object>"
    )
}

/// Replaces the range of an object of the drive.
fn with_range(index: &str, range: &str) -> Bench {
    let bench = Bench::new();
    bench.change("esi/EPOS4.xml", |esi| {
        let at = esi.find(&format!("<Index>#x{index}</Index>")).expect(index);
        let info = at + esi[at..].find("<Info>").expect("its default") + "<Info>".len();
        format!("{}{range}{}", &esi[..info], &esi[info..])
    });
    bench
}

#[test]
fn an_sdo_that_contradicts_the_process_data_the_mode_or_the_cycle_is_rejected() {
    let bench = Bench::new();
    let refused = |sdo: &str, expected: &str| {
        let device = format!("sdo = [{{ index = 0x6065, value = 2500 }}, {sdo}]");
        let error = bench.parse(&drive(&device, LIMITS)).expect_err(sdo);
        assert!(error.contains(expected), "{sdo}: {error}");
        // The line of the list, and the column of the entry.
        assert!(error.contains("machine.toml:11:42"), "{sdo}: {error}");
    };
    for (sdo, expected) in [
        (
            "{ index = 0x6040, value = 6 }",
            "0x6040:00 (Controlword) commands the drive",
        ),
        ("{ index = 0x6060, value = 9 }", "contradicts `mode`"),
        ("{ index = 0x607A, value = 0 }", "is a target of the axis"),
        ("{ index = 0x60FF, value = 0 }", "is a target of the axis"),
        ("{ index = 0x6071, value = 0 }", "is a target of the axis"),
        (
            "{ index = 0x60C2, sub = 1, value = 10 }",
            "0x60c2:01 (Interpolation time period value), 10 ms, contradicts `bus.cycle`",
        ),
        (
            "{ index = 0x60C2, sub = 2, value = -4 }",
            ", 200 µs, contradicts `bus.cycle`",
        ),
        (
            "{ index = 0x1C12, value = 0, type = \"u8\" }",
            "0x1c12:00 (RxPDO assignment, number of PDOs) follows from `mode`",
        ),
        (
            "{ index = 0x1C13, sub = 1, value = 0x1A00, type = \"u16\" }",
            "follows from `mode`",
        ),
        (
            "{ index = 0x1600, sub = 1, value = 0x60400010, type = \"u32\" }",
            "follows from `mode`",
        ),
        (
            "{ index = 0x1A00, value = 0, type = \"u8\" }",
            "follows from `mode`",
        ),
        ("{ index = 0x60B2, value = 5 }", "adds to every target"),
    ] {
        refused(sdo, expected);
    }
    // Equal values are accepted.
    for sdo in [
        "{ index = 0x6060, value = 8 }",
        "{ index = 0x60C2, sub = 1, value = 2 }",
        "{ index = 0x60C2, sub = 1, value = 20 }, { index = 0x60C2, sub = 2, value = -4 }",
        "{ index = 0x60B2, value = 0 }",
    ] {
        bench.machine(&drive(&format!("sdo = [{sdo}]"), LIMITS));
    }
    let homing = format!("{LIMITS}\nhoming = {{ method = 35 }}");
    let method = |n: u8| format!("sdo = [{{ index = 0x6098, value = {n} }}]");
    let error = bench
        .parse(&drive(&method(37), &homing))
        .expect_err("35 and 37");
    assert!(
        error.contains("0x6098:00 (Homing method) follows from `homing`"),
        "{error}"
    );
    bench.machine(&drive(&method(35), &homing));
}

#[test]
fn the_interpolation_time_is_the_cycle_if_csp_is_reachable_from_a_profile_mode() {
    let bench = Bench::new();
    let pdo = "pdo.rx = [\"0x6040\", \"0x6060\", \"0x607A\", \"0x6081\", \"0x6083\", \"0x6084\"]\n\
               pdo.tx = [\"0x6041\", \"0x6061\", \"0x6064\"]";
    let text = drive(pdo, LIMITS).replace("\"csp\"", "\"pp\"");
    let machine = bench.machine(&text);
    // In this ESI, only the module of CSP has the object.
    let unknown = "does not receive the cycle of 2000 µs";
    assert!(notes(&machine).contains(unknown), "{}", notes(&machine));
    // Without 0x6060 the axis remains in PP.
    let alone = text.replace("\"0x6060\", ", "");
    let alone = bench.machine(&alone);
    assert!(!notes(&alone).contains(unknown), "{}", notes(&alone));
    let csp = bench.machine(&text.replace("\"pp\"", "\"csp\""));
    assert_eq!(startup(&csp, 0x60c2, 1), Some(vec![2]));
    assert_eq!(startup(&csp, 0x60c2, 2), Some(vec![0xfd]));
}

#[test]
fn polarity_is_rejected_if_the_axis_commands_torques() {
    let polarity = object("607E", "USINT", 8, "<DefaultValue>0</DefaultValue>");
    let bench = with_objects(&polarity);
    let torques = "pdo.rx = [\"0x6040\", \"0x6060\", \"0x607A\", \"0x6071\"]\n\
                   pdo.tx = [\"0x6041\", \"0x6061\", \"0x6064\", \"0x6077\"]";
    let positions = "pdo.rx = [\"0x6040\", \"0x607A\"]\npdo.tx = [\"0x6041\", \"0x6064\"]";
    for (value, pdo, rejected) in [
        ("0xC0", torques, true),
        ("0xE0", torques, true),
        ("0x20", torques, true),
        ("0x00", torques, false),
        ("0xC0", positions, false),
        ("0x80", positions, true),
        ("0x40", positions, true),
    ] {
        let sdo = format!("sdo = [{{ index = 0x607E, value = {value} }}]\n{pdo}");
        let parsed = bench.parse(&drive(&sdo, LIMITS));
        assert_eq!(parsed.is_err(), rejected, "{value} {pdo}: {parsed:?}");
        let text = parsed.map_or_else(|error| error, |machine| notes(&machine));
        let names = text.contains(&format!("0x607e:00 is {value}, expected 0x00"));
        assert_eq!(names, value != "0x00", "{value}: {text}");
    }
    // The drive holds the value; the file does not write it.
    let held = with_objects(&polarity.replace(">0<", ">192<"));
    let (error, summary) = run_badly(held.machine(&drive(torques, LIMITS)), virtual_time());
    assert!(error.contains("0x607e:00 is 0xC0"), "{error}");
    assert!(summary.is_none(), "nothing has moved");
}

#[test]
fn a_torque_limit_is_written_to_the_drive_or_reported() {
    let bench = Bench::new();
    let limits = LIMITS.replace("velocity", "torque = 80.0, velocity");
    let said = "warning: `limits.torque` acts in CST only";
    let alone = notes(&bench.machine(&drive("", &limits)));
    assert!(alone.contains(said), "{alone}");
    let limits = format!("torque_limit_in_drive = true\n{limits}");
    let machine = bench.machine(&drive("", &limits));
    let value = Some(800_u16.to_le_bytes().to_vec());
    assert_eq!(startup(&machine, 0x6072, 0), value);
    assert!(
        !notes(&machine).contains("limits.torque"),
        "{}",
        notes(&machine)
    );
    let move_there = "[[step]]\nmove = { x = 1.0 }\n";
    run_well(
        bench.machine(&(drive("", &limits) + move_there)),
        virtual_time(),
    );
    // In CST alone, the axis limits its targets.
    let cst = drive("", &limits).replace("\"csp\"", "\"cst\"");
    let axis = |machine: &Machine| machine.axes[AxisIndex(0)].torque_limit.clone();
    assert_eq!(axis(&bench.machine(&cst)), TorqueLimit::NotNeeded);
    // Without 0x6072: both directions, or an error.
    let without = |more: &str| {
        let bench = Bench::new();
        bench.change("esi/EPOS4.xml", |esi| {
            esi.replacen("#x6072<", "#x2072<", 1).replacen(
                "</Objects>",
                &format!("{more}</Objects>"),
                1,
            )
        });
        bench.parse(&drive("", &limits))
    };
    let none = without("").expect_err("nothing to write");
    assert!(
        none.contains("the ESI has neither 0x6072 nor 0x60E0 and 0x60E1"),
        "{none}"
    );
    let both = ["60E0", "60E1"].map(|index| object(index, "UINT", 16, ""));
    let both = without(&both.concat()).expect("both directions");
    for index in [0x60e0, 0x60e1] {
        assert_eq!(startup(&both, index, 0), value);
    }
    // An entry that lets the drive have more, and one that does not.
    let written = |value: u16| format!("sdo = [{{ index = 0x6072, value = {value} }}]");
    let more = notes(&bench.machine(&drive(&written(2000), &limits)));
    assert!(
        more.contains("an `sdo` entry lets the drive have more"),
        "{more}"
    );
    let equal = notes(&bench.machine(&drive(&written(800), &limits)));
    assert!(!equal.contains("limits.torque"), "{equal}");
    // The ESI's range.
    let ranged = with_range("6072", "<MinValue>0</MinValue><MaxValue>700</MaxValue>");
    let error = ranged.parse(&drive("", &limits)).expect_err("800 of 700");
    assert!(
        error.contains("0x6072:00: 800 is outside what the ESI allows, 0 to 700"),
        "{error}"
    );
}

#[test]
fn homing_is_compared_with_the_ranges_of_the_esi() {
    // An object of a vendor: the ESI lists what the drive has.
    let vendor = object("2100", "UINT", 16, "");
    let bench = |range: &str| {
        let bench = with_range("6098", range);
        bench.change("esi/EPOS4.xml", |esi| {
            esi.replacen("</Objects>", &format!("{vendor}</Objects>"), 1)
        });
        bench
    };
    let range = "<MinValue>-2</MinValue><MaxValue>35</MaxValue>";
    let check = |homing: &str| {
        bench(range).parse(&drive("", &format!("{LIMITS}\nhoming = {{ {homing} }}")))
    };
    for (homing, expected) in [
        (
            "method = 37",
            "0x6098:00 (Homing method): 37 is outside what the ESI allows, -2 to 35",
        ),
        ("method = -1, threshold = 100", "the drive has no 0x30b2:00"),
        ("method = 35, distance = 1.0", "the drive has no 0x30b1:00"),
        ("method = 15", "homing method 15 is none of CiA 402"),
    ] {
        let error = check(homing).expect_err(homing);
        assert!(error.contains(expected), "{homing}: {error}");
    }
    for (homing, noted) in [
        ("method = -1", false),
        ("method = 35", false),
        ("method = -17", true),
    ] {
        let notes = notes(&check(homing).expect(homing));
        assert_eq!(
            notes.contains("homing method of the vendor: -17"),
            noted,
            "{homing}: {notes}"
        );
    }
}

#[test]
fn an_assumed_velocity_unit_is_reported_and_powers_of_ten_are_read() {
    let bench = Bench::new();
    let unit = |text: &str| drive("", &format!("velocity_unit = \"{text}\"\n{LIMITS}"));
    for (text, expected) in [
        ("0.1rpm", "0.1 rpm"),
        ("mrpm", "mrpm"),
        ("10^-5 turns/s", "10^-5 turns/s"),
    ] {
        let machine = bench.machine(&unit(text));
        let scale = machine.axes[AxisIndex(0)].config.scale;
        assert_eq!(scale.velocity_unit().to_string(), expected);
        // The ESI's 0x60A9 is rpm.
        let notes = notes(&machine);
        assert!(
            notes.contains(&format!("(rpm), expected {expected} (in the ESI")),
            "{notes}"
        );
    }
    let error = bench.parse(&unit("0.3rpm")).expect_err("no power of ten");
    assert!(
        error.contains("`velocity_unit` cannot be \"0.3rpm\""),
        "{error}"
    );
    bench.change("esi/EPOS4.xml", |esi| esi.replacen("#x60A9<", "#x20A9<", 1));
    let assumed = notes(&bench.machine(&drive("", LIMITS)));
    assert!(
        assumed.contains("velocities are assumed to be in counts/s"),
        "{assumed}"
    );
    assert!(!notes(&bench.machine(&unit("rpm"))).contains("assumed"));
}

#[test]
fn a_start_takes_the_position_of_an_absolute_encoder_only_if_it_is_unique() {
    let bench = Bench::new();
    let axis = |keys: &str| drive("", keys).replacen("encoder = 2000\n", "absolute = true\n", 1);
    let free = "limits = { velocity = 20.0, acceleration = 200.0 }";
    for (keys, expected) in [
        // 49 · 8388608 / 3 counts are no part of 2^32.
        (
            "unit = \"deg\"\nencoder = 8388608\ngear = [49, 3]\nfeed = 360.0\nmodulo = 360.0",
            "its 2^32 counts are 31.346939 times 360 deg, no whole number: beyond 2^31 counts, 5642",
        ),
        ("encoder = 2000\nmodulo = 1.0", "no whole number"),
        ("encoder = 8388608", "the axis is endless"),
    ] {
        let text = axis(&format!("{keys}\n{free}"));
        let machine = bench.machine(&text);
        let text_of = notes(&machine);
        assert!(text_of.contains(expected), "{keys}: {text_of}");
        let (outcome, _) = run(bench.machine(&text), shortly());
        outcome.result.expect("nothing moves");
        assert!(!machine.axes[AxisIndex(0)].config.absolute_start, "{keys}");
    }
    for keys in [
        format!("encoder = 8388608\nmodulo = 4.0\n{free}"),
        format!("encoder = 2000\n{LIMITS}"),
    ] {
        let machine = bench.machine(&axis(&keys));
        assert!(machine.axes[AxisIndex(0)].config.absolute_start, "{keys}");
        assert!(!notes(&machine).contains("`absolute`"), "{keys}");
    }
    let far = "encoder = 8388608\nlimits = { position = [300.0, 310.0], velocity = 20.0, acceleration = 200.0 }";
    let error = bench.parse(&axis(far)).expect_err("beyond 256 turns");
    assert!(
        error.contains("goes beyond the drive's 2^31 counts, 256 turn"),
        "{error}"
    );
}

#[test]
fn a_position_range_that_the_axis_leaves_is_rejected_at_bring_up() {
    let data_type = "<DataType><Name>DT607B</Name><BitSize>80</BitSize>\
        <SubItem><SubIdx>0</SubIdx><Name>Highest</Name><Type>USINT</Type><BitSize>8</BitSize><BitOffs>0</BitOffs></SubItem>\
        <SubItem><SubIdx>1</SubIdx><Name>Min</Name><Type>DINT</Type><BitSize>32</BitSize><BitOffs>16</BitOffs><Flags><Access>rw</Access></Flags></SubItem>\
        <SubItem><SubIdx>2</SubIdx><Name>Max</Name><Type>DINT</Type><BitSize>32</BitSize><BitOffs>48</BitOffs><Flags><Access>rw</Access></Flags></SubItem></DataType>";
    let item = |name: &str, value: i32| {
        format!(
            "<SubItem><Name>{name}</Name><Info><DefaultValue>{value}</DefaultValue></Info></SubItem>"
        )
    };
    let info = item("Highest", 2) + &item("Min", 0) + &item("Max", 7999);
    let bench = with_objects(&object("607B", "DT607B", 80, &info));
    bench.change("esi/EPOS4.xml", |esi| {
        esi.replacen("<DataTypes>", &format!("<DataTypes>{data_type}"), 1)
    });
    let (error, summary) = run_badly(bench.machine(&drive("", LIMITS)), virtual_time());
    assert!(
        error.contains("0x607b:01") && error.contains("positions jump there"),
        "{error}"
    );
    assert!(summary.is_none(), "nothing has moved");
    let inside = LIMITS.replace("-40.0, 40.0", "0.5, 3.5");
    let (outcome, _) = run(bench.machine(&drive("", &inside)), shortly());
    if let Err(error) = outcome.result {
        assert!(!error.to_string().contains("0x607b"), "{error}");
    }
}

#[test]
fn a_position_mode_needs_the_position() {
    let bench = Bench::new();
    let error = bench
        .parse(&drive("pdo.tx = [\"0x6041\"]", LIMITS))
        .expect_err("no position");
    assert!(
        error.contains("mode \"csp\" needs 0x6064 in the inputs"),
        "{error}"
    );
    assert!(error.contains("machine.toml:11:10"), "{error}");
}

/// Parses a machine file of the review of motion, with the vendors' ESI files.
fn review(name: &str) -> Option<Result<Machine, String>> {
    let text = std::fs::read_to_string(case(&format!("motion/{name}"))?).expect("a text file");
    let vendors = fixture("esi")?;
    let vendors = format!("{}/", vendors.display());
    let text = text
        .replace("../esi/EPOS4.xml", "esi/EPOS4.xml")
        .replace("../esi/", &vendors)
        .replace("esi/maxon/", &format!("{vendors}maxon/"));
    Some(Bench::new().parse(&text))
}

#[test]
fn review_of_motion_is_answered_by_check() {
    const REFUSED: bool = false;
    const ACCEPTED: bool = true;
    for (name, accepted, expected) in [
        (
            "reports/01-polarity-cst/m.toml",
            REFUSED,
            "0x607e:00 is 0xC0, expected 0x00",
        ),
        ("reports/02-gear-6091/encoder-10000.toml", ACCEPTED, ""),
        (
            "reports/02-gear-6091/encoder-8388608.toml",
            REFUSED,
            "an encoder of 8388608 makes 10000 counts",
        ),
        (
            "reports/03-absolute-modulo/first-day.toml",
            ACCEPTED,
            "2^32 counts are 31.346939 times 360 deg",
        ),
        (
            "reports/03-absolute-modulo/after-restart.toml",
            ACCEPTED,
            "2^32 counts are 31.346939 times 360 deg",
        ),
        (
            "reports/06-homing-vendor-methods/sv660-minus1.toml",
            ACCEPTED,
            "",
        ),
        (
            "reports/06-homing-vendor-methods/sv660-minus17.toml",
            ACCEPTED,
            "homing method of the vendor",
        ),
        (
            "reports/06-homing-vendor-methods/sv660-minus1-threshold.toml",
            REFUSED,
            "the drive has no 0x30b2:00",
        ),
        (
            "reports/06-homing-vendor-methods/a6-37.toml",
            REFUSED,
            "37 is outside what the ESI allows, … to 35",
        ),
        (
            "reports/07-velocity-unit/a6-csv.toml",
            ACCEPTED,
            "velocities are assumed to be in counts/s",
        ),
        (
            "reports/07-velocity-unit/tenth-rpm.toml",
            ACCEPTED,
            "expected 0.1 rpm",
        ),
        (
            "reports/08-sdo-process-objects/6040.toml",
            REFUSED,
            "0x6040:00 (Controlword) commands the drive",
        ),
        (
            "reports/08-sdo-process-objects/60C2.toml",
            REFUSED,
            "10 ms, contradicts `bus.cycle`",
        ),
        (
            "reports/09-endless-607d/epos4.toml",
            ACCEPTED,
            "0x607d:01 and :02 are the whole range",
        ),
        ("documents/b2_pp_then_csp.toml", ACCEPTED, ""),
        (
            "documents/b3_60c2_contradicts_cycle.toml",
            REFUSED,
            "5 ms, contradicts `bus.cycle`",
        ),
        (
            "documents/c2_gear_speed.toml",
            REFUSED,
            "0x3003:03 = 1000 rpm allows 16.666667 turn/s",
        ),
        (
            "documents/c3_csp_without_6064.toml",
            REFUSED,
            "needs 0x6064 in the inputs",
        ),
        (
            "documents/c8_module_against_mode.toml",
            REFUSED,
            "module \"CSV Mode\" is not for mode csp",
        ),
    ] {
        let Some(parsed) = review(name) else { return };
        assert_eq!(parsed.is_ok(), accepted, "{name}: {parsed:?}");
        if name.ends_with("b2_pp_then_csp.toml") {
            let machine = parsed.as_ref().expect("accepted");
            assert_eq!(startup(machine, 0x60c2, 1), Some(vec![2]), "{name}");
        }
        let text = parsed.map_or_else(|error| error, |machine| notes(&machine));
        assert!(text.contains(expected), "{name}: {text}");
    }
}

/// What only the bus showed: no process data, a SYNC0 that does not fit, too little current, too many
/// bytes.
#[test]
fn check_finds_what_a_run_would_meet() {
    let mailbox = "<Sm DefaultSize=\"128\" StartAddress=\"#x1000\" ControlByte=\"#x26\" Enable=\"1\">MBoxOut</Sm>\
        <Sm DefaultSize=\"128\" StartAddress=\"#x1100\" ControlByte=\"#x22\" Enable=\"1\">MBoxIn</Sm>";
    let outputs = |entries: usize| {
        let entry = "<Entry><Index>#x7000</Index><SubIndex>1</SubIndex><BitLen>64</BitLen>\
            <Name>Out</Name><DataType>ULINT</DataType></Entry>";
        format!(
            "<Sm StartAddress=\"#x2000\" ControlByte=\"#x64\" Enable=\"1\">Outputs</Sm>\
             <RxPdo Sm=\"2\" Fixed=\"1\"><Index>#x1600</Index><Name>P</Name>{}</RxPdo>",
            entry.repeat(entries)
        )
    };
    let device = |product: u32, physics: &str, info: &str, body: &str| {
        format!(
            "<Device Physics=\"{physics}\"><Type ProductCode=\"{product}\" RevisionNo=\"1\">D{product}</Type>\
             <Name>Device {product}</Name><Info>{info}</Info>{body}</Device>"
        )
    };
    let current = |ma: i32| format!("<Electrical><EBusCurrent>{ma}</EBusCurrent></Electrical>");
    let clock = "<Mailbox><CoE/></Mailbox><Dc><OpMode><Name>DC</Name>\
        <AssignActivate>#x300</AssignActivate><CycleTimeSync0>250000</CycleTimeSync0></OpMode></Dc>";
    let devices = [
        device(1, "YKY", &current(-200), ""),
        device(2, "KK", &current(150), ""),
        device(3, "YY", "", &format!("{mailbox}{}{clock}", outputs(1))),
        device(
            4,
            "YY",
            "",
            &format!("{mailbox}{}<Mailbox><CoE/></Mailbox>", outputs(210)),
        ),
        device(5, "KK", &current(-500), ""),
        device(6, "KKYY", "", ""),
    ];
    let bench = Bench::new();
    bench.write(
        "own.xml",
        &format!(
            "<EtherCATInfo><Vendor><Id>9</Id></Vendor><Descriptions><Devices>{}</Devices>\
             </Descriptions></EtherCATInfo>",
            devices.concat()
        ),
    );
    let check = |cycle: &str, products: &[u32]| {
        let mut text = format!("[bus]\nnic = \"sim\"\ncycle = \"{cycle}\"\nlost_frames = 20\n");
        for (position, product) in products.iter().enumerate() {
            text += &format!(
                "[[device]]\nname = \"d{position}\"\nesi = \"own.xml\"\nproduct = {product}\n\
                 position = {position}\n"
            );
        }
        let machine = bench.parse(&text)?;
        let devices = machine.devices.iter();
        let notes =
            devices.flat_map(|d| d.selection.notes.iter().map(|n| format!("{}: {n}", d.name)));
        Ok::<_, String>(notes.collect::<Vec<_>>().join("\n"))
    };
    for (cycle, warned) in [
        ("400us", true),
        ("500us", false),
        ("125us", false),
        ("1ms", false),
    ] {
        let notes = check(cycle, &[3]).expect("accepted");
        assert_eq!(
            notes.contains("must be a multiple of it, such as 500 µs"),
            warned,
            "{notes}"
        );
    }
    for (products, warned) in [
        (&[1, 2][..], ""),
        (
            &[1, 2, 2],
            "d0: warning: 2 devices on its E-bus take 300 mA, and it supplies 200 mA",
        ),
        (&[1, 2, 5, 2, 2, 2], ""),
        (
            &[1, 2, 5, 2, 2, 2, 2],
            "d2: warning: 4 devices on its E-bus take 600 mA",
        ),
        (&[1, 2, 3, 2], ""),
        (&[2, 2], ""),
        // What follows a junction may be on the E-bus before it.
        (&[1, 6, 1, 2, 2, 2], ""),
    ] {
        let notes = check("1ms", products).expect("accepted");
        assert!(notes.contains(warned), "{products:?}: {notes}");
        assert_eq!(
            notes.contains("E-bus"),
            !warned.is_empty(),
            "{products:?}: {notes}"
        );
    }
    let error = check("4ms", &[1, 4]).expect_err("too many bytes");
    assert!(
        error.contains("`d1`: 1680 bytes of process data do not fit into one frame"),
        "{error}"
    );
    // An image that describes a mailbox and no PDO.
    let file = ecaxis_esi::parse(bench.read("esi/MIO2.xml").as_bytes()).expect("an ESI file");
    let image = ecaxis_esi::sii::emit(
        &file.devices[0],
        &[],
        &ecaxis_esi::sii::SiiOptions::default(),
    );
    std::fs::write(bench.path().join("own.sii"), image).expect("a file");
    let text =
        "[bus]\ncycle = \"1ms\"\n[[device]]\nname = \"d\"\nsii = \"own.sii\"\nposition = 0\n";
    let notes = notes(&bench.parse(text).expect("accepted"));
    assert!(
        notes.contains("warning: the EEPROM image describes no PDO"),
        "{notes}"
    );
}
