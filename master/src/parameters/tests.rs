//! Names, files, differences, and the order in which a restore writes.

use ecaxis_esi::model::Access;
use ecaxis_esi::{Dictionary, Object, ObjectItem, Writable};
use proptest::prelude::*;

use super::compare::compare;
use super::dump::{Dump, DumpError, Origin};
use super::find::{FindError, Wanted, find};
use super::rules::{Write, order};
use super::{DataType, Kind, Parameter};
use crate::mailbox::ObjectAddress;

fn parameter(index: u16, sub: u8, data_type: &str, value: &[u8]) -> Parameter {
    Parameter {
        at: ObjectAddress { index, sub },
        name: format!("n{index:x}"),
        data_type: DataType::named(data_type, 0).expect("a type"),
        writable: true,
        value: value.to_vec(),
    }
}

fn object(index: u16, name: &str, items: &[&str]) -> Object {
    let items = (0..).zip(items).map(|(sub, name)| ObjectItem {
        sub,
        name: (*name).into(),
        type_name: "UDINT".into(),
        bit_len: 32,
        access: Access {
            read: true,
            write: Writable::Always,
        },
        ..ObjectItem::default()
    });
    Object {
        index,
        name: name.into(),
        items: items.collect(),
        ..Object::default()
    }
}

#[test]
fn objects_by_number_and_name() {
    let dictionary = Dictionary {
        objects: vec![
            object(0x2000, "Node-ID", &[""]),
            object(0x3000, "Axis configuration", &["Count", "Sensors", "Gear"]),
            object(0x3001, "Motor", &["Count", "Gear"]),
        ],
    };
    let at = |index, sub| Ok(Wanted { index, sub });
    for (text, wanted) in [
        ("0x6064", at(0x6064, None)),
        ("0x6041:00", at(0x6041, Some(0))),
        ("0x1c12:0x0a", at(0x1c12, Some(10))),
        ("24676:10", at(0x6064, Some(10))),
        ("node id", at(0x2000, None)),
        ("Motor", at(0x3001, None)),
        ("sensors", at(0x3000, Some(1))),
        ("Motor: gear", at(0x3001, Some(1))),
        // Of the standards.
        ("Statusword", at(0x6041, None)),
        ("position actual value", at(0x6064, None)),
        ("Vendor ID", at(0x1018, Some(1))),
        ("Identity", at(0x1018, None)),
    ] {
        assert_eq!(find(Some(&dictionary), text), wanted, "{text}");
    }
    for bad in ["0x12345", "0x6041:256", "0x", "12x", "0x6041:", "0x+1"] {
        let error = FindError::Number(bad.to_owned());
        assert_eq!(find(None, bad), Err(error));
    }
    assert_eq!(
        find(Some(&dictionary), "Gear").unwrap_err().to_string(),
        "`Gear` is the name of several: 0x3000:02, 0x3001:01"
    );
    let near = |text: &str| match find(Some(&dictionary), text) {
        Err(FindError::Unknown { near, .. }) => near,
        other => panic!("{other:?}"),
    };
    assert_eq!(near("Statuswort").as_deref(), Some("Statusword"));
    assert_eq!(
        near("Axis konfiguration").as_deref(),
        Some("Axis configuration")
    );
    assert_eq!(near("-"), None);
}

#[test]
fn mistakes_in_a_file_are_told() {
    let file = |line: &str| {
        format!(
            "[device]\nname = \"x\"\nvendor = 1\nproduct = 2\nrevision = 3\n[parameters]\n{line}\n"
        )
    };
    for (line, part) in [
        (
            "\"0x6065\" = { type = \"UINT\", value = 1 }",
            "not an object",
        ),
        (
            "\"0x6065:00\" = { type = \"DT1\", value = 1 }",
            "unknown type `DT1`",
        ),
        (
            "\"0x6065:00\" = { type = \"UINT\", value = 70000 }",
            "70000 does not fit",
        ),
        (
            "\"0x6065:00\" = { type = \"UINT\", value = [1] }",
            "a number, a text",
        ),
        (
            "\"0x6065:00\" = { type = \"UINT\", access = \"wo\", value = 1 }",
            "not \"wo\"",
        ),
        (
            "\"0x6065:00\" = { type = \"UINT\", vlaue = 1 }",
            "unknown field `vlaue`",
        ),
        ("x", "TOML parse error at line 7"),
    ] {
        let error: DumpError = Dump::parse(&file(line)).unwrap_err();
        assert!(error.to_string().contains(part), "{error}");
    }
}

