//! Programs with conditions, repetitions and variables, in virtual time.

use ecaxis_master::session::Progress;
use ecaxis_test_support::program::run as ecaxis;
use ecaxis_test_support::{Heard, faults, load, machine, run};

/// Returns the numbers of the steps that have run.
fn steps(heard: &Heard) -> Vec<String> {
    let each = heard.0.iter().filter_map(|progress| match progress {
        Progress::Program { step, .. } => Some(step.number.clone()),
        _ => None,
    });
    each.collect()
}

fn io(head: &str, steps: &str) -> String {
    format!(
        "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n{head}\n[[device]]\nname = \"io\"\nesi = \"esi/IO8.xml\"\nposition = 0\n{steps}"
    )
}

/// The buttons of the file start the cycle and stop it at its end.
#[test]
fn buttons_start_a_cycle_and_stop_it_at_its_end() {
    let (outcome, heard) = run(load("pick-and-place.toml"), faults(""));
    outcome.result.expect("it runs");
    let steps = steps(&heard);
    let rounds = steps.iter().filter(|step| *step == "6.1").count();
    assert_eq!(rounds, steps.iter().filter(|step| *step == "6.8").count());
    assert!(rounds >= 3, "{steps:?}");
    assert_eq!(steps.last().map(String::as_str), Some("10"));
    let summary = outcome.summary.expect("a summary");
    assert_eq!(summary.axes.first().expect("x").target_position, 0.0);
    ecaxis(["run", "configs/pick-and-place.toml", "--virtual"]).exits(0);
    let listed = ecaxis(["explain", "configs/pick-and-place.toml"])
        .exits(0)
        .out;
    for text in [
        "in   io.Input 5",
        "wait until start = 1",
        "for ever, until stop = 1",
    ] {
        assert!(listed.contains(text), "{text}: {listed}");
    }
}

/// Each branch, with conditions on inputs, variables and axes.
#[test]
fn branches_and_loops_run_as_their_conditions_say() {
    let head = "[signals]\na = \"io.Input 1\"\nout = \"io.Output 1\"\n[variables]\nn = 0\n";
    // The input copies the output, a cycle later.
    let first = "\n[[step]]\nset = { out = true }\n\n[[step]]\nwait = { a = true }\n\n[[step]]\n";
    let add = "step = [{ add = { n = 1 } }]";
    let wait = "else = [{ dwell = \"1ms\" }]";
    let rows: [(String, &[&str]); 8] = [
        (format!("if = {{ a = true }}\n{add}\n{wait}"), &["3.1"]),
        (
            format!("if = {{ a = false }}\n{add}\n{wait}"),
            &["3.else.1"],
        ),
        (
            format!("if = [{{ a = false }}, {{ n = 0, a = true }}]\n{add}"),
            &["3.1"],
        ),
        (
            format!("while = {{ n = {{ below = 2 }} }}\n{add}"),
            &["3.1", "3.1"],
        ),
        (format!("while = {{ n = {{ above = 2 }} }}\n{add}"), &[]),
        (
            format!("repeat = \"forever\"\nuntil = {{ n = 3 }}\n{add}"),
            &["3.1", "3.1", "3.1"],
        ),
        (
            format!("repeat = 2\nuntil = {{ n = 3 }}\n{add}"),
            &["3.1", "3.1"],
        ),
        (
            "let = { n = 5 }\n[[step]]\nif = { n = 5 }\nstep = [{ message = \"five\" }]".to_owned(),
            &["3", "4.1"],
        ),
    ];
    for (more, expected) in rows {
        let text = io(head, &format!("{first}{more}\n"));
        let (outcome, heard) = run(machine(&text), faults(""));
        outcome
            .result
            .unwrap_or_else(|error| panic!("{more}: {error}"));
        let expected = [&["1", "2"], expected].concat();
        assert_eq!(steps(&heard), expected, "{more}");
    }
}

/// An input that is pressed for a time, and released.
#[test]
fn a_button_is_pressed_and_released() {
    let head = "[signals]\nb = \"io.Input 3\"\n[sim]\ninputs = [{ at = \"3s\", set = { b = true }, for = \"500ms\" }]\n";
    let wait = |value: bool| format!("\n[[step]]\nwait = {{ b = {value} }}\ntimeout = \"none\"\n");
    let text = io(head, &(wait(true) + &wait(false)));
    let (outcome, _) = run(machine(&text), faults(""));
    outcome.result.expect("both come");
    let seconds = outcome.summary.expect("a summary").counters.cycles as f64 * 1e-3;
    assert!((3.0..4.0).contains(&seconds), "{seconds}");
    // The same by a fault script.
    let text = io(
        "[signals]\nb = \"io.Input 3\"\n",
        &(wait(true) + &wait(false)),
    );
    let script = "[[fault]]\nkind = \"input\"\nat = \"3s\"\nfor = \"500ms\"\ndevice = 0\nindex = 0x6000\nsub = 3\nvalue = 1\n";
    let (outcome, _) = run(machine(&text), faults(script));
    outcome.result.expect("both come");
}

#[test]
fn an_alarm_ends_the_program_with_its_text() {
    let (outcome, _) = run(
        machine(&io("", "\n[[step]]\nalarm = \"no part\"\n")),
        faults(""),
    );
    let error = outcome.result.expect_err("an alarm").to_string();
    assert!(
        error.contains("step 1") && error.contains("alarm: no part"),
        "{error}"
    );
}
