use ecaxis_axis::Mode;
use ecaxis_master::acyclic::DeviceRef;
use ecaxis_master::eoe::TapStep;
use ecaxis_master::link::OpenError;
use ecaxis_master::mailbox::{NamedObject, Subject};

use super::*;

fn device() -> DeviceRef {
    DeviceRef {
        name: "x".into(),
        position: 0,
        station: 0x1001,
    }
}

fn sdo_error(index: u16, sub: u8, cause: CoeCause) -> SdoError {
    SdoError {
        station: 0x1001,
        asked: Subject::Object(NamedObject { index, sub }),
        cause,
    }
}

fn hints_of(error: &Error) -> (u8, String) {
    let failure = failure(error, &Nic::Interface("eth9".into()));
    (failure.code, failure.hints.join("\n"))
}

#[test]
fn every_failure_has_a_hint() {
    let sdo = |code| sdo_error(0x60c2, 1, CoeCause::Abort(code));
    let start_up = |code, origin: &str| {
        Cause::StartUp {
            index: 0x60c2,
            sub: 1,
            name: String::new(),
            value: "1".into(),
            origin: origin.into(),
            source: sdo(code),
        }
        .with_device(device())
    };
    let refused = |code| {
        let refused = StateError::Refused {
            wanted: AlState::SafeOp,
            actual: AlState::PreOp,
            code,
        };
        Cause::State(refused).with_device(device())
    };
    let state = |error| Cause::State(error).with_device(device());
    let list = |index, sub, code| {
        Cause::StartUp {
            index,
            sub,
            name: String::new(),
            value: "1".into(),
            origin: "<Sm> 2".into(),
            source: sdo_error(index, sub, CoeCause::Abort(code)),
        }
        .with_device(device())
    };
    let pdos = |index, code| list(index, 1, code);
    let waiting = |state, code, waiting| {
        Cause::NotEnabled {
            state,
            statusword: 0,
            waiting,
            code,
            timeout_ms: 5000,
        }
        .with_device(device())
    };
    let not_enabled = |state, code| waiting(state, code, None);
    let missing = Cause::Missing {
        expected: 2,
        found: 1,
        missing: vec!["`y`".into()],
    };
    let ring = |processed_by| {
        let (nic, second) = ("eth9".to_owned(), "eth8".to_owned());
        let second_end = Some(SecondEnd {
            nic,
            second,
            processed_by,
        });
        Error::from(Cause::NoAnswer { second_end })
    };
    let units = |problem| {
        let problems = vec![problem];
        Cause::Units { problems }.with_device(device())
    };
    let contradicts = |found| units(UnitProblem::Contradiction(found));
    for (error, code, hint) in [
        (
            contradicts(UnitMismatch::VelocityUnit {
                expected: VelocityUnit::MILLI_RPM,
                found: VelocityUnit::RPM.si_code(),
            }),
            FAILED,
            "value = 0xFDB44700 }]`, or `velocity_unit = \"rpm\"`",
        ),
        (
            contradicts(UnitMismatch::CountsPerTurn {
                index: 0x608f,
                expected: 2000.0,
                found: 4096.0,
            }),
            FAILED,
            "write `encoder = 4096`",
        ),
        (
            contradicts(UnitMismatch::CountsPerTurn {
                index: 0x6091,
                expected: 2000.0,
                found: 1000.0,
            }),
            FAILED,
            "gear ratio to 1:1",
        ),
        (
            units(UnitProblem::NoRatedTorque { unit: "Nm" }),
            FAILED,
            "rated_torque = 0.1",
        ),
        (
            OpenError::NoSuchInterface { nic: "x".into() }.into(),
            WRONG,
            "this computer has",
        ),
        (
            OpenError::NotPermitted { nic: "x".into() }.into(),
            FAILED,
            "sudo setcap cap_net_raw",
        ),
        (
            OpenError::Down { nic: "x".into() }.into(),
            FAILED,
            "ip link set x up",
        ),
        (
            OpenError::Unfit {
                nic: "lo".into(),
                what: "is the loopback",
            }
            .into(),
            WRONG,
            "this computer has",
        ),
        (
            Cause::NoAnswer { second_end: None }.into(),
            FAILED,
            "is `eth9` the right interface?",
        ),
        (
            ring(2),
            FAILED,
            "write `redundant = \"eth8\"` into [bus], or name both: `eth9,eth8`",
        ),
        (
            ring(0),
            FAILED,
            "`redundant = \"eth9\"` into [bus], or name both: `eth8,eth9`",
        ),
        (missing.into(), FAILED, "the first one missing"),
        (
            start_up(0x0609_0030, "bus.cycle"),
            FAILED,
            "another `cycle`",
        ),
        (start_up(0x0602_0000, "ESI"), FAILED, "firmware"),
        (start_up(0x0601_0002, "mode csp"), FAILED, "firmware"),
        (
            start_up(0x0601_0002, SDO_OF_MACHINE_FILE),
            FAILED,
            "from `sdo`",
        ),
        (
            start_up(0x0602_0000, SDO_OF_MACHINE_FILE),
            FAILED,
            "`index`",
        ),
        (
            start_up(0x0604_0041, "pdo.rx in RxPdo 0x1600"),
            FAILED,
            "from `pdo.rx`",
        ),
        (refused(0x001e), FAILED, "assigned TxPDOs"),
        (refused(0x0013), FAILED, "no Bootstrap"),
        (refused(0x001b), FAILED, "if the device refuses Op"),
        (
            state(StateError::Refused {
                wanted: AlState::Op,
                actual: AlState::SafeOp,
                code: 0x001b,
            }),
            FAILED,
            "a longer `watchdog` than `cycle`",
        ),
        (
            state(StateError::Timeout {
                wanted: AlState::SafeOp,
                actual: AlState::PreOp,
                code: 0x0052,
                timeout: std::time::Duration::from_secs(1),
            }),
            FAILED,
            "the supply of its power stage, its encoder",
        ),
        (refused(0x0052), FAILED, "what is connected to it"),
        (refused(0x0070), FAILED, "`ecaxis compare` shows both"),
        (
            start_up(0x0601_0003, SDO_OF_MACHINE_FILE),
            FAILED,
            "subindex 0 = their number",
        ),
        (start_up(0x0601_0003, "ESI"), FAILED, "has not emptied"),
        (
            start_up(0x0604_0043, SDO_OF_MACHINE_FILE),
            FAILED,
            "the order of `sdo` matters",
        ),
        (
            start_up(0x0604_0043, "ESI"),
            FAILED,
            "`ecaxis sdo defaults`",
        ),
        (pdos(0x1c12, 0x0601_0003), FAILED, "its PDOs are fixed"),
        (pdos(0x1a00, 0x0601_0003), FAILED, "its PDOs are fixed"),
        (
            pdos(0x1c13, 0x0601_0002),
            FAILED,
            "keeps its PDO assignment",
        ),
        (
            list(0x1c12, 0, 0x0604_0043),
            FAILED,
            "keeps its PDO assignment",
        ),
        (pdos(0x1600, 0x0601_0002), FAILED, "omit `pdo`"),
        (
            pdos(0x1c12, 0x0609_0030),
            FAILED,
            "does not accept this PDO",
        ),
        (
            pdos(0x1c12, 0x0604_0043),
            FAILED,
            "does not accept this PDO",
        ),
        (pdos(0x1c12, 0x0602_0000), FAILED, "fewer PDOs"),
        (pdos(0x1600, 0x0604_0043), FAILED, "cannot map this object"),
        (pdos(0x1c12, 0x0800_0022), FAILED, "in PreOp only"),
        (refused(0x0035), FAILED, "cycle time"),
        (not_enabled(State::SwitchOnDisabled, None), FAILED, "STO"),
        (
            waiting(
                State::SwitchedOn,
                None,
                Some(EnableBlocker::Mode {
                    expected: Mode::Csp,
                    display: Mode::Unknown(0),
                }),
            ),
            FAILED,
            "`mode_display = \"enabled\"`",
        ),
        (
            waiting(
                State::OperationEnabled,
                None,
                Some(EnableBlocker::Follows { mode: Mode::Csp }),
            ),
            FAILED,
            "`follows_bit = false`",
        ),
        (
            Cause::NotSwitched { mode: Mode::Pp }.with_device(device()),
            FAILED,
            "`mode_change = \"no-power\"`",
        ),
        (
            Cause::NodeNotOperational {
                id: 6,
                state: NodeState::Unknown,
                timeout_ms: 5000,
            }
            .with_device(device()),
            FAILED,
            "`objects`",
        ),
        (
            not_enabled(State::Fault, Some(0x8611)),
            FAILED,
            describe(0x8611).hint,
        ),
        (
            Cause::DriveFault {
                code: Some(0x2310),
                statusword: 8,
                report: Box::default(),
            }
            .with_device(device()),
            FAILED,
            describe(0x2310).hint,
        ),
        (
            Cause::Trip {
                trip: Trip::FollowingError {
                    error: 2.0,
                    limit: 1.0,
                },
                limits: Vec::new(),
            }
            .with_device(device()),
            FAILED,
            "following_error",
        ),
        (
            Cause::BusLost {
                group: None,
                cycles: 3,
                wkc: (0, 6),
                answered: false,
            }
            .into(),
            FAILED,
            "cables",
        ),
    ] {
        let (got, text) = hints_of(&error);
        assert_eq!(got, code, "{error}");
        assert!(text.contains(hint), "{error}: {text}");
    }
}

