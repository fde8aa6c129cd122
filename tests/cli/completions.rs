//! Shell completion.

use std::process::Command;

use ecaxis_test_support::program::{Ran, run};
use ecaxis_test_support::{assert_contains, skip};

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

/// Writes the script of a shell and a machine file into a folder.
fn folder(shell: &str, script: &str) -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a folder");
    let text = run(["completions", shell]).exits(0).out;
    std::fs::write(folder.path().join(script), text).expect("written");
    let machine =
        "[[device]]\nname = \"left arm\"\n\n[[device]]\n  name     = \"io\"  # terminals\n";
    std::fs::write(folder.path().join("m.toml"), machine).expect("written");
    folder
}

fn in_bash(line: &[&str]) -> Vec<String> {
    let folder = folder("bash", "script");
    let quoted: Vec<String> = line.iter().map(|word| format!("'{word}'")).collect();
    let (last, before) = (line.len() - 1, line[line.len() - 2]);
    let ask = format!(
        "source ./script; COMP_WORDS=({}); COMP_CWORD={last}; _ecaxis_named ecaxis '{}' '{before}'; printf '%s\\n' \"${{COMPREPLY[@]}}\"",
        quoted.join(" "),
        line[last]
    );
    let mut bash = Command::new("bash");
    let offers = lines(bash.args(["-c", &ask]).current_dir(folder.path()));
    offers
        .iter()
        .map(|offer| offer.replace("\\ ", " "))
        .collect()
}

fn in_fish(line: &[&str]) -> Vec<String> {
    let folder = folder("fish", "script.fish");
    let ask = format!("source script.fish; complete -C '{}'", line.join(" "));
    let mut fish = Command::new("fish");
    fish.env("HOME", folder.path()).current_dir(folder.path());
    let offers = lines(fish.args(["--no-config", "-c", &ask]));
    // A tab separates the description.
    let name = |offer: String| offer.split('\t').next().unwrap_or_default().to_owned();
    offers.into_iter().map(name).collect()
}

/// Types the line and a tab into zsh, in a terminal, and records what it passes to `compadd`.
fn in_zsh(line: &[&str]) -> Vec<String> {
    /// `zle-line-init` runs when the line editor begins to read keys; before, Ctrl-U is lost.
    const RECORD: &str = r#"
PROMPT=
fpath=($PWD $fpath)
autoload -Uz compinit
compinit -u -D
compadd() {
    if [[ ${@[1,(i)(-|--)]} != *-(O|A|D)* ]]; then
        local -a hits
        builtin compadd -O hits "$@"
        print -rl -- $hits >>offers
    fi
    builtin compadd "$@"
}
zle-line-init() { print READY }
zle -N zle-line-init
"#;
    const TYPE: &str = r#"
zmodload zsh/zpty
zpty z zsh -f -i
zpty -w z 'source ./record'
zpty -r z line '*READY*'
zpty -n -w z "$1"$'\t\C-u exit\n'
while zpty -r z line; do :; done
touch offers
"#;
    let folder = folder("zsh", "_ecaxis");
    std::fs::write(folder.path().join("record"), RECORD).expect("written");
    let mut zsh = Command::new("zsh");
    zsh.env("TERM", "xterm").current_dir(folder.path());
    Ran::new(zsh.args(["-f", "-c", TYPE, "zsh", &line.join(" ")])).exits(0);
    let offers = std::fs::read_to_string(folder.path().join("offers")).expect("recorded");
    let offers = offers.lines().filter(|line| !line.is_empty());
    offers.map(str::to_owned).collect()
}

fn lines(command: &mut Command) -> Vec<String> {
    let out = Ran::new(command).exits(0).out;
    out.lines().map(str::to_owned).collect()
}

/// Asserts what a shell offers for the last word of lines.
fn completes_interfaces_and_devices(shell: &str, offers: fn(&[&str]) -> Vec<String>) {
    if Command::new(shell).arg("--version").output().is_err() {
        skip(&format!("there is no {shell}"));
        return;
    }
    for (line, expected) in [
        (&["ecaxis", "run", "m.toml", "--nic", ""][..], "lo"),
        (&["ecaxis", "sim", "m.toml", "--nic2", ""], "lo"),
        (&["ecaxis", "scan", "l"], "lo"),
        (&["ecaxis", "doctor", ""], "lo"),
        (&["ecaxis", "sdo", "read", "m.toml", "i"], "io"),
        (&["ecaxis", "sdo", "list", "m.toml", ""], "io"),
        (&["ecaxis", "eeprom", "read", "m.toml", ""], "left arm"),
        (&["ecaxis", "firmware", "update", "m.toml", ""], "left arm"),
        (&["ecaxis", "sdo", "read", "m.toml", "--js"], "--json"),
        (&["ecaxis", "run", "m."], "m.toml"),
    ] {
        // bash completes files itself.
        let offers = match (shell, expected) {
            ("bash", "m.toml") => continue,
            _ => offers(line),
        };
        assert!(
            offers.iter().any(|offer| offer == expected),
            "{shell}, {line:?}: {offers:?}"
        );
        if line.last() != Some(&"") {
            assert_eq!(offers.len(), 1, "{shell}, {line:?}: {offers:?}");
        }
    }
}

#[test]
fn bash_completes_interfaces_and_devices() {
    completes_interfaces_and_devices("bash", in_bash);
}

#[test]
fn fish_completes_interfaces_and_devices() {
    completes_interfaces_and_devices("fish", in_fish);
}

#[test]
fn zsh_completes_interfaces_and_devices() {
    completes_interfaces_and_devices("zsh", in_zsh);
}
