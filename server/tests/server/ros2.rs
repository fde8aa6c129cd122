//! ROS 2 messages and MCAP files from samples, read by their definitions.

use std::collections::HashMap;
use std::io::Cursor;
use std::sync::Arc;
use std::time::Duration;

use ecaxis_master::config::Machine;
use ecaxis_master::ros2::cdr::CdrEncoder;
use ecaxis_master::ros2::mcap::McapFile;
use ecaxis_master::ros2::schema;
use ecaxis_master::ros2::topics::{
    Diagnostic, DiagnosticLevel, Source, Topic, Topics, encode_diagnostics,
};
use ecaxis_master::rt::samples::{AXIS_COLUMNS, COUNT_COLUMNS, CYCLE_COLUMNS, row_words};
use ecaxis_test_support::ros2::{Value, decode};
use proptest::prelude::*;
use serde_json::json;

use crate::harness;

const EPOCH: u64 = 1_700_000_000_000_000_000;

fn demo() -> Machine {
    let mut machine = harness::demo();
    machine.use_all_signals();
    machine
}

fn topic(topics: &Topics, source: Source) -> &Topic {
    topics.list().iter().find(|t| t.source == source).unwrap()
}

fn message(topics: &Topics, source: Source, row: &[u64], missed: u64) -> Value {
    // Bytes before the message do not change its alignment.
    let mut bytes = vec![0xa5; 3];
    assert!(topics.encode(source, row, missed, &mut bytes));
    decode(&topic(topics, source).schema.text, &bytes[3..]).expect("a message of its schema")
}

fn same(a: f64, b: f64) -> bool {
    a.to_bits() == b.to_bits() || a.is_nan() && b.is_nan()
}

/// A row with any values; statusword, controlword and mode as the cycle writes them.
fn row(machine: &Machine) -> impl Strategy<Value = Vec<u64>> + use<> {
    let words = row_words(machine.axes.len(), machine.inputs.len());
    let axes = machine.axes.len();
    proptest::collection::vec(any::<u64>(), words).prop_map(move |mut row| {
        row[0] = row[0].max(1);
        // Until 2038, the end of the seconds of ROS.
        row[1] %= 447_000_000_000_000_000;
        for axis in 0..axes {
            let at = COUNT_COLUMNS.len() + CYCLE_COLUMNS.len() + axis * AXIS_COLUMNS.len();
            for word in [at + 7, at + 8] {
                row[word] = f64::from(row[word] as u16).to_bits();
            }
            row[at + 9] = f64::from(row[at + 9] as i8).to_bits();
        }
        row
    })
}

