//! Arguments that several subcommands share, and the files they name.

pub(crate) mod bus;
pub(crate) mod files;
pub(crate) mod numbers;
pub(crate) mod record;
pub(crate) mod report;
pub(crate) mod trace;

#[derive(Debug, clap::Args)]
pub(crate) struct Verbosity {
    /// Log events to stderr; repeat for more detail; RUST_LOG overrides it
    #[arg(short, long, global = true, action = clap::ArgAction::Count)]
    verbose: u8,
}

impl Verbosity {
    /// True if log lines are mixed with the output, so that no line is rewritten.
    pub fn plain(&self) -> bool {
        self.verbose > 0
    }

    /// Returns the log filter.
    pub fn log_filter(&self) -> &'static str {
        match self.verbose {
            0 => "warn,ethercrab=error",
            1 => "info,ecaxis=debug",
            2 => "debug,ecaxis=trace",
            _ => "trace",
        }
    }
}
