//! Backlash and pitch error: where the load really is, and what the drive receives.

use crate::common::{DT, Drive, LIMITS};
use ecaxis_axis::compensation::{Compensation, Mechanics, ReferenceFlank};
use ecaxis_axis::{
    Axis, AxisConfig, AxisStatus, Command, Limits, Mode, Outputs, Scale, SecondEncoder, StopMethod,
    Trip,
};

/// Fine enough for limits per cycle: 400 000 counts per mm.
pub const COUNTS: f64 = 400_000.0;
pub const BACKLASH: f64 = 0.05;
const ERRORS: &[[f64; 2]] = &[
    [-50.0, 0.02],
    [-20.0, 0.0],
    [0.0, 0.01],
    [15.0, -0.015],
    [50.0, 0.03],
];

fn scale() -> Scale {
    Scale::new(2_000_000.0, 5.0).unwrap()
}

fn compensation(reference: ReferenceFlank) -> Compensation {
    let mechanics = Mechanics {
        errors: ERRORS,
        backlash: Some(BACKLASH),
        reference,
        period: None,
    };
    Compensation::new(&mechanics, &LIMITS).unwrap()
}

/// The mechanics themselves: the load lies in the play of the drive, and its screw has errors.
pub struct Load {
    screw: f64,
    /// The screw has errors.
    pub pitch: bool,
    /// The way from the reference flank to the other one.
    play: [f64; 2],
}

impl Load {
    fn new(drive: f64, reference: ReferenceFlank) -> Self {
        let play = match reference {
            ReferenceFlank::Positive => [-BACKLASH, 0.0],
            ReferenceFlank::Negative => [0.0, BACKLASH],
        };
        Self {
            screw: drive,
            pitch: true,
            play,
        }
    }

    fn follow(&mut self, drive: f64) -> f64 {
        self.screw = self.screw.clamp(drive - self.play[1], drive - self.play[0]);
        // Newton's method, with the table as given.
        let mut load = self.screw;
        for _ in 0..30 {
            load = self.screw + if self.pitch { error(load) } else { 0.0 };
        }
        load
    }
}

fn error(at: f64) -> f64 {
    for pair in ERRORS.windows(2) {
        let [[from, a], [to, b]] = [pair[0], pair[1]];
        if at <= to || to == 50.0 {
            return a + (b - a) * (at - from) / (to - from);
        }
    }
    0.0
}

/// SplitMix64.
struct Random(u64);

impl Random {
    /// Returns a number from 0 to 1.
    fn unit(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / 2f64.powi(53)
    }

    fn within(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }

    fn below(&mut self, end: u32) -> u32 {
        (self.unit() * f64::from(end)) as u32
    }

    fn is_true(&mut self, probability: f64) -> bool {
        self.unit() < probability
    }
}

pub struct Rig {
    pub axis: Axis,
    pub drive: Drive,
    pub out: Outputs,
    pub load: Load,
    pub real: f64,
    /// The targets of the last cycles, and the largest change and change of change.
    pub targets: Vec<f64>,
    pub largest: [f64; 2],
    silent: u32,
    /// The counts of the second encoder.
    pub second: Option<i32>,
}

impl Rig {
    pub fn new(
        compensation: Compensation,
        config: impl Fn(&mut AxisConfig),
        reference: ReferenceFlank,
    ) -> Self {
        let limits = compensation.load_limits(&LIMITS);
        let mut cfg = AxisConfig::new(Mode::Csp, scale(), limits);
        cfg.dead_time_s = 2.0 * DT;
        config(&mut cfg);
        let mut rig = Self {
            axis: Axis::compensated(cfg, compensation).unwrap(),
            drive: Drive::at(0),
            out: Outputs::default(),
            load: Load::new(0.0, reference),
            real: 0.0,
            targets: Vec::new(),
            largest: [0.0; 2],
            silent: 0,
            second: None,
        };
        rig.enable();
        rig
    }

    fn enable(&mut self) {
        self.axis.command(Command::Enable).unwrap();
        self.until(|s| s.ready);
    }

