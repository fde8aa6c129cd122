//! `ecaxis man`: manual pages from the command-line definition.

use std::io;
use std::path::{Path, PathBuf};

use clap_mangen::Man;

use crate::args::files::unwritable;
use crate::command;
use crate::hints::Failure;
use crate::render::{note, result};

const EXAMPLES: &str = "\
Examples:
  ecaxis man | man -l -                            read it
  ecaxis man --out ~/.local/share/man/man1         then `man ecaxis-run`";

/// Print the manual page, or write one page per subcommand
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Write ecaxis.1 and one page per subcommand to this folder; create it if missing
    #[arg(long, value_name = "FOLDER")]
    out: Option<PathBuf>,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    // The generated `help` subcommand gets no page.
    let mut command = command().disable_help_subcommand(true);
    command.build();
    let Some(folder) = &args.out else {
        return result(&page(&Man::new(command)));
    };
    let pages = std::fs::create_dir_all(folder).and_then(|()| write_all(folder, &command));
    let pages = pages.map_err(|error| unwritable(folder, &error))?;
    note(&format!("{pages} pages in {}", folder.display()));
    Ok(())
}

/// Writes the pages of a subcommand and of those below it. Returns the number of pages.
fn write_all(folder: &Path, verb: &clap::Command) -> io::Result<usize> {
    let man = Man::new(verb.clone());
    std::fs::write(folder.join(man.get_filename()), page(&man))?;
    let mut pages = 1;
    for below in verb.get_subcommands() {
        pages += write_all(folder, below)?;
    }
    Ok(pages)
}

/// Renders a page and keeps the line breaks of the examples.
fn page(man: &Man) -> String {
    let mut page = Vec::new();
    // Writing to memory cannot fail.
    let _ = man.render(&mut page);
    String::from_utf8_lossy(&page)
        .replacen("\n.SH EXTRA\n", "\n.SH EXAMPLES\n.nf\n", 1)
        .replacen("\nExamples:\n", "\n", 1)
        .replacen("\n.SH VERSION\n", "\n.fi\n.SH VERSION\n", 1)
}
