//! The node: its topics, services and threads.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, TryRecvError, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, sleep};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use futures::channel::{mpsc as futures_mpsc, oneshot};
use futures::executor::{LocalPool, LocalSpawner};
use futures::future::LocalFutureObj;
use futures::task::LocalSpawn;
use futures::{StreamExt, pin_mut};
use ros2_client::log::LogLevel;
use ros2_client::qos::{History, WhenFull};
use ros2_client::{
    Context, ContextOptions, MessageTypeName, Name, Node, NodeLoggingHandle, NodeName, NodeOptions,
    Publisher, QosProfile, Server, ServiceMapping, ServiceTypeName, Subscription, rosout,
};
use serde_json::{Value, json};

use crate::command::read_command;
use crate::cycle::{Message, Report, monotonic_ns, value, wait_for_row};
use crate::joints::Joint;
use crate::lease::{Shared, keep_lease};
use crate::messages::{
    DiagnosticArray, DiagnosticStatus, Header, JointState, JointTrajectory, Time, TriggerRequest,
    TriggerResponse, level,
};
use crate::options::Options;
use crate::server::Connection;
use crate::services::{Service, Worker, services};
use crate::status::{NodeStatus, describe, of_server};
use crate::trajectory::{Start, plan};

const TIMEOUT: Duration = Duration::from_secs(10);
/// The pause between attempts to connect, and between states without the area.
const PAUSE: Duration = Duration::from_millis(50);
/// The longest time between two diagnostics.
const DIAGNOSTICS: Duration = Duration::from_secs(1);

/// Runs the node until a signal.
///
/// # Errors
/// Says why the node cannot start, or that the server has ended.
pub fn run(options: Options) -> Result<(), String> {
    let (stop, mut stopped) = futures_mpsc::unbounded::<Result<(), String>>();
    let ends = Arc::new(AtomicBool::new(false));
    let signals = [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM];
    let mut signals = signal_hook::iterator::Signals::new(signals)
        .map_err(|error| format!("signals cannot be received: {error}"))?;
    let (on_signal, flag) = (stop.clone(), Arc::clone(&ends));
    thread::spawn(move || {
        for _ in signals.forever() {
            flag.store(true, Ordering::Relaxed);
            let _ = on_signal.unbounded_send(Ok(()));
        }
    });
    let Some((connection, events)) = connect(&options, &ends) else {
        return Ok(());
    };
    let connection = Arc::new(connection);
    let machine = machine(&connection, &options)?;
    let joints = Arc::new(Joint::of_machine(&machine, &options)?);
    let shared = Shared {
        status: Arc::new(Mutex::new(NodeStatus::new(joints.len()))),
        samples: Arc::default(),
        ends: Arc::clone(&ends),
        connection,
        joints,
        options: Arc::new(options),
    };
    let threads = start(shared.clone(), events, &stop)?;
    let mut pool = threads.pool;
    let result = pool.run_until(stopped.next()).unwrap_or(Ok(()));
    ends.store(true, Ordering::Relaxed);
    // Axes that move stop while the node still answers.
    let _ = threads.lease.join();
    shared.connection.close();
    result
}

struct Threads {
    pool: LocalPool,
    lease: thread::JoinHandle<()>,
    /// The node lives as long as its topics.
    _node: Node,
}

fn connect(options: &Options, ends: &AtomicBool) -> Option<(Connection, Receiver<Value>)> {
    let mut said = false;
    while !ends.load(Ordering::Relaxed) {
        match Connection::open(&options.socket) {
            Ok(connected) => return Some(connected),
            Err(error) if !said => {
                eprintln!(
                    "waits for ecaxis serve at {}: {error}",
                    options.socket.display()
                );
                said = true;
            }
            Err(_) => sleep(PAUSE),
        }
    }
    None
}

