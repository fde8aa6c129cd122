//! Tests on a simulated segment in virtual time, without a bring-up.

use std::cell::Cell;
use std::path::Path;
use std::time::Duration;

use ecaxis_esi::sii;

use super::device::{locate, read_sii, with_mailbox};
use super::eeprom::{Eeprom, EepromAccess, EepromError, with_eeprom};
use super::enumerate::{EnumeratedDevice, address, enumerate, select};
use super::image::{WriteError, write};
use super::{DatagramClient, al, mailbox};
mod eeprom;

use crate::acyclic::{AlState, DeviceRef};
use crate::cancel::CancelToken;
use crate::clock::Clock;
use crate::config::{self, Locator};
use crate::link::sim::SimLink;
use crate::mailbox::{DatagramError, MailboxTransport};
use crate::report::{Cause, Error};
use crate::session::run_on_link;
use crate::session::simulated_bus;

/// Runs `work` on a segment of two drives.
fn with_drives<T: Send + 'static>(
    work: impl AsyncFnOnce(DatagramClient) -> T + Send + 'static,
) -> (T, SimLink) {
    let there = std::thread::Builder::new().stack_size(16 * 1024 * 1024);
    let done = there.spawn(move || {
        Clock::Virtual.enter();
        let demo = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/demo.toml");
        let machine = config::load(&demo).expect("a machine");
        let mut link = SimLink::new(simulated_bus(&machine, 1, None, None).expect("a bus"));
        let done = run_on_link(&mut link, Clock::Virtual, &CancelToken::default(), work);
        (done.expect("carried"), link)
    });
    done.expect("a thread").join().expect("no panic")
}

async fn addressed(wire: &DatagramClient) -> Vec<EnumeratedDevice> {
    let mut found = enumerate(wire).await.expect("a census");
    address(wire, &mut found).await.expect("addresses");
    found
}

#[test]
fn address_assigns_addresses_and_keeps_existing_ones() {
    let ((first, second), _) = with_drives(async |wire| {
        let before = enumerate(&wire).await.expect("a census");
        assert_eq!(before.len(), 2);
        assert!(
            before
                .iter()
                .all(|f| f.station == 0 && f.state == AlState::Init)
        );
        let first = addressed(&wire).await;
        wire.write_at(0, 0x0010, &0x2345_u16.to_le_bytes())
            .await
            .expect("written");
        (first, addressed(&wire).await)
    });
    assert_eq!(
        first.iter().map(|f| f.station).collect::<Vec<_>>(),
        [0x1000, 0x1001]
    );
    assert_eq!(
        second.iter().map(|f| f.station).collect::<Vec<_>>(),
        [0x2345, 0x1001]
    );
}

#[test]
fn address_replaces_duplicate_addresses() {
    let (stations, _) = with_drives(async |wire| {
        for position in 0..2 {
            wire.write_at(position, 0x0010, &0x1000_u16.to_le_bytes())
                .await
                .expect("written");
        }
        addressed(&wire)
            .await
            .iter()
            .map(|f| f.station)
            .collect::<Vec<_>>()
    });
    assert_eq!(stations, [0x1000, 0x1001]);
}

/// A device left in PreOp by another program remembers the counter of that program's last request.
#[test]
fn mailbox_of_another_program_answers_the_first_request() {
    let (answers, _) = with_drives(async |wire| {
        let found = addressed(&wire).await;
        let device = found[0].named("x");
        let sii = read_sii(&wire, &device, EepromAccess::IfFree).await;
        let sii = sii.expect("read");
        let mut first = mailbox::open(&wire, &device, &sii).await.expect("lent");
        let mut answers = Vec::new();
        // The loop covers all seven counter values.
        for _ in 0..8 {
            let read = first.coe.upload(&wire, 0x1018, 1, false).await;
            read.expect("read");
            let mut next = mailbox::open(&wire, &device, &sii).await.expect("lent");
            answers.push(next.coe.upload(&wire, 0x1018, 1, false).await);
            first = next;
            for _ in 0..answers.len() {
                let read = first.coe.upload(&wire, 0x1018, 1, false).await;
                read.expect("read");
            }
        }
        answers
    });
    for answer in answers {
        assert_eq!(answer.expect("an answer").len(), 4);
    }
}

#[test]
fn mailbox_session_restores_init() {
    let (done, link) = with_drives(async |wire| {
        let found = addressed(&wire).await;
        let device = found[0].named("x");
        let sii = read_sii(&wire, &device, EepromAccess::IfFree).await;
        let sii = sii.expect("read");
        let mut lent = mailbox::open(&wire, &device, &sii).await.expect("lent");
        let vendor = lent
            .coe
            .upload(&wire, 0x1018, 1, false)
            .await
            .expect("read");
        // A second session uses the mailbox as configured and leaves the state unchanged.
        let mut again = mailbox::open(&wire, &device, &sii).await.expect("lent");
        assert_eq!(again.found, AlState::PreOp);
        assert_eq!(again.coe.layout(), lent.coe.layout());
        let same = again
            .coe
            .upload(&wire, 0x1018, 1, false)
            .await
            .expect("read");
        again.close(&wire).await.expect("given back");
        lent.close(&wire).await.expect("given back");
        (vendor, same, sii.identity.vendor)
    });
    assert_eq!(done.0, done.2.to_le_bytes());
    assert_eq!(done.0, done.1);
    assert_eq!(
        link.segment()
            .device(0)
            .expect("a device")
            .al_state()
            .to_string(),
        "Init"
    );
}

