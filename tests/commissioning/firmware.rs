//! Firmware updates of simulated drives in virtual time: both methods, and every interruption.
//! After each interruption, the same command succeeds.

mod cli;
mod quirks;
mod refusals;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use ecaxis_master::acyclic::eeprom::EepromAccess;
use ecaxis_master::acyclic::{AlState, al};
use ecaxis_master::acyclic::{DatagramClient, device, mailbox};
use ecaxis_master::cancel::CancelToken;
use ecaxis_master::clock::Clock;
use ecaxis_master::config::Locator;
use ecaxis_master::link::sim::SimLink;
use ecaxis_master::link::{Link, LinkError, MAX_FRAME, Nanos};
use ecaxis_master::mailbox::{CoeCause, FoeCause, FoeError, MailboxTransport};
use ecaxis_master::session::run_on_link;
use ecaxis_master::session::simulated_bus;
use ecaxis_sim::{
    DeviceOptions, FaultScript, FirmwareHeader, FirmwareOptions, Segment, SegmentOptions, SimDevice,
};
use ecaxis_test_support::{load, root};
use ecaxis_tools::firmware::{
    self, BOOT_LOADER, DeviceIdentity, Expected, FinalDeviceState, FirmwareError, ReadBack,
    RunningProgram, START_TIMEOUT, UpdateCause, UpdateMethod, UpdateProgress, UpdateReport,
    UpdateRequest, UpdateStep,
};

/// The simulated bus with a power switch for one device.
#[derive(Debug)]
struct Switched {
    link: SimLink,
    position: usize,
    off: Arc<AtomicBool>,
    /// The number of datagrams that wrote to 0x0500 (EEPROM access).
    claims: usize,
}

