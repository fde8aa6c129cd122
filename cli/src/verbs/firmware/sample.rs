//! `ecaxis firmware sample`: writes a firmware file for a simulated device.

use std::path::PathBuf;

use ecaxis_master::config;
use ecaxis_sim::FirmwareHeader;

use crate::access::device::named;
use crate::args::files::write_new;
use crate::args::numbers::number;
use crate::hints::{self, Failure};
use crate::render::note;

/// The maximum program size in bytes.
const MOST: usize = 16 << 20;

const EXAMPLES: &str = "\
Examples:
  ecaxis firmware sample configs/demo.toml x -o new.bin --size 1MiB
  ecaxis firmware update configs/demo.toml x new.bin --sim --yes";

/// Write a firmware file for a device of the simulated bus (real devices reject it)
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Machine file
    #[arg(value_name = "MACHINE")]
    machine: PathBuf,
    /// The device's name in it
    #[arg(value_name = "DEVICE")]
    device: String,
    /// File to write, which must not exist yet
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Program size in bytes, such as 65536, 64KiB or 1MiB
    #[arg(long, value_name = "SIZE", default_value = "64KiB", value_parser = size)]
    size: usize,
    /// Revision of the device with this program
    #[arg(long, value_name = "N", default_value = "0x00020000", value_parser = number)]
    revision: u32,
    /// Software version of the device with this program: four characters
    #[arg(long, value_name = "TEXT", default_value = "2.00", value_parser = version)]
    software: [u8; 4],
}

fn size(text: &str) -> Result<usize, String> {
    let units = [("KiB", 1024), ("MiB", 1 << 20), ("", 1)];
    let parsed = units.into_iter().find_map(|(unit, factor)| {
        let number = text.strip_suffix(unit)?.trim().parse::<usize>().ok()?;
        number.checked_mul(factor)
    });
    match parsed {
        Some(bytes @ 0..=MOST) => Ok(bytes),
        _ => Err("a size such as 65536, 64KiB or 1MiB, of 16MiB at most".to_owned()),
    }
}

fn version(text: &str) -> Result<[u8; 4], String> {
    let bytes = <[u8; 4]>::try_from(text.as_bytes()).ok();
    bytes
        .filter(|bytes| bytes.iter().all(u8::is_ascii_graphic))
        .ok_or_else(|| "four ASCII characters, such as 2.00".to_owned())
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let machine = config::load(&args.machine).map_err(|e| hints::config(&args.machine, &e))?;
    let device = named(&machine, &args.device)?;
    let identity = device.device.identity;
    let header = FirmwareHeader {
        vendor: identity.vendor,
        product: identity.product,
        revision: args.revision,
        version: args.software,
    };
    let file = header.file(&program(args.size));
    write_new(&args.output, &file)?;
    note(&format!(
        "{}: {} bytes for the simulated `{}`",
        args.output.display(),
        file.len(),
        args.device
    ));
    Ok(())
}

/// Returns reproducible pseudo-random bytes from a linear congruential generator.
fn program(len: usize) -> Vec<u8> {
    let mut state = 1_u32;
    let mut next = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        let [.., high] = state.to_le_bytes();
        high
    };
    (0..len).map(|_| next()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes() {
        for (text, bytes) in [
            ("0", Some(0)),
            ("17", Some(17)),
            ("64KiB", Some(65536)),
            ("1MiB", Some(1 << 20)),
            ("16 MiB", Some(MOST)),
            ("17MiB", None),
            ("1MB", None),
            ("-1", None),
            ("99999999999999999999MiB", None),
            ("KiB", None),
        ] {
            assert_eq!(size(text).ok(), bytes, "{text}");
        }
    }

    #[test]
    fn versions() {
        assert_eq!(version("2.00"), Ok(*b"2.00"));
        for text in ["2.0", "2.000", "2 00", "2.0\u{7f}", "ä.0"] {
            assert!(version(text).is_err(), "{text}");
        }
    }
}
