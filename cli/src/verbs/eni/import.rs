//! `ecaxis eni import`: an ENI file as a machine file, and what ecaxis would not send.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use ecaxis_master::config::{ConfigError, Machine};
use ecaxis_master::file;
use ecaxis_master::text::pluralize;
use ecaxis_tools::cells;
use ecaxis_tools::document::{Document, Table};
use ecaxis_tools::eni::{self, EniError, Import};
use serde_json::json;

use crate::args::files::{Inputs, check_output, replace};
use crate::hints::{self, Failure};
use crate::render::{note, print, print_json, result};
use crate::verbs::scan::{find_library, open};

const EXAMPLES: &str = "\
Examples:
  ecaxis eni import bus.xml -o machine.toml --esi esi
  ecaxis eni import bus.xml                 the machine file on stdout

The machine file gets what the init commands configure. A command that ecaxis
would not send is listed with its line and its reason. Drives get no axis.";

/// Write an ENI file as a machine file
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct Args {
    /// ENI file
    #[arg(value_name = "BUS")]
    bus: PathBuf,
    /// Write the machine file here instead of stdout
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// ESI file or folder to search [default: esi]
    #[arg(long, value_name = "PATH")]
    esi: Option<PathBuf>,
    /// Overwrite the output file
    #[arg(long, requires = "output")]
    force: bool,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &Args) -> Result<(), Failure> {
    let wrong = |message: String| Failure::new(hints::WRONG, message);
    let shown = args.bus.display();
    let bytes = file::read(&args.bus, eni::MAX_BYTES).map_err(|error| {
        let failure = wrong(format!("cannot read {shown}: {error}"));
        match error.kind() {
            ErrorKind::NotFound => failure.hint("name the ENI file of the configuration tool"),
            _ => failure.hint("check the file and its permissions"),
        }
    })?;
    if let Some(output) = &args.output {
        let inputs = Inputs::default().with("the ENI file", [&args.bus]);
        check_output("--output", output, args.force, &inputs)?;
    }
    let library = match &args.esi {
        Some(path) => Some(open(path)?),
        None => find_library([args.output.as_deref(), Some(&*args.bus)])?,
    };
    let path = args.output.clone().unwrap_or(PathBuf::from("machine.toml"));
    let imported = eni::import(&bytes, library.as_ref(), &path, "sim");
    let imported = imported.map_err(|error| refused(&args.bus, &error))?;
    for error in &imported.unreadable {
        note(&format!("warning: {error}"));
    }
    if let Some(output) = &args.output {
        replace(output, imported.text.as_bytes())?;
    }
    if args.json {
        return print_json(&as_json(&imported));
    }
    if args.output.is_none() {
        result(&imported.text)?;
    }
    report(&imported, &args.bus, args.output.as_deref())
}

/// Returns the machine of an ENI file, or `None` if the file is not XML.
pub(crate) fn machine_of(path: &Path, esi: Option<&Path>) -> Result<Option<Machine>, Failure> {
    let near = path.with_file_name("machine.toml");
    let imported = expected(path, esi, &near, "sim")?;
    Ok(imported.map(|(machine, _)| machine))
}

/// Returns the machine of an ENI file as `eni::import` does, with the text of its machine file;
/// `None` if the file is not XML.
pub(crate) fn expected(
    path: &Path,
    esi: Option<&Path>,
    machine: &Path,
    nic: &str,
) -> Result<Option<(Machine, String)>, Failure> {
    let Ok(bytes) = file::read(path, eni::MAX_BYTES) else {
        return Ok(None);
    };
    let text = bytes.trim_ascii_start();
    if !text.starts_with(b"<") && !text.starts_with(b"\xef\xbb\xbf<") {
        return Ok(None);
    }
    let library = match esi {
        Some(esi) => Some(open(esi)?),
        None => find_library([Some(path), None])?,
    };
    let imported = eni::import(&bytes, library.as_ref(), machine, nic);
    let imported = imported.map_err(|error| refused(path, &error))?;
    let machine = imported.machine.map_err(|error| {
        let message = match imported.without_esi {
            0 => format!("{}: {error}", path.display()),
            count => {
                let devices = pluralize(count, "device");
                format!("{}: no ESI file describes {devices}", path.display())
            }
        };
        Failure::new(hints::WRONG, message).hint("name the folder of ESI files with `--esi`")
    })?;
    Ok(Some((*machine, imported.text)))
}

fn refused(path: &Path, error: &EniError) -> Failure {
    let message = format!("{}:{error}", path.display());
    Failure::new(hints::WRONG, message).hint(error.help)
}

fn report(imported: &Import, bus: &Path, output: Option<&Path>) -> Result<(), Failure> {
    for name in &imported.other_layouts {
        note(&format!(
            "warning: `{name}`: no choice of its ESI gives the process data of the ENI"
        ));
    }
    match &imported.machine {
        Ok(_) => {}
        Err(_) if imported.without_esi > 0 => {
            let devices = pluralize(imported.without_esi, "device");
            note(&format!(
                "warning: no ESI file describes {devices}: the file cannot be run yet"
            ));
            note("  = help: name the folder of ESI files with `--esi`");
        }
        Err(ConfigError::Problems(problems)) => {
            let problems = pluralize(problems.len(), "problem");
            note(&format!(
                "warning: the file has {problems}: `ecaxis check` shows them"
            ));
        }
        Err(error) => note(&format!("warning: {error}")),
    }
    let mut document = Document::default();
    match imported.unsent.len() {
        0 => document.line("ecaxis sends every command of the ENI".to_owned()),
        count => {
            let count = pluralize(count, "command");
            document.line(format!(
                "{count} of {} that ecaxis does not send:",
                bus.display()
            ));
            let mut table = Table::new("line|device|command|why");
            for unsent in &imported.unsent {
                let device = unsent.device.as_deref().unwrap_or("all");
                table.row(cells![
                    unsent.position.line,
                    device,
                    unsent.command,
                    unsent.reason
                ]);
            }
            document.table(table);
        }
    }
    match output {
        Some(_) => print(&document),
        None => {
            note(document.text(None).trim_end());
            Ok(())
        }
    }
}

fn as_json(imported: &Import) -> serde_json::Value {
    let problems = match &imported.machine {
        Ok(_) => 0,
        Err(ConfigError::Problems(problems)) => problems.len(),
        Err(_) => 1,
    };
    let unsent = imported.unsent.iter().map(|unsent| {
        json!({
            "line": unsent.position.line, "column": unsent.position.column,
            "device": unsent.device, "command": unsent.command, "reason": unsent.reason,
        })
    });
    json!({
        "machine": imported.text, "problems": problems, "without_esi": imported.without_esi,
        "other_layouts": imported.other_layouts, "unsent": unsent.collect::<Vec<_>>(),
    })
}
