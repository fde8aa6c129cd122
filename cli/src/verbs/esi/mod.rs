//! `ecaxis esi …`: shows and checks ESI files, and generates EEPROM images from them.

use std::path::{Path, PathBuf};

use clap::Subcommand;
use ecaxis_esi::{self as esi, Device, DeviceHeader, DeviceQuery, EsiFile, Mode, SelectError};
use ecaxis_master::config::nearest;
use ecaxis_master::esi_library::{self, LoadError};
use ecaxis_master::text::pluralize;

use crate::args::numbers::number;
use crate::hints::{self, Failure};
use crate::render::note;

mod check;
mod diff;
mod list;
pub(crate) mod objects;
mod show;
mod sii;

const EXAMPLES: &str = "\
Examples:
  ecaxis esi list esi/                      devices of a folder of files
  ecaxis esi show f.xml --device EPOS4 --mode csp
  ecaxis esi check f.xml                    problems, with line and column
  ecaxis esi sii f.xml --device 0x63500000 -o eeprom.bin";

/// Inspect ESI files: devices, PDOs, modes, problems, EEPROM images
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
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

/// An ESI file and one of its devices.
#[derive(Debug, clap::Args)]
struct DeviceArgs {
    /// ESI file
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// Device: type, name, product code (0x…), or number in the file; required if there are several
    #[arg(long, value_name = "DEVICE")]
    device: Option<String>,
    /// Product code, decimal or 0x…
    #[arg(long, value_parser = number)]
    product: Option<u32>,
    /// Revision, decimal or 0x… [default: the newest]
    #[arg(long, value_parser = number)]
    revision: Option<u32>,
}

impl DeviceArgs {
    fn load(&self) -> Result<EsiFile, Failure> {
        load(&self.file, &|header| self.may_mean(header))
    }

    /// Returns `false` if the arguments exclude the device.
    fn may_mean(&self, header: &DeviceHeader) -> bool {
        let query = DeviceQuery {
            name: None,
            product: self.product,
            revision: self.revision,
        };
        let is_called = |text: &str| {
            let query = DeviceQuery {
                name: Some(text),
                ..DeviceQuery::default()
            };
            query.matches(header.identity, &header.type_name, &header.name)
                || number(text).is_ok_and(|n| n == header.number || n == header.identity.product)
        };
        query.matches(header.identity, "", "") && self.device.as_deref().is_none_or(is_called)
    }

    fn says_which(&self) -> bool {
        self.device.is_some() || self.product.is_some() || self.revision.is_some()
    }

    /// Returns the selected device. Without a revision, it picks the newest and prints a note.
    fn device<'e>(&self, file: &'e EsiFile) -> Result<&'e Device, Failure> {
        let device = self
            .find(file)
            .map_err(|error| self.not_found(file, &error))?;
        let (product, revision) = (device.identity.product, device.identity.revision);
        let older: Vec<String> = file
            .headers()
            .filter(|(other, ..)| other.product == product && other.revision != revision)
            .map(|(other, ..)| format!("0x{:08x}", other.revision))
            .collect();
        let text = self.device.as_deref();
        let counted = text.is_some_and(|text| self.number_of(file, text).is_some());
        if self.revision.is_none() && !counted && !older.is_empty() {
            note(&format!(
                "{}: the newest revision, 0x{:08x}; `--revision` picks another of {}",
                device.type_name,
                device.identity.revision,
                older.join(", ")
            ));
        }
        Ok(device)
    }

    fn find<'e>(&self, file: &'e EsiFile) -> Result<&'e Device, SelectError> {
        let query = DeviceQuery {
            name: self.device.as_deref(),
            product: self.product,
            revision: self.revision,
        };
        let named = esi::find_device(file, &query);
        let (Err(SelectError::NoSuchDevice { .. }), Some(text)) = (&named, &self.device) else {
            return named;
        };
        if let Some(device) = self.number_of(file, text) {
            return Ok(device);
        }
        match number(text) {
            Ok(product) if self.product.is_none() && text.starts_with("0x") => {
                let query = DeviceQuery {
                    name: None,
                    product: Some(product),
                    revision: self.revision,
                };
                esi::find_device(file, &query)
            }
            _ => named,
        }
    }

    /// Returns the device with this number in the file, from 1. Device names take precedence.
    fn number_of<'e>(&self, file: &'e EsiFile, text: &str) -> Option<&'e Device> {
        let number: u32 = text.parse().ok()?;
        let mut devices = file.devices.iter();
        let device = devices.find(|device| device.number == number)?;
        let called = |device: &Device| device.type_name == text || device.name == text;
        let fits = self
            .product
            .is_none_or(|product| product == device.identity.product)
            && self
                .revision
                .is_none_or(|revision| revision == device.identity.revision);
        (fits && !file.devices.iter().any(called)).then_some(device)
    }

    fn not_found(&self, file: &EsiFile, error: &SelectError) -> Failure {
        let failure = |message: String| {
            Failure::new(hints::WRONG, format!("{}: {message}", self.file.display()))
        };
        let path = self.file.display();
        match (error, &self.device) {
            (
                SelectError::NoSuchDevice {
                    query, unreadable, ..
                },
                Some(name),
            ) => {
                let mut types: Vec<&str> = file.headers().map(|(_, kind, _)| kind).collect();
                let count = pluralize(types.len(), "device");
                types.dedup();
                let failure = failure(format!("none of its {count} matches {query}{unreadable}"));
                match nearest(name, types.iter().copied()) {
                    Some(known) => failure.hint(format!("did you mean `{known}`?")),
                    None if types.len() <= 12 => {
                        failure.hint(format!("there are {}", types.join(", ")))
                    }
                    None => failure.hint(format!("`ecaxis esi list {path}` shows what there is")),
                }
            }
            (SelectError::NoSuchDevice { .. } | SelectError::Ambiguous { .. }, _) => {
                let message = match error {
                    SelectError::Ambiguous { .. } if !self.says_which() => {
                        format!("it describes {}", pluralize(file.devices.len(), "device"))
                    }
                    _ => error.to_string(),
                };
                failure(message).hint(format!(
                    "pick one with `--device`, `--product` or `--revision`; `ecaxis esi list {path}` shows them"
                ))
            }
            _ => failure(error.to_string()),
        }
    }
}

fn load(path: &Path, wanted: &dyn Fn(&DeviceHeader) -> bool) -> Result<EsiFile, Failure> {
    esi_library::load(path, wanted).map_err(|error| {
        let failure = Failure::new(hints::WRONG, error.to_string());
        match error {
            LoadError::Esi { source, .. } => failure.hint(match source.problem() {
                esi::EsiProblem::NotEsi(_) => "this is some other XML file",
                esi::EsiProblem::NotXml => "an ESI file is an XML file of the vendor of the device",
                esi::EsiProblem::Truncated(_) | esi::EsiProblem::TruncatedTag => {
                    "the file is not complete; fetch it again"
                }
                _ => {
                    "the file is damaged or is not an ESI file; download it from the vendor's site"
                }
            }),
            LoadError::Signature(source) => failure.hint(source.hint()),
            LoadError::Read { .. } | LoadError::Sii { .. } => failure,
        }
    })
}

fn mode(text: &str) -> Result<Mode, String> {
    text.parse()
        .map_err(|error: esi::UnknownMode| error.to_string())
}
