//! Machine files for drives with odd answers.

use std::path::Path;

use ecaxis_axis::scale::DriveUnits;
use proptest::prelude::*;

use super::{MARK, OutputPath, machine_file};
use crate::scan::esi_match::{EsiMatch, describe};
use crate::scan::tests::{on, scanned};
use crate::scan::{DriveInfo, Options, Scan};
use ecaxis_master::config;
use ecaxis_master::esi_library::Library;

fn configs() -> std::path::PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs")
}

/// Returns the scan of the demonstration and the descriptions of its drives.
fn demo() -> &'static (Scan, Vec<Option<EsiMatch>>) {
    static DEMO: std::sync::OnceLock<(Scan, Vec<Option<EsiMatch>>)> = std::sync::OnceLock::new();
    DEMO.get_or_init(|| {
        let ask = Options {
            ask: true,
            ..Options::default()
        };
        let (scan, _) = on("demo.toml", async move |wire| scanned(&wire, ask).await);
        let library = Library::open(&configs().join("esi"), None).expect("our ESI files");
        let (described, unreadable) = describe(&scan, &library);
        assert!(unreadable.is_empty() && described.iter().all(Option::is_some));
        (scan, described)
    })
}

/// Returns the file for drives that all answer `drive`.
fn written(drive: Option<DriveInfo>) -> String {
    let (mut scan, described) = demo().clone();
    for device in &mut scan.devices {
        match (&mut device.answers, drive) {
            (Some(Ok(answers)), Some(drive)) => answers.drive = Some(drive),
            (answers, None) => *answers = None,
            _ => panic!("the drive answers"),
        }
    }
    let folder = configs();
    let place = OutputPath {
        nic: "sim",
        redundant: None,
        folder: &folder,
    };
    machine_file(&scan, &described, place).text
}

/// Returns the problems that `check` reports.
fn problems(text: &str) -> Option<String> {
    let checked = config::parse(&configs().join("odd.toml"), text);
    checked.err().map(|error| error.to_string())
}

fn line<'t>(text: &'t str, key: &str) -> &'t str {
    let found = text.lines().find(|line| line.starts_with(key));
    found.unwrap_or_else(|| panic!("no {key} in:\n{text}"))
}

/// A drive without 0x608F, with the largest 0x607F: CiA 402-2 permits both.
#[test]
fn absurd_answers_become_marked_guesses() {
    let drive = DriveInfo {
        units: DriveUnits {
            velocity_unit: Some(0x00b5_0300),
            ..DriveUnits::default()
        },
        max_profile_velocity: Some(0x7fff_ffff),
        max_acceleration: Some(u32::MAX - 1),
        software_limits: Some([0, 1]),
        ..DriveInfo::default()
    };
    let text = written(Some(drive));
    assert_eq!(problems(&text), None, "{text}");
    for (key, value) in [
        ("limits.velocity", "1.0"),
        ("limits.acceleration", "10.0"),
        ("encoder", "2000"),
    ] {
        let line = line(&text, key);
        assert!(line.contains(&format!("= {value} ")), "{line}");
        assert!(line.contains(MARK), "{line}");
    }
    assert!(!text.contains("\nlimits.position"), "{text}");
}

fn odd() -> impl Strategy<Value = Option<u32>> {
    let extremes = [
        0,
        1,
        2,
        1000,
        0x7fff_ffff,
        0x8000_0000,
        u32::MAX - 1,
        u32::MAX,
    ];
    prop_oneof![
        Just(None),
        prop::sample::select(extremes.to_vec()).prop_map(Some),
        any::<u32>().prop_map(Some),
    ]
}

fn ratio() -> impl Strategy<Value = Option<[u32; 2]>> {
    (odd(), odd()).prop_map(|(above, below)| Some([above?, below?]))
}

fn unit() -> impl Strategy<Value = Option<u32>> {
    let codes = [0x00b5_0300, 0x00b4_4700, 0xfdb4_4700, 0x00b4_0300, 0];
    prop_oneof![odd(), prop::sample::select(codes.to_vec()).prop_map(Some)]
}

prop_compose! {
    fn any_units()(
        encoder_resolution in ratio(),
        gear_ratio in ratio(),
        feed_constant in ratio(),
        position_unit in odd(),
        velocity_unit in unit(),
        acceleration_unit in unit(),
        rated_torque in odd(),
        polarity in any::<Option<u8>>(),
    ) -> DriveUnits {
        DriveUnits {
            encoder_resolution,
            gear_ratio,
            feed_constant,
            position_unit,
            velocity_unit,
            acceleration_unit,
            rated_torque,
            torque_constant: None,
            polarity,
        }
    }
}

prop_compose! {
    fn any_drive()(
        units in any_units(),
        sensor_resolution in odd(),
        supported_modes in prop_oneof![Just(None), any::<u32>().prop_map(Some)],
        following_window in odd(),
        limits in (odd(), odd()),
        max_profile_velocity in odd(),
        max_motor_speed in odd(),
        max_torque in odd(),
        accelerations in (odd(), odd()),
    ) -> DriveInfo {
        DriveInfo {
            units,
            sensor_resolution,
            supported_modes,
            following_window,
            software_limits: limits.0.zip(limits.1).map(|(low, high)| [low as i32, high as i32]),
            max_profile_velocity,
            max_motor_speed,
            max_torque,
            max_acceleration: accelerations.0,
            max_deceleration: accelerations.1,
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(400) })]

    /// CiA 402-2 permits any value of its optional objects, and any of them may be missing.
    #[test]
    fn files_for_odd_drives_are_accepted_by_check(drive in prop::option::weighted(0.97, any_drive())) {
        let text = written(drive);
        prop_assert_eq!(problems(&text), None, "{}", text);
    }
}
