//! Compares the reading of ESI files with lxml's tree builder, alternating in the same run. Also
//! measures peak memory, and the start of the program with a library of ESI files. On a shared
//! machine only the ratios are meaningful, best those of processor time.
//!
//! Files come from `ECAXIS_FIXTURES` or `../shared/fixtures`. lxml runs in the Python of
//! `ECAXIS_PYTHON`, else `python3`. Without lxml, only the times of ecaxis are printed.

#![allow(clippy::print_stdout, reason = "a benchmark prints its result")]

use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::time::{Duration, Instant};

use ecaxis_master::esi_library;
use rustix::time::{ClockId, clock_gettime};

const ROUNDS: usize = 21;
/// The argument that makes this process measure its peak memory for one file.
const PEAK: &str = "--peak-of";

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    if let Some(at) = arguments.iter().position(|a| a == PEAK) {
        return peak_of(Path::new(&arguments[at + 1]));
    }
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let fixtures = std::env::var_os("ECAXIS_FIXTURES")
        .map_or_else(|| root.join("../shared/fixtures"), PathBuf::from)
        .join("esi");
    let mut files = Vec::new();
    collect(&fixtures, &mut files);
    if files.is_empty() {
        println!(
            "skipped: no ESI files in {} (set ECAXIS_FIXTURES)",
            fixtures.display()
        );
        return;
    }
    files.sort_by_key(|(bytes, _)| std::cmp::Reverse(*bytes));
    let mut lxml = Lxml::start(&root.join("benches/esi_lxml.py"));
    against_lxml(&files[..files.len().min(6)], lxml.as_mut());
    memory(&files[..files.len().min(3)]);
    library_start(&fixtures, files.len());
}

fn collect(folder: &Path, files: &mut Vec<(u64, PathBuf)>) {
    for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
        let path = entry.path();
        if path.is_dir() {
            collect(&path, files);
        } else if path.extension().is_some_and(|e| e == "xml") {
            files.push((entry.metadata().map_or(0, |m| m.len()), path));
        }
    }
}

/// Measures both from the file's path to the result, without the release of the result.
fn against_lxml(files: &[(u64, PathBuf)], mut lxml: Option<&mut Lxml>) {
    println!("\nreading a file, median (least) of {ROUNDS} turns");
    println!(
        "{:<34} {:>8} {:>9} {:>15} {:>15} {:>12}",
        "file", "bytes", "time", "ecaxis, ms", "lxml, ms", "ratio"
    );
    for (bytes, path) in files {
        let (mut ours, mut theirs) = (Turns::default(), Turns::default());
        for _ in 0..ROUNDS {
            let (start, busy) = (Instant::now(), processor_time());
            let file = esi_library::load(path, &|_| true);
            ours.add(start.elapsed(), processor_time() - busy);
            drop(file);
            if let Some(lxml) = &mut lxml {
                let (clock, busy) = lxml.parse(path);
                theirs.add(clock, busy);
            }
        }
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let name: String = name.chars().take(34).collect();
        for (what, own, other) in [
            ("processor", &mut ours.busy, &mut theirs.busy),
            ("clock", &mut ours.clock, &mut theirs.clock),
        ] {
            let own = median(own);
            print!("{name:<34} {bytes:>8} {what:>9} {:>15}", shown(own));
            if other.is_empty() {
                println!(" {:>15} {:>12}", "-", "-");
                continue;
            }
            let other = median(other);
            let ratio = |a: Duration, b: Duration| a.as_secs_f64() / b.as_secs_f64();
            let ratios = (ratio(other.0, own.0), ratio(other.1, own.1));
            let ratios = format!("{:.2} ({:.2})", ratios.0, ratios.1);
            println!(" {:>15} {ratios:>12}", shown(other));
        }
    }
    if lxml.is_none() {
        println!("lxml is not here: set ECAXIS_PYTHON to a Python that has it (pip install lxml)");
    }
}

#[derive(Default)]
struct Turns {
    clock: Vec<Duration>,
    busy: Vec<Duration>,
}

impl Turns {
    fn add(&mut self, clock: Duration, busy: Duration) {
        self.clock.push(clock);
        self.busy.push(busy);
    }
}