#[test]
fn select_finds_devices_or_reports_why_not() {
    let found: Vec<EnumeratedDevice> = [(0, 5), (1, 0), (2, 5)]
        .map(|(position, alias)| EnumeratedDevice {
            position,
            station: 0x1000 + position,
            alias,
            dl_status: 0,
            state: AlState::Init,
            error: false,
            code: 0,
        })
        .into();
    let position = |at: Locator| {
        select(&found, at)
            .map(|f| f.position)
            .map_err(|e| e.to_string())
    };
    assert_eq!(position(Locator::Position(2)), Ok(2));
    assert_eq!(position(Locator::Alias(0)), Ok(1));
    assert_eq!(
        position(Locator::Position(3)),
        Err("no SubDevice has position 3; 3 answer, at positions 0 to 2".to_owned())
    );
    let nameless = found
        .get(1..2)
        .map(<[EnumeratedDevice]>::to_vec)
        .unwrap_or_default();
    let nameless = [nameless.clone(), nameless].concat();
    let none = select(&nameless, Locator::Alias(7)).map_err(|e| e.to_string());
    assert_eq!(
        none.map(|found| found.position),
        Err("no SubDevice has alias 7; none of the 2 has one".to_owned())
    );
    assert_eq!(
        position(Locator::Alias(7)),
        Err("no SubDevice has alias 7; their aliases are 5, 0, 5".to_owned())
    );
    assert_eq!(
        position(Locator::Alias(5)),
        Err("2 SubDevices have alias 5: at positions 0, 2".to_owned())
    );
}

#[test]
fn run_on_link_returns_interrupted_when_stopped() {
    std::thread::spawn(|| {
        Clock::Virtual.enter();
        let demo = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/demo.toml");
        let machine = config::load(&demo).expect("a machine");
        let mut link = SimLink::new(simulated_bus(&machine, 1, None, None).expect("a bus"));
        let stop = CancelToken::default();
        stop.cancel();
        let done = run_on_link(&mut link, Clock::Virtual, &stop, async |wire| {
            enumerate(&wire).await
        });
        assert!(done.is_err_and(|error| error.is_interruption()));
    })
    .join()
    .expect("no panic");
}

/// Runs `work` on the first of two drives until `stop` is set. Returns the AL state and 0x0500
/// afterwards. 0x0500 is `access` before.
fn stopped<T: Send + 'static>(
    access: u8,
    work: impl AsyncFnOnce(DatagramClient, EnumeratedDevice, DeviceRef, &CancelToken) -> T
    + Send
    + 'static,
) -> (Result<T, Error>, (String, u8), Vec<u8>) {
    let there = std::thread::Builder::new().stack_size(16 * 1024 * 1024);
    let done = there.spawn(move || {
        Clock::Virtual.enter();
        let demo = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/demo.toml");
        let machine = config::load(&demo).expect("a machine");
        let mut link = SimLink::new(simulated_bus(&machine, 1, None, None).expect("a bus"));
        let stop = CancelToken::default();
        let done = run_on_link(
            &mut link,
            Clock::Virtual,
            &stop,
            async |wire: DatagramClient| {
                let at = locate(&wire, Locator::Position(0), None).await;
                let (found, device) = at.expect("located");
                let written = wire.write(device.station, 0x0500, &[access]).await;
                assert_eq!(written, Ok(1));
                work(wire, found, device, &stop).await
            },
        );
        let never = CancelToken::default();
        let access = run_on_link(&mut link, Clock::Virtual, &never, async |wire| {
            let mut access = [0];
            let read = wire.read_at(0, 0x0500, &mut access).await;
            read.map(|_| access[0]).expect("read")
        });
        let device = link.segment().device(0).expect("a device");
        let left = (device.al_state().to_string(), access.expect("carried"));
        (done, left, device.sii().to_vec())
    });
    done.expect("a thread").join().expect("no panic")
}

#[test]
fn with_mailbox_restores_the_device_when_stopped() {
    for access in [0, 1] {
        let work = async |wire: DatagramClient,
                          found: EnumeratedDevice,
                          at: DeviceRef,
                          stop: &CancelToken| {
            let sii = read_sii(&wire, &at, EepromAccess::of(found.state)).await?;
            let mut reached = 0;
            let step = "reading its parameters";
            let all = with_mailbox(&wire, &at, &sii, step, async |lent| -> Result<(), Error> {
                loop {
                    reached += 1;
                    if reached >= 10 {
                        stop.cancel();
                    }
                    let read = lent.coe.upload(&wire, 0x1018, 1, false).await;
                    read.map_err(|error| Cause::Sdo(error).with_device(&at))?;
                }
            });
            let ended: Result<(), Error> = all.await;
            assert_eq!(reached, 10, "at once");
            ended
        };
        let (done, left, _) = stopped(access, work);
        let error = done.expect("a report").expect_err("ended");
        assert_eq!(
            error.to_string(),
            "`device 0` (position 0, station 0x1000): reading its parameters: interrupted"
        );
        assert_eq!(left, ("Init".to_owned(), access));
    }
}

