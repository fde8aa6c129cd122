//! Names, files, differences, the order of a restore, and its early end.

use std::cell::Cell;
use std::time::Duration;

use ecaxis_esi::model::Access;
use ecaxis_esi::{Dictionary, Object, ObjectItem, Writable};
use proptest::prelude::*;

use ecaxis_master::acyclic::DeviceRef;
use ecaxis_master::acyclic::parameters::compare::compare;
use ecaxis_master::acyclic::parameters::dictionary::dictionary;
use ecaxis_master::acyclic::parameters::restore::{RestoreError, Restored, restore};
use ecaxis_master::acyclic::parameters::restore_order::{Write, order};
use ecaxis_master::cancel::CancelToken;
use ecaxis_master::mailbox::{CoeClient, DatagramError, MailboxTransport, NamedObject};
use ecaxis_master::parameters::class::{Class, CopyRule};
use ecaxis_master::parameters::dump::{Dump, DumpError, Origin};
use ecaxis_master::parameters::lookup::{FindError, ObjectQuery, find};
use ecaxis_master::parameters::{DataType, Kind, Parameter};
use ecaxis_master::report::Cause;
use ecaxis_test_support::mailbox::fault_injection::Mischief;
use ecaxis_test_support::mailbox::server::Server;
use ecaxis_test_support::mailbox::{STATION, block_on, client, layout};

