//! What identifies a machine and the program.

use std::path::Path;

use ecaxis_test_support::{program, root};

fn copied(folder: &Path) -> String {
    std::fs::create_dir(folder.join("esi")).expect("created");
    for name in ["demo.toml", "esi/EPOS4.xml", "esi/IDX.xml"] {
        std::fs::copy(root().join("configs").join(name), folder.join(name)).expect("copied");
    }
    folder.join("demo.toml").to_str().expect("UTF-8").to_owned()
}

fn sha256(file: &str) -> String {
    let value = program::run(["check", "--json", file]).exits(0).json();
    value["sha256"].as_str().expect("a digest").to_owned()
}

#[test]
fn a_machine_has_the_same_digest_in_another_folder() {
    let (here, there) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let (here_file, there_file) = (copied(here.path()), copied(there.path()));
    let digest = sha256(&here_file);
    assert_eq!(digest.len(), 64);
    assert_eq!(digest, sha256(&there_file));
    // In a comment of the ESI file, which no check would notice.
    let esi = there.path().join("esi/IDX.xml");
    let text = std::fs::read_to_string(&esi).unwrap() + "<!-- other -->\n";
    std::fs::write(esi, text).unwrap();
    assert_ne!(digest, sha256(&there_file));
}

#[test]
fn results_and_recordings_name_the_digest() {
    let folder = tempfile::tempdir().unwrap();
    let file = copied(folder.path());
    let digest = sha256(&file);
    let recording = folder.path().join("run.pcapng");
    let ran = program::run([
        "run",
        &file,
        "--virtual",
        "--json",
        "--record",
        recording.to_str().unwrap(),
    ]);
    let result = ran.exits(0).json();
    assert_eq!(result["summary"]["machine_sha256"], digest.as_str());
    assert_eq!(result["summary"]["version"], env!("CARGO_PKG_VERSION"));
    let bytes = std::fs::read(recording).unwrap();
    let begin = String::from_utf8_lossy(&bytes[..512.min(bytes.len())]).into_owned();
    assert!(begin.contains(&digest), "{begin:?}");
}

#[test]
fn version_is_available_as_json() {
    let version = program::run(["--version", "--json"]).exits(0).json();
    assert_eq!(version["name"], "ecaxis");
    assert_eq!(version["version"], env!("CARGO_PKG_VERSION"));
}