/// Returns the processor time of this process, independent of other load.
fn processor_time() -> Duration {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    Duration::new(
        time.tv_sec.unsigned_abs(),
        time.tv_nsec.unsigned_abs() as u32,
    )
}

fn shown((median, least): (Duration, Duration)) -> String {
    let ms = |time: Duration| time.as_secs_f64() * 1e3;
    format!("{:.2} ({:.2})", ms(median), ms(least))
}

fn median(times: &mut [Duration]) -> (Duration, Duration) {
    times.sort();
    (times[times.len() / 2], times[0])
}

/// lxml in a separate process, so that neither side includes the other's interpreter or heap.
struct Lxml {
    _child: Child,
    orders: ChildStdin,
    answers: BufReader<ChildStdout>,
}

impl Lxml {
    fn start(script: &Path) -> Option<Self> {
        let python = std::env::var_os("ECAXIS_PYTHON").unwrap_or_else(|| "python3".into());
        let mut child = Command::new(python)
            .arg(script)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .ok()?;
        let orders = child.stdin.take()?;
        let mut answers = BufReader::new(child.stdout.take()?);
        let mut version = String::new();
        answers.read_line(&mut version).ok()?;
        if version.is_empty() {
            return None;
        }
        println!("against {}", version.trim());
        Some(Self {
            _child: child,
            orders,
            answers,
        })
    }

    /// Returns wall-clock time and processor time.
    fn parse(&mut self, path: &Path) -> (Duration, Duration) {
        writeln!(self.orders, "{}", path.display()).expect("lxml still listens");
        let mut answer = String::new();
        self.answers.read_line(&mut answer).expect("lxml answers");
        let mut times = answer
            .split_whitespace()
            .map(|nanoseconds| Duration::from_nanos(nanoseconds.parse().expect("nanoseconds")));
        let mut next = || times.next().expect("two times");
        (next(), next())
    }
}

/// Prints the peak memory of a process that only loads one file.
fn memory(files: &[(u64, PathBuf)]) {
    println!("\npeak of memory while a file is loaded, in a process of its own");
    for (bytes, path) in files {
        let output = Command::new(std::env::current_exe().expect("this program"))
            .arg(PEAK)
            .arg(path)
            .output()
            .expect("this program runs");
        let text = String::from_utf8_lossy(&output.stdout);
        let kib: u64 = text.trim().parse().expect("KiB");
        println!(
            "{:<44} {:>6.1} MB, {:.1} times the file",
            path.file_name().unwrap_or_default().to_string_lossy(),
            kib as f64 * 1024.0 / 1e6,
            kib as f64 * 1024.0 / *bytes as f64
        );
    }
}

fn peak_of(path: &Path) {
    let file = esi_library::load(path, &|_| true).expect("a fixture");
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let peak = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    let kib = peak.map_or("", |rest| rest.trim().trim_end_matches(" kB"));
    println!("{kib}");
    drop(file);
}

/// Compares the whole program with every file in its library to the same program with an empty
/// folder.
fn library_start(fixtures: &Path, count: usize) {
    let cache = tempfile::tempdir().expect("a temporary folder");
    let empty = tempfile::tempdir().expect("a temporary folder");
    let list = |folder: &Path| {
        let start = Instant::now();
        let output = Command::new(env!("CARGO_BIN_EXE_ecaxis"))
            .args(["esi", "list", "--json"])
            .arg(folder)
            .env("XDG_CACHE_HOME", cache.path())
            .output()
            .expect("the program runs");
        assert!(output.status.success(), "{output:?}");
        start.elapsed()
    };
    let first = list(fixtures);
    list(empty.path());
    let (mut known, mut none) = (Vec::new(), Vec::new());
    for _ in 0..ROUNDS {
        known.push(list(fixtures));
        none.push(list(empty.path()));
    }
    let (known, _) = median(&mut known);
    let (none, _) = median(&mut none);
    let ms = |time: Duration| time.as_secs_f64() * 1e3;
    println!(
        "\n`ecaxis esi list` of {count} files: {:.1} ms the first time, {:.1} ms once they are known, \
         {:.1} ms with an empty folder: {:.1} ms more",
        ms(first),
        ms(known),
        ms(none),
        ms(known) - ms(none)
    );
}
