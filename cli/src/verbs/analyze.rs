//! `ecaxis analyze`: reports on a recording as text, JSON, or HTML with plots of the axes.

use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use ecaxis_master::config::Machine;
use ecaxis_master::ros2::mcap::{McapError, McapFile};
use ecaxis_master::ros2::topics::{Source, Topics};
use ecaxis_master::text::pluralize;
use ecaxis_master::{config, recording};
use ecaxis_tools::analyze::{self as analysis, Context, DeviceReport, Report, RowSink, called};

use crate::args::files::{Inputs, check_output, unwritable};
use crate::hints::{self, Failure};
use crate::render::{note, print_json, print_page};

const EXAMPLES: &str = "\
Examples:
  ecaxis analyze run.pcapng                        the report on one page
  ecaxis analyze run.pcapng --all                  every event and transfer
  ecaxis analyze run.pcapng --machine m.toml       with its names and units
  ecaxis analyze run.pcapng --html report.html     with pictures of each axis
  ecaxis analyze run.pcapng --machine m.toml --mcap run.mcap
                                                   every cycle for viewers
  ecaxis analyze other.pcap --esi esi/ --json      from any MainDevice, as JSON
  ecaxis analyze night.pcapng night.0*.pcapng      parts of one recording

Reads pcap and pcapng of any MainDevice: `ecaxis run --record`, Wireshark,
tcpdump. A file that is cut or damaged is read as far as it can be.
Exit code: 0 read, 1 there is no EtherCAT in it, 2 it cannot be opened.";

/// Analyze a recording: devices, states, SDO transfers, cycle, clocks, axes
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Recording (pcap or pcapng), or all its parts
    #[arg(value_name = "FILE", required = true)]
    files: Vec<PathBuf>,
    /// Take names, process data and units from this machine file
    #[arg(long, value_name = "FILE")]
    machine: Option<PathBuf>,
    /// Take names and default process data from this ESI file or folder
    #[arg(long, value_name = "PATH")]
    esi: Option<PathBuf>,
    /// Use only this interface of the recording
    #[arg(long, value_name = "N")]
    interface: Option<u32>,
    /// Print every event, transfer and SyncManager
    #[arg(long)]
    all: bool,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
    /// Write an HTML report with plots of the axes to this file
    #[arg(long, value_name = "FILE")]
    html: Option<PathBuf>,
    /// Write the values of every cycle to this MCAP file, for Foxglove or PlotJuggler
    #[arg(long, value_name = "FILE.mcap", requires = "machine")]
    mcap: Option<PathBuf>,
    /// Overwrite existing output files
    #[arg(long)]
    force: bool,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let inputs = || {
        Inputs::default()
            .with("a recording to read", &args.files)
            .with("the machine file", &args.machine)
            .with("the ESI file", &args.esi)
    };
    if let Some(path) = &args.html {
        check_output("--html", path, args.force, &inputs())?;
    }
    if let Some(path) = &args.mcap {
        let inputs = inputs().with("the file of --html", &args.html);
        check_output("--mcap", path, args.force, &inputs)?;
    }
    let machine = machine(args)?;
    let known = known(args, machine.as_ref())?;
    let mut parts = Vec::new();
    for path in &args.files {
        let mut reader = recording::open(path).map_err(|e| {
            let message = format!("cannot open {}: {e}", path.display());
            Failure::new(hints::WRONG, message)
        })?;
        let begins = reader.peek().and_then(|packet| packet.at);
        parts.push((path, reader, begins));
    }
    // Sort by time, because the shell may have sorted by name.
    parts.sort_by_cached_key(|(_, _, begins)| *begins);
    let shown = parts.first().map_or(Path::new(""), |(path, ..)| path);
    let name = shown
        .file_name()
        .unwrap_or_default()
        .to_string_lossy()
        .into_owned();
    let readers = parts.into_iter().map(|(_, reader, _)| reader).collect();
    let mut output = mcap_output(args, machine.as_ref())?;
    let mut take = |row: &[u64], missed| {
        if let Some(output) = &mut output {
            output.take(row, missed);
        }
    };
    let sink = machine.as_ref().filter(|_| args.mcap.is_some());
    let sink = sink.map(|machine| RowSink {
        machine,
        take: &mut take,
    });
    let report = analysis::analyze_rows(readers, args.interface, known, sink);
    if let Some(machine) = &machine
        && let Some(odd) = other_machine(machine, &report.devices)
    {
        note(&format!("note: {}: {odd}", machine.path.display()));
    }
    if let Some(output) = output {
        output.finish()?;
    }
    let advice = advice(&report);
    if let Some(path) = &args.html {
        let page = analysis::document(&name, &report, &advice, true).html();
        std::fs::write(path, page).map_err(|e| unwritable(path, &e))?;
        note(&format!("written: {}", path.display()));
    }
    if args.json {
        print_json(&report)?;
    } else {
        print_page(&analysis::document(&name, &report, &advice, args.all))?;
    }
    if report.file.ethercat_frames == 0 {
        let failure = Failure::new(hints::FAILED, format!("there is no EtherCAT in {name}"));
        return Err(hints::no_ethercat(failure, args.interface.is_some()));
    }
    Ok(())
}