    pub fn cycle(&mut self, fresh: bool) -> AxisStatus {
        let mut inputs = self.drive.inputs();
        inputs.velocity = None;
        inputs.second_position = self.second;
        inputs.fresh = fresh;
        if fresh {
            self.drive.cycle(&self.out, DT);
        }
        self.real = self.load.follow(self.drive.position / COUNTS);
        self.out = self.axis.step(&inputs, DT);
        self.silent = if fresh { 0 } else { self.silent + 1 };
        let status = self.axis.status();
        let target = f64::from(self.out.target_position) / COUNTS;
        // A set-point that waits for lost frames waits at once, like its drive.
        if status.enabled && self.silent <= 2 {
            self.targets.push(target);
        } else {
            self.targets.clear();
        }
        let [.., a, b, c] = self.targets[..] else {
            return status;
        };
        self.largest[0] = self.largest[0].max((c - b).abs() / DT);
        self.largest[1] = self.largest[1].max((c - 2.0 * b + a).abs() / DT / DT);
        status
    }

    #[track_caller]
    pub fn until(&mut self, done: impl Fn(&AxisStatus) -> bool) -> AxisStatus {
        for _ in 0..20_000 {
            let status = self.cycle(true);
            if done(&status) {
                return status;
            }
        }
        panic!("{:#?}", self.axis.status());
    }

    /// Moves, and returns the error of the load.
    pub fn move_to(&mut self, position: f64, speed: f64) -> f64 {
        self.axis
            .command(Command::MoveTo {
                position,
                speed,
                ramp: 1.0,
            })
            .unwrap();
        self.cycle(true);
        self.until(|s| !s.moving && s.in_target);
        for _ in 0..5 {
            self.cycle(true);
        }
        self.real - position
    }

    #[track_caller]
    fn assert_limits(&self) {
        let count = 1.0 / COUNTS;
        assert!(
            self.largest[0] <= LIMITS.velocity + count / DT,
            "{:?}",
            self.largest
        );
        let rounding = 2.0 * count / DT / DT;
        assert!(
            self.largest[1] <= LIMITS.acceleration + rounding,
            "{:?}",
            self.largest
        );
    }
}

const BOTH: [ReferenceFlank; 2] = [ReferenceFlank::Positive, ReferenceFlank::Negative];
const TARGETS: [f64; 9] = [10.0, 10.01, 9.0, 8.999, 30.0, -40.0, -40.02, 15.0, -3.0];

#[test]
fn the_load_arrives_from_both_directions() {
    for reference in BOTH {
        for jerk_limited in [false, true] {
            let mut rig = Rig::new(
                compensation(reference),
                |config| config.jerk_limited = jerk_limited,
                reference,
            );
            let mut farthest = 0.0_f64;
            // Starts on the reference flank.
            for speed in [1.0, 0.2, 0.01] {
                for position in TARGETS {
                    if speed > 0.05 || position.abs() < 11.0 {
                        farthest = farthest.max(rig.move_to(position, speed).abs() * COUNTS);
                    }
                }
            }
            println!("{reference:?}, jerk {jerk_limited}: {farthest:.1} of 400 000 counts per mm");
            // Corners of the table are rounded by 2 nm; a count is 2.5 nm.
            assert!(farthest < 80.0, "{farthest}");
            rig.assert_limits();
        }
    }
}

#[test]
fn without_compensation_the_error_is_as_configured() {
    let mut rig = Rig::new(Compensation::default(), |_| {}, ReferenceFlank::Positive);
    assert!((rig.move_to(15.0, 1.0) - error(15.0)).abs() < 1e-4);
    assert!((rig.move_to(5.0, 1.0) - error(5.0) - BACKLASH).abs() < 1e-4);
}

