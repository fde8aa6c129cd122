//! `ecaxis tune`: excites an axis and proposes gains.

use std::path::PathBuf;
use std::sync::{Arc, mpsc};

use ecaxis_axis::Mode;
use ecaxis_ecat::index::AxisIndex;
use ecaxis_master::cancel::CancelToken;
use ecaxis_master::clock::Clock;
use ecaxis_master::config::{AxisSetup, Machine, duration, nearest};
use ecaxis_master::session::{Options, Outcome, run_with};
use ecaxis_tools::tune::excitation::{Bounds, Excitation, Form, Quantity};
use ecaxis_tools::tune::excite::{Exciter, Record};
use ecaxis_tools::tune::response::Spectra;

use crate::access::{rights, signals};
use crate::args::Verbosity;
use crate::args::bus::BusArgs;
use crate::args::files::{Inputs, check_output, replace};
use crate::hints::{self, Failure};
use crate::render::progress::ProgressPrinter;
use crate::render::{note, print_json, shown};

mod apply;
mod report;

const EXAMPLES: &str = "\
Examples:
  ecaxis tune m.toml x --sim --virtual            on the simulated bus
  ecaxis tune m.toml x --travel 5 --page x.html   within ±5 units, with plots
  ecaxis tune m.toml x --from 5 --to 300          from 5 to 300 Hz
  ecaxis tune m.toml x --apply                    write the drive's gains

All axes get power. The named one moves within the travel window and its
limits; the others stand. Nothing is written without --apply. docs/tune.md
describes the method.";

/// Measure the frequency response of an axis, and propose gains
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Machine file
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// Axis
    #[arg(value_name = "AXIS")]
    axis: String,
    #[command(flatten)]
    bus: BusArgs,
    /// Run in virtual time (simulated bus only)
    #[arg(long = "virtual")]
    virtual_time: bool,
    /// Greatest distance from the start, in units of the axis [default: a motor turn]
    #[arg(long, value_name = "UNITS")]
    travel: Option<f64>,
    /// Share of travel and limits that the excitation uses, above 0 and at most 1
    #[arg(long, value_name = "SHARE", default_value_t = 0.5)]
    amplitude: f64,
    /// Form of the excitation
    #[arg(long, value_name = "FORM", default_value = "multisine")]
    form: FormName,
    /// Lowest frequency in Hz
    #[arg(long, value_name = "HZ", default_value_t = 2.0)]
    from: f64,
    /// Highest frequency in Hz [default: a fifth of the cycle rate]
    #[arg(long, value_name = "HZ")]
    to: Option<f64>,
    /// Duration of one period
    #[arg(long, value_name = "DURATION", default_value = "4s", value_parser = duration::parse)]
    period: u64,
    /// Number of evaluated periods
    #[arg(long, value_name = "N", default_value_t = 4, value_parser = clap::value_parser!(u16).range(2..=100))]
    periods: u16,
    /// Least phase margin of the proposed loops, in degrees
    #[arg(long, value_name = "DEGREES", default_value_t = 50.0)]
    phase: f64,
    /// Least gain margin of the proposed loops, in dB
    #[arg(long, value_name = "DB", default_value_t = 6.0)]
    gain: f64,
    /// Highest crossover of the proposed loops, in Hz
    #[arg(long, value_name = "HZ", default_value_t = 40.0)]
    bandwidth: f64,
    /// Write plots, estimates and gains to this page
    #[arg(long, value_name = "FILE.html")]
    page: Option<PathBuf>,
    /// Write the samples of each cycle to this file
    #[arg(long, value_name = "FILE.csv")]
    samples: Option<PathBuf>,
    /// Overwrite existing files
    #[arg(long)]
    force: bool,
    /// Write the proposed gains to the drive (volatile; `ecaxis sdo store` keeps them)
    #[arg(long)]
    apply: bool,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    pub verbosity: Verbosity,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum FormName {
    /// Sines at logarithmic distances
    Multisine,
    /// Sines at equal distances, as a sweep
    Chirp,
    /// A binary sequence of torques (mode cst without `loops.cst`)
    Prbs,
}

