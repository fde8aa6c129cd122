//! The subcommands.

use clap::Subcommand;
use ecaxis_master::change_log::ChangeLog;

use crate::access::change_log;
use crate::args::{LogArgs, Verbosity};
use crate::hints::Failure;

mod analyze;
mod bench;
mod check;
mod compare;
mod completions;
mod doctor;
mod eeprom;
mod eni;
pub(crate) mod esi;
mod explain;
mod firmware;
mod init;
pub(crate) mod jog;
mod man;
mod run;
mod scan;
mod schema;
mod sdo;
mod serve;
mod sim;
mod soe;
mod tune;

#[derive(Debug, Subcommand)]
pub(crate) enum Verb {
    Run(run::Args),
    Init(init::Args),
    Serve(serve::Args),
    Check(check::Args),
    Explain(explain::Args),
    Scan(scan::Args),
    Compare(compare::Args),
    Sdo(sdo::Args),
    Soe(soe::Args),
    Eeprom(eeprom::Args),
    Esi(esi::Args),
    Eni(eni::Args),
    Sim(sim::Args),
    Doctor(doctor::Args),
    Bench(bench::Args),
    Analyze(analyze::Args),
    Firmware(firmware::Args),
    Jog(jog::Args),
    Tune(tune::Args),
    Schema(schema::Args),
    Completions(completions::Args),
    Man(man::Args),
}

impl Verb {
    /// Returns the log options of a subcommand that logs.
    pub fn verbosity(&self) -> Option<&Verbosity> {
        match self {
            Self::Run(args) => Some(&args.verbosity),
            Self::Serve(args) => Some(&args.verbosity),
            Self::Scan(args) => Some(&args.verbosity),
            Self::Compare(args) => Some(&args.verbosity),
            Self::Sdo(args) => Some(&args.verbosity),
            Self::Soe(args) => Some(&args.verbosity),
            Self::Eeprom(args) => Some(&args.verbosity),
            Self::Sim(args) => Some(&args.verbosity),
            Self::Bench(args) => Some(&args.verbosity),
            Self::Firmware(args) => Some(&args.verbosity),
            Self::Tune(args) => Some(&args.verbosity),
            _ => None,
        }
    }

    /// Returns the options of a subcommand that keeps a machine up.
    pub fn log(&self) -> Option<&LogArgs> {
        match self {
            Self::Run(args) => Some(&args.log),
            Self::Serve(args) => Some(&args.log),
            Self::Jog(args) => Some(&args.log),
            _ => None,
        }
    }

    /// True if the subcommand may change a machine.
    fn changes(&self) -> bool {
        match self {
            Self::Run(_) | Self::Serve(_) | Self::Jog(_) | Self::Tune(_) => true,
            Self::Sdo(args) => args.changes(),
            Self::Soe(args) => args.changes(),
            Self::Eeprom(args) => args.changes(),
            Self::Firmware(args) => args.changes(),
            Self::Bench(args) => args.enables(),
            _ => false,
        }
    }

    /// Runs the subcommand. One that may change a machine enters the change log.
    pub fn run(self) -> Result<(), Failure> {
        let log = ChangeLog::of_environment().filter(|_| self.changes());
        let Some(log) = log else {
            return self.run_unlogged();
        };
        let moves = matches!(
            self,
            Self::Run(_) | Self::Serve(_) | Self::Jog(_) | Self::Tune(_) | Self::Bench(_)
        );
        if moves {
            change_log::append(&log, "begins");
        }
        let done = self.run_unlogged();
        let outcome = match &done {
            Ok(()) => "done",
            Err(failure) => failure.message.as_str(),
        };
        change_log::append(&log, outcome);
        done
    }

    fn run_unlogged(self) -> Result<(), Failure> {
        match self {
            Self::Run(args) => run::run(&args),
            Self::Init(args) => init::run(&args),
            Self::Serve(args) => serve::run(&args),
            Self::Check(args) => check::run(&args),
            Self::Explain(args) => explain::run(&args),
            Self::Scan(args) => scan::run(&args),
            Self::Compare(args) => compare::run(&args),
            Self::Sdo(args) => sdo::run(&args),
            Self::Soe(args) => soe::run(&args),
            Self::Eeprom(args) => eeprom::run(&args),
            Self::Esi(args) => esi::run(&args),
            Self::Eni(args) => eni::run(&args),
            Self::Sim(args) => sim::run(&args),
            Self::Doctor(args) => doctor::run(&args),
            Self::Bench(args) => bench::run(&args),
            Self::Firmware(args) => firmware::run(&args),
            Self::Jog(args) => jog::run(&args),
            Self::Tune(args) => tune::run(&args),
            Self::Schema(args) => schema::run(&args),
            Self::Completions(args) => completions::run(&args),
            Self::Man(args) => man::run(&args),
            Self::Analyze(args) => analyze::run(&args),
        }
    }
}
