//! A fleet of machines over Zenoh. `docs/fleet.md` describes it.
//!
//! | module | |
//! |---|---|
//! | [`options`], [`config`] | the command line; the files |
//! | [`keys`] | the key expressions, and the names in them |
//! | [`agent`] | from the socket of `ecaxis serve` to Zenoh |
//! | [`reports`] | fault reports on disk, each under its SHA-256 |
//! | [`archive`], [`router`] | the history of all machines; a Zenoh router |
//! | [`observe`], [`page`] | the commands that read; the page with a tile per machine |
//! | [`orders`] | orders to machines |

pub mod agent;
pub mod archive;
pub mod config;
pub mod error;
pub mod keys;
pub mod observe;
pub mod options;
pub mod orders;
pub mod page;
pub mod reports;
pub mod router;
pub mod session;

use std::io::IsTerminal;
use std::process::ExitCode;

use options::{Command, Options};
use tracing_subscriber::EnvFilter;

/// The threads of the programs; Zenoh has its own.
const WORKERS: usize = 2;

/// Runs a command.
#[must_use]
#[expect(clippy::print_stderr, reason = "errors of a command")]
pub fn run(options: Options) -> ExitCode {
    let filter = EnvFilter::try_from_default_env();
    let filter = filter.unwrap_or_else(|_| EnvFilter::new("error,ecaxis_fleet=info"));
    let log = tracing_subscriber::fmt().with_env_filter(filter);
    let log = log.with_ansi(std::io::stderr().is_terminal());
    log.with_writer(std::io::stderr).init();
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(WORKERS)
        .enable_all()
        .build();
    let done = match runtime {
        Ok(runtime) => runtime.block_on(execute(options.command)),
        Err(error) => Err(error::Error::new(format!("starting a thread: {error}"))),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

async fn execute(command: Command) -> error::Result<()> {
    match command {
        Command::Agent { file } => agent::run(&file).await,
        Command::Router { file } => router::run(&file).await,
        Command::Archive { file } => archive::run(&file).await,
        Command::Status { network, json } => observe::status::run(&network, json).await,
        Command::Watch { network, json } => observe::watch::run(&network, json).await,
        Command::Report { network, action } => observe::report::run(&network, action).await,
        Command::Bundle { action } => orders::commands::bundle(action),
        Command::Push(args) => orders::commands::push(args).await,
        Command::Start(args) => orders::together::start(args).await,
        Command::Stop(args) => orders::together::stop(args).await,
        Command::Update(args) => orders::commands::update(args).await,
        Command::Page { network, options } => page::run(&network, options).await,
        Command::Samples { network, request } => observe::samples::run(&network, request).await,
    }
}
