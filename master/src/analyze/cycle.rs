//! The cyclic exchange: datagrams to logical addresses, how regularly they come, and their working counters.

use std::collections::BTreeMap;

use hdrhistogram::Histogram;

use super::pair::Passed;
use crate::recording::frame::Command;

/// Datagrams with an address of their own that are followed: one a group, and one for every eight mailboxes.
const GROUPS: usize = 64;
/// Changes of a working counter that are kept; they are counted beyond.
const RUNS: usize = 256;
/// Gaps that are kept.
const GAPS: usize = 64;
/// An interval that is no cycle any more.
const PAUSE_NS: u64 = 10_000_000_000;

/// Which process data: command, logical address, bytes.
pub type Key = (Command, u32, usize);

/// Cycles in a row with the same working counter; `None`: no answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Run {
    /// Nanoseconds since 1970.
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
    /// Nanoseconds from one to the next.
    pub intervals: Histogram<u64>,
    pub round_trips: Histogram<u64>,
    /// The longest intervals: length and when they ended.
    pub gaps: Vec<(u64, u64)>,
    /// Of the last cycle, and the highest of all.
    wkc: Option<u16>,
    highest: Option<u16>,
    /// The next interval is none.
    paused: bool,
}

#[derive(Debug, Default)]
pub struct Cycle {
    pub groups: BTreeMap<Key, Group>,
    /// Datagrams of groups beyond those followed.
    pub unfollowed: u64,
}

/// Numbers with four digits that count; grows as it needs.
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

    /// The working counter that most answers had.
    pub fn usual(&self) -> Option<u16> {
        let most = self
            .counters
            .iter()
            .max_by_key(|(wkc, count)| (**count, **wkc));
        most.map(|(wkc, _)| *wkc)
    }
}

impl Cycle {
    /// Something may be missing from here on.
    pub fn pause(&mut self) {
        for group in self.groups.values_mut() {
            group.paused = true;
        }
    }

    /// A datagram to a logical address. `open`: its answer may have come after the recording's end. Returns whether everybody
    /// answered who ever did: otherwise what was sent stands in the place of somebody's inputs.
    pub fn passed(&mut self, passed: &Passed<'_>, open: bool) -> bool {
        let len = passed.sent.or(passed.back).map_or(0, <[u8]>::len);
        let key = (passed.command, passed.address, len);
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
    fn passed(&mut self, passed: &Passed<'_>, open: bool) {
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
            // Of a change that was not kept, nor are its cycles.
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

    /// Keeps the longest.
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
