//! Firmware updates of simulated drives in virtual time: both ways, and everything that can break them off. Whatever happens, the same command succeeds
//! afterwards.

#[path = "firmware/cli.rs"]
mod cli;
mod common;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use common::load;
use ecaxis::bringup::{AlState, al};
use ecaxis::clock::Clock;
use ecaxis::config::Locator;
use ecaxis::firmware::{
    self, BOOT_LOADER, Cause, Done, Examined, Expected, FirmwareError, Left, Order, ReadBack, Runs,
    START_TIMEOUT, Step, Told, Via,
};
use ecaxis::link::sim::SimLink;
use ecaxis::link::{Link, LinkError, MAX_FRAME, Nanos};
use ecaxis::mailbox::{FoeError, SdoError, Wire};
use ecaxis::service::station::Which;
use ecaxis::service::{Datagrams, carry, device, mailbox};
use ecaxis::session::simulated_bus;
use ecaxis_sim::{
    DeviceOptions, FaultScript, FirmwareHeader, FirmwareOptions, Segment, SegmentOptions, SimDevice,
};

/// The simulated bus with a switch for one device's power.
#[derive(Debug)]
struct Switched {
    link: SimLink,
    position: usize,
    off: Arc<AtomicBool>,
    /// Datagrams that wrote to 0x0500: whose the EEPROM is.
    claims: usize,
}

impl Link for Switched {
    fn send(&mut self, frame: &[u8]) -> Result<(), LinkError> {
        // The first datagram of each: FPWR, and its register.
        let claim = frame.get(16) == Some(&5) && frame.get(20..22) == Some(&[0x00, 0x05]);
        self.claims += usize::from(claim);
        let on = !self.off.load(Ordering::Relaxed);
        self.link.segment_mut().power(self.position, on);
        self.link.send(frame)
    }

    fn recv(&mut self, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
        self.link.recv(buf)
    }

    fn next_arrival(&self) -> Option<Nanos> {
        self.link.next_arrival()
    }
}

/// A bus that stays as it is from one command to the next.
struct Bench {
    link: Switched,
    off: Arc<AtomicBool>,
    /// The user ends the next update.
    stop: Arc<AtomicBool>,
    /// Of whom everything here is.
    position: u16,
    expected: Expected,
}

/// Virtual time belongs to a thread.
fn on_a_bus<T: Send + 'static>(
    segment: impl FnOnce() -> Segment + Send + 'static,
    position: u16,
    work: impl FnOnce(&mut Bench) -> T + Send + 'static,
) -> T {
    let there = std::thread::Builder::new().stack_size(16 << 20);
    let done = there.spawn(move || {
        Clock::Virtual.enter();
        let off = Arc::new(AtomicBool::new(false));
        let mut bench = Bench {
            link: Switched {
                link: SimLink::new(segment()),
                position: usize::from(position),
                off: Arc::clone(&off),
                claims: 0,
            },
            off,
            stop: Arc::default(),
            position,
            expected: Expected::default(),
        };
        let header = header(position);
        bench.expected = Expected {
            vendor: Some(header.vendor),
            product: Some(header.product),
        };
        work(&mut bench)
    });
    match done.expect("a thread").join() {
        Ok(done) => done,
        Err(panic) => std::panic::resume_unwind(panic),
    }
}

/// The demonstration: an EPOS4 (0) and an IDX (1).
fn demo() -> Segment {
    simulated_bus(&load("demo.toml"), 1, None, None).expect("a bus")
}

/// The new firmware's header of the demonstration's devices.
fn header(position: u16) -> FirmwareHeader {
    FirmwareHeader {
        vendor: 0xe0a,
        product: if position == 0 {
            0x4550_0004
        } else {
            0x4944_0001
        },
        revision: 0x0002_0000,
        version: *b"2.00",
    }
}

/// A good firmware file of so many bytes.
fn file(position: u16, len: usize) -> Vec<u8> {
    let program: Vec<u8> = (0..len - 32)
        .map(|n| (n * 31 + n / 251 + n / 65_521) as u8)
        .collect();
    header(position).file(&program)
}

impl Bench {
    fn device(&self) -> &SimDevice {
        let segment = self.link.link.segment();
        segment
            .device(usize::from(self.position))
            .expect("a device")
    }

    fn examine(&mut self) -> Examined {
        let which = Which::Position(self.position);
        let work = async move |wire| firmware::examine(&wire, which, "x").await;
        let stop = AtomicBool::new(false);
        let done = carry(&mut self.link, Clock::Virtual, &stop, work);
        done.expect("carried").expect("examined")
    }

