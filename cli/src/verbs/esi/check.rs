//! `ecaxis esi check`: lists all problems in an ESI file.

use std::path::{Path, PathBuf};

use ecaxis_esi::{Finding, Severity, lint};
use ecaxis_master::text::pluralize;
use serde_json::json;

use crate::hints::{self, Failure};
use crate::render::{note, page, print_json};

const EXAMPLES: &str = "\
Examples:
  ecaxis esi check f.xml
  ecaxis esi check f.xml --json             for an editor or a script";

/// List all problems in an ESI file with line, element path and severity
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// ESI file
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let file = super::load(&args.file, &|_| true)?;
    let findings = lint(&file);
    let count = |severity| findings.iter().filter(|f| f.severity == severity).count();
    let errors = count(Severity::Error);
    if args.json {
        let findings: Vec<_> = findings.iter().map(as_json).collect();
        print_json(&json!({ "ok": errors == 0, "findings": findings }))?;
    } else {
        let lines = findings.iter().map(|f| {
            let file = place(&args.file, f.file.as_deref());
            let (file, at, severity) = (file.display(), f.position, f.severity);
            format!("{file}:{at}: {severity}: {}: {}\n", f.path, f.message)
        });
        page(&lines.collect::<String>())?;
    }
    let devices = pluralize(file.devices.len(), "device");
    let mut warnings = pluralize(count(Severity::Warning), "warning");
    match count(Severity::Note) {
        0 => {}
        notes => warnings = format!("{warnings}, {}", pluralize(notes, "note")),
    }
    if errors > 0 {
        let errors = pluralize(errors, "error");
        let message = format!("{}: {devices}, {errors}, {warnings}", args.file.display());
        return Err(Failure::new(hints::WRONG, message));
    }
    note(&format!(
        "{}: {devices}, no error, {warnings}",
        args.file.display()
    ));
    Ok(())
}

/// Returns the path of a referenced file, which lies next to the file.
fn place(file: &Path, other: Option<&str>) -> PathBuf {
    other.map_or_else(|| file.to_owned(), |other| file.with_file_name(other))
}

fn as_json(finding: &Finding) -> serde_json::Value {
    json!({
        "severity": finding.severity.to_string(),
        "file": finding.file,
        "line": finding.position.line,
        "column": finding.position.column,
        "path": finding.path,
        "message": finding.message,
    })
}
