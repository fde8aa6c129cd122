//! Lines of the standard input during a run: pause, continue, step, inputs of the simulated bus.

use std::io::BufRead;
use std::sync::Arc;
use std::sync::mpsc::{self, Receiver};
use std::thread;

use ecaxis_master::config::{Machine, Nic};
use ecaxis_master::supervise::ProgramControl;
use ecaxis_master::sys::rights::drop_capabilities;

use crate::hints::{self, Failure};
use crate::render::note;

/// Reads lines of the standard input in a thread, which ends with the process.
pub(crate) fn lines() -> Result<Receiver<String>, Failure> {
    let (send, receive) = mpsc::channel();
    start(move |line| send.send(line).is_ok())?;
    Ok(receive)
}

/// Controls a program by lines of the standard input.
pub(crate) fn control(machine: &Machine, control: Arc<ProgramControl>) -> Result<(), Failure> {
    let machine = machine.clone();
    start(move |line| {
        if let Err(why) = carry_out(&machine, &control, line.trim()) {
            note(&format!("`{}`: {why}", line.trim()));
        }
        true
    })
}

fn carry_out(machine: &Machine, control: &ProgramControl, line: &str) -> Result<(), String> {
    match line {
        "" => {}
        "p" | "pause" => {
            control.pause(true);
            note("paused: the step that runs ends first; `s` runs one step, `c` continues");
        }
        "c" | "continue" => control.pause(false),
        "s" | "step" => control.step(),
        line => match machine.parse_input_line(line) {
            None => {
                return Err("write `pause`, `continue`, `step`, or `press INPUT`".to_owned());
            }
            Some(_) if machine.bus.nic != Nic::Sim => {
                return Err("the bus is real: only inputs of a simulated bus are switched".into());
            }
            Some(input) => control.switch(input?),
        },
    }
    Ok(())
}

fn start(mut take: impl FnMut(String) -> bool + Send + 'static) -> Result<(), Failure> {
    let read = move || {
        drop_capabilities();
        let lines = std::io::stdin().lock().lines();
        lines.map_while(Result::ok).all(&mut take);
    };
    let started = thread::Builder::new()
        .name("console".to_owned())
        .spawn(read);
    let failed = |e| Failure::new(hints::FAILED, format!("starting a thread: {e}"));
    started.map(drop).map_err(failed)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_pause_step_and_continue() {
        let machine = crate::starter::demonstration().expect("a machine");
        let control = ProgramControl::default();
        let line = |line: &str| carry_out(&machine, &control, line);
        for (text, paused) in [("p", true), ("s", true), ("c", false), ("step", true)] {
            line(text).expect("understood");
            assert_eq!(control.is_paused(), paused, "{text}");
        }
        assert!(line("fly").unwrap_err().contains("pause"));
        assert!(line("press nothing").unwrap_err().contains("no input"));
    }
}
