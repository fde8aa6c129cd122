//! `ecaxis eeprom`: reads, writes and checks the EEPROM of a device, and sets its station alias.

use std::path::{Path, PathBuf};

use clap::Subcommand;
use ecaxis_esi::Identity;
use ecaxis_esi::sii::{self, Sii};
use ecaxis_master::acyclic::DatagramClient;
use ecaxis_master::acyclic::eeprom::{Eeprom, EepromAccess, size_of, with_eeprom};
use ecaxis_master::acyclic::image::{category, with_alias, with_category, write};
use ecaxis_master::text::pluralize;
use serde_json::json;

use crate::access::bus;
use crate::access::device::{DeviceArgs, DeviceError, OpenDevice, counter};
use crate::args::Verbosity;
use crate::args::files::write_new;
use crate::args::numbers::number_16;
use crate::hints::{self, Failure};
use crate::render::{note, print_json, result};

const EXAMPLES: &str = "\
Examples:
  ecaxis eeprom verify machine.toml x
  ecaxis eeprom read machine.toml x x.bin
  ecaxis eeprom alias machine.toml x 1001 --yes
  ecaxis eeprom alias --nic enp3s0 --position 0 1001 --yes
  ecaxis eeprom write machine.toml x x.bin --yes --backup old.bin

The new image is read back; the old image is backed up first. A station
alias takes effect after the next power-up.";

const READ_EXAMPLES: &str = "\
Examples:
  ecaxis eeprom read machine.toml x x.bin
  ecaxis eeprom read --nic enp3s0 --position 0 general.bin --category 30";

const WRITE_EXAMPLES: &str = "\
Examples:
  ecaxis eeprom write machine.toml x x.bin --yes
  ecaxis eeprom write machine.toml x general.bin --category 30 --yes";

const ALIAS_EXAMPLES: &str = "\
Examples:
  ecaxis eeprom alias machine.toml x 1001 --yes
  ecaxis eeprom alias --nic enp3s0 --position 0 1001 --yes";

const VERIFY_EXAMPLES: &str = "\
Examples:
  ecaxis eeprom verify machine.toml x
  ecaxis eeprom verify machine.toml x x.bin --json";

/// Read, write and check the EEPROM of a device, or set its station alias
///
/// Select the device by machine file and name, or by --nic with --position, --alias or --id.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    #[command(subcommand)]
    command: Command,
    #[command(flatten)]
    pub verbosity: Verbosity,
}

#[derive(Debug, Subcommand)]
enum Command {
    Read(ReadArgs),
    Write(WriteArgs),
    Alias(AliasArgs),
    Verify(VerifyArgs),
}

/// Save the image, or one category of it, to a file
#[derive(Debug, clap::Args)]
#[command(after_help = READ_EXAMPLES, override_usage = "ecaxis eeprom read FILE DEVICE IMAGE\n       \
    ecaxis eeprom read --nic IF --position N IMAGE")]
struct ReadArgs {
    /// Machine file, device, and the file to write, which must not exist yet
    #[arg(required = true, value_name = "WORD")]
    words: Vec<String>,
    /// Read only this category, such as 30 (general) or 41 (SyncManagers)
    #[arg(long, value_name = "TYPE", value_parser = number_16)]
    category: Option<u16>,
    /// Read the whole chip, not only up to the end of the image
    #[arg(long, conflicts_with = "category")]
    all: bool,
    #[command(flatten)]
    place: DeviceArgs,
}

/// The options that protect the old image.
#[derive(Debug, Clone, clap::Args)]
struct BackupOptions {
    /// Confirm writing: a wrong image makes a device unusable
    #[arg(long)]
    yes: bool,
    /// Back up the old image to this file, which must not exist yet [default: a generated name]
    #[arg(long, value_name = "FILE")]
    backup: Option<PathBuf>,
}