    /// What the command does.
    fn update(
        &mut self,
        via: Via,
        file: &[u8],
        tell: &mut dyn FnMut(Told),
    ) -> Result<Done, FirmwareError> {
        let (which, expected) = (Which::Position(self.position), self.expected);
        let order = Order {
            via,
            file: file.to_vec(),
            name: "new.bin".to_owned(),
            password: 0,
            read_back: true,
        };
        let work = async move |wire| {
            let before = firmware::examine(&wire, which, "x").await?;
            firmware::update(&wire, &before, expected, &order, tell).await
        };
        let stop = Arc::clone(&self.stop);
        let done = carry(&mut self.link, Clock::Virtual, &stop, work).expect("carried");
        self.stop.store(false, Ordering::Relaxed);
        done
    }

    fn power(&mut self, on: bool) {
        self.off.store(!on, Ordering::Relaxed);
        let position = usize::from(self.position);
        self.link.link.segment_mut().power(position, on);
    }

    /// The same command, and what it must lead to.
    #[track_caller]
    fn succeeds(&mut self, via: Via, file: &[u8]) -> Done {
        let done = match self.update(via, file, &mut |_| {}) {
            Ok(done) => done,
            Err(error) => panic!("{via}: {error}"),
        };
        assert_eq!(done.after.runs(), Runs::Program);
        let device = self.device();
        assert_eq!(device.firmware(), Some(file), "{via}");
        assert!(!device.is_stopped());
        assert_eq!(device.al_state(), ecaxis_sim::AlState::Init);
        done
    }
}

/// The ways of the device at a position.
fn ways(position: u16) -> &'static [Via] {
    match position {
        0 => &[Via::Foe, Via::Program],
        _ => &[Via::Foe],
    }
}

fn number(bytes: Option<Vec<u8>>) -> Option<u32> {
    Some(u32::from_le_bytes(bytes?.try_into().ok()?))
}

#[test]
fn a_mebibyte_by_both_ways_with_progress() {
    for position in [0, 1] {
        for &via in ways(position) {
            on_a_bus(demo, position, move |bench| {
                let before = bench.examine();
                assert_eq!(before.runs(), Runs::Program);
                assert_eq!(before.sii.identity.revision, 0x0001_0000);
                let file = file(position, 1 << 20);
                let (mut moved, mut steps, mut busy) = (Vec::new(), Vec::new(), 0);
                let mut tell = |told| match told {
                    Told::Moved { done, of } => {
                        assert_eq!(of, 1 << 20);
                        moved.push(done);
                    }
                    Told::Busy { done, entire } => {
                        assert!(done <= entire);
                        busy += 1;
                    }
                    Told::Step(step) => steps.push(step),
                };
                let done = match bench.update(via, &file, &mut tell) {
                    Ok(done) => done,
                    Err(error) => panic!("{via}: {error}"),
                };
                let sent = moved.iter().position(|n| *n == 1 << 20).expect("all of it");
                assert!(moved[..=sent].is_sorted());
                assert!(sent > 1000, "progress in {sent} parts");
                match via {
                    Via::Foe => {
                        assert!(busy > 10, "erasing and programming take their time");
                        assert_eq!(done.read_back, ReadBack::Same);
                        assert_eq!(moved.last(), Some(&(1 << 20)), "read back");
                    }
                    Via::Program => {
                        assert!(matches!(done.read_back, ReadBack::Refused(_)));
                    }
                }
                assert_eq!(steps.last(), Some(&Step::Check));
                assert!(done.took.as_secs() >= 1 && done.took.as_secs() < 600);

                // What it says now, by its EEPROM and its objects.
                assert_eq!(done.after.sii.identity.revision, 0x0002_0000);
                assert_eq!(done.after.sii.serial, before.sii.serial);
                let spoken = done.after.spoken.as_ref().expect("it speaks");
                assert_eq!(spoken.identity[2], Some(0x0002_0000));
                assert_eq!(spoken.software.as_deref(), Some("2.00"));
                assert_eq!(spoken.device_type, Some(0x0002_0192));
                assert_eq!(spoken.control, (position == 0).then_some(1));
                let device = bench.device();
                assert_eq!(device.firmware(), Some(&file[..]));
                assert_eq!(number(device.object(0x1018, 3)), Some(0x0002_0000));

                // It outlives the power, and can be done again.
                bench.power(false);
                bench.power(true);
                assert_eq!(bench.examine().sii.identity.revision, 0x0002_0000);
                bench.succeeds(via, &self::file(position, 5000));
            });
        }
    }
}