#[test]
fn sdo_hint_names_the_sdo_key_only_for_user_sdos() {
    for code in (0x0503_0000..0x0504_0010).chain(0x0601_0000..0x060a_0030) {
        let error = sdo_error(0x6060, 0, CoeCause::Abort(code));
        for origin in ["mode csp", "bus.cycle", "Sm 2 (line 3)"] {
            assert!(!sdo(&error, origin).contains("`sdo`"), "{code:#x}");
        }
    }
}

#[test]
fn message_names_an_address_once() {
    let abort = sdo_error(0x6060, 0, CoeCause::Abort(0x0601_0002));
    let timeout = sdo_error(
        0x6060,
        0,
        CoeCause::Timeout {
            phase: ecaxis_master::mailbox::Phase::Answer,
            after: std::time::Duration::from_secs(1),
            set_aside: 0,
        },
    );
    for (source, end) in [
        (
            abort.clone(),
            "(from mode csp): was refused with 0x06010002: ",
        ),
        (timeout, "(from mode csp): no answer came within 1s"),
    ] {
        let error = Cause::StartUp {
            index: 0x6060,
            sub: 0,
            name: "Modes of operation".into(),
            value: "0x08".into(),
            origin: "mode csp".into(),
            source,
        }
        .with_device(device());
        let text = failure(&error, &Nic::Sim).message;
        assert!(text.contains(end), "{text}");
        assert_eq!(text.matches("0x1001").count(), 1, "{text}");
        assert_eq!(text.matches("0x6060").count(), 1, "{text}");
    }
    let error = Cause::Sdo(abort)
        .with_device(device())
        .with_action("reading the PDO mapping back");
    let text = failure(&error, &Nic::Sim).message;
    assert_eq!(text.matches("0x1001").count(), 1, "{text}");
    assert!(text.contains("back: 0x6060"), "{text}");
}

