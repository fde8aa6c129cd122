//! Drives that behave as those of other vendors: what the axis must do about it, and what the drive
//! receives, read from the recording.

use ecaxis_master::session::Options;
use ecaxis_test_support::{assert_contains, faults, machine, recorded, run, run_badly};

/// What the drive receives in a cycle: Controlword, target position, target velocity.
struct Received {
    controlword: u16,
    position: i32,
    velocity: i32,
    mode: i8,
    /// The reported position.
    actual: i32,
}

struct Row {
    name: &'static str,
    mode: &'static str,
    axis: &'static str,
    sim: &'static str,
    script: &'static str,
    steps: &'static str,
    /// Text of the failure; `None`: the run succeeds.
    fails: Option<&'static str>,
    /// The Controlwords after enabling, without repetitions and without bits 4 to 8.
    words: &'static [u16],
}

const COUNTS: i32 = 2000;
const LIMITS: &str = "velocity = 50.0, acceleration = 500.0, torque = 100.0";
const TURN: &str = "[[step]]\nmove = { x = 20.0 }\n";
const HOME: &str = "homing = { method = 17, search = 5.0, zero = 1.0, acceleration = 100.0, position = 3.0, timeout = \"10s\" }\n";
const HOMES: &str = "[[step]]\nhome = [\"x\"]\n[[step]]\nmove = { x = 5.0 }\n";
const TRACK: &str = "track = { negative_limit = -6.0 }\n";

fn rows() -> Vec<Row> {
    let row = |name, sim, steps| Row {
        name,
        mode: "csp",
        axis: "",
        sim,
        script: "",
        steps,
        fails: None,
        words: &[0x000F, 0x0006, 0x0000],
    };
    let fails = |row: Row, text| Row {
        fails: Some(text),
        words: &[0x000F, 0x0002, 0x0000],
        ..row
    };
    let script = |row: Row, script| Row { script, ..row };
    let mode = |row: Row, mode| Row { mode, ..row };
    let axis = |row: Row, axis| Row { axis, ..row };
    vec![
        row("as ours", "", TURN),
        row(
            "unlisted Statuswords while enabling",
            "quirks = { unlisted_statusword = \"50ms\" }\n",
            TURN,
        ),
        row(
            "a Statusword of zero while enabling",
            "quirks = { zero_statusword = \"50ms\" }\n",
            TURN,
        ),
        row("bit 12 late", "quirks = { bit12_late = \"500ms\" }\n", TURN),
        fails(
            row(
                "bit 12 lost at rest",
                "quirks = { bit12_lost_at_rest = \"500ms\" }\n",
                "[[step]]\nmove = { x = 2.0 }\n[[step]]\ndwell = \"2s\"\n",
            ),
            "no longer follows the command value",
        ),
        axis(
            row(
                "bit 12 lost at rest, known",
                "quirks = { bit12_lost_at_rest = \"500ms\" }\n",
                "[[step]]\nmove = { x = 2.0 }\n[[step]]\ndwell = \"2s\"\n[[step]]\nmove = { x = 4.0 }\n",
            ),
            "follows_bit = false\n",
        ),
        script(
            row("one strange Statusword at speed", "", TURN),
            "[[fault]]\nkind = \"statusword\"\ndevice = 0\nvalue = 0x0056\ncount = 1\nat = \"400ms\"\n",
        ),
        script(
            row("one cycle of zero inputs at speed", "", TURN),
            "[[fault]]\nkind = \"zero-inputs\"\ndevice = 0\ncount = 3\nat = \"400ms\"\n",
        ),
        fails(
            script(
                row("zero inputs that stay", "", TURN),
                "[[fault]]\nkind = \"zero-inputs\"\ndevice = 0\nat = \"400ms\"\n",
            ),
            "Statusword 0x0000 is none of a drive with power",
        ),
        fails(
            script(
                row("the position jumps in motion", "", TURN),
                "[[fault]]\nkind = \"position-shift\"\ndevice = 0\nvalue = 6000\nat = \"400ms\"\n",
            ),
            "has jumped by",
        ),
        fails(
            row(
                "the position shifts after enabling",
                "quirks = { shift_after_enable = 1.0 }\n",
                "[[step]]\ndwell = \"1s\"\n",
            ),
            "has jumped by 1.0000",
        ),
        fails(
            axis(
                row(
                    "the position shifts after homing",
                    "track = { negative_limit = -6.0 }\nquirks = { shift_after_homing = 1.0 }\n",
                    HOMES,
                ),
                HOME,
            ),
            "has jumped by",
        ),
        fails(
            mode(
                row(
                    "velocities in another unit",
                    "quirks = { velocity_factor = 100.0 }\n",
                    "[[step]]\nvelocity = { x = 2.0 }\n[[step]]\ndwell = \"1s\"\n",
                ),
                "csv",
            ),
            "velocity",
        ),
        fails(
            mode(
                row(
                    "velocities in a slightly larger unit",
                    "quirks = { velocity_factor = 4.0 }\n",
                    "[[step]]\nvelocity = { x = 5.0 }\n[[step]]\ndwell = \"1s\"\n",
                ),
                "csv",
            ),
            "its positions (0x6064) change by",
        ),
        axis(
            row(
                "bits of an earlier homing",
                "track = { negative_limit = -6.0 }\nquirks = { homed_before = \"150ms\" }\n",
                HOMES,
            ),
            HOME,
        ),
        Row {
            fails: Some("position (0x6064) of"),
            ..axis(
                row(
                    "home offset not kept",
                    "track = { negative_limit = -6.0 }\nquirks = { home_offset_not_kept = true }\n",
                    HOMES,
                ),
                HOME,
            )
        },
        Row {
            fails: Some("position (0x6064) of"),
            ..axis(
                row(
                    "home offset with the other sign",
                    "track = { negative_limit = -6.0 }\nquirks = { home_offset_negated = true }\n",
                    HOMES,
                ),
                HOME,
            )
        },
        axis(row("homing as ours", TRACK, HOMES), HOME),
    ]
}

