//! `ecaxis compare`: compares a machine file with a bus, and updates the file with `--apply`.

use std::path::{Path, PathBuf};

use ecaxis_ecat::index::DeviceIndex;
use ecaxis_master::config::{self, Machine, Nic};
use ecaxis_master::esi_library::{self, Library};
use ecaxis_master::text::pluralize;
use ecaxis_tools::compare::apply::{self, ApplyError, BusSnapshot};
use ecaxis_tools::compare::{self, Comparison, Difference};
use ecaxis_tools::scan::{self, Scan};
use serde_json::{Value, json};

use crate::access::bus::{self, Bus};
use crate::args::files::{back_up, replace};
use crate::args::nic::NicArg;
use crate::hints::{self, Failure};
use crate::render::{note, page, print_json};
use crate::verbs::eni::machine_of;
use crate::verbs::scan::{ScanResult, open};

const EXAMPLES: &str = "\
Examples:
  ecaxis compare m.toml                    the bus on the file's interface
  ecaxis compare m.toml --nic enp3s0       another interface
  ecaxis compare m.toml --sim other.toml   another file's simulated bus
  ecaxis compare m.toml --apply            update the file to match the bus
  ecaxis compare bus.xml --nic enp3s0      an ENI file of another tool";

/// Compare a machine file with the bus: devices, revisions, aliases, serial numbers, modules
///
/// Changes nothing on the bus. Devices in Init are in PreOp while their modules and parameters are
/// read. The exit code is 0 if everything matches, else 1.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Machine file, or ENI file of another tool
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// Use this network interface instead of the file's; `IF,IF`: both ends of a ring
    #[arg(long, value_name = "IF", conflicts_with = "sim")]
    nic: Option<NicArg>,
    /// Compare with the simulated bus of this machine file
    #[arg(long, value_name = "FILE")]
    sim: Option<PathBuf>,
    /// Compare the start-up SDO values as well
    #[arg(long)]
    parameters: bool,
    /// Use the mailboxes even if another MainDevice is active
    #[arg(long)]
    intrude: bool,
    /// Update the file to match the bus; comments are kept
    #[arg(long, conflicts_with = "json")]
    apply: bool,
    /// ESI file or folder for `--apply` and for an ENI file [default: the folders of the file's ESI
    /// files; esi]
    #[arg(long, value_name = "PATH")]
    esi: Option<PathBuf>,
    /// Print as JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    pub verbosity: crate::args::Verbosity,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let eni = machine_of(&args.file, args.esi.as_deref())?;
    let is_eni = eni.is_some();
    let machine = match eni {
        Some(machine) => machine,
        None => load(&args.file)?,
    };
    if args.esi.is_some() && !is_eni && !args.apply {
        let failure = Failure::new(hints::WRONG, "--esi: the file names its ESI files itself");
        return Err(failure.hint("`--esi` is for `--apply` and for ENI files"));
    }
    if is_eni && (args.apply || args.nic.is_none() && args.sim.is_none()) {
        let file = args.file.display();
        let failure = Failure::new(hints::WRONG, format!("{file} is an ENI file"));
        return Err(match args.apply {
            true => failure.hint("`ecaxis eni import` makes a machine file of it"),
            false => failure.hint("name the interface with `--nic`"),
        });
    }
    let bus = match (&args.sim, &args.nic) {
        (Some(file), _) => {
            let mut other = load(file)?;
            other.bus.nic = Nic::Sim;
            Bus::of(&other)
        }
        (None, Some(nic)) => {
            let mut other = machine.clone();
            nic.replace(&mut other.bus);
            Bus::of(&other)
        }
        (None, None) => Bus::of(&machine),
    };
    let nic = bus.nic();
    let library = args
        .apply
        .then(|| library(args, &machine))
        .transpose()?
        .flatten();
    let (scan, mut comparison) = look(bus, &machine, args)?;
    if args.parameters && !scan.asked {
        let text = "the parameters: the devices were not asked";
        comparison.unknown.push(text.to_owned());
    }
    let seen = ScanResult::new(&nic, scan, library.as_ref());
    seen.warn(args.intrude);
    if seen.scan.devices.iter().any(|device| device.sii.is_err()) {
        let message = "an EEPROM could not be read, so the device is unknown";
        return Err(Failure::new(hints::FAILED, message)
            .hint("end the other master, or lead the devices to Init, and compare again"));
    }
    for unknown in &comparison.unknown {
        bus::warn(format_args!("not compared: {unknown}"));
    }
    // Without parameters, missing mailbox data of a driven bus does not matter.
    let complete = !args.parameters || comparison.unknown.is_empty();
    let differences: Vec<String> = comparison
        .differences
        .iter()
        .map(|difference| difference.display(&machine, &seen.scan).to_string())
        .collect();
    let absent = absent(&machine, &comparison);
    if args.json {
        print_json(&as_json(&machine, &comparison, &seen.scan, complete))?;
    } else if differences.is_empty() && comparison.unknown.is_empty() {
        page(&format!("as in the file\n{absent}"))?;
    } else if differences.is_empty() {
        page(&format!(
            "as in the file, as far as it could be compared\n{absent}"
        ))?;
    } else {
        page(&(differences.join("\n") + "\n" + &absent))?;
    }
    if differences.is_empty() {
        return if complete {
            Ok(())
        } else {
            Err(incomplete(&args.file, seen.scan.asked))
        };
    }
    if args.apply {
        return rewrite(args, &machine, &seen, &comparison);
    }
    Err(differs(&args.file, differences.len(), is_eni))
}

