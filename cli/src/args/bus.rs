//! The bus of a machine: the file's interface, another one, or the simulated bus with its faults.

use std::path::{Path, PathBuf};

use ecaxis_master::config::{self, ConfigError, Machine, Nic};
use ecaxis_master::session;
use ecaxis_sim::{FaultScript, SecondPort};

use crate::args::nic::NicArg;
use crate::failure::{Failure, WRONG};
use crate::hints;

#[derive(Debug, clap::Args)]
pub(crate) struct BusArgs {
    /// Use this network interface instead of the file's; `IF,IF`: both ends of a ring
    #[arg(long, value_name = "IF", conflicts_with = "sim")]
    pub nic: Option<NicArg>,
    /// Use the simulated bus instead of the file's interface
    #[arg(long)]
    pub sim: bool,
    /// Fault script for the simulated bus
    #[arg(long, value_name = "FILE")]
    pub faults: Option<PathBuf>,
}

impl BusArgs {
    /// Loads a machine file. The options override the bus of the file.
    pub fn load(&self, file: &Path) -> Result<Machine, ConfigError> {
        let mut machine = config::load(file)?;
        if self.sim {
            machine.bus.nic = Nic::Sim;
        } else if let Some(nic) = &self.nic {
            nic.replace(&mut machine.bus);
        }
        Ok(machine)
    }

    /// Returns the fault script. Fails if it, or another option that is given, needs the simulated
    /// bus, and the machine is on an interface.
    pub fn script(
        &self,
        machine: &Machine,
        options: &[(bool, &str)],
    ) -> Result<Option<FaultScript>, Failure> {
        if let Nic::Interface(nic) = &machine.bus.nic {
            let faults = (self.faults.is_some(), "--faults");
            let mut given = options.iter().chain([&faults]).filter(|(given, _)| *given);
            if let Some((_, option)) = given.next() {
                let message =
                    format!("{option} needs the simulated bus, the machine is on `{nic}`");
                return Err(Failure::new(WRONG, message).hint("add --sim"));
            }
        }
        let ring = machine.bus.redundant.as_ref().map(|_| SecondPort::Listens);
        let script = self.faults.as_deref();
        script.map(|path| faults(path, machine, ring)).transpose()
    }
}

/// The maximum size of a fault script in bytes.
const MAX_BYTES: u64 = 16 << 20;

/// Loads a fault script and checks it against the machine's simulated bus, which may be a ring.
pub(crate) fn faults(
    path: &Path,
    machine: &Machine,
    ring: Option<SecondPort>,
) -> Result<FaultScript, Failure> {
    let text = ecaxis_master::file::read_text(path, MAX_BYTES)
        .map_err(|e| Failure::new(WRONG, format!("cannot read {}: {e}", path.display())))?;
    let bus = session::topology(machine, ring).map_err(|e| hints::failure(&e, &machine.bus.nic))?;
    let script = FaultScript::parse(&text).and_then(|script| {
        script.check(&bus)?;
        Ok(script)
    });
    script.map_err(|e| Failure::new(WRONG, format!("{}: {e}", path.display())))
}
