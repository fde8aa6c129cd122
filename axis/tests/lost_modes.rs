//! Lost frames during a mode switch: the axis does not know whether the drive has received it.

use std::collections::VecDeque;

use crate::common::{DT, Drive, LIMITS, Rig, all, scale};
use ecaxis_axis::{Axis, AxisConfig, AxisStatus, Command, Limits, Mode, Modes, Outputs, State};

const COUNTS_PER_UNIT: f64 = 400.0;
const MRPM_PER_UNIT: f64 = 12_000.0;
const SPEED: f64 = 100.0;
/// Counts per cycle at [`SPEED`].
const WAY: f64 = SPEED * DT * COUNTS_PER_UNIT;

const ENDLESS: Limits = Limits {
    position: None,
    ..LIMITS
};

#[derive(Debug, Clone, Copy, PartialEq)]
enum Lost {
    Nothing,
    /// The frame to the drive is lost: the drive receives nothing.
    Frame,
    /// The answer is lost.
    Answer,
}

/// Advances the drive with its last outputs: it keeps moving, or stands at its last target.
fn alone(drive: &mut Drive) {
    if drive.state == State::OperationEnabled && drive.mode == Mode::Csp.code() {
        drive.velocity = 0.0;
    }
    drive.position += drive.velocity * DT;
}

/// A rig whose drive changes its mode some cycles after it received the request.
struct Line {
    rig: Rig,
    modes: VecDeque<i8>,
}

impl Line {
    /// Returns a rig that moves at [`SPEED`] in the mode of `config`.
    fn under_way(config: AxisConfig, late: usize) -> Self {
        let mode = config.mode;
        let mut rig = Rig::new(Axis::new(config).unwrap(), Drive::at(0));
        rig.axis.command(Command::Enable).unwrap();
        rig.until(|s| s.ready, 100);
        let velocity = Command::Velocity {
            velocity: SPEED,
            // A torque that the motor reaches.
            ramp: if mode == Mode::Cst { 0.1 } else { 1.0 },
        };
        rig.axis.command(velocity).unwrap();
        let status = rig.run(2000);
        assert!((status.velocity - SPEED).abs() < 0.5, "{mode}: {status:?}");
        let modes = std::iter::repeat_n(mode.code(), late).collect();
        Self { rig, modes }
    }

    /// Runs one cycle. Returns the status and the outputs that reached the drive.
    fn cycle(&mut self, lost: Lost) -> (AxisStatus, Option<Outputs>) {
        let rig = &mut self.rig;
        let mut inputs = rig.drive.inputs();
        inputs.fresh = lost == Lost::Nothing;
        let got = (lost != Lost::Frame).then_some(rig.out);
        match got {
            Some(out) => {
                self.modes.push_back(out.mode);
                let mode = self.modes.pop_front().unwrap();
                rig.drive.cycle(&Outputs { mode, ..out }, DT);
            }
            None => alone(&mut rig.drive),
        }
        rig.out = rig.axis.step(&inputs, DT);
        (rig.axis.status(), got)
    }
}

/// Switches to CSP; `delivered` cycles later, `lost` frames or answers are lost.
fn into_csp(from: Mode, late: usize, delivered: u32, lost: u32, what: Lost, most: f64) {
    let case = format!("{from}, {late} late, {delivered} delivered, {lost} of {what:?} lost");
    let mut line = Line::under_way(all(from, ENDLESS), late);
    line.rig.axis.command(Command::SetMode(Mode::Csp)).unwrap();
    line.cycle(Lost::Nothing);
    for n in 0..delivered + lost + 800 {
        let now = if (delivered..delivered + lost).contains(&n) {
            what
        } else {
            Lost::Nothing
        };
        let (mode, position) = (line.rig.drive.mode, line.rig.drive.position);
        let (status, got) = line.cycle(now);
        assert_eq!(status.trip, None, "{case}, cycle {n}");
        if let Some(out) = got
            && late == 0
            && out.mode == Mode::Csp.code()
            && mode != out.mode
        {
            let step = f64::from(out.target_position) - position;
            assert!(step.abs() <= most, "{case}, cycle {n}: {step} counts");
        }
        let step = line.rig.drive.position - position;
        assert!(step.abs() <= most, "{case}, cycle {n}: moved by {step}");
    }
    let status = line.rig.axis.status();
    assert_eq!(
        (status.mode, status.switching, line.rig.drive.mode),
        (Mode::Csp, None, Mode::Csp.code()),
        "{case}"
    );
    let at_speed = (status.target_velocity - SPEED).abs() < 0.5;
    assert!(at_speed, "{case}: {}", status.target_velocity);
}

/// A drive that kept moving does not jump back to an old target.
#[test]
fn csp_request_in_lost_frames_does_not_jump() {
    for from in [Mode::Csv, Mode::Pv, Mode::Cst] {
        for delivered in 0..4 {
            for lost in 1..30 {
                into_csp(from, 0, delivered, lost, Lost::Frame, 3.0 * WAY + 3.0);
            }
        }
    }
}

