//! The commands `start` and `stop`: one order to each of several machines at the same time.

use std::sync::Arc;
use std::time::Duration;

use clap::Args;
use tokio::task::JoinSet;
use tokio::time;

use super::commands::{KeyArgs, progress, succeed};
use super::order::{Action, OrderReply, Status};
use super::sender::{OrderSender, SentOrder};
use crate::agent::state::unix_time;
use crate::error::{Error, Result};
use crate::keys::MachineId;
use crate::options::Network;
use crate::session;

/// The time in which all machines accept an order.
const MIN_ACCEPTANCE: Duration = Duration::from_secs(1);
const MAX_ACCEPTANCE: Duration = Duration::from_secs(30);
/// The time in which a machine confirms that a start is cancelled. Without an instant, it moves.
const CANCEL: Duration = Duration::from_secs(8);

#[derive(Debug, Args)]
pub struct StartArgs {
    #[command(flatten)]
    network: Network,
    /// The machines
    #[arg(value_name = "SITE/MACHINE", required = true)]
    machines: Vec<MachineId>,
    /// The common instant, in seconds since 1970
    #[arg(long, value_name = "TIME", value_parser = instant)]
    at: Option<u64>,
    #[command(flatten)]
    key: KeyArgs,
}

/// The time in which the others answer after a machine that refuses.
const AFTER_REFUSAL: Duration = Duration::from_secs(1);
/// The time before the instant at which no machine is asked any more: the others are still to be
/// stopped.
const WATCH_END: Duration = Duration::from_secs(3);
const WATCH_PERIOD: Duration = Duration::from_millis(200);
/// The time for a machine to say that it still waits for the instant.
const WATCH_TIMEOUT: Duration = Duration::from_secs(2);

#[derive(Debug, Args)]
pub struct StopArgs {
    #[command(flatten)]
    network: Network,
    /// The machines
    #[arg(value_name = "SITE/MACHINE", required = true)]
    machines: Vec<MachineId>,
    #[command(flatten)]
    key: KeyArgs,
}

/// Starts the programs of all machines, or of none.
///
/// # Errors
/// Fails with the reasons of the machines that do not start. The others are stopped.
pub async fn start(args: StartArgs) -> Result<()> {
    let sender = connect(&args.key, &args.network).await?;
    let at_unix_ns = args.at;
    let orders = sign(&sender, &args.machines, |_| Action::Start { at_unix_ns })?;
    let timeout = acceptance(at_unix_ns, unix_time());
    let mut replies = send(&sender, &orders, timeout, Some(AFTER_REFUSAL)).await;
    let runs = |reply: &Result<OrderReply>| {
        let reply = reply.as_ref().ok();
        reply.is_some_and(|reply| reply.status == Status::Started)
    };
    if let Some(at) = at_unix_ns
        && replies.iter().all(runs)
    {
        replies = watch(&sender, &orders, replies, at).await;
    }
    let (mut errors, mut started) = (Vec::new(), Vec::new());
    for (order, reply) in orders.iter().zip(replies) {
        // A machine without an answer may have accepted the order, or receive it later.
        let runs = reply
            .as_ref()
            .map_or(true, |reply| reply.status == Status::Started);
        let name = order.machine.to_string();
        errors.extend(reply.and_then(|reply| succeed(&name, &reply)).err());
        started.extend(runs.then_some(order));
    }
    if errors.is_empty() {
        return Ok(());
    }
    let machines: Vec<MachineId> = started.iter().map(|order| order.machine.clone()).collect();
    let stops = sign(&sender, &machines, |n| Action::Stop {
        start: Some(started[n].nonce.clone()),
    })?;
    let replies = send(&sender, &stops, CANCEL, None).await;
    for (order, reply) in stops.iter().zip(replies) {
        let name = order.machine.to_string();
        let stopped = match reply {
            Ok(reply) => succeed(&name, &reply),
            Err(_) => {
                let what = format!("{name}: the stop of the start is not confirmed: it may start");
                Err(Error::new(what).help("stop this machine at its server"))
            }
        };
        errors.extend(stopped.err());
    }
    fail(errors)
}

/// Stops all axes and the programs of machines.
///
/// # Errors
/// Fails with the machines that have not confirmed it.
pub async fn stop(args: StopArgs) -> Result<()> {
    let sender = connect(&args.key, &args.network).await?;
    let orders = sign(&sender, &args.machines, |_| Action::Stop { start: None })?;
    let replies = send(&sender, &orders, MAX_ACCEPTANCE, None).await;
    let ended = orders.iter().zip(replies).map(|(order, reply)| {
        let name = order.machine.to_string();
        reply.and_then(|reply| succeed(&name, &reply))
    });
    fail(ended.filter_map(Result::err).collect())
}

async fn connect(key: &KeyArgs, network: &Network) -> Result<Arc<OrderSender>> {
    let signer = key.load()?;
    let session = session::open_at_once(network).await?;
    Ok(Arc::new(OrderSender::new(session, signer)))
}

/// Signs an order to each machine; `action` gets its place.
fn sign(
    sender: &OrderSender,
    machines: &[MachineId],
    action: impl Fn(usize) -> Action,
) -> Result<Vec<SentOrder>> {
    let machines = machines.iter().enumerate();
    machines
        .map(|(n, machine)| sender.sign(machine, action(n)))
        .collect()
}

