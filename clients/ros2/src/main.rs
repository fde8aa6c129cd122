//! `ecaxis-ros2`: a ROS 2 node over `ecaxis serve`, without a ROS installation.
//!
//! | module | |
//! |---|---|
//! | [`options`], [`joints`] | the command line; the axes as joints in rad or m |
//! | [`lease`], [`cycle`] | the thread that keeps the lease, and the one that writes set-points |
//! | [`command`], [`trajectory`] | messages as set-points, checked as a whole |
//! | [`follower`] | what a joint follows: commands or a trajectory, and when it stops |
//! | [`node`], [`publish`] | subscriptions and threads; joint states, `/diagnostics` |
//! | [`services`], [`status`] | services; the texts of `/diagnostics` |
//! | [`signals`] | inputs and outputs |
//! | [`messages`] | the ROS 2 messages |

mod command;
mod cycle;
mod follower;
mod joints;
mod lease;
mod messages;
mod node;
mod options;
mod publish;
mod services;
mod signals;
mod status;
mod trajectory;

use std::process::ExitCode;

use clap::Parser;

fn main() -> ExitCode {
    let options = options::Options::parse();
    match options.check().and_then(|()| node::run(options)) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}
