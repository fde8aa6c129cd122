//! The commands in README.md and docs/first-steps.md produce the output shown there.

use std::process::Stdio;
use std::time::Duration;

use ecaxis_master::acyclic::DatagramClient;
use ecaxis_master::cancel::CancelToken;
use ecaxis_master::clock::Clock;
use ecaxis_master::link::{self, SocketKind};
use ecaxis_master::mailbox::MailboxTransport;
use ecaxis_master::session::run_on_link;
use ecaxis_tools::bench::veth::VethPair;

use ecaxis_test_support::bench::Bench;
use ecaxis_test_support::host::over_a_pair;
use ecaxis_test_support::program::{ProgramOutput, ecaxis};
use ecaxis_test_support::{root, tolerant};

/// The interface in the document.
const NIC: &str = "enp3s0";

/// A command of the document with its output; `…` matches any text.
struct Shown {
    command: String,
    output: String,
}

fn shown(document: &str) -> Vec<Shown> {
    let document = std::fs::read_to_string(root().join(document)).expect("the document");
    let mut all: Vec<Shown> = Vec::new();
    for block in document.split("```console\n").skip(1) {
        let block = block.split("```").next().unwrap_or_default();
        for line in block.lines() {
            if let Some(command) = line.strip_prefix("$ ") {
                all.push(Shown {
                    command: command.to_owned(),
                    output: String::new(),
                });
            } else if let Some(last) = all.last_mut() {
                last.output += line;
                last.output.push('\n');
            }
        }
    }
    all
}

/// True if a text matches the shown output.
fn is_shown(shown: &str, text: &str) -> bool {
    let mut parts = shown.split('…');
    let Some(mut rest) = parts.next().and_then(|first| text.strip_prefix(first)) else {
        return false;
    };
    let parts: Vec<&str> = parts.collect();
    let Some((last, between)) = parts.split_last() else {
        return rest.is_empty();
    };
    for part in between {
        let Some(at) = rest.find(part) else {
            return false;
        };
        rest = &rest[at + part.len()..];
    }
    // A line with only `…` stands for many lines, or for none at the end.
    rest.ends_with(last) || *last == "\n"
}

#[test]
fn ellipsis_matches_any_text() {
    for (shown, text, expected) in [
        ("a\n", "a\n", true),
        ("a\n", "b\n", false),
        ("a … c\n", "a b c\n", true),
        ("a … c\n", "a b d\n", false),
        ("a\n…\nz\n", "a\nb\nc\nz\n", true),
        ("a\n…\nz\n", "a\nb\nc\n", false),
        ("a …\n", "a b\nc\n", true),
        ("…", "anything", true),
    ] {
        assert_eq!(is_shown(shown, text), expected, "{shown:?} {text:?}");
    }
}

/// Runs every command of a document in order, in one folder. `as_here` converts a command for
/// this environment. `as_there` converts its output to that of the document. `after` runs after
/// each command.
fn follow(
    document: &str,
    bench: &Bench,
    as_here: impl Fn(&str) -> String,
    as_there: impl Fn(&str) -> String,
    after: impl Fn(&str),
) {
    let program = ecaxis();
    let folder = program.parent().expect("a folder");
    let path = std::env::var("PATH").unwrap_or_default();
    let commands = shown(document);
    assert!((6..=9).contains(&commands.len()), "{}", commands.len());
    for Shown { command, output } in commands {
        let here = as_here(&command);
        let ran = bench
            .command("sh")
            .args(["-c", &format!("{{ {here}\n}} 2>&1")])
            .env("PATH", format!("{}:{path}", folder.display()))
            .output()
            .expect("a shell");
        let now = as_there(&String::from_utf8(ran.stdout).expect("UTF-8"));
        assert!(ran.status.success(), "{here}:\n{now}");
        assert!(
            is_shown(&output, &now),
            "$ {command}\n{now}\nis shown as\n{output}"
        );
        after(&command);
    }
}

fn bench() -> Bench {
    let bench = Bench::new();
    bench.copy("commissioning.toml", "bench.toml");
    bench
}

/// From a clone to a first move. The installation is left out: cargo has built the program.
#[test]
fn readme_leads_to_a_first_move_in_at_most_seven_commands() {
    let bench = Bench::new();
    let as_here = |command: &str| match command.strip_prefix("cargo install ") {
        Some(options) => {
            assert_eq!(options, "--locked --path cli");
            assert!(root().join("cli/Cargo.toml").is_file());
            "true".to_owned()
        }
        None if command.starts_with("ecaxis run") => format!("{command} --virtual"),
        None => command.replace("--lines", "--lines --virtual"),
    };
    assert!(shown("README.md").len() <= 7);
    follow("README.md", &bench, as_here, str::to_owned, |_| {});
}