/// Returns the advice for each error code.
fn advice(report: &Report) -> Vec<String> {
    let devices = report.devices.iter().enumerate();
    let of_device = |(place, device): (usize, &DeviceReport)| {
        let name = called(place, device);
        let states = device
            .al_errors
            .iter()
            .map(|code| (*code, hints::al_status(*code)));
        let emergencies = device.emergency_codes.iter();
        let emergencies = emergencies.map(|code| (*code, hints::emergency(*code)));
        let advice = states.chain(emergencies);
        let advice = advice.map(|(code, hint)| format!("{name}, {code:#06x}: {hint}"));
        advice.collect::<Vec<_>>()
    };
    devices.flat_map(of_device).collect()
}

/// The MCAP file with the values of every cycle.
struct McapOutput<'a> {
    path: &'a Path,
    rows: u64,
    /// The first error ends the file.
    file: Result<McapFile<BufWriter<File>>, McapError>,
}

impl McapOutput<'_> {
    fn take(&mut self, row: &[u64], missed: u64) {
        if let Ok(file) = &mut self.file {
            file.miss(missed);
            self.rows += 1;
            if let Err(error) = file.write_row(row) {
                self.file = Err(error);
            }
        }
    }

    fn finish(self) -> Result<(), Failure> {
        let finish = || -> Result<(), McapError> {
            let file = self.file?.finish()?.into_inner();
            file.map_err(std::io::IntoInnerError::into_error)?;
            Ok(())
        };
        finish().map_err(|error| unwritable(self.path, &std::io::Error::other(error)))?;
        let cycles = pluralize(usize::try_from(self.rows).unwrap_or(usize::MAX), "cycle");
        note(&format!("written: {}, {cycles}", self.path.display()));
        Ok(())
    }
}

/// Begins the MCAP file, if one is wanted. A recording has no diagnostics, and inputs are not
/// decoded.
fn mcap_output<'a>(
    args: &'a Args,
    machine: Option<&Machine>,
) -> Result<Option<McapOutput<'a>>, Failure> {
    let (Some(path), Some(machine)) = (&args.mcap, machine) else {
        return Ok(None);
    };
    let file = File::create(path).map_err(|error| unwritable(path, &error))?;
    let topics = Arc::new(Topics::new(machine, 0));
    let wanted = |source| !matches!(source, Source::Diagnostics | Source::Inputs);
    let file = McapFile::new(BufWriter::new(file), topics, wanted);
    Ok(Some(McapOutput {
        path,
        rows: 0,
        file,
    }))
}

/// Returns a warning if the machine file does not match the recorded machine. Devices get names
/// only if position and product match.
fn other_machine(machine: &Machine, devices: &[DeviceReport]) -> Option<String> {
    let names = machine.devices.iter().map(|device| &device.name);
    let names: Vec<_> = names.collect();
    let known = |device: &&DeviceReport| {
        let name = device.name.as_ref();
        name.is_some_and(|name| names.contains(&name))
    };
    let fitting = devices.iter().filter(known).count();
    if fitting == devices.len() && fitting == names.len() {
        return None;
    }
    Some(format!(
        "of its {}, {fitting} fit the recording, which shows {}: is it of this machine?",
        pluralize(names.len(), "device"),
        devices.len()
    ))
}

/// Returns the machine of `--machine`.
fn machine(args: &Args) -> Result<Option<Machine>, Failure> {
    let load = |file: &PathBuf| config::load(file).map_err(|e| hints::config(file, &e));
    args.machine.as_ref().map(load).transpose()
}

fn known(args: &Args, machine: Option<&Machine>) -> Result<Context, Failure> {
    let mut known = Context::default();
    if let Some(machine) = machine {
        known = known.with_machine(machine);
    }
    if let Some(path) = &args.esi {
        let library = analysis::library(path)
            .map_err(|e| Failure::new(hints::WRONG, format!("--esi: {e}")))?;
        known = known.with_library(library);
    }
    Ok(known)
}