#[test]
fn power_lost_at_forty_percent() {
    // Without the first on the bus no frame comes back; without the second they do.
    for (position, via) in [(0, Via::Foe), (0, Via::Program), (1, Via::Foe)] {
        on_a_bus(demo, position, move |bench| {
            let file = file(position, 200_000);
            let off = Arc::clone(&bench.off);
            let mut tell = |told| {
                if let Told::Moved { done, of } = told
                    && done * 100 >= of * 40
                {
                    off.store(true, Ordering::Relaxed);
                }
            };
            let error = bench.update(via, &file, &mut tell).expect_err("no power");
            let FirmwareError::Failed {
                step, cause, left, ..
            } = &error
            else {
                panic!("{error}")
            };
            match via {
                Via::Foe => {
                    assert_eq!(*step, Step::Send);
                    let gone = match position {
                        0 => matches!(cause, Cause::Foe(FoeError::Wire { .. })),
                        _ => matches!(cause, Cause::Foe(FoeError::Gone { .. })),
                    };
                    assert!(gone, "{error}");
                }
                Via::Program => {
                    assert_eq!(*step, Step::Download);
                    assert!(
                        matches!(cause, Cause::Sdo(SdoError::Wire { .. })),
                        "{error}"
                    );
                }
            }
            assert_eq!(*left, Left::Silent);

            // The device comes back with its boot loader alone.
            bench.power(true);
            let found = bench.examine();
            assert!(bench.device().is_stopped());
            assert_eq!(found.runs(), Runs::BootLoader);
            let spoken = found.spoken.expect("it speaks");
            assert_eq!(spoken.device_type, Some(BOOT_LOADER));
            assert_eq!(
                spoken.identity[..3],
                [
                    Some(0xe0a),
                    Some(header(position).product & 0xffff_0000),
                    Some(0)
                ]
            );
            assert_eq!(spoken.control, (position == 0).then_some(0));
            bench.succeeds(via, &file);
        });
    }
}

#[test]
fn who_ends_an_update_leaves_no_device_in_bootstrap() {
    for (position, via) in [(0, Via::Foe), (0, Via::Program), (1, Via::Foe)] {
        on_a_bus(demo, position, move |bench| {
            let file = file(position, 200_000);
            // At once, in the middle of it, and when all is there.
            for percent in [0, 40, 100] {
                let stop = Arc::clone(&bench.stop);
                let mut tell = |told| {
                    if let Told::Moved { done, of } = told
                        && done * 100 >= of * percent
                    {
                        stop.store(true, Ordering::Relaxed);
                    }
                };
                let error = bench.update(via, &file, &mut tell).expect_err("ended");
                let FirmwareError::Failed { cause, left, .. } = &error else {
                    panic!("{error}")
                };
                assert!(matches!(cause, Cause::Interrupted), "{error}");
                let init = Left::In {
                    state: AlState::Init,
                    code: 0,
                };
                assert_eq!(*left, init, "{percent} %");
                assert!(
                    error
                        .to_string()
                        .contains("interrupted; the device is in Init")
                );
                assert_eq!(bench.device().al_state(), ecaxis_sim::AlState::Init);
            }
            bench.succeeds(via, &file);
        });
    }
}

/// A device that has a mailbox and no process data, so that it is in Op without a cycle.
fn without_process_data() -> Segment {
    let esi = std::fs::read_to_string(common::root().join("tests/judges/esi/mailbox.xml"));
    let mut text = esi.expect("the judges' ESI");
    for (from, to) in [
        ("<RxPdo", "</RxPdo>"),
        ("<TxPdo", "</TxPdo>"),
        ("<Sm MaxSize=\"32\"", "</Sm>"),
        ("<Sm MaxSize=\"32\"", "</Sm>"),
    ] {
        let begin = text.find(from).expect("it is there");
        let end = begin + text[begin..].find(to).expect("it ends") + to.len();
        text.replace_range(begin..end, "");
    }
    let esi = ecaxis_esi::parse(text.as_bytes()).expect("an ESI");
    let options = DeviceOptions {
        firmware: Some(FirmwareOptions::default()),
        ..DeviceOptions::default()
    };
    let device = SimDevice::from_esi(&esi.devices[0], &esi.modules, options);
    Segment::new(vec![device.expect("a device")], SegmentOptions::default())
}

