//! Scans of simulated segments in virtual time.

use std::future::{Future, poll_fn};
use std::path::Path;
use std::pin::pin;
use std::sync::mpsc::channel;
use std::sync::{Arc, Mutex, MutexGuard};
use std::task::{Context, Poll, Waker};
use std::time::Duration;

use ecaxis_sim::FaultScript;

use super::{MainDeviceEvidence, Options, Scan, scan};
use ecaxis_master::acyclic::DatagramClient;
use ecaxis_master::acyclic::enumerate::{address, enumerate};
use ecaxis_master::acyclic::{AlState, al};
use ecaxis_master::cancel::CancelToken;
use ecaxis_master::clock::{Clock, Nanos};
use ecaxis_master::config::{self, Machine};
use ecaxis_master::link::sim::SimLink;
use ecaxis_master::link::{Link, LinkError, MAX_FRAME};
use ecaxis_master::mailbox::MailboxTransport;
use ecaxis_master::rt::cycle::Engine;
use ecaxis_master::session::run_on_link;
use ecaxis_master::session::{self, Attachments, Prepared, RunBuilder, simulated_bus};

const STACK: usize = 16 * 1024 * 1024;

/// Runs `work` on the bus of a machine file.
pub(crate) fn on<T: Send + 'static>(
    file: &'static str,
    work: impl AsyncFnOnce(DatagramClient) -> T + Send + 'static,
) -> (T, SimLink) {
    let there = std::thread::Builder::new().stack_size(STACK);
    let done = there.spawn(move || {
        Clock::Virtual.enter();
        let path = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../configs")
            .join(file);
        let machine = config::load(&path).expect("a machine");
        let mut link = SimLink::new(simulated_bus(&machine, 1, None, None).expect("a bus"));
        let done = run_on_link(&mut link, Clock::Virtual, &CancelToken::default(), work);
        (done.expect("carried"), link)
    });
    done.expect("a thread").join().expect("no panic")
}

pub(crate) async fn scanned(wire: &DatagramClient, options: Options) -> Scan {
    scan(wire, options, &mut |_| {}).await.expect("a scan")
}

/// Runs `other` for as long as `first` runs.
async fn run_during<T>(first: impl Future<Output = T>, other: impl Future<Output = ()>) -> T {
    let (mut first, mut other) = (pin!(first), pin!(other));
    let mut gone = false;
    poll_fn(move |context| {
        if !gone {
            gone = other.as_mut().poll(context).is_ready();
        }
        match first.as_mut().poll(context) {
            Poll::Ready(done) => Poll::Ready(done),
            Poll::Pending => Poll::Pending,
        }
    })
    .await
}

fn states(link: &SimLink, count: usize) -> Vec<String> {
    let device = |n| link.segment().device(n).expect("a device");
    (0..count)
        .map(|n| device(n).al_state().to_string())
        .collect()
}

#[test]
fn scan_restores_an_idle_bus() {
    let ask = Options {
        ask: true,
        ..Options::default()
    };
    let (scan, link) = on("demo.toml", async move |wire| scanned(&wire, ask).await);
    assert_eq!(scan.others, []);
    assert!(scan.asked && scan.measured);
    for device in &scan.devices {
        let answers = device.answers.as_ref().expect("a mailbox");
        let answers = answers.as_ref().expect("answers");
        let drive = answers.drive.expect("a drive");
        assert_eq!(drive.following_window, Some(2000));
        assert_eq!(answers.device_type.map(|t| t & 0xffff), Some(402));
    }
    assert_eq!(states(&link, 2), ["Init", "Init"]);
}

#[test]
fn scan_uses_mailboxes_only_on_request() {
    let (scan, link) = on("demo.toml", async |wire| {
        scanned(&wire, Options::default()).await
    });
    assert!(!scan.asked);
    assert!(
        scan.devices
            .iter()
            .all(|d| d.answers.is_none() && d.sii.is_ok())
    );
    assert_eq!(states(&link, 2), ["Init", "Init"]);
}

