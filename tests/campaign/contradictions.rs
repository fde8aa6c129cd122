//! Machines of the campaign with one entry more, which contradicts them: `ecaxis check` must refuse
//! each, or warn of it. An accepted one could move an axis past its limits, take a wrong angle as
//! home, or leave a hold without effect.

use std::path::Path;
use std::process::{Command, Stdio};

use super::esi;
use super::generate::{self, Plan};
use super::random::Random;
use super::run;
use super::view::Axis;
use super::wire::Profile;

const SEEDS: u64 = 120;
/// The fewest refusals of each kind: most machines permit most kinds.
const FEWEST: usize = 10;

/// Returns the plan with a contradiction; `None` if the machine permits none of this kind.
type Contradiction = fn(&Plan, &mut Random) -> Option<Plan>;

/// Each kind with parts of its refusal, of which one is enough.
const KINDS: [(&str, Contradiction, &[&str]); 5] = [
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
    ("polarity of the drive", polarity, &["0x607e:00 is 0x"]),
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
            let Some(changed) = contradict(&plan, &mut random) else {
                continue;
            };
            match check(&changed, folder.path()) {
                Err(text) if parts.iter().any(|part| text.contains(part)) => *refused += 1,
                Err(text) => wrong.push(format!("seed {seed}, {kind}: {text}")),
                Ok(_) => {
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

/// An angle of a shaft that is a whole number of the encoder's counts in each wrap of the drive's
/// 2^32 counts, or not: only the latter is warned of.
#[test]
fn an_absolute_angle_that_a_start_loses_is_warned_of() {
    const WARNING: &str = "a start finds a wrong position";
    let folder = tempfile::tempdir().expect("a folder");
    let mut seen = [0, 0];
    for seed in 1..=SEEDS {
        let plan = generate::plan(seed, None);
        let mut random = Random::new(seed);
        let Some((changed, is_lost)) = absolute_angle(&plan, &mut random) else {
            continue;
        };
        let text = check(&changed, folder.path());
        let file = &changed.machine_file;
        let text = text.unwrap_or_else(|error| panic!("seed {seed}: {error}\n{file}"));
        assert_eq!(
            text.contains(WARNING),
            is_lost,
            "seed {seed}: {text}\n{file}"
        );
        seen[usize::from(is_lost)] += 1;
    }
    println!("[kept, lost]: {seen:?}");
    assert!(seen.iter().all(|n| *n >= FEWEST), "{seen:?}");
}

/// Returns the text of the acceptance, or of the refusal.
fn check(plan: &Plan, folder: &Path) -> Result<String, String> {
    run::write(plan, folder);
    let output = Command::new(run::binary())
        .current_dir(folder)
        .args(["check", "machine.toml"])
        .stdin(Stdio::null())
        .output()
        .expect("the program starts");
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    if output.status.success() {
        return Ok(text(&output.stdout) + &text(&output.stderr));
    }
    Err(text(&output.stderr))
}

/// Returns the plan with another machine file.
fn changed(plan: &Plan, machine_file: String) -> Plan {
    Plan {
        machine_file,
        ..plan.clone()
    }
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
fn with_sdo(plan: &Plan, axis: &Axis, entry: &str) -> Option<Plan> {
    let text = &plan.machine_file;
    let device = text.find(&format!("name = \"{}\"", axis.name))?;
    let list = "sdo = [";
    let at = device + text[device..].find(list)? + list.len();
    let text = format!("{}{entry}, {}", &text[..at], &text[at..]);
    Some(changed(plan, text))
}

fn object_of_cycle(plan: &Plan, random: &mut Random) -> Option<Plan> {
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

fn output_of_axis(plan: &Plan, random: &mut Random) -> Option<Plan> {
    let axis = drive(plan, random, |_| true)?;
    let place = random.pick(&axis.outputs);
    let output = format!("{}.\"0x{:04X}\"", axis.name, place.object);
    let text = &plan.machine_file;
    let step = format!("{text}\n[[step]]\nset = {{ {output} = 0 }}\n");
    Some(changed(plan, step))
}

fn output_of_node(plan: &Plan, random: &mut Random) -> Option<Plan> {
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
        return Some(changed(plan, format!("{text}\n{step}")));
    }
    let copy = format!(
        "[[copy]]\nfrom = \"gateway.Input byte 0060\"\nto = \"gateway.Output byte {byte:04}\"\n"
    );
    Some(changed(plan, format!("{text}\n{copy}")))
}

/// Adds a terminal in a group, with a drive, without which the machine goes on.
fn unseen_condition(plan: &Plan, random: &mut Random) -> Option<Plan> {
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
    let text = format!(
        "{text}\n[[device]]\nname = \"lone\"\nesi = \"esi/IO8.xml\"\nposition = {positions}\n\
         \n{condition}\n\n[[stop.group]]\nname = \"lone\"\naxes = [\"{}\"]\n\
         devices = [\"lone\"]\noutside = \"continue\"\n",
        axis.name
    );
    Some(changed(plan, text))
}

/// Replaces the ESI of a drive.
fn with_esi(plan: &Plan, axis: &Axis, name: &str, esi: String) -> Option<Plan> {
    let text = &plan.machine_file;
    let device = text.find(&format!("name = \"{}\"", axis.name))?;
    let file = "esi/EPOS4.xml";
    let at = device + text[device..].find(file)?;
    let text = format!("{}{name}{}", &text[..at], &text[at + file.len()..]);
    let mut plan = changed(plan, text);
    plan.files.push((name.to_string(), esi));
    Some(plan)
}

/// True for an axis with the ESI of the EPOS4.
fn is_epos4(plan: &Plan, axis: &Axis) -> bool {
    let text = &plan.machine_file;
    let device = text.find(&format!(
        "name = \"{}\"\nesi = \"esi/EPOS4.xml\"",
        axis.name
    ));
    device.is_some()
}

/// A drive that turns positions, velocities or torques, with torques among its targets.
fn polarity(plan: &Plan, random: &mut Random) -> Option<Plan> {
    let torques = |axis: &Axis| axis.outputs.iter().any(|place| place.object == 0x6071);
    let axis = drive(plan, random, |axis| torques(axis) && is_epos4(plan, axis))?;
    let value = random.pick(&[0x20, 0x40, 0x60, 0x80, 0xa0, 0xc0, 0xe0]);
    let plan = with_esi(plan, axis, "polarity.xml", esi::with_polarity())?;
    with_sdo(
        &plan,
        axis,
        &format!("{{ index = 0x607E, value = {value} }}"),
    )
}

/// Gives an endless axis, alone on its bus, an absolute encoder and a gear. True: the counts of a wrap
/// are no whole number of turns of the shaft.
fn absolute_angle(plan: &Plan, random: &mut Random) -> Option<(Plan, bool)> {
    let axis = drive(plan, random, |axis| axis.range.is_none())?;
    let tables = || plan.machine_file.split("\n[[device]]\n");
    let bus = tables().next()?;
    let device = tables().find(|table| table.starts_with(&format!("name = \"{}\"", axis.name)))?;
    let device = device.split("\n\n").next()?;
    let (head, keys) = device.split_once("[device.axis]\n")?;
    let head = head.replace(
        &format!("\nposition = {}\n", axis.position),
        "\nposition = 0\n",
    );
    // The window of the drive is in counts.
    let keys = keys[keys.find("limits = ")?..].replace(", following_error = 4.0", "");
    let bits = 13 + random.below(11);
    let (motor, shaft) = random.pick(&[(1, 1), (4, 1), (64, 1), (1, 8), (49, 3), (10, 1), (7, 5)]);
    // 2^32 counts are so many turns of the shaft: 2^32 · shaft / (2^bits · motor).
    let is_lost = (shaft << (32 - bits)) % motor != 0;
    let text = format!(
        "{bus}\n[[device]]\n{head}[device.axis]\nunit = \"deg\"\nencoder = {}\ngear = [{motor}, {shaft}]\n\
         feed = 360.0\nmodulo = 360.0\nabsolute = true\n{keys}\n",
        1_u32 << bits
    );
    Some((changed(plan, text), is_lost))
}
