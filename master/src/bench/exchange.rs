//! What one frame to and fro costs on a link, in the rhythm of a cycle.

use std::io;

use crate::clock::{self, Clock, Nanos};
use crate::link::port::ETHERCAT;
use crate::link::{Link, LinkError, MAX_FRAME};
use crate::os::process::ThreadUse;
use crate::rt::margin::Margin;
use crate::rt::stats::Times;

/// What a link came to, over any number of rounds.
#[derive(Debug, Clone, Default)]
pub struct Exchanges {
    /// Sent to back.
    pub round_trip: Times,
    pub lost: u64,
    /// Back after its time.
    pub late: u64,
    pub used: ThreadUse,
    pub cycles: u64,
}

/// Why a round could not be done.
#[derive(Debug, thiserror::Error)]
pub enum ExchangeError {
    #[error(transparent)]
    Link(#[from] LinkError),
    #[error(transparent)]
    Os(#[from] io::Error),
}

impl Exchanges {
    /// Adds so many cycles of the calling thread: each sends one frame with `data` bytes of datagrams and waits for it,
    /// spinning, for three quarters of the cycle.
    ///
    /// # Errors
    /// Where the link fails.
    pub fn round(
        &mut self,
        link: &mut dyn Link,
        data: u16,
        cycle: Nanos,
        margin: &mut Margin,
        cycles: u32,
    ) -> Result<(), ExchangeError> {
        let mut frame = frame(data);
        let mut buf = [0; MAX_FRAME];
        // What is left of an earlier round.
        while link.recv(&mut buf)?.is_some() {}
        let before = ThreadUse::now()?;
        let mut next = clock::now() + cycle;
        for number in 0..cycles {
            let slept = Clock::Real.sleep_until(next, margin.get());
            margin.slept(slept);
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
        self.used = self.used.plus(ThreadUse::now()?.since(before));
        self.cycles += u64::from(cycles);
        Ok(())
    }

    /// Of the thread, for one cycle; what is spun is in it.
    #[must_use]
    pub fn cpu_ns_a_cycle(&self) -> f64 {
        self.used.cpu_ns as f64 / self.cycles.max(1) as f64
    }
}

/// Ethernet header and EtherCAT header.
const HEADERS: usize = 16;

/// A frame of ours with so many bytes in place of datagrams, at least 44 so that nothing pads it.
fn frame(data: u16) -> Vec<u8> {
    let data = data.clamp(44, 1498);
    let mut frame = vec![0xff; 6];
    frame.extend([0x10, 0x10, 0x10, 0x10, 0x00, 0x20]);
    frame.extend(ETHERCAT);
    frame.extend((0x1000 | data).to_le_bytes());
    frame.resize(HEADERS + usize::from(data), 0);
    frame
}
