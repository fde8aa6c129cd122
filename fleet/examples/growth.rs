//! Bytes and processor time per machine, and the time until a new observer has the whole picture:
//! 1, 10, 100 and 1,000 simulated agents in one process, against a router in another.
//!
//! The loopback interface must carry nothing else, so run it in a network namespace of its own. Zenoh
//! without optimization takes three times as long, and 1,000 agents do not fit into two cores:
//!
//! `cargo build --example growth --bin ecaxis-fleet --config 'profile.dev.package."*".opt-level=1'`
//!
//! `unshare -n sh -c "ip link set lo up; ulimit -n 8192; target/debug/examples/growth"`

#![allow(clippy::print_stdout, reason = "prints a table")]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command};
use std::sync::Arc;
use std::time::{Duration, Instant};

use clap::Parser;
use ecaxis_fleet::agent::UPDATES;
use ecaxis_fleet::agent::events::Events;
use ecaxis_fleet::agent::publish::Publisher;
use ecaxis_fleet::agent::reader::Update;
use ecaxis_fleet::agent::state::{Serve, Server, State, unix_time};
use ecaxis_fleet::config::{self, Role};
use ecaxis_fleet::keys::MachineId;
use ecaxis_fleet::observe::status;
use ecaxis_fleet::reports::ReportStore;
use ecaxis_fleet::session;
use serde_json::{Value, json};
use tokio::sync::mpsc;
use tokio::task::JoinSet;

/// Measures the growth of a fleet
#[derive(Debug, Parser)]
struct Options {
    /// The numbers of machines
    #[arg(long, value_delimiter = ',', default_value = "1,10,100,1000")]
    machines: Vec<usize>,
    /// The time of each measurement
    #[arg(long, default_value_t = 20.0)]
    seconds: f64,
    /// The program of the router
    #[arg(long, default_value = "target/debug/ecaxis-fleet")]
    program: PathBuf,
    /// The port of the router
    #[arg(long, default_value_t = 27447)]
    port: u16,
}

type Failure = Box<dyn std::error::Error + Send + Sync>;

/// A process that ends with the measurement.
struct Router(Child);

