//! A machine with axes on a [`BenchSegment`] without a bring-up: the parts of the real cycle and a
//! minimal supervisor.

use std::thread;
use std::time::{Duration, Instant};

use ecaxis_axis::setpoint::{Motion, PositionWave, SetpointError, Shape, Wave};
use ecaxis_axis::{Axis, AxisConfig, Command, Limits, Mode, Scale, StopMethod};
use ecaxis_ecat::index::{AxisIndex, DeviceIndex, GroupIndex};
use ecaxis_esi::layout::{Field, Layout};
use ecaxis_master::cancel::CancelToken;
use ecaxis_master::clock::{Clock, Nanos};
use ecaxis_master::config;
use ecaxis_master::link::Link;
use ecaxis_master::link::pdu_loop::main_device;
use ecaxis_master::rt::axis::RtAxis;
use ecaxis_master::rt::channel::{HostEndpoint, RtCommand, channel};
use ecaxis_master::rt::common_time::CommonTime;
use ecaxis_master::rt::config::{ExchangeMode, GroupConfig, RtConfig};
use ecaxis_master::rt::cycle::{EngineConfig, Signals, first_snapshot};
use ecaxis_master::rt::exchange::{Exchange, ExchangeDevice};
use ecaxis_master::rt::image::{self, AxisBits, ImagePlan, OpOnly, ProcessData};
use ecaxis_master::rt::phase::{ClockPlan, Phase};
use ecaxis_master::rt::setpoint_cell::SetpointCells;
use ecaxis_master::rt::setpoint_generator::GeneratorRequest;
use ecaxis_master::rt::spin::Spin;

use super::segment::{BenchSegment, DRIVE_BYTES, FIRST_STATION};

/// The maximum number of axes, limited by working counters and station addresses.
pub const MOST_AXES: usize = 1000;

/// The drift of the drives' clocks against the computer's clock in ppm.
const DRIFT_PPM: i64 = 20;
/// The unit of position, velocity and so on is one turn.
const COUNTS_PER_TURN: f64 = 2000.0;
const LIMITS: Limits = Limits {
    position: None,
    velocity: 50.0,
    acceleration: 500.0,
    jerk: None,
    torque: 100.0,
    following_error: None,
};
/// The amplitude in turns and the frequency in Hz of every axis.
const AMPLITUDE: f64 = 1.0;
const FREQUENCY: f64 = 1.0;
/// The number of periods; longer than any bench.
const PERIODS: u32 = 1_000_000;

/// The time-out for phase lock and enabling of all axes.
const TIMEOUT: Duration = Duration::from_secs(20);
const TICK: Duration = Duration::from_millis(5);
/// The settling time after the start of motion.
const SETTLE: Duration = Duration::from_millis(300);

