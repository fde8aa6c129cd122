//! Programs with conditions, repetitions and variables, in virtual time.

use ecaxis_master::session::Progress;
use ecaxis_test_support::program::run as ecaxis;
use ecaxis_test_support::{Heard, axes, faults, load, machine, run};

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
    let rounds = steps.iter().filter(|step| *step == "6.1.1").count();
    assert_eq!(rounds, steps.iter().filter(|step| *step == "6.3").count());
    assert!(rounds >= 2, "{steps:?}");
    assert_eq!(steps.last().map(String::as_str), Some("9"));
    let summary = outcome.summary.expect("a summary");
    assert_eq!(summary.axes.first().expect("x").target_position, 0.0);
    // The winder turns without load: its speed stays at the limit.
    let speeds = heard.0.iter().filter_map(|progress| match progress {
        Progress::Status(status) => status.axes.iter().find(|axis| axis.name == "winder"),
        _ => None,
    });
    let speeds: Vec<f64> = speeds.map(|axis| axis.velocity).collect();
    let fastest = speeds.iter().fold(0.0, |a: f64, b| a.max(*b));
    assert!((19.5..20.6).contains(&fastest), "{fastest}: {speeds:?}");
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

/// Two axes `a0` and `a1`, an I/O device, and steps.
fn two_axes(head: &str, steps: &str) -> String {
    let axes = axes(2);
    let axes = axes.split("\n[[step]]").next().expect("its devices");
    let io = "[[device]]\nname = \"io\"\nesi = \"esi/IO8.xml\"\nposition = 2\n";
    format!("{head}\n{axes}\n{io}\n{steps}")
}

/// Returns the texts of the steps that have run.
fn texts(heard: &Heard) -> Vec<String> {
    let each = heard.0.iter().filter_map(|progress| match progress {
        Progress::Program { what, .. } => Some(what.clone()),
        _ => None,
    });
    each.collect()
}

/// Each call of a subprogram has its own numbers, names and variables.
#[test]
fn a_subprogram_runs_with_the_values_of_each_call() {
    let head = "[variables]\ndepth = { initial = 2.0, range = [0.0, 9.0] }\n";
    let sub = "[[sub]]\nname = \"there\"\nparameters = [\"axis\", \"place\"]\n\
               step = [{ move = { \"$axis\" = \"$place\" } }]\n";
    let call = |axis: &str, place: &str| {
        format!("[[step]]\ncall = \"there\"\nwith = {{ axis = \"{axis}\", place = {place} }}\n")
    };
    let steps = [
        sub.to_owned(),
        call("a0", "5.0"),
        call("a1", "\"depth\""),
        "[[step]]\nadd = { depth = 1.5 }\n".to_owned(),
        call("a0", "\"depth\""),
    ];
    let (outcome, heard) = run(machine(&two_axes(head, &steps.concat())), faults(""));
    outcome.result.expect("it runs");
    let heard = texts(&heard).join("\n");
    for text in ["a0 → 5 turn", "a1 → 2 turn", "a0 → 3.5 turn"] {
        assert!(heard.contains(text), "{heard}");
    }
    let axes = outcome.summary.expect("a summary").axes;
    let ends: Vec<_> = axes.iter().map(|axis| axis.target_position).collect();
    assert_eq!(ends, [3.5, 2.0]);
}

/// Branches take the time of the longest one, and wait for each other by a variable.
#[test]
fn branches_run_at_the_same_time() {
    let seconds = |program: &str| {
        let text = two_axes("[variables]\nready = 0\n", program);
        let (outcome, heard) = run(machine(&text), faults(""));
        outcome.result.expect("it runs");
        let cycles = outcome.summary.expect("a summary").counters.cycles;
        (cycles as f64 * 1e-3, steps(&heard))
    };
    let (after, _) = seconds("[[step]]\nmove = { a0 = 80.0 }\n[[step]]\nmove = { a1 = 80.0 }\n");
    let (parallel, numbers) = seconds(
        "[[step]]\nparallel = [{ step = [{ move = { a0 = 80.0 } }, { let = { ready = 1 } }] }, \
         { step = [{ move = { a1 = 80.0 } }] }]\n",
    );
    assert!(
        (1.5..2.0).contains(&(after - parallel)),
        "{after} {parallel}"
    );
    assert_eq!(numbers, ["1.a.1", "1.b.1", "1.a.2"]);
    // The second branch waits for the first one.
    let (waited, numbers) = seconds(
        "[[step]]\nparallel = [{ step = [{ move = { a0 = 80.0 } }, { let = { ready = 1 } }] }, \
         { step = [{ wait = { ready = 1 }, timeout = \"none\" }, { move = { a1 = 80.0 } }] }]\n",
    );
    assert!((after - waited).abs() < 0.1, "{after} {waited}");
    assert_eq!(numbers, ["1.a.1", "1.b.1", "1.a.2", "1.b.2"]);
}