#[test]
fn what_differs_and_is_a_setting_is_told() {
    let mut left = vec![
        parameter(0x1600, 0, "USINT", &[1]),
        parameter(0x1600, 1, "UDINT", &[1, 2, 3, 4]),
        parameter(0x1600, 2, "UDINT", &[1, 2, 3, 4]),
        parameter(0x6040, 0, "UINT", &[6, 0]),
        parameter(0x6064, 0, "DINT", &[6, 0, 0, 0]),
        parameter(0x6065, 0, "UDINT", &[7, 0, 0, 0]),
    ];
    left[4].writable = false;
    assert_eq!(compare(&left, &left, true), []);
    let mut right = left.clone();
    // Beyond the count, a command, an actual value.
    for n in [2, 3, 4] {
        right[n].value[0] = 99;
    }
    assert_eq!(compare(&left, &right, false), []);
    assert_eq!(compare(&left, &right, true).len(), 2);
    right[5].value[0] = 8;
    right.push(parameter(0x6067, 0, "UDINT", &[1, 0, 0, 0]));
    let told: Vec<_> = compare(&left, &right, false)
        .into_iter()
        .map(|d| (d.at.index, d.left, d.right))
        .collect();
    assert_eq!(
        told,
        [
            (0x6065, Some("7".to_owned()), Some("8".to_owned())),
            (0x6067, None, Some("1".to_owned()))
        ]
    );
}

#[test]
fn lists_are_emptied_filled_and_counted_before_everything_else() {
    let all = [
        parameter(0x1600, 0, "USINT", &[1]),
        parameter(0x1600, 1, "UDINT", &[1; 4]),
        parameter(0x1a00, 0, "USINT", &[0]),
        parameter(0x1c12, 0, "USINT", &[1]),
        parameter(0x1c12, 1, "UINT", &[0, 0x16]),
        parameter(0x6065, 0, "UDINT", &[7, 0, 0, 0]),
        parameter(0x6066, 0, "UINT", &[7, 0]),
        parameter(0xf030, 0, "USINT", &[1]),
        parameter(0xf030, 1, "UDINT", &[9; 4]),
    ];
    let wanted: Vec<&Parameter> = all.iter().collect();
    let told = |differing: &[(u16, u8)]| -> Vec<String> {
        let writes = order(&wanted, |p| differing.contains(&(p.at.index, p.at.sub)));
        let each = writes.iter().map(|write| match write {
            Write::Empty(index) => format!("{index:x} = 0"),
            Write::Value(p) => format!("{:x}:{}", p.at.index, p.at.sub),
        });
        each.collect()
    };
    assert_eq!(told(&[]), [""; 0]);
    assert_eq!(told(&[(0x6066, 0)]), ["6066:0"]);
    // Another assignment leaves the mapping alone; another mapping is written while nothing is assigned.
    assert_eq!(told(&[(0x1c12, 1)]), ["1c12 = 0", "1c12:1", "1c12:0"]);
    assert_eq!(
        told(&[(0x1600, 1), (0xf030, 0), (0x6065, 0)]),
        [
            "f030 = 0", "f030:1", "f030:0", "1c12 = 0", "1600 = 0", "1600:1", "1600:0", "1c12:1",
            "1c12:0", "6065:0"
        ]
    );
}

fn any_parameter() -> impl Strategy<Value = Parameter> {
    let kinds = [
        (Kind::Unsigned, 1),
        (Kind::Unsigned, 3),
        (Kind::Unsigned, 64),
        (Kind::Signed, 16),
        (Kind::Real, 32),
        (Kind::Real, 64),
        (Kind::Text, 80),
        (Kind::Unicode, 80),
        (Kind::Bytes, 0),
    ];
    (
        any::<(u16, u8, bool)>(),
        "\\PC{0,10}",
        prop::sample::select(kinds.to_vec()),
        prop::collection::vec(any::<u8>(), 0..12),
        any::<bool>(),
    )
        .prop_map(
            |((index, sub, writable), name, (kind, bits), mut value, own)| {
                let data_type = DataType { kind, bits };
                if let (true, Some(width)) = (own, data_type.width()) {
                    value.resize(width, 0);
                }
                Parameter {
                    at: ObjectAddress { index, sub },
                    name,
                    data_type,
                    writable,
                    value,
                }
            },
        )
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 500, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn a_file_is_read_as_it_was_written(
        name in "\\PC{0,20}",
        numbers: [u32; 4],
        mut parameters in prop::collection::vec(any_parameter(), 0..20),
    ) {
        parameters.sort_by_key(|p| (p.at.index, p.at.sub));
        parameters.dedup_by_key(|p| p.at);
        let [vendor, product, revision, serial] = numbers;
        let device = Origin { name, vendor, product, revision, serial };
        let dump = Dump { device, parameters };
        prop_assert_eq!(Dump::parse(&dump.to_toml()), Ok(dump));
    }
}
