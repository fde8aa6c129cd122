//! `ecaxis sdo dump`.

use std::path::PathBuf;

use ecaxis_master::acyclic::parameters::upload::collect;
use ecaxis_master::parameters::dump::Dump;
use serde_json::json;

use super::{Common, refusal};
use crate::access::bus;
use crate::access::device::{Open, address, counter};
use crate::args::files::write_new;
use crate::hints::{self, Failure};
use crate::render::{note, print_json};

const EXAMPLES: &str = "\
Examples:
  ecaxis sdo dump machine.toml x x.toml
  ecaxis sdo dump --nic enp3s0 --position 0 --esi esi x.toml";

/// Save every readable object to a file: name, type, value
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES, override_usage = "ecaxis sdo dump FILE DEVICE DUMP.toml\n       \
    ecaxis sdo dump --nic IF --position N DUMP.toml")]
pub(super) struct Args {
    /// Machine file, device, and the file to write, which must not exist yet
    #[arg(required = true, value_name = "WORD")]
    words: Vec<String>,
    #[command(flatten)]
    common: Common,
}

pub(super) fn run(args: &Args) -> Result<(), Failure> {
    let (target, rest) = args.common.take(&args.words, "a file to write")?;
    let [path] = rest else {
        return Err(Failure::new(hints::WRONG, "one file to write"));
    };
    let path = PathBuf::from(path);
    if path.exists() {
        return Err(crate::args::files::already_exists(&path));
    }
    let ask = args.common.ask;
    let (dump, refused) = target.open(
        "reading its parameters",
        async move |open: &mut Open<'_>| taken(open, ask).await,
    )?;
    write_new(&path, dump.to_toml().as_bytes())?;
    for (at, code) in &refused {
        note(&format!("{} was {}", address(*at), refusal(*code)));
    }
    if args.common.json {
        let report = json!({
            "file": path.display().to_string(), "parameters": dump.parameters.len(), "refused": refused.len(),
        });
        return print_json(&report);
    }
    note(&format!(
        "{}: {} parameters of {}",
        path.display(),
        dump.parameters.len(),
        dump.device.name
    ));
    Ok(())
}

type Refused = Vec<(ecaxis_master::mailbox::NamedObject, u32)>;

/// Reads all objects of a device.
pub(super) async fn taken(open: &mut Open<'_>, ask: bool) -> Result<(Dump, Refused), Failure> {
    let dictionary = open.dictionary(ask).await?;
    let device = open.origin().await?;
    let mut progress = counter("reading");
    let at = open.at;
    let collected = collect(open.coe, &at.wire, &at.device, &dictionary, &mut progress).await;
    bus::passed();
    let collected = at.map_error(collected)?;
    let dump = Dump {
        device,
        parameters: collected.parameters,
    };
    Ok((dump, collected.refused))
}
