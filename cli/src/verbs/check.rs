//! `ecaxis check`: checks a machine file and its ESI files, without a bus.

use std::path::{Path, PathBuf};

use ecaxis_master::config::{self, ConfigError, Machine, duration};
use ecaxis_master::text::pluralize;
use ecaxis_tools::document::Document;
use serde_json::json;

use crate::hints::{self, Failure};
use crate::render::{note_of, print, print_json, shown};

/// Precedes the description of the TAP interface.
pub(crate) const TAP: &str = "EoE during the run: TAP ";

const EXAMPLES: &str = "\
Examples:
  ecaxis check machine.toml
  ecaxis check machine.toml --json          for an editor or a script";

/// Check a machine file against its ESI files, without a bus
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Machine file
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let loaded = config::load(&args.file);
    let written = match &loaded {
        _ if args.json => print_json(&as_json(&args.file, &loaded)),
        Ok(machine) => print(&summary(machine)).and_then(|()| shown("no problems\n")),
        Err(_) => Ok(()),
    };
    loaded.map_err(|e| hints::config(&args.file, &e))?;
    written
}

fn as_json(path: &Path, loaded: &Result<Machine, ConfigError>) -> serde_json::Value {
    match loaded {
        Ok(machine) => json!({
            "ok": true, "error": null, "sha256": machine.sha256.to_string(), "devices": machine.devices.len(), "problems": [],
            "files": machine.files.iter().map(|file| json!({
                "file": file.path.display().to_string(),
                "sha256": file.sha256.to_string(),
                "signed_by": file.signed_by,
            })).collect::<Vec<_>>(),
        }),
        Err(e) => json!({ "ok": false, "error": in_short(path, e), "problems": problems(e) }),
    }
}

/// Returns the error in one line, without the list from [`problems`].
pub(crate) fn in_short(path: &Path, error: &ConfigError) -> String {
    match error {
        ConfigError::Problems(problems) if problems.len() == 1 => {
            format!("1 problem in {}", path.display())
        }
        ConfigError::Problems(problems) => {
            format!("{} problems in {}", problems.len(), path.display())
        }
        ConfigError::Io { .. }
        | ConfigError::NotText { .. }
        | ConfigError::Policy(_)
        | ConfigError::Signature(_) => error.to_string(),
    }
}

/// Returns the problems of a machine file as JSON.
pub(crate) fn problems(error: &ConfigError) -> serde_json::Value {
    let problems = match error {
        ConfigError::Problems(problems) => problems.as_slice(),
        ConfigError::Io { .. }
        | ConfigError::NotText { .. }
        | ConfigError::Policy(_)
        | ConfigError::Signature(_) => &[],
    };
    let each = problems.iter().map(|p| {
        json!({
            "file": p.path.display().to_string(),
            "line": p.line,
            "column": p.column,
            "width": p.width,
            "message": p.message,
            "hint": p.hint,
        })
    });
    each.collect()
}

fn summary(machine: &Machine) -> Document {
    let mut out = Document::new(format!(
        "{}: {}, cycle {}, {}",
        machine.path.display(),
        pluralize(machine.devices.len(), "device"),
        duration::show(machine.bus.cycle_ns),
        pluralize(machine.steps.len(), "step"),
    ));
    out.line(format!("sha256 {}", machine.sha256));
    // Without a policy, no signature was looked at.
    if machine.files.iter().any(|file| file.signed_by.is_some()) {
        for file in &machine.files {
            let signer = file.signed_by.as_ref();
            let signed = signer.map_or("not signed".to_owned(), |key| format!("signed by {key}"));
            out.line(format!("{}: {signed}", file.path.display()));
        }
    }
    for device in &machine.devices {
        let selection = &device.selection;
        let mode = selection.mode.map_or("I/O".to_owned(), |m| m.to_string());
        let (name, bytes) = (
            &selection.device_name,
            pluralize(selection.layout.rx_bytes(), "byte"),
        );
        let (at, back) = (&device.at, selection.layout.tx_bytes());
        out.line(format!(
            "{} at {at}: {name}, {mode}, {bytes} out, {back} in{}",
            device.name,
            if device.optional { "; optional" } else { "" }
        ));
        if let Some(eoe) = &device.eoe {
            out.item("  ", format!("EoE: {eoe}"));
        }
        for note in &selection.notes {
            let (lead, note) = note_of(note);
            out.item(format!("  {lead}"), note);
        }
        for warning in &device.esi.warnings {
            let (file, at) = (device.esi_path.display(), warning.position);
            out.item(
                "  ",
                format!("{file}:{at} {}: {}", warning.path, warning.message),
            );
        }
    }
    if let Some(tap) = &machine.tap {
        out.line(format!("{TAP}{tap}"));
    }
    out
}
