//! Answers every EtherCAT frame unchanged after a fixed time, like a bus of that delay.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};

use ecaxis_master::clock::{self, Clock, Nanos};
use ecaxis_master::link::{self, Link, MAX_FRAME, OpenError, SocketKind};
use ecaxis_master::sys::rt_thread;

/// The first SubDevice sets this bit in the first byte of the source address.
const PROCESSED: u8 = 0x02;

/// The SCHED_FIFO priority, below that of the measuring thread.
const PRIORITY: u8 = 60;

/// The timing of a reflector in ns.
#[derive(Debug, Clone, Copy, Default)]
pub struct ReplyTiming {
    /// The time from a frame to its answer.
    pub hold: Nanos,
    /// The sleep after an answer, when no frame is expected. A thread that never sleeps is
    /// throttled by the kernel for part of every second.
    pub rest: Nanos,
}

/// A thread that answers until it is dropped. It spins while it waits.
#[derive(Debug)]
pub struct Reflector {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<u64>>,
}

impl Reflector {
    /// Answers on `nic`. With a CPU, the thread spins there with real-time priority if permitted.
    /// Without one, it yields to other threads.
    ///
    /// # Errors
    /// Fails if the interface cannot be used or the thread cannot be started.
    pub fn start(nic: &str, pace: ReplyTiming, cpu: Option<usize>) -> Result<Self, OpenError> {
        let (mut link, _) = link::open(nic, SocketKind::Ring)?;
        let stop = Arc::new(AtomicBool::new(false));
        let ended = Arc::clone(&stop);
        let thread = thread::Builder::new()
            .name("reflector".to_owned())
            .spawn(move || {
                if let Some(cpu) = cpu {
                    let _ = rt_thread::become_realtime(PRIORITY, Some(cpu));
                }
                reflect(link.as_mut(), pace, cpu.is_some(), &ended)
            })
            .map_err(|source: io::Error| OpenError::Io {
                nic: nic.to_owned(),
                what: "starting a thread",
                source,
            })?;
        Ok(Self {
            stop,
            thread: Some(thread),
        })
    }

    /// Stops the thread and returns the number of answered frames.
    #[must_use]
    pub fn finish(mut self) -> u64 {
        self.end()
    }

    fn end(&mut self) -> u64 {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.take().map_or(0, |t| t.join().unwrap_or(0))
    }
}

impl Drop for Reflector {
    fn drop(&mut self) {
        self.end();
    }
}

fn reflect(link: &mut dyn Link, pace: ReplyTiming, alone: bool, stop: &AtomicBool) -> u64 {
    let mut buf = [0; MAX_FRAME];
    let mut answered = 0;
    while !stop.load(Ordering::Relaxed) {
        let Ok(Some(len)) = link.recv(&mut buf) else {
            if alone {
                std::hint::spin_loop();
            } else {
                thread::yield_now();
            }
            continue;
        };
        let due = clock::now() + pace.hold;
        buf[6] |= PROCESSED;
        while clock::now() < due {
            std::hint::spin_loop();
        }
        answered += u64::from(link.send(&buf[..len]).is_ok());
        if pace.rest > 0 {
            Clock::Real.sleep_until(clock::now() + pace.rest, 0);
        }
    }
    answered
}
