//! Runs a [`Plan`]: every round runs every variant once, so that other load on the computer affects
//! all of them.

use std::io;
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use super::bus::{Bus, InProcess, Options};
use super::fixture::{self, RigError, Setup};
use super::host::{self, Hog};
use super::measure::{self, Measured, Thread, TurnError};
use super::peer;
use super::plan::{Baseline, Plan, Target, exchange_name};
use super::report::{LatencySummary, Report, Variant, ratios};
use super::veth::VethPair;
use super::wakeup::Cyclictest;
use super::{caveats, machine};
use crate::document::format::utc;
use crate::host::Fact;
use crate::host::counters::CpuCounters;
use ecaxis_master::cancel::CancelToken;
use ecaxis_master::config::ExchangeMode;
use ecaxis_master::config::duration::show as duration;
use ecaxis_master::link::{self, Link, OpenError, SocketKind};
use ecaxis_master::rt::spin::Spin;
use ecaxis_master::rt::stats::LatencyHistogram;
use ecaxis_master::session::{Error, Observer};
use ecaxis_master::sys::idle_spinner::IdleSpinner;
use ecaxis_master::sys::process::ThreadUsage;
use ecaxis_master::sys::rt_thread::CpuWakeGuard;

/// Why a bench ended early.
#[derive(Debug, thiserror::Error)]
pub enum BenchError {
    #[error("cannot create a veth pair: {0}")]
    Veth(#[source] io::Error),
    #[error("the bus at the far end: {0}")]
    Bus(#[source] io::Error),
    #[error("{0}")]
    Open(#[from] OpenError),
    #[error("{0}")]
    Turn(#[from] TurnError),
    #[error("{0}")]
    Rig(#[from] RigError),
    #[error("the machine: {0}")]
    Run(Box<Error>),
    #[error("{0}")]
    Cyclictest(#[source] io::Error),
    #[error("{0}")]
    Program(#[source] io::Error),
    #[error("cannot start a thread: {0}")]
    Thread(#[source] io::Error),
}

/// The kind of a variant and its parameters.
#[derive(Debug, Clone)]
enum VariantKind {
    Cycle {
        spin: Spin,
        exchange: ExchangeMode,
        link: SocketKind,
    },
    Other(Baseline),
}

/// The result of a variant so far.
#[derive(Debug)]
struct VariantResult {
    name: String,
    way: VariantKind,
    rounds: u32,
    cycles: u64,
    measured: Measured,
    /// True if it is not a variant of ecaxis.
    foreign: bool,
    lost: u64,
}

/// Receives the progress of a bench.
pub trait BenchObserver {
    /// A round of a variant begins. Rounds count from 1.
    fn round(&mut self, round: u32, of: u32, variant: &str);
    /// Returns the observer of the machine's run.
    fn machine(&mut self) -> &mut dyn Observer;
    fn warning(&mut self, text: &str);
}

/// Facts about the computer, and settings that disturb a cycle.
#[derive(Debug, Clone, Default)]
pub struct HostCheck {
    pub facts: Vec<Fact>,
    pub findings: Vec<String>,
}

/// Runs the plan. `stop` ends it early with the results so far; `None` if there are none.
/// `check_host` runs after the measurements.
///
/// # Errors
/// Fails if a variant cannot be run.
pub fn run(
    plan: &Plan,
    stop: &Arc<CancelToken>,
    watcher: &mut dyn BenchObserver,
    check_host: impl FnOnce() -> HostCheck,
) -> Result<Option<Report>, BenchError> {
    let began = SystemTime::now().duration_since(UNIX_EPOCH).ok();
    let (_held, denied) = CpuWakeGuard::take(plan.awake.then_some(plan.cpu));
    for denied in denied {
        watcher.warning(&denied.to_string());
    }
    let rig = Fixture::new(plan)?;
    let _hog = match plan.other_cpu.filter(|_| plan.hog) {
        Some(cpu) => Some(Hog::start(cpu).map_err(BenchError::Thread)?),
        None => None,
    };
    let mut all = variants(plan);
    'rounds: for round in 1..=plan.rounds {
        for kept in &mut all {
            if stop.is_cancelled() {
                break 'rounds;
            }
            watcher.round(round, plan.rounds, &kept.name);
            if !rig.round(kept, stop, watcher)? {
                break 'rounds;
            }
        }
    }
    all.retain(|kept| kept.rounds > 0);
    if all.is_empty() {
        return Ok(None);
    }
    let variants: Vec<Variant> = all.iter().map(|kept| variant(plan, kept)).collect();
    let mut remarks = caveats::of(plan, &variants);
    for kept in &all {
        for denied in &kept.measured.denied {
            let text = denied.to_string();
            if !remarks.contains(&text) {
                remarks.push(text);
            }
        }
    }
    let check = check_host();
    Ok(Some(Report {
        version: env!("CARGO_PKG_VERSION"),
        facts: host::facts(check.facts),
        findings: check.findings,
        settings: settings(plan, began),
        ratios: ratios(&variants, plan.fixed_hold()),
        variants,
        remarks,
    }))
}

fn variants(plan: &Plan) -> Vec<VariantResult> {
    let kept = |name: String, way: VariantKind| VariantResult {
        foreign: matches!(way, VariantKind::Other(_)),
        name,
        way,
        rounds: 0,
        cycles: 0,
        measured: Measured::default(),
        lost: 0,
    };
    let cycle = |name: &str, spin, exchange, link| {
        kept(
            name.to_owned(),
            VariantKind::Cycle {
                spin,
                exchange,
                link,
            },
        )
    };
    let mut all = vec![cycle("ecaxis", plan.spin, plan.exchange, plan.link)];
    for against in &plan.against {
        all.push(match against {
            Baseline::Sleep => cycle("sleeping", Spin::For(0), plan.exchange, plan.link),
            Baseline::Exchange(e) => cycle(exchange_name(*e), plan.spin, *e, plan.link),
            Baseline::Link(l) => cycle(l.name(), plan.spin, plan.exchange, *l),
            Baseline::Cyclictest => {
                kept("cyclictest".to_owned(), VariantKind::Other(against.clone()))
            }
            Baseline::Program(path) => {
                let name = path.file_name().unwrap_or(path.as_os_str());
                kept(
                    name.to_string_lossy().into_owned(),
                    VariantKind::Other(against.clone()),
                )
            }
        });
    }
    all
}

/// The resources of the whole bench.
struct Fixture<'a> {
    plan: &'a Plan,
    // Field order: the interfaces must outlive the bus.
    bus: Option<Bus>,
    pair: Option<VethPair>,
    /// Keeps the CPU of the bus from idling.
    _awake: Option<IdleSpinner>,
}

impl<'a> Fixture<'a> {
    fn new(plan: &'a Plan) -> Result<Self, BenchError> {
        let mut rig = Self {
            plan,
            bus: None,
            pair: None,
            _awake: None,
        };
        if matches!(plan.target, Target::Veth) {
            let pair = VethPair::new().map_err(BenchError::Veth)?;
            let options = Options {
                hold: plan.hold,
                cycle_ns: plan.cycle_ns,
                mischief: plan.mischief,
                priority: plan.priority,
                cpu: plan.other_cpu,
                slack_ns: plan.slack_ns(plan.exchange),
            };
            rig._awake = plan.other_cpu.and_then(|cpu| IdleSpinner::start(cpu).ok());
            let bus =
                Bus::on(&pair, fixture::segment(plan.axes)?, options).map_err(BenchError::Bus)?;
            (rig.bus, rig.pair) = (Some(bus), Some(pair));
        }
        Ok(rig)
    }

    /// Runs a round. Returns false if it was interrupted before the first measurement.
    fn round(
        &self,
        kept: &mut VariantResult,
        stop: &Arc<CancelToken>,
        watcher: &mut dyn BenchObserver,
    ) -> Result<bool, BenchError> {
        let plan = self.plan;
        let cycles = u64::try_from(plan.time.as_nanos() / u128::from(plan.cycle_ns.max(1)))
            .unwrap_or(u64::MAX);
        let seen = CpuCounters::now(Some(plan.cpu));
        let mut measured = match &kept.way {
            VariantKind::Cycle {
                spin,
                exchange,
                link,
            } => {
                let done = match &plan.target {
                    Target::Machine { machine, enable } => {
                        machine::run(machine, *enable, plan, *spin, stop, watcher.machine())
                            .map_err(|e| BenchError::Run(Box::new(e)))?
                    }
                    _ => self.cycle(*spin, *exchange, *link, stop)?,
                };
                let Some(measured) = done else {
                    return Ok(false);
                };
                kept.cycles += measured.stats.counters.cycles;
                measured
            }
            VariantKind::Other(Baseline::Program(path)) => {
                let nic = self.pair.as_ref().map_or("", |pair| &pair.a);
                let exchange = peer::Exchange {
                    nic,
                    bytes: plan.bytes(),
                    cycle_ns: plan.cycle_ns,
                    cycles,
                    cpu: plan.cpu,
                    priority: plan.priority,
                };
                let reported = peer::run(path, exchange).map_err(BenchError::Program)?;
                kept.name.clone_from(&reported.name);
                kept.cycles += reported.cycles;
                kept.lost += reported.lost;
                let mut measured = Measured::default();
                peer::add(&mut measured.stats.round_trip, &reported.release_to_input);
                peer::add(&mut measured.stats.lateness, &reported.wake_up_lateness);
                measured.used = reported.used();
                measured.wall_ns = reported.cycles * plan.cycle_ns;
                measured
            }
            VariantKind::Other(_) => {
                let mut measured = Measured::default();
                let test = Cyclictest {
                    cycle: plan.cycle_ns,
                    priority: plan.priority,
                    cpu: Some(plan.cpu),
                };
                let before = ThreadUsage::of_children().unwrap_or_default();
                let count = u32::try_from(cycles).unwrap_or(u32::MAX);
                let lateness: &mut LatencyHistogram = &mut measured.stats.lateness;
                test.round(count, lateness)
                    .map_err(BenchError::Cyclictest)?;
                let after = ThreadUsage::of_children().unwrap_or_default();
                measured.used = after.since(before);
                measured.wall_ns = cycles * plan.cycle_ns;
                kept.cycles += lateness.summary().count;
                measured
            }
        };
        if measured.taken.is_none() {
            measured.taken = Some(CpuCounters::now(Some(plan.cpu)).since(&seen));
        }
        kept.measured.add(&measured);
        kept.rounds += 1;
        Ok(true)
    }

    /// Measures the real cycle.
    fn cycle(
        &self,
        spin: Spin,
        exchange: ExchangeMode,
        back_end: SocketKind,
        stop: &CancelToken,
    ) -> Result<Option<Measured>, BenchError> {
        let plan = self.plan;
        let link: Box<dyn Link> = match &self.pair {
            Some(pair) => link::open(&pair.a, back_end)?.0,
            None => Box::new(InProcess::new(fixture::segment(plan.axes)?, plan.hold)),
        };
        let setup = Setup {
            axes: plan.axes,
            cycle_ns: plan.cycle_ns,
            spin,
            exchange,
        };
        let (parts, outer) = fixture::parts(setup, link)?;
        let thread = Thread {
            priority: plan.priority,
            cpu: Some(plan.cpu),
            time: plan.time,
        };
        Ok(measure::rig(
            parts,
            outer,
            setup,
            thread,
            self.bus.as_ref(),
            stop,
        )?)
    }
}

fn variant(plan: &Plan, kept: &VariantResult) -> Variant {
    let Measured {
        stats,
        used,
        taken,
        wall_ns,
        spin_ns,
        bus,
        ..
    } = &kept.measured;
    let cycles = kept.cycles.max(1) as f64;
    let switches = used.voluntary_switches + used.involuntary_switches;
    let mut counters = stats.counters;
    if kept.foreign {
        counters.cycles = kept.cycles;
        counters.lost_frames = kept.lost;
    }
    let cyclictest = matches!(kept.way, VariantKind::Other(Baseline::Cyclictest));
    let late_releases = match kept.way {
        VariantKind::Cycle { exchange, .. } => {
            let slack = plan.slack_ns(exchange);
            let late = stats.lateness.recorded().filter(|(ns, _)| *ns > slack);
            Some(late.map(|(_, count)| count).sum())
        }
        VariantKind::Other(_) => None,
    };
    Variant {
        late_releases,
        name: kept.name.clone(),
        rounds: kept.rounds,
        cycles: kept.cycles,
        wake_up_lateness: LatencySummary::of(&stats.lateness),
        release_to_input: LatencySummary::of(&stats.round_trip),
        work: LatencySummary::of(&stats.work),
        phase_error: LatencySummary::of(&stats.phase),
        counters: (!cyclictest).then_some(counters),
        used: Some(*used),
        cpu_ns_per_cycle: Some(used.cpu_ns as f64 / cycles),
        cpu_percent: (*wall_ns > 0).then(|| used.load_percent(*wall_ns)),
        context_switches_per_cycle: Some(switches as f64 / cycles),
        spin_ns: (!kept.foreign).then_some(*spin_ns),
        taken: taken.clone(),
        bus: *bus,
    }
}

fn settings(plan: &Plan, began: Option<Duration>) -> Vec<Fact> {
    let fact = |name, value: String| Fact { name, value };
    let date = began.map(|began| format!("{} UTC", utc(began.as_secs())));
    let mut settings = vec![
        fact("on", plan.target_name()),
        fact(
            "cycle",
            format!(
                "{} ({:.0} Hz)",
                duration(plan.cycle_ns),
                1e9 / plan.cycle_ns.max(1) as f64
            ),
        ),
    ];
    if !matches!(plan.target, Target::Machine { .. }) {
        settings.push(fact(
            "axes",
            format!("{} in CSP, in motion, 12 bytes each way", plan.axes),
        ));
    }
    settings.extend(date.map(|date| fact("begun", date)));
    settings.push(fact("exchange", exchange_name(plan.exchange).to_owned()));
    if matches!(plan.target, Target::Veth) {
        settings.push(fact("link", plan.link.name().to_owned()));
    }
    settings.push(fact(
        "thread",
        format!("SCHED_FIFO {} on CPU {}", plan.priority, plan.cpu),
    ));
    let spin = match plan.spin {
        Spin::Auto => "as long as sleeping turns out to end late".to_owned(),
        Spin::For(0) => "not at all".to_owned(),
        Spin::For(ns) => format!("{} before each release", duration(ns)),
    };
    settings.push(fact("spinning", spin));
    let other = match (plan.other_cpu, plan.hog) {
        (Some(cpu), true) => format!("a CPU hog on CPU {cpu}"),
        (None, true) => "a CPU hog was requested, but there is no other CPU".to_owned(),
        _ => "nothing of ours".to_owned(),
    };
    settings.push(fact("other load", other));
    if plan.awake {
        settings.push(fact("idling", format!("CPU {} is kept from it", plan.cpu)));
    }
    settings.push(fact(
        "rounds",
        format!(
            "{} of {} each{}",
            plan.rounds,
            duration(u64::try_from(plan.time.as_nanos()).unwrap_or(u64::MAX)),
            if plan.against.is_empty() {
                ""
            } else {
                ", in turns"
            }
        ),
    ));
    settings
}
