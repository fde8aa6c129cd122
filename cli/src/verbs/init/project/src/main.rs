//! Runs the controller on the machine of `machine.toml`, or of the file on the command line.

use std::error::Error;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;

use ecaxis_master::cancel::CancelToken;
use ecaxis_master::config;
use ecaxis_master::session::{self, Observer, Options, Progress, SignalReport};

use @NAME@::Pendulum;

struct Print;

impl Observer for Print {
    fn progress(&mut self, progress: &Progress) {
        eprintln!("{progress:?}");
    }
}

fn main() -> Result<ExitCode, Box<dyn Error>> {
    let file = std::env::args_os().nth(1).map(PathBuf::from);
    let mut machine = config::load(&file.unwrap_or_else(|| "machine.toml".into()))?;
    let pendulum = Pendulum::new(&mut machine)?;
    let stop = Arc::<CancelToken>::default();
    // Ctrl-C, SIGTERM and a closing terminal bring the axes to rest; a second Ctrl-C exits at once.
    session::stop_on_signals(Arc::clone(&stop), |report| match report {
        SignalReport::StopRepeated => std::process::exit(1),
        report => eprintln!("{report}"),
    })?;
    let options = Options::default();
    let outcome = session::run_with(machine, options, stop, &mut Print, Box::new(pendulum));
    outcome.result?;
    let Some(summary) = outcome.summary else {
        return Ok(ExitCode::SUCCESS);
    };
    println!("{} cycles", summary.counters.cycles);
    for axis in &summary.axes {
        println!("{}: {:.3} {}", axis.name, axis.final_position, axis.unit);
    }
    Ok(ExitCode::from(if summary.interrupted { 130 } else { 0 }))
}
