use std::path::PathBuf;

use super::super::{ConfigError, Machine, NameError, parse};
use super::*;

fn owner(kind: OwnerKind, line: u32) -> OutputOwner {
    match kind {
        OwnerKind::Controller | OwnerKind::Client => OutputOwner::without_line(kind),
        kind => OutputOwner::new(kind, format!("subject {line}"), line),
    }
}

fn bits(device: usize, name: &str, bits: Range<u32>) -> BitRange {
    BitRange {
        device: DeviceIndex(device),
        name: name.to_owned(),
        bits,
    }
}

/// Every pair of owners, with equal, contained and partly common bits. Only program, controllers and
/// clients share an output: one of them commands the machine at a time.
#[test]
fn no_two_owners_share_a_bit() {
    let common = [
        (8..16, 8..16),
        (8..16, 10..11),
        (10..11, 8..16),
        (8..16, 15..20),
        (8..16, 0..9),
    ];
    let apart = [(8..16, 16..24), (8..16, 0..8)];
    for first in OwnerKind::ALL {
        for second in OwnerKind::ALL {
            for (one, other) in &common {
                let mut roles = ProcessDataRoles::default();
                let own = owner(first, 11);
                roles
                    .claim(bits(1, "io.one", one.clone()), own.clone())
                    .expect("free");
                let found = roles.claim(bits(1, "io.two", other.clone()), owner(second, 22));
                if first.commands() && second.commands() {
                    found.expect("one owner");
                    continue;
                }
                let conflict = found.expect_err("two owners");
                let text = format!("{first:?} {second:?}: {}", conflict.message);
                assert!(text.contains("`io.one` in `io.two`"), "{text}");
                assert!(text.contains(&own.predicate()), "{text}");
                assert!(text.contains(&owner(second, 22).noun()), "{text}");
                for (kind, line) in [(first, "line 11"), (second, "line 22")] {
                    let named = !matches!(kind, OwnerKind::Controller | OwnerKind::Client);
                    assert_eq!(text.contains(line), named, "{text}");
                }
                assert_eq!(roles.outputs().count(), 1, "{text}");
            }
            for (one, other) in &apart {
                let mut roles = ProcessDataRoles::default();
                roles
                    .claim(bits(1, "a", one.clone()), owner(first, 11))
                    .expect("free");
                roles
                    .claim(bits(1, "b", other.clone()), owner(second, 22))
                    .expect("other bits");
                roles
                    .claim(bits(2, "c", one.clone()), owner(second, 22))
                    .expect("other device");
            }
        }
    }
}

fn folder() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../configs/m.toml")
}

/// Loads a file whose devices get their positions in the order of the text.
fn load(text: &str) -> Result<Machine, ConfigError> {
    let mut next = 0;
    let lines = text
        .lines()
        .map(|line| match line.starts_with("position = ") {
            true => {
                next += 1;
                format!("position = {}\n", next - 1)
            }
            false => format!("{line}\n"),
        });
    parse(&folder(), &lines.collect::<String>())
}

/// Tries a second owner of an output by all means that a machine has. Returns message and hint of
/// each refusal; `None` for means that were accepted.
fn attempts(base: &str, output: &str) -> Vec<(&'static str, Option<String>)> {
    let (device, name) = output.split_once('.').expect("a device");
    let copy = format!("[[copy]]\nfrom = \"{{}}\"\nto = \"{output}\"\n");
    let mut machine = load(base).unwrap_or_else(|error| panic!("{error:?}"));
    let signal = machine
        .signal(device, name, SignalDirection::Out)
        .expect("an output");
    let from = match signal.field.bit_len {
        // The terminal has inputs, too.
        1 => format!("{device}.Input 1"),
        8 => "in.bytes.0..1".to_owned(),
        16 => "in.bytes.0..2".to_owned(),
        len => panic!("{len} bits"),
    };
    let files = [
        (
            "set",
            format!("[[step]]\nset = {{ {device}.\"{name}\" = 1 }}\n"),
        ),
        ("copy", copy.replace("{}", &from)),
        (
            "position_output",
            format!(
                "[[position_output]]\noutput = \"{output}\"\naxis = \"p\"\nranges = [[1.0, 2.0]]\n"
            ),
        ),
    ];
    let mut found = Vec::new();
    for (means, text) in files {
        let refusal = match load(&format!("{base}{text}")) {
            Ok(_) => None,
            Err(ConfigError::Problems(problems)) => {
                let each = problems.iter().map(|p| format!("{p} {:?}", p.hint));
                Some(each.collect::<Vec<_>>().join("\n"))
            }
            Err(other) => panic!("{other}"),
        };
        found.push((means, refusal));
    }
    let refused = |error: NameError| error.to_string();
    found.push((
        "client",
        machine.check_client_output(device, name).err().map(refused),
    ));
    found.push((
        "controller",
        machine.output(device, name).err().map(refused),
    ));
    found
}

