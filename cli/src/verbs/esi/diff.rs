//! `ecaxis esi diff`: compares an EEPROM image with the ESI of its device.

use std::path::PathBuf;

use ecaxis_esi::sii::{self, Difference, DifferenceKind, Sii, SiiOptions};
use ecaxis_master::text::pluralize;
use ecaxis_tools::cells;
use ecaxis_tools::document::Table;
use serde_json::json;

use super::DeviceArgs;
use crate::hints::{self, Failure};
use crate::render::{note, print_json, print_table};

const EXAMPLES: &str = "\
Examples:
  ecaxis esi diff f.xml eeprom.bin
  ecaxis esi diff f.xml eeprom.bin --revision 0x1700000 --json";

/// Compare an EEPROM image with an ESI file; exit code 1 if the device would behave differently
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    #[command(flatten)]
    which: DeviceArgs,
    /// EEPROM image
    #[arg(value_name = "IMAGE")]
    image: PathBuf,
    /// Print the differences as JSON
    #[arg(long)]
    json: bool,
}

/// The maximum size of an EEPROM in bytes.
const MAX_BYTES: u64 = 512 * 1024;

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let file = args.which.load()?;
    let name = args.image.display();
    let wrong = |message: String| Failure::new(hints::WRONG, message);
    let bytes = ecaxis_master::file::read(&args.image, MAX_BYTES)
        .map_err(|e| wrong(format!("cannot read {name}: {e}")))?;
    let (found, warnings) = sii::inspect(&bytes).map_err(|e| {
        wrong(format!("{name}: {e}")).hint("an image is the EEPROM's bytes, without any header")
    })?;
    let device = device(args, &file, &found)?;
    let expected = sii::emit(device, &file.modules, &SiiOptions::default());
    let expected = sii::parse(&expected).map_err(|e| wrong(format!("the ESI's own image: {e}")))?;
    let differences = sii::compare(&expected, &found);
    let warnings: Vec<String> = warnings.iter().map(ToString::to_string).collect();
    for warning in warnings.iter().filter(|_| !args.json) {
        note(&format!("warning: {name}: {warning}"));
    }
    if args.json {
        let all: Vec<_> = differences.iter().map(as_json).collect();
        let device = &device.name;
        print_json(&json!({ "device": device, "differences": all, "warnings": warnings }))?;
    } else if !differences.is_empty() {
        let mut table = Table::new("of|field|ESI|image");
        for d in &differences {
            table.row(cells![aspect(d.aspect), d.field, d.expected, d.found]);
        }
        print_table(&table)?;
    }
    let count = |aspect| differences.iter().filter(|d| d.aspect == aspect).count();
    let (identity, behaviour) = (
        count(DifferenceKind::Identity),
        count(DifferenceKind::Behaviour),
    );
    let reported = format!(
        "{name} against {}: {} of identity, {behaviour} of behaviour, {} of description",
        device.name,
        pluralize(identity, "difference"),
        count(DifferenceKind::Description),
    );
    if identity + behaviour > 0 {
        return Err(Failure::new(hints::FAILED, reported));
    }
    note(&reported);
    Ok(())
}

/// Returns the device named by the image or selected by the user.
fn device<'e>(
    args: &Args,
    file: &'e ecaxis_esi::EsiFile,
    found: &Sii,
) -> Result<&'e ecaxis_esi::Device, Failure> {
    let which = &args.which;
    if which.says_which() {
        return which.device(file);
    }
    let same = |d: &&ecaxis_esi::Device| d.identity == found.identity;
    match file.devices.iter().find(same) {
        Some(device) => Ok(device),
        None => which.device(file),
    }
}

fn aspect(aspect: DifferenceKind) -> &'static str {
    match aspect {
        DifferenceKind::Identity => "identity",
        DifferenceKind::Behaviour => "behaviour",
        DifferenceKind::Description => "description",
        DifferenceKind::Instance => "this piece",
    }
}

fn as_json(d: &Difference) -> serde_json::Value {
    json!({ "of": aspect(d.aspect), "field": d.field, "esi": d.expected, "image": d.found })
}
