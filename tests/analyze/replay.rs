//! A recording replaces the bus.

use ecaxis_master::session::{Options, Progress};

use super::recorded;
use ecaxis_test_support::{axes, faults, load, machine, root, run, virtual_time};

fn moved(options: Options) -> (String, Vec<String>) {
    let (outcome, heard) = run(load("demo.toml"), options);
    if let Err(error) = outcome.result {
        panic!("{error}; {:?}", heard.warnings());
    }
    let mut summary = serde_json::to_value(outcome.summary.expect("a summary")).expect("JSON");
    // These keys describe the recording itself.
    for key in ["recorded_frames", "recorded_frames_dropped"] {
        summary.as_object_mut().expect("an object").remove(key);
    }
    let reported = heard
        .0
        .iter()
        .filter(|progress| !matches!(progress, Progress::Status(_)));
    (
        summary.to_string(),
        reported.map(|progress| format!("{progress:?}")).collect(),
    )
}

/// Also if an answer arrives in the moment in which its frame is repeated: it is not the answer of
/// the repetition.
#[test]
fn a_replayed_run_has_the_same_outcome() {
    let late = |delay: &str| {
        format!("[[fault]]\nkind = \"frame-delay\"\ncount = 1\ndelay = \"{delay}\"\n")
    };
    for script in [String::new(), late("30ms"), late("29995us"), late("45ms")] {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("run.pcapng");
        let once = Options {
            repeat: Some(1),
            ..virtual_time()
        };
        let first = moved(Options {
            record: Some(path.clone()),
            faults: faults(&script).faults,
            ..once.clone()
        });
        // A recording of the replay has the same bytes at the same times.
        let again = folder.path().join("again.pcapng");
        let second = moved(Options {
            replay: Some(path.clone()),
            record: Some(again.clone()),
            ..once
        });
        assert_eq!(first, second, "{script}");
        let [path, again] = [path, again].map(|of| std::fs::read(of).expect("a recording"));
        assert!(path == again, "{script}");
    }
}

#[test]
fn a_replay_reports_where_the_run_deviates() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let once = Options {
        repeat: Some(1),
        ..virtual_time()
    };
    let path = recorded(folder.path(), load("demo.toml"), once.clone());
    let replay = || Options {
        replay: Some(path.clone()),
        ..once.clone()
    };
    // Another target gives the same frames with other set-points. The supervision notices axes that
    // do not follow.
    let text =
        std::fs::read_to_string(root().join("configs/demo.toml")).expect("the demonstration");
    let other = machine(&text.replace("x = 50.0, y = 50.0", "x = 40.0, y = 50.0"));
    let (outcome, heard) = run(other, replay());
    assert!(outcome.result.is_err());
    let reported = heard.warnings().join("\n");
    assert!(
        reported.contains("of the data is 0x") && reported.contains("frame "),
        "{reported}"
    );
    // With more devices than in the recording, the replay ends or deviates, but does not hang.
    let (outcome, heard) = run(machine(&axes(3)), replay());
    let error = outcome
        .result
        .expect_err("the recording has two devices")
        .to_string();
    let reported = heard.warnings().join("\n");
    assert!(reported.contains("recording"), "{error}\n{reported}");
    // A recording without replies is rejected.
    let empty = folder.path().join("empty.pcapng");
    std::fs::write(&empty, b"\n\r\r\n").expect("written");
    let (outcome, _) = run(
        load("demo.toml"),
        Options {
            replay: Some(empty),
            ..once
        },
    );
    assert!(
        outcome
            .result
            .expect_err("refused")
            .to_string()
            .contains("the replay"),
        "says what"
    );
}
