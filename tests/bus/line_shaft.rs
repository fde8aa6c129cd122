//! Line shafts: an axis of one bus is the master of axes of another one. Their clocks are 50 ppm
//! apart. Set-points go from the first to the second through a channel with delay and loss. All
//! values are those of the set-points, with their instants in common time, or of the frames.

use std::collections::VecDeque;
use std::fmt;
use std::sync::{Arc, LazyLock, Mutex};

use ecaxis_axis::setpoint::{LineShaftPoint, Motion};
use ecaxis_master::rt::setpoint_cell::{SetpointCell, SetpointCells};
use ecaxis_master::supervise::operator::{ProgramRequest, Request};
use ecaxis_test_support::random::Random;
use ecaxis_test_support::{assert_contains, machine, virtual_time};

use crate::common_time::{ALIGN, Act, BEGIN, MS, Plan, Run, SECOND, run};

const COUNTS: f64 = 131_072.0;
/// An axis has 12 bytes out and 13 bytes in, at the same place of the image.
const REGION: usize = 13;
/// The time between two messages of the leader.
const INTERVAL: u64 = 5;
/// The begin of both programs.
const START: u64 = BEGIN + 6 * SECOND;
/// Of 8 turns of the shaft. Not all followers need it.
const CAM: &str =
    "[[cam]]\nname = \"cam\"\npoints = [[0.0, 0.0], [4.0, 2.0], [8.0, 0.0]]\nrepeat = true\n";
const RATIOS: [f64; 3] = [2.0, -0.5, 1.0];
/// Twice that of the leader: the rest is for catching up.
const ACCELERATION: f64 = 200.0;

type OfCycle = dyn FnMut(u64, &[u8]) + Send;

/// What a test does with the process data of each cycle, at its common time.
pub(crate) struct EachCycle(pub Box<OfCycle>);

impl fmt::Debug for EachCycle {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("EachCycle")
    }
}

fn device(n: usize, mode: &str, drift: f64, limits: &str) -> String {
    format!(
        "[[device]]\nname = \"a{n}\"\nesi = \"esi/SV1.xml\"\nposition = {n}\nmode = \"{mode}\"\n[device.axis]\n\
         encoder = {COUNTS}\nlimits = {{ {limits}, torque = 300.0, following_error = 40.0 }}\n\
         {}[device.sim]\ndrift_ppm = {drift:?}\n",
        if mode == "csv" {
            "csv = { kv = 30.0, feed_forward = 1.0 }\n"
        } else {
            ""
        }
    )
}

fn start(at: u64) -> (u64, Act) {
    (at, Act::Request(Request::Program(ProgramRequest::Start)))
}

/// The set-points that a leader publishes, one for each cycle: a jerk-limited move, a constant
/// velocity, and a reversal.
static LEADER: LazyLock<Vec<LineShaftPoint>> = LazyLock::new(|| {
    let steps = "[[step]]\ndwell = \"600ms\"\n[[step]]\nmove = { a0 = 5.0 }\n[[step]]\ndwell = \"200ms\"\n\
                 [[step]]\nvelocity = { a0 = 8.0 }\n[[step]]\ndwell = \"600ms\"\n\
                 [[step]]\nvelocity = { a0 = -8.0 }\n[[step]]\ndwell = \"600ms\"\n[[step]]\nstop = [\"a0\"]\n";
    let limits = "velocity = 10.0, acceleration = 100.0, jerk = 5000.0";
    let points = lead(&device(0, "csp", -25.0, limits), steps);
    assert!(
        points
            .windows(2)
            .all(|p| p[1].at_ns > p[0].at_ns && p[0].stream == p[1].stream)
    );
    points
});

