//! The cyclic exchange: logical datagrams, their intervals and working counters.

use std::collections::BTreeMap;

use hdrhistogram::Histogram;

use super::match_frames::DatagramExchange;
use ecaxis_ecat::datagram::Command;

/// The maximum number of logical datagrams: one per group, and one per eight mailboxes.
const GROUPS: usize = 64;
/// The maximum number of stored working counter changes; further ones are counted.
const RUNS: usize = 256;
/// The maximum number of stored gaps.
const GAPS: usize = 64;
/// The maximum interval of a cycle in ns.
const PAUSE_NS: u64 = 10_000_000_000;

/// The identity of process data: command, logical address, length in bytes.
pub type Key = (Command, u32, usize);

/// Returns the identity of a datagram with process data.
pub fn key(passed: &DatagramExchange<'_>) -> Key {
    let len = passed.sent.or(passed.back).map_or(0, <[u8]>::len);
    (passed.command, passed.address, len)
}

/// Consecutive cycles with the same working counter; `None`: no answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Run {
    /// The time in ns since 1970.
    pub at: u64,
    pub wkc: Option<u16>,
    pub cycles: u64,
}

/// One datagram of the cycle.
#[derive(Debug)]
pub struct Group {
    pub first: u64,
    pub last: u64,
    pub sent: u64,
    pub lost: u64,
    pub counters: BTreeMap<u16, u64>,
    pub runs: Vec<Run>,
    pub more_runs: u64,
    /// The intervals between datagrams in ns.
    pub intervals: Histogram<u64>,
    pub round_trips: Histogram<u64>,
    /// The longest intervals: length and end.
    pub gaps: Vec<(u64, u64)>,
    /// The working counter of the last cycle, and the highest one.
    wkc: Option<u16>,
    highest: Option<u16>,
    /// True if the next interval is not counted.
    paused: bool,
}

#[derive(Debug, Default)]
pub struct Cycle {
    pub groups: BTreeMap<Key, Group>,
    /// The number of datagrams of groups beyond the maximum.
    pub unfollowed: u64,
}

/// Returns an auto-resizing histogram with this number of significant digits.
fn histogram(digits: u8) -> Option<Histogram<u64>> {
    Histogram::new(digits).ok()
}

impl Group {
    fn new(at: u64) -> Option<Self> {
        Some(Self {
            first: at,
            last: at,
            sent: 0,
            lost: 0,
            counters: BTreeMap::new(),
            runs: Vec::new(),
            more_runs: 0,
            intervals: histogram(4)?,
            round_trips: histogram(3)?,
            gaps: Vec::new(),
            wkc: None,
            highest: None,
            paused: true,
        })
    }

    /// Returns the most frequent working counter.
    pub fn usual(&self) -> Option<u16> {
        let most = self
            .counters
            .iter()
            .max_by_key(|(wkc, count)| (**count, **wkc));
        most.map(|(wkc, _)| *wkc)
    }
}

impl Cycle {
    /// Marks a possible gap in the recording.
    pub fn pause(&mut self) {
        for group in self.groups.values_mut() {
            group.paused = true;
        }
    }

    /// Processes a logical datagram. `open`: its answer may have arrived after the end of the
    /// recording. Returns true if the working counter is the highest so far. Otherwise some inputs
    /// still have their transmitted values.
    pub fn passed(&mut self, key: Key, passed: &DatagramExchange<'_>, open: bool) -> bool {
        if !self.groups.contains_key(&key) {
            let group = (self.groups.len() < GROUPS).then(|| Group::new(passed.at));
            let Some(group) = group.flatten() else {
                self.unfollowed += 1;
                return false;
            };
            self.groups.insert(key, group);
        }
        let Some(group) = self.groups.get_mut(&key) else {
            return false;
        };
        group.passed(passed, open);
        passed.wkc.is_some_and(|wkc| wkc > 0) && passed.wkc == group.highest
    }
}

impl Group {
    fn passed(&mut self, passed: &DatagramExchange<'_>, open: bool) {
        let interval = passed.at.saturating_sub(self.last);
        if !self.paused && passed.at >= self.last && interval < PAUSE_NS {
            let _ = self.intervals.record(interval);
            self.gap(interval, passed.at);
        }
        self.paused = false;
        self.last = self.last.max(passed.at);
        self.first = self.first.min(passed.at);
        self.sent += 1;
        if open {
            return;
        }
        match passed.wkc {
            Some(wkc) => {
                if self.counters.len() < RUNS || self.counters.contains_key(&wkc) {
                    *self.counters.entry(wkc).or_default() += 1;
                }
            }
            None => self.lost += 1,
        }
        if let (Some(back), Some(_)) = (passed.back_at, passed.sent) {
            let _ = self
                .round_trips
                .record(back.saturating_sub(passed.at).min(PAUSE_NS));
        }
        if passed.wkc == self.wkc && !self.runs.is_empty() {
            // Cycles of a change that was not stored are not counted.
            if self.more_runs == 0
                && let Some(run) = self.runs.last_mut()
            {
                run.cycles += 1;
            }
        } else if self.runs.len() < RUNS {
            self.runs.push(Run {
                at: passed.at,
                wkc: passed.wkc,
                cycles: 1,
            });
        } else {
            self.more_runs += 1;
        }
        self.wkc = passed.wkc;
        self.highest = self.highest.max(passed.wkc);
    }

    /// Stores the gap if it is among the longest.
    fn gap(&mut self, interval: u64, at: u64) {
        if self.gaps.len() < GAPS {
            self.gaps.push((interval, at));
        } else if let Some(shortest) = self.gaps.iter_mut().min_by_key(|(interval, _)| *interval)
            && shortest.0 < interval
        {
            *shortest = (interval, at);
        }
    }
}
