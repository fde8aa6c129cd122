//! `ecaxis sdo read`.

use std::path::PathBuf;
use std::time::Duration;

use ecaxis_esi::Object;
use ecaxis_master::acyclic::parameters::dictionary;
use ecaxis_master::config::duration;
use ecaxis_master::mailbox::{CoeCause, NamedObject, SdoError, Subject, object_name};
use ecaxis_master::parameters::lookup::ObjectQuery;
use ecaxis_master::parameters::meaning::meaning;
use ecaxis_master::parameters::{DataType, name_of, type_of};
use ecaxis_master::text::pluralize;
use ecaxis_tools::document::format::hex_bytes;
use serde_json::json;

use super::{Common, Line, print_lines, wanted};
use crate::access::device::{Open, address};
use crate::hints::{self, Failure};
use crate::render::{note, print_json};

mod watch;

const EXAMPLES: &str = "\
Examples:
  ecaxis sdo read machine.toml x Statusword
  ecaxis sdo read machine.toml x 0x6064 0x1018:01 --json
  ecaxis sdo read --nic enp3s0 --position 0 0x1018
  ecaxis sdo read machine.toml x 0x2100 --to large.bin
  ecaxis sdo read machine.toml x Statusword --watch        each change
  ecaxis sdo read machine.toml x 0x6064 --watch 500ms --json";

/// Read objects by number (0x6064, 0x1018:01) or by name
///
/// An object without subindex is read with all its subindices.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES, override_usage = "ecaxis sdo read FILE DEVICE OBJECT...\n       \
    ecaxis sdo read --nic IF --position N OBJECT...")]
pub(super) struct Args {
    /// Machine file, device, and one or more objects
    #[arg(required = true, value_name = "WORD")]
    words: Vec<String>,
    /// Interpret the object as this type: u16, i32, f32, text, bytes, or a name from ETG.2000 such
    /// as UDINT
    #[arg(long = "type", value_name = "TYPE")]
    data_type: Option<String>,
    /// Read each object in one transfer (complete access)
    #[arg(long)]
    complete: bool,
    /// Read again and again, each PERIOD [default: 100ms], and print each value that changes, until
    /// Ctrl-C
    #[arg(long, value_name = "PERIOD", num_args = 0..=1, default_missing_value = "100ms",
        value_parser = duration::parse, conflicts_with_all = ["complete", "to"])]
    watch: Option<u64>,
    /// Write the bytes of one object to this file, which must not exist yet
    #[arg(long, value_name = "FILE", conflicts_with_all = ["complete", "json"])]
    to: Option<PathBuf>,
    #[command(flatten)]
    common: Common,
}

pub(super) fn run(args: &Args) -> Result<(), Failure> {
    let (target, objects) = args.common.take(&args.words, "objects")?;
    if objects.is_empty() {
        return Err(Failure::new(hints::WRONG, "which object?")
            .hint("by number, such as 0x6041, or by name, such as Statusword"));
    }
    let data_type = data_type(args.data_type.as_deref())?;
    let (objects, ask, complete) = (objects.to_vec(), args.common.ask, args.complete);
    let to_file = args.to.is_some();
    if let Some(period) = args.watch {
        let (period, json) = (Duration::from_nanos(period), args.common.json);
        return target.open("reading objects", async move |open: &mut Open<'_>| {
            let mut parts = Vec::new();
            for (wanted, object) in describe(open, ask, &objects).await? {
                parts.extend(self::parts(wanted, object.as_ref()));
            }
            watch::watch(open, parts, data_type, period, json).await
        });
    }
    let read = target.open("reading objects", async move |open: &mut Open<'_>| {
        let mut out = Vec::new();
        let mut refused = Vec::new();
        for (wanted, object) in describe(open, ask, &objects).await? {
            let before = out.len();
            if complete {
                out.extend(whole(open, wanted, object.as_ref(), data_type).await?);
            } else {
                for (at, name, known) in parts(wanted, object.as_ref()) {
                    let value = open.read(at.index, at.sub).await?;
                    out.push((at, name, data_type.or(known), value));
                }
            }
            let new = out.get(before..).unwrap_or_default();
            if let Some(wrong) = data_type.and_then(|given| misfit(given, new)) {
                return Err(wrong);
            }
            if new.iter().all(|(.., value)| value.is_err()) {
                refused.push(wanted.to_string());
            }
        }
        // A refused single value is an error; among others it is a row.
        match out.as_slice() {
            [(at, .., Err(code))] => open.at.sdo_error(Err(SdoError {
                station: open.at.device.station,
                asked: Subject::Object(*at),
                cause: CoeCause::Abort(*code),
            })),
            [_, _, ..] if to_file => {
                Err(Failure::new(hints::WRONG, "a file takes one subindex")
                    .hint("name it: 0x1018:01"))
            }
            _ => Ok((out, refused)),
        }
    })?;
    let (read, refused) = read;
    if let (Some(path), [(_, _, _, Ok(value))]) = (&args.to, read.as_slice()) {
        crate::args::files::write_new(path, value)?;
        note(&format!("{}: {} bytes", path.display(), value.len()));
        return Ok(());
    }
    let lines: Vec<Line> = read.into_iter().map(line).collect();
    if args.common.json {
        let all: serde_json::Value = lines.iter().map(as_json).collect();
        print_json(&all)?;
    } else {
        print_lines(&lines)?;
    }
    if refused.is_empty() {
        return Ok(());
    }
    let message = format!("the device refused {}", refused.join(", "));
    Err(Failure::new(hints::FAILED, message).hint("`ecaxis sdo list` shows its objects"))
}

