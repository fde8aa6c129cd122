//! `ecaxis man`: the manual, out of what the command line says of itself.

use std::io;
use std::path::{Path, PathBuf};

use clap_mangen::Man;

use super::{Failure, command, note, result, unwritable};

const EXAMPLES: &str = "\
Examples:
  ecaxis man | man -l -                            read it
  ecaxis man --out ~/.local/share/man/man1         then `man ecaxis-run`";

/// Print the manual page, or write a page for every verb
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Write ecaxis.1 and a page for every verb into this folder, which is made if need be
    #[arg(long, value_name = "FOLDER")]
    out: Option<PathBuf>,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    // Help is no page of its own.
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

/// The page of a verb and of those below it; how many.
fn write_all(folder: &Path, verb: &clap::Command) -> io::Result<usize> {
    let man = Man::new(verb.clone());
    std::fs::write(folder.join(man.get_filename()), page(&man))?;
    let mut pages = 1;
    for below in verb.get_subcommands() {
        pages += write_all(folder, below)?;
    }
    Ok(pages)
}

/// Examples keep their lines.
fn page(man: &Man) -> String {
    let mut page = Vec::new();
    // Writing into memory cannot fail.
    let _ = man.render(&mut page);
    String::from_utf8_lossy(&page)
        .replacen("\n.SH EXTRA\n", "\n.SH EXAMPLES\n.nf\n", 1)
        .replacen("\nExamples:\n", "\n", 1)
        .replacen("\n.SH VERSION\n", "\n.fi\n.SH VERSION\n", 1)
}