#[test]
fn first_steps_on_the_simulated_bus() {
    let bench = bench();
    let as_here = |command: &str| {
        let command = command.replace(&format!("scan {NIC}"), "scan --sim bench.toml");
        if command.starts_with("ecaxis compare") {
            return format!("{command} --sim bench.toml");
        }
        if command.starts_with("ecaxis run") {
            return format!("{command} --virtual");
        }
        command
    };
    let as_there = |text: &str| {
        let named = text.replace("`sim`", &format!("`{NIC}`"));
        // The root of a tree.
        match named.strip_prefix("sim\n") {
            Some(rest) => format!("{NIC}\n{rest}"),
            None => named,
        }
    };
    follow("docs/first-steps.md", &bench, as_here, as_there, |_| {});
}

/// Runs the simulated bus of a machine file in another process.
fn serve(bench: &Bench, pair: &VethPair, file: &str) -> ProgramOutput {
    let mut command = bench.command(ecaxis());
    command.args(["sim", file, "--nic", &pair.a]);
    let mut served = ProgramOutput::start(command.stdout(Stdio::null()));
    served.says("answer");
    served
}

/// Brings a device whose controller accepts every state to SafeOp, as another MainDevice would
/// leave it.
fn led_to_safe_op(pair: &VethPair, position: u16) {
    let (mut link, _) = link::open(&pair.b, SocketKind::default()).expect("the interface");
    let stop = CancelToken::default();
    let led = run_on_link(
        link.as_mut(),
        Clock::Real,
        &stop,
        async |wire: DatagramClient| {
            for state in [2, 4] {
                let took = wire.write_at(position, 0x0120, &[state, 0]).await;
                assert_eq!(took.expect("an answer"), 1);
                wire.delay(Duration::from_millis(100)).await;
            }
        },
    );
    led.expect("carried");
}

/// A machine on the same interface continues undisturbed.
#[test]
fn scan_leaves_a_running_machine_alone() {
    over_a_pair(|pair| {
        let bench = bench();
        bench.write("machine.toml", &tolerant(&bench.read("bench.toml")));
        let _served = serve(&bench, &pair, "bench.toml");
        let mut command = bench.command(ecaxis());
        command.args(["run", "machine.toml", "--nic", &pair.b]);
        command.args(["--no-enable", "--for", "8s", "--json"]);
        let mut run = ProgramOutput::start(command.stdout(Stdio::piped()));
        run.says("all SubDevices in Op");
        // A second program cannot take over the bus.
        for second in [
            &["run", "machine.toml", "--nic", &pair.b, "--for", "1s"][..],
            &[
                "firmware",
                "update",
                "machine.toml",
                "--nic",
                &pair.b,
                "--position",
                "5",
                "--yes",
            ],
        ] {
            let ran = bench.ecaxis(second);
            assert_eq!(ran.code, 1, "{second:?}: {}", ran.err);
            let (pid, nic) = (run.id(), &pair.b);
            let taken = format!("error: another ecaxis (pid {pid}) drives `{nic}`");
            assert!(ran.err.contains(&taken), "{second:?}: {}", ran.err);
            assert!(ran.err.contains("Ctrl-C there"), "{second:?}: {}", ran.err);
        }
        let ran = bench.ecaxis(&["scan", &pair.b, "--ask", "--json"]);
        let seen: serde_json::Value = serde_json::from_str(&ran.out).expect("JSON");
        let warned = ran.err.contains("another master is driving this bus");
        assert!(warned, "{}", ran.err);
        assert_eq!(seen["other_master"], true, "{seen:#}");
        assert_eq!(seen["asked"], false);
        assert_eq!(seen["devices"][5]["state"], "Op", "{seen:#}");
        assert_eq!(seen["devices"][5]["serial"], 1005);
        let ended = run.end();
        let ended: serde_json::Value = serde_json::from_slice(&ended.stdout).expect("JSON");
        assert_eq!(ended["ok"], true, "{ended:#}");
        assert_eq!(ended["summary"]["counters"]["wkc_errors"], 0, "{ended:#}");
    });
}

