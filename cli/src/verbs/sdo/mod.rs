//! `ecaxis sdo`: reads, writes, lists, saves and restores the parameters of a device. One file per
//! subcommand.

use std::path::{Path, PathBuf};

use clap::Subcommand;
use ecaxis_esi::Dictionary;
use ecaxis_master::acyclic::parameters::compare::Difference;
use ecaxis_master::mailbox::{NamedObject, abort_text};
use ecaxis_master::parameters::dump::Dump;
use ecaxis_master::parameters::lookup::{FindError, ObjectQuery, find};
use ecaxis_tools::cells;
use ecaxis_tools::document::Table;
use ecaxis_tools::document::format::or_dash;
use serde_json::{Value, json};

use crate::access::device::{DeviceArgs, Target, address};
use crate::args::Verbosity;
use crate::hints::{self, Failure};
use crate::render::{print_table, shown};

mod command;
mod compare;
mod dump;
mod list;
mod read;
mod restore;
mod write;

const EXAMPLES: &str = "\
Examples:
  ecaxis sdo read machine.toml x Statusword 0x1018
  ecaxis sdo write machine.toml x 0x6065 2000
  ecaxis sdo list --nic enp3s0 --position 0
  ecaxis sdo dump machine.toml x x.toml       save all readable objects
  ecaxis sdo compare machine.toml x x.toml    print the differences
  ecaxis sdo restore machine.toml x x.toml    restore the settings
  ecaxis sdo store machine.toml x             store them in non-volatile memory

Values are decimal, hexadecimal (0x10), text, or bytes ([01 02]). An object is
a number (0x6065, 0x1018:01) or a name (Statusword, \"Identity: Vendor ID\").";

/// Read and write the parameters of a device, save and restore them
///
/// Select the device by machine file and name, or by --nic with --position, --alias or --id. Its
/// state is kept: a device in Init is in PreOp during the access, a device in Op stays in Op.
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
    Read(read::Args),
    Write(write::Args),
    List(list::Args),
    Dump(dump::Args),
    Compare(compare::Args),
    Restore(restore::Args),
    Store(command::StoreArgs),
    Defaults(command::DefaultsArgs),
}

impl Args {
    /// True if the subcommand may change a device.
    pub fn changes(&self) -> bool {
        use Command::{Defaults, Restore, Store, Write};
        matches!(self.command, Write(_) | Restore(_) | Store(_) | Defaults(_))
    }
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    match &args.command {
        Command::Read(args) => read::run(args),
        Command::Write(args) => write::run(args),
        Command::List(args) => list::run(args),
        Command::Dump(args) => dump::run(args),
        Command::Compare(args) => compare::run(args),
        Command::Restore(args) => restore::run(args),
        Command::Store(args) => command::store(args),
        Command::Defaults(args) => command::defaults(args),
    }
}

/// The options of every subcommand.
#[derive(Debug, Clone, clap::Args)]
struct Common {
    #[command(flatten)]
    place: DeviceArgs,
    /// ESI file or folder of the device, without a machine file
    #[arg(long, value_name = "PATH", requires = "nic")]
    esi: Option<PathBuf>,
    /// Read the object dictionary from the device (SDO Information), even if an ESI file describes
    /// it
    #[arg(long)]
    ask: bool,
    /// Print as JSON
    #[arg(long)]
    json: bool,
}

impl Common {
    /// As [`DeviceArgs::take`].
    fn take<'w>(&self, words: &'w [String], rest: &str) -> Result<(Target, &'w [String]), Failure> {
        let (target, rest) = self.place.take(words, rest)?;
        let esi = self.esi.clone();
        Ok((Target { esi, ..target }, rest))
    }
}

/// Parses an object given by number or name.
fn wanted(dictionary: Option<&Dictionary>, text: &str) -> Result<ObjectQuery, Failure> {
    find(dictionary, text).map_err(|error| {
        let failure = Failure::new(hints::WRONG, error.to_string());
        match error {
            FindError::Unknown {
                near: Some(near), ..
            } => failure.hint(format!("did you mean `{near}`?")),
            FindError::Unknown { .. } => failure
                .hint("`ecaxis sdo list` shows the names; a number such as 0x6041:00 always works"),
            FindError::Ambiguous { .. } => failure.hint(
                "give the number, or the object's name before its own: `Identity: Vendor ID`",
            ),
            FindError::Number(_) => failure,
        }
    })
}

