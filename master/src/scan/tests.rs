//! Scans of simulated segments in virtual time.

use std::future::{Future, poll_fn};
use std::path::Path;
use std::pin::pin;
use std::sync::atomic::AtomicBool;
use std::task::Poll;
use std::time::Duration;

use super::{Options, Scan, Sign, scan};
use crate::bringup::AlState;
use crate::clock::Clock;
use crate::config;
use crate::link::sim::SimLink;
use crate::mailbox::Wire;
use crate::service::station::{address, census};
use crate::service::{Datagrams, carry};
use crate::session::simulated_bus;

const STACK: usize = 16 * 1024 * 1024;

/// Does a piece of work on the bus of one of our machine files.
fn on<T: Send + 'static>(
    file: &'static str,
    work: impl AsyncFnOnce(Datagrams) -> T + Send + 'static,
) -> (T, SimLink) {
    let there = std::thread::Builder::new().stack_size(STACK);
    let done = there.spawn(move || {
        Clock::Virtual.enter();
        let path = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../configs")
            .join(file);
        let machine = config::load(&path).expect("a machine");
        let mut link = SimLink::new(simulated_bus(&machine, 1, None, None).expect("a bus"));
        let done = carry(&mut link, Clock::Virtual, &AtomicBool::new(false), work);
        (done.expect("carried"), link)
    });
    done.expect("a thread").join().expect("no panic")
}

async fn scanned(wire: &Datagrams, options: Options) -> Scan {
    scan(wire, options, &mut |_| {}).await.expect("a scan")
}

/// The other does its work for as long as the first lasts.
async fn beside<T>(first: impl Future<Output = T>, other: impl Future<Output = ()>) -> T {
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
fn a_quiet_bus_is_asked_and_left_as_it_was() {
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
fn only_what_was_asked_for() {
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

/// Another MainDevice gives out the time; everything is left alone, and `intrude` asks all the same.
#[test]
fn another_master_shows_by_the_time_that_it_gives() {
    for intrude in [false, true] {
        let options = Options {
            ask: true,
            intrude,
            heard: 0,
        };
        let (scan, link) = on("demo.toml", async move |wire| {
            let mut found = census(&wire).await.expect("two");
            address(&wire, &mut found).await.expect("addresses");
            let station = found[0].station;
            let master = async {
                loop {
                    let _ = wire.distribute_time(station).await;
                    wire.delay(Duration::from_millis(1)).await;
                }
            };
            beside(scanned(&wire, options), master).await
        });
        assert!(
            scan.others.contains(&Sign::Time { position: 1 }),
            "{:?}",
            scan.others
        );
        assert!(scan.others.iter().all(Sign::is_live));
        assert_eq!(scan.asked, intrude);
        assert!(!scan.measured, "what it measured is not disturbed");
        assert_eq!(states(&link, 2), ["Init", "Init"]);
    }
}

#[test]
fn a_bus_that_was_left_running() {
    let (scan, link) = on("demo.toml", async |wire| {
        let mut found = census(&wire).await.expect("two");
        address(&wire, &mut found).await.expect("addresses");
        let station = found[1].station;
        // SYNC0 in an hour.
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
    assert_eq!(scan.others, [Sign::Sync { position: 1 }]);
    assert!(!scan.asked);
    assert_eq!(states(&link, 2), ["Init", "Init"]);
}

#[test]
fn frames_that_were_heard() {
    let options = Options {
        heard: 12,
        ask: true,
        ..Options::default()
    };
    let (scan, _) = on("demo.toml", async move |wire| scanned(&wire, options).await);
    assert_eq!(scan.others, [Sign::Frames { count: 12 }]);
    assert!(!scan.asked);
}

/// An EEPROM that the device's processor holds is not taken from it.
#[test]
fn an_eeprom_that_is_lent() {
    let ((scan, access), _) = on("demo.toml", async |wire| {
        let mut found = census(&wire).await.expect("two");
        address(&wire, &mut found).await.expect("addresses");
        let station = found[0].station;
        wire.write(station, 0x0500, &[1]).await.expect("written");
        let scan = scanned(&wire, Options::default()).await;
        let mut access = [0; 1];
        wire.read(station, 0x0500, &mut access).await.expect("read");
        (scan, access)
    });
    assert_eq!(access, [1], "as it was");
    let first = &scan.devices[0];
    let problem = first.sii.as_ref().expect_err("lent");
    assert!(problem.contains("processor"), "{problem}");
    assert!(scan.devices[1].sii.is_ok());
    assert_eq!(first.found.state, AlState::Init);
}