/// The drive has the mode, and the axis does not know it.
#[test]
fn csp_request_with_lost_answers_does_not_jump() {
    for from in [Mode::Csv, Mode::Pv, Mode::Cst] {
        for delivered in 0..4 {
            for lost in 1..30 {
                into_csp(from, 0, delivered, lost, Lost::Answer, 3.0 * WAY + 3.0);
            }
        }
    }
}

/// After a withdrawn request, the drive keeps its mode while further frames are lost soon: each change
/// of mode in motion is a disturbance.
#[test]
fn two_bursts_of_lost_frames_withdraw_csp_once() {
    for what in [Lost::Frame, Lost::Answer] {
        for (lost, gap) in (3..7).flat_map(|lost| (1..5).map(move |gap| (lost, gap))) {
            let mut line = Line::under_way(all(Mode::Pv, ENDLESS), 0);
            line.rig.axis.command(Command::SetMode(Mode::Csp)).unwrap();
            let (mut before, mut withdrawn) = (None, 0);
            for n in 0..2 * lost + gap + 800 {
                let is_lost = n < lost || (lost + gap..2 * lost + gap).contains(&n);
                let (status, _) = line.cycle(if is_lost { what } else { Lost::Nothing });
                let asked = line.rig.out.mode;
                assert_eq!(status.trip, None);
                withdrawn += u32::from(before == Some(Mode::Csp.code()) && before != Some(asked));
                before = Some(asked);
            }
            assert!(withdrawn <= 1, "{what:?}, {lost}, {gap}: {withdrawn}");
            assert_eq!(line.rig.axis.status().mode, Mode::Csp);
        }
    }
}

/// A slow drive receives both modes in turn; its first displays do not count.
#[test]
fn csp_of_a_slow_drive_does_not_jump() {
    for late in 1..8 {
        for lost in 1..20 {
            into_csp(Mode::Csv, late, 0, lost, Lost::Answer, 12.0 * WAY);
        }
    }
}

fn out_of_csp(config: AxisConfig, delivered: u32, lost: u32) {
    let case = format!("{delivered} delivered, {lost} lost");
    let mut line = Line::under_way(config, 0);
    line.rig.axis.command(Command::SetMode(Mode::Csv)).unwrap();
    line.cycle(Lost::Nothing);
    for n in 0..delivered + lost + 800 {
        let now = if (delivered..delivered + lost).contains(&n) {
            Lost::Frame
        } else {
            Lost::Nothing
        };
        let drive = &line.rig.drive;
        // A drive at standstill stays there.
        let stands = now != Lost::Frame && n == delivered + lost && drive.mode == Mode::Csp.code();
        let before = if stands { 0.0 } else { drive.velocity };
        let (status, got) = line.cycle(now);
        assert_eq!(status.trip, None, "{case}, cycle {n}");
        let Some(out) = got.filter(|out| out.mode == Mode::Csv.code()) else {
            continue;
        };
        let before = before / COUNTS_PER_UNIT;
        let asked = f64::from(out.target_velocity) / MRPM_PER_UNIT;
        let most = LIMITS.acceleration * DT * 4.0;
        assert!(
            (asked - before).abs() <= most,
            "{case}, cycle {n}: {asked} at {before} units/s"
        );
    }
    let status = line.rig.axis.status();
    assert_eq!((status.mode, status.switching), (Mode::Csv, None), "{case}");
    assert!((status.velocity - SPEED).abs() < 0.5, "{case}");
}

/// A drive that has left CSP keeps its last velocity and does not stop in one cycle.
#[test]
fn csv_keeps_its_velocity_after_lost_frames() {
    let plain = AxisConfig {
        modes: Modes::only(Mode::Csp).with(Mode::Csv),
        ..AxisConfig::new(Mode::Csp, scale(), ENDLESS)
    };
    for config in [plain, all(Mode::Csp, ENDLESS)] {
        for delivered in 0..4 {
            for lost in 3..30 {
                out_of_csp(config, delivered, lost);
            }
        }
    }
}

/// Neither a pending mode nor a displayed mode times out.
#[test]
fn pending_mode_does_not_time_out() {
    let config = AxisConfig {
        mode_time_s: 0.006,
        ..all(Mode::Csv, ENDLESS)
    };
    let mut line = Line::under_way(config, 0);
    line.rig.axis.command(Command::SetMode(Mode::Csp)).unwrap();
    for n in 0..100 {
        let lost = if (1..50).contains(&n) {
            Lost::Frame
        } else {
            Lost::Nothing
        };
        let (status, _) = line.cycle(lost);
        assert_eq!((status.switch_failed, status.trip), (None, None), "{n}");
    }
    assert_eq!(line.rig.axis.status().mode, Mode::Csp);
}