/// Returns the machine of the server.
fn machine(connection: &Connection, options: &Options) -> Result<Value, String> {
    let ask = |request| {
        connection
            .request(request, TIMEOUT)
            .map_err(|error| error.to_string())
    };
    let hello = ask(json!({"op": "hello", "name": options.name}))?;
    if hello["virtual"] == true {
        return Err(
            "the server runs in virtual time, where no node can follow; \
                    start it with --sim instead of --virtual"
                .to_owned(),
        );
    }
    ask(json!({"op": "subscribe", "topics": ["events"]}))?;
    ask(json!({"op": "machine"}))
}

fn start(
    shared: Shared,
    events: Receiver<Value>,
    stop: &futures_mpsc::UnboundedSender<Result<(), String>>,
) -> Result<Threads, String> {
    let ros = |what: &str| {
        let what = what.to_owned();
        move |error: &dyn std::fmt::Debug| format!("{what}: {error:?}")
    };
    let options = Arc::clone(&shared.options);
    let context = Context::with_options(ContextOptions::new().domain_id(options.domain))
        .map_err(|error| ros("DDS does not start")(&error))?;
    let name = NodeName::new(&options.namespace, &options.name)
        .map_err(|error| ros("the name of the node")(&error))?;
    let mut node = context
        .new_node(name, NodeOptions::new().enable_rosout(true))
        .map_err(|error| ros("the node")(&error))?;
    let reliable = QosProfile::publisher_default()
        .reliability_reliable(WhenFull::Wait(Duration::from_millis(1)))
        .history(History::KeepLast { depth: 10 });
    // Publishers of any reliability are heard.
    let commands = QosProfile::subscription_default().history(History::KeepLast { depth: 1 });
    let states = publisher(
        &mut node,
        &options.states,
        "sensor_msgs",
        "JointState",
        &reliable,
    )?;
    let diagnostics = publisher(
        &mut node,
        "/diagnostics",
        "diagnostic_msgs",
        "DiagnosticArray",
        &reliable,
    )?;
    let commands = subscription::<JointState>(
        &mut node,
        &options.commands,
        "sensor_msgs",
        "JointState",
        &commands,
    )?;
    let trajectories = subscription::<JointTrajectory>(
        &mut node,
        &options.trajectories,
        "trajectory_msgs",
        "JointTrajectory",
        &reliable,
    )?;

    let (to_cycle, messages) = channel();
    let (to_lease, lease_requests) = channel();
    let (reports_in, reports) = channel();
    let worker = Worker {
        connection: Arc::clone(&shared.connection),
        cycle: to_cycle.clone(),
        joints: Arc::clone(&shared.joints),
        lease: to_lease,
    };
    let pool = LocalPool::new();
    let spawner = pool.spawner();
    let spinner = node
        .spinner()
        .map_err(|error| ros("the node does not spin")(&error))?;
    spawn(&spawner, async move {
        let _ = spinner.spin().await;
    });
    for service in services(&shared.joints) {
        let server = server(&mut node, &options, &service)?;
        spawn(&spawner, serve(server, service, worker.clone()));
    }
    spawn(
        &spawner,
        follow_commands(commands, shared.clone(), to_cycle.clone()),
    );
    spawn(
        &spawner,
        follow_trajectories(trajectories, shared.clone(), to_cycle),
    );

    let log = node.logging_handle();
    let (for_states, for_diagnostics) = (shared.clone(), shared.clone());
    let ended = stop.clone();
    thread::spawn(move || publish_states(&for_states, &states));
    thread::spawn(move || {
        let result = publish_diagnostics(&for_diagnostics, &diagnostics, &log, &events, &reports);
        let _ = ended.unbounded_send(result);
    });
    let ended = stop.clone();
    let lease = thread::spawn(move || {
        let result = keep_lease(&shared, &lease_requests, messages, &reports_in);
        let _ = ended.unbounded_send(result);
    });
    Ok(Threads {
        pool,
        lease,
        _node: node,
    })
}

fn spawn(spawner: &LocalSpawner, task: impl Future<Output = ()> + 'static) {
    // The pool outlives this call.
    let _ = spawner.spawn_local_obj(LocalFutureObj::new(Box::new(task)));
}

