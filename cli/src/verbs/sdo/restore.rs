//! `ecaxis sdo restore`.

use std::path::Path;

use ecaxis_master::acyclic::parameters::restore::{Restored, restore};
use serde_json::json;

use super::{Common, as_json, load, print_differences, refusal};
use crate::access::bus;
use crate::access::device::{Open, address, counter};
use crate::hints::{self, Failure};
use crate::render::{note, print_json};

const EXAMPLES: &str = "\
Examples:
  ecaxis sdo restore machine.toml x x.toml
  ecaxis sdo restore machine.toml x old.toml --other-device";

/// Write the settings of a file to a device in a safe order and read them back
///
/// Only differing values are written. Commands are never written: Controlword, mode, targets,
/// outputs, store and load.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES, override_usage = "ecaxis sdo restore FILE DEVICE DUMP.toml\n       \
    ecaxis sdo restore --nic IF --position N DUMP.toml")]
pub(super) struct Args {
    /// Machine file, device, and a file from `sdo dump`
    #[arg(required = true, value_name = "WORD")]
    words: Vec<String>,
    /// Write even if the file is from another product or revision
    #[arg(long)]
    other_device: bool,
    #[command(flatten)]
    common: Common,
}

pub(super) fn run(args: &Args) -> Result<(), Failure> {
    let (target, rest) = args.common.take(&args.words, "a file of `sdo dump`")?;
    let [file] = rest else {
        return Err(Failure::new(hints::WRONG, "one file of `sdo dump`"));
    };
    let dump = load(Path::new(file))?;
    let (ask, other_device, shown) = (args.common.ask, args.other_device, file.clone());
    let done = target.open(
        "restoring its settings",
        async move |open: &mut Open<'_>| {
            let at = open.at;
            at.at_rest("settings are restored")?;
            let actual = open.origin().await?.identity();
            let of_file = dump.device.identity();
            if actual != of_file && !other_device {
                let message = format!("{}: is {actual}, {shown} is of {of_file}", at.device);
                return Err(Failure::new(hints::FAILED, message)
                    .hint("`--other-device` writes what it has in common with that one"));
            }
            let dictionary = open.dictionary(ask).await?;
            let mut progress = counter("writing");
            let parameters = &dump.parameters;
            let restored = restore(
                open.coe,
                &at.wire,
                &at.device,
                Some(&dictionary),
                parameters,
                &mut progress,
            );
            let restored = restored.await;
            bus::passed();
            restored.map_err(|error| at.advised(&error, hints::restore))
        },
    )?;
    report(args, file, &done)?;
    if done.complete() {
        return Ok(());
    }
    let wrong = done.missing.len() + done.refused.len() + done.differing.len();
    Err(Failure::new(
        hints::FAILED,
        format!("{wrong} settings are not those of {file}"),
    ))
}

fn report(args: &Args, file: &str, done: &Restored) -> Result<(), Failure> {
    if args.common.json {
        let report = json!({
            "written": done.written,
            "same": done.same,
            "missing": done.missing.iter().map(|at| address(*at)).collect::<Vec<_>>(),
            "refused": done.refused.iter().map(|(at, code)| json!({
                "object": address(*at), "abort": code, "why": ecaxis_master::mailbox::abort_text(*code),
            })).collect::<Vec<_>>(),
            "differing": as_json(&done.differing),
        });
        return print_json(&report);
    }
    for at in &done.missing {
        note(&format!("{at}: the device has no such setting"));
    }
    for (at, code) in &done.refused {
        note(&format!("{at}: {}", refusal(*code)));
    }
    print_differences([file, "device"], &done.differing)?;
    note(&format!(
        "{} settings written, {} had their value already",
        done.written, done.same
    ));
    if done.written > 0 {
        note("`ecaxis sdo store` store them in non-volatile memory");
    }
    Ok(())
}
