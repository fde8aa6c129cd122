//! A brake on an output of another device: the cycle in which the output changes, relative to the
//! drive's Controlword. Read from the recording; virtual time.

use std::path::Path;

use ecaxis_test_support::recordings::process_images;
use ecaxis_test_support::{axes, faults, machine, recorded, run};

use super::returns::returned;

/// In cycles of 1 ms.
const RELEASE: usize = 80;
const ENGAGE: usize = 120;
/// An axis of the project's ESI has 12 bytes out and 13 bytes in, at the same place of the image.
const REGION: usize = 13;

/// Returns a machine of two axes and eight outputs. The first output opens the brake of `a0`.
fn braked() -> String {
    let text = axes(2).replacen(
        "encoder = 2000\n",
        "encoder = 2000\nbrake = { output = \"io.Output 1\", release = \"80ms\", engage = \"120ms\" }\n",
        1,
    );
    let io = "\n[[device]]\nname = \"io\"\nesi = \"esi/IO8.xml\"\nposition = 2\n";
    text.replacen("\n[[step]]", &format!("{io}\n[[step]]"), 1)
}

/// One cycle on the wire: outputs of `a0` and of the I/O device, and the answer of `a0`.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Seen {
    open: bool,
    controlword: u16,
    target: i32,
    statusword: u16,
    actual: i32,
}

impl Seen {
    fn enabled(self) -> bool {
        self.statusword & 0x6f == 0x27
    }
}

/// `at`: the place of `a0` in the image.
fn cycles(recording: &Path, at: usize) -> Vec<Seen> {
    let word = |data: &[u8]| u16::from_le_bytes([data[0], data[1]]);
    let position = |data: &[u8]| i32::from_le_bytes([data[2], data[3], data[4], data[5]]);
    let images = process_images(recording).into_iter();
    let seen = images.map(|(out, data)| Seen {
        open: out[2 * REGION] & 1 != 0,
        controlword: word(&out[at..]),
        target: position(&out[at..]),
        statusword: word(&data[at..]),
        actual: position(&data[at..]),
    });
    seen.collect()
}

/// Runs the machine. Returns the process data on the wire and whether the run succeeded.
fn recorded_cycles(script: &str) -> (Vec<Seen>, bool) {
    let folder = tempfile::tempdir().expect("a folder");
    let (options, path) = recorded(faults(script), folder.path());
    let (outcome, _) = run(machine(&braked()), options);
    (cycles(&path, 0), outcome.result.is_ok())
}

/// Checks that the brake is closed until the drive is enabled, and opens `RELEASE` cycles before
/// the first motion. Returns the cycle in which it opens.
#[track_caller]
fn opens_before_motion(seen: &[Seen]) -> usize {
    let enabled = seen.iter().position(|s| s.enabled()).expect("enabled");
    let open = seen.iter().position(|s| s.open).expect("open");
    assert!(open > enabled, "open in cycle {open}, enabled in {enabled}");
    let start = seen[open].target;
    let moves = seen.iter().position(|s| s.target.abs_diff(start) > 1);
    let moves = moves.expect("it moves");
    assert!(
        moves >= open + RELEASE,
        "open in cycle {open}, moves in {moves}"
    );
    open
}

/// Returns the cycle in which the brake finally closes, the first cycle without a power command,
/// and whether the axis stood.
#[track_caller]
fn closes(seen: &[Seen]) -> (usize, usize, bool) {
    let closed = seen.iter().rposition(|s| s.open).expect("open") + 1;
    assert!(closed < seen.len(), "the last outputs open the brake");
    let powered = |s: &Seen| s.controlword & 0x0f == 0x0f || s.controlword & 0x06 == 0x02;
    let off = seen.iter().rposition(powered).expect("powered") + 1;
    let stood = seen[closed].target == seen[closed - 1].target
        && seen[closed].actual.abs_diff(seen[closed - 1].actual) <= 1;
    (closed, off, stood)
}

#[test]
fn the_brake_opens_after_power_and_closes_before_power_off() {
    let (seen, done) = recorded_cycles("");
    assert!(done);
    let open = opens_before_motion(&seen);
    let (closed, off, stood) = closes(&seen);
    assert!(stood && closed > open);
    assert!(
        off >= closed + ENGAGE,
        "closed in cycle {closed}, no power in {off}"
    );
    // The brake stays open between these cycles.
    assert!(seen[open..closed].iter().all(|s| s.open));
    let rest = &seen[closed];
    assert!(seen[closed..off].iter().all(|s| s.target == rest.target));
}

