//! `ecaxis sdo restore`.

use std::path::Path;

use ecaxis_master::acyclic::parameters::restore::{Change, Restored, Skipped, restore};
use ecaxis_master::parameters::class::{Class, CopyRule};
use ecaxis_tools::cells;
use ecaxis_tools::document::Table;
use ecaxis_tools::document::format::or_dash;
use serde_json::{Value, json};

use super::{Common, as_json, load, print_differences, refusal};
use crate::access::bus;
use crate::access::device::{Open, address, counter};
use crate::hints::{self, Failure};
use crate::render::{note, print_json, print_table};

const EXAMPLES: &str = "\
Examples:
  ecaxis sdo restore machine.toml x x.toml
  ecaxis sdo restore machine.toml x x.toml --class machine,tuned
  ecaxis sdo restore machine.toml x old.toml --other-device";

/// Write the settings of a file to a device in a safe order and read them back
///
/// Only differing values are written, and each is named. Data of a unit, such as sensor offsets, is
/// written only to the unit of the file: the one with its serial number. Identity, commands and
/// logs are never written.
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
    /// Write these classes only: machine, tuned, unit
    #[arg(long = "class", value_name = "CLASS", value_delimiter = ',', value_parser = class)]
    classes: Vec<Class>,
    #[command(flatten)]
    common: Common,
}

fn class(text: &str) -> Result<Class, String> {
    let written = [Class::Machine, Class::Tuned, Class::Unit];
    let class = written.into_iter().find(|class| class.name() == text);
    class.ok_or_else(|| "the classes that are written are machine, tuned and unit".to_owned())
}

pub(super) fn run(args: &Args) -> Result<(), Failure> {
    let (target, rest) = args.common.take(&args.words, "a file of `sdo dump`")?;
    let [file] = rest else {
        return Err(Failure::new(hints::WRONG, "one file of `sdo dump`"));
    };
    let dump = load(Path::new(file))?;
    let (ask, other_device, shown) = (args.common.ask, args.other_device, file.clone());
    let classes = args.classes.clone();
    let done = target.open(
        "restoring its settings",
        async move |open: &mut Open<'_>| {
            let at = open.at;
            at.at_rest("settings are restored")?;
            let origin = open.origin().await?;
            let (actual, of_file) = (origin.identity(), dump.device.identity());
            if actual != of_file && !other_device {
                let message = format!("{}: is {actual}, {shown} is of {of_file}", at.device);
                return Err(Failure::new(hints::FAILED, message)
                    .hint("`--other-device` writes what it has in common with that one"));
            }
            let mut rule = CopyRule::between(&dump.device, &origin);
            if classes.contains(&Class::Unit) && !rule.allows(Class::Unit) {
                let (of_file, found) = (dump.device.serial, origin.serial);
                let message = format!(
                    "{}: {shown} is of the serial number {of_file}, the device has {found}",
                    at.device
                );
                return Err(Failure::new(hints::WRONG, message).hint(
                    "data of a unit is written only to the same unit; measure it again in this one",
                ));
            }
            if !classes.is_empty() {
                rule = rule.only(&classes);
            }
            let dictionary = open.dictionary(ask).await?;
            let mut progress = counter("writing");
            let values = (dump.parameters.as_slice(), rule);
            let restored = restore(
                open.coe,
                &at.wire,
                &at.device,
                Some(&dictionary),
                values,
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
            "written": done.written.len(),
            "same": done.same,
            "writes": done.written.iter().map(change).collect::<Vec<_>>(),
            "skipped": done.skipped.iter().map(skip).collect::<Vec<_>>(),
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
    print_changes(&done.written)?;
    for line in done.lines_of_skipped() {
        note(&line);
    }
    note(&format!(
        "{} settings written, {} had their value already",
        done.written.len(),
        done.same
    ));
    if !done.written.is_empty() {
        note("`ecaxis sdo store` store them in non-volatile memory");
    }
    Ok(())
}

fn print_changes(written: &[Change]) -> Result<(), Failure> {
    if written.is_empty() {
        return Ok(());
    }
    let mut table = Table::new("object|before|written|class|name");
    for change in written {
        let before = or_dash(change.before.as_ref());
        table.row(cells![
            address(change.at),
            before,
            change.after,
            change.class,
            change.name
        ]);
    }
    print_table(&table)
}

fn change(change: &Change) -> Value {
    json!({
        "object": address(change.at), "name": change.name, "class": change.class.name(),
        "before": change.before, "after": change.after,
    })
}

fn skip(skipped: &Skipped) -> Value {
    json!({
        "object": address(skipped.at), "name": skipped.name, "class": skipped.class.name(),
        "what": skipped.what, "file": skipped.value, "device": skipped.kept,
    })
}
