//! `ecaxis sdo write`.

use std::path::PathBuf;

use ecaxis_master::file;
use ecaxis_master::mailbox::MailboxTransport;
use ecaxis_master::parameters::meaning::meaning;
use ecaxis_master::parameters::{DataType, ValueError};
use serde_json::json;

use super::read::{data_type, describe, hex, parts};
use super::{Common, Line, print_lines};
use crate::access::device::{Open, address};
use crate::hints::{self, Failure};
use crate::render::{note, print_json};

const EXAMPLES: &str = "\
Examples:
  ecaxis sdo write machine.toml x 0x6065 2000
  ecaxis sdo write --nic enp3s0 --alias 1001 0x6065 2000
  ecaxis sdo write machine.toml x 0x2100 --from large.bin";

/// Write an object: decimal, hexadecimal (0x10), text, or bytes ([01 02])
///
/// The value is read back. Use `sdo store` to keep it over a power cycle.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES, override_usage = "ecaxis sdo write FILE DEVICE OBJECT VALUE\n       \
    ecaxis sdo write --nic IF --position N OBJECT VALUE")]
pub(super) struct Args {
    /// Machine file, device, object, and the value
    #[arg(required = true, value_name = "WORD", allow_negative_numbers = true)]
    words: Vec<String>,
    /// Interpret the object as this type: u16, i32, f32, text, bytes, or a name from ETG.2000 such
    /// as UDINT
    #[arg(long = "type", value_name = "TYPE")]
    data_type: Option<String>,
    /// Write the object in one transfer (complete access); the value is bytes
    #[arg(long)]
    complete: bool,
    /// Read the value from this file
    #[arg(long, value_name = "FILE")]
    from: Option<PathBuf>,
    #[command(flatten)]
    common: Common,
}

/// The maximum size of an object in bytes.
const MAX_BYTES: u64 = 256 << 20;

pub(super) fn run(args: &Args) -> Result<(), Failure> {
    let (target, words) = args.common.take(&args.words, "an object and its value")?;
    let (object, written) = match (words, &args.from) {
        ([object], Some(path)) => {
            let bytes = file::read(path, MAX_BYTES).map_err(|error| {
                Failure::new(
                    hints::WRONG,
                    format!("cannot read {}: {error}", path.display()),
                )
            })?;
            (object.clone(), Written::Bytes(bytes))
        }
        ([object, value], None) => (object.clone(), Written::Text(value.clone())),
        (_, Some(_)) => {
            return Err(Failure::new(
                hints::WRONG,
                "one object, and no value in addition to --from",
            ));
        }
        (_, None) => {
            return Err(Failure::new(hints::WRONG, "one object and one value")
                .hint("a value of several words goes in quotes"));
        }
    };
    let data_type = data_type(args.data_type.as_deref())?;
    let (ask, complete) = (args.common.ask, args.complete);
    let done = target.open("writing an object", async move |open: &mut Open<'_>| {
        let described = describe(open, ask, std::slice::from_ref(&object)).await?;
        let (wanted, known) = described.into_iter().next().ok_or_else(nothing)?;
        let mut parts = parts(wanted, known.as_ref());
        let several = parts.len() > 1 && wanted.sub.is_none() && !complete;
        if several {
            let at = address(parts.swap_remove(0).0);
            let message = format!("{object} has {} subindices", parts.len() + 1);
            return Err(Failure::new(hints::WRONG, message).hint(format!(
                "name one of them: `{at}`; or all at once with --complete"
            )));
        }
        let (at, name, known) = parts.into_iter().next().ok_or_else(nothing)?;
        let known = match complete {
            true => Some(DataType::BYTES),
            false => data_type.or(known),
        };
        let value = written.value(known, &object)?;
        let shown = known.unwrap_or(DataType::BYTES);
        let wire = &open.at.wire;
        let before = open.coe.upload(wire, at.index, at.sub, complete).await.ok();
        let download = open.coe.download(wire, at.index, at.sub, complete, &value);
        // A started download is not cancelled.
        let sent = wire.stop().shield(download).await;
        open.at.sdo_error(sent)?;
        // A value that cannot be read back was still accepted.
        let after = open.coe.upload(wire, at.index, at.sub, complete).await.ok();
        Ok((at, name, shown, value, before, after))
    })?;
    let (at, name, data_type, value, before, after) = done;
    let kept = after.as_ref().is_none_or(|after| *after == value);
    let shown = |bytes: &Vec<u8>| data_type.show(bytes);
    if args.common.json {
        let report = json!({
            "index": at.index, "sub": at.sub, "name": name, "type": data_type.to_string(),
            "written": shown(&value), "before": before.as_ref().map(shown), "after": after.as_ref().map(shown),
        });
        return print_json(&report);
    }
    if let Some(after) = after.as_ref().filter(|_| !kept) {
        note(&format!(
            "warning: {} reads back as {}, {} was written",
            address(at),
            shown(after),
            shown(&value)
        ));
    }
    if let Some(before) = before.filter(|before| before.len() <= 64 && *before != value) {
        note(&format!("it was {}", data_type.show(&before)));
    }
    let long = value.len() > 64;
    let line = Line {
        at,
        name,
        data_type: data_type.to_string(),
        value: Ok(match long {
            true => (format!("{} bytes", value.len()), None),
            false => (shown(&value), hex(data_type, &value)),
        }),
        meaning: meaning(at.index, at.sub, &value),
    };
    print_lines(&[line])
}

fn nothing() -> Failure {
    Failure::new(hints::WRONG, "which object?")
}

#[derive(Debug)]
enum Written {
    Text(String),
    Bytes(Vec<u8>),
}

impl Written {
    fn value(self, data_type: Option<DataType>, object: &str) -> Result<Vec<u8>, Failure> {
        let text = match self {
            Self::Bytes(bytes) => return Ok(bytes),
            Self::Text(text) => text,
        };
        let raw = text.trim_start().starts_with('[');
        let Some(data_type) = data_type.or(raw.then_some(DataType::BYTES)) else {
            let message = format!("{object}: neither the ESI nor the device says what type it has");
            return Err(Failure::new(hints::WRONG, message)
                .hint("give it: `--type u16`; or write bytes: `[01 02]`"));
        };
        data_type.read(&text).map_err(|error: ValueError| {
            Failure::new(hints::WRONG, format!("{object} ({data_type}): {error}"))
        })
    }
}
