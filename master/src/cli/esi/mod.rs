//! `ecaxis esi …`: what an ESI file says, what is wrong with it, and the EEPROM image that follows from it.

use std::path::{Path, PathBuf};

use clap::Subcommand;
use ecaxis::library::{self, LoadError};
use ecaxis_esi::{self as esi, Device, DeviceQuery, EsiFile, Mode};

use super::{Failure, hints};

mod check;
mod diff;
mod list;
mod objects;
mod show;
mod sii;

/// Look into ESI files: devices, PDOs, modes, mistakes, EEPROM images
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    #[command(subcommand)]
    verb: Verb,
}

#[derive(Debug, Subcommand)]
enum Verb {
    Show(show::Args),
    Check(check::Args),
    Objects(objects::Args),
    Sii(sii::Args),
    Diff(diff::Args),
    List(list::Args),
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    match &args.verb {
        Verb::Show(args) => show::run(args),
        Verb::Check(args) => check::run(args),
        Verb::Objects(args) => objects::run(args),
        Verb::Sii(args) => sii::run(args),
        Verb::Diff(args) => diff::run(args),
        Verb::List(args) => list::run(args),
    }
}

/// A file, and which device of it.
#[derive(Debug, clap::Args)]
struct Which {
    /// ESI file
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// Device, by its type or name; needed where the file describes several
    #[arg(long, value_name = "NAME")]
    device: Option<String>,
    /// Product code, decimal or 0x…
    #[arg(long, value_parser = number)]
    product: Option<u32>,
    /// Revision, decimal or 0x…; otherwise the newest
    #[arg(long, value_parser = number)]
    revision: Option<u32>,
}

impl Which {
    fn load(&self) -> Result<EsiFile, Failure> {
        load(&self.file)
    }

    fn query(&self) -> DeviceQuery<'_> {
        DeviceQuery {
            name: self.device.as_deref(),
            product: self.product,
            revision: self.revision,
        }
    }

    fn device<'e>(&self, file: &'e EsiFile) -> Result<&'e Device, Failure> {
        esi::find_device(file, &self.query()).map_err(|error| {
            let message = format!("{}: {error}", self.file.display());
            Failure::new(hints::WRONG, message)
                .hint("pick one with `--device TYPE`, `--product` or `--revision`; `ecaxis esi list FILE` shows them")
        })
    }
}

fn load(path: &Path) -> Result<EsiFile, Failure> {
    library::load(path).map_err(|error| {
        let failure = Failure::new(hints::WRONG, error.to_string());
        match error {
            LoadError::Esi { source, .. } => failure.hint(match source.problem() {
                esi::EsiProblem::NotEsi(_) => "this is some other XML file",
                esi::EsiProblem::Truncated(_) => "the file is not complete; fetch it again",
                _ => "the file is damaged or is not an ESI file; its maker has the right one",
            }),
            LoadError::Read { .. } | LoadError::TooLong { .. } => failure,
        }
    })
}

fn number(text: &str) -> Result<u32, String> {
    let hex = text.strip_prefix("0x").or(text.strip_prefix("0X"));
    let value = hex.map_or_else(
        || text.parse().ok(),
        |hex| u32::from_str_radix(hex, 16).ok(),
    );
    value.ok_or_else(|| "a number of 32 bits, decimal or 0x…".to_owned())
}

fn mode(text: &str) -> Result<Mode, String> {
    text.parse()
        .map_err(|error: esi::UnknownMode| error.to_string())
}

fn plural(count: usize, one: &str) -> String {
    match count {
        1 => format!("1 {one}"),
        _ => format!("{count} {one}s"),
    }
}