/// Returns a failure if a value's length differs from the requested type.
fn misfit(given: DataType, values: &[Read]) -> Option<Failure> {
    let width = given.width()?;
    values.iter().find_map(|(at, .., value)| {
        let found = value.as_ref().ok()?.len();
        let message = format!(
            "{} has {}, a {given} has {width}",
            address(*at),
            pluralize(found, "byte")
        );
        (found != width).then(|| {
            Failure::new(hints::WRONG, message).hint(
                "omit `--type`, or give a type of that length; `--type bytes` accepts any length",
            )
        })
    })
}

fn as_json(line: &Line) -> serde_json::Value {
    json!({
        "index": line.at.index, "sub": line.at.sub, "name": line.name, "type": line.data_type,
        "value": line.value.as_ref().ok().map(|(value, _)| value),
        "hex": line.value.as_ref().ok().and_then(|(_, hex)| hex.as_ref()),
        "text": line.meaning,
        "abort": line.value.as_ref().err(),
    })
}

type Read = (NamedObject, String, Option<DataType>, Result<Vec<u8>, u32>);

fn line((at, name, data_type, value): Read) -> Line {
    let bytes = value.as_deref().unwrap_or_default();
    let meaning = meaning(at.index, at.sub, bytes);
    let data_type = data_type.unwrap_or(DataType::BYTES);
    Line {
        at,
        name,
        data_type: match data_type {
            DataType::BYTES => "bytes".to_owned(),
            known => known.to_string(),
        },
        value: value.map(|bytes| (data_type.show(&bytes), hex(data_type, &bytes))),
        meaning,
    }
}

/// Formats a number of more than one bit in hexadecimal.
pub(super) fn hex(data_type: DataType, bytes: &[u8]) -> Option<String> {
    data_type.integer(bytes).filter(|_| data_type.bits > 1)?;
    Some(format!("0x{}", hex_bytes(bytes.iter().rev(), "")))
}

pub(super) fn data_type(name: Option<&str>) -> Result<Option<DataType>, Failure> {
    let Some(name) = name else {
        return Ok(None);
    };
    DataType::named(name, 0).map(Some).ok_or_else(|| {
        Failure::new(hints::WRONG, format!("unknown type `{name}`"))
            .hint("u8 to u64, i8 to i64, f32, f64, bool, text, bytes, or a name of ETG.2000 such as UDINT")
    })
}

/// Returns the requested objects with their descriptions. The whole dictionary is read only if a
/// name requires it.
pub(super) async fn describe(
    open: &mut Open<'_>,
    ask: bool,
    objects: &[String],
) -> Result<Vec<(ObjectQuery, Option<Object>)>, Failure> {
    let mut dictionary = open.described(ask)?;
    let mut all = Vec::new();
    for text in objects {
        let found = match (wanted(dictionary.as_ref(), text), &dictionary) {
            (Err(failure), None) if !text.starts_with(|c: char| c.is_ascii_digit()) => {
                note("asking the device for the names of its objects");
                let own = open.dictionary(true).await;
                // Report the unknown name; that the device has no dictionary either is not
                // important.
                let own = own.map_err(|_| failure)?;
                wanted(Some(dictionary.insert(own)), text)?
            }
            (found, _) => found?,
        };
        let known = dictionary.as_ref().and_then(|d| d.object(found.index));
        let object = match (known, &dictionary) {
            (Some(object), _) => Some(object.clone()),
            // The device may have an object that its ESI does not describe.
            (None, _) => {
                let mut failed = Vec::new();
                let own =
                    dictionary::object(open.coe, &open.at.wire, found.index, &mut failed).await;
                own.ok().flatten()
            }
        };
        all.push((found, object.filter(|object| !object.items.is_empty())));
    }
    Ok(all)
}

