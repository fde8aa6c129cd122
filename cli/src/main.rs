//! The command line.
//!
//! - `args`: arguments that several subcommands share, and the files they name;
//! - `access`: the bus and the device that a subcommand works on;
//! - `verbs`: one file or folder per subcommand, each with its arguments and `run`;
//! - `render`: text for people: summaries, tables, fault reports, progress;
//! - `hints`: message and advice for each failure;
//! - `failure`: a failure for the user, with its exit code;
//! - `starter`: the demonstration and the starter, which are part of the program.
//!
//! Results go to stdout, progress and errors to stderr.

use std::process::ExitCode;

use clap::Parser;

mod access;
mod args;
mod failure;
mod hints;
mod render;
mod starter;
mod verbs;

use verbs::Verb;

const EXAMPLES: &str = "\
Examples:
  ecaxis run                         the demonstration, on a simulated bus
  ecaxis init press                  a machine file to start from
  ecaxis scan enp3s0                 the devices on the bus
  ecaxis check machine.toml          all problems in the machine file
  ecaxis explain machine.toml        the derived configuration
  ecaxis run machine.toml --sim      its program on the simulated bus
  ecaxis run machine.toml            on the file's network interface
  ecaxis analyze run.pcapng          what a recording shows
  ecaxis help run                    the options of a subcommand, with examples
  ecaxis --version --json            version and commit, for scripts

Exit code: 0 done, 1 the machine or the bus failed, 2 the file or the command
line is wrong, 130 interrupted.
NO_COLOR=1 switches colours off, CLICOLOR_FORCE=1 on. ECAXIS_POLICY names the
policy for signed files, ECAXIS_CHANGE_LOG the change log. ECAXIS_RIGHTS=strict
insists that `run`, `serve` and `jog` give up the rights that they do not need.";

/// An EtherCAT master for CiA 402 drives in the cyclic synchronous modes.
#[derive(Debug, Parser)]
#[command(version, propagate_version = true, max_term_width = 100, after_help = EXAMPLES)]
struct Cli {
    #[command(subcommand)]
    verb: Verb,
}

/// Runs the command line. Exit codes: 0 done, 1 the machine or the bus failed, 2 the file or the
/// command line is wrong, 130 interrupted.
fn main() -> ExitCode {
    let mut arguments: Vec<_> = std::env::args_os().skip(1).collect();
    arguments.sort();
    if arguments == ["--json", "--version"] {
        return match render::print_json(&version()) {
            Ok(()) => ExitCode::SUCCESS,
            Err(failure) => ExitCode::from(failure.code),
        };
    }
    let verb = Cli::parse().verb;
    match start_logging(&verb).and_then(|()| verb.run()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            render::show_failure(&failure);
            ExitCode::from(failure.code)
        }
    }
}

/// Logs to stderr or to a file, as the options of the subcommand say.
fn start_logging(verb: &Verb) -> Result<(), failure::Failure> {
    let verbosity = verb.verbosity();
    if let Some(log) = verb.log() {
        render::output::set_quiet(log.quiet);
        if let Some(path) = &log.log_file {
            let verbose = verbosity.filter(|verbosity| verbosity.plain());
            let filter = verbose.map_or(args::FILE_FILTER, args::Verbosity::log_filter);
            let opened = render::output::start_log_file(path, filter);
            return opened.map_err(|error| args::files::unwritable(path, &error));
        }
    }
    if let Some(verbosity) = verbosity {
        render::output::start_logging(verbosity.log_filter());
    }
    Ok(())
}

/// Returns what identifies this program.
fn version() -> serde_json::Value {
    serde_json::json!({
        "name": "ecaxis",
        "version": ecaxis_master::VERSION,
        "commit": ecaxis_master::COMMIT,
        "arch": std::env::consts::ARCH,
        "debug": cfg!(debug_assertions),
    })
}

/// Returns the definition of the command line.
pub(crate) fn command() -> clap::Command {
    <Cli as clap::CommandFactory>::command()
}

#[cfg(test)]
mod tests {
    use clap::error::ErrorKind;

    use crate::*;

    #[test]
    fn every_subcommand_has_valid_examples() {
        fn look(verb: &clap::Command, path: &str) {
            let path = format!("{path} {}", verb.get_name());
            if verb.get_name() == "help" {
                return;
            }
            let help = verb.get_after_help().map(ToString::to_string);
            let help = help.unwrap_or_default();
            assert!(help.contains("Examples:\n"), "{path} has no examples");
            for line in help.lines() {
                assert!(line.chars().count() <= 80, "{path}: `{line}` is too wide");
                let Some(example) = line.trim().strip_prefix("ecaxis ") else {
                    continue;
                };
                // Two or more spaces separate the example from its description.
                let words = example.split("  ").next().unwrap_or_default();
                let words = words.split(['<', '>', '|']).next().unwrap_or_default();
                let line = std::iter::once("ecaxis").chain(words.split_whitespace());
                match Cli::try_parse_from(line) {
                    Ok(_) => {}
                    Err(e)
                        if matches!(
                            e.kind(),
                            ErrorKind::DisplayHelp | ErrorKind::DisplayVersion
                        ) => {}
                    Err(e) => panic!("{path}: `{words}`: {e}"),
                }
            }
            for verb in verb.get_subcommands() {
                look(verb, &path);
            }
        }
        look(&command(), "");
    }

