//! A machine of axes in front of a [`Segment`], without a bring-up: the parts of the real cycle, and the little that a
//! supervisor does for it.

use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use ecaxis_axis::setpoint::{Motion, PositionWave, SetpointError, Shape, Wave};
use ecaxis_axis::{Axis, AxisConfig, Command, Limits, Mode, Scale, StopMethod};
use ecaxis_esi::layout::{Field, Layout};

use super::segment::{DRIVE_BYTES, FIRST_STATION, Segment};
use crate::clock::{Clock, Nanos};
use crate::config::{self, StopSetup};
use crate::link::Link;
use crate::link::port::main_device;
use crate::rt::cycle::{Parts, Signals, Timing, first_snapshot};
use crate::rt::exchange::{Exchange, Member};
use crate::rt::feed::Start;
use crate::rt::groups::Group;
use crate::rt::guard::Guard;
use crate::rt::handover::{Order, OuterEnd, ends};
use crate::rt::image::{self, AxisBits, ImagePlan, ProcessData};
use crate::rt::margin::Spin;
use crate::rt::phase::{ClockPlan, Phase};
use crate::rt::slot::AxisSlot;

/// As many axes as their frames' working counters and stations allow.
pub const MOST_AXES: usize = 1000;

/// The clocks of the drives run this much faster than the computer's.
const DRIFT_PPM: i64 = 20;
/// Position, velocity and so on are in turns.
const COUNTS_PER_TURN: f64 = 2000.0;
const LIMITS: Limits = Limits {
    position: None,
    velocity: 50.0,
    acceleration: 500.0,
    jerk: None,
    torque: 100.0,
    following_error: None,
};
/// Every axis swings this far, in turns, this often a second.
const AMPLITUDE: f64 = 1.0;
const FREQUENCY: f64 = 1.0;
/// Longer than any bench.
const PERIODS: u32 = 1_000_000;

/// Until the phase is locked and every axis enabled.
const PATIENCE: Duration = Duration::from_secs(20);
const TICK: Duration = Duration::from_millis(5);
/// Enough to settle after everything has begun to move.
const SETTLE: Duration = Duration::from_millis(300);

