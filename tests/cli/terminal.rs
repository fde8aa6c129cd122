//! Output on a terminal with 80 columns.

use ecaxis_test_support::host::retry_if_host_stalled;
use std::process::{Command, Stdio};

use ecaxis_test_support::program::ecaxis;
use ecaxis_test_support::{root, skip, tolerant_demo};

/// Returns the exit code and the whole output, stdout and stderr interleaved. Prints the reason and
/// returns `None` without `script`.
fn on_terminal(arguments: &str) -> Option<(i32, String)> {
    if Command::new("script").arg("--version").output().is_err() {
        skip("there is no `script`, which makes terminals");
        return None;
    }
    let program = ecaxis();
    let program = program.display();
    let line = format!("stty cols 80 rows 24; {program} {arguments}");
    let output = Command::new("script")
        .args(["-qec", &line, "/dev/null"])
        .current_dir(root())
        .env("TERM", "xterm")
        .env_remove("COLUMNS")
        .env_remove("NO_COLOR")
        .stdin(Stdio::null())
        .output()
        .expect("it runs");
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    Some((output.status.code().expect("an exit code"), text))
}

/// Removes escape sequences. Each carriage return starts a new line.
fn lines(text: &str) -> Vec<String> {
    let mut plain = String::new();
    let mut rest = text.chars();
    while let Some(c) = rest.next() {
        match c {
            '\u{1b}' => {
                // CSI sequences end with a letter.
                let _ = rest.by_ref().skip(1).find(char::is_ascii_alphabetic);
            }
            '\r' => plain.push('\n'),
            c => plain.push(c),
        }
    }
    plain
        .lines()
        .map(|line| line.trim_end().to_owned())
        .collect()
}

#[test]
fn no_line_is_wider_than_the_terminal() {
    let folder = tempfile::tempdir().expect("a folder");
    let silent = folder.path().join("silent.toml");
    let script = "[[fault]]\nkind = \"power-off\"\nat = \"1s\"\ndevice = 1\n";
    std::fs::write(&silent, script).expect("written");
    let abort = folder.path().join("abort.toml");
    let script =
        "[[fault]]\nkind = \"sdo-abort\"\ndevice = 0\nindex = 0x6060\nsub = 0\ncode = 0x06090030\n";
    std::fs::write(&abort, script).expect("written");
    let (silent, abort) = (silent.display(), abort.display());
    let table = [
        (0, "sdo list configs/demo.toml x --sim".to_owned()),
        (0, "esi objects configs/esi/EPOS4.xml --mode csp".to_owned()),
        (0, "check configs/commissioning.toml".to_owned()),
        (0, "explain configs/groups.toml".to_owned()),
        (0, "explain configs/commissioning.toml".to_owned()),
        (0, "run configs/demo.toml --sim --virtual".to_owned()),
        (
            1,
            format!("run configs/demo.toml --sim --virtual --faults {silent}"),
        ),
        (
            1,
            format!("run configs/demo.toml --sim --virtual --faults {abort}"),
        ),
        (
            1,
            "compare configs/demo.toml --sim configs/commissioning.toml".to_owned(),
        ),
        (0, "scan --sim configs/commissioning.toml --ask".to_owned()),
        (2, "check configs/no-such.toml".to_owned()),
        (1, "sdo write configs/demo.toml x 0x6041 1 --sim".to_owned()),
        (1, "sdo read configs/demo.toml x 0x5fff --sim".to_owned()),
    ];
    for (expected, line) in table {
        let Some((code, text)) = on_terminal(&line) else {
            return;
        };
        assert_eq!(code, expected, "{line}: {text}");
        assert!(text.lines().count() > 1, "{line}: {text}");
        for one in lines(&text) {
            // The table of axes has no line breaks: its lines are padded to the width.
            let one: Vec<char> = one.chars().collect();
            let padded = one.chunks(80).rev().skip(1);
            for piece in padded {
                let piece: String = piece.iter().collect();
                assert!(piece.ends_with(' '), "{line}: `{piece}`");
            }
        }
    }
}

/// Emergencies, warnings and the Ctrl-C message have their own lines, separate from the transient
/// status line.
#[test]
fn permanent_lines_do_not_mix_with_the_status_line() {
    retry_if_host_stalled(|| {
        let folder = tempfile::tempdir().expect("a folder");
        let faults = folder.path().join("emergency.toml");
        let script = "[[fault]]\nkind = \"emergency\"\nat = \"1s\"\ndevice = 1\ncode = 0x8611\n";
        std::fs::write(&faults, script).expect("written");
        let machine = folder.path().join("m.toml");
        std::fs::write(&machine, tolerant_demo()).expect("written");
        let line = format!(
            "run {} --sim --for 60s --faults {} & sleep 6; kill -INT $!; wait $!",
            machine.display(),
            faults.display()
        );
        let Some((_, text)) = on_terminal(&line) else {
            return;
        };
        let lines = lines(&text);
        // The summary repeats these lines.
        let meanwhile = lines
            .iter()
            .take_while(|line| !line.contains("complete run"));
        let meanwhile: Vec<&String> = meanwhile.collect();
        let having = |part: &str| -> Vec<&String> {
            let these = meanwhile.iter().filter(|line| line.contains(part));
            these.copied().collect()
        };
        let [emergency] = having("0x8611")[..] else {
            panic!("not reported once:\n{text}");
        };
        assert!(emergency.starts_with("warning: `y`: "), "{emergency}");
        assert_eq!(
            having("stopping; once more"),
            ["stopping; once more to leave at once"]
        );
    });
}