#[test]
fn a_fault_of_its_drive_closes_the_brake_at_once() {
    let script = "[[fault]]\nkind = \"drive-fault\"\nat = \"1s\"\ndevice = 0\ncode = 0x3220\n";
    let (seen, done) = recorded_cycles(script);
    assert!(!done);
    opens_before_motion(&seen);
    let (closed, ..) = closes(&seen);
    // The state is Fault reaction active or Fault.
    let fault = seen
        .iter()
        .position(|s| s.statusword & 0x4f == 0x08 || s.statusword & 0x4f == 0x0f);
    let fault = fault.expect("a fault");
    assert!(
        closed <= fault + 2,
        "a fault in cycle {fault}, closed in {closed}"
    );
}

#[test]
fn a_fault_of_another_drive_closes_the_brake_at_standstill() {
    let script = "[[fault]]\nkind = \"drive-fault\"\nat = \"1s\"\ndevice = 1\ncode = 0x3220\n";
    let (seen, done) = recorded_cycles(script);
    assert!(!done);
    opens_before_motion(&seen);
    let (closed, off, stood) = closes(&seen);
    assert!(stood, "{:?}", &seen[closed - 2..closed + 2]);
    assert!(
        off >= closed + ENGAGE,
        "closed in cycle {closed}, no power in {off}"
    );
}

/// A held load: the drive, then the device of its brake, loses power and returns. The brake stays closed
/// until the axis is enabled by command, and the first target is the actual position.
#[test]
fn a_returned_drive_holds_its_load_before_the_brake_opens() {
    let group = "\n[[stop.group]]\nname = \"z\"\naxes = [\"a0\"]\ndevices = [\"io\"]\noutside = \"continue\"\n";
    let steps = "\n[[step]]\nenable = true\n\n[[step]]\nmove = { a1 = 80.0 }\n\n[[step]]\nmove = { a1 = -80.0 }\n\n[[step]]\nreset = [\"a0\"]\n\
                 \n[[step]]\nenable = [\"a0\"]\n\n[[step]]\nmove = { a0 = 2.0 }\n";
    // Behind `a1`, which stays.
    let text = braked().replacen("position = 1", "position = first", 1);
    let text = text.replacen("position = 0", "position = 1", 1);
    let text = text.replacen("position = first", "position = 0", 1);
    let text = text.split("\n[[step]]").next().expect("devices");
    let machine = machine(&format!("{text}{group}{steps}"));
    for device in [1, 2] {
        let script = format!(
            "[[fault]]\nkind = \"power-off\"\ndevice = {device}\nat = \"1.5s\"\nfor = \"500ms\"\n"
        );
        let folder = tempfile::tempdir().expect("a folder");
        let (options, path) = recorded(faults(&script), folder.path());
        let (outcome, heard) = run(machine.clone(), options);
        let warnings = heard.warnings();
        let result = outcome.result;
        result.unwrap_or_else(|error| panic!("{device}: {error}; {warnings:?}"));
        // The terminal behind the drive is cut off with it.
        let restarted = returned(&heard)
            .into_iter()
            .filter(|(.., restarted)| *restarted);
        assert_eq!(restarted.count(), 1, "{device}: {warnings:?}");
        // Its group is the second in the image.
        let seen = cycles(&path, REGION);
        let first = opens_before_motion(&seen);
        let closed = first + seen[first..].iter().position(|s| !s.open).expect("closed");
        let again = closed + seen[closed..].iter().position(|s| s.open).expect("open");
        // Enabled by the second command, with the actual position as the target, before it opens.
        let without = seen[closed..again].iter().rposition(|s| !s.enabled());
        let enabled = closed + without.expect("without power") + 1;
        assert!(enabled < again, "{device}: enabled {enabled}, open {again}");
        let held = &seen[enabled..again];
        let off = |s: &Seen| s.target.abs_diff(s.actual);
        assert!(held.iter().all(|s| off(s) <= 1), "{device}: {held:?}");
        opens_before_motion(&seen[closed..]);
    }
}
