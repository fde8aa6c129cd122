//! `ecaxis check`: a machine file against the ESI files it names, without a bus.

use std::path::PathBuf;

use ecaxis::config::{self, ConfigError, Machine, duration};
use serde_json::json;

use super::{Failure, hints, result};

/// Check a machine file against its ESI files, without a bus
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Machine file
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// Print what was found as JSON
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let loaded = config::load(&args.file);
    if args.json {
        result(&format!("{:#}\n", as_json(&loaded)));
    }
    let machine = loaded.map_err(|e| hints::config(&args.file, &e))?;
    if !args.json {
        result(&summary(&machine));
    }
    Ok(())
}

fn as_json(loaded: &Result<Machine, ConfigError>) -> serde_json::Value {
    match loaded {
        Ok(machine) => json!({ "ok": true, "devices": machine.devices.len(), "problems": [] }),
        Err(ConfigError::Io { .. }) => json!({ "ok": false, "problems": [] }),
        Err(ConfigError::Problems(problems)) => {
            let problems = problems.iter().map(|p| {
                json!({
                    "file": p.path.display().to_string(),
                    "line": p.line,
                    "column": p.column,
                    "width": p.width,
                    "message": p.message,
                    "hint": p.hint,
                })
            });
            json!({ "ok": false, "problems": problems.collect::<Vec<_>>() })
        }
    }
}

fn summary(machine: &Machine) -> String {
    let mut text = format!(
        "{}: {} device{}, cycle {}, {} step{}\n",
        machine.path.display(),
        machine.devices.len(),
        if machine.devices.len() == 1 { "" } else { "s" },
        duration::show(machine.bus.cycle_ns),
        machine.steps.len(),
        if machine.steps.len() == 1 { "" } else { "s" },
    );
    for device in &machine.devices {
        let selection = &device.selection;
        let mode = selection.mode.map_or("I/O".to_owned(), |m| m.to_string());
        text += &format!(
            "  {} at {}: {}, {mode}, {} bytes out, {} in\n",
            device.name,
            device.at,
            selection.device_name,
            selection.layout.rx_bytes(),
            selection.layout.tx_bytes(),
        );
        for note in &selection.notes {
            text += &format!("    note: {note}\n");
        }
        for warning in &device.esi.warnings {
            text += &format!(
                "    {}:{} {}: {}\n",
                device.esi_path.display(),
                warning.position,
                warning.path,
                warning.message,
            );
        }
    }
    text + "no problems\n"
}
