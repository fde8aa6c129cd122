//! The node: its topics, services and threads.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, sleep};
use std::time::Duration;

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
use crate::lease::{Shared, keep_lease};
use crate::messages::{Float64, JointState, JointTrajectory, TriggerRequest, TriggerResponse};
use crate::options::Options;
use crate::publish::{publish_diagnostics, publish_states};
use crate::server::Connection;
use crate::services::{Service, Worker, services};
use crate::signals::{InputPublisher, Signal};
use crate::status::NodeStatus;
use crate::trajectory::{Start, plan};

const TIMEOUT: Duration = Duration::from_secs(10);
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
    let threads = start(shared.clone(), &machine, events, &stop)?;
    let mut pool = threads.pool;
    let result = pool.run_until(stopped.next()).unwrap_or(Ok(()));
    ends.store(true, Ordering::Relaxed);
    // Axes that move stop while the node still answers, and DDS announces its end.
    for thread in threads.threads {
        let _ = thread.join();
    }
    shared.connection.close();
    result
}

struct Threads {
    pool: LocalPool,
    threads: [thread::JoinHandle<()>; 3],
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
    machine: &Value,
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
    let connection = Arc::clone(&shared.connection);
    let for_outputs = shared.clone();
    thread::spawn(move || {
        for (Signal { device, name, .. }, value) in outputs {
            let request = json!({"op": "output", "device": device, "output": name, "value": value});
            let error = connection.request(request, TIMEOUT).err();
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
