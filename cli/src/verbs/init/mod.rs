//! `ecaxis init`: a folder to start from, with a commented machine file or a program of one's own.

use std::fs;
use std::path::{Path, PathBuf};

use serde_json::json;

use crate::args::files::{replace, unwritable};
use crate::failure::{Failure, WRONG};
use crate::render::result;
use crate::starter::{self, ESI, SCHEMA, STARTER};

const EXAMPLES: &str = "\
Examples:
  ecaxis init press            press/machine.toml, with comments, its ESI
                               files and its schema for editors; then:
                               ecaxis run press/machine.toml
  ecaxis init --rust press     a cargo project with a controller of your own

Existing files are only overwritten with --force.";

/// Write a commented machine file to start from, or a cargo project with a controller
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Folder; created if missing
    #[arg(value_name = "DIR")]
    folder: PathBuf,
    /// Write a cargo project with a controller in the cycle, and tests on the simulated bus
    #[arg(long)]
    rust: bool,
    /// The sources of ecaxis that the cargo project uses [default: those of this program]
    #[arg(long, value_name = "DIR", requires = "rust")]
    source: Option<PathBuf>,
    /// Overwrite existing files
    #[arg(long)]
    force: bool,
}

/// The files of a cargo project; `@NAME@` stands for its name, `@SOURCE@` for its dependency.
const PROJECT: [(&str, &str); 5] = [
    ("Cargo.toml", include_str!("project/Cargo.toml.txt")),
    (".gitignore", "/target\n"),
    ("src/lib.rs", include_str!("project/src/lib.rs")),
    ("src/main.rs", include_str!("project/src/main.rs")),
    (
        "tests/simulated.rs",
        include_str!("project/tests/simulated.rs"),
    ),
];

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let folder = args.folder.as_path();
    let mut files = vec![
        ("machine.toml", starter::with_schema(STARTER)),
        (SCHEMA, starter::schema()),
    ];
    files.extend(ESI.map(|(name, text)| (name, text.to_owned())));
    if args.rust {
        // A string of JSON is one of TOML.
        let source = json!(source(args)?.to_string_lossy()).to_string();
        let name = package_name(folder);
        let project = PROJECT.map(|(file, text)| {
            let text = text.replace("@NAME@", &name);
            (file, text.replace("@SOURCE@", &source))
        });
        files.extend(project);
    }
    if !args.force {
        refuse_existing(folder, files.iter().map(|(name, _)| *name))?;
    }
    for (name, text) in &files {
        let path = folder.join(name);
        let parent = path.parent().unwrap_or(folder);
        fs::create_dir_all(parent).map_err(|error| unwritable(parent, &error))?;
        replace(&path, text.as_bytes())?;
    }
    let names: Vec<&str> = files.iter().map(|(name, _)| *name).collect();
    let shown = folder.display();
    let machine = match folder == Path::new(".") {
        true => PathBuf::from("machine.toml"),
        false => folder.join("machine.toml"),
    };
    let machine = machine.display();
    let next = match args.rust {
        false => format!("`ecaxis run {machine}`, then change the file"),
        true => format!("`cd {shown}`, `cargo test`, `cargo run --release`"),
    };
    result(&format!("{shown}: {}\nnext: {next}\n", names.join(", ")))
}

fn refuse_existing<'f>(
    folder: &Path,
    mut files: impl Iterator<Item = &'f str>,
) -> Result<(), Failure> {
    let there = |name: &&str| folder.join(name).symlink_metadata().is_ok();
    match files.find(there) {
        None => Ok(()),
        Some(name) => {
            let message = format!("{} exists already", folder.join(name).display());
            Err(Failure::new(WRONG, message)
                .hint("name another folder, or overwrite its files with `--force`"))
        }
    }
}

/// Returns the folder of the library in the sources.
fn source(args: &Args) -> Result<PathBuf, Failure> {
    let built_from = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let source = args.source.clone().unwrap_or(built_from);
    let library = source.join("master");
    match fs::canonicalize(&library) {
        Ok(library) if library.join("Cargo.toml").is_file() => Ok(library),
        _ => {
            let message = format!("{} does not have the sources of ecaxis", source.display());
            Err(Failure::new(WRONG, message)
                .hint("name a clone of the repository with `--source DIR`"))
        }
    }
}

/// Returns a name for the cargo package: valid and no word of Rust.
fn package_name(folder: &Path) -> String {
    let there = fs::canonicalize(folder).unwrap_or_else(|_| folder.to_owned());
    let name = there.file_name().unwrap_or_default().to_string_lossy();
    let word = |c: char| match c.is_ascii_alphanumeric() {
        true => c.to_ascii_lowercase(),
        false => '_',
    };
    let name: String = name.chars().map(word).collect();
    match name.trim_matches('_') {
        "" => "machine_controller".to_owned(),
        name if name.starts_with(|c: char| c.is_ascii_digit()) => {
            format!("machine_{name}_controller")
        }
        name => format!("{name}_controller"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn package_names_are_valid() {
        for (folder, name) in [
            ("/a/Press 2", "press_2_controller"),
            ("mod", "mod_controller"),
            ("/a/3d", "machine_3d_controller"),
            ("/a/…", "machine_controller"),
        ] {
            assert_eq!(package_name(Path::new(folder)), name);
        }
    }
}
