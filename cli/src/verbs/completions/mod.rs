//! `ecaxis completions`: shell completion for subcommands, options, files, network interfaces and
//! the devices of a machine file.

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
    result(&with_names(args.shell, &String::from_utf8_lossy(&out)))
}

/// Adds the completion of interfaces and devices to a generated script.
fn with_names(shell: Shell, script: &str) -> String {
    /// The options that take an interface.
    const NIC: [&str; 2] = ["--nic)", "--nic2)"];
    let mut text = String::new();
    match shell {
        Shell::Bash => {
            let mut of_nic = false;
            for line in script.lines() {
                let line = match of_nic {
                    true => line.replace("compgen -f", "compgen -W \"$(_ecaxis_interfaces)\" --"),
                    false => line.to_owned(),
                };
                of_nic = NIC.contains(&line.trim());
                text += &line;
                text.push('\n');
            }
            text += include_str!("names.bash");
        }
        Shell::Zsh => {
            // The script ends with the call of its function, which needs the others.
            let (head, tail) = script.split_once("\n_ecaxis() {").unwrap_or((script, ""));
            text = format!("{head}\n{}\n_ecaxis() {{{tail}", include_str!("names.zsh"));
            text = text.replace(":IF:_default", ":IF:_net_interfaces");
            let lines = text.lines().map(|line| {
                if line.contains(" -- Network interface") {
                    line.replace(":_default'", ":_net_interfaces'")
                } else if line.contains("'*::words -- ") || line.contains(":device -- ") {
                    // With two colons, zsh offers no options after the first of the words.
                    let line = line.replace("'*::words", "'*:words");
                    line.replace(":_default'", ":_ecaxis_devices'")
                } else {
                    line.to_owned()
                }
            });
            text = lines.map(|line| line + "\n").collect();
        }
        Shell::Fish => {
            for line in script.lines() {
                text += line;
                if line.contains(" -l nic ") || line.contains(" -l nic2 ") {
                    text += " -f -a '(__fish_print_interfaces)'";
                }
                text.push('\n');
            }
            text += include_str!("names.fish");
        }
        _ => script.clone_into(&mut text),
    }
    text
}
