//! `ecaxis firmware update`: another program for a device.

use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::time::{Duration, Instant};

use clap::ValueEnum;
use ecaxis::firmware::{self, Done, Examined, Order, ReadBack, Step, Told, Via};
use indicatif::{ProgressBar, ProgressStyle};
use serde_json::{Value, json};

use super::show;
use super::target::{self, Where};
use crate::cli::esi::number;
use crate::cli::{Failure, bus, hints, note, result, screen, style};

/// No program memory of a drive is larger.
const MOST: u64 = 256 << 20;
/// Where lines stay, one a so many percent.
const PERCENT: usize = 10;
/// A pause is worth no line of its own, a wait is.
const BUSY: Duration = Duration::from_secs(1);

const EXAMPLES: &str = "\
Examples:
  ecaxis firmware update m.toml x new.msdc --dry-run
  ecaxis firmware update m.toml x new.msdc --yes
  ecaxis firmware update m.toml x new.msdc --via program --yes
  ecaxis firmware update --nic enp3s0 --position 0 app.bin --name app --yes";

const USAGE: &str = "\
ecaxis firmware update [OPTIONS] <MACHINE> <DEVICE> <FILE>
       ecaxis firmware update [OPTIONS] --nic <IF> --position <N> <FILE>";

/// Put another program into a device and start it
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES, override_usage = USAGE)]
pub(crate) struct Args {
    /// Machine file and the device's name in it, or neither; then the firmware file
    #[arg(value_names = ["MACHINE", "DEVICE", "FILE"], num_args = 1..=3, required = true)]
    words: Vec<String>,
    #[command(flatten)]
    at: Where,
    /// The way [default: FoE, where the device offers it]
    #[arg(long, value_enum)]
    via: Option<Way>,
    /// What the file is called over FoE [default: its own name]
    #[arg(long, value_name = "NAME")]
    name: Option<String>,
    /// Password over FoE
    #[arg(long, value_name = "N", default_value = "0", value_parser = number)]
    password: u32,
    /// Vendor that the device must have [default: the machine file's]
    #[arg(long, value_name = "N", value_parser = number)]
    expect_vendor: Option<u32>,
    /// Product code that the device must have [default: the machine file's]
    #[arg(long, value_name = "N", value_parser = number)]
    expect_product: Option<u32>,
    /// Read the file back over FoE and compare it, where the device hands it out
    #[arg(long)]
    read_back: bool,
    /// Check everything and write nothing
    #[arg(long)]
    dry_run: bool,
    /// Write; without it nothing is written
    #[arg(long, conflicts_with = "dry_run")]
    yes: bool,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Way {
    /// File access in Bootstrap
    Foe,
    /// Program download by 0x1F50 and 0x1F51 (CiA 302-3)
    Program,
}

impl From<Way> for Via {
    fn from(way: Way) -> Self {
        match way {
            Way::Foe => Self::Foe,
            Way::Program => Self::Program,
        }
    }
}

/// What the bus was visited for.
struct Visited {
    before: Examined,
    via: Via,
    /// `None` where nothing was to be written.
    done: Option<Done>,
}

pub(crate) fn run(args: &Args, plain: bool) -> Result<(), Failure> {
    match update(args, plain) {
        Err(failure) if args.json => {
            let report = json!({
                "ok": false, "error": failure.message, "hints": failure.hints,
            });
            result(&format!("{report:#}\n"))?;
            Err(failure)
        }
        done => done,
    }
}

fn update(args: &Args, plain: bool) -> Result<(), Failure> {
    let Some((path, words)) = args.words.split_last() else {
        return Err(target::wrong("the firmware file is missing"));
    };
    let path = PathBuf::from(path);
    let input = (path.as_path(), "the firmware file");
    let mut target = args.at.target(words, Some(input))?;
    target.expected.vendor = args.expect_vendor.or(target.expected.vendor);
    target.expected.product = args.expect_product.or(target.expected.product);
    let file = read(&path)?;
    let bytes = file.len();
    let name = match &args.name {
        Some(name) => name.clone(),
        None => path
            .file_name()
            .map(|name| name.to_string_lossy().into_owned())
            .unwrap_or_default(),
    };
    let (which, expected, nic) = (target.which, target.expected, target.nic());
    let device = target.name.clone();
    let chosen = args.via.map(Via::from);
    let (password, read_back, write) = (args.password, args.read_back, args.yes);
    let teller = Teller::new(plain);
    let target = if write { target.alone() } else { target };
    let visited = target.visit(async move |wire, others| {
        if others > 0 && write {
            return Err(hints::shared_bus());
        }
        bus::warn_of(others);
        let visited = async {
            let before = firmware::examine(&wire, which, &device).await?;
            let via = before.way(chosen)?;
            let order = Order {
                via,
                file,
                name,
                password,
                read_back,
            };
            before.ready(&order, expected)?;
            let done = if write {
                let mut tell = |told| teller.tell(&told);
                Some(firmware::update(&wire, &before, expected, &order, &mut tell).await?)
            } else {
                None
            };
            Ok(Visited { before, via, done })
        };
        visited.await.map_err(|error| hints::firmware(&error, &nic))
    })?;
    let visited = visited?;
    let Some(done) = &visited.done else {
        result(&if args.json {
            format!("{:#}\n", planned_json(&visited, bytes, &path))
        } else {
            planned(&visited, bytes, &path)
        })?;
        return if args.dry_run {
            Ok(())
        } else {
            Err(target::wrong("nothing was written")
                .hint("add `--yes` to write it, or `--dry-run` where this was all you wanted"))
        };
    };
    result(&if args.json {
        format!("{:#}\n", done_json(&visited, done, bytes))
    } else {
        done_text(&visited, done, bytes)
    })
}

fn read(path: &Path) -> Result<Vec<u8>, Failure> {
    let failed = |why: String| target::wrong(&format!("cannot read {}: {why}", path.display()));
    let file = ecaxis::file::read(path, MOST).map_err(|e| failed(e.to_string()))?;
    if file.is_empty() {
        return Err(target::wrong(&format!("{} is empty", path.display()))
            .hint("name the file that the device's maker made for it"));
    }
    Ok(file)
}

fn planned(visited: &Visited, bytes: usize, path: &Path) -> String {
    format!(
        "{}{} ({bytes} bytes) would be written by {}.\n",
        show::info(&visited.before),
        path.display(),
        visited.via
    )
}

fn planned_json(visited: &Visited, bytes: usize, path: &Path) -> Value {
    json!({
        "ok": true,
        "written": false,
        "file": path.display().to_string(),
        "bytes": bytes,
        "via": show::name(visited.via),
        "before": show::as_json(&visited.before),
    })
}

fn done_text(visited: &Visited, done: &Done, bytes: usize) -> String {
    let Visited { before, via, .. } = visited;
    let mut text = format!(
        "{}: {bytes} bytes in {:.1} s, {}, by {via}\n{}",
        done.after.device,
        done.took.as_secs_f64(),
        rate(bytes, done.took),
        show::change(before, &done.after),
    );
    text += &match &done.read_back {
        ReadBack::NotAsked => String::new(),
        ReadBack::Same => "The device holds the file byte for byte.\n".to_owned(),
        ReadBack::Refused(why) => format!("The file was not read back: {why}\n"),
    };
    text += &format!("It {} and is in {}.\n", done.after.runs(), done.after.state);
    text
}

fn done_json(visited: &Visited, done: &Done, bytes: usize) -> Value {
    json!({
        "ok": true,
        "written": true,
        "bytes": bytes,
        "seconds": done.took.as_secs_f64(),
        "via": show::name(visited.via),
        "read_back": match &done.read_back {
            ReadBack::NotAsked => Value::Null,
            ReadBack::Same => "same".into(),
            ReadBack::Refused(_) => "refused".into(),
        },
        "before": show::as_json(&visited.before),
        "after": show::as_json(&done.after),
    })
}

fn rate(bytes: usize, took: Duration) -> String {
    let kibibytes = bytes as f64 / 1024.0;
    match took.as_secs_f64() {
        seconds if seconds > 0.0 => format!("{:.1} KiB/s", kibibytes / seconds),
        _ => "at once".to_owned(),
    }
}

/// Progress on stderr: a bar on a terminal, lines elsewhere.
struct Teller {
    bar: Option<ProgressBar>,
    said: Mutex<Said>,
}

#[derive(Default)]
struct Said {
    percent: Option<usize>,
    /// Since when the device has been busy, or since that was said last.
    busy: Option<Instant>,
}

impl Teller {
    fn new(plain: bool) -> Self {
        let bar = (style::rewrites() && !plain).then(|| {
            let bar = ProgressBar::new(0);
            let template =
                "{msg} {bar:20} {percent:>3} %  {bytes} of {total_bytes}, {bytes_per_sec}";
            let style = ProgressStyle::with_template(template);
            let bar = bar.with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
            screen::put_up(&bar);
            bar
        });
        Self {
            bar,
            said: Mutex::default(),
        }
    }

