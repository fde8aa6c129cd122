//! Arguments that several subcommands share, and the files they name.

pub(crate) mod bus;
pub(crate) mod can_log;
pub(crate) mod files;
pub(crate) mod nic;
pub(crate) mod numbers;
pub(crate) mod record;
pub(crate) mod report;
pub(crate) mod trace;

use std::path::PathBuf;

/// Options of the subcommands that keep a machine up
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct LogArgs {
    /// Print only errors and the result
    #[arg(short, long)]
    pub quiet: bool,
    /// Append log lines and messages to this file instead of logging to stderr; RUST_LOG sets what
    /// is logged
    #[arg(long, value_name = "FILE")]
    pub log_file: Option<PathBuf>,
}

#[derive(Debug, clap::Args)]
pub(crate) struct Verbosity {
    /// Log events to stderr; repeat for more detail; RUST_LOG overrides it
    #[arg(short, long, global = true, action = clap::ArgAction::Count)]
    verbose: u8,
}

/// The log filter without options.
pub(crate) const DEFAULT_FILTER: &str = "warn,ethercrab=error";
/// The log filter of a file.
pub(crate) const FILE_FILTER: &str = "info,ethercrab=warn";

impl Verbosity {
    /// True if log lines are mixed with the output, so that no line is rewritten.
    pub fn plain(&self) -> bool {
        self.verbose > 0
    }

    /// Returns the log filter.
    pub fn log_filter(&self) -> &'static str {
        match self.verbose {
            0 => DEFAULT_FILTER,
            1 => "info,ecaxis=debug",
            2 => "debug,ecaxis=trace",
            _ => "trace",
        }
    }
}