#[test]
fn the_eeprom_of_a_device_that_runs_is_not_taken_from_it() {
    on_a_bus(without_process_data, 0, |bench| {
        bench.expected = Expected::default();
        let state = |bench: &Bench| bench.device().al_state().to_string();
        for wanted in [AlState::PreOp, AlState::SafeOp, AlState::Op] {
            let name = &wanted.to_string();
            let never = AtomicBool::new(false);
            let work = async |wire: Datagrams| {
                let at = device::locate(&wire, Locator::Position(0), None).await;
                let (found, at) = at.expect("located");
                if found.state == AlState::Init {
                    let sii = device::information(&wire, &found, &at).await.expect("read");
                    mailbox::lend(&wire, &at, &sii).await.expect("in PreOp");
                    wire.write(at.station, 0x0500, &[1]).await.expect("lent");
                } else {
                    let devices = std::slice::from_ref(&at);
                    let changed = al::change_state(&wire, devices, wanted, START_TIMEOUT).await;
                    changed.unwrap_or_else(|error| panic!("{error}"));
                }
            };
            carry(&mut bench.link, Clock::Virtual, &never, work).expect("carried");
            assert_eq!(state(bench), *name);
            bench.link.claims = 0;
            let found = bench.examine();
            assert!(found.in_use, "{name}");
            let spoken = found.spoken.expect("it speaks");
            assert_eq!(spoken.identity[1], Some(0x4d42_4f58));
            assert_eq!((bench.link.claims, &state(bench)), (0, name));
        }
        let header = FirmwareHeader {
            product: 0x4d42_4f58,
            ..header(0)
        };
        let file = header.file(&[7; 5000]);
        let error = bench
            .update(Via::Foe, &file, &mut |_| {})
            .expect_err("driven");
        assert!(matches!(error, FirmwareError::Driven { .. }), "{error}");
        assert_eq!((bench.link.claims, state(bench).as_str()), (0, "Op"));

        // One that nobody drives gives it up for an update, and in Init.
        let never = AtomicBool::new(false);
        let back = async |wire: Datagrams| {
            let at = device::locate(&wire, Locator::Position(0), None).await;
            let devices = [at.expect("located").1];
            al::change_state(&wire, &devices, AlState::PreOp, START_TIMEOUT).await
        };
        let back = carry(&mut bench.link, Clock::Virtual, &never, back).expect("carried");
        back.unwrap_or_else(|error| panic!("{error}"));
        let done = bench.update(Via::Foe, &file, &mut |_| {});
        done.unwrap_or_else(|error| panic!("{error}"));
        assert!(bench.link.claims > 0);
        assert!(!bench.examine().in_use);
        assert_eq!(bench.device().firmware(), Some(&file[..]));
    });
}

#[test]
fn what_one_way_left_half_done_the_other_completes() {
    on_a_bus(demo, 0, |bench| {
        let file = file(0, 50_000);
        let off = Arc::clone(&bench.off);
        let mut tell = |told| {
            if let Told::Moved { done: 20_000.., .. } = told {
                off.store(true, Ordering::Relaxed);
            }
        };
        bench
            .update(Via::Foe, &file, &mut tell)
            .expect_err("no power");
        bench.power(true);
        // The other way works, too.
        bench.succeeds(Via::Program, &file);
        bench.succeeds(Via::Foe, &file);
    });
}

#[test]
fn a_wrong_file_is_refused_and_the_right_one_taken_afterwards() {
    let good = file(0, 60_000);
    let mut damaged = good.clone();
    damaged[50_000] ^= 1;
    // Device codes over FoE and by SDO, and whether the old program is still there.
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
                let state = match (via, cause) {
                    (Via::Foe, Cause::Foe(error)) => {
                        assert_eq!(error.code(), Some(foe), "{what}: {error}");
                        AlState::Bootstrap
                    }
                    (Via::Program, Cause::Sdo(error)) => {
                        assert_eq!(error.abort_code(), Some(sdo), "{what}: {error}");
                        AlState::PreOp
                    }
                    _ => panic!("{what}: {error}"),
                };
                assert_eq!(*left, Left::In { state, code: 0 }, "{what}");
                let stopped = bench.device().is_stopped();
                assert_eq!(stopped, via == Via::Program, "{what}");
                // It can be used as it was, unless its program has been cleared.
                bench.power(false);
                bench.power(true);
                let runs = match keeps && via == Via::Foe {
                    true => Runs::Program,
                    false => Runs::BootLoader,
                };
                assert_eq!(bench.examine().runs(), runs, "{what}");
                bench.succeeds(via, &good);
            });
        }
    }
}