/// Returns a line for each optional device that is absent.
pub(crate) fn absent(machine: &Machine, comparison: &Comparison) -> String {
    let devices = comparison
        .absent
        .iter()
        .map(|index| &machine.devices[*index]);
    let lines = devices.map(|device| {
        format!(
            "`{}` ({}) is absent; it is optional\n",
            device.name, device.at
        )
    });
    lines.collect()
}

fn load(file: &Path) -> Result<Machine, Failure> {
    config::load(file).map_err(|e| hints::config(file, &e))
}

/// Fails with all differences if the bus is not as an ENI file says.
pub(crate) fn require(machine: &Machine, scan: &Scan, eni: &Path) -> Result<(), Failure> {
    let comparison = compare::compare(machine, scan);
    if comparison.differences.is_empty() {
        return Ok(());
    }
    for difference in &comparison.differences {
        note(&difference.display(machine, scan).to_string());
    }
    Err(differs(eni, comparison.differences.len(), true))
}

fn differs(file: &Path, count: usize, is_eni: bool) -> Failure {
    let (file, count) = (file.display(), pluralize(count, "difference"));
    let message = format!("the bus is not as in {file}: {count}");
    let failure = Failure::new(hints::FAILED, message);
    if is_eni {
        return failure.hint("correct the bus, or export the file again");
    }
    failure.hint(
        "correct the bus, or `--apply` makes the file as the bus is; what revisions may stand for others, `identity` says",
    )
}

fn incomplete(file: &Path, asked: bool) -> Failure {
    let message = format!(
        "not all parameters could be compared with {}",
        file.display()
    );
    Failure::new(hints::FAILED, message).hint(if asked {
        "once the devices named above answer, compare again"
    } else {
        "end the other master and compare again; `--intrude` asks the devices all the same"
    })
}

fn look(bus: Bus, machine: &Machine, args: &Args) -> Result<(Scan, Comparison), Failure> {
    let nic = bus.nic();
    let machine = machine.clone();
    let (parameters, intrude) = (args.parameters, args.intrude);
    let done = bus.visit(async move |wire, heard| {
        let options = scan::Options {
            ask: true,
            intrude,
            identify: scan::needs_identification(&machine),
            heard,
        };
        let mut report = |step: scan::ScanStep| {
            let (what, position, of) = (step.what, step.position, step.of);
            bus::passing(&format!("{what} position {position}, {of} in all"));
        };
        let scan = scan::scan(&wire, options, &mut report).await?;
        let mut comparison = compare::compare(&machine, &scan);
        if parameters && scan.asked {
            compare::parameters(&wire, &machine, &scan, &mut comparison).await;
        }
        Ok((scan, comparison))
    });
    bus::passed();
    bus::done(done?, &nic)
}

