//! A line shaft of this machine: the set-points of another machine's axis, for the server.

use std::convert::Infallible;
use std::path::PathBuf;
use std::thread;
use std::time::{Duration, Instant};

use ecaxis_client::{Machine, Options};
use serde::{Deserialize, Serialize};
use serde_json::json;
use zenoh::handlers::{RingChannel, RingChannelHandler};
use zenoh::pubsub::Subscriber;
use zenoh::sample::{Sample, SampleKind};
use zenoh::{Session, Wait};

use super::reader::attach_options;
use super::setpoints::suffix;
use crate::config::LineShaftTable;
use crate::error::{Error, Result};

/// The points of one request.
const MAX_POINTS: usize = 64;
/// The longest message in bytes.
const MAX_MESSAGE: usize = 16 << 10;
/// The time between two tries to reach the server.
const RETRY: Duration = Duration::from_millis(300);
/// The least time between two warnings, and between two notes.
const QUIET: Duration = Duration::from_secs(10);

/// A set-point and its instant.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct Point {
    unix_ns: u64,
    position: f64,
    velocity: f64,
    acceleration: f64,
}

/// What a leader publishes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Message {
    stream: String,
    points: Vec<Point>,
}

impl Message {
    /// Reads a message; `None` for anything else.
    fn parse(bytes: &[u8]) -> Option<Self> {
        let short = bytes.len() <= MAX_MESSAGE;
        let message: Self = short.then(|| serde_json::from_slice(bytes).ok())??;
        let known = message.stream.len() <= 16 && message.points.len() <= MAX_POINTS;
        known.then_some(message)
    }
}

/// Feeds one line shaft.
#[derive(Debug)]
pub struct LineShaft {
    pub session: Session,
    pub socket: PathBuf,
    pub table: LineShaftTable,
}

/// Logs errors that may come with each message.
#[derive(Debug, Default)]
struct Warnings(Option<Instant>);

impl Warnings {
    fn warn(&mut self, shaft: &str, error: &dyn std::fmt::Display) {
        if self.0.is_none_or(|last| last.elapsed() > QUIET) {
            tracing::warn!(shaft, "line shaft: {error}");
            self.0 = Some(Instant::now());
        }
    }
}

type Newest = Subscriber<RingChannelHandler<Sample>>;

impl LineShaft {
    /// Feeds the server until the process ends.
    pub fn run(&self) {
        let mut warnings = Warnings::default();
        loop {
            let Err(error) = self.subscribe(&mut warnings);
            warnings.warn(&self.table.name, &error);
            thread::sleep(RETRY);
        }
    }

    fn subscribe(&self, warnings: &mut Warnings) -> Result<Infallible> {
        let failed = |error: zenoh::Error| Error::new(format!("Zenoh: {error}"));
        let LineShaftTable { name, from, axis } = &self.table;
        // The newest point alone counts: the server predicts from it.
        let points = self.session.declare_subscriber(from.key(&suffix(axis)));
        let points = points.with(RingChannel::new(1)).wait().map_err(failed)?;
        let tokens = self.session.liveliness();
        let tokens = tokens.declare_subscriber(from.key("alive")).history(true);
        let tokens = tokens.with(RingChannel::new(1)).wait().map_err(failed)?;
        while !self.session.is_closed() {
            let Err(error) = self.feed(&points, &tokens, warnings);
            warnings.warn(name, &error);
            thread::sleep(RETRY);
        }
        Err(Error::new("Zenoh: the session is closed"))
    }

    /// Feeds over one connection until it is lost. This stops the shaft; a refused point does not.
    fn feed(
        &self,
        points: &Newest,
        tokens: &Newest,
        warnings: &mut Warnings,
    ) -> Result<Infallible> {
        let failed = |error: zenoh::Error| Error::new(format!("Zenoh: {error}"));
        let lost = |error: ecaxis_client::Error| Error::new(error.to_string());
        let LineShaftTable { name, from, axis } = &self.table;
        let options = Options {
            name: format!("line shaft from {from} {axis}"),
            ..attach_options()
        };
        let machine = Machine::attach(&self.socket, options).map_err(lost)?;
        tracing::info!(shaft = name, "line shaft: connected");
        let (mut there, mut noted) = (None, None);
        loop {
            if let Some(token) = tokens.try_recv().map_err(failed)? {
                there = Some(token.kind() == SampleKind::Put);
            }
            // The time-out of the shaft stops it, not this note. A token may flap.
            let due = noted.is_none_or(|(known, at): (_, Instant)| {
                Some(known) != there && at.elapsed() > QUIET
            });
            if let Some(there) = there.filter(|_| due) {
                noted = Some((there, Instant::now()));
                let word = if there { "there" } else { "gone" };
                let text = format!("line shaft `{name}`: the agent of {from} is {word}");
                tracing::info!("{text}");
                if let Err(error) = machine.request("note", json!({"text": text})) {
                    warnings.warn(name, &error);
                }
            }
            let newest = points.recv_timeout(RETRY).map_err(failed)?;
            let message = newest.map(|sample| Message::parse(&sample.payload().to_bytes()));
            if let Some(None) = message {
                warnings.warn(name, &format!("a message of {from} has no set-points"));
            }
            if let Some(Some(Message { stream, points })) = message {
                let keys = json!({"name": name, "stream": stream, "points": points});
                if let Err(error) = machine.request("line_shaft", keys) {
                    warnings.warn(name, &error);
                }
            }
            machine.keep().map_err(lost)?;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn message(stream: &str, points: usize) -> Message {
        let point = Point {
            unix_ns: u64::MAX,
            position: 0.1,
            velocity: -1e-300,
            acceleration: f64::MAX,
        };
        Message {
            stream: stream.to_owned(),
            points: vec![point; points],
        }
    }

    #[test]
    fn a_message_is_read_as_it_was_written_within_its_bounds() {
        for (stream, points, taken) in [
            ("0123456789abcdef", 64, true),
            ("0123456789abcdef0", 1, false),
            ("", 0, true),
            ("a", 65, false),
        ] {
            let message = message(stream, points);
            let read = Message::parse(&serde_json::to_vec(&message).unwrap());
            assert_eq!(read, taken.then_some(message));
        }
    }

    proptest! {
        #[test]
        fn any_bytes_are_read_or_dropped(bytes in proptest::collection::vec(any::<u8>(), 0..256)) {
            let _ = Message::parse(&bytes);
            let mut text = serde_json::to_vec(&message("ab", 2)).unwrap();
            for (n, byte) in bytes.iter().enumerate().take(3) {
                let at = (n * 37 + usize::from(*byte)) % text.len();
                text[at] = *byte;
            }
            let _ = Message::parse(&text);
        }
    }
}