type Part = (NamedObject, String, Option<DataType>);

/// Returns the requested subindices.
pub(super) fn parts(wanted: ObjectQuery, object: Option<&Object>) -> Vec<Part> {
    let index = wanted.index;
    let nameless = |sub: u8| {
        let name = object_name(index, sub).unwrap_or_default().to_owned();
        (NamedObject { index, sub }, name, None)
    };
    let Some(object) = object else {
        return vec![nameless(wanted.sub.unwrap_or(0))];
    };
    let items = object.items.iter().filter(|item| match wanted.sub {
        Some(sub) => item.sub == sub,
        None => item.access.read,
    });
    let known: Vec<Part> = items
        .map(|item| {
            let at = NamedObject {
                index,
                sub: item.sub,
            };
            (at, name_of(object, item), Some(type_of(item)))
        })
        .collect();
    match known.is_empty() {
        true => vec![nameless(wanted.sub.unwrap_or(0))],
        false => known,
    }
}

/// Reads by complete access and splits the data according to the dictionary.
async fn whole(
    open: &mut Open<'_>,
    wanted: ObjectQuery,
    object: Option<&Object>,
    data_type: Option<DataType>,
) -> Result<Vec<Read>, Failure> {
    let index = wanted.index;
    let first = wanted.sub.unwrap_or(0);
    let read = open.coe.upload(&open.at.wire, index, first, true).await;
    let bytes = open.at.sdo_error(read)?;
    let at = NamedObject { index, sub: first };
    let Some(object) = object.filter(|object| object.items.len() > 1 && data_type.is_none()) else {
        let name = object
            .map(|object| object.name.to_string())
            .unwrap_or_default();
        return Ok(vec![(at, name, data_type, Ok(bytes))]);
    };
    // Subindex 0 occupies 16 bits.
    let start = if first == 0 { 0 } else { 16 };
    let items = object.items.iter().filter(|item| item.sub >= first);
    let known = items.map_while(|item| {
        let from = usize::try_from(item.bit_offset.checked_sub(start)?).ok()?;
        let value = bits(&bytes, from, usize::try_from(item.bit_len).ok()?)?;
        let at = NamedObject {
            index,
            sub: item.sub,
        };
        Some((at, name_of(object, item), Some(type_of(item)), Ok(value)))
    });
    Ok(known.collect())
}

/// Returns `len` bits starting at bit `from`; `None` beyond the end.
fn bits(bytes: &[u8], from: usize, len: usize) -> Option<Vec<u8>> {
    let end = from
        .checked_add(len)
        .filter(|end| *end <= bytes.len() * 8)?;
    let mut out = vec![0_u8; len.div_ceil(8)];
    for (n, at) in (from..end).enumerate() {
        let bit = bytes.get(at / 8)? >> (at % 8) & 1;
        *out.get_mut(n / 8)? |= bit << (n % 8);
    }
    Some(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bits_returns_a_bit_range() {
        let bytes = [0b1010_0110, 0xff, 0x01];
        assert_eq!(bits(&bytes, 1, 3), Some(vec![0b011]));
        assert_eq!(bits(&bytes, 4, 12), Some(vec![0xfa, 0x0f]));
        assert_eq!(bits(&bytes, 8, 16), Some(vec![0xff, 0x01]));
        assert_eq!(bits(&bytes, 20, 5), None);
        assert_eq!(bits(&bytes, usize::MAX, 2), None);
    }

    #[test]
    fn hex_keeps_leading_zeros() {
        let ty = |name: &str| DataType::named(name, 0).expect("a type");
        assert_eq!(hex(ty("UINT"), &[0x50, 2]).as_deref(), Some("0x0250"));
        assert_eq!(hex(ty("SINT"), &[0xfe]).as_deref(), Some("0xfe"));
        assert_eq!(hex(ty("BOOL"), &[1]), None);
        assert_eq!(hex(ty("REAL"), &[0; 4]), None);
        assert_eq!(hex(ty("UINT"), &[0; 4]), None);
    }
}
