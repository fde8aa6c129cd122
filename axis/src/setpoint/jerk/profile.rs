//! Segments of constant jerk in sequence.

/// Position relative to the start of the profile, velocity and acceleration at one moment. The
/// velocity of [`super::Motion`] is the mean of a cycle instead.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct State {
    pub(crate) position: f64,
    pub(crate) velocity: f64,
    pub(crate) acceleration: f64,
}

impl State {
    pub(crate) fn after(self, jerk: f64, time: f64) -> Self {
        let Self {
            position: p,
            velocity: v,
            acceleration: a,
        } = self;
        Self {
            position: p + time * (v + time * (a / 2.0 + time * jerk / 6.0)),
            velocity: v + time * (a + time * jerk / 2.0),
            acceleration: a + time * jerk,
        }
    }

    fn mirrored(self) -> Self {
        Self {
            position: -self.position,
            velocity: -self.velocity,
            acceleration: -self.acceleration,
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct JerkSegment {
    pub(crate) jerk: f64,
    pub(crate) time: f64,
    /// Starts with acceleration 0. A rounding residue would add up over a long cruise.
    level: bool,
}

impl JerkSegment {
    pub(crate) fn new(jerk: f64, time: f64) -> Self {
        // Rounding makes some times slightly negative.
        Self {
            jerk,
            time: time.max(0.0),
            level: false,
        }
    }

    /// Creates a segment of constant velocity.
    pub(crate) fn cruise(time: f64) -> Self {
        Self {
            level: true,
            ..Self::new(0.0, time)
        }
    }

    pub(crate) fn enter(self, state: State) -> State {
        State {
            acceleration: if self.level { 0.0 } else { state.acceleration },
            ..state
        }
    }
}

/// An optional stop, a change of velocity, a cruise, another change.
pub(crate) const SEGMENTS: usize = 10;

#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct Profile {
    segments: [JerkSegment; SEGMENTS],
    used: usize,
}

impl Profile {
    pub(crate) fn of(parts: &[&[JerkSegment]]) -> Self {
        let mut profile = Self::default();
        let given = parts.iter().flat_map(|part| part.iter());
        for (place, &segment) in profile.segments.iter_mut().zip(given) {
            *place = segment;
            profile.used += 1;
        }
        profile
    }

    pub(crate) fn get(&self, index: usize) -> Option<JerkSegment> {
        self.segments().get(index).copied()
    }

    pub(crate) fn segments(&self) -> &[JerkSegment] {
        self.segments.get(..self.used).unwrap_or(&self.segments)
    }

    pub(crate) fn duration(&self) -> f64 {
        self.segments().iter().map(|s| s.time).sum()
    }

    pub(crate) fn end(&self, start: State) -> State {
        travel(start, self.segments())
    }

    pub(crate) fn mirrored(mut self) -> Self {
        for segment in &mut self.segments {
            segment.jerk = -segment.jerk;
        }
        self
    }

    /// Returns the same way, slower by `factor`. Only from rest: another start would change its
    /// velocity.
    pub(crate) fn slowed(mut self, factor: f64) -> Self {
        for segment in &mut self.segments {
            segment.time *= factor;
            segment.jerk /= factor * factor * factor;
        }
        self
    }

    /// Returns the lowest and highest position on the way.
    pub(crate) fn span(&self, start: State) -> [f64; 2] {
        let mut span = [start.position, start.position];
        let mut state = start;
        let mut visit = |position: f64| {
            span = [span[0].min(position), span[1].max(position)];
        };
        for segment in self.segments() {
            state = segment.enter(state);
            for time in turning_points(state, segment.jerk) {
                if time > 0.0 && time < segment.time {
                    visit(state.after(segment.jerk, time).position);
                }
            }
            state = state.after(segment.jerk, segment.time);
            visit(state.position);
        }
        span
    }
}

pub(crate) fn travel(start: State, segments: &[JerkSegment]) -> State {
    segments
        .iter()
        .fold(start, |state, s| s.enter(state).after(s.jerk, s.time))
}

/// Returns the times at which the velocity is zero: v + a·t + j·t²/2 = 0. A missing solution is
/// negative or NaN.
fn turning_points(state: State, jerk: f64) -> [f64; 2] {
    let State {
        velocity: v,
        acceleration: a,
        ..
    } = state;
    if jerk == 0.0 {
        return [-v / a, f64::NAN];
    }
    let root = (a * a - 2.0 * jerk * v).sqrt();
    let q = -(a + root.copysign(a));
    [q / jerk, 2.0 * v / q]
}

/// Returns the fastest change from (v₀, a₀) to `velocity` with acceleration 0.
pub(crate) fn velocity_change(
    start: State,
    velocity: f64,
    acceleration: f64,
    jerk: f64,
) -> [JerkSegment; 3] {
    let sign = if velocity >= coasting(start, jerk) {
        1.0
    } else {
        -1.0
    };
    let a = sign * start.acceleration;
    let change = sign * (velocity - start.velocity);
    let up = sign * jerk;
    let peak = (jerk * change + a * a / 2.0).max(0.0).sqrt().max(a);
    if peak <= acceleration {
        return [
            JerkSegment::new(up, (peak - a) / jerk),
            JerkSegment::default(),
            JerkSegment::new(-up, peak / jerk),
        ];
    }
    let (first, rest) = if a <= acceleration {
        let gained = (acceleration * acceleration - a * a) / (2.0 * jerk);
        (
            JerkSegment::new(up, (acceleration - a) / jerk),
            change - gained,
        )
    } else {
        let gained = (a * a - acceleration * acceleration) / (2.0 * jerk);
        (
            JerkSegment::new(-up, (a - acceleration) / jerk),
            change - gained,
        )
    };
    let last = acceleration * acceleration / (2.0 * jerk);
    [
        first,
        JerkSegment::new(0.0, (rest - last) / acceleration),
        JerkSegment::new(-up, acceleration / jerk),
    ]
}

/// Returns the velocity that remains once the acceleration is reduced to zero.
pub(crate) fn coasting(state: State, jerk: f64) -> f64 {
    state.velocity + state.acceleration * state.acceleration.abs() / (2.0 * jerk)
}

/// Returns `state` mirrored such that `sign` is forwards.
pub(crate) fn mirrored(state: State, sign: f64) -> State {
    if sign < 0.0 { state.mirrored() } else { state }
}