/// An axis and inputs for the second owner.
const REST: &str = r#"
[[device]]
name = "p"
esi = "esi/EPOS4.xml"
mode = "csp"
position = 8
[device.axis]
encoder = 2000
limits = { velocity = 50.0, acceleration = 500.0 }
[[device]]
name = "in"
esi = "esi/gateway.xml"
type = "GW64"
position = 9
"#;

const BUS: &str = "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n";

const GATEWAY: &str = r#"
[[device]]
name = "gateway"
esi = "esi/gateway.xml"
type = "GW64"
position = 0
[device.can]
sync = "4ms"
[[device.node]]
id = 5
drive = "EPOS 24/5"
outputs = [{ pdo = 1, at = 2, objects = ["0x6040", "0x2062"] }, { pdo = 3, at = 8 }]
inputs = [{ pdo = 1, at = 2, objects = ["0x6041", "0x6064"] }, { pdo = 3, at = 8 }]
[device.node.axis]
name = "a"
unit = "mm"
per_turn = 5.0
encoder = 2000
limits = { position = [-60.0, 60.0], velocity = 50.0, acceleration = 250.0, following_error = 2.0 }
"#;

/// The file began to check owners for objects of CiA 402 alone: bytes of a node and control words were
/// anybody's.
#[test]
fn outputs_of_axes_nodes_and_gateways_are_refused_alike() {
    let sercos = "\n[[device]]\nname = \"sercos\"\nesi = \"esi/SC2.xml\"\nposition = 0\nmode = \"csp\"\n\
        [[device.axis]]\nname = \"x\"\nencoder = 65536\nvelocity_unit = \"mrpm\"\n\
        limits = { velocity = 10.0, acceleration = 100.0 }\n";
    let drive = "\n[[device]]\nname = \"d\"\nesi = \"esi/EPOS4.xml\"\nposition = 0\nmode = \"csp\"\n\
        [device.axis]\nencoder = 2000\nlimits = { velocity = 50.0, acceleration = 500.0 }\n";
    for (base, output, owner) in [
        (drive, "d.Controlword", "is written by the axis `d` in line"),
        (
            sercos,
            "sercos.MDT 1/Master control word",
            "is written by the axis `x` in line",
        ),
        (
            sercos,
            "sercos.0x0086:1",
            "belongs to an axis of `sercos` in line",
        ),
        (
            GATEWAY,
            "gateway.Output byte 0000",
            "is the control word of `gateway` in line",
        ),
        (
            GATEWAY,
            "gateway.Output byte 0001",
            "is the control word of `gateway` in line",
        ),
        (
            GATEWAY,
            "gateway.Output byte 0002",
            "carries 0x6040 of node 5 in line 1",
        ),
        (
            GATEWAY,
            "gateway.Output byte 0005",
            "carries 0x607A of node 5 in line 1",
        ),
        (
            GATEWAY,
            "gateway.Output byte 0010",
            "carries 0x6060 of node 5 in line 1",
        ),
    ] {
        for (means, refusal) in attempts(&format!("{BUS}{base}{REST}"), output) {
            let refusal = refusal.unwrap_or_else(|| panic!("{means} may write {output}"));
            // A position switches one bit, whatever owns it.
            if means != "position_output" {
                assert!(refusal.contains(owner), "{means}, {output}: {refusal}");
            }
        }
    }
    // Bytes of no PDO are free.
    for (means, refusal) in attempts(&format!("{BUS}{GATEWAY}{REST}"), "gateway.Output byte 0040") {
        assert_eq!(
            refusal.is_some(),
            means == "position_output",
            "{means}: {refusal:?}"
        );
    }
}

