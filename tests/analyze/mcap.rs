//! The values of every cycle of a recording, as rows of samples and as MCAP.

use std::sync::Arc;

use ecaxis_master::cancel::CancelToken;
use ecaxis_master::rt::samples::flags;
use ecaxis_master::samples::{SampleLayout, Samples};
use ecaxis_master::session::{self, Attachments};
use ecaxis_test_support::Heard;
use ecaxis_test_support::ros2::decode;
use ecaxis_tools::analyze::RowSink;

use super::*;

/// A run of the demonstration: its recording, and its own samples of each cycle.
fn run_with_samples(folder: &Path) -> (PathBuf, Samples) {
    let machine = load("demo.toml");
    let samples = Samples::create(SampleLayout::new(&machine), 60_000_000_000).unwrap();
    let options = Options {
        repeat: Some(1),
        ..virtual_time()
    };
    let (options, path) = ecaxis_test_support::recorded(options, folder);
    let attachments = Attachments {
        samples: samples.writer(),
        ..Attachments::default()
    };
    let stop = Arc::<CancelToken>::default();
    let outcome = session::run_attached(machine, options, stop, &mut Heard::default(), attachments);
    outcome.result.unwrap();
    (path, samples)
}

/// Each value of the recording equals that of the run: actual values of the same frame, targets of
/// the cycle before, in which the frame was made.
#[test]
fn rows_of_a_recording_are_the_samples_of_the_run() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let (path, samples) = run_with_samples(folder.path());
    let machine = load("demo.toml");
    let mut found = Vec::new();
    let sink = RowSink {
        machine: &machine,
        take: &mut |row, missed| found.push((row.to_vec(), missed)),
    };
    let bytes = std::fs::read(&path).expect("the recording");
    let known = Context::default().with_machine(&machine);
    analyze::analyze_rows(vec![Reader::new(&bytes[..])], None, known, Some(sink));
    let mut own = Vec::new();
    let missed = samples.read_new(&mut 0, |_, row| own.push(row.to_vec()));
    assert_eq!(missed, 0);
    let layout = samples.layout();
    let value =
        |row: &[u64], name: &str| f64::from_bits(row[layout.signal(name).expect("a signal").word]);
    // The first motion is the same in both.
    let in_op = |row: &&Vec<u64>| row[3] & flags::IN_OP != 0 && row[3] & flags::FRESH != 0;
    let own: Vec<_> = own.iter().filter(in_op).collect();
    let moves = |row: &[u64]| value(row, "x.velocity") != 0.0;
    let begin = own.iter().position(|row| moves(row)).expect("a motion");
    let first = found
        .iter()
        .position(|(row, _)| moves(row))
        .expect("a motion");
    let mut compared = 0;
    for (at, row) in own.iter().enumerate().skip(begin) {
        let Some((same, missed)) = found.get(first + at - begin) else {
            break;
        };
        assert_eq!(*missed, 0);
        for name in ["position", "velocity", "torque", "statusword"] {
            for axis in ["x", "y"] {
                let name = format!("{axis}.{name}");
                let (got, wanted) = (value(same, &name), value(row, &name));
                assert!(got == wanted || got.is_nan(), "{name} {at}: {got} {wanted}");
                assert!(
                    !got.is_nan() || !name.ends_with("position"),
                    "{name} has a value"
                );
            }
        }
        for axis in ["x", "y"] {
            // One count is 0.0025 mm.
            let sent = value(same, &format!("{axis}.target_position"));
            let made = value(own[at - 1], &format!("{axis}.target_position"));
            assert!((sent - made).abs() <= 0.00126, "{axis} {at}: {sent} {made}");
            let control = value(same, &format!("{axis}.controlword"));
            assert_eq!(control, value(own[at - 1], &format!("{axis}.controlword")));
        }
        compared += 1;
    }
    assert!(compared > 1500, "{compared}");
    // The numbers are consecutive, the times ascend.
    assert!(
        found
            .windows(2)
            .all(|pair| pair[1].0[0] == pair[0].0[0] + 1)
    );
    assert!(found.windows(2).all(|pair| pair[1].0[1] > pair[0].0[1]));
}

#[test]
fn analyze_writes_mcap_and_overwrites_only_with_force() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let (path, samples) = run_with_samples(folder.path());
    let output = folder.path().join("run.mcap");
    let machine = root().join("configs/demo.toml");
    let [path, output, machine] =
        [&path, &output, &machine].map(|path| path.to_str().expect("UTF-8"));
    let line = [path, "--machine", machine, "--mcap", output];
    ecaxis(&line).exits(0);
    let refused = ecaxis(&line).exits(2);
    assert_contains(&refused.err, &["exists already"]);
    ecaxis(&[&line[..], &["--force"]].concat()).exits(0);
    let refused = ecaxis(&[path, "--machine", machine, "--mcap", path, "--force"]).exits(2);
    assert_contains(&refused.err, &["a recording to read"]);
    ecaxis(&[path, "--mcap", "other.mcap"]).exits(2);
    let bytes = std::fs::read(output).expect("the file");
    let mut counts = std::collections::BTreeMap::<String, u64>::new();
    for message in ::mcap::MessageStream::new(&bytes).expect("MCAP") {
        let message = message.expect("a message");
        let schema = message.channel.schema.as_ref().expect("a schema");
        let schema = std::str::from_utf8(&schema.data).expect("UTF-8");
        let found = decode(schema, &message.data).expect("a message of its schema");
        assert_eq!(found.stamp(), message.log_time);
        *counts.entry(message.channel.topic.clone()).or_default() += 1;
    }
    let topics: Vec<_> = counts.keys().map(String::as_str).collect();
    let expected = [
        "/ecaxis/axis/x",
        "/ecaxis/axis/y",
        "/ecaxis/bus",
        "/joint_states",
    ];
    assert_eq!(topics, expected);
    let cycles = samples.written();
    let near = |count: &u64| count.abs_diff(cycles) < cycles / 10;
    assert!(counts.values().all(near), "{counts:?} of {cycles} cycles");
}

/// Any recording of a real bus, with a machine file of another one: no panic, nothing invented.
#[test]
fn rows_of_other_machines_have_no_values() {
    let machine = load("demo.toml");
    for path in captures() {
        let mut rows = 0;
        let sink = RowSink {
            machine: &machine,
            take: &mut |_, _| rows += 1,
        };
        let bytes = std::fs::read(&path).expect("readable");
        let known = Context::default().with_machine(&machine);
        analyze::analyze_rows(vec![Reader::new(&bytes[..])], None, known, Some(sink));
        assert_eq!(rows, 0, "{}", path.display());
    }
}
