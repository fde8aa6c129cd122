#![allow(clippy::print_stdout, reason = "an example")]

use std::f64::consts::TAU;

use ecaxis_client::{Machine, Options, Result, SetPoint};

fn main() -> Result<()> {
    run(
        &std::env::args().nth(1).unwrap_or("demo.sock".to_owned()),
        60.0,
    )
}

pub fn run(socket: &str, seconds: f64) -> Result<()> {
    let machine = Machine::attach(socket, Options::default())?;
    machine.enable("x")?;
    let mut cyclic = machine.cyclic()?;
    let x = cyclic.axis("x")?;
    let start = cyclic.value(cyclic.signal("x.target_position")?);
    println!("running");
    let mut cycle = 0;
    loop {
        let time = cycle as f64 * cyclic.cycle_time().as_secs_f64();
        if time >= seconds || cyclic.is_stopped(x) {
            break;
        }
        cyclic.set(
            x,
            SetPoint::Position(start + 2.0 * (1.0 - (TAU * time).cos())),
        );
        cyclic.publish();
        cycle += cyclic.wait()?;
        machine.keep()?;
    }
    println!("{:?}", cyclic.counters());
    Ok(())
}