/// Loads a parameter file.
fn load(path: &Path) -> Result<Dump, Failure> {
    /// The maximum size of a dump in bytes.
    const MAX_BYTES: u64 = 64 << 20;
    let shown = path.display();
    let wrong = |what: String| Failure::new(hints::WRONG, what);
    let text = ecaxis_master::file::read_text(path, MAX_BYTES);
    let text = text.map_err(|error| wrong(format!("cannot read {shown}: {error}")))?;
    Dump::parse(&text).map_err(|error| {
        wrong(format!("{shown}: {error}"))
            .hint("`ecaxis sdo dump` writes such files; `value` may be changed by hand")
    })
}

/// One value, printed alone or as a row of a table.
struct Line {
    at: NamedObject,
    name: String,
    data_type: String,
    /// The value as text, and in hexadecimal if it is a number; or the abort code.
    value: Result<(String, Option<String>), u32>,
    /// The text of a word or code.
    meaning: Option<String>,
}

/// Formats a value with its object in one line.
fn line_text(line: &Line) -> String {
    let name = match line.name.as_str() {
        "" => String::new(),
        name => format!(" {name}"),
    };
    let value = match &line.value {
        Ok((value, Some(hex))) => format!("{value} ({hex})"),
        Ok((value, None)) => value.clone(),
        Err(code) => refusal(*code),
    };
    let meaning = line.meaning.as_ref();
    let meaning = meaning.map_or(String::new(), |text| format!(": {text}"));
    format!(
        "{}{name} ({}) = {value}{meaning}",
        address(line.at),
        line.data_type
    )
}

fn print_lines(all: &[Line]) -> Result<(), Failure> {
    if let [line] = all {
        return shown(&(line_text(line) + "\n"));
    }
    let any = all.iter().any(|line| line.meaning.is_some());
    let mut table = match any {
        true => Table::new("object|type|value|hex|name|meaning"),
        false => Table::new("object|type|value|hex|name"),
    };
    for line in all {
        let (value, hex) = match &line.value {
            Ok((value, hex)) => (value.clone(), hex.clone().unwrap_or_default()),
            Err(code) => (refusal(*code), String::new()),
        };
        let row = cells![address(line.at), line.data_type, value, hex, line.name];
        let meaning = any.then(|| line.meaning.clone().unwrap_or_default());
        table.line(row.into_iter().chain(meaning).collect());
    }
    print_table(&table)
}

fn refusal(code: u32) -> String {
    format!("refused with {code:#010x}: {}", abort_text(code))
}

/// Prints the differences between two sides as a table.
fn print_differences(sides: [&str; 2], all: &[Difference]) -> Result<(), Failure> {
    if all.is_empty() {
        return Ok(());
    }
    // A file name may contain the separator of headings.
    let mut table = Table::default();
    let [left, right] = sides;
    table.row(cells!["object", left, right, "class", "name"]);
    for d in all {
        let side = |value: &Option<String>, meaning: &Option<String>| match (value, meaning) {
            (Some(value), Some(meaning)) => format!("{value}: {meaning}"),
            (value, _) => or_dash(value.as_ref()),
        };
        let [of_left, of_right] = &d.meanings;
        let (left, right) = (side(&d.left, of_left), side(&d.right, of_right));
        table.row(cells![address(d.at), left, right, d.class, d.name]);
    }
    print_table(&table)
}

fn as_json(all: &[Difference]) -> Value {
    let each = all.iter().map(|difference| {
        json!({
            "index": difference.at.index, "sub": difference.at.sub, "name": difference.name,
            "class": difference.class.name(),
            "left": difference.left, "right": difference.right,
            "left_text": difference.meanings[0], "right_text": difference.meanings[1],
        })
    });
    each.collect()
}
