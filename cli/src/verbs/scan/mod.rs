//! `ecaxis scan`: lists the devices of a bus and writes a machine file for it.

use std::path::{Path, PathBuf};

use ecaxis_master::config::{self, Machine, Nic};
use ecaxis_master::esi_library::{self, Library};
use ecaxis_tools::compare;
use ecaxis_tools::scan::{self, EsiMatch, MainDeviceEvidence, Scan, esi_match};

use crate::access::bus::{self, Bus};
use crate::args::nic::NicArg;
use crate::hints::{self, Failure};
use crate::render::{note, print_json, print_page, shown};
use crate::verbs;

mod report;
mod text;
mod write;

const EXAMPLES: &str = "\
Examples:
  ecaxis scan enp3s0                        list the devices
  ecaxis scan enp3s0 --tree                 draw the topology
  ecaxis scan enp3s0 --write machine.toml   generate a machine file
  ecaxis scan enp3s0 --write machine.toml --eni bus.xml   from an ENI file
  ecaxis scan --sim configs/demo.toml       the simulated bus of a machine file";

/// Show the devices of a bus: position, identity, state, ports, clocks, mailboxes, and matching ESI
/// files
///
/// Only reads registers and EEPROMs: a bus that another MainDevice drives is not disturbed. `--ask`
/// and `--write` use the mailboxes as well; devices in Init are in PreOp meanwhile. This is skipped
/// if another MainDevice is active.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Network interface; `IF,IF`: both ends of a ring
    #[arg(value_name = "IF")]
    nic: Option<NicArg>,
    /// Scan the simulated bus of this machine file instead
    #[arg(long, value_name = "FILE", conflicts_with = "nic")]
    sim: Option<PathBuf>,
    /// ESI file or folder to search [default: esi]
    #[arg(long, value_name = "PATH")]
    esi: Option<PathBuf>,
    /// Ask the devices over their mailboxes: modules, modes, units, limits
    #[arg(long)]
    ask: bool,
    /// Use the mailboxes even if another MainDevice is active
    #[arg(long)]
    intrude: bool,
    /// Draw the topology
    #[arg(long, conflicts_with = "json")]
    tree: bool,
    /// Write a machine file; implies `--ask`
    #[arg(long, value_name = "FILE", conflicts_with_all = ["json", "tree"])]
    write: Option<PathBuf>,
    /// With `--write`: the machine of this ENI file, if the bus is as it says
    #[arg(long, value_name = "FILE", requires = "write")]
    eni: Option<PathBuf>,
    /// Overwrite the file and the EEPROM images that it names
    #[arg(long, requires = "write")]
    force: bool,
    /// Print as JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    pub verbosity: crate::args::Verbosity,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    if let Some(path) = &args.write {
        write::refuse(path, args.force)?;
    }
    let library = library(args)?;
    let mut simulated = None;
    let bus = match (&args.sim, &args.nic) {
        (Some(file), _) => {
            let mut machine = config::load(file).map_err(|e| hints::config(file, &e))?;
            machine.bus.nic = Nic::Sim;
            let bus = Bus::of(&machine);
            simulated = Some(machine);
            bus
        }
        (None, Some(nic)) => Bus::interface(nic),
        (None, None) => {
            return Err(Failure::new(hints::WRONG, "which network interface?")
                .hint(hints::interfaces())
                .hint("`--sim FILE` scans the simulated bus of a machine file"));
        }
    };
    let (nic, second) = (bus.nic(), bus.second().map(str::to_owned));
    let expected = args.expected(&nic)?;
    let identify = simulated.as_ref().is_some_and(scan::needs_identification)
        || matches!(&expected, Some((_, machine, _)) if scan::needs_identification(machine));
    let options = scan::Options {
        ask: args.ask || args.write.is_some(),
        intrude: args.intrude,
        identify,
        heard: 0,
    };
    let scan = look(bus, options)?;
    let seen = ScanResult::new(&nic, scan, library.as_ref());
    seen.warn(args.intrude);
    if let Some(machine) = &simulated {
        let comparison = compare::compare(machine, &seen.scan);
        for line in verbs::compare::absent(machine, &comparison).lines() {
            note(line);
        }
    }
    if library.is_none() && args.write.is_none() {
        note(
            "note: no folder `esi` here: put the vendors' ESI files there, or name it with `--esi`",
        );
    }
    if let (Some(path), Some((eni, machine, text))) = (&args.write, &expected) {
        verbs::compare::require(machine, &seen.scan, eni)?;
        return write::imported(path, text, args.force);
    }
    if let Some(path) = &args.write {
        return write::machine_file(
            &seen,
            second.as_deref(),
            path,
            library.is_some(),
            args.force,
        );
    }
    if args.json {
        print_json(&report::json(&seen))
    } else if args.tree {
        shown(&text::tree(&seen))
    } else {
        print_page(&text::document(&seen))
    }
}

impl Args {
    /// Returns the ENI file, its machine, and the text of the machine file.
    fn expected(&self, nic: &Nic) -> Result<Option<(&Path, Machine, String)>, Failure> {
        let (Some(eni), Some(path)) = (&self.eni, &self.write) else {
            return Ok(None);
        };
        let nic = match nic {
            Nic::Sim => "sim",
            Nic::Interface(nic) => nic,
        };
        match verbs::eni::expected(eni, self.esi.as_deref(), path, nic)? {
            Some((machine, text)) => Ok(Some((eni, machine, text))),
            None => {
                let message = match std::fs::metadata(eni) {
                    Ok(_) => format!("{} is not an ENI file", eni.display()),
                    Err(error) => format!("cannot read {}: {error}", eni.display()),
                };
                Err(Failure::new(hints::WRONG, message)
                    .hint("name the XML file of the configuration tool"))
            }
        }
    }
}

