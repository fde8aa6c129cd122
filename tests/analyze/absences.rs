//! Devices that no longer answer come first among the problems.

use ecaxis_test_support::{faults, machine, recorded, run};

use crate::{axes, of_file};

#[test]
fn vanished_devices_are_the_first_problem() {
    // Fault and its keys, devices that vanish, the text.
    let faulty = [
        (
            "kind = \"power-off\"\ndevice = 2",
            2,
            "2 SubDevices of 4 vanished behind port 1 of ",
        ),
        (
            "kind = \"link-break\"\ndevice = 3",
            1,
            "1 SubDevice of 4 vanished behind port 1 of ",
        ),
    ];
    for (fault, absent, text) in faulty {
        let folder = tempfile::tempdir().expect("a folder");
        let script = format!("[[fault]]\nat = \"1s\"\n{fault}\n");
        let (options, path) = recorded(faults(&script), folder.path());
        let (outcome, _) = run(machine(&axes(4)), options);
        assert!(outcome.result.is_err());
        let report = of_file(&path);
        let [absence] = report.absences.as_slice() else {
            panic!("{:?}", report.absences);
        };
        assert_eq!((absence.absent, absence.of), (absent, 4));
        assert_eq!(absence.until, None);
        assert!((absence.at - 1.0).abs() < 0.1, "{absence:?}");
        let first = report.trouble.first().expect("a problem");
        assert!(first.contains(text), "{first}");
        let device = format!("#{}", 3 - absent);
        assert!(first.contains(&device), "{first}");
    }
}
