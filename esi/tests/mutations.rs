//! A drive's ESI file with one damage at a time. Each damage yields an error or a finding at its
//! position, without a panic and with bounded memory and time.
//!
//! `cargo test -p ecaxis-esi --test memory mutations -- --nocapture` prints message, peak memory
//! and time of each damage.

mod modules;
mod process_data;
mod structure;
mod table;

use crate::common;
use std::sync::mpsc;
use std::time::{Duration, Instant};

use ecaxis_esi::{SelectOptions, lint, offered_modes, parse, select, sii};
use table::{Mutation, Says};

/// A thread that runs longer counts as hanging, even on a slow machine.
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

/// Derives everything from a file, on a separate thread.
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
        let choice = SelectOptions {
            cycle_ns: 1_000_000,
            ..SelectOptions::default()
        };
        let _ = select(&file, device, &choice);
        for mode in offered_modes(&file, device) {
            let mode = Some(mode);
            let _ = select(&file, device, &SelectOptions { mode, ..choice });
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

/// Returns line and column of a byte offset, computed without the reader.
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
    crate::reset();
    let (said, took) = examine(bytes);
    let peak = crate::peak();
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
fn each_damage_is_reported_at_its_position() {
    let Some(bytes) = common::read(common::EPOS4) else {
        return;
    };
    let _alone = crate::measure();
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
    // Damage must not cause disproportionate work. Absolute times depend on the machine.
    assert!(
        longest < 100 * undamaged,
        "{longest:?} against {undamaged:?}"
    );
}