/// Write an image or one category, back up the old image, and read the new one back
#[derive(Debug, clap::Args)]
#[command(after_help = WRITE_EXAMPLES, override_usage = "ecaxis eeprom write FILE DEVICE IMAGE --yes\n       \
    ecaxis eeprom write --nic IF --position N IMAGE --yes"
)]
struct WriteArgs {
    /// Machine file, device, and the image
    #[arg(required = true, value_name = "WORD")]
    words: Vec<String>,
    /// The file contains only this category
    #[arg(long, value_name = "TYPE", value_parser = number_16)]
    category: Option<u16>,
    /// Write even if the image is for another device
    #[arg(long)]
    other_device: bool,
    #[command(flatten)]
    care: BackupOptions,
    #[command(flatten)]
    place: DeviceArgs,
}

/// Set the station alias and its checksum; effective after the next power-up
#[derive(Debug, clap::Args)]
#[command(after_help = ALIAS_EXAMPLES, override_usage = "ecaxis eeprom alias FILE DEVICE ALIAS --yes\n       \
    ecaxis eeprom alias --nic IF --position N ALIAS --yes"
)]
struct AliasArgs {
    /// Machine file, device, and the alias; 0 removes it
    #[arg(required = true, value_name = "WORD")]
    words: Vec<String>,
    #[command(flatten)]
    care: BackupOptions,
    #[command(flatten)]
    place: DeviceArgs,
}

/// Check the device's image: its checksum and structure, against the machine file, or against a
/// file
#[derive(Debug, clap::Args)]
#[command(after_help = VERIFY_EXAMPLES, override_usage = "ecaxis eeprom verify FILE DEVICE [IMAGE]\n       \
    ecaxis eeprom verify --nic IF --position N [IMAGE]")]
struct VerifyArgs {
    /// Machine file, device, and an image to compare with
    #[arg(value_name = "WORD")]
    words: Vec<String>,
    /// Print as JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    place: DeviceArgs,
}

impl Args {
    /// True if the subcommand may change a device.
    pub fn changes(&self) -> bool {
        matches!(self.command, Command::Write(_) | Command::Alias(_))
    }
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    match &args.command {
        Command::Read(args) => read(args),
        Command::Write(args) => replace(args),
        Command::Alias(args) => alias(args),
        Command::Verify(args) => verify(args),
    }
}

fn read(args: &ReadArgs) -> Result<(), Failure> {
    let (target, rest) = args.place.take(&args.words, "a file to write")?;
    let path = only(rest, "one file to write")?;
    if path.exists() {
        return Err(crate::args::files::already_exists(&path));
    }
    let all = args.all;
    let image = target.visit(async move |at: &OpenDevice| image(at, all).await)?;
    let bytes = match args.category {
        None => image.as_slice(),
        Some(kind) => {
            let place = category(&image, kind).ok_or_else(|| no_category(kind, &image))?;
            image.get(place).unwrap_or_default()
        }
    };
    write_new(&path, bytes)?;
    note(&format!("{}: {} bytes", path.display(), bytes.len()));
    Ok(())
}

fn replace(args: &WriteArgs) -> Result<(), Failure> {
    let (target, rest) = args.place.take(&args.words, "an image")?;
    let path = only(rest, "one image")?;
    let given = load(&path)?;
    if args.category.is_none() {
        sound(&path, &given)?;
    }
    args.care.allow()?;
    let (kind, care, other_device) = (args.category, args.care.clone(), args.other_device);
    let done = target.visit(async move |at: &OpenDevice| {
        let old = image(at, false).await?;
        let new = match kind {
            None => given,
            Some(kind) => {
                let new = with_category(&old, kind, &given);
                let new = new.ok_or_else(|| no_category(kind, &old))?;
                // Allow writing single categories to repair a broken image.
                if sii::parse(&old).is_ok_and(|sii| sii.damage.is_empty()) {
                    sound(&path, &new)?;
                }
                new
            }
        };
        for remark in new_remarks(&old, &new) {
            bus::warn(format!("{}: {remark}", path.display()));
        }
        let (was, becomes) = (identity(&old), identity(&new));
        if was != becomes && !other_device {
            let device = &at.device;
            let message = format!("{device}: is {was}, {} is an image of {becomes}", path.display());
            return Err(Failure::new(hints::FAILED, message)
                .hint("with it the device would be taken for another; `--other-device` writes it all the same"));
        }
        for (what, was, becomes) in kept(&old, &new) {
            bus::warn(format!("the {what} {was} becomes {becomes}"));
        }
        burn(at, &care, &old, &new).await
    })?;
    note(&done);
    Ok(())
}