fn topic_name(topic: &str) -> Result<Name, String> {
    Name::parse(topic).map_err(|error| format!("topic `{topic}`: {error:?}"))
}

fn publisher<M: serde::Serialize>(
    node: &mut Node,
    topic: &str,
    package: &str,
    name: &str,
    qos: &QosProfile,
) -> Result<Publisher<M>, String> {
    let wrong = |error: ros2_client::CreateError| format!("topic `{topic}`: {error:?}");
    let made = node.create_topic(
        &topic_name(topic)?,
        MessageTypeName::new(package, name),
        qos,
    );
    node.create_publisher(&made.map_err(wrong)?, None)
        .map_err(wrong)
}

fn subscription<M: 'static>(
    node: &mut Node,
    topic: &str,
    package: &str,
    name: &str,
    qos: &QosProfile,
) -> Result<Subscription<M>, String> {
    let wrong = |error: ros2_client::CreateError| format!("topic `{topic}`: {error:?}");
    let made = node.create_topic(
        &topic_name(topic)?,
        MessageTypeName::new(package, name),
        qos,
    );
    node.create_subscription(&made.map_err(wrong)?, None)
        .map_err(wrong)
}

fn server(
    node: &mut Node,
    options: &Options,
    service: &Service,
) -> Result<Server<TriggerRequest, TriggerResponse>, String> {
    let namespace = options.namespace.trim_end_matches('/');
    let name = format!("{namespace}/{}/{}", options.name, service.name);
    let qos = QosProfile::publisher_default().history(History::KeepLast { depth: 10 });
    let made = node.create_server(
        ServiceMapping::Enhanced,
        &topic_name(&name)?,
        &ServiceTypeName::new("std_srvs", "Trigger"),
        qos.clone(),
        qos,
    );
    made.map_err(|error| format!("service `{name}`: {error:?}"))
}

/// Answers one service, a call after another.
async fn serve(server: Server<TriggerRequest, TriggerResponse>, service: Service, worker: Worker) {
    loop {
        let Ok((id, _)) = server.async_receive_request().await else {
            continue;
        };
        let (sender, answer) = oneshot::channel();
        let (worker, service) = (worker.clone(), service.clone());
        thread::spawn(move || {
            let _ = sender.send(worker.carry_out(&service));
        });
        let Ok(response) = answer.await else { continue };
        let _ = server.async_send_response(id, response).await;
    }
}

/// Returns where the axes are, from the newest cycle.
fn starts(shared: &Shared) -> Option<(Vec<Start>, f64)> {
    let known = shared
        .samples
        .lock()
        .unwrap_or_else(PoisonError::into_inner)
        .clone();
    let (samples, columns) = known?;
    let mut row = Vec::new();
    let read = samples.read_newest(&mut row);
    let starts = columns.iter().map(|columns| columns.start(&row)).collect();
    read.then_some((starts, samples.cycle_ns as f64 * 1e-9))
}

fn no_lease(shared: &Shared) -> Option<String> {
    let status = shared.status.lock().unwrap_or_else(PoisonError::into_inner);
    status
        .no_lease
        .as_ref()
        .map(|why| format!("the node does not own the motion: {why}"))
}

async fn follow_commands(
    commands: Subscription<JointState>,
    shared: Shared,
    cycle: Sender<Message>,
) {
    let stream = commands.async_stream();
    pin_mut!(stream);
    while let Some(received) = stream.next().await {
        let read = received.map_err(|error| format!("unreadable: {error:?}"));
        let read = read.and_then(|(message, info)| {
            if let Some(why) = no_lease(&shared) {
                return Err(why);
            }
            let (starts, _) = starts(&shared).ok_or("the server has no cycle yet")?;
            let modes: Vec<_> = starts.iter().map(|start| start.mode).collect();
            let wanted = read_command(&message, &shared.joints, &modes)?;
            let publisher = info.publisher_gid().to_bytes16();
            let _ = cycle.send(Message::Command { publisher, wanted });
            Ok(())
        });
        shared.update(|status| status.command = read.err());
    }
}

