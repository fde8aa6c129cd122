//! `ecaxis jog` in a terminal, driven through tmux, and without a terminal.

use ecaxis_test_support::host::retry_if_host_stalled;
use std::path::Path;
use std::process::Command;
use std::thread::sleep;
use std::time::{Duration, Instant};

use ecaxis_test_support::program::{ecaxis, run};
use ecaxis_test_support::recordings::comes_to_rest;
use ecaxis_test_support::{skip, tolerant_demo};

/// A timeout much longer than any operation.
const TIMEOUT: Duration = Duration::from_secs(60);

#[test]
fn jog_without_a_terminal_names_the_alternative() {
    let ran = run(["jog", "configs/demo.toml", "--sim"]);
    ran.fails(2, &["not a terminal", "--lines"]);
    assert_eq!(ran.out, "");
}

/// A tmux session of 80 × 24 with its own server.
struct Tmux {
    folder: tempfile::TempDir,
}

impl Tmux {
    /// Prints the reason and returns `None` without tmux.
    fn new(arguments: &str) -> Option<Self> {
        Self::after("", arguments)
    }

    /// Same as `new`, with a shell command before.
    fn after(before: &str, arguments: &str) -> Option<Self> {
        if Command::new("tmux").arg("-V").output().is_err() {
            skip("there is no tmux");
            return None;
        }
        let folder = tempfile::tempdir().expect("a folder");
        std::fs::write(folder.path().join("m.toml"), tolerant_demo()).expect("written");
        let tmux = Self { folder };
        let script = format!(
            "{before} cd {}; stty -g > before; {} jog m.toml --sim {arguments}; echo $? > code; stty -g > after; echo all-is-done; cat",
            tmux.folder.path().display(),
            ecaxis().display(),
        );
        tmux.ask(&[
            "-f",
            "/dev/null",
            "new-session",
            "-d",
            "-x",
            "80",
            "-y",
            "24",
            "sh",
            "-c",
            &script,
        ]);
        Some(tmux)
    }

    fn ask(&self, arguments: &[&str]) -> String {
        let output = Command::new("tmux")
            .arg("-S")
            .arg(self.folder.path().join("socket"))
            .args(arguments)
            .env("TERM", "xterm")
            .env_remove("TMUX")
            .output()
            .expect("tmux runs");
        String::from_utf8_lossy(&output.stdout).into_owned()
    }

    fn screen(&self) -> String {
        self.ask(&["capture-pane", "-p"])
    }

    fn keys(&self, keys: &[&str]) {
        self.ask(&[&["send-keys"], keys].concat());
    }

    /// Waits until the screen shows the text.
    #[track_caller]
    fn shows(&self, what: impl Fn(&str) -> bool, text: &str) -> String {
        let began = Instant::now();
        loop {
            let screen = self.screen();
            if what(&screen) {
                return screen;
            }
            assert!(began.elapsed() < TIMEOUT, "never {text}:\n{screen}");
            sleep(Duration::from_millis(50));
        }
    }

    /// Sends keys, and repeats them if a stalled computer has lost them.
    #[track_caller]
    fn again(&self, keys: &[&str], what: impl Fn(&str) -> bool) {
        for _ in 0..5 {
            self.keys(keys);
            let began = Instant::now();
            while began.elapsed() < Duration::from_secs(5) {
                if what(&self.screen()) {
                    return;
                }
                sleep(Duration::from_millis(50));
            }
        }
        panic!("not by {keys:?}:\n{}", self.screen());
    }

    #[track_caller]
    fn says(&self, text: &str) -> String {
        self.shows(|screen| screen.contains(text), text)
    }

    fn file(&self, name: &str) -> String {
        let path = self.folder.path().join(name);
        std::fs::read_to_string(path).unwrap_or_default()
    }

    /// Returns the process ID of jog.
    fn pid(&self) -> String {
        let shell = self.ask(&["display-message", "-p", "#{pane_pid}"]);
        let shell = shell.trim();
        let children = Path::new("/proc").join(shell).join("task").join(shell);
        let children = std::fs::read_to_string(children.join("children")).expect("Linux");
        children.trim().to_owned()
    }

    /// Checks that jog has ended with this code, and that the terminal is restored.
    #[track_caller]
    fn left(&self, code: &str) {
        // The output before this marker contains no part of the summary.
        let screen = self.says("all-is-done");
        assert_eq!(self.file("code").trim(), code, "{screen}");
        assert!(!self.file("before").is_empty());
        assert_eq!(
            self.file("after"),
            self.file("before"),
            "the terminal is not as it was"
        );
    }
}

impl Drop for Tmux {
    fn drop(&mut self) {
        self.ask(&["kill-server"]);
    }
}

