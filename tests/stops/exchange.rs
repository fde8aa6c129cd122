//! A drive that is replaced by another one of its kind: parameters, firmware and home.

use std::fs;
use std::path::Path;

use ecaxis_master::config::Machine;
use ecaxis_master::report::Home;
use ecaxis_master::session::Progress;
use ecaxis_test_support::program::run as ecaxis;
use ecaxis_test_support::{Heard, faults, machine, root, run};

use super::returns::{STEPS, line_text};

const SWAP: &str = "[[fault]]\nkind = \"swap\"\ndevice = 2\nat = \"1.5s\"\nserial = 4711\n";
const OFF: &str = "[[fault]]\nkind = \"power-off\"\ndevice = 2\nat = \"1.5s\"\nfor = \"500ms\"\n";

/// The following error window of the simulated drive.
const WINDOW: &str = "type = \"UDINT\", access = \"rw\", value = 2000 }";

/// Saves the parameters of the drive `a2` to a file, with a change.
fn saved(folder: &Path, change: (&str, &str)) -> String {
    let esi = root().join("configs/esi/EPOS4.xml");
    let text = line_text(3, STEPS).replace("esi/EPOS4.xml", esi.to_str().expect("text"));
    let (file, dump) = (folder.join("m.toml"), folder.join("a2.toml"));
    fs::write(&file, text).expect("written");
    let [file, dump] = [&file, &dump].map(|path| path.to_str().expect("text"));
    if !Path::new(dump).exists() {
        ecaxis(["sdo", "dump", file, "a2", dump]).exits(0);
    }
    let text = fs::read_to_string(dump).expect("the file");
    let (from, to) = change;
    assert!(text.contains(from), "{text}");
    let changed = folder.join("changed.toml");
    fs::write(&changed, text.replacen(from, to, 1)).expect("written");
    changed.to_str().expect("text").to_owned()
}

/// Returns the line of three drives; the last has a parameter file and further keys of its axis.
fn with_file(parameters: &str, axis: &str) -> Machine {
    let named = format!("position = 2\nparameters = \"{parameters}\"\n");
    let text = line_text(3, STEPS).replace("position = 2\n", &named);
    let (before, last) = text.split_once("name = \"a2\"").expect("a drive");
    let last = last.replacen("encoder = 2000\n", &format!("encoder = 2000\n{axis}"), 1);
    machine(&format!("{before}name = \"a2\"{last}"))
}

fn warned(heard: &Heard, text: &str) -> bool {
    heard.warnings().iter().any(|w| w.contains(text))
}

fn homes(heard: &Heard) -> Vec<Option<Home>> {
    let each = heard.0.iter().filter_map(|progress| match progress {
        Progress::DeviceReturned { home, .. } => Some(*home),
        _ => None,
    });
    each.collect()
}

#[test]
fn drive_that_replaces_another_gets_its_parameters() {
    let folder = tempfile::tempdir().expect("a folder");
    let changed = WINDOW.replace("2000", "2345");
    let file = saved(folder.path(), (WINDOW, &changed));
    // The serial number is that of the file: nothing is compared.
    let (outcome, heard) = run(with_file(&file, ""), faults(OFF));
    outcome.result.expect("it returns");
    assert!(!warned(&heard, "restored"), "{:?}", heard.warnings());

    let (outcome, heard) = run(with_file(&file, ""), faults(SWAP));
    outcome.result.expect("the other drive returns");
    let restored = "has the serial number 4711";
    assert!(warned(&heard, restored), "{:?}", heard.warnings());
    assert!(
        warned(&heard, "1 setting restored"),
        "{:?}",
        heard.warnings()
    );

    // Replaced while the machine was off: the file is of another drive.
    let text = fs::read_to_string(&file).expect("the file");
    let serial = text.lines().find(|line| line.starts_with("serial = "));
    let other = folder.path().join("other.toml");
    let text = text.replace(serial.expect("a number"), "serial = 5");
    fs::write(&other, text).expect("written");
    let other = other.to_str().expect("text");
    let (outcome, heard) = run(with_file(other, ""), faults(""));
    outcome.result.expect("the machine runs");
    assert!(
        warned(&heard, "1 setting restored"),
        "{:?}",
        heard.warnings()
    );
}

/// The drive stays in Init, and its axis without power.
#[test]
fn drive_that_cannot_get_the_parameters_does_not_return() {
    let folder = tempfile::tempdir().expect("a folder");
    let rows = [
        (
            ("value = \"1.00\"", "value = \"1.01\""),
            "0x100A:00 Software version is 1.00, in",
        ),
        (
            (
                "[parameters]\n",
                "[parameters]\n\"0x2fff:00\" = { name = \"No such\", type = \"UDINT\", access = \"rw\", value = 1 }\n",
            ),
            "0x2FFF:00 is refused (0x06020000",
        ),
    ];
    for (change, expected) in rows {
        let file = saved(folder.path(), change);
        let (outcome, heard) = run(with_file(&file, ""), faults(SWAP));
        assert!(outcome.result.is_err(), "a2 is never enabled again");
        assert_eq!(homes(&heard), []);
        let all = heard.warnings().join("\n").to_lowercase();
        assert!(all.contains(&expected.to_lowercase()), "{all}");
        assert!(all.contains("`a2` does not return"), "{all}");
    }
}

#[test]
fn home_is_kept_by_the_absolute_encoder_of_the_same_drive() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = saved(folder.path(), ("format = 2", "format = 2"));
    let rows = [
        (OFF, "", Home::Lost),
        (OFF, "absolute = true\n", Home::Kept),
        (SWAP, "absolute = true\n", Home::Lost),
    ];
    for (script, keys, expected) in rows {
        let (outcome, heard) = run(with_file(&file, keys), faults(script));
        outcome.result.expect("it returns");
        assert_eq!(homes(&heard), [Some(expected)], "{script}{keys}");
    }
}

#[test]
fn parameter_file_must_be_of_the_same_product() {
    let folder = tempfile::tempdir().expect("a folder");
    let rows = [
        (("product = 0x45", "product = 0x46"), "the ESI describes"),
        (("format = 2", "format = 9"), "format 9 is not known"),
        (("value = 2000", "value = {}"), "a value is a number"),
    ];
    for (change, expected) in rows {
        let file = saved(folder.path(), change);
        let named = format!("position = 2\nparameters = \"{file}\"\n");
        let text = line_text(3, STEPS).replace("position = 2\n", &named);
        let path = root().join("configs/m.toml");
        let error = ecaxis_master::config::parse(&path, &text).expect_err("refused");
        assert!(error.to_string().contains(expected), "{error}");
    }
}