/// Scans a bus and shows the progress.
pub(crate) fn look(bus: Bus, options: scan::Options) -> Result<Scan, Failure> {
    let nic = bus.nic();
    let done = bus.visit(async move |wire, heard| {
        let options = scan::Options { heard, ..options };
        let mut report = |step: scan::ScanStep| {
            let (what, position, of) = (step.what, step.position, step.of);
            bus::passing(&format!("{what} position {position}, {of} in all"));
        };
        scan::scan(&wire, options, &mut report).await
    });
    bus::passed();
    bus::done(done?, &nic)
}

/// A bus and the ESI descriptions of its devices.
pub(crate) struct ScanResult {
    pub nic: String,
    pub scan: Scan,
    /// One per device.
    pub described: Vec<Option<EsiMatch>>,
    unreadable: Vec<String>,
}

impl ScanResult {
    pub fn new(nic: &Nic, scan: Scan, library: Option<&Library>) -> Self {
        let (described, unreadable) = match library {
            Some(library) => esi_match::describe(&scan, library),
            None => (scan.devices.iter().map(|_| None).collect(), Vec::new()),
        };
        let unusable = library.map(Library::unusable).unwrap_or_default();
        let unusable = unusable
            .iter()
            .map(|(file, problem)| format!("{}: {problem}", file.display()));
        let unreadable = unreadable.iter().map(ToString::to_string).chain(unusable);
        Self {
            nic: match nic {
                Nic::Sim => "sim".to_owned(),
                Nic::Interface(nic) => nic.clone(),
            },
            described,
            unreadable: unreadable.collect(),
            scan,
        }
    }

    /// Iterates over the devices with their descriptions.
    pub fn devices(&self) -> impl Iterator<Item = (&scan::Device, Option<&EsiMatch>)> {
        let described = self.described.iter().map(Option::as_ref);
        self.scan.devices.iter().zip(described)
    }

    /// Prints warnings on stderr.
    pub fn warn(&self, intrude: bool) {
        /// The maximum number of ESI files that are named.
        const NAMED: usize = 5;
        for problem in self.unreadable.iter().take(NAMED) {
            bus::warn(format_args!("ESI file not read: {problem}"));
        }
        if let Some(more @ 1..) = self.unreadable.len().checked_sub(NAMED) {
            bus::warn(format_args!("{more} more ESI files were not read"));
        }
        let others = &self.scan.others;
        if !others.is_empty() {
            let there = if others.iter().any(MainDeviceEvidence::is_live) {
                "another master is driving this bus"
            } else {
                "another master has left this bus running"
            };
            bus::warn(format_args!("{there}: {}", in_short(others)));
            note(if intrude {
                "note: the devices were asked over their mailboxes all the same (--intrude)"
            } else {
                "note: states and mailboxes were left alone; `--intrude` asks the devices all the same"
            });
        }
        for (device, described) in self.devices() {
            let position = device.position();
            match &device.sii {
                Err(problem) => bus::warn(problem),
                Ok(sii) => {
                    for damage in sii.damage.iter().take(1) {
                        bus::warn(format_args!("position {position}: its EEPROM: {damage}"));
                    }
                }
            }
            if let Some(difference) = described.and_then(|d| d.mailbox_difference(device)) {
                bus::warn(format_args!("position {position}: {difference}"));
                note("  = help: `mailbox` in the machine file selects which ones a run uses");
            }
            if let Some(Err(problem)) = &device.answers {
                bus::warn(problem);
            }
            if position > 0 && device.uplink.is_none() {
                bus::warn(format_args!(
                    "position {position}: no device before it has a port for it; DL status is odd"
                ));
            }
        }
    }
}

/// Formats the first pieces of evidence.
fn in_short(signs: &[MainDeviceEvidence]) -> String {
    const SHOWN: usize = 3;
    let shown: Vec<String> = signs.iter().take(SHOWN).map(ToString::to_string).collect();
    let more = signs.len().saturating_sub(SHOWN);
    let mut text = shown.join("; ");
    if more > 0 {
        text += &format!("; and {more} more signs");
    }
    text
}

/// Returns the ESI library: `--esi`, else the folder `esi` here, next to the written file, or next
/// to the simulated machine's file.
fn library(args: &Args) -> Result<Option<Library>, Failure> {
    if let Some(path) = &args.esi {
        return open(path).map(Some);
    }
    find_library([args.write.as_deref(), args.sim.as_deref()])
}

/// Returns the folder `esi` next to one of these files or here, if there is one.
pub(crate) fn find_library(files: [Option<&Path>; 2]) -> Result<Option<Library>, Failure> {
    let near = |file: &Path| Some(file.parent()?.join("esi"));
    let places = files.into_iter().flatten().filter_map(near);
    let mut places = places.chain([PathBuf::from("esi")]);
    let place = places.find(|place| place.is_dir());
    place.map(|place| open(&place)).transpose()
}

pub(crate) fn open(path: &Path) -> Result<Library, Failure> {
    let opened = if path.is_file() {
        Library::of_file(path)
    } else {
        Library::open(path, esi_library::cache_file(path).as_deref())
    };
    opened.map_err(|error| Failure::new(hints::WRONG, error.to_string()))
}