proptest! {
    #[test]
    fn every_value_of_a_row_is_in_the_messages(row in row(&demo()), missed: u64) {
        let machine = demo();
        let topics = Topics::new(&machine, EPOCH);
        let value = |at: usize| f64::from_bits(row[at]);
        let time = EPOCH + row[1];
        let axes_at = COUNT_COLUMNS.len() + CYCLE_COLUMNS.len();
        let joints = message(&topics, Source::JointStates, &row, missed);
        prop_assert_eq!(joints.stamp(), time);
        for (index, axis) in machine.axes.iter().enumerate() {
            let at = axes_at + index * AXIS_COLUMNS.len();
            let found = message(&topics, Source::Axis(index), &row, missed);
            prop_assert_eq!(found.stamp(), time);
            prop_assert_eq!(found["header"]["frame_id"].text(), &axis.name);
            prop_assert_eq!(found["row"].integer(), i128::from(row[0] - 1));
            for (column, (name, _)) in AXIS_COLUMNS.iter().enumerate() {
                let wanted = value(at + column);
                let got = match &found[*name] {
                    Value::Integer(got) => *got as f64,
                    got => got.real(),
                };
                prop_assert!(same(got, wanted), "{}: {} {}", name, got, wanted);
            }
            // The axes of the demonstration are in mm.
            for (column, name) in ["position", "velocity"].iter().enumerate() {
                let got = joints[name].list()[index].real();
                prop_assert!(same(got, value(at + column) * 1e-3), "{}", name);
            }
            prop_assert_eq!(joints["name"].list()[index].text(), &axis.name);
        }
        prop_assert!(joints["effort"].list().is_empty());
        let bus = message(&topics, Source::Bus, &row, missed);
        prop_assert_eq!(bus["missed"].integer(), i128::from(missed));
        prop_assert_eq!(bus["cycle"].integer(), i128::from(row[2]));
        for (bit, name) in ["inputs_fresh", "in_op", "stopping", "phase_locked"].iter().enumerate() {
            prop_assert_eq!(bus[name].integer(), i128::from(row[3] >> bit & 1));
        }
        for (column, (name, _)) in CYCLE_COLUMNS.iter().enumerate() {
            prop_assert!(same(bus[*name].real(), value(COUNT_COLUMNS.len() + column)));
        }
        let inputs = message(&topics, Source::Inputs, &row, missed);
        let first = axes_at + machine.axes.len() * AXIS_COLUMNS.len();
        let Value::Message(fields) = inputs else {
            panic!("{inputs:?}");
        };
        prop_assert_eq!(fields.len(), 1 + machine.inputs.len());
        for (n, (_, got)) in fields[1..].iter().enumerate() {
            prop_assert!(same(got.real(), value(first + n)));
        }
    }

    #[test]
    fn cdr_keeps_values_and_alignment(
        parts in proptest::collection::vec((any::<u8>(), any::<u64>(), "\\PC{0,9}"), 0..40),
    ) {
        let mut bytes = Vec::new();
        let mut to = CdrEncoder::new(&mut bytes);
        let (mut fields, mut wanted) = (String::new(), Vec::new());
        for (n, (kind, number, text)) in parts.iter().enumerate() {
            let (name, value) = match kind % 10 {
                0 => { to.bool(number & 1 == 1); ("bool", Value::Integer((number & 1).into())) }
                1 => { to.u8(*number as u8); ("uint8", Value::Integer((*number as u8).into())) }
                2 => { to.i8(*number as i8); ("int8", Value::Integer((*number as i8).into())) }
                3 => { to.u16(*number as u16); ("uint16", Value::Integer((*number as u16).into())) }
                4 => { to.i32(*number as i32); ("int32", Value::Integer((*number as i32).into())) }
                5 => { to.u32(*number as u32); ("uint32", Value::Integer((*number as u32).into())) }
                6 => { to.u64(*number); ("uint64", Value::Integer((*number).into())) }
                7 => { to.f64(*number as f64); ("float64", Value::Real(*number as f64)) }
                8 => {
                    to.length(2);
                    to.string(text);
                    to.string("");
                    let texts = [text.as_str(), ""].map(|text| Value::Text(text.to_owned()));
                    ("string[]", Value::List(texts.into()))
                }
                _ => { to.string(text); ("string", Value::Text(text.clone())) }
            };
            fields += &format!("{name} field_{n}\n");
            wanted.push((format!("field_{n}"), value));
        }
        prop_assert_eq!(decode(&fields, &bytes), Some(Value::Message(wanted)));
    }
}

#[test]
fn diagnostics_keep_levels_and_texts() {
    let diagnostics = [
        Diagnostic {
            level: DiagnosticLevel::Error,
            name: "axis x".to_owned(),
            message: "a NUL\0 ends a text".to_owned(),
            hardware_id: String::new(),
            values: vec![("statusword", "0x0237".to_owned())],
        },
        Diagnostic {
            level: DiagnosticLevel::Stale,
            name: "bus".to_owned(),
            message: "µ".to_owned(),
            hardware_id: "demo".to_owned(),
            values: Vec::new(),
        },
    ];
    let mut bytes = Vec::new();
    encode_diagnostics(EPOCH + 5, &diagnostics, &mut bytes);
    let found = decode(&schema::DIAGNOSTIC_ARRAY.text, &bytes).unwrap();
    assert_eq!(found.stamp(), EPOCH + 5);
    let [axis, bus] = found["status"].list() else {
        panic!("{found:?}");
    };
    assert_eq!((axis["level"].integer(), bus["level"].integer()), (2, 3));
    assert_eq!(axis["message"].text(), "a NUL");
    assert_eq!(axis["values"].list()[0]["value"].text(), "0x0237");
    assert_eq!(bus["message"].text(), "µ");
}

#[test]
fn fields_of_inputs_with_odd_names_differ() {
    let names = ["io.Input 1", "io.Input-1", "1", "header", "µ\n"].map(str::to_owned);
    let schema = schema::inputs(&names);
    let fields = schema
        .text
        .lines()
        .filter_map(|line| line.strip_prefix("float64 "));
    let fields: Vec<_> = fields.collect();
    let expected = ["io_input_1", "io_input_1_2", "input_1", "header_2", "input"];
    assert_eq!(fields, expected);
}

#[test]
fn topics_of_axes_with_odd_names_differ() {
    let mut machine = demo();
    let names = ["X 1", "X-1"];
    for (axis, name) in machine.axes.iter_mut().zip(names) {
        axis.name = name.to_owned();
    }
    let topics = Topics::new(&machine, 0);
    let topic = |index| &*topic(&topics, Source::Axis(index)).name;
    assert_eq!(
        [topic(0), topic(1)],
        ["/ecaxis/axis/X_1", "/ecaxis/axis/X_1_2"]
    );
}

