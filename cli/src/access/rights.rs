//! Gives up the rights that a running machine does not need, before the first frame.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use ecaxis_master::change_log::ChangeLog;
use ecaxis_master::config::Machine;
use ecaxis_master::sys::rights::{NeededRights, limit_process};

use crate::failure::{FAILED, Failure, WRONG};
use crate::render::note;

/// The environment variable that says whether this must succeed.
const VARIABLE: &str = "ECAXIS_RIGHTS";

/// Returns the rights that each run of a machine needs: its files, and the change log.
pub(crate) fn of_machine(machine: &Machine) -> NeededRights {
    let mut needed = NeededRights {
        one_bring_up: true,
        interface: machine.tap.is_some(),
        low_port: machine
            .mailbox_gateway
            .is_some_and(|gateway| is_low(gateway.bind)),
        ..NeededRights::default()
    };
    let files = machine.files.iter().map(|file| folder(&file.path));
    needed.read.extend(files);
    let log = ChangeLog::of_environment();
    needed
        .write
        .extend(log.iter().map(|log| folder(log.path())));
    needed
}

/// Returns `true` if only privileged programs may bind the port.
pub(crate) fn is_low(address: SocketAddr) -> bool {
    (1..1024).contains(&address.port())
}

/// Adds files that are written, with their folders, because parts or temporary files are next to
/// them.
pub(crate) fn with_outputs<'p>(
    mut needed: NeededRights,
    files: impl IntoIterator<Item = &'p PathBuf>,
) -> NeededRights {
    for file in files {
        // A link may lead to a file in another folder.
        needed.write.extend([file.clone(), folder(file)]);
    }
    needed
}

/// Gives up all other rights, if the environment does not forbid it. Call it before the first thread
/// starts.
pub(crate) fn limit(needed: &NeededRights) -> Result<(), Failure> {
    let choice = std::env::var_os(VARIABLE).unwrap_or_default();
    let strict = match choice.to_str() {
        Some("off") => return Ok(()),
        Some("" | "best-effort") => false,
        Some("strict") => true,
        _ => {
            let message = format!("{VARIABLE}={}: no such choice", choice.display());
            return Err(Failure::new(WRONG, message).hint("strict, best-effort or off"));
        }
    };
    let kept = limit_process(needed);
    if kept.is_empty() {
        return Ok(());
    }
    let reasons: Vec<_> = kept.iter().map(ToString::to_string).collect();
    let reasons = reasons.join("; ");
    if strict {
        let message = format!("not all rights could be given up: {reasons}");
        let hint = format!("use a newer kernel, or go on with {VARIABLE}=best-effort");
        return Err(Failure::new(FAILED, message).hint(hint));
    }
    note(&format!(
        "note: {reasons}; the program keeps rights that it does not need"
    ));
    Ok(())
}

fn folder(file: &Path) -> PathBuf {
    match file.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder.to_owned(),
        _ => PathBuf::from("."),
    }
}
