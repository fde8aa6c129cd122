//! A reference model of the drive: differential equations for winding and rotor, the continuous
//! transfer functions of the application notes for the loops. The integration step is far below
//! every time constant. The model shares only the plant's data with the simulation.

use std::f64::consts::{PI, TAU};

use crate::drive::plant::PlantParams;

/// 2 µs.
const STEP: f64 = 2e-6;
/// Sampling of the observer, 0.4 ms.
const SAMPLE: u32 = 200;

/// Control parameters in the units of the objects.
#[derive(Debug, Clone, Copy)]
pub(super) struct Objects {
    /// 0x30A0:01–02.
    pub current: [f64; 2],
    /// 0x30A1:01–05.
    pub position: [f64; 5],
    /// 0x30A2:01–05.
    pub velocity: [f64; 5],
    /// 0x30A3:01–05.
    pub observer: [f64; 5],
}

/// The demand on the loop under test, as a function of time.
#[derive(Clone, Copy)]
pub(super) enum Asked<'a> {
    /// The current, in A.
    Current(&'a dyn Fn(f64) -> f64),
    /// The speed in rad/s, and the acceleration for the feed-forward. `fed`: profile velocity mode.
    Velocity {
        speed: &'a dyn Fn(f64) -> (f64, f64),
        fed: bool,
        observed: bool,
    },
    /// The angle, in rad.
    Position(&'a dyn Fn(f64) -> f64),
}

/// The compared values.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sample {
    /// The current, in A.
    pub current: f64,
    /// The speed, in rad/s.
    pub speed: f64,
    /// The angle, in rad.
    pub angle: f64,
}

#[derive(Debug, Clone, Copy, Default)]
struct State {
    current: f64,
    speed: f64,
    angle: f64,
    current_integral: f64,
    integral: f64,
    filtered: f64,
    differentiated: f64,
    observed: [f64; 2],
    observed_load: f64,
}

pub(super) struct Model<'a> {
    pub plant: PlantParams,
    pub gains: Objects,
    pub asked: Asked<'a>,
    /// The load torque, in N·m.
    pub load: f64,
}

impl Model<'_> {
    /// Returns samples after 0.04 ms, 0.08 ms, … .
    pub(super) fn run(&self, seconds: f64) -> Vec<Sample> {
        let mut state = State::default();
        let mut out = Vec::new();
        let mut n = 0_u32;
        while f64::from(n) * STEP < seconds {
            state = self.step(&state, f64::from(n) * STEP);
            n += 1;
            if n.is_multiple_of(SAMPLE) {
                self.correct(&mut state);
            }
            if n.is_multiple_of(20) {
                out.push(Sample {
                    current: state.current,
                    speed: state.speed,
                    angle: state.angle,
                });
            }
        }
        out
    }

    fn current_wanted(&self, t: f64, s: &State) -> (f64, f64, f64) {
        let [ppp, pip, pdp, ..] = self.gains.position.map(|raw| 1e-6 * raw);
        let [vp, vi, ff_speed, ff_acceleration, _] = self.gains.velocity.map(|raw| 1e-6 * raw);
        match self.asked {
            Asked::Current(wanted) => (wanted(t), 0.0, 0.0),
            Asked::Velocity {
                speed,
                fed,
                observed,
            } => {
                let (wanted, acceleration) = speed(t);
                let seen = if observed { s.observed[1] } else { s.filtered };
                let error = wanted - seen;
                let feed = ff_speed * wanted + ff_acceleration * acceleration;
                let feed = if fed { feed } else { 0.0 };
                (vp * error + s.integral + feed, vi * error, 0.0)
            }
            Asked::Position(wanted) => {
                let error = wanted(t) - s.angle;
                // D·s / (1 + τ·s), with τ = D / (10·P)
                let tau = pdp / (10.0 * ppp);
                let d = (pdp * error - s.differentiated) / tau;
                (ppp * error + s.integral + d, pip * error, d)
            }
        }
    }

    fn slope(&self, t: f64, s: &State) -> State {
        let p = &self.plant;
        let (wanted, integral, differentiated) = self.current_wanted(t, s);
        let [cp, ci] = [1e-6 * self.gains.current[0], 1e-3 * self.gains.current[1]];
        let error = wanted - s.current;
        let voltage = cp * error + s.current_integral;
        let km = p.torque_constant;
        let cut_off = TAU * self.gains.velocity[4];
        // nN·m/rpm and mg·cm².
        let (r, j) = (
            self.gains.observer[3] * 1e-9 * 30.0 / PI,
            self.gains.observer[4] * 1e-10,
        );
        State {
            current: (voltage - p.resistance * s.current - km * s.speed) / p.inductance,
            speed: (km * s.current - p.viscous_friction * s.speed - self.load) / p.inertia,
            angle: s.speed,
            current_integral: ci * error,
            integral,
            filtered: cut_off * (s.speed - s.filtered),
            differentiated,
            observed: [
                s.observed[1],
                (km * s.current - s.observed_load - r * s.observed[1]) / j,
            ],
            observed_load: 0.0,
        }
    }

    fn correct(&self, s: &mut State) {
        let [angle, speed, load, ..] = self.gains.observer;
        let error = s.angle - s.observed[0];
        s.observed[0] += 1e-3 * angle * error;
        s.observed[1] += 1e-3 * speed * error;
        s.observed_load -= 1e-6 * load * error;
    }

    /// Runge–Kutta, fourth order.
    fn step(&self, s: &State, t: f64) -> State {
        let a = self.slope(t, s);
        let b = self.slope(t + 0.5 * STEP, &s.plus(&a, 0.5 * STEP));
        let c = self.slope(t + 0.5 * STEP, &s.plus(&b, 0.5 * STEP));
        let d = self.slope(t + STEP, &s.plus(&c, STEP));
        s.plus(&a, STEP / 6.0)
            .plus(&b, STEP / 3.0)
            .plus(&c, STEP / 3.0)
            .plus(&d, STEP / 6.0)
    }
}

impl State {
    fn plus(&self, slope: &Self, dt: f64) -> Self {
        let add = |a: f64, b: f64| a + dt * b;
        Self {
            current: add(self.current, slope.current),
            speed: add(self.speed, slope.speed),
            angle: add(self.angle, slope.angle),
            current_integral: add(self.current_integral, slope.current_integral),
            integral: add(self.integral, slope.integral),
            filtered: add(self.filtered, slope.filtered),
            differentiated: add(self.differentiated, slope.differentiated),
            observed: [
                add(self.observed[0], slope.observed[0]),
                add(self.observed[1], slope.observed[1]),
            ],
            observed_load: add(self.observed_load, slope.observed_load),
        }
    }
}

/// Checks the integrator against the known response of a first-order lag.
#[test]
fn reference_matches_the_exponential_response() {
    let plant = PlantParams {
        torque_constant: 0.0,
        ..PlantParams::default()
    };
    // Pole and zero cancel: R/L = I/P.
    let bandwidth = 1000.0;
    let gains = Objects {
        current: [
            plant.inductance * bandwidth * 1e6,
            plant.resistance * bandwidth * 1e3,
        ],
        position: [1.0; 5],
        velocity: [1.0; 5],
        observer: [1.0; 5],
    };
    let one = |_| 1.0;
    let model = Model {
        plant,
        gains,
        asked: Asked::Current(&one),
        load: 0.0,
    };
    for (n, state) in (1_u32..).zip(model.run(5e-3)) {
        let exact = 1.0 - (-bandwidth * 40e-6 * f64::from(n)).exp();
        assert!((state.current - exact).abs() < 1e-9, "{n}");
    }
}
