//! Mistakes in the description of a gateway, and the process data of a node.

use std::path::Path;

use super::super::{ConfigError, load, parse};

/// Returns the problems of an example machine with one text replaced.
fn broken(file: &str, from: &str, to: &str) -> Vec<(String, String)> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../configs")
        .join(file);
    let text = std::fs::read_to_string(&path).unwrap();
    assert!(text.contains(from), "{from}");
    match parse(&path, &text.replacen(from, to, 1)) {
        Err(ConfigError::Problems(problems)) => problems
            .into_iter()
            .map(|problem| (problem.message, problem.hint.unwrap_or_default()))
            .collect(),
        other => panic!("{from} → {to}: {other:?}"),
    }
}

#[test]
#[rustfmt::skip] // one row per mistake
fn gateway_rejects_invalid_settings() {
    for (from, to, message, hint) in [
        ("\"EPOS 24/1\"", "\"EPOS 24/2\"", "unknown drive `EPOS 24/2`", "did you mean `EPOS 24/1`?"),
        ("id      = 1", "id = 16", "takes node numbers up to 15", ""),
        ("id      = 1", "id = 128", "a whole number from 1 to 127", ""),
        ("id        = 2", "id = 1", "node 1 is there twice", ""),
        ("drive   = \"EPOS 24/1\"\n", "", "`drive` is missing in [[device.node]]", "EPOS 24/5"),
        ("at = 8", "at = 600", "a whole number from 2 to 511", ""),
        ("pdo = 2, at = 24", "pdo = 2, at = 60", "6 bytes at 60 do not lie", ""),
        ("pdo = 3, at = 18", "pdo = 4, at = 18", "a whole number from 1 to 3", ""),
        ("\"0x6041\", \"0x6064\"", "\"0x6042\"", "0x6042:00 cannot be mapped", ""),
        ("\"0x6041\", \"0x6064\"", "\"0x6040\"", "0x6040:00 with 16 bits cannot be mapped", ""),
        ("bit_rate = 1_000_000", "bit_rate = 9600", "no such bit rate", "500000"),
        ("heartbeat = \"50ms\"", "heartbeat = \"1ms\"", "10 ms to 65 s", ""),
        ("mandatory =", "mandatry =", "unknown key `mandatry`", "did you mean `mandatory`?"),
        ("[device.axis]", "[device.can]\nbit_rate = 1_000_000\n[device.axis]", "`EPOS4` is not a CANopen gateway", "0x2100"),
    ] {
        let found = broken("gateway.toml", from, to);
        let [(said, hinted)] = found.as_slice() else {
            panic!("{from} → {to}: {found:?}")
        };
        assert!(said.contains(message) && hinted.contains(hint), "{said}: {hinted}");
    }
}

#[test]
#[rustfmt::skip] // one row per mistake
fn axes_behind_a_gateway_reject_what_cannot_work() {
    for (from, to, message, hint) in [
        ("at = 11, objects", "at = 10, objects", "bytes 10 to 15 overlap PDO 3 of node 1 at 8 to 10", "`at = 11`"),
        ("sync     = \"4ms\"", "sync = \"1ms\"", "occupied for 1", "`sync = \"3ms\"`"),
        ("sync     = \"4ms\"", "sync = \"4500us\"", "not a multiple of the cycle of 1 ms", "`sync` or `cycle`"),
        ("\"0x2062\"] }, { pdo = 3, at = 8 }", "\"0x607A\"] }, { pdo = 3, at = 8 }", "needs 0x2062:00 (position mode setting value)", "\"csp\""),
        (", { pdo = 3, at = 8 }]\ninputs", "]\ninputs", "needs 0x6060:00 (modes of operation, in PDO 3) in the `outputs`", "PDO 3"),
        ("\"0x6064\"] }, { pdo = 3, at = 8 }]", "\"0x606C\"] }, { pdo = 3, at = 8 }]", "needs 0x6064:00", ""),
        ("id      = 1\n", "id = 1\nmode = \"csv\"\n", "mode \"csv\" is not safe behind a gateway", "`velocity` steps"),
        ("id      = 1\n", "id = 1\nmode = \"pv\"\n", "the drive would go on", "\"csp\""),
        ("id      = 1\n", "id = 1\nmode = \"csb\"\n", "unknown mode \"csb\"", "did you mean `csp`?"),
        ("id      = 1\n", "id = 1\nmode = \"pp\"\n", "needs 0x607a:00 (target position", "Controlword and 0x607A"),
        ("id      = 1\n", "id = 1\nheartbeat = \"50ms\"\nguarding = \"50ms\"\n", "either a heartbeat or node guarding", ""),
        ("id      = 1\n", "id = 1\nheartbeat = \"0ms\"\n", "needs error control of its node", "50ms"),
        ("sync     = \"4ms\"", "sync = \"4ms\"\nstart_up = 0", "as the NMT master", "`start_up = 1`"),
        ("sync     = \"4ms\"", "sync = \"4ms\"\ninputs = 16", "do not lie between", ""),
        ("sync     = \"4ms\"", "sync = \"4ms\"\noutputs = 1", "a whole number from 2 to 512", ""),
        ("sync     = \"4ms\"", "sync = \"4ms\"\nobjects = [{ index = 0x1F89, value = 5 }]", "no such object", "type"),
        ("[[step]]\nhome = [\"feed\"]", "[[step]]\nmode = { feed = \"pv\" }\n[[step]]\nhome = [\"feed\"]", "cannot switch to \"pv\"", "csp"),
        ("name     = \"feed\"\n", "", "the axis of a node needs a `name`", "name = "),
        ("name     = \"feed\"", "name = \"x\"", "the name \"x\" is taken", ""),
        ("homing   = { method = 35", "homing = { method = 99", "99", ""),
    ] {
        let found = broken("mixed.toml", from, to);
        // Steps that name the axis may report it as well.
        let fits = |(said, hinted): &(String, String)| said.contains(message) && hinted.contains(hint);
        assert!(found.iter().any(fits), "{from} → {to}: {found:?}");
    }
}