/// Runs a leader, and returns what it publishes.
fn lead(device: &str, steps: &str) -> Vec<LineShaftPoint> {
    let text = format!("[bus]\ncycle = \"1ms\"\n{ALIGN}\n{device}{steps}");
    let cell = Arc::new(SetpointCell::new(41));
    let log = Arc::<Mutex<Vec<LineShaftPoint>>>::default();
    let (reads, kept) = (Arc::clone(&cell), Arc::clone(&log));
    let mut last = None;
    let each = move |_: u64, _: &[u8]| {
        reads.read(&mut last);
        let mut kept = kept.lock().expect("one thread");
        let newer = last.filter(|point| kept.last() != Some(point));
        kept.extend(newer);
    };
    let leader = run(Plan {
        machine: machine(&text),
        options: virtual_time(),
        seed: 1,
        begin: BEGIN + 654_321,
        acts: vec![start(START)],
        until: START + 4300 * MS,
        setpoints: SetpointCells {
            axes: [cell].into(),
            ..SetpointCells::default()
        },
        each_cycle: Some(EachCycle(Box::new(each))),
    });
    assert_eq!((leader.error, leader.kept.events.len()), (None, 1));
    std::mem::take(&mut *log.lock().expect("one thread"))
}

/// A leader that stops without a jerk limit decelerates up to its last cycle. The point of that
/// cycle has no motion: followers without a newer one would be predicted to move backwards.
#[test]
fn a_leader_that_stops_publishes_no_motion_at_its_end() {
    let limits = "velocity = 10.0, acceleration = 100.0";
    for end in [
        "stop = [\"a0\"]",
        "velocity = { a0 = 0.0 }",
        "move_by = { a0 = 5.0 }",
    ] {
        let steps = format!(
            "[[step]]\nvelocity = {{ a0 = 8.0 }}\n[[step]]\ndwell = \"200ms\"\n[[step]]\n{end}\n"
        );
        let points = lead(&device(0, "csp", 0.0, limits), &steps);
        let fastest = points.iter().map(|p| p.motion.velocity).fold(0.0, f64::max);
        assert!(fastest > 7.9, "{end}: {fastest}");
        assert!(points.last().is_some_and(|p| p.motion.velocity == 0.0));
        for point in &points {
            let Motion {
                velocity,
                acceleration,
                ..
            } = point.motion;
            assert!(velocity >= 0.0, "{end}: {velocity}");
            assert!(
                velocity > 0.0 || acceleration == 0.0,
                "{end}: {acceleration}"
            );
        }
    }
}

/// In CSV without a position loop, an axis has no commanded position.
#[test]
fn a_leader_without_positions_publishes_none() {
    let limits = "velocity = 10.0, acceleration = 100.0";
    let steps = "[[step]]\nvelocity = { a0 = 8.0 }\n[[step]]\ndwell = \"200ms\"\n[[step]]\nstop = [\"a0\"]\n";
    let with_loop = device(0, "csv", 0.0, limits);
    let without = with_loop.replace("csv = { kv = 30.0, feed_forward = 1.0 }\n", "");
    assert_ne!(with_loop, without);
    assert!(lead(&with_loop, steps).len() > 100);
    assert_eq!(lead(&without, steps), []);
}

/// Returns the set-point of the leader at an instant.
fn leader_at(at_ns: u64) -> LineShaftPoint {
    let index = LEADER.partition_point(|point| point.at_ns <= at_ns + MS / 2);
    let point = LEADER[index.saturating_sub(1)];
    let dt = at_ns.wrapping_sub(point.at_ns).cast_signed() as f64 * 1e-9;
    let mut motion = point.motion;
    motion.position += motion.velocity * dt;
    LineShaftPoint { motion, ..point }
}

