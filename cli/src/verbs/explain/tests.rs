use super::*;
use crate::render::pdo_table::{short_name, value};
use ecaxis_ecat::index::GroupIndex;

#[test]
fn frame_bytes_match_a_manual_count() {
    for (axes, bytes) in [(8, 168), (32, 456), (100, 1272)] {
        let axis = image::ProcessData {
            out_len: 12,
            in_len: 12,
            group: GroupIndex(0),
            lrw: true,
            mailbox: false,
            op_only: image::OpOnly::default(),
        };
        let plan = image::plan(&vec![axis; axes]).unwrap();
        let frames = frame_bytes(&plan, true);
        assert_eq!(
            frames.iter().sum::<usize>(),
            bytes + AL_STATUS + MAX_POLL_DATAGRAM,
            "{axes} axes"
        );
        assert_eq!(frames.len(), 1);
    }
    let idle = frame_bytes(&image::plan(&[]).unwrap(), false);
    assert_eq!(idle, [84]);
}

#[test]
fn short_name_omits_the_object_name() {
    for (name, short) in [
        ("RxPDO assignment / Assigned PDOs", "Assigned PDOs"),
        ("RxPDO / SubIndex 001", "RxPDO / SubIndex 001"),
        ("Modes of operation", "Modes of operation"),
    ] {
        assert_eq!(short_name(name), short);
    }
}

#[test]
fn explain_fits_a_terminal_and_shows_assumptions() {
    let configs = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs");
    let demo = std::fs::read_to_string(configs.join("demo.toml")).unwrap();
    let explained = |text: &str| {
        let machine = config::parse(&configs.join("demo.toml"), text).unwrap();
        let out = explain(&machine, None).text(None);
        out.replace(&configs.display().to_string(), "configs")
    };
    let text = explained(&demo);
    let wide: Vec<&str> = text.lines().filter(|l| l.chars().count() > 100).collect();
    assert!(wide.is_empty(), "{wide:#?}");
    assert!(text.contains("0x60A9 in the ESI, until the drive is asked"));
    assert!(!text.contains("assumed"));
    let all = "velocity_unit = \"rpm\"\ntorque_unit = \"A\"\ntorque_constant = 0.0385\ninvert = true\noffset = 2.5\ndead_time = \"2ms\"\n\
        csv = { kv = 30.0 }\ncst = { kp = 400.0, tn = \"40ms\" }\nsupervise = { torque = 0.5, acceleration = 9000.0 }\n\
        brake = { release = \"80ms\", engage = \"120ms\" }\nfault_reset = { tries = 3 }\non_trip = \"ramp\"\n";
    let (before, after) = demo.split_once("encoder ").unwrap();
    let text = explained(&format!(
        "{before}{all}encoder {}",
        after.replacen("torque = 100.0", "torque = 2.0", 1)
    ));
    let wide: Vec<&str> = text.lines().filter(|l| l.chars().count() > 110).collect();
    assert!(wide.is_empty(), "{wide:#?}");
    for (value, origin) in [
        ("2000 counts a motor turn", "`encoder`, held against 0x608F"),
        ("inverted", "`invert`"),
        ("in rpm, steps of", "`velocity_unit`; the drive is asked"),
        ("in rpm/s", "0x60AA in the ESI, until the drive is asked"),
        ("in A", "`torque_unit`"),
        ("0.1 Nm", "0x6076 in the ESI, until the drive is asked"),
        ("0.0385 Nm/A", "`torque_constant`"),
        ("2 A (77 % of rated)", "`limits.torque`"),
        ("Kv 30 1/s, feed-forward 1", "`csv`"),
        ("Tn 40 ms", "`cst`"),
        ("2 ms", "`dead_time`"),
        ("above 0.5 A for 100 ms", "`supervise.torque`"),
        ("above 9000", "`supervise.acceleration`"),
        ("by the acceleration limit, then no power", "`on_trip`"),
        ("by itself after 1 s, 3 times", "`fault_reset`"),
        ("opens in 80 ms, closes in 120 ms", "`brake`"),
    ] {
        let line = text
            .lines()
            .find(|l| l.contains(value) && l.contains(origin));
        assert!(line.is_some(), "{value}, {origin}: {text}");
    }
}

#[test]
fn explain_shows_stops_and_groups() {
    let configs = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs");
    let explained = |file: &str| {
        let machine = config::load(&configs.join(file)).unwrap();
        let out = explain(&machine, None).text(None);
        let (_, stop) = out.split_once("\nstop\n").unwrap();
        let (stop, _) = stop.split_once("\nprogram").unwrap();
        (out.contains("2 LRW"), stop.to_owned())
    };
    let (several, text) = explained("demo.toml");
    assert!(
        !several && text.contains("all axes stop together"),
        "{text}"
    );
    let (several, text) = explained("groups.toml");
    assert!(several, "a datagram for the gantry, one for the rest");
    let wide: Vec<&str> = text.lines().filter(|l| l.chars().count() > 110).collect();
    assert!(wide.is_empty(), "{wide:#?}");
    for words in [
        &[
            "an axis faults or trips",
            "the others: within their limits",
            "`others`",
        ][..],
        &["3 cycles", "the drives' quick stop", "`bus_lost`"],
        &["emergency stop", "no condition"],
        &["gantry", "x y", "quick stop", "continues"],
        &["(the rest)", "z", "within their limits", "stops"],
    ] {
        let line = text
            .lines()
            .find(|l| words.iter().all(|word| l.contains(word)));
        assert!(line.is_some(), "{words:?}: {text}");
    }
}

#[test]
fn value_formats_bytes_as_number() {
    assert_eq!(value(&[0x10, 0x27]), "0x2710");
    assert_eq!(value(&[1; 9]), "01 01 01 01 01 01 01 01 01");
    assert_eq!(value(&[]), "");
}

#[test]
fn limits_of_a_corrected_load_are_next_to_those_of_the_drive() {
    let configs = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs");
    let demo = std::fs::read_to_string(configs.join("demo.toml")).unwrap();
    let keys = "compensation = { backlash = 0.05, homing_ends = \"negative\" }\nencoder ";
    let machine = config::parse(
        &configs.join("demo.toml"),
        &demo.replacen("encoder ", keys, 1),
    );
    let text = explain(&machine.unwrap(), None).text(None);
    let text = text.replace(&configs.display().to_string(), "configs");
    for (load, file) in [
        (
            "237.5 of 250 mm/s (2850 rpm)",
            "`limits.velocity`, `compensation`",
        ),
        (
            "2250 of 2500 mm/s²",
            "`limits.acceleration`, `compensation`",
        ),
        ("40000 of 50000 mm/s³", "in 50 ms, `compensation`"),
    ] {
        let row = text.lines().find(|row| row.contains(load)).unwrap_or(&text);
        assert!(row.contains(file), "{row}");
    }
    let wide: Vec<&str> = text.lines().filter(|l| l.chars().count() > 110).collect();
    assert!(wide.is_empty(), "{wide:#?}");
}