/// Asks all machines again and again until [`WATCH_END`] before the instant: axes may not be enabled,
/// or common time may jump. Returns the last replies, or those with the first failure.
async fn watch(
    sender: &Arc<OrderSender>,
    orders: &[SentOrder],
    mut replies: Vec<Result<OrderReply>>,
    at_unix_ns: u64,
) -> Vec<Result<OrderReply>> {
    let failed = |reply: &Result<OrderReply>| {
        let reply = reply.as_ref();
        reply.is_ok_and(|reply| reply.status != Status::Started)
    };
    let end = Duration::from_nanos(at_unix_ns).saturating_sub(WATCH_END);
    if unix_time() < end.as_secs_f64() {
        let seconds = WATCH_END.as_secs();
        let text = format!("wait; they are asked again until {seconds} s before the instant");
        progress("all machines".to_owned())(&text);
    }
    while unix_time() < end.as_secs_f64() {
        time::sleep(WATCH_PERIOD).await;
        replies = send(sender, orders, WATCH_TIMEOUT, None).await;
        if replies.iter().any(failed) {
            break;
        }
    }
    replies
}

/// Sends all orders at the same time. Returns a reply to each, in their order. With
/// `after_refusal`, the others have this time after a machine that refuses.
async fn send(
    sender: &Arc<OrderSender>,
    orders: &[SentOrder],
    timeout: Duration,
    after_refusal: Option<Duration>,
) -> Vec<Result<OrderReply>> {
    let mut replies: Vec<_> = orders
        .iter()
        .map(|order| Err(silent(order, timeout)))
        .collect();
    let mut tasks = JoinSet::new();
    for (n, order) in orders.iter().enumerate() {
        let (sender, order) = (Arc::clone(sender), order.clone());
        tasks.spawn(async move {
            let mut progress = progress(order.machine.to_string());
            let reply = sender.follow(&order, &mut progress);
            (n, time::timeout(timeout, reply).await)
        });
    }
    let mut end = None;
    loop {
        let next = tasks.join_next();
        let ended = match end {
            Some(end) => time::timeout_at(end, next).await,
            None => Ok(next.await),
        };
        match ended {
            Ok(Some(Ok((n, Ok(reply))))) => {
                let runs =
                    |reply: &OrderReply| matches!(reply.status, Status::Started | Status::Done);
                if !reply.as_ref().is_ok_and(runs) {
                    end = end.or(after_refusal.map(|rest| time::Instant::now() + rest));
                }
                replies[n] = reply;
            }
            Ok(Some(_)) => {}
            Ok(None) | Err(_) => return replies,
        }
    }
}

fn silent(order: &SentOrder, timeout: Duration) -> Error {
    let (machine, seconds) = (&order.machine, timeout.as_secs_f64());
    let what = format!(
        "{machine} has not confirmed the order within {seconds:.1} s, or before another one refused"
    );
    Error::new(what).help("see `ecaxis-fleet status`")
}

/// Returns the time to accept a start: half of the time until the instant. The other half is for
/// the stop of those that have accepted.
fn acceptance(at_unix_ns: Option<u64>, now: f64) -> Duration {
    at_unix_ns.map_or(MAX_ACCEPTANCE, |at| {
        let rest = Duration::from_nanos(at).saturating_sub(Duration::from_secs_f64(now));
        (rest / 2).clamp(MIN_ACCEPTANCE, MAX_ACCEPTANCE)
    })
}

fn fail(errors: Vec<Error>) -> Result<()> {
    let joined = errors
        .into_iter()
        .reduce(|a, b| Error::new(format!("{a}\n{b}")));
    joined.map_or(Ok(()), Err)
}

fn instant(text: &str) -> std::result::Result<u64, String> {
    let wrong = || "write seconds since 1970, such as 1795718434.5".to_owned();
    let (whole, fraction) = text.split_once('.').unwrap_or((text, ""));
    if fraction.len() > 9 {
        return Err(wrong());
    }
    let seconds: u64 = whole.parse().map_err(|_| wrong())?;
    let nanos: u64 = format!("{fraction:0<9}").parse().map_err(|_| wrong())?;
    let total = seconds
        .checked_mul(1_000_000_000)
        .and_then(|ns| ns.checked_add(nanos));
    total.ok_or_else(wrong)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn half_of_the_time_is_for_the_acceptance() {
        let s = |s: f64| Duration::from_secs_f64(s);
        for (at, time) in [
            (None, s(30.0)),
            (Some(1_010_000_000_000), s(5.0)),
            (Some(1_001_000_000_000), s(1.0)),
            (Some(5), s(1.0)),
            (Some(u64::MAX), s(30.0)),
        ] {
            assert_eq!(acceptance(at, 1_000.0), time, "{at:?}");
        }
    }

    #[test]
    fn an_instant_has_whole_seconds_and_a_fraction() {
        for (text, ns) in [
            ("1795718434.5", Some(1_795_718_434_500_000_000)),
            ("1", Some(1_000_000_000)),
            ("0.000000001", Some(1)),
            ("0.0000000001", None),
            ("-1", None),
            ("1e9", None),
            ("99999999999999999", None),
        ] {
            assert_eq!(instant(text).ok(), ns, "{text}");
        }
    }
}
