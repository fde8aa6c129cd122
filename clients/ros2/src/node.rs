//! The node: its topics, services and threads.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Sender, channel};
use std::thread::{self, sleep};
use std::time::Duration;

use ecaxis_client::{ErrorKind, Machine};
use futures::channel::{mpsc as futures_mpsc, oneshot};
use futures::executor::{LocalPool, LocalSpawner};
use futures::future::LocalFutureObj;
use futures::task::LocalSpawn;
use futures::{StreamExt, pin_mut};
use ros2_client::qos::{History, WhenFull};
use ros2_client::{
    Context, ContextOptions, MessageTypeName, Name, Node, NodeName, NodeOptions, Publisher,
    QosProfile, Server, ServiceMapping, ServiceTypeName, Subscription,
};
use serde_json::{Value, json};

use crate::command::read_command;
use crate::cycle::Message;
use crate::joints::Joint;
use crate::lease::{LEASE, Shared, keep_lease, text};
use crate::messages::{Float64, JointState, JointTrajectory, TriggerRequest, TriggerResponse};
use crate::options::Options;
use crate::publish::{publish_diagnostics, publish_states};
use crate::services::{Service, Worker, services};
use crate::signals::{InputPublisher, Signal};
use crate::trajectory::{Start, plan};

/// The pause between attempts to connect.
const PAUSE: Duration = Duration::from_millis(50);

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
    let Some(machine) = connect(&options, &ends)? else {
        return Ok(());
    };
    let events = machine.events().map_err(text)?;
    let about = machine.request("machine", json!({})).map_err(text)?;
    let joints = Joint::of_machine(&about, &options)?;
    let shared = Shared::new(machine, joints, options, Arc::clone(&ends));
    let threads = start(shared, &about, events, &stop)?;
    let mut pool = threads.pool;
    let result = pool.run_until(stopped.next()).unwrap_or(Ok(()));
    ends.store(true, Ordering::Relaxed);
    // Axes that move stop while the node still answers, and DDS announces its end.
    for thread in threads.threads {
        let _ = thread.join();
    }
    result
}

struct Threads {
    pool: LocalPool,
    threads: [thread::JoinHandle<()>; 3],
    /// The node lives as long as its topics.
    _node: Node,
}

/// Waits for the server. Returns none at the end of the node.
fn connect(options: &Options, ends: &AtomicBool) -> Result<Option<Machine>, String> {
    let mut said = false;
    while !ends.load(Ordering::Relaxed) {
        let attach = ecaxis_client::Options {
            name: options.name.clone(),
            lease: LEASE,
            timeout: Duration::ZERO,
            take: false,
            ..ecaxis_client::Options::default()
        };
        match Machine::attach(&options.socket, attach) {
            Ok(machine) if machine.is_virtual() => {
                return Err(
                    "the server runs in virtual time, where no node can follow; \
                            start it with --sim instead of --virtual"
                        .to_owned(),
                );
            }
            Ok(machine) => return Ok(Some(machine)),
            Err(error) if error.kind() != ErrorKind::Lost => return Err(text(error)),
            Err(error) if !said => {
                eprintln!("waits for ecaxis serve: {}", error.cause);
                said = true;
            }
            Err(_) => sleep(PAUSE),
        }
    }
    Ok(None)
}

fn start(
    shared: Shared,
    machine: &Value,
    events: ecaxis_client::Subscription,
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
        shared: shared.clone(),
        cycle: to_cycle.clone(),
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

    let mut inputs = Vec::new();
    for signal in Signal::of_machine(machine, "inputs") {
        let topic = below_node(&options, &signal.topic);
        let publisher = publisher(&mut node, &topic, "std_msgs", "Float64", &reliable)?;
        inputs.push(InputPublisher::new(signal, publisher));
    }
    let (to_outputs, outputs) = channel();
    for signal in Signal::of_machine(machine, "outputs") {
        let topic = below_node(&options, &signal.topic);
        let values = subscription::<Float64>(&mut node, &topic, "std_msgs", "Float64", &reliable)?;
        spawn(&spawner, take_outputs(values, signal, to_outputs.clone()));
    }
    let for_outputs = shared.clone();
    thread::spawn(move || {
        for (Signal { device, name, .. }, value) in outputs {
            let set = for_outputs.machine.set_output(&device, &name, value);
            let error = set.err().map(text);
            let error = error.map(|error| format!("{device}.{name}: {error}"));
            for_outputs.update(|status| status.output = error);
        }
    });

    let log = node.logging_handle();
    let (for_states, for_diagnostics) = (shared.clone(), shared.clone());
    let ended = stop.clone();
    let states = thread::spawn(move || publish_states(&for_states, &states));
    let diagnostics = thread::spawn(move || {
        let result = publish_diagnostics(
            &for_diagnostics,
            &diagnostics,
            inputs,
            &log,
            &events,
            &reports,
        );
        let _ = ended.unbounded_send(result);
    });
    let ended = stop.clone();
    let lease = thread::spawn(move || {
        let result = keep_lease(&shared, &lease_requests, messages, &reports_in);
        let _ = ended.unbounded_send(result);
    });
    Ok(Threads {
        pool,
        threads: [lease, states, diagnostics],
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

/// Returns the name of a topic or service below the node.
fn below_node(options: &Options, name: &str) -> String {
    let namespace = options.namespace.trim_end_matches('/');
    format!("{namespace}/{}/{name}", options.name)
}

fn server(
    node: &mut Node,
    options: &Options,
    service: &Service,
) -> Result<Server<TriggerRequest, TriggerResponse>, String> {
    let name = below_node(options, &service.name);
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

async fn take_outputs(
    values: Subscription<Float64>,
    signal: Signal,
    outputs: Sender<(Signal, f64)>,
) {
    let stream = values.async_stream();
    pin_mut!(stream);
    while let Some(received) = stream.next().await {
        if let Ok((Float64 { data }, _)) = received {
            let _ = outputs.send((signal.clone(), data));
        }
    }
}

/// Returns where the axes are, from the newest cycle.
fn starts(shared: &Shared) -> Option<(Vec<Start>, f64)> {
    let (mut samples, columns) = shared.samples()?;
    // What is kept is the cycle in which the node got the lease.
    (samples.poll() > 0).then(|| {
        let starts = columns.iter().map(|columns| columns.start(&samples));
        (starts.collect(), samples.cycle_time().as_secs_f64())
    })
}

fn no_lease(shared: &Shared) -> Option<String> {
    let why = shared.status().no_lease?;
    Some(format!("the node does not own the motion: {why}"))
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
