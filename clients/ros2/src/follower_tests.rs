use super::*;

const DT: f64 = 1e-3;
const STALE: u64 = 100;
const ME: Publisher = [1; 16];

fn config() -> FollowerConfig {
    FollowerConfig {
        limits: MotionLimits {
            velocity: 250.0,
            acceleration: 2500.0,
            jerk: 1e9,
        },
        range: Some([-60.0, 60.0]),
        start_tolerance: 1.0,
        smoothing_s: 0.01,
        stale_cycles: STALE,
        dt_s: DT,
    }
}

/// A follower, and an axis that reaches each set-point within a cycle.
struct Rig {
    follower: Follower,
    position: f64,
    velocity: f64,
    worst: [f64; 2],
}

impl Rig {
    fn new(position: f64) -> Self {
        let mut rig = Self {
            follower: Follower::new(config()),
            position,
            velocity: 0.0,
            worst: [0.0; 2],
        };
        rig.step(1);
        rig
    }

    fn input(&self) -> AxisInput {
        AxisInput {
            target_position: self.position,
            enabled: true,
            stands: self.velocity == 0.0,
            blocked: false,
        }
    }

    fn step(&mut self, cycles: u64) -> Option<End> {
        let (wanted, end) = self.follower.advance(self.input(), cycles);
        let next = match wanted {
            Some(SetPoint::Position(position)) => position,
            _ => self.position,
        };
        let velocity = (next - self.position) / (cycles as f64 * DT);
        // Only while it follows: what follows is the server's stop.
        if wanted.is_some() && cycles == 1 {
            self.worst[0] = self.worst[0].max(velocity.abs());
            self.worst[1] = self.worst[1].max((velocity - self.velocity).abs() / DT);
        }
        (self.position, self.velocity) = (next, velocity);
        end
    }
}

#[test]
fn followers_begin_where_the_axis_is() {
    let mut rig = Rig::new(20.0);
    // What ros2_control sends before its first state.
    assert_eq!(
        rig.follower.command(SetPoint::Position(0.0), ME),
        Err(Refusal::Far(-20.0))
    );
    assert!(rig.follower.is_free());
    rig.follower.command(SetPoint::Position(20.5), ME).unwrap();
    let (first, _) = rig.follower.advance(rig.input(), 1);
    let Some(SetPoint::Position(first)) = first else {
        panic!("{first:?}")
    };
    assert!((first - 20.0).abs() < 0.01, "{first}");
}

#[test]
fn followers_track_slow_publishers_within_the_limits() {
    for period in [2, 10, 20] {
        let mut rig = Rig::new(0.0);
        let sine = |cycle: u64| 10.0 * (1.0 - (cycle as f64 * DT * 3.0).cos());
        let (mut lag, mut jitter) = (0.0_f64, 0);
        for cycle in 0..10_000 {
            // Up to half a period late.
            if cycle >= jitter {
                jitter = cycle + period + (cycle * 7919) % (period / 2 + 1);
                rig.follower
                    .command(SetPoint::Position(sine(cycle)), ME)
                    .unwrap();
            }
            assert_eq!(rig.step(1), None);
            if cycle > 1000 {
                lag = lag.max((rig.position - sine(cycle)).abs());
            }
        }
        // The velocity is 30 at most: the lag is some periods and the smoothing.
        assert!(
            lag < 30.0 * (0.03 + 4.0 * period as f64 * DT),
            "{period}: {lag}"
        );
        assert!(
            rig.worst[0] <= 250.0 && rig.worst[1] <= 2500.0 * 1.001,
            "{:?}",
            rig.worst
        );
    }
}

#[test]
fn far_commands_are_reached_within_the_limits() {
    let mut rig = Rig::new(0.0);
    rig.follower.command(SetPoint::Position(0.0), ME).unwrap();
    rig.step(1);
    for _ in 0..100 {
        rig.follower.command(SetPoint::Position(60.0), ME).unwrap();
        for _ in 0..10 {
            assert_eq!(rig.step(1), None);
            assert!(rig.position <= 60.0);
        }
    }
    assert!((rig.position - 60.0).abs() < 0.01, "{}", rig.position);
    assert!(
        rig.worst[0] <= 250.0 && rig.worst[1] <= 2500.0 * 1.001,
        "{:?}",
        rig.worst
    );
}

