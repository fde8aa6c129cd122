//! Every device of the vendors' ESI files, alone on the simulated bus, in each mode, module,
//! assignment and OpMode that its file offers. It reaches Op, and an axis moves; or it is refused
//! with a message that names the reason. [`REFUSED`] and [`REFUSED_OF_PROJECTS`] list every refusal.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};

use ecaxis_esi::{Device, EsiFile, Mode, offered_modes};
use ecaxis_master::cancel::CancelToken;
use ecaxis_master::config;
use ecaxis_master::session::run_on;
use ecaxis_sim::Segment;
use ecaxis_test_support::wire::{WatchedBus, Watcher};
use ecaxis_test_support::{Heard, fixture, vendor_file, virtual_time};

/// A refusal: the start of the file's name, a part of the case, a part of the message, and the number
/// among all cases.
type Refusal = (&'static str, &'static str, &'static str, usize);

/// The refusals of open projects' files. Simulated device and ecaxis are right in each: the file
/// contradicts itself, or describes no process data.
const REFUSED_OF_PROJECTS: &[Refusal] = &[
    // Its TxPdo is on SyncManager 2, which is the one of the outputs.
    ("BogusIO", " default", "0x001e", 1),
    // The SYNC0 shift is 2.0002 s; no SYNC0 comes before Op.
    ("Orbita2d", " OpMode 2", "0x002c", 1),
    // No PDO has `Sm`, and CoE has neither PdoAssign nor PdoConfig: there is no process data.
    (
        "BogusServo",
        "",
        "does not let its PDO assignment be changed",
        14,
    ),
    (
        "BogusServo",
        " own PDOs",
        "does not let its PDOs be configured",
        6,
    ),
];

/// The refusals of vendors' files.
const REFUSED: &[Refusal] = &[
    // A Sercos drive has IDNs.
    (
        "Beckhoff AX5xxx",
        " own PDOs",
        "neither in the dictionary nor in a PDO",
        441,
    ),
    (
        "Hilscher_NETX90_RE_ECS_V5.2.0_MDP",
        " default",
        "needs a module",
        1,
    ),
    ("TI_AM243X", " default", "needs a module", 1),
    // The device's InitCmd writes two bytes to an object of one byte.
    ("kickcat_esi_test_sm_fmmu", "", "0x06070012", 4),
    // The default PDOs have no 0x6060 or no target of the mode, and no room for them.
    ("", " default", "cannot switch to", 308),
    ("", "hm default", "homing needs modes of operation", 151),
    ("", " own PDOs", "does not let its PDOs be configured", 18),
    // The dictionary of two drives has homing methods up to 35.
    ("", "hm ", "37 is outside what the ESI allows", 4),
];

/// One device with one choice of each kind.
#[derive(Debug)]
struct Case {
    file: PathBuf,
    /// The device's identity and the choice, for messages.
    name: String,
    /// The keys of `[[device]]` that select the device and the choice.
    keys: String,
    /// The mode of the motion, and the counts per turn.
    drive: Option<(Mode, u64)>,
    /// The key of the axis.
    velocity_unit: &'static str,
}

/// The modes that an axis reaches by a step, and the outputs that they need.
const BY_STEP: [(Mode, &str); 3] = [
    (Mode::Pp, "\"0x6081\", \"0x6083\", \"0x6084\""),
    (Mode::Pv, "\"0x60FF\", \"0x6083\", \"0x6084\""),
    (Mode::Hm, ""),
];

/// Returns the keys of the user's own PDOs with the objects that mode switches need.
fn own_pdos(objects: &str) -> String {
    format!(
        "pdo.rx = [\"0x6040\", \"0x6060\", \"0x607A\", {objects}]\n\
         pdo.tx = [\"0x6041\", \"0x6061\", \"0x6064\"]\n"
    )
}

/// Returns a TOML string.
fn quoted(text: &str) -> String {
    let escaped = text.replace('\\', "\\\\").replace('"', "\\\"");
    format!("\"{escaped}\"")
}

/// Returns the counts per motor turn: 0x608F of the dictionary, otherwise those of the simulated
/// motor.
fn encoder(device: &Device) -> u64 {
    let value = |sub| {
        let item = device.dictionary.item(0x608f, sub)?;
        let mut bytes = [0; 8];
        bytes
            .get_mut(..item.default.len())?
            .copy_from_slice(&item.default);
        Some(u64::from_le_bytes(bytes)).filter(|value| *value > 0)
    };
    value(1).map_or(2000, |counts| counts / value(2).unwrap_or(1))
}

/// Returns the modules of each place: each alone, then all places with their first.
fn module_choices(file: &EsiFile, device: &Device) -> Vec<Vec<String>> {
    let Some(slots) = &device.slots else {
        return Vec::new();
    };
    let mut places: Vec<(bool, Vec<String>)> = Vec::new();
    for slot in &slots.slots {
        let classed = file.modules.iter().filter(|module| {
            let class = module.class.as_ref();
            class.is_some_and(|class| slot.module_classes.contains(class))
        });
        let idents = slot.module_idents.iter().map(|(ident, _)| *ident);
        let idents: Vec<String> = idents
            .chain(classed.map(|module| module.ident))
            .map(|ident| format!("0x{ident:08x}"))
            .collect();
        for instance in 0..slot.max_instances.max(slot.min_instances).clamp(1, 16) {
            places.push((instance < slot.min_instances, idents.clone()));
        }
    }
    let first = |place: &(bool, Vec<String>)| place.1.first().cloned().unwrap_or_default();
    let mut choices = Vec::new();
    for (number, (_, idents)) in places.iter().enumerate() {
        for ident in idents {
            let modules = places.iter().enumerate().map(|(other, place)| match place {
                _ if other == number => ident.clone(),
                (true, _) => first(place),
                (false, _) => "-".to_owned(),
            });
            choices.push(modules.collect());
        }
    }
    choices.push(places.iter().map(first).collect());
    choices
}

/// Returns each choice of a device as (name, keys).
fn choices(device: &Device) -> Vec<(String, String)> {
    let mut choices = vec![("default".to_owned(), String::new())];
    for (n, mode) in device.dc_modes.iter().enumerate() {
        // Several OpModes may have one name; their descriptions differ.
        let repeated = device
            .dc_modes
            .iter()
            .take(n)
            .any(|other| other.name == mode.name);
        let name = if repeated {
            &mode.description
        } else {
            &mode.name
        };
        choices.push((
            format!("OpMode {}", n + 1),
            format!("dc = {}\n", quoted(name)),
        ));
    }
    if !device.dc_modes.is_empty() {
        choices.push(("no clock".to_owned(), "dc = \"off\"\n".to_owned()));
    }
    for (n, mapping) in device.sm_mappings.iter().enumerate() {
        let keys = format!("assignment = {}\n", quoted(&mapping.name));
        choices.push((format!("assignment {}", n + 1), keys));
    }
    choices
}

/// Returns the cases of a file. With `alone`, drives are devices without an axis, too.
fn cases_of(path: &Path, alone: bool) -> Vec<Case> {
    let file = std::fs::read(path).expect("readable");
    let file = ecaxis_esi::parse(&file).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    let (mut drives, mut others) = (Vec::new(), Vec::new());
    for device in &file.devices {
        let id = &device.identity;
        let who = format!(
            "type = {}\nproduct = {}\nrevision = {}\n",
            quoted(&device.type_name),
            id.product,
            id.revision
        );
        let case = |choice: &str, keys: &str, mode: Option<Mode>| {
            // The other modes are reached from CSP.
            let base = mode.map(|mode| if mode.is_cyclic() { mode } else { Mode::Csp });
            let more = base.map(|mode| format!("mode = \"{mode}\"\n"));
            let mode_name = mode.map(|mode| format!("{mode} "));
            // The simulated Sercos drive has this one.
            let soe = device
                .mailbox
                .as_ref()
                .is_some_and(|mailbox| mailbox.soe.is_some());
            let velocity_unit = match soe {
                true => "velocity_unit = \"mrpm\"\n",
                false => "",
            };
            Case {
                velocity_unit,
                file: path.to_owned(),
                name: format!(
                    "{:08x}:{:08x} {}{choice}",
                    id.product,
                    id.revision,
                    mode_name.unwrap_or_default()
                ),
                keys: format!("{who}{}{keys}", more.unwrap_or_default()),
                drive: mode.map(|mode| (mode, encoder(device))),
            }
        };
        let modes = offered_modes(&file, device);
        let modes: Vec<Mode> = modes.into_iter().filter(|mode| mode.is_cyclic()).collect();
        for (choice, keys) in choices(device) {
            for mode in &modes {
                drives.push(case(&choice, &keys, Some(*mode)));
            }
            if modes.is_empty() || alone {
                others.push(case(&choice, &keys, None));
            }
        }
        if modes.contains(&Mode::Csp) {
            for (mode, objects) in BY_STEP {
                drives.push(case("default", "", Some(mode)));
                drives.push(case("own PDOs", &own_pdos(objects), Some(mode)));
            }
        }
        if modes.is_empty() {
            for (n, modules) in module_choices(&file, device).iter().enumerate() {
                let names: Vec<String> = modules.iter().map(|name| quoted(name)).collect();
                let keys = format!("modules = [{}]\n", names.join(", "));
                others.push(case(&format!("modules {}", n + 1), &keys, None));
            }
        }
    }
    drives.append(&mut others);
    drives
}

/// Follows the shaft of the drive.
struct Shaft(Arc<Mutex<Vec<i64>>>);

impl Watcher for Shaft {
    fn after(&mut self, segment: &mut Segment) {
        let drive = segment.device(0).and_then(|device| device.drive());
        if let Some(drive) = drive {
            let mut positions = self.0.lock().expect("no panic");
            positions.push(drive.position_counts());
        }
    }
}

/// Runs a case. Returns the refusal, or what went wrong in spite of a run that ended well.
fn run(case: &Case) -> Result<Result<(), String>, String> {
    let axis = case.drive.map(|(mode, encoder)| {
        let step = match mode {
            Mode::Csp => "move = { d = 1.0 }",
            Mode::Csv => "velocity = { d = 5.0 }",
            Mode::Cst => "torque = { d = 8.0 }",
            Mode::Pp => "mode = { d = \"pp\" }\n[[step]]\nmove = { d = 1.0 }",
            Mode::Pv => "mode = { d = \"pv\" }\n[[step]]\nvelocity = { d = 5.0 }",
            Mode::Hm => "home = [\"d\"]\n[[step]]\nmove = { d = 1.0 }",
        };
        let homing = match mode {
            Mode::Hm => "homing = { method = 37 }\n",
            _ => "",
        };
        format!(
            "[device.axis]\nunit = \"turn\"\nencoder = {encoder}\n\
             limits = {{ velocity = 20.0, acceleration = 200.0, torque = 100.0, following_error = 1.0 }}\n\
             {}{homing}[[step]]\n{step}\n",
            case.velocity_unit
        )
    });
    let text = format!(
        "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n[[device]]\nname = \"d\"\nesi = {}\nposition = 0\n{}{}\
         [[step]]\ndwell = \"300ms\"\n",
        quoted(&case.file.display().to_string()),
        case.keys,
        axis.unwrap_or_default()
    );
    let machine = config::parse(Path::new("machine.toml"), &text).map_err(|e| e.to_string())?;
    let options = virtual_time();
    let positions = Arc::new(Mutex::new(Vec::new()));
    let link = Box::new(WatchedBus::new(
        &machine,
        &options,
        Shaft(Arc::clone(&positions)),
    ));
    let mut heard = Heard::default();
    let stop = Arc::<CancelToken>::default();
    let outcome = run_on(link, machine, options, stop, &mut heard);
    outcome.result.map_err(|error| error.to_string())?;
    let summary = outcome.summary.expect("a summary");
    let errors = summary.counters.wkc_errors + summary.counters.lost_frames;
    if errors > 0 {
        return Ok(Err(format!(
            "{errors} wrong working counters or lost frames"
        )));
    }
    let Some((mode, encoder)) = case.drive else {
        return Ok(Ok(()));
    };
    let positions = positions.lock().expect("no panic");
    let turned = match (positions.first(), positions.last()) {
        (Some(first), Some(last)) => (last - first) as f64 / encoder as f64,
        _ => return Ok(Err("no drive".to_owned())),
    };
    let moved = match mode {
        Mode::Csp | Mode::Pp | Mode::Hm => (turned - 1.0).abs() < 0.01,
        // 5 turns/s for 300 ms.
        Mode::Csv => (turned - 1.5).abs() < 0.3,
        // The drive decelerates by its own value.
        Mode::Pv => turned > 1.4,
        Mode::Cst => turned > 0.2,
    };
    Ok(moved
        .then_some(())
        .ok_or(format!("moved {turned:.3} turns")))
}

/// The results of all cases of one folder.
#[derive(Default)]
struct Tally {
    cases: usize,
    /// Cases whose axis moved.
    moved: usize,
    /// Devices without an axis in Op.
    done: usize,
    /// The number of refusals by row of the table.
    refused: Vec<usize>,
    /// Results that the table does not have.
    wrong: Vec<String>,
}

/// Runs every case of the ESI files in the folders of vendors.
fn sweep(folder: &Path, alone: bool, refusals: &[Refusal]) -> Tally {
    let mut files = Vec::new();
    for vendor in std::fs::read_dir(folder).expect("a folder").flatten() {
        let inside = std::fs::read_dir(vendor.path()).expect("a folder");
        files.extend(inside.flatten().map(|entry| entry.path()));
    }
    files.sort();
    let cases = files.iter().flat_map(|file| cases_of(file, alone));
    let cases: Vec<Case> = cases.collect();
    let next = AtomicUsize::new(0);
    let results = Mutex::new(Vec::new());
    let workers = std::thread::available_parallelism().map_or(2, usize::from);
    std::thread::scope(|scope| {
        for _ in 0..workers {
            scope.spawn(|| {
                while let Some(case) = cases.get(next.fetch_add(1, Ordering::Relaxed)) {
                    let result = run(case);
                    results.lock().expect("no panic").push((case, result));
                }
            });
        }
    });
    let mut results = results.into_inner().expect("no panic");
    results.sort_by_key(|(case, ..)| (&case.file, &case.name));
    let mut tally = Tally {
        cases: results.len(),
        refused: vec![0; refusals.len()],
        ..Tally::default()
    };
    for (case, result) in &results {
        let file = case.file.file_name().unwrap_or_default().to_string_lossy();
        match result {
            Ok(Ok(())) if case.drive.is_some() => tally.moved += 1,
            Ok(Ok(())) => tally.done += 1,
            Ok(Err(text)) => tally.wrong.push(format!("{file} {}: {text}", case.name)),
            Err(text) => {
                let known = |(start, part, reason, _): &Refusal| {
                    file.starts_with(start) && case.name.contains(part) && text.contains(reason)
                };
                match refusals.iter().position(known) {
                    Some(row) => tally.refused[row] += 1,
                    None => tally.wrong.push(format!("{file} {}: {text}", case.name)),
                }
            }
        }
    }
    println!(
        "{} cases: {} axes moved, {} devices in Op, {} refused",
        tally.cases,
        tally.moved,
        tally.done,
        tally.refused.iter().sum::<usize>()
    );
    tally
}

impl Tally {
    /// Checks that the table has every refusal.
    fn check(&self, refusals: &[Refusal]) {
        assert!(self.wrong.is_empty(), "{}", self.wrong.join("\n"));
        let expected: Vec<usize> = refusals.iter().map(|row| row.3).collect();
        assert_eq!(self.refused, expected);
    }
}

/// The vendors' ESI files say what the devices offer (ETG.2000), and the simulated drive turns its
/// shaft.
#[test]
fn every_vendor_device_reaches_op_or_is_refused_with_its_reason() {
    let Some(folder) = fixture("esi") else {
        return;
    };
    let tally = sweep(&folder, false, REFUSED);
    tally.check(REFUSED);
    assert_eq!((tally.moved, tally.done), (2212, 638));
}

/// The same for files of open projects. Each device is also without an axis on the bus.
#[test]
fn every_device_of_a_project_reaches_op_or_is_refused_with_its_reason() {
    let Some(folder) = vendor_file("esi") else {
        return;
    };
    let tally = sweep(&folder, true, REFUSED_OF_PROJECTS);
    tally.check(REFUSED_OF_PROJECTS);
    assert_eq!((tally.moved, tally.done), (4, 83));
}
