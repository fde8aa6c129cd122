//! Shell completion.

use std::process::Command;

use ecaxis_test_support::assert_contains;
use ecaxis_test_support::program::{Ran, run};

#[test]
fn completions_exist_for_every_shell() {
    for (shell, parts) in [
        ("bash", &["complete -F _ecaxis", "--faults"][..]),
        ("zsh", &["#compdef ecaxis", "--faults"]),
        ("fish", &["complete -c ecaxis", "faults"]),
    ] {
        let script = run(["completions", shell]).exits(0).out;
        assert_contains(&script, &[parts, &["doctor", "explain"]].concat());
    }
    run(["completions", "dos"]).fails(2, &["'dos'"]);
}

/// Returns what bash offers for the last word of a line.
fn offers(line: &[&str]) -> Vec<String> {
    let folder = tempfile::tempdir().expect("a folder");
    let script = run(["completions", "bash"]).exits(0).out;
    std::fs::write(folder.path().join("script"), script).expect("written");
    let machine =
        "[[device]]\nname = \"left arm\"\n\n[[device]]\n  name     = \"io\"  # terminals\n";
    std::fs::write(folder.path().join("m.toml"), machine).expect("written");
    let quoted: Vec<String> = line.iter().map(|word| format!("'{word}'")).collect();
    let (last, before) = (line.len() - 1, line[line.len() - 2]);
    let ask = format!(
        "source ./script; COMP_WORDS=({}); COMP_CWORD={last}; _ecaxis_named ecaxis '{}' '{before}'; printf '%s\\n' \"${{COMPREPLY[@]}}\"",
        quoted.join(" "),
        line[last]
    );
    let mut bash = Command::new("bash");
    let ran = Ran::new(bash.args(["-c", &ask]).current_dir(folder.path())).exits(0);
    ran.out.lines().map(str::to_owned).collect()
}

#[test]
fn bash_completes_interfaces_and_devices() {
    for line in [
        &["ecaxis", "run", "m.toml", "--nic", ""][..],
        &["ecaxis", "scan", "l"],
    ] {
        assert!(
            offers(line).contains(&"lo".to_owned()),
            "{line:?}: {:?}",
            offers(line)
        );
    }
    let devices = offers(&["ecaxis", "sdo", "read", "m.toml", "i"]);
    assert!(devices.contains(&"io".to_owned()), "{devices:?}");
    let options = offers(&["ecaxis", "sdo", "read", "m.toml", "--js"]);
    assert_eq!(options, ["--json"]);
}
