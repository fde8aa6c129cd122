//! Properties for any file content: no panic, fields inside their SyncManagers, start-up commands
//! in order, and readable EEPROM images. Seeds are the small files of the fuzz corpus, one per
//! feature.
//!
//! `ECAXIS_FUZZ_FILES` sets the number of files, `ECAXIS_FUZZ_SEED` the first seed:
//! `ECAXIS_FUZZ_FILES=1000000 cargo test --release -p ecaxis-esi --test main fuzz -- --nocapture`

mod mutate;
mod walk;

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use ecaxis_esi::parse;
use mutate::{Dice, mutate};
use walk::{Reached, walk};

fn corpus() -> Vec<(String, Vec<u8>)> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fuzz/corpus/esi");
    let mut files: Vec<_> = std::fs::read_dir(folder)
        .unwrap()
        .flatten()
        .map(|entry| {
            let name = entry.file_name().to_string_lossy().into_owned();
            (name, std::fs::read(entry.path()).unwrap())
        })
        .collect();
    files.sort();
    files
}

fn from_env(key: &str, otherwise: u64) -> u64 {
    let text = std::env::var(key).ok();
    text.map_or(otherwise, |text| text.parse().expect("a number"))
}

/// Checks the seeds themselves, because an unreadable seed tests nothing.
#[test]
fn every_seed_passes_all_steps() {
    for (name, bytes) in corpus() {
        let file = parse(&bytes).unwrap_or_else(|error| panic!("{name}: {error}"));
        assert!(
            !file.devices.is_empty() || !file.modules.is_empty(),
            "{name}"
        );
        let mut reached = Reached::default();
        walk(&bytes, &mut reached);
        let devices = file.devices.len().min(3) as u64;
        assert_eq!(reached.images, devices, "{name}");
        assert!(
            reached.selected > 0 || ["soe", "reference"].contains(&name.as_str()) || devices == 0,
            "{name}"
        );
    }
}

#[test]
fn changed_seeds_keep_all_properties() {
    let (count, seed) = (
        from_env("ECAXIS_FUZZ_FILES", 20_000),
        from_env("ECAXIS_FUZZ_SEED", 1),
    );
    let seeds: Vec<Vec<u8>> = corpus().into_iter().map(|(_, bytes)| bytes).collect();
    let mut reached = Reached::default();
    for number in 0..count {
        let mut dice = Dice(
            seed.wrapping_add(number)
                .wrapping_mul(0x2545_f491_4f6c_dd1d),
        );
        let original: &Vec<u8> = dice.pick(&seeds);
        let bytes = mutate(original, &seeds, &mut dice);
        let walked = catch_unwind(AssertUnwindSafe(|| walk(&bytes, &mut reached)));
        if walked.is_err() {
            let text = String::from_utf8_lossy(&bytes);
            panic!(
                "ECAXIS_FUZZ_SEED={} ECAXIS_FUZZ_FILES=1:\n{text}",
                seed.wrapping_add(number)
            );
        }
    }
    println!("{reached:?}");
    // Most changed files must stay readable; otherwise the test checks too little.
    assert!(count == 1 || reached.read * 5 > count, "{reached:?}");
    assert!(count == 1 || reached.selected > count, "{reached:?}");
}