fn machine_of(row: &Row) -> String {
    format!(
        r#"
[bus]
nic = "sim"
cycle = "1ms"
[[device]]
name = "x"
esi = "esi/EPOS4.xml"
position = 0
mode = "{}"
pdo.rx = ["0x6040", "0x6060", "0x607A", "0x60FF", "0x6081", "0x6083", "0x6084"]
pdo.tx = ["0x6041", "0x6061", "0x6064", "0x606C"]
[device.axis]
unit = "turn"
encoder = {COUNTS}
limits = {{ {LIMITS} }}
{}[device.sim]
{}{}"#,
        row.mode, row.axis, row.sim, row.steps
    )
}

fn received(recording: &std::path::Path) -> Vec<Received> {
    ecaxis_test_support::recordings::process_images(recording)
        .into_iter()
        .filter(|(out, inputs)| out.len().min(inputs.len()) >= 11)
        .map(|(out, inputs)| Received {
            controlword: u16::from_le_bytes([out[0], out[1]]),
            mode: out[2] as i8,
            position: i32::from_le_bytes([out[3], out[4], out[5], out[6]]),
            velocity: i32::from_le_bytes([out[7], out[8], out[9], out[10]]),
            actual: i32::from_le_bytes([inputs[3], inputs[4], inputs[5], inputs[6]]),
        })
        .collect()
}

