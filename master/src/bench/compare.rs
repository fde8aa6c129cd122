//! Runs a [`Plan`]: every variant in every round, one after the other, so that whatever else the computer does meets all of
//! them.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use super::bus::{Bus, Options};
use super::host::{self, Hog};
use super::in_process::InProcess;
use super::kernel::CpuView;
use super::plan::{Against, Plan, Target, exchange_name};
use super::program;
use super::report::{Dist, Fact, Report, Variant, ratios};
use super::rig::{self, RigError, Setup};
use super::turn::{self, Measured, Thread, TurnError};
use super::veth::VethPair;
use super::wakeup::Cyclictest;
use super::{machine, remarks};
use crate::config::Exchange;
use crate::config::duration::show as duration;
use crate::link::{self, BackEnd, Link, OpenError};
use crate::os::process::ThreadUse;
use crate::rt::awake::Awake;
use crate::rt::margin::Spin;
use crate::rt::stats::Times;
use crate::rt::thread::Held;
use crate::session::{Observer, RunError};

/// Why a bench ended early.
#[derive(Debug, thiserror::Error)]
pub enum BenchError {
    #[error("a pair of virtual interfaces cannot be made: {0}")]
    Veth(io::Error),
    #[error("the bus at the far end: {0}")]
    Bus(io::Error),
    #[error("{0}")]
    Open(#[from] OpenError),
    #[error("{0}")]
    Turn(#[from] TurnError),
    #[error("{0}")]
    Rig(#[from] RigError),
    #[error("the machine: {0}")]
    Run(Box<RunError>),
    #[error("{0}")]
    Cyclictest(io::Error),
    #[error("{0}")]
    Program(io::Error),
    #[error("a thread cannot be started: {0}")]
    Thread(io::Error),
}

/// What a round of one variant was begun with.
#[derive(Debug, Clone)]
enum Way {
    Cycle {
        spin: Spin,
        exchange: Exchange,
        link: BackEnd,
    },
    Other(Against),
}

/// One variant so far.
#[derive(Debug)]
struct Kept {
    name: String,
    way: Way,
    rounds: u32,
    cycles: u64,
    measured: Measured,
    /// It is none of ours.
    foreign: bool,
    lost: u64,
}

/// Told while it goes on.
pub trait Watcher {
    /// A round of a variant begins; rounds from 1.
    fn round(&mut self, round: u32, of: u32, variant: &str);
    /// What of the machine is told otherwise.
    fn machine(&mut self) -> &mut dyn Observer;
    fn warning(&mut self, text: &str);
}

/// Measures. `stop` ends it early, with what there is; `None` where that is nothing.
///
/// # Errors
/// Where something that is measured cannot be run.
pub fn run(
    plan: &Plan,
    stop: &Arc<AtomicBool>,
    watcher: &mut dyn Watcher,
) -> Result<Option<Report>, BenchError> {
    let (_held, denied) = Held::take(plan.awake.then_some(plan.cpu));
    for denied in denied {
        watcher.warning(&denied.to_string());
    }
    let rig = Rig::new(plan)?;
    let _hog = match plan.other_cpu.filter(|_| plan.hog) {
        Some(cpu) => Some(Hog::start(cpu).map_err(BenchError::Thread)?),
        None => None,
    };
    let mut all = variants(plan);
    'rounds: for round in 1..=plan.rounds {
        for kept in &mut all {
            if stop.load(Ordering::Relaxed) {
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
    let variants: Vec<Variant> = all.iter().map(|kept| told(plan, kept)).collect();
    let mut remarks = remarks::of(plan, &variants);
    for kept in &all {
        for denied in &kept.measured.denied {
            let text = denied.to_string();
            if !remarks.contains(&text) {
                remarks.push(text);
            }
        }
    }
    let (facts, findings) = host::examined(plan);
    Ok(Some(Report {
        version: env!("CARGO_PKG_VERSION"),
        facts,
        findings,
        settings: settings(plan),
        ratios: ratios(&variants, plan.fixed_hold()),
        variants,
        remarks,
    }))
}

fn variants(plan: &Plan) -> Vec<Kept> {
    let kept = |name: String, way: Way| Kept {
        foreign: matches!(way, Way::Other(_)),
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
            Way::Cycle {
                spin,
                exchange,
                link,
            },
        )
    };
    let mut all = vec![cycle("ecaxis", plan.spin, plan.exchange, plan.link)];
    for against in &plan.against {
        all.push(match against {
            Against::Sleep => cycle("sleeping", Spin::For(0), plan.exchange, plan.link),
            Against::Exchange(e) => cycle(exchange_name(*e), plan.spin, *e, plan.link),
            Against::Link(l) => cycle(l.name(), plan.spin, plan.exchange, *l),
            Against::Cyclictest => kept("cyclictest".to_owned(), Way::Other(against.clone())),
            Against::Program(path) => {
                let name = path.file_name().unwrap_or(path.as_os_str());
                kept(
                    name.to_string_lossy().into_owned(),
                    Way::Other(against.clone()),
                )
            }
        });
    }
    all
}

/// What lives as long as the bench.
struct Rig<'a> {
    plan: &'a Plan,
    // In this order, so that the interfaces outlive the bus.
    bus: Option<Bus>,
    pair: Option<VethPair>,
    /// The bus's CPU wakes at once.
    _awake: Option<Awake>,
}

impl<'a> Rig<'a> {
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
            rig._awake = plan.other_cpu.and_then(|cpu| Awake::start(cpu).ok());
            let bus = Bus::on(&pair, rig::segment(plan.axes)?, options).map_err(BenchError::Bus)?;
            (rig.bus, rig.pair) = (Some(bus), Some(pair));
        }
        Ok(rig)
    }

    /// False where it was interrupted before anything was measured.
    fn round(
        &self,
        kept: &mut Kept,
        stop: &Arc<AtomicBool>,
        watcher: &mut dyn Watcher,
    ) -> Result<bool, BenchError> {
        let plan = self.plan;
        let cycles = u64::try_from(plan.time.as_nanos() / u128::from(plan.cycle_ns.max(1)))
            .unwrap_or(u64::MAX);
        let seen = CpuView::now(plan.cpu);
        let mut measured = match &kept.way {
            Way::Cycle {
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
            Way::Other(Against::Program(path)) => {
                let nic = self.pair.as_ref().map_or("", |pair| &pair.a);
                let exchange = program::Exchange {
                    nic,
                    bytes: plan.bytes(),
                    cycle_ns: plan.cycle_ns,
                    cycles,
                    cpu: plan.cpu,
                    priority: plan.priority,
                };
                let told = program::run(path, exchange).map_err(BenchError::Program)?;
                kept.name.clone_from(&told.name);
                kept.cycles += told.cycles;
                kept.lost += told.lost;
                let mut measured = Measured::default();
                program::add(&mut measured.stats.round_trip, &told.release_to_input);
                program::add(&mut measured.stats.lateness, &told.wake_up_lateness);
                measured.used = told.used();
                measured.wall_ns = told.cycles * plan.cycle_ns;
                measured
            }
            Way::Other(_) => {
                let mut measured = Measured::default();
                let test = Cyclictest {
                    cycle: plan.cycle_ns,
                    priority: plan.priority,
                    cpu: Some(plan.cpu),
                };
                let before = ThreadUse::of_children().unwrap_or_default();
                let count = u32::try_from(cycles).unwrap_or(u32::MAX);
                let lateness: &mut Times = &mut measured.stats.lateness;
                test.round(count, lateness)
                    .map_err(BenchError::Cyclictest)?;
                let after = ThreadUse::of_children().unwrap_or_default();
                measured.used = after.since(before);
                measured.wall_ns = cycles * plan.cycle_ns;
                kept.cycles += lateness.summary().count;
                measured
            }
        };
        if measured.taken.is_none() {
            measured.taken = Some(CpuView::now(plan.cpu).since(&seen));
        }
        kept.measured.add(&measured);
        kept.rounds += 1;
        Ok(true)
    }

    /// The real cycle.
    fn cycle(
        &self,
        spin: Spin,
        exchange: Exchange,
        back_end: BackEnd,
        stop: &AtomicBool,
    ) -> Result<Option<Measured>, BenchError> {
        let plan = self.plan;
        let link: Box<dyn Link> = match &self.pair {
            Some(pair) => link::open(&pair.a, back_end)?.0,
            None => Box::new(InProcess::new(rig::segment(plan.axes)?, plan.hold)),
        };
        let setup = Setup {
            axes: plan.axes,
            cycle_ns: plan.cycle_ns,
            spin,
            exchange,
        };
        let (parts, outer) = rig::parts(setup, link)?;
        let thread = Thread {
            priority: plan.priority,
            cpu: Some(plan.cpu),
            time: plan.time,
        };
        Ok(turn::rig(
            parts,
            outer,
            setup,
            thread,
            self.bus.as_ref(),
            stop,
        )?)
    }
}

fn told(plan: &Plan, kept: &Kept) -> Variant {
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
    let cyclictest = matches!(kept.way, Way::Other(Against::Cyclictest));
    let late_releases = match kept.way {
        Way::Cycle { exchange, .. } => {
            let slack = plan.slack_ns(exchange);
            let late = stats.lateness.recorded().filter(|(ns, _)| *ns > slack);
            Some(late.map(|(_, count)| count).sum())
        }
        Way::Other(_) => None,
    };
    Variant {
        late_releases,
        name: kept.name.clone(),
        rounds: kept.rounds,
        cycles: kept.cycles,
        wake_up_lateness: Dist::of(&stats.lateness),
        release_to_input: Dist::of(&stats.round_trip),
        work: Dist::of(&stats.work),
        phase_error: Dist::of(&stats.phase),
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

fn settings(plan: &Plan) -> Vec<Fact> {
    let fact = |name, value: String| Fact { name, value };
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
        (None, true) => "a hog was asked for, but there is no other CPU".to_owned(),
        _ => "nothing of ours".to_owned(),
    };
    settings.push(fact("beside it", other));
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
