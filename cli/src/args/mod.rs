//! Arguments that several subcommands share, and the files they name.

use tracing_subscriber::EnvFilter;

use crate::render::{output, style};

pub(crate) mod bus;
pub(crate) mod device;
pub(crate) mod files;
pub(crate) mod record;
pub(crate) mod signals;
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

    pub fn start_logging(&self) {
        let level = match self.verbose {
            0 => "warn,ethercrab=error",
            1 => "info,ecaxis=debug",
            2 => "debug,ecaxis=trace",
            _ => "trace",
        };
        let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(level));
        tracing_subscriber::fmt()
            .with_env_filter(filter)
            .with_writer(|| output::Log)
            .with_ansi(style::on_stderr())
            .with_timer(tracing_subscriber::fmt::time::uptime())
            .init();
    }
}