/// Removes the power only in the documented order, and steps no target beyond the limits.
#[test]
fn foreign_drives_row_by_row() {
    let mut wrong = Vec::new();
    for row in rows() {
        let folder = tempfile::tempdir().expect("a folder");
        let (options, recording) = recorded(faults(row.script), folder.path());
        let (outcome, _) = run(machine(&machine_of(&row)), options);
        match (&outcome.result, row.fails) {
            (Ok(()), None) => {}
            (Err(error), Some(text)) if error.to_string().contains(text) => {}
            (result, expected) => {
                let result = result.as_ref().map_err(ToString::to_string);
                wrong.push(format!("{}: {result:?}, expected {expected:?}", row.name));
            }
        }
        let cycles = received(&recording);
        let mut words: Vec<u16> = cycles.iter().map(|c| c.controlword & !0x01F0).collect();
        words.dedup();
        let enabled = words.iter().position(|word| *word == 0x000F);
        let after = enabled.map_or(&[][..], |at| &words[at..]);
        if after != row.words {
            wrong.push(format!("{}: words {words:x?}", row.name));
        }
        // Targets of consecutive cycles with power, in the mode that uses them.
        for pair in cycles.windows(3) {
            if !pair
                .iter()
                .all(|c| c.controlword & 0x000F == 0x000F && c.mode == pair[0].mode)
            {
                continue;
            }
            let step = |at: usize| pair[at].position.wrapping_sub(pair[at - 1].position);
            let accelerates = (step(2) - step(1)).abs();
            // 50 turns/s and 500 turns/s², and rounding.
            if pair[0].mode == 8 && (step(2).abs() > 101 || accelerates > 3) {
                wrong.push(format!("{}: step {} after {}", row.name, step(2), step(1)));
            }
            let change = pair[2].velocity.abs_diff(pair[1].velocity);
            if pair[0].mode == 9 && change > 31_000 {
                wrong.push(format!("{}: velocity steps by {change}", row.name));
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// A hold of a move in PP is the halt (bit 8). A drive that ignores it gets the quick stop after the
/// time of a stop, and not before.
#[test]
fn an_ignored_halt_in_pp_ends_in_a_quick_stop_in_time() {
    /// Counts in a cycle, at a tenth of 50 turns/s.
    const STEP: i32 = COUNTS / 200;
    let row = Row {
        name: "halt ignored in PP",
        mode: "pp",
        axis: "",
        sim: "quirks = { halt_ignored = true }\n[[device]]\nname = \"io\"\nesi = \"esi/IO8.xml\"\n\
              position = 1\n",
        script: "",
        steps: "[[step]]\nmove = { x = 500.0 }\nspeed = 0.1\n",
        fails: None,
        words: &[],
    };
    let head = "[signals]\nheld = \"io.Input 1\"\n[override]\nhold = { held = true }\n[sim]\n\
                inputs = [{ at = \"2s\", set = { held = true } }]\n";
    let folder = tempfile::tempdir().expect("a folder");
    let (options, recording) = recorded(faults(""), folder.path());
    let options = Options {
        limit: Some(8_000_000_000),
        ..options
    };
    let text = format!("{head}{}", machine_of(&row));
    let (error, _) = run_badly(machine(&text), options);
    assert_contains(&error, &["`x`", "halt"]);
    let cycles = received(&recording);
    let first = |from: usize, shows: fn(&Received) -> bool| {
        let at = cycles[from..].iter().position(shows);
        from + at.expect("it is in the recording")
    };
    let halt = first(0, |c| c.controlword & 0x010F == 0x010F);
    let quick_stop = first(halt, |c| c.controlword & 0x010F != 0x010F);
    assert_eq!(cycles[quick_stop].controlword & 0x000F, 0x0002);
    // 5 turns/s at 500 turns/s², and 1 s.
    let time = quick_stop - halt;
    assert!((1000..1050).contains(&time), "{time} cycles");
    for pair in cycles[halt..quick_stop].windows(2) {
        let step = pair[1].actual - pair[0].actual;
        assert!(
            (step - STEP).abs() <= 3,
            "the drive ignores the halt: {step} counts"
        );
    }
    let rest = quick_stop + 100;
    let [at, last] = [&cycles[rest], &cycles[cycles.len() - 1]];
    assert!(
        at.actual.abs_diff(last.actual) <= 1,
        "{} to {}",
        at.actual,
        last.actual
    );
    assert_eq!(last.controlword, 0x0000);
}
