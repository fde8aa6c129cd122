//! The motion of the simulated drives, and the means that stopped them.

use std::collections::BTreeSet;
use std::fmt;
use std::fs::File;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::thread::sleep;
use std::time::{Duration, Instant};

use rustix::time::{ClockId, clock_gettime};

use super::TIMEOUT;

/// The standstill threshold in turns/s, as in the simulator.
const STANDS: f64 = 0.1;
/// The time at rest after which an axis counts as standing.
const SETTLED_NS: u64 = 200_000_000;
/// Older outputs no longer arrive; a busy computer is late by milliseconds.
const LATE_NS: u64 = 10_000_000;
/// The first means of every stop of a reachable drive.
pub(super) const SET_POINTS: &str = "set-points";
/// The maximum time of bring-up with every start-up SDO.
const BRING_UP: Duration = Duration::from_secs(30);

#[derive(Debug, Clone)]
struct Sample {
    at: u64,
    device: usize,
    /// The reported state; empty: without power.
    al: String,
    al_code: u16,
    /// True while frames deliver outputs.
    commanded: bool,
    statusword: u16,
    velocity: f64,
}

impl Sample {
    /// Parses a line; `None` for devices other than drives.
    fn parse(line: &str) -> Option<Self> {
        let mut fields = line.split(',');
        let mut next = || fields.next();
        let hex = |text: &str| u16::from_str_radix(text.strip_prefix("0x")?, 16).ok();
        let (at, device, _name, al) = (next()?, next()?, next()?, next()?);
        let (al_code, age, _controlword) = (next()?, next()?, next()?);
        let (statusword, velocity) = (next()?, next()?);
        Some(Self {
            at: at.parse().ok()?,
            device: device.parse().ok()?,
            al: al.to_owned(),
            al_code: hex(al_code)?,
            commanded: age.parse().is_ok_and(|age: u64| age < LATE_NS),
            statusword: hex(statusword)?,
            velocity: velocity.parse().ok()?,
        })
    }

    /// Returns the means that acts on the motor at this time.
    fn means(&self) -> &'static str {
        let is = |mask, value| self.statusword & mask == value;
        if self.al.is_empty() {
            "friction, no supply"
        } else if is(0x6f, 0x27) {
            match self.commanded {
                true => SET_POINTS,
                false => "last set-point",
            }
        } else if is(0x6f, 0x07) {
            "quick stop 0x0002"
        } else if is(0x4f, 0x0f) && self.al_code == 0x001b {
            "SyncManager watchdog"
        } else if is(0x4f, 0x0f) {
            "drive's own fault reaction"
        } else {
            "friction, power off"
        }
    }
}

/// The stop of one drive.
#[derive(Debug)]
pub(super) struct DriveStop {
    device: usize,
    ms: f64,
    stands_since: u64,
    /// Each means that reduced the speed by at least a twentieth, in order of occurrence.
    means: Vec<&'static str>,
}

#[derive(Debug)]
pub(super) struct Stop {
    began: u64,
    drives: Vec<DriveStop>,
}

/// The trace of a simulated bus, as far as it is written.
pub(super) struct Trace {
    reader: BufReader<File>,
    line: String,
    samples: Vec<Sample>,
}

impl Trace {
    pub fn open(path: &Path) -> Self {
        Self {
            reader: BufReader::new(File::open(path).expect("the trace")),
            line: String::new(),
            samples: Vec::new(),
        }
    }

    /// Returns the time on the trace's clock.
    pub fn now(&self) -> u64 {
        let now = clock_gettime(ClockId::Monotonic);
        u64::try_from(now.tv_sec).expect("after boot") * 1_000_000_000
            + u64::try_from(now.tv_nsec).expect("within a second")
    }

    fn read(&mut self) {
        while self.reader.read_line(&mut self.line).expect("a trace") > 0 {
            // The rest of the line is not written yet.
            if !self.line.ends_with('\n') {
                return;
            }
            self.samples.extend(Sample::parse(self.line.trim_end()));
            self.line.clear();
        }
    }

    /// Returns samples of one drive from a time on.
    fn since(&self, device: usize, at: u64) -> impl DoubleEndedIterator<Item = &Sample> {
        let first = self.samples.partition_point(|sample| sample.at < at);
        self.samples[first..]
            .iter()
            .filter(move |sample| sample.device == device)
    }

    fn drives(&self) -> BTreeSet<usize> {
        self.samples.iter().map(|sample| sample.device).collect()
    }

    #[track_caller]
    fn wait(&mut self, timeout: Duration, what: &str, holds: impl Fn(&Self) -> bool) {
        let began = Instant::now();
        loop {
            self.read();
            if !self.samples.is_empty() && holds(self) {
                return;
            }
            let last = &self.samples[self.samples.len().saturating_sub(2)..];
            assert!(began.elapsed() < timeout, "no {what}: {last:?}");
            sleep(Duration::from_millis(5));
        }
    }