/// Another MainDevice distributes the time: the devices are left alone, but `intrude` uses the
/// mailboxes.
#[test]
fn scan_detects_a_main_device_by_its_clock_writes() {
    for intrude in [false, true] {
        let options = Options {
            ask: true,
            intrude,
            ..Options::default()
        };
        let (scan, link) = on("demo.toml", async move |wire| {
            let mut found = enumerate(&wire).await.expect("two");
            address(&wire, &mut found).await.expect("addresses");
            let station = found[0].station;
            let master = async {
                loop {
                    let _ = wire.distribute_time(station).await;
                    wire.delay(Duration::from_millis(1)).await;
                }
            };
            run_during(scanned(&wire, options), master).await
        });
        assert!(
            scan.others
                .contains(&MainDeviceEvidence::Time { position: 1 }),
            "{:?}",
            scan.others
        );
        assert!(scan.others.iter().all(MainDeviceEvidence::is_live));
        assert_eq!(scan.asked, intrude);
        assert!(!scan.measured, "what it measured is not disturbed");
        assert_eq!(states(&link, 2), ["Init", "Init"]);
    }
}

/// A terminal follows AL control.
#[test]
fn scan_reports_a_bus_left_running() {
    let (scan, link) = on("terminals.toml", async |wire| {
        let mut found = enumerate(&wire).await.expect("devices");
        address(&wire, &mut found).await.expect("addresses");
        let station = found[1].station;
        for state in [2, 4] {
            wire.write(station, 0x0120, &[state, 0])
                .await
                .expect("written");
        }
        let ask = Options {
            ask: true,
            ..Options::default()
        };
        scanned(&wire, ask).await
    });
    let state = AlState::SafeOp;
    assert_eq!(
        scan.others,
        [MainDeviceEvidence::State { position: 1, state }]
    );
    assert!(!scan.asked);
    assert_eq!(states(&link, 3), ["Init", "SafeOp", "Init"]);
}

/// SYNC0 of a device in Init is a leftover and does not count as a MainDevice.
#[test]
fn leftover_sync0_is_not_a_main_device() {
    let (scan, link) = on("demo.toml", async |wire| {
        let mut found = enumerate(&wire).await.expect("two");
        address(&wire, &mut found).await.expect("addresses");
        let station = found[1].station;
        // SYNC0 starts in an hour.
        wire.write(station, 0x0990, &3_600_000_000_000_u64.to_le_bytes())
            .await
            .expect("written");
        wire.write(station, 0x09a0, &1_000_000_u32.to_le_bytes())
            .await
            .expect("written");
        wire.write(station, 0x0981, &[3]).await.expect("written");
        let ask = Options {
            ask: true,
            ..Options::default()
        };
        scanned(&wire, ask).await
    });
    assert_eq!(scan.others, []);
    assert!(scan.asked);
    assert_eq!(states(&link, 2), ["Init", "Init"]);
}

/// A bus that can be accessed after the run that used it.
#[derive(Debug, Clone)]
struct Shared(Arc<Mutex<SimLink>>);

impl Shared {
    fn bus(&self) -> MutexGuard<'_, SimLink> {
        self.0.lock().expect("one thread")
    }
}

impl Link for Shared {
    fn send(&mut self, frame: &[u8]) -> Result<(), LinkError> {
        self.bus().send(frame)
    }

    fn recv(&mut self, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
        self.bus().recv(buf)
    }

    fn next_arrival(&self) -> Option<Nanos> {
        self.bus().next_arrival()
    }
}

/// Brings a machine up and runs it until it stops, in virtual time.
fn ran_well(link: &Shared, machine: &Arc<Machine>) -> bool {
    let options = session::Options {
        clock: Clock::Virtual,
        ..session::Options::default()
    };
    let stop = Arc::<CancelToken>::default();
    let (progress, _receiver) = channel();
    let own = Box::new(link.clone());
    let job = RunBuilder {
        machine,
        options: &options,
        stop,
        progress,
        attachments: Attachments::default(),
    };
    let Ok(Prepared { parts, supervisor }) = job.prepare_on(own) else {
        return false;
    };
    let mut engine = Engine::new(parts);
    let mut during = pin!(supervisor.run());
    let mut context = Context::from_waker(Waker::noop());
    let mut done = None;
    while !engine.halted() {
        engine.cycle();
        if done.is_none()
            && let Poll::Ready((_, result)) = during.as_mut().poll(&mut context)
        {
            done = Some(result);
        }
    }
    matches!(done, Some(Ok(())))
}