/// No PDO can carry the speed of a drive's own profile.
#[test]
fn a_profile_move_behind_a_gateway_takes_no_speed() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/mixed.toml");
    let text = std::fs::read_to_string(&path).unwrap();
    let end = text.find("[[step]]").unwrap();
    let text = text[..end].replacen("id      = 1\n", "id = 1\nmode = \"pp\"\n", 1);
    let text = text.replacen("\"0x2062\"", "\"0x607A\"", 1);
    let with = |step: &str| {
        parse(
            &path,
            &format!("{text}[[step]]\nmove = {{ feed = 5.0 }}\n{step}"),
        )
    };
    let machine = with("").unwrap();
    let node = &machine.devices[machine.axes[ecaxis_ecat::index::AxisIndex(2)].device];
    let objects = &node.gateway.as_ref().unwrap().nodes[0].objects;
    // 50 mm/s and 250 mm/s² are 10 turns/s and 50 turns/s².
    let profile = [(0x6081, 600_u32), (0x6083, 3000), (0x6084, 3000)];
    for (index, value) in profile {
        assert!(
            objects.contains(&(index, 0, value.to_le_bytes().to_vec())),
            "{objects:x?}"
        );
    }
    for step in ["speed = 0.5\n", "ramp = 0.5\n"] {
        let Err(ConfigError::Problems(problems)) = with(step) else {
            panic!("{step}")
        };
        assert!(
            problems[0].message.contains("speed and ramp of its drive"),
            "{problems:?}"
        );
    }
}

#[test]
fn a_node_has_the_objects_of_an_axis_at_offsets_of_the_gateway() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/mixed.toml");
    let machine = load(&path).unwrap();
    let lift = machine
        .axes
        .iter()
        .find(|axis| axis.name == "lift")
        .unwrap();
    let device = &machine.devices[lift.device];
    let layout = &device.selection_of(lift).layout;
    for (output, index, byte, bits) in [
        (true, 0x6040, 11, 16),
        (true, 0x607a, 13, 32),
        (true, 0x6060, 19, 8),
        (false, 0x6041, 11, 16),
        (false, 0x6064, 13, 32),
        (false, 0x6061, 19, 8),
    ] {
        let field = match output {
            true => layout.rx_field(index, 0),
            false => layout.tx_field(index, 0),
        };
        let field = field.unwrap();
        assert_eq!(
            (field.bit_offset, field.bit_len),
            (byte * 8, bits),
            "{index:04x}"
        );
    }
    assert_eq!((layout.rx_bytes(), layout.tx_bytes()), (64, 64));
    assert!(!lift.config.follows_bit);
    assert!(
        (lift.config.dead_time_s - 6.17e-3).abs() < 1e-9,
        "{}",
        lift.config.dead_time_s
    );
}

/// The EDS fills in what the file leaves out, and its objects are checked.
#[test]
fn a_node_with_an_eds_has_its_contents() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let path = root.join("configs/mixed.toml");
    let text = std::fs::read_to_string(&path).unwrap();
    let eds = root.join("tests/judges/esi/epos.eds");
    let text = text.replacen(
        "id      = 1\n",
        &format!("id = 1\neds = \"{}\"\n", eds.display()),
        1,
    );
    let machine = parse(&path, &text).unwrap();
    let gateway = machine.devices[ecaxis_ecat::index::DeviceIndex(2)]
        .gateway
        .as_ref();
    let outputs = &gateway.unwrap().nodes[0].outputs;
    assert_eq!(outputs[0].contents, [(0x6040, 0, 16), (0x2062, 0, 32)]);
    let wrong = text.replacen("epos.eds", "epod.eds", 1);
    let Err(ConfigError::Problems(problems)) = parse(&path, &wrong) else {
        panic!("the file is missing")
    };
    assert!(problems[0].message.contains("epod.eds"), "{problems:?}");
}