fn alias(args: &AliasArgs) -> Result<(), Failure> {
    let (target, rest) = args.place.take(&args.words, "an alias")?;
    let alias = match rest {
        [alias] => number_16(alias).map_err(|error| format!("`{alias}`: {error}")),
        _ => Err("one alias, decimal or 0x…".to_owned()),
    };
    let alias = alias.map_err(|error| Failure::new(hints::WRONG, error))?;
    args.care.allow()?;
    let care = args.care.clone();
    let done = target.visit(async move |at: &OpenDevice| {
        let old = image(at, false).await?;
        let mut new = old.clone();
        let Some(area) = new.first_chunk_mut() else {
            return Err(Failure::new(
                hints::FAILED,
                "the image has no configuration area",
            ));
        };
        *area = with_alias(*area, alias);
        burn(at, &care, &old, &new).await
    })?;
    note(&done);
    note("the alias takes effect when the device is switched on again");
    Ok(())
}

fn verify(args: &VerifyArgs) -> Result<(), Failure> {
    let (target, rest) = args.place.take(&args.words, "nothing or an image")?;
    let other = match rest {
        [] => None,
        rest => {
            let path = only(rest, "one image")?;
            Some((load(&path)?, path))
        }
    };
    let compared = other.as_ref().map_or(0, |(image, _)| image.len());
    let ((there, longer), expected, device) = target.visit(async move |at: &OpenDevice| {
        let read = in_eeprom(at, "reading its EEPROM", async |eeprom| {
            let mut progress = counter("reading bytes");
            let there = eeprom.image(&mut progress).await?;
            // File and chip may both continue after the end of the image.
            let room = eeprom.size().await?.max(there.len());
            let longer = compared.min(room);
            let longer = eeprom.longer(there.clone(), longer, &mut progress).await?;
            Ok((there, longer))
        });
        let read = read.await;
        bus::passed();
        Ok((read?, at.expected.clone(), at.device.clone()))
    })?;
    let mut problems = Vec::new();
    let mut remarks = Vec::new();
    match sii::inspect(&there) {
        Ok((sii, warnings)) => {
            match &expected {
                Some((name, expected)) if sii.identity != *expected => problems.push(format!(
                    "it is of {}, the machine file says {name} ({expected})",
                    sii.identity
                )),
                _ => {}
            }
            if !sii.checksum_ok {
                problems.push("the checksum of its configuration area is wrong".to_owned());
            }
            problems.extend(sii.damage.iter().map(ToString::to_string));
            let others = warnings.iter().filter(|w| !sii.damage.contains(w));
            remarks.extend(others.map(ToString::to_string));
        }
        Err(error) => problems.push(error.to_string()),
    }
    if let Some((image, path)) = &other {
        problems.extend(differing(&longer, image, path));
    }
    if args.json {
        print_json(&json!({
            "ok": problems.is_empty(), "device": device.name, "position": device.position,
            "bytes": there.len(), "problems": problems, "remarks": remarks,
        }))?;
    } else {
        for line in problems.iter().chain(&remarks) {
            result(&format!("{line}\n"))?;
        }
        if problems.is_empty() {
            let same = other.as_ref().map(|(_, path)| path.display());
            let same = same.map_or_else(String::new, |path| format!(", as in {path}"));
            let bytes = there.len();
            result(&format!(
                "{device}: its EEPROM is right: {bytes} bytes{same}\n"
            ))?;
        }
    }
    if problems.is_empty() {
        return Ok(());
    }
    Err(Failure::new(
        hints::FAILED,
        format!("{device}: the image in its EEPROM is not right"),
    )
    .hint("`ecaxis eeprom write` writes another"))
}