#[test]
fn first_steps_over_a_real_interface() {
    over_a_pair(|pair| {
        let bench = bench();
        let _served = serve(&bench, &pair, "bench.toml");
        let as_here = |command: &str| command.replace(NIC, &pair.b);
        // A busy test machine is not suitable for a cycle of a millisecond: it warns, and cycles
        // are late.
        let as_there = |text: &str| {
            let lines = text.lines().filter(|line| !line.starts_with("warning: "));
            let lines = lines.filter(|line| !line.starts_with("  = help: "));
            let text: String = lines.map(|line| format!("{line}\n")).collect();
            text.replace(&pair.b, NIC)
        };
        let after = |command: &str| {
            if command.contains("--write") {
                bench.write("machine.toml", &tolerant(&bench.read("machine.toml")));
            }
        };
        follow("docs/first-steps.md", &bench, as_here, as_there, after);
    });
}

/// Both would answer each frame.
#[test]
fn a_second_simulated_bus_on_an_interface_is_refused() {
    over_a_pair(|pair| {
        let bench = bench();
        let served = serve(&bench, &pair, "bench.toml");
        let second = bench.ecaxis(&["sim", "bench.toml", "--nic", &pair.a]);
        let first = format!("another ecaxis (pid {}) uses `{}`", served.id(), pair.a);
        second.fails(1, &[&first, "= help: end that one"]);
    });
}

/// A run leaves no traces: scans before and after it write the same file.
#[test]
fn a_run_leaves_the_bus_unchanged() {
    over_a_pair(|pair| {
        let bench = bench();
        let _served = serve(&bench, &pair, "bench.toml");
        bench.well(&["scan", &pair.b, "--write", "before.toml"]);
        bench.write("machine.toml", &tolerant(&bench.read("before.toml")));
        bench.well(&["run", "machine.toml", "--no-enable", "--for", "500ms"]);
        let ran = bench.ecaxis(&["scan", &pair.b, "--write", "after.toml"]);
        assert_eq!((ran.code, ran.err.as_str()), (0, ""));
        assert_eq!(bench.read("after.toml"), bench.read("before.toml"));
        // All parameters were compared, even though devices have reset the 0x6060 of the run.
        let ran = bench.ecaxis(&["compare", "machine.toml", "--parameters", "--json"]);
        let json: serde_json::Value = serde_json::from_str(&ran.out).expect("JSON");
        assert_eq!(json["not_compared"], serde_json::json!([]), "{json:#}");
    });
}

/// While another MainDevice drives the bus, mailbox data are unavailable. `scan --write` and
/// `compare` report them as unknown.
#[test]
fn unread_mailbox_data_are_reported_as_unknown() {
    over_a_pair(|pair| {
        let bench = bench();
        let block = "[[device]]\nname = \"block\"\nesi = \"esi/MIO2.xml\"\nposition = 9\nmodules = [\"IN8\", \"OUT8\"]\n";
        bench.write(
            "machine.toml",
            &format!("{}\n{block}", bench.read("bench.toml")),
        );
        // The terminal's controller keeps the state that another MainDevice requested.
        let _served = serve(&bench, &pair, "machine.toml");
        led_to_safe_op(&pair, 1);
        let compare = ["compare", "machine.toml", "--nic", &pair.b];
        let ran = bench.ecaxis(&compare);
        assert_eq!(ran.code, 0, "{}", ran.err);
        assert_eq!(ran.out, "as in the file, as far as it could be compared\n");
        let ran = bench.ecaxis(&[&compare[..], &["--parameters"]].concat());
        assert_eq!(ran.code, 1, "{}", ran.err);
        assert_eq!(ran.out, "as in the file, as far as it could be compared\n");
        assert!(
            ran.err
                .contains("not compared: the parameters: the devices were not asked")
                && ran.err.contains("--intrude"),
            "{}",
            ran.err
        );
        let ran = bench.ecaxis(&[&compare[..], &["--parameters", "--json"]].concat());
        let json: serde_json::Value = serde_json::from_str(&ran.out).expect("JSON");
        assert_eq!(
            (ran.code, &json["equal"]),
            (1, &serde_json::Value::Bool(false))
        );

        let ran = bench.ecaxis(&["scan", &pair.b, "--write", "guessed.toml"]);
        assert_eq!(ran.code, 0, "{}", ran.err);
        let guessed = bench.read("guessed.toml");
        assert!(guessed.contains("it was not asked"), "{guessed}");
        assert!(!guessed.contains("the drive does not say"), "{guessed}");
    });
}
