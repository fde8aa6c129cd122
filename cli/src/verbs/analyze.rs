//! `ecaxis analyze`: reports on a recording as text, JSON, or HTML with plots of the axes.

use std::path::{Path, PathBuf};

use ecaxis_master::text::pluralize;
use ecaxis_master::{config, recording};
use ecaxis_tools::analyze::{self as analysis, Context, DeviceReport, Report, called};

use crate::args::files::{Inputs, check_output, unwritable};
use crate::hints::{self, Failure};
use crate::render::{note, print_json, print_page};

const EXAMPLES: &str = "\
Examples:
  ecaxis analyze run.pcapng                        the report on one page
  ecaxis analyze run.pcapng --all                  every event and transfer
  ecaxis analyze run.pcapng --machine m.toml       with its names and units
  ecaxis analyze run.pcapng --html report.html     with pictures of each axis
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
    /// Overwrite an existing report
    #[arg(long)]
    force: bool,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    if let Some(path) = &args.html {
        let inputs = Inputs::default()
            .with("a recording to read", &args.files)
            .with("the machine file", &args.machine)
            .with("the ESI file", &args.esi);
        check_output("--html", path, args.force, &inputs)?;
    }
    let (known, expected) = known(args)?;
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
    let report = analysis::analyze(readers, args.interface, known);
    if let Some((file, names)) = &expected
        && let Some(odd) = other_machine(names, &report.devices)
    {
        note(&format!("note: {}: {odd}", file.display()));
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

/// A machine file and the names of its devices.
type Expected<'a> = (&'a Path, Vec<String>);

/// Returns a warning if the machine file does not match the recorded machine. Devices get names
/// only if position and product match.
fn other_machine(names: &[String], devices: &[DeviceReport]) -> Option<String> {
    let known = |device: &&DeviceReport| {
        let name = device.name.as_ref();
        name.is_some_and(|name| names.contains(name))
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

fn known(args: &Args) -> Result<(Context, Option<Expected<'_>>), Failure> {
    let mut known = Context::default();
    let mut expected = None;
    if let Some(file) = &args.machine {
        let machine = config::load(file).map_err(|e| hints::config(file, &e))?;
        known = known.with_machine(&machine);
        let names = machine.devices.iter().map(|device| device.name.clone());
        expected = Some((file.as_path(), names.collect()));
    }
    if let Some(path) = &args.esi {
        let library = analysis::library(path)
            .map_err(|e| Failure::new(hints::WRONG, format!("--esi: {e}")))?;
        known = known.with_library(library);
    }
    Ok((known, expected))
}
