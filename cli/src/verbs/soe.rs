//! `ecaxis soe`: reads and writes the IDNs of a Sercos drive, and executes its procedure commands.

use std::time::Duration;

use clap::Subcommand;
use ecaxis_ecat::mailbox::soe::{
    Attribute, DataLength, DataState, Display, Element, Idn, List, format_value, parse_value,
};
use ecaxis_master::config::duration;
use ecaxis_master::mailbox::{IdnElement, MailboxTransport, SdoError};
use ecaxis_master::report::Cause;
use ecaxis_tools::cells;
use ecaxis_tools::document::Table;
use ecaxis_tools::document::format::hex_bytes;
use serde_json::{Value, json};

use crate::access::device::{DeviceArgs, Open, no_more};
use crate::args::Verbosity;
use crate::hints::{self, Failure};
use crate::render::{note, print_json, print_table, shown};

const EXAMPLES: &str = "\
Examples:
  ecaxis soe read machine.toml x S-0-0051 S-0-0091
  ecaxis soe read machine.toml x S-0-0011 S-0-0095 S-0-0390
  ecaxis soe write machine.toml x S-0-0091 1500.5
  ecaxis soe write machine.toml x P-0-0100 \"1, 2, 3\"     a list
  ecaxis soe list --nic enp3s0 --position 0 --drive 1
  ecaxis soe command machine.toml x S-0-0099             clear the errors

Values follow the attribute that the drive reports: decimal places, lists,
texts, IDNs, hexadecimal (0x10) and binary (0b1011) numbers.";

const READ_EXAMPLES: &str = "\
Examples:
  ecaxis soe read machine.toml x S-0-0051 S-0-0091
  ecaxis soe read --nic enp3s0 --position 0 S-0-0011 --json";

const WRITE_EXAMPLES: &str = "\
Examples:
  ecaxis soe write machine.toml x S-0-0091 1500.5
  ecaxis soe write machine.toml x P-0-0100 \"1, 2, 3\"     a list";

const LIST_EXAMPLES: &str = "\
Examples:
  ecaxis soe list machine.toml x
  ecaxis soe list --nic enp3s0 --position 0 --drive 1";

const COMMAND_EXAMPLES: &str = "\
Examples:
  ecaxis soe command machine.toml x S-0-0099             clear the errors
  ecaxis soe command machine.toml x S-0-0264 --timeout 30s";

/// Read and write the IDNs of a Sercos drive (SoE), execute procedure commands
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
    /// Read IDNs with name, unit, limits and attribute
    #[command(after_help = READ_EXAMPLES, override_usage = "ecaxis soe read FILE DEVICE IDN...\n       \
        ecaxis soe read --nic IF --position N IDN...")]
    Read(Common),
    /// Write the value of an IDN; it is read back
    #[command(after_help = WRITE_EXAMPLES, override_usage = "ecaxis soe write FILE DEVICE IDN VALUE\n       \
        ecaxis soe write --nic IF --position N IDN VALUE")]
    Write(Common),
    /// List the IDNs of a drive (S-0-0017) with names and values
    #[command(after_help = LIST_EXAMPLES, override_usage = "ecaxis soe list FILE DEVICE\n       \
        ecaxis soe list --nic IF --position N")]
    List(Common),
    /// Execute a procedure command and wait for its end
    #[command(
        name = "command",
        after_help = COMMAND_EXAMPLES,
        override_usage = "ecaxis soe command FILE DEVICE IDN\n       \
        ecaxis soe command --nic IF --position N IDN"
    )]
    Execute(CommandArgs),
}

#[derive(Debug, clap::Args)]
struct Common {
    /// Machine file, device, and IDNs or IDN and value
    #[arg(value_name = "WORD", allow_negative_numbers = true)]
    words: Vec<String>,
    /// Drive of the device, from 0
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u8).range(0..=7))]
    drive: u8,
    #[command(flatten)]
    place: DeviceArgs,
    /// Print as JSON
    #[arg(long)]
    json: bool,
}

#[derive(Debug, clap::Args)]
struct CommandArgs {
    /// The time within which the drive executes the command
    #[arg(long, value_name = "TIME", default_value = "10s", value_parser = duration::parse)]
    timeout: u64,
    #[command(flatten)]
    common: Common,
}

impl Args {
    /// True if the subcommand may change a device.
    pub fn changes(&self) -> bool {
        matches!(self.command, Command::Write(_) | Command::Execute(_))
    }
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    match &args.command {
        Command::Read(args) => read(args),
        Command::Write(args) => write(args),
        Command::List(args) => list(args),
        Command::Execute(args) => command(args),
    }
}

/// What a drive says about one IDN.
struct Parameter {
    idn: Idn,
    name: String,
    attribute: Attribute,
    unit: String,
    range: [Option<String>; 2],
    /// The data state; only of procedure commands.
    state: Option<DataState>,
    /// The value, or the code with which the drive refuses it.
    value: Result<Vec<u8>, u16>,
}