    /// Waits until all drives have turned at this speed for a while.
    #[track_caller]
    pub fn await_speed(&mut self, speed: f64) {
        self.wait(BRING_UP, "drive turns", |trace| {
            let from = trace.now().saturating_sub(SETTLED_NS);
            trace.drives().into_iter().all(|device| {
                let mut all = trace.since(device, from).peekable();
                all.peek().is_some() && all.all(|s| (s.velocity - speed).abs() < 0.1 * speed)
            })
        });
    }

    /// Waits until all drives stand. No drive may accelerate before that. Drives before `ramped`
    /// must receive set-points until they stand.
    #[track_caller]
    pub fn await_standstill(&mut self, began: u64, ramped: usize) -> Stop {
        self.wait(TIMEOUT, "standstill", |trace| {
            let now = trace.samples.last().map_or(0, |sample| sample.at);
            let settled = now.saturating_sub(began) > SETTLED_NS;
            let from = now.saturating_sub(SETTLED_NS);
            settled
                && trace.drives().into_iter().all(|device| {
                    let mut all = trace.since(device, from);
                    all.all(|sample| sample.velocity.abs() < STANDS)
                })
        });
        let drives = self.drives();
        let drives = drives.into_iter().map(|device| self.stop(device, began));
        let stop = Stop {
            began,
            drives: drives.collect(),
        };
        let mut reached = stop.drives.iter().filter(|drive| drive.device < ramped);
        assert!(reached.all(|drive| drive.means == [SET_POINTS]), "{stop:?}");
        stop
    }

    fn stop(&self, device: usize, began: u64) -> DriveStop {
        let samples: Vec<&Sample> = self.since(device, began).collect();
        // One sample is not the speed: it may follow a late frame.
        let settled = self.since(device, began.saturating_sub(SETTLED_NS));
        let settled = settled.take_while(|sample| sample.at <= began);
        let speeds: Vec<f64> = settled.map(|sample| sample.velocity.abs()).collect();
        let first = speeds.iter().sum::<f64>() / speeds.len().max(1) as f64;
        let mut taken: Vec<(&'static str, f64)> = Vec::new();
        let mut stands_since = began;
        for pair in samples.windows(2) {
            let (before, now) = (pair[0].velocity.abs(), pair[1].velocity.abs());
            assert!(
                now < 1.15 * first,
                "device {device} gains speed: {:?}",
                pair[1]
            );
            if now >= STANDS {
                stands_since = pair[1].at;
            }
            let means = pair[0].means();
            match taken.iter_mut().find(|(known, _)| *known == means) {
                Some((_, speed)) => *speed += before - now,
                None => taken.push((means, before - now)),
            }
        }
        taken.retain(|(_, speed)| *speed > 0.05 * first);
        DriveStop {
            device,
            ms: stands_since.saturating_sub(began) as f64 * 1e-6,
            stands_since,
            means: taken.into_iter().map(|(means, _)| means).collect(),
        }
    }

    /// Checks that no drive has turned again up to now.
    #[track_caller]
    pub fn stays(&mut self, stop: Stop) -> Stop {
        sleep(Duration::from_millis(100));
        self.read();
        for drive in &stop.drives {
            let mut after = self.since(drive.device, drive.stands_since + 1);
            let turned = after.find(|sample| sample.velocity.abs() >= STANDS);
            assert!(
                turned.is_none(),
                "turns again after {}: {turned:?}",
                stop.began
            );
        }
        stop
    }
}

/// A table with one row per trial and drive.
#[derive(Default)]
pub(super) struct Table(Vec<Row>);

struct Row {
    trial: &'static str,
    device: usize,
    ms: Vec<f64>,
    means: BTreeSet<String>,
}

impl Table {
    pub fn add(&mut self, trial: &'static str, stop: &Stop) {
        for drive in &stop.drives {
            let same = |row: &&mut Row| row.trial == trial && row.device == drive.device;
            let means = drive.means.join(", then ");
            match self.0.iter_mut().find(same) {
                Some(row) => {
                    row.ms.push(drive.ms);
                    row.means.insert(means);
                }
                None => self.0.push(Row {
                    trial,
                    device: drive.device,
                    ms: vec![drive.ms],
                    means: BTreeSet::from([means]),
                }),
            }
        }
    }
}

impl fmt::Display for Table {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "| trial | drive | times | ms to standstill: min | median | max | by |"
        )?;
        writeln!(f, "|---|---|---|---|---|---|---|")?;
        for row in &self.0 {
            let mut ms = row.ms.clone();
            ms.sort_by(f64::total_cmp);
            let (min, max) = (ms[0], ms[ms.len() - 1]);
            let (median, times) = (ms[ms.len() / 2], ms.len());
            let drive = ["csp", "csv"].get(row.device).unwrap_or(&"?");
            let means: Vec<&str> = row.means.iter().map(String::as_str).collect();
            let means = means.join("; or ");
            writeln!(
                f,
                "| {} | {drive} | {times} | {min:.0} | {median:.0} | {max:.0} | {means} |",
                row.trial
            )?;
        }
        Ok(())
    }
}