/// Why the axes of a bench do not move.
#[derive(Debug, thiserror::Error)]
pub enum RigError {
    #[error("{0} axes do not fit: one frame holds the process data of a device whole")]
    TooMany(usize),
    #[error("{what} after {} s ({cycles} cycles, {lost} without an answer)", TIMEOUT.as_secs())]
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

/// Outputs: Controlword, target position, mode. Inputs: Statusword, position, mode.
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

/// The process data of every drive.
const DRIVE: ProcessData = ProcessData {
    out_len: DRIVE_BYTES,
    in_len: DRIVE_BYTES,
    group: GroupIndex::MACHINE,
    lrw: true,
    mailbox: false,
    op_only: OpOnly {
        outputs: false,
        inputs: false,
    },
};

fn plan(axes: usize) -> Result<ImagePlan, RigError> {
    image::plan(&vec![DRIVE; axes]).map_err(|_| RigError::TooMany(axes))
}

/// Returns the bus for this number of axes.
///
/// # Errors
/// Fails if there are too many axes.
pub fn segment(axes: usize) -> Result<BenchSegment, RigError> {
    let plan = plan(axes)?;
    let regions = plan.regions.iter().flatten();
    Ok(BenchSegment::new(
        regions.map(|region| region.logical),
        DRIFT_PPM,
    ))
}

/// The parameters of the cycle.
#[derive(Debug, Clone, Copy)]
pub struct Setup {
    pub axes: usize,
    pub cycle_ns: Nanos,
    pub spin: Spin,
    pub exchange: ExchangeMode,
}

/// Returns the engine configuration and the host side of the cycle.
///
/// # Errors
/// Fails if there are too many axes.
pub fn parts(setup: Setup, link: Box<dyn Link>) -> Result<(EngineConfig, HostEndpoint), RigError> {
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
    for (device, region) in (0..).map(DeviceIndex).zip(plan.regions.iter().flatten()) {
        let bits = AxisBits::new(&layout, region)?;
        let axis = Axis::new(config)?;
        slots.push(RtAxis::new(axis, bits, device, GroupIndex::MACHINE));
    }
    let devices = u16::try_from(axes).unwrap_or(u16::MAX);
    let members: Vec<ExchangeDevice> = (0..devices)
        .map(|n| ExchangeDevice {
            station: FIRST_STATION + n,
            clock: true,
            mailbox: None,
        })
        .collect();
    let clock = ClockPlan {
        reference: FIRST_STATION,
        cycle_ns,
        // The middle between two SYNC0 pulses, which are at whole cycles of the monotonic clock.
        release: (cycle_ns / 2) as u32,
        release_at: cycle_ns / 2,
        window_ns: config::Bus::default().clock_window_ns,
        sync0: 0,
        align: false,
    };
    let signals = Signals::default();
    let (end, outer) = channel(&first_snapshot(&slots, (1, 0), &signals, members.len()));
    let parts = EngineConfig {
        clock: Clock::Real,
        config: RtConfig {
            cycle_ns,
            clock_window_ns: config::Bus::default().clock_window_ns,
            align: false,
            spin,
            exchange,
            // Losses are counted only; a stopped machine would end the measurement.
            lost_frames: u32::MAX,
            devices: vec![DRIVE; axes].into(),
            groups: vec![GroupConfig::machine(StopMethod::Ramp)].into(),
            bus_lost: StopMethod::QuickStop,
            emergency: Vec::new(),
            overrides: config::OverrideConfig::default(),
            gantries: Vec::new(),
            cams: Vec::new(),
            line_shafts: Vec::new(),
            copies: Vec::new(),
            output_locks: Vec::new(),
            repeats: Vec::new(),
        },
        link,
        port: main_device(cycle_ns, Duration::ZERO).1,
        exchange: Exchange::new(&plan, Some(&clock), &members, exchange),
        axes: slots.into(),
        gateways: Box::default(),
        signals,
        controller: None,
        samples: None,
        tables: Box::default(),
        setpoints: SetpointCells::default(),
        phase: Some(Phase::new(&clock)),
        common: CommonTime::new(cycle_ns, Some(&clock)),
        end,
    };
    Ok((parts, outer))
}

/// Waits for the bus, then starts all axes. Returns `Ok(false)` if `stop` ends it.
///
/// # Errors
/// Fails if the phase is not locked or an axis is not enabled in time.
pub fn set_in_motion(
    outer: &mut HostEndpoint,
    setup: Setup,
    stop: &CancelToken,
) -> Result<bool, RigError> {
    send(outer, RtCommand::StartBusMonitor);
    let locked = wait(outer, stop, "the phase is not locked", |outer| {
        let snapshot = outer.snapshots.read();
        snapshot.inputs_fresh && snapshot.phase.is_some_and(|phase| phase.locked)
    })?;
    if !locked {
        return Ok(false);
    }
    for axis in (0..setup.axes).map(AxisIndex) {
        send(
            outer,
            RtCommand::Axis {
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
    for axis in (0..setup.axes).map(AxisIndex) {
        let at = outer.snapshots.read().axes[axis].target_position;
        let wave = PositionWave::new(wave, Motion::at(at), LIMITS.motion(), None, dt_s)?;
        send(
            outer,
            RtCommand::Generate {
                axis,
                start: GeneratorRequest::Wave(wave),
            },
        );
    }
    thread::sleep(SETTLE);
    Ok(true)
}

/// Sends a command and waits for space in the queue, which the cycle empties.
fn send(outer: &mut HostEndpoint, command: RtCommand) {
    let start = Instant::now();
    while outer.commands.push(command).is_err() && start.elapsed() < TIMEOUT {
        thread::sleep(TICK);
    }
}

fn wait(
    outer: &mut HostEndpoint,
    stop: &CancelToken,
    what: &'static str,
    mut done: impl FnMut(&mut HostEndpoint) -> bool,
) -> Result<bool, RigError> {
    let start = Instant::now();
    while !done(outer) {
        if stop.is_cancelled() {
            return Ok(false);
        }
        if start.elapsed() > TIMEOUT {
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
