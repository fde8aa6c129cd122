//! The round-trip cost of one frame on a link at the rate of a cycle.

use std::io;

use ecaxis_master::clock::{self, Clock, Nanos};
use ecaxis_master::link::{Link, LinkError, MAX_FRAME};
use ecaxis_master::rt::spin::SpinWindow;
use ecaxis_master::rt::stats::LatencyHistogram;
use ecaxis_master::sys::process::ThreadUsage;
use ecaxis_sim::frame::FrameBuilder;

/// The result of a link over all rounds.
#[derive(Debug, Clone, Default)]
pub struct Exchanges {
    /// Transmission to reception.
    pub round_trip: LatencyHistogram,
    pub lost: u64,
    /// Frames that returned after the deadline.
    pub late: u64,
    pub used: ThreadUsage,
    pub cycles: u64,
}

/// Why a round failed.
#[derive(Debug, thiserror::Error)]
pub enum ExchangeError {
    #[error(transparent)]
    Link(#[from] LinkError),
    #[error(transparent)]
    Os(#[from] io::Error),
}

impl Exchanges {
    /// Runs `cycles` on the calling thread. Each cycle sends one frame with `data` bytes of
    /// datagrams and spins until it returns, for at most three quarters of the cycle.
    ///
    /// # Errors
    /// Fails if the link fails.
    pub fn round(
        &mut self,
        link: &mut dyn Link,
        data: u16,
        cycle: Nanos,
        margin: &mut SpinWindow,
        cycles: u32,
    ) -> Result<(), ExchangeError> {
        let mut frame = frame(data);
        let mut buf = [0; MAX_FRAME];
        // Discard frames of an earlier round.
        while link.recv(&mut buf)?.is_some() {}
        let before = ThreadUsage::now()?;
        let mut next = clock::now() + cycle;
        for number in 0..cycles {
            let slept = Clock::Real.sleep_until(next, margin.get());
            margin.record_wakeup(slept);
            let mark = number.to_le_bytes();
            frame[HEADERS..HEADERS + mark.len()].copy_from_slice(&mark);
            let sent = clock::now();
            link.send(&frame)?;
            let deadline = sent + cycle / 4 * 3;
            loop {
                let got = link.recv(&mut buf)?;
                let now = clock::now();
                match got {
                    Some(len)
                        if len > HEADERS + mark.len() && buf[HEADERS..].starts_with(&mark) =>
                    {
                        self.round_trip.record(now - sent);
                        break;
                    }
                    Some(_) => self.late += 1,
                    None if now >= deadline => {
                        self.lost += 1;
                        break;
                    }
                    None => std::hint::spin_loop(),
                }
            }
            next += cycle;
            let now = clock::now();
            if next < now {
                next = now + cycle;
            }
        }
        self.used = self.used.plus(ThreadUsage::now()?.since(before));
        self.cycles += u64::from(cycles);
        Ok(())
    }

    /// Returns the CPU time per cycle of the thread in ns, including spinning.
    #[must_use]
    pub fn cpu_ns_a_cycle(&self) -> f64 {
        self.used.cpu_ns as f64 / self.cycles.max(1) as f64
    }
}

/// Ethernet header, EtherCAT header and datagram header in bytes.
const HEADERS: usize = 26;

/// Returns a frame with one datagram of `bytes` with header and working counter, which no SubDevice
/// processes; at least 44, so that it needs no padding.
fn frame(bytes: u16) -> Vec<u8> {
    let data = vec![0; usize::from(bytes.clamp(44, 1498)) - 12];
    let frame = FrameBuilder::from_source([0x10, 0x10, 0x10, 0x10, 0x00, 0x20]);
    frame.datagram(0, 0, 0, &data).build()
}