impl Link for Switched {
    fn send(&mut self, frame: &[u8]) -> Result<(), LinkError> {
        // The first datagram: FPWR to register 0x0500.
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

/// A bus that keeps its state between commands.
struct Bench {
    link: Switched,
    off: Arc<AtomicBool>,
    /// The user's cancellation of the next update.
    stop: Arc<CancelToken>,
    /// The position of the device under test.
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

/// Returns the header of the new firmware for a device of the demonstration.
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

/// Returns a valid firmware file with this length.
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

    fn examine(&mut self) -> DeviceIdentity {
        let which = Locator::Position(self.position);
        let work = async move |wire| firmware::examine(&wire, which, Some("x")).await;
        let stop = CancelToken::default();
        let done = run_on_link(&mut self.link, Clock::Virtual, &stop, work);
        done.expect("carried").expect("examined")
    }

    /// Runs the update as the command does.
    fn update(
        &mut self,
        via: UpdateMethod,
        file: &[u8],
        report: &mut dyn FnMut(UpdateProgress),
    ) -> Result<UpdateReport, FirmwareError> {
        let (which, expected) = (Locator::Position(self.position), self.expected);
        let order = UpdateRequest {
            via,
            file: file.to_vec(),
            name: "new.bin".to_owned(),
            password: 0,
            read_back: true,
        };
        let work = async move |wire| {
            let before = firmware::examine(&wire, which, Some("x")).await?;
            firmware::update(&wire, &before, expected, &order, report).await
        };
        let stop = Arc::clone(&self.stop);
        let done = run_on_link(&mut self.link, Clock::Virtual, &stop, work).expect("carried");
        self.stop = Arc::default();
        done
    }

    fn power(&mut self, on: bool) {
        self.off.store(!on, Ordering::Relaxed);
        let position = usize::from(self.position);
        self.link.link.segment_mut().power(position, on);
    }

    /// Runs the same command, which must succeed.
    #[track_caller]
    fn succeeds(&mut self, via: UpdateMethod, file: &[u8]) -> UpdateReport {
        let done = match self.update(via, file, &mut |_| {}) {
            Ok(done) => done,
            Err(error) => panic!("{via}: {error}"),
        };
        assert_eq!(done.after.runs(), RunningProgram::Program);
        let device = self.device();
        assert_eq!(device.firmware(), Some(file), "{via}");
        assert!(!device.is_stopped());
        assert_eq!(device.al_state(), ecaxis_sim::AlState::Init);
        done
    }
}

/// Returns the update methods of the device at a position.
fn ways(position: u16) -> &'static [UpdateMethod] {
    match position {
        0 => &[UpdateMethod::Foe, UpdateMethod::Program],
        _ => &[UpdateMethod::Foe],
    }
}

fn number(bytes: Option<Vec<u8>>) -> Option<u32> {
    Some(u32::from_le_bytes(bytes?.try_into().ok()?))
}

#[test]
fn a_mebibyte_is_updated_by_both_methods_with_progress() {
    for position in [0, 1] {
        for &via in ways(position) {
            on_a_bus(demo, position, move |bench| {
                let before = bench.examine();
                assert_eq!(before.runs(), RunningProgram::Program);
                assert_eq!(before.sii.identity.revision, 0x0001_0000);
                let file = file(position, 1 << 20);
                let (mut moved, mut steps, mut busy) = (Vec::new(), Vec::new(), 0);
                let mut report = |reported| match reported {
                    UpdateProgress::Moved { done, of } => {
                        assert_eq!(of, 1 << 20);
                        moved.push(done);
                    }
                    UpdateProgress::Busy { done, entire } => {
                        assert!(done <= entire);
                        busy += 1;
                    }
                    UpdateProgress::Step(step) => steps.push(step),
                };
                let done = match bench.update(via, &file, &mut report) {
                    Ok(done) => done,
                    Err(error) => panic!("{via}: {error}"),
                };
                let sent = moved.iter().position(|n| *n == 1 << 20).expect("all of it");
                assert!(moved[..=sent].is_sorted());
                assert!(sent > 1000, "progress in {sent} parts");
                match via {
                    UpdateMethod::Foe => {
                        assert!(busy > 10, "erasing and programming take their time");
                        assert_eq!(done.read_back, ReadBack::Same);
                        assert_eq!(moved.last(), Some(&(1 << 20)), "read back");
                    }
                    UpdateMethod::Program => {
                        assert!(matches!(done.read_back, ReadBack::Refused(_)));
                    }
                }
                assert_eq!(steps.last(), Some(&UpdateStep::Check));
                assert!(done.took.as_secs() >= 1 && done.took.as_secs() < 600);

                // The new identity in EEPROM and objects.
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

                // The new firmware survives a power cycle and can be updated again.
                bench.power(false);
                bench.power(true);
                assert_eq!(bench.examine().sii.identity.revision, 0x0002_0000);
                bench.succeeds(via, &self::file(position, 5000));
            });
        }
    }
}

#[test]
fn an_update_succeeds_after_power_loss_at_forty_percent() {
    // Without the first device, no frames come back; without the second, frames come back.
    for (position, via) in [
        (0, UpdateMethod::Foe),
        (0, UpdateMethod::Program),
        (1, UpdateMethod::Foe),
    ] {
        on_a_bus(demo, position, move |bench| {
            let file = file(position, 200_000);
            let off = Arc::clone(&bench.off);
            let mut report = |reported| {
                if let UpdateProgress::Moved { done, of } = reported
                    && done * 100 >= of * 40
                {
                    off.store(true, Ordering::Relaxed);
                }
            };
            let error = bench.update(via, &file, &mut report).expect_err("no power");
            let FirmwareError::Failed {
                step, cause, left, ..
            } = &error
            else {
                panic!("{error}")
            };
            match via {
                UpdateMethod::Foe => {
                    assert_eq!(*step, UpdateStep::Send);
                    let gone = match position {
                        0 => matches!(
                            **cause,
                            UpdateCause::Foe(FoeError {
                                cause: FoeCause::Wire { .. },
                                ..
                            })
                        ),
                        _ => matches!(
                            **cause,
                            UpdateCause::Foe(FoeError {
                                cause: FoeCause::Gone { .. },
                                ..
                            })
                        ),
                    };
                    assert!(gone, "{error}");
                }
                UpdateMethod::Program => {
                    assert_eq!(*step, UpdateStep::Download);
                    assert!(
                        matches!(&**cause, UpdateCause::Sdo(error) if matches!(error.cause, CoeCause::Wire(_))),
                        "{error}"
                    );
                }
            }
            assert_eq!(*left, FinalDeviceState::Silent);

            // Only the boot loader of the device starts.
            bench.power(true);
            let found = bench.examine();
            assert!(bench.device().is_stopped());
            assert_eq!(found.runs(), RunningProgram::BootLoader);
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
fn a_cancelled_update_leaves_no_device_in_bootstrap() {
    for (position, via) in [
        (0, UpdateMethod::Foe),
        (0, UpdateMethod::Program),
        (1, UpdateMethod::Foe),
    ] {
        on_a_bus(demo, position, move |bench| {
            let file = file(position, 200_000);
            // Cancels at the start, in the middle, and at the end.
            for percent in [0, 40, 100] {
                let stop = Arc::clone(&bench.stop);
                let mut report = |reported| {
                    if let UpdateProgress::Moved { done, of } = reported
                        && done * 100 >= of * percent
                    {
                        stop.cancel();
                    }
                };
                let error = bench.update(via, &file, &mut report).expect_err("ended");
                let FirmwareError::Failed { cause, left, .. } = &error else {
                    panic!("{error}")
                };
                assert!(matches!(**cause, UpdateCause::Interrupted), "{error}");
                let init = FinalDeviceState::In {
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

/// A device with a mailbox but without process data is in Op without a cycle.
fn without_process_data() -> Segment {
    let esi = std::fs::read_to_string(root().join("tests/judges/esi/mailbox.xml"));
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
fn the_eeprom_of_a_running_device_stays_assigned_to_it() {
    on_a_bus(without_process_data, 0, |bench| {
        bench.expected = Expected::default();
        let state = |bench: &Bench| bench.device().al_state().to_string();
        for wanted in [AlState::PreOp, AlState::SafeOp, AlState::Op] {
            let name = &wanted.to_string();
            let never = CancelToken::default();
            let work = async |wire: DatagramClient| {
                let at = device::locate(&wire, Locator::Position(0), None).await;
                let (found, at) = at.expect("located");
                if found.state == AlState::Init {
                    let sii = device::read_sii(&wire, &at, EepromAccess::Force).await;
                    let sii = sii.expect("read");
                    mailbox::open(&wire, &at, &sii).await.expect("in PreOp");
                    wire.write(at.station, 0x0500, &[1]).await.expect("lent");
                } else {
                    let devices = std::slice::from_ref(&at);
                    let changed = al::change_state(&wire, devices, wanted, START_TIMEOUT).await;
                    changed.unwrap_or_else(|error| panic!("{error}"));
                }
            };
            run_on_link(&mut bench.link, Clock::Virtual, &never, work).expect("carried");
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
            .update(UpdateMethod::Foe, &file, &mut |_| {})
            .expect_err("driven");
        assert!(matches!(error, FirmwareError::Driven { .. }), "{error}");
        assert_eq!((bench.link.claims, state(bench).as_str()), (0, "Op"));

        // A device without an active MainDevice releases its EEPROM in Init for an update.
        let never = CancelToken::default();
        let back = async |wire: DatagramClient| {
            let at = device::locate(&wire, Locator::Position(0), None).await;
            let devices = [at.expect("located").1];
            al::change_state(&wire, &devices, AlState::PreOp, START_TIMEOUT).await
        };
        let back = run_on_link(&mut bench.link, Clock::Virtual, &never, back).expect("carried");
        back.unwrap_or_else(|error| panic!("{error}"));
        let done = bench.update(UpdateMethod::Foe, &file, &mut |_| {});
        done.unwrap_or_else(|error| panic!("{error}"));
        assert!(bench.link.claims > 0);
        assert!(!bench.examine().in_use);
        assert_eq!(bench.device().firmware(), Some(&file[..]));
    });
}

/// One EPOS4 with slow program memory.
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
fn a_busy_device_is_awaited_for_a_limited_time() {
    let patient = FirmwareOptions {
        erase_ns: 100_000_000_000,
        ..FirmwareOptions::default()
    };
    on_a_bus(slow(patient), 0, |bench| {
        let done = bench.succeeds(UpdateMethod::Foe, &file(0, 5000));
        assert!(done.took.as_secs() >= 100);
    });
    let endless = FirmwareOptions {
        erase_ns: 150_000_000_000,
        ..FirmwareOptions::default()
    };
    on_a_bus(slow(endless), 0, |bench| {
        let good = file(0, 5000);
        let error = bench
            .update(UpdateMethod::Foe, &good, &mut |_| {})
            .expect_err("busy");
        let FirmwareError::Failed { cause, left, .. } = &error else {
            panic!("{error}")
        };
        let UpdateCause::Foe(FoeError { cause, .. }) = &**cause else {
            panic!("{error}")
        };
        let busy = matches!(cause, FoeCause::Busy { entire: 100, .. });
        assert!(busy, "{error}");
        assert_eq!(
            *left,
            FinalDeviceState::In {
                state: AlState::Bootstrap,
                code: 0
            }
        );
        bench.succeeds(UpdateMethod::Foe, &good);
    });
    // Erasing may take up to twenty seconds.
    let slow_clear = FirmwareOptions {
        erase_ns: 30_000_000_000,
        ..FirmwareOptions::default()
    };
    on_a_bus(slow(slow_clear), 0, |bench| {
        let good = file(0, 5000);
        let error = bench
            .update(UpdateMethod::Program, &good, &mut |_| {})
            .expect_err("not cleared");
        assert!(
            matches!(
                error,
                FirmwareError::Failed {
                    step: UpdateStep::Clear,
                    ..
                }
            ),
            "{error}"
        );
        bench.succeeds(UpdateMethod::Foe, &good);
    });
}

#[test]
fn lost_frames_only_delay_an_update() {
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