/// Whatever happens, the target keeps the limits of the drive, and stands when the axis rests.
#[test]
fn random_motions_and_stops_keep_the_limits() {
    for seed in 0..200 {
        let mut rng = Random(seed);
        let reference = BOTH[usize::from(rng.is_true(0.5))];
        let jerk_limited = rng.is_true(0.5);
        let mut rig = Rig::new(
            compensation(reference),
            |config| config.jerk_limited = jerk_limited,
            reference,
        );
        let mut standing = 0;
        let mut stopped = true;
        let mut lost = 0;
        for _ in 0..1500 {
            match rng.below(120) {
                0..4 => {
                    let (position, speed, ramp) = (
                        rng.within(-45.0, 45.0),
                        rng.within(0.01, 1.0),
                        rng.within(0.05, 1.0),
                    );
                    let order = Command::MoveTo {
                        position,
                        speed,
                        ramp,
                    };
                    stopped &= rig.axis.command(order).is_err();
                }
                4..8 => {
                    let order = Command::MoveBy {
                        distance: rng.within(-0.2, 0.2),
                        speed: rng.within(0.01, 1.0),
                        ramp: 1.0,
                    };
                    stopped &= rig.axis.command(order).is_err();
                }
                8 => {
                    let order = Command::Velocity {
                        velocity: rng.within(-100.0, 100.0),
                        ramp: rng.within(0.05, 1.0),
                    };
                    stopped &= rig.axis.command(order).is_err();
                }
                9..11 => {
                    rig.axis.command(Command::Stop).unwrap();
                    stopped = true;
                }
                11 => rig.axis.set_rate(rng.within(0.0, 1.2)),
                12 => rig.axis.set_rate(0.0),
                13 => rig.axis.set_rate(1.0),
                14 => {
                    rig.axis.stop_by(StopMethod::Ramp);
                    stopped = true;
                }
                15 if rng.is_true(0.2) => {
                    rig.axis.command(Command::QuickStop).unwrap();
                    stopped = true;
                }
                16 if rng.is_true(0.2) => {
                    rig.drive.fault();
                    stopped = true;
                }
                17 => lost = 1 + rng.below(2),
                18 if rng.is_true(0.2) => lost = 3 + rng.below(27),
                19..22 => {
                    let _ = rig.axis.command(Command::ResetFault);
                    let _ = rig.axis.command(Command::Enable);
                }
                _ => {}
            }
            let ready = rig.axis.status().ready && rig.targets.len() > 1;
            if lost == 0 && rig.silent == 0 && ready && rng.is_true(0.004) {
                // The staged frame was never sent: the drive stands at the target before it.
                rig.out = rig.axis.skipped(3 + rng.below(9));
                let drive = rig.drive.position.round() as i32;
                assert!((rig.out.target_position - drive).abs() <= 1, "seed {seed}");
                rig.targets.clear();
            }
            let before = rig.out.target_position;
            if lost > 0 {
                rig.cycle(false);
                lost -= 1;
                if rig.silent > 2 {
                    assert_eq!(rig.out.target_position, before, "seed {seed}");
                }
                continue;
            }
            let status = rig.cycle(true);
            assert_eq!(status.guarded_cycles, 0, "seed {seed}");
            standing = if stopped && status.target_velocity == 0.0 {
                standing + 1
            } else {
                0
            };
            // 5 % of the velocity end with the limit acceleration within 5 cycles, and with the limit
            // jerk within 2·√(v / j).
            let most = if jerk_limited { 50 } else { 7 };
            if standing > most && status.enabled && rig.targets.len() > 1 {
                assert_eq!(rig.out.target_position, before, "seed {seed}");
            }
            assert!(status.trip.is_none(), "seed {seed}: {status:#?}");
        }
        rig.assert_limits();
    }
}

/// Enabling moves nothing, wherever in its play the drive stands.
#[test]
fn enabling_on_either_flank_moves_nothing() {
    for reference in BOTH {
        let mut rig = Rig::new(compensation(reference), |_| {}, reference);
        for position in [3.0, 2.0, 2.99, 2.98] {
            rig.move_to(position, 1.0);
            let before = rig.out.target_position;
            rig.axis.command(Command::Disable).unwrap();
            rig.until(|s| !s.enabled);
            // A hand turns the motor within its play.
            rig.drive.position += 0.01 * COUNTS;
            rig.cycle(true);
            rig.enable();
            for _ in 0..200 {
                let status = rig.cycle(true);
                let moved = f64::from(rig.out.target_position - before) / COUNTS;
                assert!((moved - 0.01).abs() < 1e-6, "{moved}: {status:#?}");
                assert!((status.position - rig.real).abs() < 1e-4);
            }
            assert!(rig.move_to(position - 0.5, 1.0).abs() < 1e-4);
            assert!(rig.move_to(position, 1.0).abs() < 1e-4);
        }
        rig.assert_limits();
    }
}

