//! What is measured, and against what.

use std::path::PathBuf;
use std::time::Duration;

use super::bus::{Hold, Mischief};
use crate::clock::Nanos;
use crate::config::duration::show as duration;
use crate::config::{Exchange, Machine, Nic};
use crate::link::BackEnd;
use crate::rt::margin::Spin;

/// Bytes of a cycle's frame beside the process data: headers, clock, AL status, a diagnostic read.
const FRAME: usize = 16 + 20 + 12 + 14 + 20;
/// What sending and receiving take at both ends together, roughly.
const SOFTWARE: Nanos = 10_000;

/// A bench.
#[derive(Debug, Clone)]
pub struct Plan {
    pub target: Target,
    pub axes: usize,
    pub cycle_ns: Nanos,
    pub exchange: Exchange,
    pub link: BackEnd,
    pub spin: Spin,
    pub hold: Hold,
    pub mischief: Mischief,
    pub priority: u8,
    /// Of the cycle.
    pub cpu: usize,
    /// Of the bus and the hog; `None` where there is only one.
    pub other_cpu: Option<usize>,
    /// Of one round of each variant.
    pub time: Duration,
    pub rounds: u32,
    /// A program that takes all of the other CPU.
    pub hog: bool,
    /// Keep the cycle's CPU from idling, whoever is measured.
    pub awake: bool,
    pub against: Vec<Against>,
}

/// What the cycle runs on.
#[derive(Debug, Clone)]
pub enum Target {
    /// Drives that answer at the other end of a pair of virtual interfaces.
    Veth,
    /// The same in the thread of the cycle.
    InProcess,
    /// The bus of a machine file, as it is or simulated; axes are enabled where that is asked for.
    Machine { machine: Box<Machine>, enable: bool },
}

/// What takes turns with the cycle.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Against {
    /// Of rt-tests, with the same priority, CPU and interval.
    Cyclictest,
    /// The same cycle without spinning before the release.
    Sleep,
    /// The same cycle with another exchange.
    Exchange(Exchange),
    /// The same cycle with another link.
    Link(BackEnd),
    /// A program that exchanges as many bytes on the same interface; see `benches/ethercrab`.
    Program(PathBuf),
}

impl Plan {
    /// Process data of all axes, bytes.
    #[must_use]
    pub fn bytes(&self) -> usize {
        self.axes * super::segment::DRIVE_BYTES
    }

    /// How much later than due an answer may come, with this exchange: no more, and its cycle is lost.
    #[must_use]
    pub fn slack_ns(&self, exchange: Exchange) -> Nanos {
        let hold = match self.hold {
            Hold::Fixed(hold) => hold,
            Hold::Wire => {
                let devices = self.axes as u64 * super::segment::NANOS_PER_DEVICE;
                super::segment::wire_ns(FRAME + self.bytes()) + devices
            }
        };
        let time = match exchange {
            Exchange::SameCycle => self.cycle_ns / 4 * 3,
            Exchange::Pipelined => self.cycle_ns,
        };
        time.saturating_sub(hold + SOFTWARE)
    }

    /// What is held anyway is no share of the software's.
    #[must_use]
    pub fn fixed_hold(&self) -> Option<Nanos> {
        match (&self.target, self.hold) {
            (Target::Veth, Hold::Fixed(hold)) => Some(hold),
            _ => None,
        }
    }

    /// In words.
    #[must_use]
    pub fn target_name(&self) -> String {
        match &self.target {
            Target::Veth => {
                let hold = match self.hold {
                    Hold::Fixed(hold) => format!("each reply held {}", duration(hold)),
                    Hold::Wire => {
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

/// The name of an exchange in the machine file and on the command line.
#[must_use]
pub fn exchange_name(exchange: Exchange) -> &'static str {
    match exchange {
        Exchange::SameCycle => "same-cycle",
        Exchange::Pipelined => "pipelined",
    }
}
