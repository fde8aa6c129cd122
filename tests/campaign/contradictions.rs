//! Machines of the campaign with one entry more, which contradicts them: `ecaxis check` must refuse
//! each. An accepted one could move an axis past its limits, or leave a hold without effect.

use std::path::Path;
use std::process::{Command, Stdio};

use super::generate::{self, Plan};
use super::random::Random;
use super::run;
use super::view::Axis;
use super::wire::Profile;

const SEEDS: u64 = 120;
/// The fewest refusals of each kind: most machines permit most kinds.
const FEWEST: usize = 10;

/// Returns the machine file with a contradiction; `None` if the machine permits none of this kind.
type Contradiction = fn(&Plan, &mut Random) -> Option<String>;

/// Each kind with parts of its refusal, of which one is enough.
const KINDS: [(&str, Contradiction, &[&str]); 4] = [
    (
        "`sdo` of an object that the cycle writes",
        object_of_cycle,
        &["commands the drive", "is a target of the axis"],
    ),
    (
        "second owner of the outputs of an axis",
        output_of_axis,
        &["may not write it"],
    ),
    (
        "second owner of the outputs of a node",
        output_of_node,
        &["may not write it"],
    ),
    (
        "condition whose loss goes unseen",
        unseen_condition,
        &["without which the machine goes on"],
    ),
];

#[test]
fn no_contradiction_is_accepted() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut wrong = Vec::new();
    let mut refused = KINDS.map(|_| 0);
    for seed in 1..=SEEDS {
        let plan = generate::plan(seed, None);
        let mut random = Random::new(seed);
        if let Err(text) = check(&plan, folder.path()) {
            wrong.push(format!("seed {seed}, without a contradiction: {text}"));
        }
        for ((kind, contradict, parts), refused) in KINDS.into_iter().zip(&mut refused) {
            let Some(machine_file) = contradict(&plan, &mut random) else {
                continue;
            };
            let changed = Plan {
                machine_file,
                ..plan.clone()
            };
            match check(&changed, folder.path()) {
                Err(text) if parts.iter().any(|part| text.contains(part)) => *refused += 1,
                Err(text) => wrong.push(format!("seed {seed}, {kind}: {text}")),
                Ok(()) => {
                    let file = &changed.machine_file;
                    wrong.push(format!("seed {seed}, {kind}: accepted\n{file}"));
                }
            }
        }
    }
    println!("refused: {refused:?}");
    assert!(wrong.is_empty(), "{} wrong\n{}", wrong.len(), wrong[0]);
    assert!(refused.iter().all(|n| *n >= FEWEST), "{refused:?}");
}

/// Returns the text of the refusal.
fn check(plan: &Plan, folder: &Path) -> Result<(), String> {
    run::write(plan, folder);
    let output = Command::new(run::binary())
        .current_dir(folder)
        .args(["check", "machine.toml"])
        .stdin(Stdio::null())
        .output()
        .expect("the program starts");
    if output.status.success() {
        return Ok(());
    }
    Err(String::from_utf8_lossy(&output.stderr).into_owned())
}

/// Returns an EtherCAT drive of CiA 402 that fits.
fn drive<'a>(
    plan: &'a Plan,
    random: &mut Random,
    fits: impl Fn(&Axis) -> bool,
) -> Option<&'a Axis> {
    let all = plan.machine.axes.iter();
    let fitting: Vec<&Axis> = all
        .filter(|axis| axis.profile == Profile::Cia402 && axis.period == 1 && fits(axis))
        .collect();
    (!fitting.is_empty()).then(|| random.pick(&fitting))
}

/// Returns the text with an entry at the begin of the `sdo` of a drive.
fn with_sdo(plan: &Plan, axis: &Axis, entry: &str) -> Option<String> {
    let text = &plan.machine_file;
    let device = text.find(&format!("name = \"{}\"", axis.name))?;
    let list = "sdo = [";
    let at = device + text[device..].find(list)? + list.len();
    Some(format!("{}{entry}, {}", &text[..at], &text[at..]))
}

fn object_of_cycle(plan: &Plan, random: &mut Random) -> Option<String> {
    let axis = drive(plan, random, |_| true)?;
    let mut entries = vec![
        "{ index = 0x6040, value = 6 }",
        "{ index = 0x607A, value = 0 }",
    ];
    if axis.outputs.iter().any(|place| place.object == 0x60ff) {
        entries.push("{ index = 0x60FF, value = 0 }");
    }
    let entry = random.pick(&entries);
    with_sdo(plan, axis, entry)
}

fn output_of_axis(plan: &Plan, random: &mut Random) -> Option<String> {
    let axis = drive(plan, random, |_| true)?;
    let place = random.pick(&axis.outputs);
    let output = format!("{}.\"0x{:04X}\"", axis.name, place.object);
    Some(format!(
        "{}\n[[step]]\nset = {{ {output} = 0 }}\n",
        plan.machine_file
    ))
}

fn output_of_node(plan: &Plan, random: &mut Random) -> Option<String> {
    let nodes: Vec<&Axis> = plan
        .machine
        .axes
        .iter()
        .filter(|axis| axis.period > 1)
        .collect();
    let axis = *nodes.first()?;
    // Word and value of a node, or the control word of the gateway.
    let of_value = axis.outputs[1].at + random.below(4);
    let byte = random.pick(&[0, 1, axis.outputs[0].at, of_value]);
    let text = &plan.machine_file;
    if random.chance(0.5) {
        let step = format!("[[step]]\nset = {{ gateway.\"Output byte {byte:04}\" = 1 }}\n");
        return Some(format!("{text}\n{step}"));
    }
    let copy = format!(
        "[[copy]]\nfrom = \"gateway.Input byte 0060\"\nto = \"gateway.Output byte {byte:04}\"\n"
    );
    Some(format!("{text}\n{copy}"))
}

/// Adds a terminal in a group, with a drive, without which the machine goes on.
fn unseen_condition(plan: &Plan, random: &mut Random) -> Option<String> {
    let text = &plan.machine_file;
    let axis = drive(plan, random, |_| true)?;
    if text.contains("[[stop.group]]") || !plan.machine.gantries.is_empty() {
        return None;
    }
    let positions = text.matches("\nposition = ").count();
    let has = |table: &str| text.contains(&format!("\n{table}\n"));
    let condition = match has("[stop]") || random.chance(0.5) {
        true if has("[override]") => return None,
        true => "[override]\nhold = { lone.\"Input 1\" = true }",
        false => "[stop]\nemergency = { lone.\"Input 1\" = true }",
    };
    Some(format!(
        "{text}\n[[device]]\nname = \"lone\"\nesi = \"esi/IO8.xml\"\nposition = {positions}\n\
         \n{condition}\n\n[[stop.group]]\nname = \"lone\"\naxes = [\"{}\"]\n\
         devices = [\"lone\"]\noutside = \"continue\"\n",
        axis.name
    ))
}