impl Parameter {
    /// Reads the elements one by one; a drive has not all of them for each IDN.
    async fn read(open: &mut Open<'_>, at: IdnElement) -> Result<Self, Failure> {
        let attribute = element(open, at.with(Element::Attribute)).await?;
        let attribute = attribute.map_err(|code| refused(open, at, code))?;
        let attribute = attribute.first_chunk().map(|b| u32::from_le_bytes(*b));
        let attribute = Attribute(attribute.unwrap_or(0));
        let name = text(element(open, at.with(Element::Name)).await?);
        let unit = text(element(open, at.with(Element::Unit)).await?);
        let one = single(attribute);
        let mut range = [None, None];
        let mut state = None;
        if attribute.is_command() {
            let bytes = element(open, at.with(Element::DataState)).await?;
            let bytes = bytes.ok().and_then(|bytes| bytes.first_chunk().copied());
            state = bytes.map(|bytes| DataState(u16::from_le_bytes(bytes)));
        } else {
            for (limit, of) in range.iter_mut().zip([Element::Minimum, Element::Maximum]) {
                let found = element(open, at.with(of)).await?;
                *limit = found.ok().map(|bytes| format_value(one, &bytes));
            }
        }
        Ok(Self {
            idn: at.idn,
            name: match name.as_str() {
                "" => at.idn.name().unwrap_or_default().to_owned(),
                _ => name,
            },
            attribute,
            unit,
            range,
            state,
            value: element(open, at).await?,
        })
    }

    fn shown(&self) -> String {
        match (&self.value, self.state) {
            (_, Some(state)) => state.command().to_string(),
            (Ok(bytes), None) => format_value(self.attribute, bytes),
            (Err(code), None) => {
                let text = ecaxis_ecat::mailbox::soe::soe_error_text(*code);
                format!("refused with {code:#06x}: {text}")
            }
        }
    }

    fn as_json(&self) -> Value {
        json!({
            "idn": self.idn.to_string(), "name": self.name, "unit": self.unit,
            "attribute": self.attribute.0, "attribute_text": self.attribute.to_string(),
            "minimum": self.range[0], "maximum": self.range[1],
            "value": self.value.is_ok().then(|| self.shown()),
            "hex": self.value.as_ref().ok().map(|bytes| hex_bytes(bytes.iter(), " ")),
            "error": self.value.as_ref().err(),
        })
    }
}

/// Returns the attribute of one element of a list: limits have it.
fn single(attribute: Attribute) -> Attribute {
    match attribute.length() {
        DataLength::List(width @ 2..) => {
            let one = Attribute::new(DataLength::Fixed(width), attribute.display());
            Attribute(one.0 | u32::from(attribute.decimals()) << 24)
        }
        _ => attribute,
    }
}

/// Reads an element; the error code of the drive if it refuses.
async fn element(open: &mut Open<'_>, at: IdnElement) -> Result<Result<Vec<u8>, u16>, Failure> {
    match open.coe.read_idn(&open.at.wire, at).await {
        Ok(bytes) => Ok(Ok(bytes)),
        Err(error) => match error.soe_code() {
            Some(code) => Ok(Err(code)),
            None => Err(failure(open, error)),
        },
    }
}

fn failure(open: &Open<'_>, error: SdoError) -> Failure {
    let failed: Result<(), _> = Err(Cause::Sdo(error).with_device(&open.at.device));
    match open.at.map_error(failed) {
        Err(failure) => failure,
        Ok(()) => Failure::new(hints::FAILED, "no answer"),
    }
}

fn refused(open: &Open<'_>, at: IdnElement, code: u16) -> Failure {
    failure(
        open,
        SdoError {
            station: open.at.device.station,
            asked: ecaxis_master::mailbox::Subject::Idn(at),
            cause: ecaxis_master::mailbox::CoeCause::Soe(code),
        },
    )
}

fn text(bytes: Result<Vec<u8>, u16>) -> String {
    let text = Attribute::new(DataLength::List(1), Display::Text);
    let bytes = bytes.unwrap_or_default();
    List::parse(&bytes).map_or(String::new(), |_| format_value(text, &bytes))
}

fn parse(word: &str) -> Result<Idn, Failure> {
    word.parse().map_err(|_| {
        Failure::new(hints::WRONG, format!("`{word}` is not an IDN"))
            .hint("write it as S-0-0047 or P-0-0150; `ecaxis soe list` shows those of the drive")
    })
}

fn read(args: &Common) -> Result<(), Failure> {
    let (target, words) = args.place.take(&args.words, "IDNs")?;
    if words.is_empty() {
        return Err(Failure::new(hints::WRONG, "which IDN?").hint("for example S-0-0051"));
    }
    let idns = words.iter().map(|word| parse(word));
    let idns = idns.collect::<Result<Vec<_>, _>>()?;
    let drive = args.drive;
    let all = target.open("reading IDNs", async move |open: &mut Open<'_>| {
        let mut all = Vec::new();
        for idn in idns {
            all.push(Parameter::read(open, IdnElement::value(drive, idn)).await?);
        }
        Ok(all)
    })?;
    if args.json {
        return print_json(&all.iter().map(Parameter::as_json).collect::<Value>());
    }
    if let [one] = all.as_slice() {
        return shown(&line(one));
    }
    table(&all)
}

