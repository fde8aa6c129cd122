//! `ecaxis esi list`: lists the devices of ESI files and finds the best match for a device.

use std::path::PathBuf;

use ecaxis_esi::Identity;
use ecaxis_master::esi_library::{self, Library, LoadError, RevisionMatch};
use ecaxis_tools::cells;
use ecaxis_tools::document::Table;
use ecaxis_tools::document::format::hex32;

use crate::args::numbers::number;
use crate::hints::{self, Failure};
use crate::render::{note, print_json, print_table};

const EXAMPLES: &str = "\
Examples:
  ecaxis esi list esi/
  ecaxis esi list esi/ --vendor 0xfb        of one vendor
  ecaxis esi list esi/ --vendor 0xfb --product 0x63500000 --revision 0x1700000";

/// List the devices in a file or folder of ESI files; with an identity, show the best match
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// ESI file, or a folder of them
    #[arg(value_name = "PATH")]
    path: PathBuf,
    /// Vendor ID, decimal or 0x…
    #[arg(long, value_parser = number)]
    vendor: Option<u32>,
    /// Product code, decimal or 0x…
    #[arg(long, value_parser = number)]
    product: Option<u32>,
    /// Revision of the device, decimal or 0x…; needs `--vendor` and `--product`
    #[arg(long, value_parser = number, requires = "vendor", requires = "product")]
    revision: Option<u32>,
    /// Match rule for revisions: equal, newer (the device may be newer than its description),
    /// high-word, low-word, ignore
    #[arg(long = "match", default_value = "newer")]
    rule: RevisionMatch,
    /// Read every file and do not use the cached index
    #[arg(long)]
    no_cache: bool,
    /// Print as JSON
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let library = open(args).map_err(|error| Failure::new(hints::WRONG, error.to_string()))?;
    for (file, problem) in library.unusable() {
        note(&format!(
            "warning: {}: {problem}",
            library.folder().join(file).display()
        ));
    }
    let entries: Vec<&esi_library::Entry> = match (args.vendor, args.product, args.revision) {
        (Some(vendor), Some(product), Some(revision)) => {
            let device = Identity {
                vendor,
                product,
                revision,
            };
            let found = library.find(device, args.rule);
            vec![found.ok_or_else(|| missing(&library, device, args.rule))?]
        }
        (vendor, product, _) => {
            let fits = |e: &&esi_library::Entry| {
                vendor.is_none_or(|vendor| e.vendor == vendor)
                    && product.is_none_or(|product| e.product == product)
            };
            library.entries().iter().filter(fits).collect()
        }
    };
    if args.json {
        return print_json(&entries);
    }
    if entries.is_empty() {
        let message = format!("{} describes no such device", library.folder().display());
        return Err(Failure::new(hints::WRONG, message).hint(vendors(&library)));
    }
    let mut table = Table::new("vendor|product|revision|type|name|file");
    for e in &entries {
        let vendor = format!("{} {}", hex32(e.vendor), e.vendor_name);
        let (product, revision) = (hex32(e.product), hex32(e.revision));
        let file = e.file.display();
        table.row(cells![vendor, product, revision, e.type_name, e.name, file]);
    }
    print_table(&table)
}

/// Lists the vendors in the library.
fn vendors(library: &Library) -> String {
    let mut all: Vec<String> = library
        .entries()
        .iter()
        .map(|e| format!("0x{:08x} {}", e.vendor, e.vendor_name))
        .collect();
    all.sort();
    all.dedup();
    match all.len() {
        0 => "there is no ESI file in it".to_owned(),
        1 => format!("its only vendor is {}", all.concat()),
        _ => format!("its vendors are {}", all.join(", ")),
    }
}

fn open(args: &Args) -> Result<Library, LoadError> {
    if args.path.is_file() {
        return Library::of_file(&args.path);
    }
    let cache = esi_library::cache_file(&args.path).filter(|_| !args.no_cache);
    Library::open(&args.path, cache.as_deref())
}

fn missing(library: &Library, device: Identity, rule: RevisionMatch) -> Failure {
    let same = |e: &&esi_library::Entry| (e.vendor, e.product) == (device.vendor, device.product);
    let described: Vec<String> = library
        .entries()
        .iter()
        .filter(same)
        .map(|e| format!("0x{:08x} in {}", e.revision, e.file.display()))
        .collect();
    let message = format!(
        "{} describes no device that fits {device} by the rule `{rule}`",
        library.folder().display()
    );
    let failure = Failure::new(hints::WRONG, message);
    if described.is_empty() {
        failure.hint("no file of that vendor and product; download it from the vendor's site")
    } else {
        failure.hint(format!("there are revisions {}", described.join(", ")))
    }
}