/// Describes the differences between the image in a file and the device, or returns `None`. The
/// device may hold more bytes.
fn differing(there: &[u8], image: &[u8], path: &Path) -> Option<String> {
    let at = (0..image.len()).filter(|at| there.get(*at) != image.get(*at));
    let all: Vec<usize> = at.collect();
    let first = all.first()?;
    Some(format!(
        "{} bytes are not those of {}, the first at 0x{first:04x}",
        all.len(),
        path.display()
    ))
}

impl BackupOptions {
    fn allow(&self) -> Result<(), Failure> {
        if self.yes {
            return Ok(());
        }
        Err(
            Failure::new(hints::WRONG, "nothing was written: add `--yes`")
                .hint("a wrong image makes a device unusable; the old image is backed up first"),
        )
    }

    /// Backs up the old image and prints the path.
    fn keep(&self, at: &OpenDevice, old: &[u8]) -> Result<PathBuf, Failure> {
        if let Some(path) = &self.backup {
            return write_new(path, old).map(|()| path.clone());
        }
        let serial = sii::parse(old).map_or(0, |sii| sii.serial);
        let plain = |c: char| if c.is_alphanumeric() { c } else { '-' };
        let name: String = at.device.name.chars().map(plain).collect();
        for n in 1..1000 {
            let path = PathBuf::from(format!("eeprom-{name}-{serial}-{n}.bin"));
            if !path.exists() {
                return write_new(&path, old).map(|()| path);
            }
        }
        Err(
            Failure::new(hints::WRONG, "too many old images in this folder")
                .hint("name the file with `--backup`"),
        )
    }
}

/// Backs up the old image, writes the new one and reads it back.
async fn burn(
    at: &OpenDevice,
    care: &BackupOptions,
    old: &[u8],
    new: &[u8],
) -> Result<String, Failure> {
    let done = in_eeprom(at, "writing its EEPROM", async |eeprom| {
        // The size word of the old image may be wrong. A smaller chip is detected by reading beyond
        // its end.
        let room = eeprom.size().await?.max(size_of(new));
        if new.len() > room {
            let message = format!("the image has {} bytes, the EEPROM {room}", new.len());
            return Err(Failure::new(hints::FAILED, message).into());
        }
        // Bytes after the end of the old image are overwritten as well.
        let bytes = new.len().next_multiple_of(2);
        let there = eeprom.longer(old.to_vec(), bytes, &mut |_, _| {}).await?;
        let backup = care.keep(at, &there)?;
        note(&format!("the old image is in {}", backup.display()));
        let mut progress = counter("writing words");
        let written = write(eeprom, new, &mut progress).await;
        bus::passed();
        let half = written.map_err(|e| at.advised(&e, |e, nic| hints::image(e, &backup, nic)));
        Ok(half?)
    });
    let written = done.await?;
    let (device, words) = (&at.device, pluralize(written, "word"));
    Ok(format!("{device}: {words} written and read back"))
}

