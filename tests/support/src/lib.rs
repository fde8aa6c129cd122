//! What the tests of several packages share: machines and runs in virtual time, the program, its
//! recordings, fixtures, snapshots, and tests that depend on the host.

#![allow(
    missing_debug_implementations,
    clippy::new_without_default,
    clippy::print_stderr,
    clippy::print_stdout,
    reason = "only tests use it"
)]

use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};

pub mod bench;
pub mod host;
pub mod machines;
pub mod mailbox;
pub mod program;
pub mod random;
pub mod recordings;
pub mod ros2;
pub mod script;
pub mod wire;

pub use machines::*;

/// The only reason to skip a test that is permitted on CI too.
pub const NO_INTERFACE: &str = "this computer has no network interface";

/// Returns the root of the workspace.
pub fn root() -> PathBuf {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    root.canonicalize().expect("the workspace exists")
}

/// Prints why a test does not run, and adds it to the file `ECAXIS_SKIPS`, which `.ci/run` prints at
/// its end. Panics if `CI` is set and the reason is not permitted there.
#[track_caller]
pub fn skip(reason: &str) {
    let on_ci = std::env::var_os("CI").is_some();
    assert!(reason == NO_INTERFACE || !on_ci, "skipped on CI: {reason}");
    println!("skipped: {reason}");
    if let Some(file) = std::env::var_os("ECAXIS_SKIPS") {
        let thread = std::thread::current();
        let line = format!("{}: {reason}\n", thread.name().unwrap_or("a test"));
        let mut file = File::options()
            .append(true)
            .create(true)
            .open(file)
            .expect("opened");
        file.write_all(line.as_bytes()).expect("written");
    }
}

/// Returns a third-party file or folder for tests, or skips the test.
#[track_caller]
pub fn fixture(path: &str) -> Option<PathBuf> {
    shared("ECAXIS_FIXTURES", "fixtures", path)
}

/// Returns a file or folder of open projects, next to the folder of [`fixture`], or skips the test.
#[track_caller]
pub fn vendor_file(path: &str) -> Option<PathBuf> {
    let path = format!("../vendor-files/{path}");
    shared("ECAXIS_FIXTURES", "fixtures", &path)
}

/// Returns a machine file or fault script of a review, or skips the test.
#[track_caller]
pub fn case(path: &str) -> Option<PathBuf> {
    shared("ECAXIS_CASES", "cases", path)
}

/// Returns a file or folder below the folder that a variable names.
#[track_caller]
fn shared(variable: &str, default: &str, path: &str) -> Option<PathBuf> {
    let folder = std::env::var_os(variable)
        .map_or_else(|| root().join("../shared").join(default), PathBuf::from);
    let file = folder.join(path);
    if !file.exists() {
        skip(&format!("no {} (set {variable})", file.display()));
        return None;
    }
    Some(file)
}

/// Compares a text with `tests/snapshots/NAME`. Writes the file instead if
/// `ECAXIS_UPDATE_SNAPSHOTS` is set.
#[track_caller]
pub fn assert_snapshot(name: &str, now: &str) {
    let file = root().join("tests/snapshots").join(name);
    if std::env::var_os("ECAXIS_UPDATE_SNAPSHOTS").is_some() {
        std::fs::create_dir_all(file.parent().expect("a folder")).expect("created");
        std::fs::write(&file, now).expect("written");
    }
    let kept = std::fs::read_to_string(&file).unwrap_or_default();
    assert!(kept == now, "{} differs, now:\n{now}", file.display());
}

/// Checks that the text contains all parts.
#[track_caller]
pub fn assert_contains(text: &str, parts: &[&str]) {
    for part in parts {
        assert!(text.contains(part), "`{part}` is not in:\n{text}");
    }
}

/// Checks that every line fits a terminal of 80 columns.
#[track_caller]
pub fn assert_fits(text: &str) {
    for line in text.lines() {
        assert!(line.chars().count() <= 80, "longer than 80: {line}");
        assert!(!line.contains(char::is_control), "{line:?}");
    }
}

/// Checks that a page is well-formed XML without external references. Returns the number of its
/// charts and of their paths.
#[track_caller]
pub fn assert_well_formed(page: &str) -> (usize, usize) {
    use quick_xml::events::Event;
    let mut reader = quick_xml::Reader::from_str(page);
    reader.config_mut().check_end_names = true;
    let (mut open, mut charts, mut paths) = (0, 0, 0);
    loop {
        let event = reader.read_event();
        let event = event.unwrap_or_else(|e| panic!("{e} at {}", reader.buffer_position()));
        match event {
            Event::Start(e) => {
                open += 1;
                charts += usize::from(e.name().as_ref() == "figure");
                e.attributes().for_each(|a| drop(a.expect("an attribute")));
            }
            Event::Empty(e) => paths += usize::from(e.name().as_ref() == "path"),
            Event::End(_) => open -= 1,
            Event::Eof => break,
            _ => {}
        }
    }
    assert_eq!(open, 0, "every element ends");
    for elsewhere in ["src=", "href=", "url(", "@import"] {
        assert!(!page.contains(elsewhere), "{elsewhere}");
    }
    (charts, paths)
}