fn line(one: &Parameter) -> String {
    let unit = if one.unit.is_empty() {
        String::new()
    } else {
        format!(" {}", one.unit)
    };
    let range = match &one.range {
        [Some(low), Some(high)] => format!(", {low} to {high}{unit}"),
        _ => String::new(),
    };
    let value = one.shown();
    let attribute = one.attribute;
    format!(
        "{} {} = {value}{unit} ({attribute}{range})\n",
        one.idn, one.name
    )
}

fn table(all: &[Parameter]) -> Result<(), Failure> {
    /// Longer values are cut.
    const WIDTH: usize = 48;
    let mut table = Table::new("IDN|value|unit|minimum|maximum|name|attribute");
    for one in all {
        let mut value = one.shown();
        if value.chars().count() > WIDTH {
            value = value.chars().take(WIDTH).chain(['…']).collect();
        }
        let [low, high] = one.range.clone().map(Option::unwrap_or_default);
        table.row(cells![
            one.idn,
            value,
            one.unit,
            low,
            high,
            one.name,
            one.attribute
        ]);
    }
    print_table(&table)
}

fn write(args: &Common) -> Result<(), Failure> {
    let (target, words) = args.place.take(&args.words, "an IDN and its value")?;
    let [idn, value] = words else {
        return Err(Failure::new(hints::WRONG, "one IDN and one value")
            .hint("a list or a text of several words goes in quotes"));
    };
    let at = IdnElement::value(args.drive, parse(idn)?);
    let value = value.clone();
    let (written, one) = target.open("writing an IDN", async move |open: &mut Open<'_>| {
        let before = Parameter::read(open, at).await?;
        if before.attribute.is_command() {
            let message = format!("{} is a procedure command", at.idn.named());
            return Err(Failure::new(hints::WRONG, message)
                .hint(format!("`ecaxis soe command … {}` executes it", at.idn)));
        }
        let bytes = parse_value(before.attribute, &value)
            .map_err(|error| Failure::new(hints::WRONG, error.to_string()))?;
        let wire = &open.at.wire;
        let sent = open.coe.write_idn(wire, at, &bytes);
        // A started write is not cancelled.
        let sent = wire.stop().shield(sent).await;
        sent.map_err(|error| failure(open, error))?;
        Ok((bytes, Parameter::read(open, at).await?))
    })?;
    let same = |now: &[u8]| match (List::parse(now), List::parse(&written)) {
        (Some(now), Some(written)) => now.data == written.data,
        _ => false,
    };
    if let Ok(now) = &one.value
        && *now != written
        && !same(now)
    {
        note(&format!(
            "warning: {} reads back as {}",
            one.idn,
            one.shown()
        ));
    }
    match args.json {
        true => print_json(&one.as_json()),
        false => shown(&line(&one)),
    }
}

fn list(args: &Common) -> Result<(), Failure> {
    let (target, rest) = args.place.take(&args.words, "nothing else")?;
    no_more(rest)?;
    let drive = args.drive;
    let all = target.open("reading IDNs", async move |open: &mut Open<'_>| {
        let at = IdnElement::value(drive, Idn::ALL_IDNS);
        let list = element(open, at).await?;
        let list = list.map_err(|code| refused(open, at, code))?;
        let list = List::parse(&list).map_or(&[][..], |list| list.data);
        let mut all = Vec::new();
        for idn in list.chunks_exact(2) {
            let idn = Idn(idn
                .iter()
                .rev()
                .fold(0, |n, byte| n << 8 | u16::from(*byte)));
            all.push(Parameter::read(open, IdnElement::value(drive, idn)).await?);
        }
        Ok(all)
    })?;
    if args.json {
        return print_json(&all.iter().map(Parameter::as_json).collect::<Value>());
    }
    table(&all)
}

fn command(args: &CommandArgs) -> Result<(), Failure> {
    let (target, words) = args.common.place.take(&args.common.words, "an IDN")?;
    let [idn] = words else {
        return Err(Failure::new(hints::WRONG, "one procedure command").hint("such as S-0-0099"));
    };
    let (drive, idn) = (args.common.drive, parse(idn)?);
    let timeout = Duration::from_nanos(args.timeout);
    target.open(
        "executing a procedure command",
        async move |open: &mut Open<'_>| {
            let executed = open
                .coe
                .execute_command(&open.at.wire, (drive, idn), timeout);
            executed.await.map_err(|error| failure(open, error))
        },
    )?;
    let named = idn.named().to_string();
    match args.common.json {
        true => print_json(&json!({ "idn": idn.to_string(), "state": "executed" })),
        false => shown(&format!("{named}: executed\n")),
    }
}
