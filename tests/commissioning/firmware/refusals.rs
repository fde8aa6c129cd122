//! Files and devices that do not fit each other.

use super::*;

#[test]
fn an_update_left_incomplete_by_one_method_completes_by_the_other() {
    on_a_bus(demo, 0, |bench| {
        let file = file(0, 50_000);
        let off = Arc::clone(&bench.off);
        let mut report = |reported| {
            if let UpdateProgress::Moved { done: 20_000.., .. } = reported {
                off.store(true, Ordering::Relaxed);
            }
        };
        bench
            .update(UpdateMethod::Foe, &file, &mut report)
            .expect_err("no power");
        bench.power(true);
        // The other method works as well.
        bench.succeeds(UpdateMethod::Program, &file);
        bench.succeeds(UpdateMethod::Foe, &file);
    });
}

#[test]
fn a_wrong_file_is_rejected_and_the_right_one_accepted_afterwards() {
    let good = file(0, 60_000);
    let mut damaged = good.clone();
    damaged[50_000] ^= 1;
    // Error codes over FoE and by SDO, and whether the old program remains.
    for (what, wrong, foe, sdo, keeps) in [
        ("noise", vec![0x5a; 60_000], 0x8010, 0x0609_0030, true),
        ("short", vec![0x45; 20], 0x8010, 0x0609_0030, true),
        (
            "of another device",
            file(1, 60_000),
            0x800d,
            0x0609_0030,
            true,
        ),
        ("damaged", damaged, 0x800c, 0x0800_0020, false),
    ] {
        for &via in ways(0) {
            let (good, wrong) = (good.clone(), wrong.clone());
            on_a_bus(demo, 0, move |bench| {
                let error = bench.update(via, &wrong, &mut |_| {}).expect_err(what);
                let FirmwareError::Failed { cause, left, .. } = &error else {
                    panic!("{what}: {error}")
                };
                match (via, &**cause) {
                    (UpdateMethod::Foe, UpdateCause::Foe(error)) => {
                        assert_eq!(error.code(), Some(foe), "{what}: {error}");
                    }
                    (UpdateMethod::Program, UpdateCause::Sdo(error)) => {
                        assert_eq!(error.abort_code(), Some(sdo), "{what}: {error}");
                    }
                    _ => panic!("{what}: {error}"),
                }
                // As it was found.
                let state = AlState::Init;
                assert_eq!(*left, FinalDeviceState::In { state, code: 0 }, "{what}");
                let stopped = bench.device().is_stopped();
                assert_eq!(stopped, via == UpdateMethod::Program, "{what}");
                // The boot loader that refused the file has started its program again.
                if keeps && via == UpdateMethod::Foe {
                    assert_eq!(bench.examine().runs(), RunningProgram::Program, "{what}");
                }
                // The device works as before, unless its program was erased.
                bench.power(false);
                bench.power(true);
                let runs = match keeps && via == UpdateMethod::Foe {
                    true => RunningProgram::Program,
                    false => RunningProgram::BootLoader,
                };
                assert_eq!(bench.examine().runs(), runs, "{what}");
                bench.succeeds(via, &good);
            });
        }
    }
}

/// Takes the device under test to a state, as another MainDevice would leave it.
fn bring_to(bench: &mut Bench, wanted: AlState) {
    let position = bench.position;
    let work = async move |wire: DatagramClient| {
        let at = device::locate(&wire, Locator::Position(position), None).await;
        let (_, at) = at.expect("located");
        let devices = std::slice::from_ref(&at);
        let change = async |state| al::change_state(&wire, devices, state, START_TIMEOUT).await;
        if wanted == AlState::Init {
            return;
        }
        let sii = device::read_sii(&wire, &at, EepromAccess::IfFree).await;
        let sii = sii.expect("read");
        mailbox::open(&wire, &at, &sii).await.expect("in PreOp");
        if wanted == AlState::SafeOp {
            // The SyncManagers of the default process data, from the EEPROM.
            for (number, sm) in sii.sync_managers.iter().enumerate().skip(2) {
                let register = 0x0800 + 8 * u16::try_from(number).expect("few");
                let [[a, b], [c, d]] = [sm.start_address, sm.len].map(u16::to_le_bytes);
                let bytes = [a, b, c, d, sm.control, 0, 1, 0];
                let written = wire.write(at.station, register, &bytes).await;
                assert_eq!(written, Ok(1));
            }
            change(wanted).await.expect("in SafeOp");
        }
    };
    let never = CancelToken::default();
    run_on_link(&mut bench.link, Clock::Virtual, &never, work).expect("carried");
    assert_eq!(bench.device().al_state().to_string(), wanted.to_string());
}