#[test]
fn missed_cycles_leave_the_joint_on_its_way() {
    let mut rig = Rig::new(0.0);
    let mut cycle = 0;
    while cycle < 3000 {
        let position = 5.0 * (1.0 - (cycle as f64 * DT * 3.0).cos());
        rig.follower
            .command(SetPoint::Position(position), ME)
            .unwrap();
        let cycles = if cycle % 7 == 0 { 5 } else { 1 };
        assert_eq!(rig.step(cycles), None);
        cycle += cycles;
    }
    let expected = 5.0 * (1.0 - (cycle as f64 * DT * 3.0).cos());
    assert!(
        (rig.position - expected).abs() < 1.0,
        "{} {expected}",
        rig.position
    );
}

#[test]
fn joints_without_commands_end() {
    // Moving: the joint stops and says so. A further command begins again.
    let mut rig = Rig::new(0.0);
    for cycle in 0..200 {
        rig.follower
            .command(SetPoint::Position(cycle as f64 * 0.05), ME)
            .unwrap();
        rig.step(1);
    }
    rig.follower.command(SetPoint::Position(50.0), ME).unwrap();
    let ends: Vec<_> = (0..=STALE).filter_map(|_| rig.step(1)).collect();
    assert_eq!(ends, [End::Stale]);
    assert!(matches!(
        rig.follower.command(SetPoint::Position(50.0), ME),
        Err(Refusal::Moves)
    ));
    // At rest, as the topic interface is near its state: no trouble.
    let mut rig = Rig::new(5.0);
    rig.follower.command(SetPoint::Position(5.0), ME).unwrap();
    let ends: Vec<_> = (0..=STALE + 1).filter_map(|_| rig.step(1)).collect();
    assert_eq!(ends, [End::Silent]);
    // A joint that has reached its last command says so as well, if the commands moved it.
    let mut rig = Rig::new(0.0);
    for cycle in 0..200 {
        let position = f64::from(cycle) * 0.02;
        rig.follower
            .command(SetPoint::Position(position), ME)
            .unwrap();
        rig.step(1);
    }
    let ends: Vec<_> = (0..=STALE + 1).filter_map(|_| rig.step(1)).collect();
    assert_eq!(ends, [End::Stale]);
    assert_eq!(rig.velocity, 0.0);
    // Velocities stop, and a standstill is silent.
    for (velocity, end) in [(10.0, End::Stale), (0.0, End::Silent)] {
        let mut rig = Rig::new(0.0);
        rig.follower
            .command(SetPoint::Velocity(velocity), ME)
            .unwrap();
        let ends: Vec<_> = (0..=STALE + 1).filter_map(|_| rig.step(1)).collect();
        assert_eq!(ends, [end]);
    }
}

#[test]
fn one_publisher_commands_until_it_is_silent() {
    let mut rig = Rig::new(0.0);
    rig.follower.command(SetPoint::Position(0.0), ME).unwrap();
    rig.step(1);
    let other = rig.follower.command(SetPoint::Position(0.0), [2; 16]);
    assert_eq!(other, Err(Refusal::OtherPublisher));
    for _ in 0..=STALE + 1 {
        rig.step(1);
    }
    rig.follower
        .command(SetPoint::Position(0.0), [2; 16])
        .unwrap();
}

#[test]
fn stopped_joints_wait_for_enable() {
    let mut rig = Rig::new(0.0);
    rig.follower.command(SetPoint::Position(0.0), ME).unwrap();
    rig.follower.stop(true);
    rig.step(1);
    assert_eq!(
        rig.follower.command(SetPoint::Position(0.0), ME),
        Err(Refusal::Held)
    );
    rig.follower.release();
    rig.follower.command(SetPoint::Position(0.0), ME).unwrap();
}

#[test]
fn joints_that_cannot_move_do_not_follow() {
    let mut rig = Rig::new(0.0);
    rig.follower.command(SetPoint::Position(0.0), ME).unwrap();
    let lost = AxisInput {
        enabled: false,
        ..rig.input()
    };
    assert_eq!(rig.follower.advance(lost, 1), (None, Some(End::Disabled)));
    assert_eq!(
        rig.follower.command(SetPoint::Position(0.0), ME),
        Err(Refusal::Disabled)
    );
    for input in [
        AxisInput {
            blocked: true,
            ..rig.input()
        },
        AxisInput {
            stands: false,
            ..rig.input()
        },
    ] {
        rig.follower.advance(input, 1);
        assert_eq!(
            rig.follower.command(SetPoint::Position(0.0), ME),
            Err(Refusal::Moves)
        );
    }
}
