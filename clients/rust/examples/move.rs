#![allow(clippy::print_stdout, reason = "an example")]

use std::time::Duration;

use ecaxis_client::{Machine, Options, Result};

fn main() -> Result<()> {
    run(&std::env::args().nth(1).unwrap_or("demo.sock".to_owned()))
}

pub fn run(socket: &str) -> Result<()> {
    let machine = Machine::attach(socket, Options::default())?;
    machine.enable("*")?;
    let moves = [
        machine.move_to("x", 20.0, 0.5)?,
        machine.move_to("y", -10.0, 0.2)?,
    ];
    for request in moves {
        machine.wait(request, Duration::from_secs(20))?;
    }
    let request = machine.move_to("x", 1000.0, 1.0)?;
    if let Err(error) = machine.wait(request, Duration::from_secs(20)) {
        println!("{error}"); // outside the range
    }
    let x = machine.axis("x")?;
    println!("{:.1}, {}", x.position, x.state);
    Ok(())
}