/// Returns the position that the row of an axis shows.
fn position(screen: &str, axis: &str) -> Option<f64> {
    let row = screen.lines().find(|line| {
        let mut words = line.trim_start_matches([' ', '>']).split_whitespace();
        words.next() == Some(axis) && line.contains("CSP")
    })?;
    let (_, numbers) = row.split_once("CSP")?;
    numbers.split_whitespace().next()?.parse().ok()
}

#[test]
fn a_machine_is_driven_from_a_terminal() {
    retry_if_host_stalled(|| {
        let Some(tmux) = Tmux::new("") else { return };
        tmux.says("x no power");
        tmux.keys(&["e"]);
        tmux.says("x holds");
        // A single key press moves nothing. A second press in time starts a short motion.
        tmux.again(&["Right"], |screen| screen.contains("keep holding"));
        let before = position(&tmux.screen(), "x").expect("a position");
        assert!(before.abs() < 0.01, "{before}");
        tmux.again(&["Right", "Right"], |screen| {
            let far = position(screen, "x").is_some_and(|x| x > 1.0);
            far && screen.contains("x: let go, brakes") && screen.contains("x holds")
        });
        // Typed positions: one within the range and one outside.
        tmux.keys(&["+"]);
        tmux.again(&["m", "-", "1", "2", ".", "5", "Enter"], |screen| {
            position(screen, "x") == Some(-12.5)
        });
        tmux.keys(&["m", "6", "1"]);
        tmux.says("move x to 61_ mm");
        tmux.keys(&["Enter"]);
        tmux.says("x: refused: position 61 is outside the range");
        // A step of the other axis, which is enabled first.
        tmux.keys(&["Down", "e"]);
        tmux.says("y holds");
        tmux.again(&["."], |screen| position(screen, "y") >= Some(1.0));
        // A long move, interrupted by an accidental key.
        tmux.keys(&["-", "-", "m", "5", "0", "Enter"]);
        tmux.says("y moves to 50 mm");
        tmux.keys(&["z"]);
        tmux.says("y: stopped");
        let screen = tmux.says("y holds");
        let stopped = position(&screen, "y").expect("a position");
        assert!((1.0..50.0).contains(&stopped), "{stopped}");
        tmux.keys(&["x"]);
        tmux.says("emergency stop");
        tmux.keys(&["r"]);
        tmux.says("has been reset");
        tmux.keys(&["q"]);
        tmux.left("0");
    });
}

#[test]
fn a_signal_stops_the_machine_and_restores_the_terminal() {
    retry_if_host_stalled(|| {
        for signal in ["-TERM", "-HUP"] {
            let Some(tmux) = Tmux::new("") else { return };
            tmux.says("x no power");
            tmux.keys(&["e"]);
            tmux.says("x holds");
            tmux.keys(&["m", "5", "0", "Enter"]);
            tmux.says("x moves to 50 mm");
            let kill = Command::new("kill").args([signal, &tmux.pid()]).status();
            assert!(kill.expect("kill runs").success());
            tmux.left("130");
        }
    });
}

/// Either the shell ends with its terminal and SIGHUP follows, or the shell stays and jog detects
/// the closed terminal.
#[test]
fn a_closed_terminal_stops_the_machine() {
    retry_if_host_stalled(|| {
        for before in ["", "trap : HUP;"] {
            let Some(tmux) = Tmux::after(before, "--record r.pcapng") else {
                return;
            };
            tmux.says("x no power");
            tmux.keys(&["e"]);
            tmux.says("x holds");
            tmux.keys(&["m", "5", "0", "Enter"]);
            tmux.says("x moves to 50 mm");
            let process = Path::new("/proc").join(tmux.pid());
            tmux.ask(&["kill-server"]);
            let began = Instant::now();
            while process.exists() || (!before.is_empty() && tmux.file("code").is_empty()) {
                assert!(began.elapsed() < TIMEOUT, "it goes on without a terminal");
                sleep(Duration::from_millis(50));
            }
            if !before.is_empty() {
                assert_eq!(tmux.file("code").trim(), "130");
            }
            // At most a quarter of 250 mm/s, with 400 counts/mm, plus rounding.
            comes_to_rest(&tmux.folder.path().join("r.pcapng"), 26);
        }
    });
}

#[test]
fn jog_can_be_left_before_the_bus_is_up() {
    retry_if_host_stalled(|| {
        let Some(tmux) = Tmux::new("") else { return };
        tmux.says("EMERGENCY STOP");
        tmux.keys(&["q"]);
        tmux.left("0");
    });
}

#[test]
fn an_invalid_file_leaves_the_terminal_unchanged() {
    let Some(tmux) = Tmux::new("--faults nowhere.toml") else {
        return;
    };
    tmux.left("2");
    let screen = tmux.screen();
    assert!(screen.contains("cannot read nowhere.toml"), "{screen}");
}