/// Once, a refusal left the device in Bootstrap, or in Init.
#[test]
fn a_device_that_refuses_a_file_is_in_its_earlier_state_afterwards() {
    for state in [AlState::Init, AlState::PreOp, AlState::SafeOp] {
        for &via in ways(0) {
            on_a_bus(demo, 0, move |bench| {
                bring_to(bench, state);
                let error = bench.update(via, &[0x5a; 5000], &mut |_| {});
                let error = error.expect_err("noise");
                let FirmwareError::Failed { left, .. } = &error else {
                    panic!("{error}")
                };
                // The program was erased before the download: its boot loader has no process data.
                let (state, code) = match (via, state) {
                    (UpdateMethod::Program, AlState::SafeOp) => (AlState::PreOp, 0x0014),
                    _ => (state, 0),
                };
                assert_eq!(
                    *left,
                    FinalDeviceState::In { state, code },
                    "{via}: {error}"
                );
                assert_eq!(bench.device().al_state().to_string(), state.to_string());
                // Its objects can be read there, and the right file is accepted.
                assert!(bench.examine().spoken.is_some());
                bench.succeeds(via, &file(0, 5000));
            });
        }
    }
}

#[test]
fn a_device_of_another_type_is_not_changed() {
    on_a_bus(demo, 0, |bench| {
        let good = file(0, 5000);
        let meant = bench.expected;
        for (expected, part) in [
            (
                Expected {
                    product: Some(0x4550_0005),
                    ..meant
                },
                "product 0x45500005 is meant",
            ),
            (
                Expected {
                    vendor: Some(0xfb),
                    ..meant
                },
                "vendor 0x000000fb is meant",
            ),
        ] {
            bench.expected = expected;
            let mut touched = false;
            let error = bench
                .update(UpdateMethod::Foe, &good, &mut |_| touched = true)
                .expect_err("another device");
            assert!(matches!(error, FirmwareError::Identity { .. }), "{error}");
            assert!(error.to_string().contains(part), "{error}");
            assert!(!touched);
            let device = bench.device();
            assert_eq!(device.al_state(), ecaxis_sim::AlState::Init);
            assert_eq!(device.firmware(), None);
        }
        bench.expected = meant;
        // The check also works while the program is stopped, when the device shows only half of its
        // product code.
        bench.succeeds(UpdateMethod::Program, &good);
    });
    on_a_bus(demo, 1, |bench| {
        let error = bench
            .update(UpdateMethod::Program, &file(1, 5000), &mut |_| {})
            .expect_err("no 0x1F51");
        assert!(
            matches!(
                error,
                FirmwareError::NotOffered {
                    via: UpdateMethod::Program,
                    ..
                }
            ),
            "{error}"
        );
        bench.succeeds(UpdateMethod::Foe, &file(1, 5000));
    });
}

#[test]
fn a_file_larger_than_the_program_memory_is_rejected() {
    let small = FirmwareOptions {
        capacity: 4000,
        ..FirmwareOptions::default()
    };
    for &via in ways(0) {
        on_a_bus(slow(small.clone()), 0, move |bench| {
            let error = bench
                .update(via, &file(0, 5000), &mut |_| {})
                .expect_err("too long");
            let FirmwareError::Failed { cause, .. } = &error else {
                panic!("{error}")
            };
            match &**cause {
                UpdateCause::Foe(error) => assert_eq!(error.code(), Some(0x8003)),
                UpdateCause::Sdo(error) => assert_eq!(error.abort_code(), Some(0x0607_0012)),
                other => panic!("{other}"),
            }
            bench.succeeds(via, &file(0, 4000));
        });
    }
}
