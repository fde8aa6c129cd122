//! The plan of a bench: what is measured, and compared with what.

use std::path::PathBuf;
use std::time::Duration;

use super::bus::{FaultInjection, ReplyDelay};
use ecaxis_master::clock::Nanos;
use ecaxis_master::config::duration::show as duration;
use ecaxis_master::config::{ExchangeMode, Machine, Nic};
use ecaxis_master::link::SocketKind;
use ecaxis_master::rt::spin::Spin;

/// Bytes of a cycle's frame in addition to the process data: headers, clock, AL status, a
/// diagnostic read.
const FRAME: usize = 16 + 20 + 12 + 14 + 20;
/// The approximate time for sending and receiving at both ends in ns.
const SOFTWARE: Nanos = 10_000;

/// The plan of a bench.
#[derive(Debug, Clone)]
pub struct Plan {
    pub target: Target,
    pub axes: usize,
    pub cycle_ns: Nanos,
    pub exchange: ExchangeMode,
    pub link: SocketKind,
    pub spin: Spin,
    pub hold: ReplyDelay,
    pub mischief: FaultInjection,
    pub priority: u8,
    /// The CPU of the cycle.
    pub cpu: usize,
    /// The CPU of the bus and the load; `None` on a computer with one CPU.
    pub other_cpu: Option<usize>,
    /// The time of one round of each variant.
    pub time: Duration,
    pub rounds: u32,
    /// True if a program loads the other CPU.
    pub hog: bool,
    /// True if the cycle's CPU is kept from idling for all variants.
    pub awake: bool,
    pub against: Vec<Baseline>,
}

/// The target of the measurement.
#[derive(Debug, Clone)]
pub enum Target {
    /// Drives at the far end of a pair of virtual interfaces.
    Veth,
    /// The same drives on the thread of the cycle.
    InProcess,
    /// The bus of a machine file, real or simulated. Axes are enabled only on request.
    Machine { machine: Box<Machine>, enable: bool },
}

/// A variant to compare with.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Baseline {
    /// cyclictest of rt-tests with the same priority, CPU and interval.
    Cyclictest,
    /// The same cycle without spinning before the release.
    Sleep,
    /// The same cycle with another exchange.
    Exchange(ExchangeMode),
    /// The same cycle with another link.
    Link(SocketKind),
    /// A program that exchanges as many bytes on the same interface; see `benches/ethercrab`.
    Program(PathBuf),
}

impl Plan {
    /// Returns the process data of all axes in bytes.
    #[must_use]
    pub fn bytes(&self) -> usize {
        self.axes * super::segment::DRIVE_BYTES
    }

    /// Returns the maximum delay of an answer in ns before its cycle is lost, for this exchange.
    #[must_use]
    pub fn slack_ns(&self, exchange: ExchangeMode) -> Nanos {
        let hold = match self.hold {
            ReplyDelay::Fixed(hold) => hold,
            ReplyDelay::Wire => {
                let devices = self.axes as u64 * super::segment::NANOS_PER_DEVICE;
                ecaxis_sim::frame::wire_time(FRAME + self.bytes()) + devices
            }
        };
        let time = match exchange {
            ExchangeMode::SameCycle => self.cycle_ns / 4 * 3,
            ExchangeMode::Pipelined => self.cycle_ns,
        };
        time.saturating_sub(hold + SOFTWARE)
    }

    /// Returns the constant delay of replies in ns, which the software does not cause.
    #[must_use]
    pub fn fixed_hold(&self) -> Option<Nanos> {
        match (&self.target, self.hold) {
            (Target::Veth, ReplyDelay::Fixed(hold)) => Some(hold),
            _ => None,
        }
    }

    /// Returns a description of the target.
    #[must_use]
    pub fn target_name(&self) -> String {
        match &self.target {
            Target::Veth => {
                let hold = match self.hold {
                    ReplyDelay::Fixed(hold) => format!("each reply held {}", duration(hold)),
                    ReplyDelay::Wire => {
                        "each reply held as long as a wire of 100 Mbit/s would".to_owned()
                    }
                };
                format!("a pair of virtual interfaces, {hold}")
            }
            Target::InProcess => "in process, without an interface".to_owned(),
            Target::Machine { machine, enable } => {
                let bus = match &machine.bus.nic {
                    Nic::Sim => "its simulated bus".to_owned(),
                    Nic::Interface(nic) => format!("`{nic}`"),
                };
                let axes = if *enable { "enabled" } else { "not enabled" };
                format!("{} on {bus}, axes {axes}", machine.path.display())
            }
        }
    }
}

/// Returns the name of an exchange as in the machine file and on the command line.
#[must_use]
pub fn exchange_name(exchange: ExchangeMode) -> &'static str {
    match exchange {
        ExchangeMode::SameCycle => "same-cycle",
        ExchangeMode::Pipelined => "pipelined",
    }
}