/// A fault in one branch ends the program; the axes of the other branch stop within their limits.
#[test]
fn a_fault_in_one_branch_stops_the_axes_of_all() {
    let program = "[[step]]\nparallel = [{ step = [{ move = { a0 = 80.0 } }] }, \
                 { step = [{ move = { a1 = 80.0 } }] }]\n[[step]]\nmove = { a0 = 0.0 }\n";
    let fault = "[[fault]]\nkind = \"drive-fault\"\nat = \"1.2s\"\ndevice = 0\ncode = 0x2310\n";
    let (outcome, heard) = run(machine(&two_axes("", program)), faults(fault));
    let error = outcome.result.expect_err("a fault").to_string();
    assert!(error.contains("a0"), "{error}");
    assert_eq!(steps(&heard), ["1.a.1", "1.b.1"]);
    let axes = outcome.summary.expect("a summary").axes;
    let end = axes[1].target_position;
    assert!(end > 1.0 && end < 79.0, "a1 was on its way: {end}");
    assert_eq!(axes[1].trip, None);
}

/// An alarm in one branch ends the other one before its next step.
#[test]
fn an_alarm_in_one_branch_ends_the_others() {
    let program = "[[step]]\nparallel = [{ step = [{ dwell = \"100ms\" }, { alarm = \"empty\" }] }, \
                 { step = [{ move = { a1 = 80.0 } }, { move = { a1 = 0.0 } }] }]\n";
    let (outcome, heard) = run(machine(&two_axes("", program)), faults(""));
    let error = outcome.result.expect_err("an alarm").to_string();
    assert!(
        error.contains("step 1.a.2") && error.contains("empty"),
        "{error}"
    );
    assert_eq!(steps(&heard), ["1.a.1", "1.b.1", "1.a.2"]);
}

/// A value outside the range of its variable reaches no axis.
#[test]
fn a_variable_out_of_its_range_ends_the_program() {
    let head = "[variables]\nplace = { initial = 0.0, range = [0.0, 25.0] }\n";
    let steps = "[[step]]\nrepeat = 4\nstep = [{ move = { a0 = \"place\" } }, { add = { place = 10.0 } }]\n";
    let (outcome, heard) = run(machine(&two_axes(head, steps)), faults(""));
    let error = outcome.result.expect_err("out of range").to_string();
    for part in ["step 1.2", "`place` would be 30", "0 to 25"] {
        assert!(error.contains(part), "{error}");
    }
    let last = texts(&heard).pop().unwrap_or_default();
    assert!(last.contains("place"), "{last}");
    let axes = outcome.summary.expect("a summary").axes;
    assert_eq!(axes[0].target_position, 20.0);
}

/// No step begins while the input of `[program]` is pressed; its button lets one step begin.
#[test]
fn inputs_pause_and_step_the_program() {
    let run_with = |presses: &str| {
        let head = format!(
            "[signals]\nhold = \"io.Input 1\"\nonce = \"io.Input 2\"\n[program]\npause = {{ hold = true }}\n\
             step = {{ once = true }}\n[sim]\ninputs = [{presses}]\n"
        );
        let program =
            "[[step]]\nmove = { a0 = 1.0 }\n".repeat(3) + "[[step]]\nmove = { a0 = 0.0 }\n";
        let (outcome, heard) = run(machine(&two_axes(&head, &program)), faults(""));
        outcome.result.expect("it runs");
        let cycles = outcome.summary.expect("a summary").counters.cycles;
        (cycles as f64 * 1e-3, steps(&heard).len())
    };
    let hold = "{ at = \"0s\", set = { hold = true }, for = \"9s\" }";
    let (free, count) = run_with("");
    assert_eq!(count, 4);
    let (held, _) = run_with(hold);
    assert!(free < 8.0 && held > 8.5, "{free} {held}");
    // Presses during the pause run the steps one by one, before the end of the pause.
    let press =
        |at: u32| format!(", {{ at = \"{at}s\", set = {{ once = true }}, for = \"100ms\" }}");
    let (stepped, _) = run_with(&(hold.to_owned() + &press(4) + &press(5) + &press(6) + &press(7)));
    assert!(stepped < held - 1.0, "{stepped} {held}");
}