impl Drop for Router {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[tokio::main]
async fn main() -> Result<(), Failure> {
    let options = Options::parse();
    println!(
        "| machines | B/s per machine | agent CPU | router CPU | router MB | all seen after |"
    );
    for machines in &options.machines {
        measure(&options, *machines).await?;
    }
    Ok(())
}

async fn measure(options: &Options, machines: usize) -> Result<(), Failure> {
    let folder = tempfile::tempdir()?;
    let endpoint = format!("tcp/127.0.0.1:{}", options.port);
    let file = folder.path().join("router.toml");
    fs::write(
        &file,
        format!("[zenoh]\nlisten.endpoints = [\"{endpoint}\"]\n"),
    )?;
    let router = Router(
        Command::new(&options.program)
            .arg("router")
            .arg(&file)
            .env("RUST_LOG", "error")
            .spawn()?,
    );
    let router_stat = PathBuf::from(format!("/proc/{}/stat", router.0.id()));
    let text = format!("connect.endpoints = [\"{endpoint}\"]");
    let table: toml::Table = toml::from_str(&text)?;
    let zenoh = config::zenoh(&table, &file, Role::Service)?;
    let mut agents = JoinSet::new();
    for number in 0..machines {
        let zenoh = zenoh.clone();
        let folder = folder.path().join(number.to_string());
        agents.spawn(async move { agent(zenoh, number, &folder).await });
        if number % 20 == 19 {
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
    }
    // Until all are there.
    let begin = Instant::now();
    let first = session::open(zenoh.clone()).await?;
    let complete = |seen: &std::collections::BTreeMap<MachineId, status::Seen>| {
        seen.values()
            .filter(|s| s.alive && s.state.is_some())
            .count()
            == machines
    };
    while !complete(&status::look(&first).await?) {
        if begin.elapsed() > Duration::from_secs(120) {
            return Err("the agents have not appeared".into());
        }
        tokio::time::sleep(Duration::from_millis(200)).await;
    }
    first.close().await?;
    // A new observer.
    let begin = Instant::now();
    let observer = session::open(zenoh).await?;
    while !complete(&status::look(&observer).await?) {
        if begin.elapsed() > Duration::from_secs(60) {
            return Err("the picture has not become complete".into());
        }
    }
    let whole = begin.elapsed();
    // One that listens to all states.
    let states = observer
        .declare_subscriber(ecaxis_fleet::keys::ALL_STATES)
        .callback(|_| {});
    let _states = states.await?;
    let before = (cpu("/proc/self/stat")?, cpu(&router_stat)?, loopback()?);
    let begin = Instant::now();
    tokio::time::sleep(Duration::from_secs_f64(options.seconds)).await;
    let seconds = begin.elapsed().as_secs_f64();
    let after = (cpu("/proc/self/stat")?, cpu(&router_stat)?, loopback()?);
    let per = |difference: f64| difference / seconds / machines as f64;
    // From an agent to the router and on to the observer, with all headers and acknowledgements.
    let bytes = per((after.2 - before.2) as f64);
    println!(
        "| {machines} | {bytes:.0} | {:.2} % | {:.2} % | {:.0} | {:.2} s |",
        per(after.0 - before.0) * 100.0,
        per(after.1 - before.1) * 100.0,
        resident_mb(router.0.id())?,
        whole.as_secs_f64(),
    );
    agents.abort_all();
    while agents.join_next().await.is_some() {}
    observer.close().await?;
    Ok(())
}

/// An agent without a server: its state is that of a machine with ten axes.
async fn agent(zenoh: zenoh::Config, number: usize, folder: &Path) -> Result<(), Failure> {
    let id: MachineId = format!("hall/m{number}").parse()?;
    let store = Arc::new(ReportStore::open(folder, 500)?);
    let session = session::open(zenoh).await?;
    let (updates, received) = mpsc::channel(UPDATES);
    let events = Arc::new(Events::default());
    let publisher = Publisher::new(session, id.clone(), store, events, None);
    let publish = async move {
        let mut ticks = tokio::time::interval(Duration::from_secs(1));
        loop {
            ticks.tick().await;
            let _ = updates.send(Update::State(Box::new(state(&id)))).await;
        }
    };
    tokio::select! {
        ended = publisher.run(received) => ended?,
        () = publish => {}
    }
    Ok(())
}

fn state(id: &MachineId) -> State {
    let axis = |n: usize| json!({"name": format!("x{n}"), "enabled": true, "at_rest": false});
    let device = json!({"name": "x3", "al_state": "Op", "clock_difference_ns": 12, "ports": []});
    let state = json!({
        "axes": (0..10).map(axis).collect::<Vec<Value>>(), "devices": [device],
        "bus": {"state": "op", "cycles": 123_456_789, "lost_frames": 3},
        "timing": {"wake_up": {"p99_9_ns": 15_000, "max_ns": 21_000}},
        "lease": {"owner": {"name": "cell"}},
    });
    let machine = json!({"name": "press", "sha256": "5f".repeat(32)});
    State {
        id: id.clone(),
        unix_time: unix_time(),
        agent: env!("CARGO_PKG_VERSION").to_owned(),
        page: Some("http://press-3:8080/".to_owned()),
        reports: 0,
        last_event: None,
        server: Server::Present,
        serve: Some(Serve::read(&json!({"version": "0.1.0"}), &machine, &state)),
    }
}

/// Returns the processor time of a process in s: proc_pid_stat(5), fields 14 and 15.
fn cpu(path: impl AsRef<Path>) -> Result<f64, Failure> {
    let text = fs::read_to_string(path)?;
    let after_name = text.rsplit(')').next().unwrap_or_default();
    let ticks = after_name.split_whitespace().skip(11).take(2);
    let ticks: u64 = ticks
        .map(|field| field.parse::<u64>().unwrap_or_default())
        .sum();
    Ok(ticks as f64 / rustix::param::clock_ticks_per_second() as f64)
}

/// Returns the bytes that the loopback interface has carried.
fn loopback() -> Result<u64, Failure> {
    let text = fs::read_to_string("/proc/self/net/dev")?;
    let line = text
        .lines()
        .find_map(|line| line.trim().strip_prefix("lo:"));
    let received = line.and_then(|line| line.split_whitespace().next());
    Ok(received.ok_or("no interface lo")?.parse()?)
}

fn resident_mb(pid: u32) -> Result<f64, Failure> {
    let text = fs::read_to_string(format!("/proc/{pid}/statm"))?;
    let pages: f64 = text.split(' ').nth(1).unwrap_or_default().parse()?;
    Ok(pages * rustix::param::page_size() as f64 / 1e6)
}
