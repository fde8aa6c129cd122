//! Homes two axes, waits for an input, moves a square, and recovers from a fault of a drive.
//!
//!     ecaxis serve configs/square.toml --sim --socket square.sock &
//!     cargo run -p ecaxis-client --example square square.sock

use std::time::Duration;

use ecaxis_client::{ErrorKind, Machine, Options, Result};

const TIMEOUT: Duration = Duration::from_secs(30);
const CORNERS: [(f64, f64); 4] = [(20.0, 0.0), (20.0, 20.0), (0.0, 20.0), (0.0, 0.0)];

fn main() -> Result<()> {
    let socket = std::env::args().nth(1).unwrap_or("square.sock".to_owned());
    run(&socket, 1).map(drop)
}

/// Moves squares. Returns the faults that came meanwhile.
pub fn run(socket: &str, squares: usize) -> Result<Vec<String>> {
    let options = Options {
        name: "square".to_owned(),
        ..Options::default()
    };
    let machine = Machine::attach(socket, options)?;
    machine.enable("*")?;
    let homing = [machine.home("x")?, machine.home("y")?];
    for request in homing {
        machine.wait(request, TIMEOUT)?;
    }

    machine.set_output("io", "Output 1", 1.0)?; // clamp
    while !is_clamped(&machine)? {
        machine.sleep(Duration::from_millis(20))?;
    }

    let (mut done, mut faults) = (0, Vec::new());
    while done < squares && is_clamped(&machine)? {
        match square(&machine) {
            Ok(()) => done += 1,
            // A fault of a drive stops the group of its axis.
            Err(error) if matches!(error.kind(), ErrorKind::Failed | ErrorKind::Refused) => {
                machine.stop()?;
                let found = present_faults(&machine)?;
                if found.is_empty() {
                    return Err(error);
                }
                faults.extend(found);
                machine.reset("*")?;
                machine.enable("*")?;
            }
            Err(error) => return Err(error),
        }
    }
    machine.disable("*")?;
    Ok(faults)
}

fn square(machine: &Machine) -> Result<()> {
    for (x, y) in CORNERS {
        let moves = [machine.move_to("x", x, 0.3)?, machine.move_to("y", y, 0.3)?];
        for request in moves {
            machine.wait(request, TIMEOUT)?;
        }
    }
    Ok(())
}

/// Returns true once the part is clamped: a switch at the first input.
fn is_clamped(machine: &Machine) -> Result<bool> {
    Ok(machine.input("io", "Input 1")? != 0.0)
}

fn present_faults(machine: &Machine) -> Result<Vec<String>> {
    let mut faults = Vec::new();
    for name in ["x", "y"] {
        let axis = machine.axis(name)?;
        let fault = axis.fault.or(axis.trip);
        faults.extend(fault.map(|fault| format!("{name}: {fault}")));
    }
    Ok(faults)
}
