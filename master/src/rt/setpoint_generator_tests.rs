use ecaxis_axis::group::{Line, LineAxis};
use ecaxis_axis::setpoint::{GearInMode, MotionLimits};
use ecaxis_axis::{AxisConfig, Command, Inputs, Limits, Mode, Outputs, Scale};
use ecaxis_ecat::index::AxisIndex;

use super::*;
use crate::rt::overrides::Rates;

const DT: f64 = 0.001;

const LIMITS: Limits = Limits {
    position: Some([-60.0, 60.0]),
    velocity: 250.0,
    acceleration: 2500.0,
    jerk: Some(50_000.0),
    torque: 100.0,
    following_error: Some(2.0),
};

fn line_request(along: LinePath) -> GeneratorRequest {
    let first = AxisIndex(0);
    GeneratorRequest::Line { along, first }
}

/// An enabled axis whose drive reports the target of the previous cycle.
struct Rig {
    axis: Axis,
    generator: SetpointGenerator,
    out: Outputs,
    before: f64,
}

impl Rig {
    fn new(velocity: f64) -> Self {
        let scale = Scale::new(2000.0, 5.0).expect("a scale");
        let limits = Limits { velocity, ..LIMITS };
        let config = AxisConfig::new(Mode::Csp, scale, limits);
        let mut rig = Self {
            axis: Axis::new(config).expect("an axis"),
            generator: SetpointGenerator::default(),
            out: Outputs::default(),
            before: 0.0,
        };
        rig.axis.command(Command::Enable).expect("takes it");
        for _ in 0..50 {
            rig.cycle(None);
        }
        assert!(rig.axis.status().ready, "{:?}", rig.axis.status());
        rig
    }

    fn cycle(&mut self, master: Option<Motion>) -> f64 {
        // The CiA 402 state follows the Controlword immediately.
        let statusword = match self.out.controlword & 0x0f {
            0x0f => 0x1237,
            0x07 => 0x1233,
            0x06 => 0x1231,
            _ => 0x1250,
        };
        let inputs = Inputs {
            statusword,
            position: Some(self.out.target_position),
            mode_display: Some(8),
            fresh: true,
            ..Inputs::default()
        };
        self.axis.observe(&inputs, DT);
        self.before = self.axis.status().target_position;
        let master = Ok(Master {
            motion: master.unwrap_or_default(),
            comes_to_rest: false,
        });
        let _ = self
            .generator
            .advance(&mut self.axis, master, Rates::WHOLE, DT);
        self.out = self.axis.act();
        self.axis.status().target_position
    }

    fn begin(&mut self, start: GeneratorRequest, master: Option<Motion>) {
        let status = self.axis.status();
        let master = Ok(master.unwrap_or_default());
        self.generator.begin(start, &status, master, Rate::WHOLE);
    }

    fn part(&self, target: f64, speed: f64) -> LineAxis {
        let limits = self.axis.config().limits;
        LineAxis {
            from: commanded(&self.axis.status()),
            target,
            limits: MotionLimits {
                velocity: limits.velocity * speed,
                ..limits.motion()
            },
            fastest: limits.velocity,
            range: limits.position,
        }
    }
}

/// Returns the distance of each axis from the straight line in user units.
fn off_the_line(gone: &[f64; 6], way: &[f64; 6]) -> [f64; 6] {
    let length: f64 = way.iter().map(|w| w * w).sum();
    let part: f64 = way.iter().zip(gone).map(|(w, g)| w * g).sum::<f64>() / length;
    [0, 1, 2, 3, 4, 5].map(|i| gone[i] - part * way[i])
}

#[test]
fn six_axes_on_lines_there_and_back_arrive_in_the_same_cycle() {
    let mut axes = [250.0, 100.0, 60.0, 200.0, 250.0, 33.0].map(Rig::new);
    let all = [0, 1, 2, 3, 4, 5];
    for (targets, speed) in [
        ([50.0, 20.0, -3.0, 0.0, 55.5, 1.0], 1.0),
        ([0.0, 0.0, 0.0, 0.0, 0.0, 0.0], 0.5),
        ([-7.3, 55.0, 10.0, -59.0, 0.001, 2.0], 0.9),
    ] {
        let parts = all.map(|i| axes[i].part(targets[i], speed));
        let line = Line::plan(&parts).expect("a line");
        for (rig, part) in axes.iter_mut().zip(&parts) {
            rig.begin(line_request(line.along(part)), None);
        }
        let planned = (line.duration_s() / DT).ceil() as u32;
        for cycle in 0.. {
            assert!(cycle <= planned + 2, "{:?}", axes[0].axis.status());
            let at = all.map(|i| axes[i].cycle(None));
            let way = all.map(|i| targets[i] - parts[i].from.position);
            let off = off_the_line(&all.map(|i| at[i] - parts[i].from.position), &way);
            assert!(off.iter().all(|off| off.abs() < 1e-9), "{off:?}");
            // The drives receive whole counts, 400 per millimetre.
            let sent = all.map(|i| f64::from(axes[i].out.target_position) / 400.0);
            let off = off_the_line(&all.map(|i| sent[i] - parts[i].from.position), &way);
            assert!(off.iter().all(|off| off.abs() < 1.0 / 400.0), "{off:?}");
            let states = all.map(|i| axes[i].generator.state());
            assert!(states.iter().all(|state| *state == states[0]), "{states:?}");
            if states[0] == GeneratorState::Finished {
                break;
            }
            assert_eq!(states[0], GeneratorState::Running);
        }
        for (rig, target) in axes.iter_mut().zip(targets) {
            for _ in 0..5 {
                rig.cycle(None);
            }
            assert_eq!(rig.axis.status().target_position, target);
        }
    }
}

