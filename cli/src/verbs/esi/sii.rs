//! `ecaxis esi sii`: generates the EEPROM image of a device.

use std::path::PathBuf;

use ecaxis_esi::sii::{self, SiiOptions};

use super::DeviceArgs;
use crate::args::numbers::number;
use crate::hints::{self, Failure};
use crate::render::note;

const EXAMPLES: &str = "\
Examples:
  ecaxis esi sii f.xml --output eeprom.bin
  ecaxis esi sii f.xml --device EPOS4 --serial 7 --alias 1001 -o eeprom.bin";

/// Generate the EEPROM image (SII) from an ESI file
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    #[command(flatten)]
    which: DeviceArgs,
    /// Image file; it must not exist yet
    #[arg(short, long, value_name = "IMAGE")]
    output: PathBuf,
    /// Serial number
    #[arg(long, default_value = "0", value_parser = number)]
    serial: u32,
    /// Station alias
    #[arg(long, default_value_t = 0)]
    alias: u16,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let file = args.which.load()?;
    let device = args.which.device(&file)?;
    let options = SiiOptions {
        alias: args.alias,
        serial: args.serial,
    };
    let image = sii::emit(device, &file.modules, &options);
    let output = args.output.display();
    std::fs::File::create_new(&args.output)
        .and_then(|mut out| std::io::Write::write_all(&mut out, &image))
        .map_err(|error| {
            let failure = Failure::new(hints::WRONG, format!("cannot write {output}: {error}"));
            match error.kind() {
                std::io::ErrorKind::AlreadyExists => failure.hint(
                    "images are never written over others; name another file or remove that one",
                ),
                _ => failure,
            }
        })?;
    note(&format!(
        "{output}: {} bytes for {} ({})",
        image.len(),
        device.name,
        device.identity
    ));
    let room = device.eeprom.byte_size;
    if room > 0 && image.len() > usize::try_from(room).unwrap_or(usize::MAX) {
        note(&format!(
            "warning: the ESI gives the EEPROM {room} bytes, this image does not fit"
        ));
    }
    Ok(())
}