fn parameter(index: u16, sub: u8, data_type: &str, value: &[u8]) -> Parameter {
    Parameter {
        at: NamedObject { index, sub },
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
fn find_accepts_numbers_and_names() {
    let dictionary = Dictionary {
        objects: vec![
            object(0x2000, "Node-ID", &[""]),
            object(0x3000, "Axis configuration", &["Count", "Sensors", "Gear"]),
            object(0x3001, "Motor", &["Count", "Gear"]),
        ],
    };
    let at = |index, sub| Ok(ObjectQuery { index, sub });
    for (text, wanted) in [
        ("0x6064", at(0x6064, None)),
        ("0x6041:00", at(0x6041, Some(0))),
        ("0x1c12:0x0a", at(0x1c12, Some(10))),
        ("24676:10", at(0x6064, Some(16))),
        ("node id", at(0x2000, None)),
        ("Motor", at(0x3001, None)),
        ("sensors", at(0x3000, Some(1))),
        ("Motor: gear", at(0x3001, Some(1))),
        // Names from the standards.
        ("Statusword", at(0x6041, None)),
        ("position actual value", at(0x6064, None)),
        ("Vendor ID", at(0x1018, Some(1))),
        ("Identity", at(0x1018, None)),
        ("Identity: Vendor ID", at(0x1018, Some(1))),
        (
            "software position limit: max position limit",
            at(0x607d, Some(2)),
        ),
        // Subindices are hexadecimal.
        ("0x1600:0a", at(0x1600, Some(10))),
        ("0x1600:10", at(0x1600, Some(16))),
        ("0x1600:0x10", at(0x1600, Some(16))),
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

fn device() -> DeviceRef {
    DeviceRef {
        name: "x".to_owned(),
        position: 0,
        station: STATION,
    }
}

/// Returns the object indices of the dictionary and the texts of the failed descriptions.
fn read_dictionary(mischief: &[Mischief]) -> Result<(Vec<u16>, Vec<String>), String> {
    let objects: &[(u16, u8, &[u8])] = &[
        (0x2000, 0, &[1, 2]),
        (0x2001, 0, &[1, 2]),
        (0x2002, 0, &[1, 2]),
        (0x2003, 0, &[1, 2]),
    ];
    let server = Server::new(128, objects, mischief);
    let mut coe = CoeClient::new(layout(128));
    let (at, mut silent) = (device(), |_, _| {});
    let read = dictionary(&mut coe, &server, &at, &mut silent);
    let read = block_on(read).map_err(|error| error.to_string())?;
    let indices = read.dictionary.objects.iter().map(|object| object.index);
    let failed = read.failed.iter().map(|e| e.without_station().to_string());
    Ok((indices.collect(), failed.collect()))
}

/// ETG.1000.6 clause 5.6.3: an object description has at least 6 bytes, an entry description 10.
/// Answer 1 is the list; two answers per object follow.
#[test]
fn a_malformed_description_costs_one_object() {
    let information = |opcode: u8, data: &[u8]| {
        let length = u8::try_from(6 + data.len()).expect("short");
        let mut message = vec![length, 0, 0, 0, 0, 0x13, 0, 0x80, opcode, 0, 0, 0];
        message.extend(data);
        message
    };
    assert_eq!(
        read_dictionary(&[]),
        Ok((vec![0x2000, 0x2001, 0x2002, 0x2003], vec![]))
    );
    let object = information(4, &[0x01, 0x20, 7, 0]);
    let (indices, failed) = read_dictionary(&[Mischief::Replace(4, object)]).expect("a list");
    assert_eq!(indices, [0x2000, 0x2002, 0x2003]);
    assert_eq!(failed.len(), 1, "{failed:?}");
    assert!(failed[0].starts_with("the description of object 0x2001"));

    let entry = information(6, &[0x01, 0x20, 0, 7]);
    let (indices, failed) = read_dictionary(&[Mischief::Replace(5, entry)]).expect("a list");
    assert_eq!(indices, [0x2000, 0x2001, 0x2002, 0x2003]);
    assert_eq!(failed.len(), 1, "{failed:?}");
}

/// ETG.1000.6 clause 5.6.3: each description is a request of its own.
#[test]
fn an_unanswered_description_costs_one_object_and_a_silent_device_ends_the_list() {
    let (indices, failed) = read_dictionary(&[Mischief::Skip(4)]).expect("a list");
    assert_eq!(indices, [0x2000, 0x2002, 0x2003]);
    assert_eq!(failed.len(), 1, "{failed:?}");
    let silent = [3, 4, 5, 6, 7].map(Mischief::Skip);
    let error = read_dictionary(&silent).expect_err("silent");
    assert!(error.contains("no answer came"), "{error}");
}

/// Files without a format number have decimal subindices.
#[test]
fn subindices_of_old_files_are_decimal() {
    let file = |format: &str, key: &str| {
        let text = format!(
            "{format}[device]\nname = \"x\"\nvendor = 1\nproduct = 2\nrevision = 3\n[parameters]\n\"{key}\" = {{ type = \"UINT\", value = 1 }}\n"
        );
        Dump::parse(&text).map(|dump| dump.parameters[0].at.sub)
    };
    for (format, key, sub) in [
        ("", "0x1600:10", Some(10)),
        ("", "0x1600:0x10", Some(16)),
        ("", "0x1600:0a", None),
        ("format = 1\n", "0x1600:10", Some(10)),
        ("format = 2\n", "0x1600:10", Some(16)),
        ("format = 2\n", "0x1600:0a", Some(10)),
        ("format = 2\n", "0x1600:fe", Some(254)),
        ("format = 2\n", "Statusword:00", None),
    ] {
        assert_eq!(file(format, key).ok(), sub, "{format}{key}");
    }
    let error = file("format = 3\n", "0x1600:10").unwrap_err();
    assert!(
        error.to_string().contains("format 3 is not known"),
        "{error}"
    );
}

#[test]
fn parse_reports_errors_in_a_file() {
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
fn compare_returns_differing_settings() {
    let mut left = vec![
        parameter(0x1600, 0, "USINT", &[1]),
        parameter(0x1600, 1, "UDINT", &[1, 2, 3, 4]),
        parameter(0x1600, 2, "UDINT", &[1, 2, 3, 4]),
        parameter(0x6040, 0, "UINT", &[6, 0]),
        parameter(0x6064, 0, "DINT", &[6, 0, 0, 0]),
        parameter(0x6065, 0, "UDINT", &[7, 0, 0, 0]),
    ];
    left[4].writable = false;
    let rule = CopyRule::to_other_unit(0xfb);
    assert_eq!(compare(&left, &left, rule, true), []);
    let mut right = left.clone();
    // A count, a command, an actual value.
    for n in [2, 3, 4] {
        right[n].value[0] = 99;
    }
    assert_eq!(compare(&left, &right, rule, false), []);
    assert_eq!(compare(&left, &right, rule, true).len(), 2);
    right[5].value[0] = 8;
    right.push(parameter(0x6067, 0, "UDINT", &[1, 0, 0, 0]));
    let reported: Vec<_> = compare(&left, &right, rule, false)
        .into_iter()
        .map(|d| (d.at.index, d.left, d.right))
        .collect();
    assert_eq!(
        reported,
        [
            (0x6065, Some("7".to_owned()), Some("8".to_owned())),
            (0x6067, None, Some("1".to_owned()))
        ]
    );
}

#[test]
fn order_writes_lists_first() {
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
    let reported = |differing: &[(u16, u8)]| -> Vec<String> {
        let writes = order(&wanted, |p| differing.contains(&(p.at.index, p.at.sub)));
        let each = writes.iter().map(|write| match write {
            Write::Empty(index) => format!("{index:x} = 0"),
            Write::Value(p) => format!("{:x}:{}", p.at.index, p.at.sub),
        });
        each.collect()
    };
    assert_eq!(reported(&[]), [""; 0]);
    assert_eq!(reported(&[(0x6066, 0)]), ["6066:0"]);
    // A changed assignment leaves the mapping alone. A changed mapping is written while no PDO is
    // assigned.
    assert_eq!(reported(&[(0x1c12, 1)]), ["1c12 = 0", "1c12:1", "1c12:0"]);
    assert_eq!(
        reported(&[(0x1600, 1), (0xf030, 0), (0x6065, 0)]),
        [
            "f030 = 0", "f030:1", "f030:0", "1c12 = 0", "1600 = 0", "1600:1", "1600:0", "1c12:1",
            "1c12:0", "6065:0"
        ]
    );
}

/// Restores values of an EPOS4 with the given rule to a device whose values are all 0.
fn restore_epos4(rule: CopyRule) -> (Restored, Vec<u32>) {
    let places: [(u16, u8); 9] = [
        (0x1010, 1),
        (0x1023, 1),
        (0x2ec0, 1),
        (0x3001, 1),
        (0x30a1, 1),
        (0x30b5, 2),
        (0x3241, 1),
        (0x3241, 6),
        (0x324b, 1),
    ];
    let objects = places.map(|(index, sub)| (index, sub, &[0; 4][..]));
    let server = Server::new(48, &objects, &[]);
    let wanted = places.map(|(index, sub)| parameter(index, sub, "UDINT", &[7, 0, 0, 0]));
    let (at, mut coe) = (device(), client());
    let mut silent = |_, _| {};
    let done = restore(&mut coe, &server, &at, None, (&wanted, rule), &mut silent);
    let done = block_on(done).expect("restored");
    let values = places.iter().map(|&(index, sub)| {
        let value = server.object(index, sub).expect("an object");
        u32::from_le_bytes(value.try_into().expect("four bytes"))
    });
    (done, values.collect())
}

#[test]
fn unit_data_and_commands_are_not_copied_to_another_unit() {
    let (done, values) = restore_epos4(CopyRule::to_other_unit(0xfb));
    assert_eq!(values, [0, 0, 0, 7, 7, 0, 0, 0, 0]);
    let lines: Vec<_> = done
        .lines_of_written()
        .chain(done.lines_of_skipped())
        .collect();
    assert_eq!(
        lines,
        [
            "written (machine): 0x3001:01 0 → 7",
            "written (tuned): 0x30a1:01 0 → 7",
            "not written (unit): 0x30b5:02 (home reference and its state): 0 kept, 7 in the file, \
             0x3241:01 (offset of the current sensors): 0 kept, 7 in the file, \
             0x3241:06 (rotor angle): 0 kept, 7 in the file",
            "not written (command): 0x1010:01 (store and restore), 0x1023:01 (OS command), \
             0x2ec0:01 (internal control)",
            "not written (log): 0x324b:01 (state of the auto tuning)",
        ]
    );
}

#[test]
fn unit_data_goes_back_to_its_own_unit_unless_left_out() {
    let rule = CopyRule::to_same_unit(0xfb);
    let (done, values) = restore_epos4(rule);
    assert_eq!(values, [0, 0, 0, 7, 7, 7, 7, 7, 0]);
    assert_eq!(done.written.len(), 5);
    let (_, values) = restore_epos4(rule.only(&[Class::Tuned]));
    assert_eq!(values, [0, 0, 0, 0, 7, 0, 0, 0, 0]);
}

/// A device that loses its frames from a given download on, before the download or with its answer.
struct Failing {
    server: Server,
    downloads: Cell<usize>,
    fails_at: usize,
    arrives: bool,
    dead: Cell<bool>,
    stop: CancelToken,
}

impl Failing {
    /// Has a mapping and an assignment with one entry each, and two settings.
    fn new(fails_at: usize, arrives: bool) -> Self {
        let objects: [(u16, u8, &[u8]); 6] = [
            (0x1600, 0, &[1]),
            (0x1600, 1, &[0x20, 0, 0x40, 0x60]),
            (0x1c12, 0, &[1]),
            (0x1c12, 1, &[1, 0x16, 0, 0]),
            (0x6065, 0, &[1, 0, 0, 0]),
            (0x6066, 0, &[1, 0, 0, 0]),
        ];
        Self {
            server: Server::new(48, &objects, &[]),
            downloads: Cell::new(0),
            fails_at,
            arrives,
            dead: Cell::new(false),
            stop: CancelToken::default(),
        }
    }

    /// Restores other values for all of them.
    fn restore(&self, progress: &mut dyn FnMut(usize, usize)) -> Result<Restored, RestoreError> {
        let wanted = [
            parameter(0x1600, 0, "USINT", &[1]),
            parameter(0x1600, 1, "UDINT", &[0x20, 0, 0x7a, 0x60]),
            parameter(0x1c12, 0, "USINT", &[1]),
            parameter(0x1c12, 1, "UDINT", &[0, 0x16, 0, 0]),
            parameter(0x6065, 0, "UDINT", &[7, 0, 0, 0]),
            parameter(0x6066, 0, "UDINT", &[7, 0, 0, 0]),
        ];
        let dictionary = Dictionary {
            objects: vec![
                object(0x1600, "m", &["", ""]),
                object(0x1c12, "a", &["", ""]),
                object(0x6065, "x", &[""]),
                object(0x6066, "y", &[""]),
            ],
        };
        let device = device();
        let mut coe = client();
        block_on(restore(
            &mut coe,
            self,
            &device,
            Some(&dictionary),
            (&wanted, CopyRule::to_other_unit(0)),
            progress,
        ))
    }

    fn is_empty(&self, index: u16) -> bool {
        self.server.object(index, 0) == Some(vec![0])
    }
}

impl MailboxTransport for Failing {
    async fn read(
        &self,
        station: u16,
        register: u16,
        buf: &mut [u8],
    ) -> Result<u16, DatagramError> {
        match self.dead.get() {
            true => Err(DatagramError::Timeout { station, register }),
            false => self.server.read(station, register, buf).await,
        }
    }

    async fn write(&self, station: u16, register: u16, data: &[u8]) -> Result<u16, DatagramError> {
        // A mailbox write that contains an SDO download.
        let download = register == 0x1000 && data.get(8).is_some_and(|c| c >> 5 == 1);
        self.downloads
            .set(self.downloads.get() + usize::from(download));
        let dies = download && self.downloads.get() == self.fails_at;
        if dies && self.arrives {
            let _ = self.server.write(station, register, data).await;
            self.server.delay(Duration::from_millis(10)).await;
        }
        self.dead.set(self.dead.get() || dies);
        match self.dead.get() {
            true => Err(DatagramError::Timeout { station, register }),
            false => self.server.write(station, register, data).await,
        }
    }

    async fn delay(&self, duration: Duration) {
        self.server.delay(duration).await;
    }

    fn now(&self) -> u64 {
        self.server.now()
    }

    fn stop(&self) -> &CancelToken {
        &self.stop
    }
}

/// 1c12 = 0, 1600 = 0, 1600:1, 1600:0, 1c12:1, 1c12:0, 6065:0, 6066:0.
const WRITES: usize = 8;

#[test]
fn failed_restore_reports_the_remaining_state() {
    let whole = Failing::new(0, false);
    let done = whole.restore(&mut |_, _| {}).expect("restored");
    assert!(done.complete(), "{done:?}");
    assert_eq!((done.written.len(), whole.downloads.get()), (4, WRITES));

    let mut empty = 0;
    for arrives in [false, true] {
        for k in 1..=WRITES {
            let device = Failing::new(k, arrives);
            let error = device.restore(&mut |_, _| {}).expect_err("no frames");
            assert!(matches!(*error.source.cause, Cause::Sdo(_)), "{error}");
            assert_eq!((error.written, error.of), (k - 1, WRITES), "{error}");
            let text = error.to_string();
            let reported = match k {
                1 => true,
                k => text.contains(&format!("; {} of 8 writes were done", k - 1)),
            };
            assert!(reported, "{text}");
            for (index, name) in [(0x1c12, "0x1c12:00"), (0x1600, "0x1600:00")] {
                if device.is_empty(index) {
                    empty += 1;
                    assert!(error.emptied.contains(&index), "{k}: {text}");
                    let left = text.split("left empty").nth(1).unwrap_or_default();
                    assert!(left.contains(name), "{k}: {text}");
                }
            }
            // A refilled list is not reported as empty.
            let still: &[u16] = match k {
                1 | 5..=6 => &[0x1c12],
                2..=4 => &[0x1c12, 0x1600],
                _ => &[],
            };
            assert_eq!(error.emptied, still, "{k}: {text}");
        }
    }
    assert!(empty > 10, "{empty}");
}

#[test]
fn cancelled_restore_leaves_no_list_empty() {
    for k in 0..WRITES {
        let device = Failing::new(0, false);
        let mut progress = |n, _| {
            if n == k {
                device.stop.cancel();
            }
        };
        let ended = device.restore(&mut progress);
        assert!(!device.is_empty(0x1c12) && !device.is_empty(0x1600), "{k}");
        let error = ended.expect_err("ended");
        let stopped = error.source.is_interruption();
        assert!(stopped && error.emptied.is_empty(), "{k}: {error}");
        // The lists are six writes; a cancellation during these takes effect after the sixth.
        assert_eq!(error.written, (k + 1).max(6), "{k}: {error}");
        assert_eq!(device.downloads.get(), error.written);
    }
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
                    at: NamedObject { index, sub },
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
    fn dump_parses_its_own_output(
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