#[test]
fn a_gear_follows_within_the_same_cycle_and_ends_with_a_command() {
    let (mut master, mut follower) = (Rig::new(250.0), Rig::new(250.0));
    let start = GeneratorRequest::Gear {
        master: GearMaster::Axis {
            axis: AxisIndex(0),
            actual: false,
        },
        cam: None,
        config: GearConfig {
            ratio: -0.5,
            engage: GearInMode::Here,
            smoothing_s: 0.0,
            limits: LIMITS.motion(),
            range: LIMITS.position,
        },
    };
    let now = commanded(&master.axis.status());
    follower.begin(start, Some(now));
    let to = Command::MoveTo {
        position: 40.0,
        speed: 1.0,
        ramp: 0.8,
    };
    master.axis.command(to).expect("takes it");
    for _ in 0..600 {
        let at = master.cycle(None);
        let master_motion = commanded(&master.axis.status());
        let follows = follower.cycle(Some(master_motion));
        assert!((follows + 0.5 * at).abs() < 1e-9, "{follows} {at}");
        assert_eq!(follower.generator.state(), GeneratorState::Engaged);
    }
    assert_eq!(master.axis.status().target_position, 40.0);
    follower.axis.command(Command::Stop).expect("takes it");
    follower.generator.end();
    assert_eq!(follower.generator.state(), GeneratorState::None);
}

#[test]
fn rejected_set_point_ends_the_generator() {
    let mut rig = Rig::new(250.0);
    let part = rig.part(30.0, 1.0);
    let line = Line::plan(&[part]).expect("a line");
    rig.begin(line_request(line.along(&part)), None);
    for _ in 0..60 {
        rig.cycle(None);
    }
    rig.axis.command(Command::Disable).expect("takes it");
    for _ in 0..200 {
        rig.cycle(None);
    }
    assert!(
        matches!(
            rig.generator.state(),
            GeneratorState::Failed(GeneratorError::Refused(_))
        ),
        "{:?}",
        rig.generator.state()
    );
}

/// Moves of different length and limits end in the same cycle, each within its limits.
#[test]
fn moves_timed_together_arrive_in_the_same_cycle() {
    use ecaxis_axis::group::arrive_together;
    use ecaxis_axis::setpoint::{Goal, MoveRequest};
    let axes = [(50.0, 250.0), (3.0, 40.0), (-20.0, 250.0)];
    let mut rigs: Vec<Rig> = axes.iter().map(|&(_, limit)| Rig::new(limit)).collect();
    let mut moves: Vec<JerkLimited> = axes
        .iter()
        .zip(&rigs)
        .map(|(&(target, _), rig)| {
            let status = rig.axis.status();
            let limits = rig.axis.config().limits.motion();
            let order = MoveRequest::within(Goal::Position(target), limits);
            JerkLimited::new(order, commanded(&status), DT).expect("a way")
        })
        .collect();
    let alone: Vec<f64> = moves.iter().map(JerkLimited::duration_s).collect();
    let duration = arrive_together(&mut moves).expect("timed");
    assert!(alone[0] > 2.0 * alone[1], "{alone:?}");
    for (rig, planned) in rigs.iter_mut().zip(&moves) {
        rig.begin(GeneratorRequest::Move(*planned), None);
    }
    let mut arrived = vec![None; axes.len()];
    for cycle in 0..2000 {
        for (index, rig) in rigs.iter_mut().enumerate() {
            let before = commanded(&rig.axis.status()).velocity;
            let position = rig.cycle(None);
            let change = (commanded(&rig.axis.status()).velocity - before).abs();
            assert!(change <= 2500.0 * DT * 1.000_001, "{change}");
            if arrived[index].is_none() && rig.generator.state() == GeneratorState::Finished {
                assert_eq!(position, axes[index].0);
                arrived[index] = Some(cycle);
            }
        }
    }
    assert!(arrived[0].is_some(), "{duration} s");
    assert!(
        arrived.iter().all(|&cycle| cycle == arrived[0]),
        "{arrived:?}"
    );
}