async fn follow_trajectories(
    trajectories: Subscription<JointTrajectory>,
    shared: Shared,
    cycle: Sender<Message>,
) {
    let stream = trajectories.async_stream();
    pin_mut!(stream);
    while let Some(received) = stream.next().await {
        let read = received.map_err(|error| format!("unreadable: {error:?}"));
        let read = read.and_then(|(message, _)| {
            if let Some(why) = no_lease(&shared) {
                return Err(why);
            }
            let (starts, cycle_s) = starts(&shared).ok_or("the server has no cycle yet")?;
            let tolerance = shared.options.start_tolerance;
            let plans = plan(&message, &shared.joints, &starts, tolerance, cycle_s)?;
            if !plans.is_empty() {
                let _ = cycle.send(Message::Trajectory(plans));
                return Ok(());
            }
            let named = |joint: &Joint| message.joint_names.contains(&joint.name);
            for joint in (0..shared.joints.len()).filter(|at| named(&shared.joints[*at])) {
                let _ = cycle.send(Message::Stop {
                    joint: Some(joint),
                    hold: false,
                });
            }
            Ok(())
        });
        shared.update(|status| status.trajectory = read.err());
    }
}

/// Returns the header of a message. `monotonic` is its time in ns of CLOCK_MONOTONIC.
fn header(monotonic: u64) -> Header {
    let unix = SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .unwrap_or_default();
    let unix = u64::try_from(unix.as_nanos()).unwrap_or(u64::MAX);
    let age = monotonic_ns().saturating_sub(monotonic);
    Header {
        stamp: Time::from_ns(unix.saturating_sub(age)),
        frame_id: String::new(),
    }
}

fn publish_states(shared: &Shared, states: &Publisher<JointState>) {
    let joints = &shared.joints;
    let mut values = Vec::new();
    let (mut row, mut next) = (0, 0);
    while !shared.ends.load(Ordering::Relaxed) {
        let known = shared
            .samples
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .clone();
        let Some((samples, columns)) = known else {
            if let Some(state) = state_of_server(shared) {
                let _ = states.publish(state);
            }
            sleep(PAUSE);
            continue;
        };
        let Some(written) = wait_for_row(&samples, row, &shared.ends) else {
            continue;
        };
        row = written;
        let every = (1e9 / (shared.options.rate * samples.cycle_ns as f64))
            .round()
            .max(1.0);
        if row < next || !samples.read_newest(&mut values) {
            continue;
        }
        next = row + every as u64;
        let columns = joints.iter().zip(columns.iter());
        let mut state = joint_state(joints, values.get(1).copied().unwrap_or_default());
        for (joint, columns) in columns {
            state
                .position
                .push(value(&values, columns.position) * joint.scale);
            state
                .velocity
                .push(value(&values, columns.velocity) * joint.scale);
            state
                .effort
                .push(joint.effort(value(&values, columns.torque)));
        }
        let _ = states.publish(without_unknown_effort(state));
    }
}

fn joint_state(joints: &[Joint], time_ns: u64) -> JointState {
    JointState {
        header: header(time_ns),
        name: joints.iter().map(|joint| joint.name.clone()).collect(),
        ..JointState::default()
    }
}

fn without_unknown_effort(mut state: JointState) -> JointState {
    if state.effort.iter().all(|effort| effort.is_nan()) {
        state.effort.clear();
    }
    state
}

/// Returns the joint states without the area: until the node has the lease for the first time.
fn state_of_server(shared: &Shared) -> Option<JointState> {
    let answer = shared
        .connection
        .request(json!({"op": "state"}), TIMEOUT)
        .ok()?;
    let mut state = joint_state(&shared.joints, answer["time_ns"].as_u64()?);
    for joint in shared.joints.iter() {
        let axis = &answer["axes"][joint.index];
        state
            .position
            .push(axis["position"].as_f64()? * joint.scale);
        state
            .velocity
            .push(axis["velocity"].as_f64()? * joint.scale);
        state.effort.push(joint.effort(axis["torque"].as_f64()?));
    }
    Some(without_unknown_effort(state))
}