    #[test]
    fn arguments_are_consistent() {
        command().debug_assert();
        for (line, good) in [
            ("ecaxis run", true),
            (
                "ecaxis run m.toml --sim --virtual --for 1h --repeat 2 --seed 7 --json",
                true,
            ),
            ("ecaxis run m.toml --nic eth0 --sim", false),
            ("ecaxis init d --rust --source s --force", true),
            ("ecaxis init d --source s", false),
            ("ecaxis run --for 10", false),
            ("ecaxis run --repeat 0", false),
            ("ecaxis check", false),
            ("ecaxis compare", false),
            ("ecaxis compare m.toml --sim o.toml --apply", true),
            ("ecaxis compare m.toml --apply --json", false),
            ("ecaxis scan eth0 --tree", true),
            ("ecaxis scan --sim m.toml --ask --json", true),
            ("ecaxis scan eth0 --sim m.toml", false),
            ("ecaxis scan eth0 --force", false),
            ("ecaxis scan eth0 --tree --json", false),
            ("ecaxis run m.toml --enable --no-enable", false),
            (
                "ecaxis esi show f.xml --device EPOS4 --mode csp --cycle 2ms",
                true,
            ),
            ("ecaxis esi sii f.xml", false),
            (
                "ecaxis esi list d --vendor 0xfb --product 1 --revision 2 --match high-word",
                true,
            ),
            ("ecaxis esi list d --revision 2", false),
            ("ecaxis esi list d --match roughly", false),
            (
                "ecaxis sdo read m.toml x 0x6064 Statusword --sim --json",
                true,
            ),
            ("ecaxis sdo read --nic eth0 --position 1 0x6064", true),
            ("ecaxis sdo read --position 1 0x6064", false),
            (
                "ecaxis sdo read --nic eth0 --position 1 --alias 2 0x6064",
                false,
            ),
            ("ecaxis sdo read --nic eth0 --id 5 0x6064", true),
            ("ecaxis sdo read --nic eth0 --id 5 --alias 2 0x6064", false),
            ("ecaxis sdo read --nic eth0 --position 1 --esi esi 1", true),
            ("ecaxis eeprom verify --nic eth0 --id 0x10", true),
            ("ecaxis eeprom verify --nic eth0 --esi esi", false),
            ("ecaxis sdo read", false),
            ("ecaxis sdo write m.toml x 0x6065 -5", true),
            ("ecaxis sdo store --nic eth0 --alias 0x10", true),
            ("ecaxis sdo compare a.toml b.toml --all", true),
            ("ecaxis eeprom alias m.toml x 1001 --yes", true),
            (
                "ecaxis eeprom read m.toml x image.bin --category 30 --all",
                false,
            ),
            ("ecaxis sim m.toml --nic veth0", true),
            ("ecaxis analyze run.pcapng --all --html r.html", true),
            ("ecaxis analyze a.pcapng b.pcap --interface 1 --json", true),
            ("ecaxis analyze", false),
            ("ecaxis run --record r.pcapng --record-limit 100MB", true),
            ("ecaxis run --record r.pcapng --record-limit 100", false),
            ("ecaxis run --record-limit 100MB", false),
            ("ecaxis run --replay r.pcapng --record again.pcapng", true),
            ("ecaxis run m.toml --replay r.pcapng --nic eth0", false),
            ("ecaxis firmware", false),
            ("ecaxis firmware info m.toml x --sim --json", true),
            ("ecaxis firmware info --nic eth0 --position 0", true),
            ("ecaxis firmware info --nic eth0 --id 5", true),
            ("ecaxis firmware info --position 0", false),
            ("ecaxis firmware info m.toml x --position 0", false),
            ("ecaxis firmware info --nic eth0 --sim", false),
            (
                "ecaxis firmware update m.toml x f.bin --via foe --yes",
                true,
            ),
            (
                "ecaxis firmware update f.bin --nic eth0 --alias 7 --dry-run",
                true,
            ),
            ("ecaxis firmware update f.bin --dry-run --yes", false),
            ("ecaxis firmware update", false),
            ("ecaxis firmware sample m.toml x -o f.bin --size 1MiB", true),
            ("ecaxis firmware sample m.toml x -o f.bin --size 1MB", false),
            ("ecaxis doctor", true),
            (
                "ecaxis doctor eth0 --machine m.toml --cpu 3 --cycle 250us --seconds 0 --json",
                true,
            ),
            ("ecaxis doctor --priority 100", false),
            ("ecaxis doctor --cycle 1us", false),
            ("ecaxis doctor --seconds -1", false),
        ] {
            assert_eq!(Cli::try_parse_from(line.split(' ')).is_ok(), good, "{line}");
        }
    }
}