/// True if the key exists in [bus], [[device]] or [device.axis] of the machine file.
fn is_a_key(key: &str) -> bool {
    let takes = |text: &str| {
        let Err(ConfigError::Problems(problems)) =
            ecaxis_master::config::parse(Path::new("m.toml"), text)
        else {
            return true;
        };
        let unknown = |p: &ecaxis_master::config::Problem| p.message.contains("unknown key");
        !problems.iter().any(unknown)
    };
    takes(&format!("[bus]\n{key} = 1"))
        || takes(&format!("[[device]]\n{key} = 1"))
        || takes(&format!("[device.axis]\n{key} = 1").replace("[device", "[[device]]\n[device"))
}

#[test]
fn hints_name_keys_that_exist() {
    assert!(is_a_key("pdo.rx") && is_a_key("cycle") && is_a_key("per_turn"));
    assert!(is_a_key("mode_change") && is_a_key("mode_display") && is_a_key("dead_time"));
    assert!(!is_a_key("pdo.xr") && !is_a_key("cycel"));
    for code in 0..=u16::MAX {
        for key in al_status(code).split('`').skip(1).step_by(2) {
            assert!(is_a_key(key), "{code:#06x}: {key}");
        }
    }
}

#[test]
fn config_suggests_files_only_for_a_missing_file() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("m.toml"), "[bus]").unwrap();
    std::fs::write(folder.path().join("noise.toml"), [0xff, 0xfe, 0]).unwrap();
    for (name, message, hint) in [
        ("n.toml", "cannot read", Some("m.toml")),
        ("", "is a folder", None),
        ("noise.toml", "is not text", None),
    ] {
        let path = folder.path().join(name);
        let failure = config(&path, &ecaxis_master::config::load(&path).unwrap_err());
        assert_eq!(failure.code, WRONG);
        assert!(failure.message.contains(message), "{failure:?}");
        let nearby = failure.hints.iter().any(|h| h.contains("nearby"));
        assert_eq!(nearby, hint.is_some(), "{failure:?}");
    }
}