/// What happens to the messages of the leader.
#[derive(Debug, Clone, Copy)]
struct Channel {
    delay: u64,
    /// In percent.
    loss: u64,
    /// From this common time on.
    fault: Option<(u64, Fault)>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Fault {
    /// No message leaves the leader. A new stream begins after 400 ms.
    Killed,
    /// The connection that feeds the shaft closes.
    Closed,
    /// The leader begins a new stream.
    NewStream,
    /// The clock of the follower's computer is set.
    ClockSet,
}

/// The run of a follower.
struct Followed {
    run: Run,
    /// The set-points of each axis.
    points: [Vec<LineShaftPoint>; 3],
    /// The Controlword and the target of both axes in CSP, in the frame of each cycle.
    frames: Vec<(u64, [(u16, i64); 2])>,
}

fn frame_of(data: &[u8]) -> [(u16, i64); 2] {
    [0, 1].map(|n| {
        let axis = &data[n * REGION..];
        let target = i32::from_le_bytes([axis[2], axis[3], axis[4], axis[5]]);
        (u16::from_le_bytes([axis[0], axis[1]]), i64::from(target))
    })
}

fn follow(channel: Channel, shaft: &str, again: bool, seed: u64) -> Followed {
    let gear = |n: usize| format!("ratio = {:?}, offset = 0.0", RATIOS[n]);
    follow_by(channel, (1, shaft), gear, again, seed)
}

/// Followers with the given keys of their `gear`, at a cycle in ms. The leader's is 1 ms.
fn follow_by(
    channel: Channel,
    (cycle_ms, shaft): (u64, &str),
    gear: impl Fn(usize) -> String,
    again: bool,
    seed: u64,
) -> Followed {
    // Before the clock of this run begins.
    LazyLock::force(&LEADER);
    let limits = "velocity = 30.0, acceleration = 410.0";
    let axes = [("csp", 25.0), ("csp", -60.0), ("csv", 80.0)];
    let mut text = format!("[bus]\ncycle = \"{cycle_ms}ms\"\n{ALIGN}\n");
    for (n, (mode, drift)) in axes.into_iter().enumerate() {
        text += &device(n, mode, drift, limits);
    }
    text += &format!(
        "[[line_shaft]]\nname = \"shaft\"\nvelocity = 12.0\nacceleration = {ACCELERATION:.1}\n{shaft}\n"
    );
    text += "[[stop.group]]\nname = \"line\"\naxes = [\"a0\", \"a1\", \"a2\"]\noutside = \"continue\"\n";
    text +=
        "[[step]]\nreset = [\"a0\", \"a1\", \"a2\"]\n[[step]]\nenable = [\"a0\", \"a1\", \"a2\"]\n";
    for n in 0..RATIOS.len() {
        let gear = gear(n);
        text += &format!("[[step]]\ngear = {{ a{n} = {{ to = \"shaft\", {gear} }} }}\n");
    }
    text += "[[step]]\ndwell = \"10s\"\n";
    text += CAM;
    let mut random = Random::new(seed);
    let mut waiting: VecDeque<(u64, LineShaftPoint)> = VecDeque::new();
    let mut next = 0;
    let cells: Vec<_> = (0..3).map(|n| Arc::new(SetpointCell::new(n))).collect();
    let input = Arc::new(SetpointCell::new(0));
    let setpoints = SetpointCells {
        axes: cells.clone().into(),
        line_shafts: [Arc::clone(&input)].into(),
    };
    let log = Arc::new(Mutex::new(([(); 3].map(|()| Vec::new()), Vec::new())));
    let kept = Arc::clone(&log);
    let mut last = [None; 3];
    let each = move |now: u64, data: &[u8]| {
        while let Some(&point) = LEADER.get(next).filter(|point| point.at_ns <= now + 2 * MS) {
            next += 1;
            if (next as u64).is_multiple_of(INTERVAL) && random.below(100) >= channel.loss {
                // A set-point is known about two cycles before it takes effect.
                waiting.push_back((point.at_ns - 2 * MS + channel.delay * MS, point));
            }
        }
        while waiting.front().is_some_and(|(at, _)| *at <= now) {
            let (_, mut point) = waiting.pop_front().expect("there is one");
            match channel.fault.filter(|(at, _)| point.at_ns >= *at) {
                Some((at, Fault::Killed)) if point.at_ns < at + 400 * MS => continue,
                Some((at, Fault::Closed)) if point.at_ns < at + 400 * MS => {
                    input.write(None);
                    continue;
                }
                Some((_, Fault::Killed | Fault::Closed | Fault::NewStream)) => point.stream += 1,
                _ => {}
            }
            input.write(Some(point));
        }
        let mut kept = kept.lock().expect("one thread");
        for ((cell, last), points) in cells.iter().zip(&mut last).zip(&mut kept.0) {
            cell.read(last);
            let newer = last.filter(|point: &LineShaftPoint| points.last() != Some(point));
            points.extend(newer);
        }
        if data.len() >= 2 * REGION - 1 {
            kept.1.push((now, frame_of(data)));
        }
    };
    // The leader has power, and has not moved yet.
    let mut acts = vec![start(START + 400 * MS)];
    if let Some((at, Fault::ClockSet)) = channel.fault {
        acts.push((at, Act::Set(300_000)));
    }
    if let Some((at, _)) = channel.fault.filter(|_| again) {
        let request = |request| Act::Request(Request::Program(request));
        acts.push((at + 900 * MS, request(ProgramRequest::Stop)));
        acts.push((at + SECOND, request(ProgramRequest::Start)));
    }
    let run = run(Plan {
        machine: machine(&text),
        options: virtual_time(),
        seed,
        begin: BEGIN + 111_111,
        acts,
        until: START + 4000 * MS,
        setpoints,
        each_cycle: Some(EachCycle(Box::new(each))),
    });
    let (points, frames) = std::mem::take(&mut *log.lock().expect("one thread"));
    Followed {
        run,
        points,
        frames,
    }
}

/// The times of the leader's motions: the move, the constant velocity and the reversal.
fn phases() -> [[u64; 2]; 3] {
    let mut changes: Vec<[u64; 2]> = Vec::new();
    for point in LEADER.iter().filter(|p| p.motion.acceleration.abs() > 1e-3) {
        match changes.last_mut() {
            Some(last) if point.at_ns < last[1] + 50 * MS => last[1] = point.at_ns,
            _ => changes.push([point.at_ns; 2]),
        }
    }
    let [speeds_up, brakes, begins, reverses, ..] = changes[..] else {
        panic!("{changes:?}");
    };
    let settled = 150 * MS;
    [
        [speeds_up[0], brakes[1] + settled],
        [begins[1] + 2 * settled, reverses[0]],
        [reverses[0], reverses[1] + settled],
    ]
}

/// The largest and the mean square error of a follower within a time.
fn errors(points: &[LineShaftPoint], ratio: f64, [from, to]: [u64; 2]) -> [f64; 2] {
    let within = points.iter().filter(|p| (from..to).contains(&p.at_ns));
    let error = |p: &LineShaftPoint| p.motion.position / ratio - leader_at(p.at_ns).motion.position;
    let all: Vec<f64> = within.map(error).collect();
    assert!(all.len() > 100, "{}", all.len());
    let largest = all.iter().map(|e| e.abs()).fold(0.0, f64::max);
    let square = all.iter().map(|e| e * e).sum::<f64>() / all.len() as f64;
    [largest, square.sqrt()]
}

/// The followers are at their ratio of the shaft in every cycle; its error against the leader
/// depends on delay and loss, and on the leader's jerk only.
#[test]
fn followers_of_a_line_shaft_keep_their_error() {
    println!("error in millionths of a turn, largest (root of the mean square)");
    println!("| delay | loss | jerk-limited move | constant velocity | reversal |");
    let phases = phases();
    let mut worst = Vec::new();
    for delay in [0, 1, 5, 20, 50] {
        for loss in [0, 10, 30] {
            let channel = Channel {
                delay,
                loss,
                fault: None,
            };
            let followed = follow(channel, "timeout = \"200ms\"", false, 7 + delay);
            assert_eq!(followed.run.error, None);
            let rows = phases.map(|phase| errors(&followed.points[0], RATIOS[0], phase));
            let cell = |[max, rms]: [f64; 2]| format!("{:.1} ({:.1})", max * 1e6, rms * 1e6);
            let cells = rows.map(cell).join(" | ");
            println!("| {delay} ms | {loss} % | {cells} |");
            // A count of the leader is 7.6 millionths.
            assert!(rows[1][0] * COUNTS < 1.0, "{delay} {loss}: {rows:?}");
            for (points, ratio) in followed.points.iter().zip(RATIOS) {
                for (one, two) in points.iter().zip(&followed.points[0]) {
                    let off = one.motion.position / ratio - two.motion.position / RATIOS[0];
                    assert!(off.abs() < 1e-9 || one.at_ns < START + 600 * MS, "{off}");
                }
            }
            if loss == 0 {
                worst.push((delay, rows[2][0]));
            }
        }
    }
    // The prediction over a delay d is wrong by at most jerk · d³ / 6, and by a changed acceleration
    // · d² / 2; the interval of the messages adds to the delay.
    for (delay, error) in worst {
        let d = (delay + INTERVAL) as f64 * 1e-3 + 0.01;
        assert!(error < 100.0 * d * d / 2.0 + 1e-4, "{delay}: {error}");
    }
}

/// The leader is killed at a constant velocity, in an acceleration and in a reversal, and the other
/// ends of a stream: all followers stay in gear with the shaft until they stand, within its
/// acceleration. Nothing moves when the stream is back, until a new `gear`.
#[test]
fn the_end_of_a_stream_stops_all_followers_in_gear() {
    let [moves, constant, reverses] = phases();
    let middle = |[from, to]: [u64; 2]| from.midpoint(to);
    let reversal = LEADER.iter().filter(|p| p.at_ns > reverses[0]);
    let zero = { reversal }
        .find(|p| p.motion.velocity < 0.0)
        .expect("reverses")
        .at_ns;
    for (at, fault, why) in [
        (
            middle(constant),
            Fault::Killed,
            "no set-point came within its `timeout`",
        ),
        (
            moves[0] + 40 * MS,
            Fault::Killed,
            "no set-point came within its `timeout`",
        ),
        (
            zero - 30 * MS,
            Fault::Killed,
            "no set-point came within its `timeout`",
        ),
        (
            zero,
            Fault::Killed,
            "no set-point came within its `timeout`",
        ),
        (
            middle(constant),
            Fault::Closed,
            "the connection that feeds it has closed",
        ),
        (
            middle(constant),
            Fault::NewStream,
            "was interrupted and has begun again",
        ),
        (middle(constant), Fault::ClockSet, "common time has jumped"),
    ] {
        let channel = Channel {
            delay: 5,
            loss: 0,
            fault: Some((at, fault)),
        };
        let again = fault != Fault::ClockSet;
        let followed = follow(channel, "", again, 3);
        assert_eq!(followed.run.error, None);
        let stopped = followed.run.warnings.join("\n");
        assert_contains(&stopped, &["line shaft `shaft`", why]);
        // The frames of both axes in CSP.
        let frames = followed
            .frames
            .iter()
            .filter(|(now, _)| *now > at - 100 * MS);
        let until = at + SECOND - 50 * MS;
        // Without power, targets are actual positions.
        let powered = |axes: &[(u16, i64); 2]| axes.iter().all(|(word, _)| *word == 0x000f);
        let frames: Vec<_> = { frames }
            .filter(|(now, axes)| *now < until && powered(axes))
            .collect();
        let mut rest = None;
        let limit = 2.0 * ACCELERATION * COUNTS * 1e-6 + 3.0;
        for w in frames.windows(3) {
            let [before, now, next] = [0, 1, 2].map(|n| w[n].1);
            let change = next[0].1 - 2 * now[0].1 + before[0].1;
            assert!(
                change.abs() as f64 <= limit,
                "{fault:?}: {change} of {limit}"
            );
            // The ratio of both is -4; targets are whole counts.
            let off = next[0].1 + 4 * next[1].1;
            assert!(off.abs() <= 3, "{fault:?}: {off} counts out of gear");
            if next[0].1 == now[0].1 && now[0].1 == before[0].1 && w[0].0 > at {
                rest.get_or_insert((w[0].0, now[0].1));
            } else {
                assert_eq!(rest, None, "{fault:?}: it moves again");
            }
        }
        let (stands_at, _) = rest.expect("comes to rest");
        let off_at = frames.last().expect("had power").0;
        // The velocity is at most 12: 50 ms of timeout, 5 ms of delay, 100 ms of deceleration.
        assert!(
            stands_at < at + 165 * MS,
            "{fault:?}: {}",
            (stands_at - at) / MS
        );
        assert!(off_at >= stands_at, "{fault:?}: power is removed at rest");
        println!(
            "{fault:?} at {:.1} turns/s: at rest after {} ms, no power after {} ms",
            leader_at(at).motion.velocity,
            (stands_at - at) / MS,
            (off_at - at) / MS
        );
        // The axis in CSV has no target position in its frames.
        let stops = followed.points[2]
            .iter()
            .filter(|p| p.at_ns > at && p.at_ns < stands_at);
        let mut checked = 0;
        for point in stops {
            let same = followed.points[0].iter().find(|p| p.at_ns == point.at_ns);
            if let Some(same) = same {
                let off = point.motion.position / RATIOS[2] - same.motion.position / RATIOS[0];
                assert!(off.abs() < 1e-9, "{fault:?}: {off}");
                checked += 1;
            }
        }
        // A shaft that stands already has no way to go.
        let short = fault == Fault::ClockSet || stands_at < at + 30 * MS;
        assert!(short || checked > 20, "{fault:?}: {checked}");
        if again {
            // A new start follows the new stream.
            let moved = followed.frames.iter().filter(|(now, _)| *now > at + SECOND);
            let places: std::collections::BTreeSet<_> = moved.map(|(_, axes)| axes[0].1).collect();
            assert!(places.len() > 10, "{fault:?}: {}", places.len());
        }
    }
}

/// A gear to a shaft that does not run is refused, and nothing moves.
#[test]
fn a_gear_to_a_shaft_without_a_stream_is_refused() {
    let channel = Channel {
        delay: 5,
        loss: 100,
        fault: None,
    };
    let followed = follow(channel, "", false, 3);
    let results = followed.run.results();
    let error = results[0].as_ref().expect_err("refused");
    assert_contains(
        error,
        &["line shaft `shaft`", "does not run", "no set-points"],
    );
    let enabled = followed
        .frames
        .iter()
        .filter(|(_, axes)| axes[0].0 == 0x000f);
    let places: std::collections::BTreeSet<_> = enabled.map(|(_, axes)| axes[0].1).collect();
    assert_eq!(places.len(), 1);
}

/// A cam on a shaft, at half the rate of the leader's cycle: the follower is on the cam in each
/// frame, also while the shaft stops by itself.
#[test]
fn a_cam_follows_the_shaft_at_another_cycle() {
    let [_, constant, _] = phases();
    for (delay, loss, kills) in [(0, 0, false), (20, 10, false), (5, 0, true)] {
        let channel = Channel {
            delay,
            loss,
            fault: kills.then_some((constant[0] + 100 * MS, Fault::Killed)),
        };
        let gear = |n: usize| match n {
            1 => "cam = \"cam\", offset = 0.0".to_owned(),
            _ => format!("ratio = {:?}, offset = 0.0", RATIOS[n]),
        };
        let timeout = if kills { "" } else { "timeout = \"200ms\"" };
        let followed = follow_by(channel, (2, timeout), gear, false, 5);
        assert_eq!(followed.run.error, None);
        let warned = followed.run.warnings.join("\n");
        assert_eq!(warned.contains("line shaft `shaft`"), kills, "{warned}");
        let engaged = followed.frames.iter().filter(|(now, axes)| {
            *now > START + 600 * MS && axes.iter().all(|(word, _)| *word == 0x000f)
        });
        let (mut largest, mut places) = (0.0_f64, std::collections::BTreeSet::new());
        for (_, [(_, shaft), (_, target)]) in engaged {
            let x = (*shaft as f64 / COUNTS / RATIOS[0]).rem_euclid(8.0) / 4.0;
            let z = x.min(2.0 - x);
            let law = z * z * z * (10.0 + z * (-15.0 + 6.0 * z));
            largest = largest.max((*target as f64 - 2.0 * law * COUNTS).abs());
            places.insert(*target);
        }
        println!(
            "cam, {delay} ms, {loss} %, kill {kills}: {largest:.2} counts at {} places",
            places.len()
        );
        // Both targets are whole counts.
        assert!(largest < 1.5, "{largest} counts");
        assert!(places.len() > 300, "{}", places.len());
        let points = &followed.points[0];
        assert!(
            points
                .windows(2)
                .all(|p| p[1].at_ns.abs_diff(p[0].at_ns + 2 * MS) < 10_000)
        );
        if !kills {
            let [largest, _] = errors(points, RATIOS[0], constant);
            assert!(largest * COUNTS < 1.0, "{largest}");
        }
    }
}