/// Returns the ESI library: `--esi`, else the folders of the file's own ESI files. `None` if the file
/// names none.
fn library(args: &Args, machine: &Machine) -> Result<Option<Library>, Failure> {
    if let Some(path) = &args.esi {
        return open(path).map(Some);
    }
    let mut library: Option<Library> = None;
    let mut folders: Vec<&Path> = Vec::new();
    for device in machine.devices.iter().filter(|device| device.has_esi()) {
        let folder = device.esi_path.parent().unwrap_or(Path::new(""));
        if folders.contains(&folder) {
            continue;
        }
        folders.push(folder);
        let here = if folder.as_os_str().is_empty() {
            Path::new(".")
        } else {
            folder
        };
        let next = Library::open(here, esi_library::cache_file(here).as_deref())
            .map_err(|error| Failure::new(hints::WRONG, error.to_string()))?;
        // Use the folder that describes most devices; several folders are rare.
        if library
            .as_ref()
            .is_none_or(|known| known.entries().len() < next.entries().len())
        {
            library = Some(next);
        }
    }
    Ok(library)
}

fn rewrite(
    args: &Args,
    machine: &Machine,
    seen: &ScanResult,
    comparison: &Comparison,
) -> Result<(), Failure> {
    let file = &args.file;
    /// The maximum size of a machine file in bytes.
    const MAX_BYTES: u64 = 16 << 20;
    let only_parameters = |d: &Difference| matches!(d, Difference::Parameter { .. });
    if comparison.differences.iter().all(only_parameters) {
        return Err(Failure::new(
            hints::FAILED,
            "only parameters differ, which `--apply` leaves alone",
        )
        .hint("start-up writes them at every run; `sdo` in the file says what it writes"));
    }
    let text = ecaxis_master::file::read_text(file, MAX_BYTES)
        .map_err(|e| Failure::new(hints::WRONG, format!("cannot read {}: {e}", file.display())))?;
    let actual = BusSnapshot {
        scan: &seen.scan,
        described: &seen.described,
        comparison,
    };
    let applied = apply::apply(file, &text, machine, actual).map_err(|e| refused(file, &e))?;
    let kept = back_up(file)?;
    replace(file, applied.text.as_bytes())?;
    for reported in &applied.reported {
        note(&format!("  {reported}"));
    }
    note(&format!("the old text is in {}", kept.display()));
    let shown = file.display();
    note(&format!(
        "{shown} matches the bus now; run `ecaxis check {shown}`"
    ));
    let mark = scan::write::MARK;
    let marked = applied.text.lines().filter(|line| line.contains(mark));
    match marked.count() {
        0 => {}
        1 => note(&format!("1 line is marked \"{mark}\" and needs a check")),
        n => note(&format!("{n} lines are marked \"{mark}\" and need a check")),
    }
    Ok(())
}

fn refused(file: &Path, error: &ApplyError) -> Failure {
    if let ApplyError::Wrong(wrong) = error {
        let problems = hints::config(file, wrong);
        let message = format!(
            "{} was left as it is: the rewritten file would be wrong",
            file.display()
        );
        let mut failure = Failure::new(hints::FAILED, message);
        failure.hints.push(problems.message);
        return failure;
    }
    let message = format!("{} was left as it is: {error}", file.display());
    let failure = Failure::new(hints::FAILED, message);
    match error {
        ApplyError::NotDescribed { .. } => {
            failure.hint("name a folder that has its ESI file with `--esi`")
        }
        ApplyError::NothingLeft => {
            failure.hint("this is another machine: `ecaxis scan --write` makes a file for it")
        }
        _ => failure.hint("write each device as a [[device]] table"),
    }
}

/// Formats the comparison as JSON. `complete`: all requested items were compared.
fn as_json(machine: &Machine, comparison: &Comparison, scan: &Scan, complete: bool) -> Value {
    let name = |index: DeviceIndex| machine.devices.get(index).map(|d| d.name.clone());
    let each: Vec<Value> = comparison
        .differences
        .iter()
        .map(|difference| {
            let (devices, positions) = difference.location();
            json!({
                "kind": difference.kind(),
                "devices": devices.into_iter().map(name).collect::<Vec<_>>(),
                "positions": positions,
                "text": difference.display(machine, scan).to_string(),
            })
        })
        .collect();
    json!({
        "equal": each.is_empty() && complete,
        "differences": each,
        "absent": comparison.absent.iter().map(|index| name(*index)).collect::<Vec<_>>(),
        "not_compared": comparison.unknown,
    })
}
