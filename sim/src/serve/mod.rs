//! The segment on a real network interface, in real time: other MainDevices may judge it.
//!
//! * `socket`: the raw socket
//! * `stats`: what is counted

mod socket;
mod stats;

use std::io;
use std::sync::atomic::{AtomicBool, Ordering};

use crate::frame::{self, ETHERTYPE, Kind};
use crate::{Segment, Transit};
use socket::{RawSocket, clock};
pub use stats::{Histogram, ServeStats};

const MAX_FRAME: usize = 1522;

#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    #[error("the interface `{0}` does not exist")]
    NoSuchInterface(String),
    #[error("opening a raw socket on `{0}` is not permitted")]
    NotPermitted(String),
    #[error("the interface `{nic}`: {what}: {source}")]
    Io {
        nic: String,
        what: &'static str,
        source: io::Error,
    },
}

/// Answers every EtherCAT frame on the interface until `stop` is set; looks at it at least every
/// millisecond. A frame reaches the devices at the time it reached the interface.
pub fn serve(
    segment: &mut Segment,
    nic: &str,
    stop: &AtomicBool,
) -> Result<ServeStats, ServeError> {
    let socket = RawSocket::open(nic)?;
    let mut stats = ServeStats::default();
    let mut buffer = [0_u8; MAX_FRAME];
    while !stop.load(Ordering::Relaxed) {
        let received = socket
            .receive(&mut buffer)
            .map_err(|source| ServeError::Io {
                nic: nic.to_owned(),
                what: "receiving",
                source,
            })?;
        let Some(received) = received else {
            segment.advance(clock(libc::CLOCK_MONOTONIC));
            continue;
        };
        let Some(bytes) = buffer.get_mut(..received.len) else {
            continue;
        };
        if bytes.get(12..14) != Some(&ETHERTYPE.to_be_bytes()) {
            stats.foreign += 1;
            continue;
        }
        stats.frames += 1;
        if received.cut {
            stats.malformed += 1;
            continue;
        }
        if frame::kind(bytes) != Kind::EtherCat {
            stats.malformed += 1;
        }
        match segment.transit(bytes, received.at) {
            Transit::Lost => stats.lost += 1,
            // The wire time the simulation adds is not waited for: a real wire follows.
            Transit::Back { .. } => {
                if socket.send(bytes) {
                    stats.answered += 1;
                } else {
                    stats.send_errors += 1;
                }
                let sent = clock(libc::CLOCK_MONOTONIC);
                stats.turnaround.add(sent.saturating_sub(received.at));
            }
        }
    }
    Ok(stats)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::SegmentOptions;

    #[test]
    fn a_missing_interface_is_named() {
        let mut segment = Segment::new(Vec::new(), SegmentOptions::default());
        let error = serve(&mut segment, "no-such-nic", &AtomicBool::new(true)).unwrap_err();
        assert_eq!(
            error.to_string(),
            "the interface `no-such-nic` does not exist"
        );
    }
}
