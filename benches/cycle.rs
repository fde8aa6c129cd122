//! The cost of a cycle: the whole cycle with simulated drives, and the axes alone.

use std::hint::black_box;
use std::path::Path;
use std::sync::Arc;
use std::sync::mpsc::channel;

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use ecaxis_axis::{Axis, AxisConfig, Command, Inputs, Limits, Mode, Scale};
use ecaxis_master::cancel::CancelToken;
use ecaxis_master::clock::Clock;
use ecaxis_master::config;
use ecaxis_master::rt::cycle::Engine;
use ecaxis_master::session::{Attachments, Options, RunBuilder};

/// Returns a machine of `count` CSP axes at 1 ms.
fn machine(count: usize) -> String {
    let mut text = String::from("[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n");
    for i in 0..count {
        text += &format!(
            "[[device]]\nname = \"a{i}\"\nesi = \"esi/EPOS4.xml\"\nposition = {i}\nmode = \"csp\"\n\
             [device.axis]\nunit = \"turn\"\nper_turn = 1.0\nencoder = 2000\n\
             limits = {{ velocity = 50.0, acceleration = 500.0, torque = 100.0 }}\n"
        );
    }
    text
}

/// Measures a cycle: send, pass through the simulated segment and its drives, receive, check, step,
/// stage, publish.
fn whole_cycle(c: &mut Criterion) {
    let mut group = c.benchmark_group("cycle_with_simulated_drives");
    for count in [2, 16] {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/bench.toml");
        let machine = config::parse(&path, &machine(count)).expect("a valid machine");
        let options = Options {
            clock: Clock::Virtual,
            ..Options::default()
        };
        options.clock.enter();
        let (progress, _receiver) = channel();
        let stop = Arc::<CancelToken>::default();
        let job = RunBuilder {
            machine: &Arc::new(machine),
            options: &options,
            stop,
            progress,
            attachments: Attachments::default(),
        };
        let prepared = job.prepare().expect("comes up");
        let mut engine = Engine::new(prepared.parts);
        group.throughput(Throughput::Elements(count as u64));
        group.bench_function(BenchmarkId::from_parameter(count), |b| {
            b.iter(|| engine.cycle())
        });
    }
    group.finish();
}

/// Measures state machine, trapezoid, limits and supervision of 100 axes in motion.
fn step_axes(c: &mut Criterion) {
    let scale = Scale::new(2000.0, 1.0).expect("a valid scale");
    let limits = Limits {
        position: None,
        velocity: 50.0,
        acceleration: 500.0,
        jerk: None,
        torque: 100.0,
        following_error: None,
    };
    let config = AxisConfig::new(Mode::Csp, scale, limits);
    let mut axes: Vec<Axis> = (0..100)
        .map(|_| Axis::new(config).expect("a valid axis"))
        .collect();
    let mut inputs = Inputs {
        statusword: 0x0240,
        position: Some(0),
        mode_display: Some(8),
        fresh: true,
        ..Inputs::default()
    };
    for axis in &mut axes {
        axis.step(&inputs, 1e-3);
        axis.command(Command::Enable).expect("enables");
        for statusword in [0x0231, 0x0233, 0x1237] {
            inputs.statusword = statusword;
            axis.step(&inputs, 1e-3);
        }
        axis.command(Command::MoveTo {
            position: 1e6,
            speed: 0.5,
            ramp: 0.5,
        })
        .expect("moves");
    }
    let mut group = c.benchmark_group("step_axes");
    group.throughput(Throughput::Elements(100));
    group.bench_function("100", |b| {
        b.iter(|| {
            for axis in &mut axes {
                let outputs = axis.step(black_box(&inputs), 1e-3);
                inputs.position = Some(black_box(outputs.target_position));
            }
        });
    });
    group.finish();
}

criterion_group!(benches, whole_cycle, step_axes);
criterion_main!(benches);