/// Each output of a terminal with an owner, and each further one.
#[test]
fn outputs_of_terminals_have_one_owner() {
    let io = "\n[[device]]\nname = \"io\"\nesi = \"esi/IO8.xml\"\nposition = 1\n";
    let brake = "\n[[device]]\nname = \"d\"\nesi = \"esi/EPOS4.xml\"\nposition = 0\nmode = \"csp\"\n\
        [device.axis]\nencoder = 2000\nlimits = { velocity = 50.0, acceleration = 500.0 }\n\
        brake = { output = \"io.Output 1\" }\n";
    let position =
        "[[position_output]]\noutput = \"io.Output 1\"\naxis = \"p\"\nranges = [[1.0, 2.0]]\n";
    let copy = "[[copy]]\nfrom = \"in.bytes.0..1\"\nto = \"io.pdo.0x1600\"\n";
    let set = "[[step]]\nset = { io.\"Output 1\" = true }\n";
    for (first, owner, accepted) in [
        (brake, "the brake of `d` in line", &[][..]),
        (position, "the position_output in line", &[]),
        (copy, "the copy in line", &[]),
        (set, "the step in line", &["set", "client", "controller"]),
    ] {
        let base = match first == brake {
            true => format!("{BUS}{brake}{io}{REST}"),
            false => format!("{BUS}{io}{REST}{first}"),
        };
        for (means, refusal) in attempts(&base, "io.Output 1") {
            let Some(refusal) = refusal else {
                assert!(accepted.contains(&means), "{means} next to {first}");
                continue;
            };
            let verb = owner.replace("the brake", "opens the brake");
            let named = refusal.contains(owner) || refusal.contains(&verb);
            let spoken = ["position_output in line", "copy in line", "step in line"];
            assert!(
                named || spoken.iter().any(|s| refusal.contains(s)),
                "{means}: {refusal}"
            );
            assert!(refusal.contains("may not write it"), "{means}: {refusal}");
        }
    }
    // Two brakes on one output.
    let second = brake
        .replace("\"d\"", "\"e\"")
        .replace("position = 0", "position = 2");
    let error = load(&format!("{BUS}{brake}{io}{second}{REST}")).expect_err("one output");
    let text = error.to_string();
    assert!(
        text.contains("opens the brake of `d` in line 13; the brake of `e`"),
        "{text}"
    );
}