/// What was flushed is readable even if the file is never finished.
#[test]
fn mcap_has_every_row_and_gap() {
    let machine = demo();
    let topics = Arc::new(Topics::new(&machine, EPOCH));
    let words = row_words(machine.axes.len(), machine.inputs.len());
    let wanted = |source| matches!(source, Source::Bus | Source::Axis(0));
    let mut file = McapFile::new(Cursor::new(Vec::new()), topics, wanted).unwrap();
    let mut row = vec![0; words];
    for n in 0..2500_u64 {
        (row[0], row[1]) = (n + 1, n * 1_000_000);
        if n == 1200 {
            file.miss(7);
        }
        file.write_row(&row).unwrap();
        if n % 1000 == 999 {
            file.flush().unwrap();
        }
    }
    file.write_diagnostics(EPOCH, &[]).unwrap();
    let bytes = file.finish().unwrap().into_inner();
    let rows = |messages: mcap::MessageStream<'_>| -> Vec<(i128, i128)> {
        let messages = messages.map_while(Result::ok);
        let bus = messages.filter(|message| message.channel.topic == "/ecaxis/bus");
        let bus = bus.map(|message| {
            assert_eq!(message.channel.message_encoding, "cdr");
            let found = decode(&schema::BUS.text, &message.data).unwrap();
            assert_eq!(found.stamp(), message.log_time);
            (found["row"].integer(), found["missed"].integer())
        });
        bus.collect()
    };
    let all = rows(mcap::MessageStream::new(&bytes).unwrap());
    let expected: Vec<_> = (0..2500)
        .map(|n| (n, if n == 1200 { 7 } else { 0 }))
        .collect();
    assert_eq!(all, expected);
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    let statistics = summary.stats.unwrap();
    assert_eq!(
        (statistics.message_count, statistics.channel_count),
        (5000, 2)
    );
    let cut = &bytes[..bytes.len() / 2];
    let options = mcap::read::Options::IgnoreEndMagic.into();
    let whole = rows(mcap::MessageStream::new_with_options(cut, options).unwrap());
    assert!(
        whole.len() > 1000 && expected.starts_with(&whole),
        "{}",
        whole.len()
    );
}

/// The recording has every cycle of the run, with the values that clients get, up to the last.
#[test]
fn a_recording_has_every_cycle() {
    let server = harness::Server::with_recording(harness::demo());
    let mut client = server.owner("cell");
    let signals = ["x.position", "x.target_velocity", "y.statusword"];
    client.ok(
        "subscribe",
        json!({"topics": ["samples"], "signals": signals, "interval_ms": 10}),
    );
    client.done("enable", json!({"axis": "*"}));
    client.done("move", json!({"axis": "x", "to": 5.0, "speed": 0.5}));
    std::thread::sleep(Duration::from_millis(200));
    client.ok("hello", json!({}));
    let batches = std::mem::take(&mut client.events);
    drop(client);
    let bytes = server.recorded();
    let mut recorded = HashMap::new();
    let (mut next, mut times) = (0, Vec::new());
    for message in mcap::MessageStream::new(&bytes).unwrap() {
        let message = message.unwrap();
        let schema = std::str::from_utf8(&message.channel.schema.as_ref().unwrap().data).unwrap();
        let found = decode(schema, &message.data).expect("a message of its schema");
        assert_eq!(found.stamp(), message.log_time);
        match &*message.channel.topic {
            "/ecaxis/bus" => {
                assert_eq!(
                    (found["row"].integer(), found["missed"].integer()),
                    (next, 0)
                );
                next += 1;
                times.push(message.log_time);
            }
            topic => drop(recorded.insert((topic.to_owned(), message.log_time), found)),
        }
    }
    let mut compared = 0;
    for batch in batches
        .iter()
        .filter(|batch| batch["event"] == json!("samples"))
    {
        let batch_times = batch["time_ns"].as_array().unwrap();
        for (time, row) in batch_times.iter().zip(batch["rows"].as_array().unwrap()) {
            // Virtual time begins in 1970.
            let time = time.as_u64().unwrap();
            let axis = |name: &str| &recorded[&(format!("/ecaxis/axis/{name}"), time)];
            // The parser of JSON here may be wrong by the last bit.
            let same = |got: f64, wanted: &serde_json::Value| {
                let wanted = wanted.as_f64().unwrap();
                assert!(
                    (got - wanted).abs() <= 1e-15 * wanted.abs(),
                    "{got} {wanted}"
                );
            };
            same(axis("x")["position"].real(), &row[0]);
            same(axis("x")["target_velocity"].real(), &row[1]);
            same(axis("y")["statusword"].integer() as f64, &row[2]);
            compared += 1;
        }
    }
    assert!(compared > 100 && times.len() > compared, "{compared}");
    // The file goes on to the end of the run: no power, and the bus leaves Op.
    let last = &recorded[&("/ecaxis/axis/x".to_owned(), *times.last().unwrap())];
    assert_ne!(last["state"].integer(), 4, "{last:?}");
    assert!(recorded.keys().any(|(topic, _)| topic == "/diagnostics"));
}