/// At the velocity limit over all corners of the table, in CSV with a position loop as well.
#[test]
fn loops_of_the_main_device_correct_too() {
    use ecaxis_axis::{Loops, VelocityLoop};
    let config = |config: &mut AxisConfig| {
        config.scale = Scale::new(2000.0, 5.0)
            .unwrap()
            .with_velocity_unit(ecaxis_axis::VelocityUnit::MILLI_RPM);
        config.mode = Mode::Csv;
        config.modes = ecaxis_axis::Modes::only(Mode::Csv).with(Mode::Csp);
        config.loops = Loops {
            csv: Some(VelocityLoop {
                kv: 20.0,
                feed_forward: 1.0,
            }),
            ..Loops::default()
        };
        config.limits = Limits {
            following_error: Some(0.2),
            ..config.limits
        };
    };
    let limits = compensation(ReferenceFlank::Positive).load_limits(&LIMITS);
    let mut cfg = AxisConfig::new(Mode::Csv, scale(), limits);
    cfg.dead_time_s = 2.0 * DT;
    config(&mut cfg);
    let axis = Axis::compensated(cfg, compensation(ReferenceFlank::Positive)).unwrap();
    let mut rig = crate::common::Rig::new(axis, Drive::at(0));
    let mut load = Load::new(0.0, ReferenceFlank::Positive);
    rig.axis.command(Command::Enable).unwrap();
    rig.until(|s| s.ready, 100);
    for (position, mode) in [
        (40.0, Mode::Csv),
        (-30.0, Mode::Csp),
        (12.0, Mode::Csv),
        (11.9, Mode::Csv),
        (12.0, Mode::Csp),
    ] {
        rig.axis.command(Command::SetMode(mode)).unwrap();
        rig.until(|s| s.mode == mode && s.switching.is_none(), 100);
        rig.axis
            .command(Command::MoveTo {
                position,
                speed: 1.0,
                ramp: 1.0,
            })
            .unwrap();
        let mut real = 0.0;
        for _ in 0..1500 {
            let status = rig.cycle();
            real = load.follow(rig.drive.position / 400.0);
            assert!(status.trip.is_none(), "{status:#?}");
        }
        println!("{mode}: {position} is {real:.4}");
        assert!((real - position).abs() <= 2.0 / 400.0, "{position}: {real}");
    }
}

/// A slip trips the axis. Then its place is unknown: it can be reset and enabled, for homing.
#[test]
fn an_axis_that_has_slipped_can_be_enabled_again() {
    let config = |config: &mut AxisConfig| {
        config.absolute = true;
        config.second_encoder = Some(SecondEncoder {
            counts_per_unit: 1000.0,
            max_difference: 0.1,
            offset: None,
            unsigned: false,
        });
    };
    let mut rig = Rig::new(Compensation::default(), config, ReferenceFlank::Positive);
    rig.second = Some(0);
    for _ in 0..10 {
        let status = rig.cycle(true);
        assert_eq!((status.trip, status.encoder_difference), (None, Some(0.0)));
    }
    rig.second = Some(-101);
    let tripped = rig.until(|status| status.trip.is_some());
    assert!(
        matches!(tripped.trip, Some(Trip::EncoderDifference { .. })),
        "{tripped:?}"
    );
    assert!(!tripped.homed());
    rig.until(|status| !status.enabled);
    rig.axis.command(Command::ResetFault).unwrap();
    rig.until(|status| status.trip.is_none() && status.stop.is_none());
    rig.enable();
    for _ in 0..100 {
        assert_eq!(rig.cycle(true).trip, None);
    }
}

/// An encoder that has restarted from 0 does not trip the axis: it waits for the next homing.
#[test]
fn an_encoder_that_restarts_is_compared_after_homing() {
    for offset in [None, Some(0.0)] {
        let config = |config: &mut AxisConfig| {
            config.absolute = true;
            config.second_encoder = Some(SecondEncoder {
                counts_per_unit: 1000.0,
                max_difference: 0.1,
                offset,
                unsigned: false,
            });
        };
        let mut rig = Rig::new(Compensation::default(), config, ReferenceFlank::Positive);
        rig.second = Some(0);
        rig.cycle(true);
        rig.axis.restart_second_encoder();
        rig.second = Some(5000);
        let status = rig.cycle(true);
        // With a configured offset its counts mean a place.
        assert_eq!(status.encoder_difference, offset.map(|_| -5.0));
        assert_eq!(status.trip.is_some(), offset.is_some());
    }
}
