//! `ecaxis firmware update`: writes a program to a device.

use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::time::{Duration, Instant};

use clap::ValueEnum;
use ecaxis_master::change_log::ChangeLog;
use ecaxis_master::file_digest::UsedFile;
use ecaxis_master::signature::{SignaturePolicy, SignedKind};
use ecaxis_tools::document::Document;
use ecaxis_tools::firmware::{
    self, DeviceIdentity, Expected, ReadBack, UpdateMethod, UpdateProgress, UpdateReport,
    UpdateRequest, UpdateStep,
};
use indicatif::{ProgressBar, ProgressStyle};
use serde_json::{Value, json};

use super::{TargetArgs, show, wrong};
use crate::access::device::Target;
use crate::access::{bus, change_log};
use crate::args::numbers::number;
use crate::hints::{self, Failure};
use crate::render::{note, output, print, print_json, style};

/// The maximum file size in bytes.
const MOST: u64 = 256 << 20;
/// The progress step in percent without a terminal.
const PERCENT: usize = 10;
/// A busy device is reported after this time; shorter pauses are not.
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

/// Write a program to a device and start it
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES, override_usage = USAGE)]
pub(crate) struct Args {
    /// Machine file and the device's name in it, or neither; then the firmware file
    #[arg(value_names = ["MACHINE", "DEVICE", "FILE"], num_args = 1..=3, required = true)]
    words: Vec<String>,
    #[command(flatten)]
    at: TargetArgs,
    /// Update method [default: FoE, if the device supports it]
    #[arg(long, value_enum)]
    via: Option<MethodArg>,
    /// File name for FoE [default: the name of the file]
    #[arg(long, value_name = "NAME")]
    name: Option<String>,
    /// Password for FoE
    #[arg(long, value_name = "N", default_value = "0", value_parser = number)]
    password: u32,
    /// Required vendor of the device [default: the machine file's]
    #[arg(long, value_name = "N", value_parser = number)]
    expect_vendor: Option<u32>,
    /// Required product code of the device [default: the machine file's]
    #[arg(long, value_name = "N", value_parser = number)]
    expect_product: Option<u32>,
    /// Read the file back over FoE and compare it, if the device supports it
    #[arg(long)]
    read_back: bool,
    /// Run all checks, but write nothing
    #[arg(long)]
    dry_run: bool,
    /// Confirm writing; without it nothing is written
    #[arg(long, conflicts_with = "dry_run")]
    yes: bool,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum MethodArg {
    /// File access over EtherCAT (FoE) in Bootstrap
    Foe,
    /// Program download with 0x1F50 and 0x1F51 (CiA 302-3)
    Program,
}

impl From<MethodArg> for UpdateMethod {
    fn from(way: MethodArg) -> Self {
        match way {
            MethodArg::Foe => Self::Foe,
            MethodArg::Program => Self::Program,
        }
    }
}

/// The result of the visit.
struct UpdateOutcome {
    before: DeviceIdentity,
    via: UpdateMethod,
    /// `None` if nothing was to be written.
    done: Option<UpdateReport>,
}

pub(crate) fn run(args: &Args, plain: bool) -> Result<(), Failure> {
    match update(args, plain) {
        Err(failure) if args.json => {
            let report = json!({
                "ok": false, "error": failure.message, "hints": failure.hints,
            });
            print_json(&report)?;
            Err(failure)
        }
        done => done,
    }
}

fn update(args: &Args, plain: bool) -> Result<(), Failure> {
    let (target, rest) = args.at.device.take(&args.words, "a firmware file")?;
    let [path] = rest else {
        return Err(wrong("which file? One firmware file after the device"));
    };
    let path = PathBuf::from(path);
    let Target {
        bus, at, config, ..
    } = args.at.set_up(target, Some(&path))?;
    let identity = config.as_ref().map(|config| config.device.identity);
    let expected = Expected {
        vendor: args.expect_vendor.or(identity.map(|i| i.vendor)),
        product: args.expect_product.or(identity.map(|i| i.product)),
    };
    let (file, used) = read(&path)?;
    let bytes = file.len();
    let name = match &args.name {
        Some(name) => name.clone(),
        None => path
            .file_name()
            .map(|name| name.to_string_lossy().into_owned())
            .unwrap_or_default(),
    };
    let nic = bus.nic();
    let chosen = args.via.map(UpdateMethod::from);
    let (password, read_back, write) = (args.password, args.read_back, args.yes);
    let teller = ProgressReporter::new(plain);
    let bus = if write { bus.alone() } else { bus };
    if let Some(log) = ChangeLog::of_environment().filter(|_| write) {
        change_log::append_file(&log, &used);
    }
    let visited = bus.visit(async move |wire, others| {
        if others > 0 && write {
            return Err(hints::shared_bus());
        }
        bus::warn_foreign_frames(others);
        let visited = async {
            let device = config.as_ref().map(|config| config.name.as_str());
            let before = firmware::examine(&wire, at, device).await?;
            let via = before.way(chosen)?;
            let order = UpdateRequest {
                via,
                file,
                name,
                password,
                read_back,
            };
            before.ready(&order, expected)?;
            let done = if write {
                let mut report = |reported| teller.report(&reported);
                Some(firmware::update(&wire, &before, expected, &order, &mut report).await?)
            } else {
                None
            };
            Ok(UpdateOutcome { before, via, done })
        };
        visited.await.map_err(|error| hints::firmware(&error, &nic))
    })?;
    let visited = visited?;
    let Some(done) = &visited.done else {
        match args.json {
            true => print_json(&planned_json(&visited, bytes, &path))?,
            false => print(&planned(&visited, bytes, &path))?,
        }
        return if args.dry_run {
            Ok(())
        } else {
            Err(wrong("nothing was written")
                .hint("add `--yes` to write it, or `--dry-run` where this was all you wanted"))
        };
    };
    match args.json {
        true => print_json(&done_json(&visited, done, bytes)),
        false => print(&done_text(&visited, done, bytes)),
    }
}

/// Reads the file and verifies its signature.
fn read(path: &Path) -> Result<(Vec<u8>, UsedFile), Failure> {
    let failed = |why: String| wrong(&format!("cannot read {}: {why}", path.display()));
    let file = ecaxis_master::file::read(path, MOST).map_err(|e| failed(e.to_string()))?;
    if file.is_empty() {
        return Err(wrong(&format!("{} is empty", path.display()))
            .hint("name a firmware file from the device's vendor"));
    }
    let policy = SignaturePolicy::of_environment();
    let policy = policy.map_err(|error| wrong(&error.to_string()).hint(hints::POLICY))?;
    let used = policy.verify(SignedKind::Firmware, path, &file);
    let used = used.map_err(|error| wrong(&error.to_string()).hint(error.hint()))?;
    Ok((file, used))
}

fn planned(visited: &UpdateOutcome, bytes: usize, path: &Path) -> Document {
    let mut out = show::info(&visited.before);
    let (path, via) = (path.display(), visited.via);
    out.line(format!("{path} ({bytes} bytes) would be written by {via}."));
    out
}

fn planned_json(visited: &UpdateOutcome, bytes: usize, path: &Path) -> Value {
    json!({
        "ok": true,
        "written": false,
        "file": path.display().to_string(),
        "bytes": bytes,
        "via": show::name(visited.via),
        "before": show::as_json(&visited.before),
    })
}

fn done_text(visited: &UpdateOutcome, done: &UpdateReport, bytes: usize) -> Document {
    let UpdateOutcome { before, via, .. } = visited;
    let (device, seconds) = (&done.after.device, done.took.as_secs_f64());
    let rate = rate(bytes, done.took);
    let mut out = Document::new(format!(
        "{device}: {bytes} bytes in {seconds:.1} s, {rate}, by {via}"
    ));
    show::change(before, &done.after, &mut out);
    match &done.read_back {
        ReadBack::NotAsked => {}
        ReadBack::Same => out.line("The device holds the file byte for byte."),
        ReadBack::Refused(why) => out.line(format!("The file was not read back: {why}")),
    }
    let (runs, state) = (done.after.runs(), done.after.state);
    out.line(format!("It {runs} and is in {state}."));
    out
}

fn done_json(visited: &UpdateOutcome, done: &UpdateReport, bytes: usize) -> Value {
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

/// Shows progress on stderr: a bar on a terminal, otherwise lines.
struct ProgressReporter {
    bar: Option<ProgressBar>,
    said: Mutex<ProgressState>,
}

#[derive(Default)]
struct ProgressState {
    percent: Option<usize>,
    /// The start of the busy time, or the time of its last report.
    busy: Option<Instant>,
}

impl ProgressReporter {
    fn new(plain: bool) -> Self {
        let bar = (style::rewrites() && !plain).then(|| {
            let bar = ProgressBar::new(0);
            let template =
                "{msg} {bar:20} {percent:>3} %  {bytes} of {total_bytes}, {bytes_per_sec}";
            let style = ProgressStyle::with_template(template);
            let bar = bar.with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
            output::attach_bar(&bar);
            bar
        });
        Self {
            bar,
            said: Mutex::default(),
        }
    }

    fn report(&self, reported: &UpdateProgress) {
        let Ok(mut said) = self.said.lock() else {
            return;
        };
        match (reported, &self.bar) {
            (UpdateProgress::Step(step), Some(bar)) => {
                note(&step.to_string());
                bar.set_message("");
            }
            (UpdateProgress::Step(step), None) => note(&step.to_string()),
            (UpdateProgress::Moved { done, of }, Some(bar)) => {
                let number = |n: usize| u64::try_from(n).unwrap_or(u64::MAX);
                if bar.length() != Some(number(*of)) {
                    bar.set_length(number(*of));
                }
                bar.set_message("");
                bar.set_position(number(*done));
            }
            (UpdateProgress::Moved { done, of }, None) => {
                let percent = (done * 100).checked_div(*of).unwrap_or(100);
                let step = percent / PERCENT * PERCENT;
                if said.percent != Some(step) {
                    note(&format!("  {percent:>3} %, {done} of {of} bytes"));
                    said.percent = Some(step);
                }
            }
            (UpdateProgress::Busy { .. }, Some(bar)) => bar.set_message("busy"),
            (UpdateProgress::Busy { done, entire }, None) => {
                let since = said.busy.get_or_insert_with(Instant::now);
                if since.elapsed() >= BUSY {
                    *since = Instant::now();
                    note(&format!("  the device is busy: {done} of {entire} done"));
                }
            }
        }
        if !matches!(reported, UpdateProgress::Busy { .. }) {
            said.busy = None;
        }
        if matches!(reported, UpdateProgress::Step(UpdateStep::Check)) {
            self.clear();
        }
    }

    fn clear(&self) {
        output::detach_bar();
    }
}

impl Drop for ProgressReporter {
    fn drop(&mut self) {
        self.clear();
    }
}
