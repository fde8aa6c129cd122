//! Two runs of one seed are equal bit by bit, whatever else the computer does.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use super::generate;
use super::run;

/// Scenes in which several tasks of the supervisor send datagrams in the same cycle.
const SCENES: [&str; 6] = [
    "device-missing",
    "anything",
    "gateway-axis",
    "sercos",
    "line-shaft",
    "gantry",
];
const REPETITIONS: usize = 4;

fn assert_equal_runs(seed: u64, scene: &str) {
    let folder = tempfile::tempdir().expect("a folder");
    let plan = generate::plan(seed, Some(scene));
    let plan = run::placed(&plan, folder.path());
    let first = run::record(&plan, folder.path());
    assert!(!first.is_empty());
    for _ in 1..REPETITIONS {
        let again = run::record(&plan, folder.path());
        let differs = first
            .iter()
            .zip(&again)
            .position(|(one, other)| one != other);
        assert!(
            first == again,
            "seed {seed} ({scene}): the recordings differ from byte {differs:?} on, {} and {} bytes",
            first.len(),
            again.len()
        );
    }
}

#[test]
fn a_seed_gives_the_same_recording_every_time() {
    for (number, scene) in SCENES.iter().enumerate() {
        assert_equal_runs(7 + number as u64, scene);
    }
}

/// Threads that use all processors change no recording.
#[test]
fn a_seed_gives_the_same_recording_on_a_busy_computer() {
    let ended = AtomicBool::new(false);
    std::thread::scope(|scope| {
        for _ in 0..4 {
            scope.spawn(|| {
                while !ended.load(Ordering::Relaxed) {
                    std::hint::spin_loop();
                }
            });
        }
        let guard = Ending(&ended);
        for (number, scene) in SCENES.iter().enumerate() {
            assert_equal_runs(40 + number as u64, scene);
        }
        drop(guard);
    });
}

/// `select!` polls in a random order unless it is biased, and a HashMap iterates in a random one.
/// Modules that do not run in virtual time may use both.
#[test]
fn nothing_that_runs_in_virtual_time_is_random() {
    const REAL_TIME_ONLY: &str = "mailbox_gateway";
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let mut folders: Vec<_> = ["axis", "ecat", "master", "sim"]
        .map(|package| root.join(package).join("src"))
        .into();
    let mut selects = 0;
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).expect("a folder") {
            let path = entry.expect("an entry").path();
            if path.ends_with(REAL_TIME_ONLY) {
                continue;
            }
            if path.is_dir() {
                folders.push(path);
                continue;
            }
            let text = std::fs::read_to_string(&path).expect("a source file");
            for word in ["HashMap", "HashSet", "RandomState"] {
                assert!(!text.contains(word), "{}: {word}", path.display());
            }
            for (at, _) in text.match_indices("select! {") {
                selects += 1;
                let mut lines = text[at..].lines().skip(1).map(str::trim);
                let first = lines.find(|line| !line.starts_with("//"));
                assert_eq!(first, Some("biased;"), "{}", path.display());
            }
        }
    }
    assert!(selects > 3, "{selects}");
}

/// Ends the other threads, also after a panic.
struct Ending<'a>(&'a AtomicBool);

impl Drop for Ending<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}
