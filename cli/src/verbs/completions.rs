//! `ecaxis completions`: shell completion for subcommands, options and files.

use clap_complete::Shell;

use crate::command;
use crate::hints::Failure;
use crate::render::result;

const EXAMPLES: &str = "\
Examples:
  ecaxis completions bash > ~/.local/share/bash-completion/completions/ecaxis
  ecaxis completions zsh > ~/.zfunc/_ecaxis        with ~/.zfunc in `fpath`
  ecaxis completions fish > ~/.config/fish/completions/ecaxis.fish";

/// Print the completion script for a shell
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    #[arg(value_name = "SHELL")]
    shell: Shell,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let mut out = Vec::new();
    clap_complete::generate(args.shell, &mut command(), "ecaxis", &mut out);
    result(&String::from_utf8_lossy(&out))
}