/// A time-out caused by another MainDevice must not suggest switching the drive off.
#[test]
fn hints_keep_drives_on_with_another_main_device() {
    let nic = Nic::Interface("eth9".into());
    let timeout = sdo_error(
        0x6065,
        0,
        CoeCause::Timeout {
            phase: ecaxis_master::mailbox::Phase::Answer,
            after: std::time::Duration::from_secs(6),
            set_aside: 0,
        },
    );
    let refused = sdo_error(0x6065, 0, CoeCause::Abort(0x0609_0030));
    for (source, takes_away) in [(timeout, true), (refused, false)] {
        let error = Cause::Sdo(source).with_device(device());
        let alone = failure(&error, &nic);
        let during = with_other_main_device(failure(&error, &nic), &error);
        let reported = during.hints.join("\n");
        assert_eq!(
            reported.contains("takes the answers away"),
            takes_away,
            "{reported}"
        );
        assert!(!reported.contains("off and on"), "{reported}");
        assert_eq!(during.hints != alone.hints, takes_away, "{reported}");
        assert_eq!((during.code, during.message), (alone.code, alone.message));
    }
}

#[test]
fn firmware_error_names_its_device_once() {
    use ecaxis_tools::firmware::{FinalDeviceState, FirmwareError, UpdateCause, UpdateStep};
    let abort = sdo_error(0x1f51, 1, CoeCause::Abort(0x0601_0002));
    let state = StateError::Gone {
        wanted: AlState::PreOp,
    };
    let state = Cause::State(state).with_device(device());
    for (step, cause) in [
        (UpdateStep::Clear, UpdateCause::Sdo(abort)),
        (UpdateStep::PreOp, UpdateCause::Service(state)),
    ] {
        let error = FirmwareError::from_step(&device(), step, cause, FinalDeviceState::Silent);
        let text = firmware(&error, &Nic::Sim).message;
        assert!(
            text.starts_with(&format!("{}: {step}: ", device())),
            "{text}"
        );
        assert_eq!(text.matches("0x1001").count(), 1, "{text}");
        assert!(text.ends_with("; the device does not answer"), "{text}");
    }
}

/// The remedy depends on the step at which the TAP interface fails.
#[test]
fn tap_hints_name_the_step() {
    for (step, code, part) in [
        (TapStep::Open, libc::ENOENT, "modprobe tun"),
        (TapStep::Open, libc::ENODEV, "modprobe tun"),
        (TapStep::Open, libc::EACCES, "/dev/net/tun"),
        (TapStep::Create, libc::EPERM, "ip tuntap add ecat0"),
        (TapStep::Create, libc::EBUSY, "another name"),
        (TapStep::Create, libc::EINVAL, "ip link show ecat0"),
        (TapStep::Address, libc::EPERM, "omit `address`"),
        (TapStep::SwitchOn, libc::EPERM, "ip link set ecat0 up"),
    ] {
        let error = std::io::Error::from_raw_os_error(code);
        let hint = tap(&error, step, "ecat0");
        assert!(hint.contains(part), "{step} {code}: {hint}");
    }
}
