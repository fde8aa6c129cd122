//! A bus for subcommands without a cycle: a network interface, or the simulated bus of a machine
//! file.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use ecaxis_master::acyclic::DatagramClient;
use ecaxis_master::cancel::CancelToken;
use ecaxis_master::clock::Clock;
use ecaxis_master::config::{Machine, Nic};
use ecaxis_master::link::{self, Link, SocketKind};
use ecaxis_master::session::{self, Cause, Error, Options};

use crate::access::signals;
use crate::args::nic::NicArg;
use crate::hints::{self, Failure};
use crate::render::note;
use crate::render::output;

/// How long the second copy of a frame is awaited in a ring without a cycle.
const COPY_TIMEOUT_NS: u64 = 5_000_000;

#[derive(Debug)]
pub(crate) struct Bus {
    on: BusKind,
    /// Only the clock, the faults of a simulated bus and the recording are used.
    options: Options,
    /// True if no other program may drive the interface during the work.
    alone: bool,
}

#[derive(Debug)]
enum BusKind {
    Interface {
        nic: String,
        /// The interface at the other end of a ring.
        second: Option<String>,
        back_end: SocketKind,
    },
    Sim(Box<Machine>),
}

impl Bus {
    /// Returns the bus that the machine's `nic` names.
    pub fn of(machine: &Machine) -> Self {
        let (on, clock) = match &machine.bus.nic {
            Nic::Sim => (BusKind::Sim(Box::new(machine.clone())), Clock::Virtual),
            Nic::Interface(nic) => {
                let (nic, back_end) = (nic.clone(), machine.bus.link);
                let second = machine.bus.redundant.clone();
                let on = BusKind::Interface {
                    nic,
                    second,
                    back_end,
                };
                (on, Clock::Real)
            }
        };
        let options = Options {
            clock,
            ..Options::default()
        };
        Self {
            on,
            options,
            alone: false,
        }
    }

    /// Returns the bus on the interfaces of an option.
    pub fn interface(nic: &NicArg) -> Self {
        Self {
            on: BusKind::Interface {
                nic: nic.first.clone(),
                second: nic.second.clone(),
                back_end: SocketKind::default(),
            },
            options: Options::default(),
            alone: false,
        }
    }

    /// Sets clock, faults and recording.
    pub fn with(self, options: Options) -> Self {
        Self { options, ..self }
    }

    /// Requires that no other program drives the interface.
    pub fn alone(self) -> Self {
        Self {
            alone: true,
            ..self
        }
    }

    /// The interface; hints depend on it.
    pub fn nic(&self) -> Nic {
        match &self.on {
            BusKind::Interface { nic, .. } => Nic::Interface(nic.clone()),
            BusKind::Sim(_) => Nic::Sim,
        }
    }

    /// The interface at the other end of a ring.
    pub fn second(&self) -> Option<&str> {
        match &self.on {
            BusKind::Interface { second, .. } => second.as_deref(),
            BusKind::Sim(_) => None,
        }
    }

    /// Runs `work` on the bus. `work` receives the number of foreign frames seen before the first
    /// transmission. Ctrl-C cancels it; shielded sections run to completion.
    pub fn visit<T, W>(self, work: W) -> Result<T, Failure>
    where
        T: Send + 'static,
        W: AsyncFnOnce(DatagramClient, u64) -> T + Send + 'static,
    {
        let nic = self.nic();
        let clock = self.options.clock;
        let stop = Arc::<CancelToken>::default();
        signals::stop_on_interrupt(&stop);
        let heard = Arc::new(AtomicU64::new(0));
        let others = Arc::clone(&heard);
        let done = session::with_bus(
            move || self.open(&others),
            clock,
            stop,
            async move |wire: DatagramClient| work(wire, heard.load(Ordering::Relaxed)).await,
        );
        done.map_err(|error| hints::failure(&error, &nic))
    }

    fn open(self, heard: &AtomicU64) -> Result<Box<dyn Link>, Error> {
        let Self { on, options, alone } = self;
        let comment = match &on {
            BusKind::Sim(machine) => session::recording_comment(machine),
            BusKind::Interface { nic, .. } => format!("interface {nic}"),
        };
        let link: Box<dyn Link> = match on {
            BusKind::Sim(machine) => {
                let faults = options.faults.as_ref();
                session::simulated_link(&machine, options.seed, faults)?
            }
            BusKind::Interface {
                nic,
                second,
                back_end,
            } => {
                let open = |nic: &str| -> Result<Box<dyn Link>, Error> {
                    // Interface settings that only disturb a cycle are irrelevant here.
                    let (mut link, _) = match (alone, second.is_some()) {
                        (true, false) => link::open_exclusive(nic, back_end)?,
                        (true, true) => link::open_end_exclusive(nic, back_end)?,
                        (false, false) => link::open(nic, back_end)?,
                        (false, true) => link::open_end(nic, back_end)?,
                    };
                    let frames = link::sniff_foreign_frames(link.as_mut(), Instant::now())
                        .map_err(Cause::Link)?;
                    heard.fetch_add(frames, Ordering::Relaxed);
                    Ok(link)
                };
                let first = open(&nic)?;
                let link = match &second {
                    None => first,
                    Some(second) => session::ring(first, open(second)?, COPY_TIMEOUT_NS),
                };
                // Another ecaxis may drive a machine on this interface.
                Box::new(link::source_address::PrivateMacLink::new(
                    link,
                    std::process::id(),
                ))
            }
        };
        session::recorded(link, &options, &comment)
    }
}

/// Warns about foreign frames that arrived before the first transmission.
pub(crate) fn warn_foreign_frames(others: u64) {
    if others > 0 {
        warn("another MainDevice is active on this bus; what both do may collide");
    }
}

/// Maps the error of work on a bus to a failure with hints.
pub(crate) fn done<T>(result: Result<T, Error>, nic: &Nic) -> Result<T, Failure> {
    result.map_err(|error| hints::failure(&error, nic))
}

/// Shows a transient status line on stderr, on a terminal only.
pub(crate) fn passing(text: &str) {
    output::set_status_line(text);
}

/// Clears the status line.
pub(crate) fn passed() {
    passing("");
}

/// Prints one line per warning.
pub(crate) fn warn(text: impl std::fmt::Display) {
    note(&format!("warning: {text}"));
}
