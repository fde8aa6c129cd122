//! What a new user starts from: the demonstration and `ecaxis init`, in any folder.

use std::path::Path;
use std::process::{Command, Stdio};

use ecaxis_test_support::program::{Ran, ecaxis};
use ecaxis_test_support::{assert_contains, root};

/// Runs the program in a folder, without the files of the repository.
#[track_caller]
fn ran(folder: &Path, line: &str) -> Ran {
    let mut command = Command::new(ecaxis());
    command.current_dir(folder).stdin(Stdio::null());
    command.env("XDG_CACHE_HOME", folder);
    Ran::new(command.args(line.split(' ')))
}

#[test]
fn run_without_a_file_runs_the_demonstration_in_any_folder() {
    let folder = tempfile::tempdir().expect("a folder");
    let ran = ran(folder.path(), "run --virtual").exits(0);
    assert_contains(
        &ran.out,
        &["the demonstration: 2 SubDevices", "2 complete runs"],
    );
    let left: Vec<_> = std::fs::read_dir(folder.path())
        .expect("a folder")
        .collect();
    assert!(left.is_empty(), "{left:?}");
}

#[test]
fn init_writes_a_starter_that_runs_and_overwrites_only_with_force() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = folder.path();
    let out = ran(at, "init press").exits(0).out;
    assert_contains(
        &out,
        &[
            "ecaxis.schema.json",
            "next: `ecaxis run press/machine.toml`",
        ],
    );
    let text = std::fs::read_to_string(at.join("press/machine.toml")).expect("written");
    assert!(
        text.starts_with("#:schema ./ecaxis.schema.json\n"),
        "{text}"
    );
    let schema = std::fs::read_to_string(at.join("press/ecaxis.schema.json")).expect("written");
    assert_eq!(schema, ran(at, "schema").exits(0).out);
    ran(at, "check press/machine.toml").exits(0);
    let out = ran(at, "run press/machine.toml --virtual").exits(0).out;
    assert_contains(&out, &["1 complete run", "lost frames             0"]);

    std::fs::write(at.join("press/machine.toml"), "dear diary").expect("written");
    ran(at, "init press").fails(2, &["press/machine.toml exists already", "`--force`"]);
    let kept = std::fs::read(at.join("press/machine.toml")).expect("it is there");
    assert_eq!(kept, b"dear diary");
    ran(at, "init press --force").exits(0);
    ran(at, "check press/machine.toml").exits(0);
    ran(at, "init press/machine.toml").fails(2, &["cannot write press/machine.toml"]);
}

/// The line is an own comment of the file: scans and checks ignore it.
#[test]
fn scan_writes_the_schema_next_to_the_file() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = folder.path();
    ran(at, "init one").exits(0);
    ran(
        at,
        "scan --sim one/machine.toml --esi one/esi --write two.toml",
    )
    .exits(0);
    let text = std::fs::read_to_string(at.join("two.toml")).expect("written");
    assert!(
        text.starts_with("#:schema ./ecaxis.schema.json\n"),
        "{text}"
    );
    assert!(at.join("ecaxis.schema.json").is_file());
    // No path of a temporary file.
    let unwritable = "cannot write no/two.toml: entity not found\n";
    ran(
        at,
        "scan --sim one/machine.toml --esi one/esi --write no/two.toml",
    )
    .fails(2, &[unwritable]);
}

/// Builds the generated project against these sources, and runs its tests and its program.
#[test]
fn init_rust_writes_a_project_that_builds_and_moves() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = folder.path();
    ran(at, "init --rust arm --source nowhere").fails(2, &["nowhere", "`--source DIR`"]);
    let source = root();
    let line = format!("init --rust arm --source {}", source.display());
    let out = ran(at, &line).exits(0).out;
    assert_contains(&out, &["src/lib.rs", "`cargo test`"]);
    let project = at.join("arm");
    let manifest = std::fs::read_to_string(project.join("Cargo.toml")).expect("written");
    assert!(manifest.contains("name = \"arm_controller\""), "{manifest}");
    // The versions and the compiled packages of this workspace, without a network.
    std::fs::copy(source.join("Cargo.lock"), project.join("Cargo.lock")).expect("copied");
    let built = ecaxis();
    let target = built.ancestors().nth(2).expect("the target folder");
    let cargo = |words: &str| {
        // Outside of `cargo test`, the one of rustup selects the toolchain for dependencies too.
        let mut command = Command::new(std::env::var_os("CARGO").unwrap_or("cargo".into()));
        command.args(words.split(' ')).current_dir(&project);
        command.env("CARGO_TARGET_DIR", target).stdin(Stdio::null());
        command.args(["--config", "profile.dev.package.\"*\".debug=false"]);
        command.args(["--config", "profile.dev.debug='line-tables-only'"]);
        // Cargo compiles these again for the project; without optimization, in half the time.
        for package in ["axis", "ecat", "esi", "master", "sim"] {
            let slow = format!("profile.dev.package.ecaxis-{package}.opt-level=0");
            command.args(["--config", &slow]);
        }
        Ran::new(&mut command)
    };
    let mut format = Command::new("cargo");
    Ran::new(format.args(["fmt", "--check"]).current_dir(&project)).exits(0);
    let tested = cargo("test --offline").exits(0);
    assert_contains(
        &tested.out,
        &[
            "pendulum_swings_and_returns_to_its_start ... ok",
            "2 passed",
        ],
    );
    assert!(!tested.err.contains("warning"), "{}", tested.err);
    let ran = cargo("run --offline --quiet").exits(0);
    assert_contains(&ran.out, &[" cycles\nx: ", " mm\ny: "]);
}