/// Why the axes of a bench do not move.
#[derive(Debug, thiserror::Error)]
pub enum RigError {
    #[error("{0} axes do not fit: one frame holds the process data of a device whole")]
    TooMany(usize),
    #[error("{what} after {} s ({cycles} cycles, {lost} without an answer)", PATIENCE.as_secs())]
    NotReady {
        what: &'static str,
        cycles: u64,
        lost: u64,
    },
    #[error("the axes cannot be moved at this cycle time: {0}")]
    Wave(#[from] SetpointError),
    #[error("{0}")]
    Axis(#[from] ecaxis_axis::ConfigError),
    #[error("{0}")]
    Scale(#[from] ecaxis_axis::ScaleError),
    #[error("{0}")]
    NotMapped(#[from] image::NotMapped),
}

/// Controlword, target position, mode out; Statusword, position, mode in.
fn layout() -> Layout {
    let field = |pdo, index, bit_offset, bit_len| Field {
        pdo,
        index,
        sub: 0,
        bit_offset,
        bit_len,
        name: String::new(),
        data_type: String::new(),
    };
    Layout {
        rx: vec![
            field(0x1600, 0x6040, 0, 16),
            field(0x1600, 0x607a, 16, 32),
            field(0x1600, 0x6060, 48, 8),
        ],
        tx: vec![
            field(0x1a00, 0x6041, 0, 16),
            field(0x1a00, 0x6064, 16, 32),
            field(0x1a00, 0x6061, 48, 8),
        ],
        ..Layout::default()
    }
}

fn plan(axes: usize) -> Result<ImagePlan, RigError> {
    let drive = ProcessData {
        out_len: DRIVE_BYTES,
        in_len: DRIVE_BYTES,
        group: 0,
        lrw: true,
        mailbox: false,
    };
    image::plan(&vec![drive; axes]).map_err(|_| RigError::TooMany(axes))
}

/// The bus for so many axes.
///
/// # Errors
/// Where there are too many.
pub fn segment(axes: usize) -> Result<Segment, RigError> {
    let plan = plan(axes)?;
    let regions = plan.regions.iter().flatten();
    Ok(Segment::new(
        regions.map(|region| region.logical),
        DRIFT_PPM,
    ))
}

/// How the loop is to run.
#[derive(Debug, Clone, Copy)]
pub struct Setup {
    pub axes: usize,
    pub cycle_ns: Nanos,
    pub spin: Spin,
    pub exchange: config::Exchange,
}

/// Everything that turns the cycle, and the other end of it.
///
/// # Errors
/// Where there are too many axes.
pub fn parts(setup: Setup, link: Box<dyn Link>) -> Result<(Parts, OuterEnd), RigError> {
    let Setup {
        axes,
        cycle_ns,
        spin,
        exchange,
    } = setup;
    let plan = plan(axes)?;
    let layout = layout();
    let scale = Scale::new(COUNTS_PER_TURN, 1.0)?;
    let config = AxisConfig::new(Mode::Csp, scale, LIMITS);
    let mut slots = Vec::with_capacity(axes);
    for region in plan.regions.iter().flatten() {
        let bits = AxisBits::new(&layout, region)?;
        slots.push(AxisSlot::new(Axis::new(config)?, bits, slots.len(), 0));
    }
    let devices = u16::try_from(axes).unwrap_or(u16::MAX);
    let members: Vec<Member> = (0..devices)
        .map(|n| Member {
            station: FIRST_STATION + n,
            clock: true,
            mailbox: None,
        })
        .collect();
    let clock = ClockPlan {
        reference: FIRST_STATION,
        cycle_ns,
        // In the middle between two SYNC0 pulses at whole cycles.
        release: cycle_ns / 2,
    };
    let signals = Signals::default();
    let (end, outer) = ends(&first_snapshot(&slots, 1, &signals, members.len()));
    let parts = Parts {
        clock: Clock::Real,
        timing: Timing {
            cycle_ns,
            clock_window_ns: config::Bus::default().clock_window_ns,
            spin,
        },
        link,
        port: main_device(cycle_ns).1,
        exchange: Exchange::new(&plan, Some(&clock), &members, exchange),
        axes: slots,
        groups: vec![Group::machine(StopMethod::Ramp)],
        signals,
        controller: None,
        tables: Box::default(),
        stop: StopSetup::default(),
        phase: Some(Phase::new(&clock)),
        // Losses are counted. A machine that has stopped would have no more to show.
        guard: Guard::new(u32::MAX, &plan.groups),
        end,
    };
    Ok((parts, outer))
}

/// Waits for the bus, then sets every axis in motion.
///
/// # Errors
/// Where the phase is not locked or an axis not enabled in time. Stopped by `stop`: `Ok(false)`.
pub fn set_in_motion(
    outer: &mut OuterEnd,
    setup: Setup,
    stop: &AtomicBool,
) -> Result<bool, RigError> {
    order(outer, Order::Guard);
    let locked = wait(outer, stop, "the phase is not locked", |outer| {
        let snapshot = outer.snapshots.read();
        snapshot.inputs_fresh && snapshot.phase.is_some_and(|phase| phase.locked)
    })?;
    if !locked {
        return Ok(false);
    }
    for axis in 0..setup.axes {
        order(
            outer,
            Order::Axis {
                axis,
                command: Command::Enable,
            },
        );
    }
    let enabled = wait(outer, stop, "not every axis is enabled", |outer| {
        outer.snapshots.read().axes.iter().all(|axis| axis.enabled)
    })?;
    if !enabled {
        return Ok(false);
    }
    let dt_s = setup.cycle_ns as f64 * 1e-9;
    let wave = Wave::new(Shape::Sine, AMPLITUDE, FREQUENCY, PERIODS, dt_s)?;
    for axis in 0..setup.axes {
        let at = outer.snapshots.read().axes[axis].target_position;
        let wave = PositionWave::new(wave, Motion::at(at), LIMITS.motion(), None, dt_s)?;
        order(
            outer,
            Order::Feed {
                axis,
                start: Start::Wave(wave),
            },
        );
    }
    thread::sleep(SETTLE);
    Ok(true)
}

/// The queue is emptied every cycle; where it is full, that is soon over.
fn order(outer: &mut OuterEnd, order: Order) {
    let start = Instant::now();
    while outer.orders.push(order).is_err() && start.elapsed() < PATIENCE {
        thread::sleep(TICK);
    }
}

fn wait(
    outer: &mut OuterEnd,
    stop: &AtomicBool,
    what: &'static str,
    mut done: impl FnMut(&mut OuterEnd) -> bool,
) -> Result<bool, RigError> {
    let start = Instant::now();
    while !done(outer) {
        if stop.load(Ordering::Relaxed) {
            return Ok(false);
        }
        if start.elapsed() > PATIENCE {
            let counters = outer.snapshots.read().counters;
            return Err(RigError::NotReady {
                what,
                cycles: counters.cycles,
                lost: counters.lost_frames,
            });
        }
        thread::sleep(TICK);
    }
    Ok(true)
}