/// The most cycles of an excitation: their samples are kept in memory.
const MAX_CYCLES: f64 = 4e6;

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let wrong = |text: String| Failure::new(hints::WRONG, text);
    for (option, value) in [
        ("--amplitude", args.amplitude),
        ("--bandwidth", args.bandwidth),
        ("--travel", args.travel.unwrap_or(1.0)),
    ] {
        if !(value.is_finite() && value > 0.0) {
            return Err(wrong(format!("{option} {value}: a number above 0")));
        }
    }
    if args.amplitude > 1.0 {
        return Err(wrong(format!("--amplitude {}: at most 1", args.amplitude)));
    }
    for (option, value, most) in [("--phase", args.phase, 80.0), ("--gain", args.gain, 20.0)] {
        if !(0.0..=most).contains(&value) {
            return Err(wrong(format!("{option} {value}: 0 to {most}")));
        }
    }
    let loaded = args.bus.load(&args.file);
    let mut machine = loaded.map_err(|error| hints::config(&args.file, &error))?;
    let needs_sim = [(args.virtual_time, "--virtual")];
    let faults = args.bus.script(&machine, &needs_sim)?;
    let inputs = Inputs::from_machine(&machine).with("the fault script", &args.bus.faults);
    for (option, path) in [("--page", &args.page), ("--samples", &args.samples)] {
        if let Some(path) = path {
            check_output(option, path, args.force, &inputs)?;
        }
    }
    let index = named(&machine, &args.axis)?;
    let setup = machine.axes[index].clone();
    let plan = plan(args, &machine, &setup)?;
    let reference = machine
        .axis(&args.axis)
        .map_err(|error| wrong(error.to_string()))?;
    let window = travel(args, &setup);
    let (send, receive) = mpsc::channel();
    let exciter = Exciter::new(
        reference,
        plan.clone(),
        usize::from(args.periods),
        (window, &setup.unit),
        send,
    );
    let files = args.page.iter().chain(&args.samples);
    let mut needed = rights::with_outputs(rights::of_machine(&machine), files);
    needed.one_bring_up = !args.apply;
    rights::limit(&needed)?;
    let clock = match args.virtual_time {
        true => Clock::Virtual,
        false => Clock::Real,
    };
    let options = Options {
        clock,
        faults,
        ..Options::default()
    };
    machine.enable = true;
    let after = args.apply.then(|| machine.clone());
    let nic = machine.bus.nic.clone();
    let stop = Arc::<CancelToken>::default();
    signals::stop_on_interrupt(&stop);
    note(&format!(
        "`{}` moves for {:.0} s within ±{window} {}",
        setup.name,
        plan.period_s() * f64::from(args.periods + 2),
        setup.unit
    ));
    let mut printer = ProgressPrinter::new(clock, &machine.bus, args.verbosity.plain());
    let outcome: Outcome = run_with(machine, options, stop, &mut printer, Box::new(exciter));
    drop(printer);
    outcome
        .result
        .map_err(|error| hints::failure(&error, &nic))?;
    if outcome
        .summary
        .as_ref()
        .is_some_and(|summary| summary.interrupted)
    {
        return Err(Failure::interrupted());
    }
    let failed = |error: ecaxis_tools::tune::TuneError| {
        Failure::new(hints::FAILED, format!("`{}`: {error}", args.axis))
    };
    let record: Record = receive
        .recv()
        .map_err(|_| Failure::new(hints::FAILED, "the excitation did not begin"))?;
    if let Some(path) = &args.samples {
        replace(path, report::samples(&plan, &record, &setup).as_bytes())?;
    }
    if let Some(error) = record.failed {
        return Err(failed(error).hint("use a smaller --amplitude, or a larger --travel"));
    }
    let spectra = Spectra::of(&plan, &record.samples).map_err(failed)?;
    let result = report::evaluate(&plan, &spectra, &setup, &args.targets()).map_err(failed)?;
    if let Some(path) = &args.page {
        replace(path, result.page(&args.file).as_bytes())?;
    }
    match args.json {
        true => print_json(&result.json())?,
        false => shown(&result.text(&args.file))?,
    }
    match after {
        Some(machine) => apply::write(machine, &setup, &result.drive_gains()),
        None => Ok(()),
    }
}

impl Args {
    fn targets(&self) -> ecaxis_tools::tune::gains::Targets {
        ecaxis_tools::tune::gains::Targets {
            phase_deg: self.phase,
            gain_db: self.gain,
            bandwidth_hz: self.bandwidth,
        }
    }
}

fn named(machine: &Machine, name: &str) -> Result<AxisIndex, Failure> {
    let found = machine.axes.enumerate().find(|(_, axis)| axis.name == name);
    found.map(|(index, _)| index).ok_or_else(|| {
        let names = || machine.axes.iter().map(|axis| axis.name.as_str());
        let message = format!("{}: no axis is called `{name}`", machine.path.display());
        Failure::new(hints::WRONG, message).hint(match nearest(name, names()) {
            Some(known) => format!("did you mean `{known}`?"),
            None => format!("there are {}", names().collect::<Vec<_>>().join(", ")),
        })
    })
}

fn travel(args: &Args, setup: &AxisSetup) -> f64 {
    args.travel.unwrap_or(setup.config.scale.units_per_turn())
}

fn plan(args: &Args, machine: &Machine, setup: &AxisSetup) -> Result<Excitation, Failure> {
    let config = &setup.config;
    let refuse = |text: String, hint: &str| {
        let message = format!("`{}`: {text}", setup.name);
        Err(Failure::new(hints::WRONG, message).hint(hint))
    };
    let quantity = match config.mode {
        _ if setup.node.is_some() => {
            return refuse(
                "an axis behind a gateway cannot be tuned: its set-points change once per SYNC"
                    .to_owned(),
                "tune the drive with the vendor's tool",
            );
        }
        Mode::Csp => Quantity::Motion,
        Mode::Csv => Quantity::Velocity,
        Mode::Cst if config.loops.cst.is_some() && args.form != FormName::Prbs => {
            Quantity::Velocity
        }
        Mode::Cst => Quantity::Torque,
        other => {
            return refuse(
                format!("mode {other} has no set-point in each cycle"),
                "start the axis in mode csp, csv or cst",
            );
        }
    };
    let form = match args.form {
        FormName::Multisine => Form::Multisine,
        FormName::Chirp => Form::Chirp,
        FormName::Prbs => Form::Prbs,
    };
    let bounds = Bounds {
        travel: travel(args, setup),
        velocity: config.limits.velocity,
        acceleration: config.limits.acceleration,
        torque: config.limits.torque,
        torque_slope: config.torque_slope,
    };
    let dt_s = machine.bus.cycle_ns as f64 * 1e-9;
    let high = args.to.unwrap_or(0.2 / dt_s);
    let period_s = args.period as f64 * 1e-9;
    let cycles = period_s / dt_s * f64::from(args.periods + 2);
    if cycles > MAX_CYCLES {
        return refuse(
            format!("the excitation would last {cycles:.0} cycles, more than {MAX_CYCLES:.0}"),
            "use a shorter --period, or fewer --periods",
        );
    }
    Excitation::plan(
        (form, quantity),
        (args.from, high),
        period_s,
        dt_s,
        &bounds,
        args.amplitude,
    )
    .map_err(|error| Failure::new(hints::WRONG, format!("`{}`: {error}", setup.name)))
}
