//! A drive's ESI file, damaged in one place each time: an error or a finding at that very place, no panic, and bounded
//! memory and work.
//!
//! `cargo test -p ecaxis-esi --test mutations -- --nocapture` prints what each one says, its peak of memory and time.
//! One test in this binary, because it measures its own process.

#![allow(clippy::print_stdout)]

mod common;
#[path = "mutations/memory.rs"]
mod memory;
#[path = "mutations/modules.rs"]
mod modules;
#[path = "mutations/process_data.rs"]
mod process_data;
#[path = "mutations/structure.rs"]
mod structure;
#[path = "mutations/table.rs"]
mod table;

use std::sync::mpsc;
use std::time::{Duration, Instant};

use ecaxis_esi::{Choice, lint, offered_modes, parse, select, sii};
use table::{Mutation, Says};

/// Longer and a thread counts as hanging, on the slowest machine.
const HANG: Duration = Duration::from_secs(120);
const MAX_PEAK: usize = 200 << 20;

#[derive(Debug)]
struct Said {
    kind: &'static str,
    line: u32,
    column: u32,
    path: String,
    text: String,
}

/// Everything that is made of a file, on a thread of its own.
fn examine(bytes: Vec<u8>) -> (Vec<Said>, Duration) {
    let (done, result) = mpsc::channel();
    let started = Instant::now();
    std::thread::spawn(move || {
        let _ = done.send(all(&bytes));
    });
    let said = result.recv_timeout(HANG).expect("it panicked or hangs");
    (said, started.elapsed())
}

fn all(bytes: &[u8]) -> Vec<Said> {
    let file = match parse(bytes) {
        Ok(file) => file,
        Err(error) => {
            return vec![Said {
                kind: "refused",
                line: error.position().line,
                column: error.position().column,
                path: error.path().to_owned(),
                text: error.problem().to_string(),
            }];
        }
    };
    for device in file.devices.iter().take(3) {
        let choice = Choice {
            cycle_ns: 1_000_000,
            ..Choice::default()
        };
        let _ = select(&file, device, &choice);
        for mode in offered_modes(&file, device) {
            let mode = Some(mode);
            let _ = select(&file, device, &Choice { mode, ..choice });
        }
        let image = sii::emit(device, &file.modules, &sii::SiiOptions::default());
        sii::parse(&image).expect("an emitted image can be read");
    }
    lint(&file)
        .into_iter()
        .map(|finding| Said {
            kind: match finding.severity {
                ecaxis_esi::Severity::Error => "error",
                ecaxis_esi::Severity::Warning => "warning",
                ecaxis_esi::Severity::Note => "note",
            },
            line: finding.position.line,
            column: finding.position.column,
            path: finding.path,
            text: finding.message,
        })
        .collect()
}

/// Line and column of a place of the text, found without the reader.
fn place(text: &str, at: usize) -> (u32, u32) {
    let before = &text[..at];
    let line = before.matches('\n').count() + 1;
    let column = before.rsplit('\n').next().unwrap_or("").chars().count() + 1;
    (u32::try_from(line).unwrap(), u32::try_from(column).unwrap())
}

fn check(mutation: &Mutation, original: &str) -> Result<(String, usize, Duration), String> {
    let name = mutation.name;
    let damaged = (mutation.damage)(original.to_owned());
    let Says {
        kind,
        at,
        path,
        text,
    } = &mutation.says;
    let found = at.find(&damaged).ok_or(format!("{name}: no such place"))?;
    let (line, column) = place(&damaged, found);
    // The file is ISO-8859-1.
    let bytes = damaged.chars().map(|c| u8::try_from(u32::from(c)).unwrap());
    let bytes: Vec<u8> = bytes.collect();
    drop(damaged);
    memory::reset();
    let (said, took) = examine(bytes);
    let peak = memory::peak();
    let matching = said.iter().find(|said| {
        (said.kind, said.line, said.column) == (*kind, line, column)
            && said.path == *path
            && said.text.contains(text)
    });
    match matching {
        Some(said) => Ok((
            format!("{kind} {line}:{column} {path}: {}", said.text),
            peak,
            took,
        )),
        None => Err(format!(
            "{name}: wanted {kind} {line}:{column} {path}: …{text}…\n    said {:#?}",
            said.iter().take(6).collect::<Vec<_>>()
        )),
    }
}

#[test]
fn each_damage_is_told_at_its_place() {
    let Some(bytes) = common::read(common::EPOS4) else {
        return;
    };
    let original: String = bytes.iter().map(|&byte| char::from(byte)).collect();
    let (said, undamaged) = examine(bytes);
    assert!(said.is_empty(), "{said:#?}");
    let mut wrong = Vec::new();
    let (mut highest, mut longest) = (0, Duration::ZERO);
    let tables = [
        structure::MUTATIONS,
        process_data::MUTATIONS,
        modules::MUTATIONS,
    ];
    let mutations: Vec<&Mutation> = tables.into_iter().flatten().collect();
    for &mutation in &mutations {
        match check(mutation, &original) {
            Ok((said, peak, took)) => {
                println!(
                    "{:<44} {:>4} MB {:>5} ms  {said}",
                    mutation.name,
                    peak >> 20,
                    took.as_millis()
                );
                highest = highest.max(peak);
                longest = longest.max(took);
                if peak > MAX_PEAK {
                    wrong.push(format!("{}: {} MB", mutation.name, peak >> 20));
                }
            }
            Err(error) => wrong.push(error),
        }
    }
    println!(
        "{} kinds of damage, at most {} MB and {} ms; undamaged {} ms",
        mutations.len(),
        highest >> 20,
        longest.as_millis(),
        undamaged.as_millis()
    );
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    assert!(mutations.len() >= 30);
    // Damage must not make work out of proportion; absolute times depend on the machine.
    assert!(
        longest < 100 * undamaged,
        "{longest:?} against {undamaged:?}"
    );
}