/// A transport that loses datagrams. `loses` decides for each one, from its register and the data
/// to write.
struct Lossy<'w, F> {
    wire: &'w DatagramClient,
    loses: F,
}

impl<F: Fn(u16, Option<&[u8]>) -> bool> MailboxTransport for Lossy<'_, F> {
    async fn read(
        &self,
        station: u16,
        register: u16,
        buf: &mut [u8],
    ) -> Result<u16, DatagramError> {
        match (self.loses)(register, None) {
            true => Err(DatagramError::Timeout { station, register }),
            false => self.wire.read(station, register, buf).await,
        }
    }

    async fn write(&self, station: u16, register: u16, data: &[u8]) -> Result<u16, DatagramError> {
        match (self.loses)(register, Some(data)) {
            true => Err(DatagramError::Timeout { station, register }),
            false => self.wire.write(station, register, data).await,
        }
    }

    async fn delay(&self, duration: Duration) {
        self.wire.delay(duration).await;
    }

    fn now(&self) -> u64 {
        self.wire.now()
    }
}

#[test]
fn mailbox_open_restores_init_after_a_lost_frame() {
    let (done, left, _) = stopped(0, async |wire, found, at, _| {
        let sii = read_sii(&wire, &at, EepromAccess::of(found.state)).await?;
        // The first answer after the request for PreOp is lost.
        let asked = Cell::new(false);
        let lossy = Lossy {
            wire: &wire,
            loses: |register, written: Option<&[u8]>| match written {
                None => asked.take(),
                Some(data) => {
                    asked.set((register, data) == (0x0120, &[2, 0][..]));
                    false
                }
            },
        };
        mailbox::open(&lossy, &at, &sii).await.map(|_| ())
    });
    let error = done.expect("carried").expect_err("a frame was lost");
    assert!(matches!(*error.cause, Cause::State(_)), "{error}");
    assert_eq!(left, ("Init".to_owned(), 0));
}

/// A wire that keeps what is written to AL control.
struct Controls<'w> {
    wire: &'w DatagramClient,
    written: std::cell::RefCell<Vec<u8>>,
}

impl MailboxTransport for Controls<'_> {
    async fn read(
        &self,
        station: u16,
        register: u16,
        buf: &mut [u8],
    ) -> Result<u16, DatagramError> {
        self.wire.read(station, register, buf).await
    }

    async fn write(&self, station: u16, register: u16, data: &[u8]) -> Result<u16, DatagramError> {
        if register == 0x0120 {
            self.written.borrow_mut().push(data[0]);
        }
        self.wire.write(station, register, data).await
    }

    async fn delay(&self, duration: Duration) {
        self.wire.delay(duration).await;
    }

    fn now(&self) -> u64 {
        self.wire.now()
    }
}

/// ETG.1500, feature 103, and ETG.1000.4, AL control: a device with device emulation (0x0140 bit 8)
/// copies AL control into AL status and must not receive the acknowledge bit. ETG.1000.6, 6.4: every
/// other device leaves an error only after the acknowledgement.
#[test]
fn only_devices_without_device_emulation_receive_an_acknowledgement() {
    let written = std::thread::spawn(|| {
        Clock::Virtual.enter();
        let terminals = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/terminals.toml");
        let machine = config::load(&terminals).expect("a machine");
        let mut link = SimLink::new(simulated_bus(&machine, 1, None, None).expect("a bus"));
        let never = CancelToken::default();
        let done = run_on_link(&mut link, Clock::Virtual, &never, async |wire| {
            let found = addressed(&wire).await;
            let mut written = Vec::new();
            // The coupler emulates its device; the drive refuses SafeOp in Init with an error.
            let last = found.len() - 1;
            for (position, control) in [(0, 0x14), (last, 0x04)] {
                let device = found[position].named("a device");
                let control = [control, 0];
                wire.write(device.station, 0x0120, &control)
                    .await
                    .expect("written");
                wire.delay(Duration::from_millis(2)).await;
                let status = al::read_status(&wire, device.station).await.expect("read");
                assert!(status.is_some_and(|(status, _)| status & 0x10 != 0));
                let controls = Controls {
                    wire: &wire,
                    written: Default::default(),
                };
                let second = Duration::from_secs(1);
                al::change_state(&controls, &[device], AlState::Init, second)
                    .await
                    .expect("Init");
                written.push(controls.written.into_inner());
            }
            written
        });
        done.expect("carried")
    });
    let written = written.join().expect("no panic");
    assert_eq!(written, [vec![0x01], vec![0x11, 0x01]]);
}
