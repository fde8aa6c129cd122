use crate::config::tests::{GOOD, with_esi};
use ecaxis_axis::StopMethod;
use ecaxis_ecat::index::DeviceIndex;

use crate::config::{ConfigError, GroupStopScope, StopGroup};

#[test]
fn stop_groups_are_parsed_with_their_defaults() {
    let machine = with_esi(GOOD).unwrap();
    assert!(machine.stop.groups.is_empty());
    assert_eq!(
        [0, 1].map(|device| machine.group_of(DeviceIndex(device)).0),
        [0, 0]
    );
    let two = "\n[stop]\nothers = \"no-power\"\n[[stop.group]]\nname = \"g\"\naxes = [\"v\"]\noutside = \"continue\"\n\
        [[stop.group]]\nname = \"h\"\naxes = [\"x\"]\nothers = \"quick-stop\"\n";
    let machine = with_esi(&format!("{GOOD}{two}")).unwrap();
    assert_eq!(
        [0, 1].map(|device| machine.group_of(DeviceIndex(device)).0),
        [2, 1]
    );
    let group = |name: &str, device, others, outside| StopGroup {
        name: name.to_owned(),
        devices: vec![DeviceIndex(device)],
        others,
        outside,
    };
    assert_eq!(
        machine.stop.groups,
        [
            group("g", 1, StopMethod::DisableVoltage, GroupStopScope::Continue),
            group("h", 0, StopMethod::QuickStop, GroupStopScope::Stop),
        ]
    );
}

#[test]
fn a_group_may_consist_of_devices_alone() {
    let text = "\n[[device]]\nname = \"io\"\nesi = \"D1.xml\"\nposition = 2\n\
        [[stop.group]]\nname = \"g\"\ndevices = [\"io\"]\noutside = \"continue\"\n";
    let machine = with_esi(&format!("{GOOD}{text}")).unwrap();
    assert_eq!(machine.stop.groups[0].devices, [DeviceIndex(2)]);
}

#[test]
fn a_group_that_the_machine_goes_on_without_may_have_no_process_data() {
    let text = "\n[[device]]\nname = \"io\"\nesi = \"D1.xml\"\nposition = 2\npdo.rx = []\npdo.tx = []\n\
        [[stop.group]]\nname = \"g\"\ndevices = [\"io\"]\noutside = \"continue\"\n";
    let machine = with_esi(&format!("{GOOD}{text}")).unwrap();
    assert_eq!(machine.stop.groups[0].devices, [DeviceIndex(2)]);
}

#[test]
#[rustfmt::skip] // one row per mistake
fn stop_rejects_invalid_groups() {
    let io = "\n[[device]]\nname = \"io\"\nesi = \"D1.xml\"\nposition = 2\n";
    let group = "[[stop.group]]\nname = \"g\"\naxes = [\"x\"]\n";
    for (text, message, hint, marked) in [
        ("[[stop.group]]\naxes = [\"x\"]\n", "`name` is missing in [[stop.group]]", "name = \"gantry\"", ""),
        ("[[stop.group]]\nname = \"g\"\n", "nothing is in this [[stop.group]]", "axes = [\"x\", \"y\"]", ""),
        ("[[stop.group]]\nname = \"g\"\naxes = []\n", "nothing is named here", "a list such as", "[]"),
        ("[[stop.group]]\nname = \" \"\naxes = [\"x\"]\n", "a group needs a name", "", "\" \""),
        ("[[stop.group]]\nname = \"g\"\naxes = [\"q\"]\n", "no device is named `q`", "axes: `x`, `v`", "\"q\""),
        ("[[stop.group]]\nname = \"g\"\naxes = [\"io\"]\n", "`io` has no axis", "give it a [device.axis]", "\"io\""),
        ("[[stop.group]]\nname = \"g\"\naxes = [\"x\", \"x\"]\n", "`x` is named twice", "", "\"x\""),
        ("[[stop.group]]\nname = \"h\"\naxes = [\"x\"]\n[[stop.group]]\nname = \"g\"\naxes = [\"v\", \"x\"]\n", "`x` is in the group `h` already", "one group", "\"x\""),
        ("[[stop.group]]\nname = \"g\"\naxes = [\"x\"]\n[[stop.group]]\nname = \"g\"\naxes = [\"v\"]\n", "the group \"g\" is there already", "in line", "\"g\""),
        ("GROUPothers = \"gently\"\n", "`others` cannot be \"gently\"", "`ramp`", "\"gently\""),
        ("GROUPoutside = \"continues\"\n", "`outside` cannot be \"continues\"", "did you mean `continue`?", "\"continues\""),
        ("GROUPoutsid = \"stop\"\n", "unknown key `outsid` in [[stop.group]]", "did you mean `outside`?", "outsid"),
        ("GROUPdevices = [\"v\"]\n", "`v` has an axis", "name it in `axes`", "\"v\""),
        ("GROUPdevices = [\"oi\"]\n", "no device is named `oi`", "devices", "\"oi\""),
        ("[stop]\nemergency = { x.\"0x6041\" = 1 }\nGROUPoutside = \"continue\"\n", "an emergency would go unseen", "leave its device out", "x"),
    ] {
        let text = text.replace("GROUP", group);
        let Err(ConfigError::Problems(found)) = with_esi(&format!("{GOOD}{io}{text}")) else {
            panic!("{text}")
        };
        let [problem] = found.as_slice() else { panic!("{text}: {found:#?}") };
        assert!(problem.message.contains(message), "{problem}");
        assert!(problem.hint.as_deref().unwrap_or_default().contains(hint), "{problem}");
        if !marked.is_empty() {
            let at: String = problem.source_line.chars().skip(problem.column as usize - 1).take(problem.width as usize).collect();
            assert_eq!(at, marked, "{problem}");
        }
    }
}