/// After every kind of run, a scan finds no MainDevice, and SYNC0 is off in every device.
#[test]
fn scan_finds_no_main_device_after_a_run() {
    // Faults, and whether the machine comes up and completes its program.
    for (faults, comes_up, works) in [
        ("", true, true),
        (
            "[[fault]]\nkind = \"drive-fault\"\nat = \"1s\"\ndevice = 1\ncode = 0x3210",
            true,
            false,
        ),
        (
            "[[fault]]\nkind = \"refuse-state\"\ndevice = 1\nstate = \"safe-op\"\ncode = 0x1e",
            false,
            false,
        ),
    ] {
        let there = std::thread::Builder::new().stack_size(STACK);
        let done = there.spawn(move || {
            Clock::Virtual.enter();
            let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/demo.toml");
            let machine = Arc::new(config::load(&path).expect("a machine"));
            let script = FaultScript::parse(faults).expect("faults");
            let bus = simulated_bus(&machine, 1, Some(&script), None).expect("a bus");
            let link = Shared(Arc::new(Mutex::new(SimLink::new(bus))));
            assert_eq!(ran_well(&link, &machine), works, "{faults}");
            for position in 0..2 {
                let bus = link.bus();
                let device = bus.segment().device(position).expect("a device");
                let pulses = device.sync0_log().next().is_some();
                assert!(pulses || !comes_up, "{faults}: position {position}");
            }
            let mut bus = link.clone();
            let ask = Options {
                ask: true,
                ..Options::default()
            };
            let stop = CancelToken::default();
            let look = run_on_link(
                &mut bus,
                Clock::Virtual,
                &stop,
                async |wire: DatagramClient| {
                    let mut activations = Vec::new();
                    for position in 0..2 {
                        let mut activation = [0xa5; 1];
                        let answer = wire.read_at(position, 0x0981, &mut activation).await;
                        assert_eq!(answer.expect("read"), 1);
                        activations.push(activation[0]);
                    }
                    (activations, scanned(&wire, ask).await)
                },
            );
            let (activations, scan) = look.expect("carried");
            assert_eq!(activations, [0, 0], "{faults}");
            assert_eq!(scan.others, [], "{faults}");
            assert!(scan.asked, "{faults}");
        });
        done.expect("a thread").join().expect("no panic");
    }
}

#[test]
fn scan_reports_foreign_frames() {
    let options = Options {
        heard: 12,
        ask: true,
        ..Options::default()
    };
    let (scan, _) = on("demo.toml", async move |wire| scanned(&wire, options).await);
    assert_eq!(scan.others, [MainDeviceEvidence::Frames { count: 12 }]);
    assert!(!scan.asked);
}

/// In Init an EEPROM is taken from the device's processor, to which other MainDevices leave it, and
/// given back. In other states the processor may need it.
#[test]
fn scan_takes_an_eeprom_from_the_processor_in_init_only() {
    for state in [AlState::Init, AlState::PreOp] {
        let ((scan, access), _) = on("terminals.toml", async move |wire| {
            let mut found = enumerate(&wire).await.expect("all");
            address(&wire, &mut found).await.expect("addresses");
            let coupler = [found[0].named("coupler".to_owned())];
            let change = al::change_state(&wire, &coupler, state, Duration::from_secs(3));
            change.await.expect("changed");
            let station = found[0].station;
            wire.write(station, 0x0500, &[1]).await.expect("written");
            let scan = scanned(&wire, Options::default()).await;
            let mut access = [0; 1];
            wire.read(station, 0x0500, &mut access).await.expect("read");
            (scan, access)
        });
        assert_eq!(access, [1], "as it was");
        let first = &scan.devices[0];
        match &first.sii {
            Ok(_) => assert_eq!(state, AlState::Init),
            Err(problem) => assert!(
                state == AlState::PreOp && problem.contains("processor"),
                "{problem}"
            ),
        }
        assert!(scan.devices[1].sii.is_ok());
    }
}
