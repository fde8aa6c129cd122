//! The command line.

use std::net::SocketAddr;
use std::path::PathBuf;

use clap::{Args, Parser, Subcommand};

use crate::keys::MachineId;
use crate::orders::commands::{BundleAction, PushArgs, UpdateArgs};
use crate::orders::together::{StartArgs, StopArgs};
use crate::reports::ReportId;

/// Machines of `ecaxis serve` as a fleet over Zenoh
#[derive(Debug, Parser)]
#[command(name = "ecaxis-fleet", version, max_term_width = 80)]
pub struct Options {
    #[command(subcommand)]
    pub command: Command,
}

#[derive(Debug, Subcommand)]
pub enum Command {
    /// Publish a machine, from the socket of `ecaxis serve`
    #[command(after_help = "Examples:\n  ecaxis-fleet agent /etc/ecaxis/agent.toml")]
    Agent {
        /// The file of the agent
        file: PathBuf,
    },
    /// Forward between agents, archives and commands
    #[command(after_help = "Examples:\n  ecaxis-fleet router /etc/ecaxis/router.toml")]
    Router {
        /// The file of the router
        file: PathBuf,
    },
    /// Keep the last states, fault reports and events of all machines
    #[command(after_help = "Examples:\n  ecaxis-fleet archive /etc/ecaxis/archive.toml")]
    Archive {
        /// The file of the archive
        file: PathBuf,
    },
    /// Print all machines with their state
    #[command(
        after_help = "Examples:\n  ecaxis-fleet status --connect tcp/router:7447\n  \
                            ecaxis-fleet status --json"
    )]
    Status {
        #[command(flatten)]
        network: Network,
        /// Print JSON
        #[arg(long)]
        json: bool,
    },
    /// Print machines that appear and vanish, events and fault reports
    #[command(after_help = "Examples:\n  ecaxis-fleet watch --connect tcp/router:7447")]
    Watch {
        #[command(flatten)]
        network: Network,
        /// Print a JSON object per line
        #[arg(long)]
        json: bool,
    },
    /// List and show fault reports
    #[command(after_help = "Examples:\n  ecaxis-fleet report list\n  \
                            ecaxis-fleet report show 5f1c9a")]
    Report {
        #[command(flatten)]
        network: Network,
        #[command(subcommand)]
        action: ReportAction,
    },
    /// Serve a page with a tile for each machine
    #[command(
        after_help = "Examples:\n  ecaxis-fleet page --connect tcp/router:7447\n  \
                            ecaxis-fleet page --http 0.0.0.0:8090 --allow-host hall.example"
    )]
    Page {
        #[command(flatten)]
        network: Network,
        #[command(flatten)]
        options: PageOptions,
    },
    /// Print the samples of a machine's signals, as JSON
    #[command(after_help = "Examples:\n  ecaxis-fleet samples hall-1/press-3 \
                            --signals x.position --seconds 2")]
    Samples {
        #[command(flatten)]
        network: Network,
        #[command(flatten)]
        request: SamplesRequest,
    },
    /// Make, sign and verify bundles: the files of a machine
    #[command(
        after_help = "Examples:\n  ecaxis-fleet bundle make machine.toml press.bundle \\\n    \
                            --machine hall-1/press-3\n  \
                            ecaxis-fleet bundle sign press.bundle --key release.key"
    )]
    Bundle {
        #[command(subcommand)]
        action: BundleAction,
    },
    /// Send a bundle to a machine, which checks it and restarts with it
    #[command(
        after_help = "Examples:\n  ecaxis-fleet push hall-1/press-3 press.bundle \
                            --key anna.key\n  \
                            ecaxis-fleet push hall-1/press-3 --back --key anna.key"
    )]
    Push(PushArgs),
    /// Start the programs of machines: of all, or of none
    #[command(
        after_help = "Examples:\n  ecaxis-fleet start hall-1/press-3 --key anna.key\n  \
                            ecaxis-fleet start hall-1/press-3 hall-1/press-4 \\\n    \
                            --at 1795718434.5 --key anna.key"
    )]
    Start(StartArgs),
    /// Stop all axes and the programs of machines, also before their start
    #[command(
        after_help = "Examples:\n  ecaxis-fleet stop hall-1/press-3 hall-1/press-4 \\\n    \
                            --key anna.key"
    )]
    Stop(StopArgs),
    /// Update firmware or parameters, device by device, up to the first failure
    #[command(
        after_help = "Examples:\n  ecaxis-fleet update new.msdc hall-1/press-3:x,y \\\n    \
                            hall-1/press-4:x,y --key anna.key\n  \
                            ecaxis-fleet update x.toml hall-1/press-3:x \\\n    \
                            --parameters --key anna.key"
    )]
    Update(UpdateArgs),
}

/// How a command reaches the fleet.
#[derive(Debug, Clone, Args)]
pub struct Network {
    /// A file with the table `zenoh`
    #[arg(long, env = "ECAXIS_FLEET_CONFIG", global = true)]
    pub config: Option<PathBuf>,
    /// A router, such as tcp/router:7447
    #[arg(long, value_name = "ENDPOINT", global = true)]
    pub connect: Vec<String>,
}

#[derive(Debug, Subcommand)]
pub enum ReportAction {
    /// List the fault reports, newest first
    #[command(after_help = "Examples:\n  ecaxis-fleet report list --machine hall-1/press-3")]
    List {
        /// Only those of this machine
        #[arg(long, value_name = "SITE/MACHINE")]
        machine: Option<MachineId>,
        /// Print JSON
        #[arg(long)]
        json: bool,
    },
    /// Print a fault report as JSON
    #[command(after_help = "Examples:\n  ecaxis-fleet report show 5f1c9a")]
    Show {
        /// The first digits of its id
        #[arg(value_parser = id_prefix)]
        id: String,
    },
}

#[derive(Debug, Clone, Args)]
pub struct PageOptions {
    /// The address of the page; port 0: a free port
    #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1:8090")]
    pub http: SocketAddr,
    /// A further name that the `Host` header may contain
    #[arg(long, value_name = "NAME")]
    pub allow_host: Vec<String>,
}

#[derive(Debug, Clone, Args)]
pub struct SamplesRequest {
    /// The machine
    #[arg(value_name = "SITE/MACHINE")]
    pub machine: MachineId,
    /// The signals, such as x.position,y.position
    #[arg(long, value_delimiter = ',', required = true)]
    pub signals: Vec<String>,
    /// The time; at most 10
    #[arg(long, default_value_t = 1.0)]
    pub seconds: f64,
}

fn id_prefix(text: &str) -> Result<String, String> {
    match text.len() <= ReportId::DIGITS && text.bytes().all(|b| b.is_ascii_hexdigit()) {
        true => Ok(text.to_ascii_lowercase()),
        false => Err("write the first hexadecimal digits of an id".to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn the_help_fits_80_columns_and_has_examples() {
        let mut root = Options::command();
        root.clone().debug_assert();
        for command in root.get_subcommands_mut() {
            let help = command.render_long_help().to_string();
            assert!(help.contains("Examples:"), "{help}");
            assert!(
                help.lines().all(|line| line.chars().count() <= 80),
                "{help}"
            );
        }
    }
}