fn publish_diagnostics(
    shared: &Shared,
    publisher: &Publisher<DiagnosticArray>,
    log: &NodeLoggingHandle,
    events: &Receiver<Value>,
    reports: &Receiver<(usize, Report)>,
) -> Result<(), String> {
    let mut published = Instant::now() - DIAGNOSTICS;
    let mut said: Vec<DiagnosticStatus> = Vec::new();
    while !shared.ends.load(Ordering::Relaxed) {
        let mut news = false;
        while let Ok((index, report)) = reports.try_recv() {
            take_report(shared, index, report);
            news = true;
        }
        loop {
            match events.try_recv() {
                Ok(event) => news |= take_event(shared, &event),
                Err(TryRecvError::Empty) => break,
                Err(TryRecvError::Disconnected) => {
                    return Err("the connection to the server is lost".to_owned());
                }
            }
        }
        let node = shared.options.name.as_str();
        let status = shared
            .status
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .clone();
        let own = status.diagnostics(node, &shared.joints);
        news |= own != said;
        if news || published.elapsed() >= DIAGNOSTICS {
            published = Instant::now();
            log_changes(log, &said, &own);
            said.clone_from(&own);
            let parts = server_diagnostics(shared, node)
                .into_iter()
                .chain(own)
                .collect();
            let _ = publisher.publish(DiagnosticArray {
                header: header(monotonic_ns()),
                status: parts,
            });
        }
        sleep(PAUSE);
    }
    Ok(())
}

fn server_diagnostics(shared: &Shared, node: &str) -> Vec<DiagnosticStatus> {
    match shared
        .connection
        .request(json!({"op": "diagnostics"}), TIMEOUT)
    {
        Ok(answer) => {
            let parts = answer["diagnostics"].as_array().into_iter().flatten();
            parts.map(|part| of_server(node, part)).collect()
        }
        Err(error) => vec![DiagnosticStatus {
            level: level::ERROR,
            name: format!("{node}: server"),
            message: error.to_string(),
            ..DiagnosticStatus::default()
        }],
    }
}

fn take_report(shared: &Shared, index: usize, report: Report) {
    let Some(joint) = shared.joints.get(index) else {
        return;
    };
    let Options {
        stale_ms,
        start_tolerance,
        ..
    } = *shared.options;
    let described = describe(report, joint, stale_ms, start_tolerance);
    shared.update(|status| {
        if let Some(state) = status.joints.get_mut(index) {
            *state = described;
        }
    });
}

/// Returns true if the event changes diagnostics.
fn take_event(shared: &Shared, event: &Value) -> bool {
    let kind = event["event"].as_str().unwrap_or_default();
    if kind == "area" {
        let axis = event["axis"].as_str().unwrap_or_default();
        let why = event["why"].as_str().unwrap_or_default();
        if let Some(index) = shared.joints.iter().position(|joint| joint.axis == axis) {
            shared.update(|status| {
                if let Some(state) = status.joints.get_mut(index) {
                    *state = (level::WARN, format!("stopped: {why}"));
                }
            });
        }
    }
    let changes = [
        "area",
        "bus",
        "fault",
        "lease",
        "device_lost",
        "device_returned",
        "done",
    ];
    changes.contains(&kind)
}

/// Logs problems that are new or over.
fn log_changes(log: &NodeLoggingHandle, before: &[DiagnosticStatus], now: &[DiagnosticStatus]) {
    for status in now {
        let old = before.iter().find(|old| old.name == status.name);
        if old.is_some_and(|old| old.message == status.message)
            || (old.is_none() && status.level == level::OK)
        {
            continue;
        }
        let text = format!("{}: {}", status.name, status.message);
        eprintln!("{text}");
        let level = if status.level == level::OK {
            LogLevel::Info
        } else {
            LogLevel::Warn
        };
        rosout!(*log, level, "{text}");
    }
}