/// Runs `work` on the EEPROM, then returns the EEPROM to its previous owner.
async fn in_eeprom<T>(
    at: &OpenDevice,
    step: &'static str,
    work: impl AsyncFnOnce(&Eeprom<'_, DatagramClient>) -> Result<T, DeviceError>,
) -> Result<T, Failure> {
    let done = with_eeprom(&at.wire, &at.device, step, EepromAccess::of(at.state), work).await;
    // Writing that has begun is never cancelled.
    let untouched = matches!(&done, Err(DeviceError::Service(error)) if error.is_interruption());
    at.ended(done).map_err(|failure| match untouched {
        true => Failure {
            message: format!("{}; nothing was written", failure.message),
            ..failure
        },
        false => failure,
    })
}

/// Reads the image of the device.
async fn image(at: &OpenDevice, all: bool) -> Result<Vec<u8>, Failure> {
    let read = in_eeprom(at, "reading its EEPROM", async |eeprom| {
        let mut progress = counter("reading bytes");
        Ok(match all {
            true => eeprom.all(&mut progress).await?,
            false => eeprom.image(&mut progress).await?,
        })
    });
    let read = read.await;
    bus::passed();
    read
}

/// Returns the remarks on the new image that the old one does not have.
fn new_remarks(old: &[u8], new: &[u8]) -> Vec<String> {
    let remarks = |image: &[u8]| -> Vec<String> {
        let warnings = sii::inspect(image).map(|(_, warnings)| warnings);
        let warnings = warnings.unwrap_or_default();
        warnings.iter().map(ToString::to_string).collect()
    };
    let old = remarks(old);
    let mut new = remarks(new);
    new.retain(|remark| !old.contains(remark));
    new
}

fn identity(image: &[u8]) -> Identity {
    let word = |at: usize| {
        let bytes = image.get(at..).and_then(<[u8]>::first_chunk);
        bytes.map_or(0, |bytes| u32::from_le_bytes(*bytes))
    };
    Identity {
        vendor: word(0x10),
        product: word(0x14),
        revision: word(0x18),
    }
}

/// Returns the device-specific values that would change: name, old value, new value.
fn kept(old: &[u8], new: &[u8]) -> Vec<(&'static str, u32, u32)> {
    let (Ok(old), Ok(new)) = (sii::parse(old), sii::parse(new)) else {
        return Vec::new();
    };
    let own = |sii: &Sii| {
        [
            ("serial number", sii.serial),
            ("station alias", u32::from(sii.alias)),
        ]
    };
    let both = own(&old).into_iter().zip(own(&new));
    let changed = both.filter(|((_, was), (_, becomes))| was != becomes);
    changed
        .map(|((what, was), (_, becomes))| (what, was, becomes))
        .collect()
}

fn load(path: &Path) -> Result<Vec<u8>, Failure> {
    /// The maximum size of an EEPROM in bytes.
    const MAX_BYTES: u64 = 512 * 1024;
    let shown = path.display();
    let wrong = |what: String| Failure::new(hints::WRONG, what);
    ecaxis_master::file::read(path, MAX_BYTES)
        .map_err(|error| wrong(format!("cannot read {shown}: {error}")))
}

/// Fails for a broken image: the device would lose its mailbox, and some devices their controller.
fn sound(path: &Path, image: &[u8]) -> Result<(), Failure> {
    let wrong = |what: String| {
        Failure::new(hints::WRONG, format!("{}: {what}", path.display()))
            .hint("`ecaxis esi sii` generates an image from an ESI file")
    };
    match sii::parse(image) {
        Ok(sii) if !sii.checksum_ok => Err(wrong(
            "the checksum of its configuration area is wrong; a controller would ignore it"
                .to_owned(),
        )),
        Ok(sii) => match sii.damage.first() {
            None => Ok(()),
            Some(damage) => Err(wrong(damage.to_string())),
        },
        Err(error) => Err(wrong(error.to_string())),
    }
}

fn no_category(kind: u16, image: &[u8]) -> Failure {
    let there: Vec<String> = (0..0x1000)
        .filter(|kind| category(image, *kind).is_some())
        .map(|kind| kind.to_string())
        .collect();
    Failure::new(hints::WRONG, format!("the image has no category {kind}"))
        .hint(format!("it has {}", there.join(", ")))
}

fn only(words: &[String], what: &str) -> Result<PathBuf, Failure> {
    match words {
        [path] => Ok(PathBuf::from(path)),
        _ => Err(Failure::new(hints::WRONG, what)),
    }
}

#[cfg(test)]
#[path = "eeprom_tests.rs"]
mod tests;