/// `hold` and the others on a device whose loss the machine survives: only `emergency` was refused.
#[test]
fn inputs_whose_loss_would_go_unseen_are_refused() {
    let terminal = "\n[[device]]\nname = \"io\"\nesi = \"esi/IO8.xml\"\nposition = 1\n\
        [[stop.group]]\nname = \"g\"\naxes = [\"p\"]\ndevices = [\"io\"]\n";
    let gone = "outside = \"continue\"\n";
    for (text, danger) in [
        (
            "[stop]\nemergency = { io.\"Input 1\" = true }\n",
            "an emergency would go unseen",
        ),
        (
            "[override]\nhold = { io.\"Input 1\" = true }\n",
            "a hold would go unseen",
        ),
        (
            "[override]\ninput = \"io.Input 1\"\nfull = 1\n",
            "the override would keep its last value",
        ),
        (
            "[program]\npause = { io.\"Input 1\" = true }\n",
            "a pause would go unseen",
        ),
        (
            "[program]\nstep = { io.\"Input 1\" = true }\n",
            "a button would go unseen",
        ),
    ] {
        let named = "[signals]\npedal = \"io.Input 1\"\n".to_owned()
            + &text.replace("io.\"Input 1\"", "pedal");
        for text in [text, &named] {
            let head = format!("{BUS}{text}{REST}{terminal}");
            load(&head).unwrap_or_else(|error| panic!("{text}: {error:?}"));
            let error = load(&format!("{head}{gone}")).expect_err(text).to_string();
            let message = format!(
                "`io.Input 1` is in the group `g`, without which the machine goes on: {danger}"
            );
            assert!(error.contains(&message), "{text}: {error}");
        }
        // A gateway keeps the last input of a node that is lost.
        let node = text.replace("io.\"Input 1\"", "gateway.\"Input byte 0009\"");
        let node = node
            .replace("io.Input 1", "gateway.Input byte 0009")
            .replace("true", "1");
        let error = load(&format!("{BUS}{node}{GATEWAY}{REST}"))
            .expect_err(&node)
            .to_string();
        assert!(
            error.contains(&format!(
                "comes from node 5, whose last value its gateway keeps: {danger}"
            )),
            "{error}"
        );
    }
    // A step may wait for an input that is lost: nothing moves meanwhile.
    let wait = "[[step]]\nwait = { io.\"Input 1\" = true }\n";
    load(&format!("{BUS}{REST}{terminal}{gone}{wait}")).expect("a condition of a step");
}

/// In manual mode, each axis without a group stops alone.
#[test]
fn manual_mode_keeps_watched_devices_in_the_group_of_the_machine() {
    for text in [
        "[stop]\nemergency = { p.\"0x6041\" = 1 }\n",
        "[override]\nhold = { p.\"0x6041\" = 1 }\n",
        "",
    ] {
        let machine = load(&format!("{BUS}{text}{REST}"));
        let machine = machine.unwrap_or_else(|error| panic!("{text}: {error:?}"));
        let manual = crate::supervise::operator::for_manual_mode(machine);
        let alone = manual.group_of(DeviceIndex(0)) != ecaxis_ecat::index::GroupIndex::MACHINE;
        assert_eq!(alone, text.is_empty(), "{text}");
    }
}

/// `fsoe` follows the names of the ESI.
#[test]
fn outputs_are_locked_by_their_owners() {
    let io = "\n[[device]]\nname = \"io\"\nesi = \"esi/IO8.xml\"\nposition = 1\n";
    let copy = "[[copy]]\nfrom = \"in.bytes.0..1\"\nto = \"io.pdo.0x1600\"\n";
    for (text, locked) in [
        (copy.to_owned(), 8),
        (format!("{copy}fsoe = true\n"), 0),
        (format!("{copy}fsoe = false\n"), 8),
        ("[[step]]\nset = { io.\"Output 3\" = true }\n".to_owned(), 1),
    ] {
        let machine = load(&format!("{BUS}{io}{REST}{text}"));
        let machine = machine.unwrap_or_else(|error| panic!("{text}: {error:?}"));
        let locks = machine.rt_config().output_locks;
        assert_eq!(
            locks.iter().map(|lock| lock.bits).sum::<usize>(),
            locked,
            "{text}"
        );
        assert!(locks.iter().all(|lock| lock.from == lock.to), "{text}");
    }
}

/// The tables of `docs/stops.md` are those of the registry.
#[test]
fn roles_are_documented() {
    let text = include_str!("../../../docs/stops.md");
    let lines: Vec<&str> = text.lines().collect();
    let row = |cells: &[&str]| format!("| {} |", cells.join(" | "));
    for kind in OwnerKind::ALL {
        let row = row(&kind.row());
        assert!(lines.contains(&row.as_str()), "{row}");
        let off = kind.row()[2] == "off";
        assert_eq!(off, kind.on_return() == ReturnRule::Off, "{row}");
    }
    for usage in InputUse::ALL {
        let row = row(&usage.row());
        assert!(lines.contains(&row.as_str()), "{row}");
        let machine = row.contains("the machine stops");
        let watched = usage.danger().is_some() && usage != InputUse::SecondEncoder;
        assert_eq!(machine, watched, "{row}");
    }
}