#[test]
fn another_device_than_is_meant_is_not_touched() {
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
                .update(Via::Foe, &good, &mut |_| touched = true)
                .expect_err("another device");
            assert!(matches!(error, FirmwareError::Identity { .. }), "{error}");
            assert!(error.to_string().contains(part), "{error}");
            assert!(!touched);
            let device = bench.device();
            assert_eq!(device.al_state(), ecaxis_sim::AlState::Init);
            assert_eq!(device.firmware(), None);
        }
        bench.expected = meant;
        // Also while its program is stopped, when it shows only half of its product code.
        bench.succeeds(Via::Program, &good);
    });
    on_a_bus(demo, 1, |bench| {
        let error = bench
            .update(Via::Program, &file(1, 5000), &mut |_| {})
            .expect_err("no 0x1F51");
        assert!(
            matches!(
                error,
                FirmwareError::NotOffered {
                    via: Via::Program,
                    ..
                }
            ),
            "{error}"
        );
        bench.succeeds(Via::Foe, &file(1, 5000));
    });
}

/// One EPOS4 whose program memory is slow.
fn slow(firmware: FirmwareOptions) -> impl FnOnce() -> Segment + Send + 'static {
    move || {
        let machine = load("demo.toml");
        let config = machine.devices.first().expect("a device");
        let options = DeviceOptions {
            firmware: Some(firmware),
            ..DeviceOptions::default()
        };
        let device = SimDevice::from_esi(&config.device, &config.esi.modules, options);
        Segment::new(vec![device.expect("a device")], SegmentOptions::default())
    }
}

#[test]
fn a_busy_device_is_waited_for_but_not_for_ever() {
    let patient = FirmwareOptions {
        erase_ns: 100_000_000_000,
        ..FirmwareOptions::default()
    };
    on_a_bus(slow(patient), 0, |bench| {
        let done = bench.succeeds(Via::Foe, &file(0, 5000));
        assert!(done.took.as_secs() >= 100);
    });
    let endless = FirmwareOptions {
        erase_ns: 150_000_000_000,
        ..FirmwareOptions::default()
    };
    on_a_bus(slow(endless), 0, |bench| {
        let good = file(0, 5000);
        let error = bench
            .update(Via::Foe, &good, &mut |_| {})
            .expect_err("busy");
        let FirmwareError::Failed {
            cause: Cause::Foe(FoeError::Busy { entire: 100, .. }),
            left,
            ..
        } = &error
        else {
            panic!("{error}")
        };
        assert_eq!(
            *left,
            Left::In {
                state: AlState::Bootstrap,
                code: 0
            }
        );
        bench.succeeds(Via::Foe, &good);
    });
    // Clearing may take twenty seconds, no more.
    let slow_clear = FirmwareOptions {
        erase_ns: 30_000_000_000,
        ..FirmwareOptions::default()
    };
    on_a_bus(slow(slow_clear), 0, |bench| {
        let good = file(0, 5000);
        let error = bench
            .update(Via::Program, &good, &mut |_| {})
            .expect_err("not cleared");
        assert!(
            matches!(
                error,
                FirmwareError::Failed {
                    step: Step::Clear,
                    ..
                }
            ),
            "{error}"
        );
        bench.succeeds(Via::Foe, &good);
    });
}

#[test]
fn a_file_beyond_the_program_memory() {
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
            match cause {
                Cause::Foe(error) => assert_eq!(error.code(), Some(0x8003)),
                Cause::Sdo(error) => assert_eq!(error.abort_code(), Some(0x0607_0012)),
                other => panic!("{other}"),
            }
            bench.succeeds(via, &file(0, 4000));
        });
    }
}

#[test]
fn lost_frames_cost_time_and_nothing_else() {
    for &via in ways(0) {
        on_a_bus(demo, 0, move |bench| {
            let script = "seed = 7\n[[fault]]\nkind = \"frame-loss\"\nprobability = 0.002\n\
                          [[fault]]\nkind = \"frame-corrupt\"\nprobability = 0.002\n";
            let script = FaultScript::parse(script).expect("a script");
            bench.link.link.segment_mut().set_faults(script);
            bench.succeeds(via, &file(0, 30_000));
        });
    }
}
