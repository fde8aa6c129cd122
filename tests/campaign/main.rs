//! A random campaign: machines, programs and fault scripts from a seed, run under virtual time by
//! the program as its users run it, and judged by what the recording shows the drives received. The
//! judge shares no code with the packages of this workspace.
//!
//! `cargo test` makes ten machine-minutes. Hours, a single seed (loud), a single scene, another
//! binary:
//!
//! ```sh
//! ECAXIS_CAMPAIGN_HOURS=24 cargo test --release -p ecaxis --test campaign -- --nocapture
//! ECAXIS_CAMPAIGN_SEED=91 cargo test -p ecaxis --test campaign -- --nocapture
//! ECAXIS_CAMPAIGN_SCENE=jerk ECAXIS_CAMPAIGN_BINARY=target/release/ecaxis cargo test …
//! ```

#![allow(clippy::print_stdout, reason = "figures of the campaign")]

mod by_hand;
mod contradictions;
mod determinism;
mod esi;
mod faults;
mod features;
mod foreign;
mod generate;
mod judge;
mod pcapng;
mod random;
mod relations;
mod rules;
mod run;
mod scenes;
mod shaft;
mod stops;
mod tally;
mod tests;
mod verdict;
mod view;
mod wire;

use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};

use tally::Tally;

/// Runs of `cargo test`: more than ten machine-minutes, the same every time.
const RUNS: u64 = 300;
const THREADS: usize = 2;
/// The required percentage of failed runs whose report contains a correct cause.
const RIGHT_CAUSES: usize = 99;

fn asked<T: std::str::FromStr>(variable: &str) -> Option<T> {
    let text = std::env::var(variable).ok()?;
    let value = text.parse();
    assert!(value.is_ok(), "{variable}={text} is not a number");
    value.ok()
}

#[test]
fn no_machine_breaks_a_rule() {
    let scene: Option<String> = asked("ECAXIS_CAMPAIGN_SCENE");
    if let Some(seed) = asked("ECAXIS_CAMPAIGN_SEED") {
        let folder = tempfile::tempdir().expect("a folder").keep();
        let plan = run::placed(&generate::plan(seed, scene.as_deref()), &folder);
        let outcome = run::run(&plan, &folder);
        println!(
            "{}\n# faults.toml\n{}",
            plan.machine_file, plan.fault_script
        );
        for finding in &outcome.findings {
            println!("{}", run::around(&plan, &folder, finding));
        }
        println!("{outcome:#?}\nfiles in {}", folder.display());
        assert!(outcome.findings.is_empty(), "seed {seed} breaks a rule");
        return;
    }
    let hours: Option<f64> = asked("ECAXIS_CAMPAIGN_HOURS");
    let first: u64 = asked("ECAXIS_CAMPAIGN_FIRST").unwrap_or(1);
    let next = AtomicU64::new(first);
    let tally = Mutex::new(Tally::default());
    std::thread::scope(|scope| {
        for _ in 0..THREADS {
            scope.spawn(|| {
                let folder = tempfile::tempdir().expect("a folder");
                loop {
                    let seed = next.fetch_add(1, Ordering::Relaxed);
                    let seconds = tally.lock().expect("no panic").seconds;
                    if hours.map_or(seed >= first + RUNS, |hours| seconds >= hours * 3600.0) {
                        break;
                    }
                    let plan = generate::plan(seed, scene.as_deref());
                    let plan = run::placed(&plan, folder.path());
                    let outcome = run::run(&plan, folder.path());
                    tally.lock().expect("no panic").add(&plan, outcome);
                }
            });
        }
    });
    let tally = tally.into_inner().expect("no panic");
    println!("{tally}");
    assert!(tally.broken.is_empty(), "rules are broken, see above");
    let named = tally.right + tally.wrong.len();
    let enough = tally.right * 100 >= named * RIGHT_CAUSES || tally.wrong.len() < 2;
    assert!(enough, "wrong causes, see above");
}
