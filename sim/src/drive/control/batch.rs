//! Current loops and motors of several drives at once. Each step of one drive is a chain of
//! dependent operations, so interleaving several drives uses the processor better. Every drive gets
//! exactly the result of a separate calculation.

use super::{Controller, SUBSTEPS};
use crate::drive::plant::Plant;

/// Values that the steps change.
struct State<const N: usize> {
    current: [f64; N],
    velocity: [f64; N],
    position: [f64; N],
    before: [f64; N],
    integral: [f64; N],
}

/// Values that the steps do not change.
struct Constants<const N: usize> {
    wanted: [f64; N],
    p: [f64; N],
    i: [f64; N],
    supply: [f64; N],
    torque_constant: [f64; N],
    current_decay: [f64; N],
    current_per_volt: [f64; N],
    load_torque: [f64; N],
    velocity_decay: [f64; N],
    velocity_per_torque: [f64; N],
    friction: [f64; N],
    counts_per_velocity: [f64; N],
    low: [f64; N],
    high: [f64; N],
}

fn each<const N: usize>(lane: impl FnMut(usize) -> f64) -> [f64; N] {
    std::array::from_fn(lane)
}

/// As [`f64::clamp`] between `-limit` and `limit`.
fn within(value: f64, limit: f64) -> f64 {
    let value = if value < -limit { -limit } else { value };
    if value > limit { limit } else { value }
}

/// [`Controller::drive`] for each drive towards these currents. No shaft may be blocked.
pub(super) fn drive<const N: usize>(
    together: &mut [(&mut Controller, &mut Plant); N],
    wanted: [f64; N],
) {
    let of = |value: fn(&Controller, &Plant) -> f64| {
        together
            .each_ref()
            .map(|(controller, plant)| value(controller, plant))
    };
    let k = Constants {
        wanted,
        p: of(|c, _| c.current_loop.p),
        i: of(|c, _| c.current_loop.i),
        supply: of(|c, _| c.current_loop.supply),
        torque_constant: of(|_, p| p.torque_constant),
        current_decay: of(|_, p| p.current_decay),
        current_per_volt: of(|_, p| p.current_per_volt),
        load_torque: of(|_, p| p.load_torque),
        velocity_decay: of(|_, p| p.velocity_decay),
        velocity_per_torque: of(|_, p| p.velocity_per_torque),
        friction: of(|_, p| p.coulomb * p.velocity_per_torque),
        counts_per_velocity: of(|_, p| p.counts_per_velocity),
        low: of(|_, p| p.ends.0),
        high: of(|_, p| p.ends.1),
    };
    let mut s = State {
        current: of(|_, p| p.current),
        velocity: of(|_, p| p.velocity),
        position: of(|_, p| p.position),
        before: of(|c, _| c.current_loop.before),
        integral: of(|c, _| c.current_loop.integral),
    };
    let mut sum = [0.0; N];
    for _ in 0..SUBSTEPS {
        step(&mut s, &k);
        sum = each(|n| sum[n] + s.current[n]);
    }
    for (n, (controller, plant)) in together.iter_mut().enumerate() {
        plant.current = s.current[n];
        plant.velocity = s.velocity[n];
        plant.position = s.position[n];
        controller.current_loop.before = s.before[n];
        controller.current_loop.integral = s.integral[n];
        controller.driven(plant, sum[n]);
    }
}

/// One current-loop step: `CurrentLoop::step` and [`Plant::drive`].
#[inline]
fn step<const N: usize>(s: &mut State<N>, k: &Constants<N>) {
    let error: [f64; N] =
        each(|n| k.wanted[n] - (s.current[n] + 0.5 * (s.current[n] - s.before[n])));
    let voltage: [f64; N] = each(|n| within(k.p[n] * error[n] + s.integral[n], k.supply[n]));
    s.integral = each(|n| within(s.integral[n] + k.i[n] * error[n], k.supply[n]));
    s.before = s.current;
    let back_emf: [f64; N] = each(|n| k.torque_constant[n] * s.velocity[n]);
    s.current = each(|n| {
        s.before[n] * k.current_decay[n] + (voltage[n] - back_emf[n]) * k.current_per_volt[n]
    });
    let torque: [f64; N] =
        each(|n| k.torque_constant[n] * (0.5 * (s.before[n] + s.current[n])) - k.load_torque[n]);
    let free: [f64; N] =
        each(|n| s.velocity[n] * k.velocity_decay[n] + torque[n] * k.velocity_per_torque[n]);
    let velocity: [f64; N] = each(|n| (free[n].abs() - k.friction[n]).max(0.0).copysign(free[n]));
    let position: [f64; N] =
        each(|n| s.position[n] + 0.5 * (s.velocity[n] + velocity[n]) * k.counts_per_velocity[n]);
    let (low, high) = (k.low, k.high);
    let beyond = |n: usize| position[n] < low[n] || position[n] > high[n];
    if (0..N).any(beyond) {
        s.velocity = each(|n| if beyond(n) { 0.0 } else { velocity[n] });
        s.position = each(|n| {
            if beyond(n) {
                position[n].clamp(low[n], high[n])
            } else {
                position[n]
            }
        });
    } else {
        (s.velocity, s.position) = (velocity, position);
    }
}
