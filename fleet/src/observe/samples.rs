//! `samples`: every cycle's values of some signals.

use std::time::Duration;

use serde_json::Value;

use super::{TIMEOUT, print};
use crate::error::{Error, Result};
use crate::options::{Network, SamplesRequest};
use crate::session;

/// Prints the samples of a machine.
///
/// # Errors
/// Fails if the machine does not answer, or has no such signal.
pub async fn run(network: &Network, request: SamplesRequest) -> Result<()> {
    let session = session::open_observer(network).await?;
    let seconds = request.seconds.clamp(0.0, 10.0);
    let signals = request.signals.join(",");
    let selector = request
        .machine
        .key(&format!("samples?signals={signals};seconds={seconds}"));
    let timeout = TIMEOUT + Duration::from_secs_f64(seconds);
    let replies = session::query(&session, &selector, timeout).await?;
    let Some(reply) = replies.all.first() else {
        return Err(
            Error::new(format!("samples of {}: no answer", request.machine))
                .help("check the names of the signals, and `ecaxis-fleet status`"),
        );
    };
    if reply
        .json::<Value>()
        .is_some_and(|answer| answer["complete"] == false)
    {
        tracing::warn!("the answer is cut to one reply: ask for fewer signals or seconds");
    }
    print(&String::from_utf8_lossy(&reply.bytes))
}