    fn tell(&self, told: &Told) {
        let Ok(mut said) = self.said.lock() else {
            return;
        };
        match (told, &self.bar) {
            (Told::Step(step), Some(bar)) => {
                note(&step.to_string());
                bar.set_message("");
            }
            (Told::Step(step), None) => note(&step.to_string()),
            (Told::Moved { done, of }, Some(bar)) => {
                let number = |n: usize| u64::try_from(n).unwrap_or(u64::MAX);
                if bar.length() != Some(number(*of)) {
                    bar.set_length(number(*of));
                }
                bar.set_message("");
                bar.set_position(number(*done));
            }
            (Told::Moved { done, of }, None) => {
                let percent = (done * 100).checked_div(*of).unwrap_or(100);
                let step = percent / PERCENT * PERCENT;
                if said.percent != Some(step) {
                    note(&format!("  {percent:>3} %, {done} of {of} bytes"));
                    said.percent = Some(step);
                }
            }
            (Told::Busy { .. }, Some(bar)) => bar.set_message("busy"),
            (Told::Busy { done, entire }, None) => {
                let since = said.busy.get_or_insert_with(Instant::now);
                if since.elapsed() >= BUSY {
                    *since = Instant::now();
                    note(&format!("  the device is busy: {done} of {entire} done"));
                }
            }
        }
        if !matches!(told, Told::Busy { .. }) {
            said.busy = None;
        }
        if matches!(told, Told::Step(Step::Check)) {
            self.clear();
        }
    }

    fn clear(&self) {
        screen::take_down();
    }
}

impl Drop for Teller {
    fn drop(&mut self) {
        self.clear();
    }
}
