//! A segment taken as it is found, in virtual time.

use std::path::Path;
use std::sync::atomic::AtomicBool;

use ecaxis_esi::sii;

use super::eeprom::{Claim, Eeprom, EepromError};
use super::station::{Found, Which, address, census};
use super::{Datagrams, ServiceError, carry, mailbox};
use crate::bringup::AlState;
use crate::clock::Clock;
use crate::config;
use crate::link::sim::SimLink;
use crate::mailbox::Wire;
use crate::session::{RunError, simulated_bus};

/// Two drives, and what is done with them.
fn with_drives<T: Send + 'static>(
    work: impl AsyncFnOnce(Datagrams) -> T + Send + 'static,
) -> (T, SimLink) {
    let there = std::thread::Builder::new().stack_size(super::STACK);
    let done = there.spawn(move || {
        Clock::Virtual.enter();
        let demo = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/demo.toml");
        let machine = config::load(&demo).expect("a machine");
        let mut link = SimLink::new(simulated_bus(&machine, 1, None, None).expect("a bus"));
        let done = carry(&mut link, Clock::Virtual, &AtomicBool::new(false), work);
        (done.expect("carried"), link)
    });
    done.expect("a thread").join().expect("no panic")
}

async fn addressed(wire: &Datagrams) -> Vec<Found> {
    let mut found = census(wire).await.expect("a census");
    address(wire, &mut found).await.expect("addresses");
    found
}

#[test]
fn everybody_gets_an_address_and_keeps_it() {
    let ((first, second), _) = with_drives(async |wire| {
        let before = census(&wire).await.expect("a census");
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
fn two_with_one_address_both_get_another() {
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

#[test]
fn an_eeprom_is_read_as_it_is() {
    let (read, link) = with_drives(async |wire| {
        let found = addressed(&wire).await;
        let device = found[1].named("y");
        let eeprom = Eeprom::claim(&wire, &device, "reading", Claim::IfFree)
            .await
            .expect("free");
        let mut told = Vec::new();
        let image = eeprom
            .image(&mut |at, of| told.push((at, of)))
            .await
            .expect("read");
        assert!(told.iter().all(|(at, of)| at <= of), "{told:?}");
        let all = eeprom.all(&mut |_, _| {}).await.expect("read");
        eeprom.give_back().await.expect("given back");
        (image, all)
    });
    let (image, all) = read;
    let there = link.segment().device(1).expect("a device").sii().to_vec();
    assert_eq!(all.get(..there.len()), Some(&there[..]));
    assert_eq!(there.get(..image.len()), Some(&image[..]));
    assert_eq!(sii::parse(&image), sii::parse(&there));
    assert!(sii::parse(&image).expect("an image").ended);
}

#[test]
fn a_word_is_written() {
    let (word, _) = with_drives(async |wire| {
        let found = addressed(&wire).await;
        let device = found[0].named("x");
        let eeprom = Eeprom::claim(&wire, &device, "writing", Claim::IfFree)
            .await
            .expect("free");
        eeprom.write(4, [0x34, 0x12]).await.expect("written");
        let mut word = [0; 2];
        eeprom.read(4, &mut word).await.expect("read");
        word
    });
    assert_eq!(word, [0x34, 0x12]);
}

#[test]
fn what_is_lent_to_the_device_is_taken_by_force_alone_and_given_back() {
    let (access, _) = with_drives(async |wire| {
        let found = addressed(&wire).await;
        let device = found[0].named("x");
        wire.write(device.station, 0x0500, &[1])
            .await
            .expect("written");
        let refused = Eeprom::claim(&wire, &device, "reading", Claim::IfFree).await;
        assert!(matches!(
            refused,
            Err(ServiceError::Eeprom {
                source: EepromError::InUse,
                ..
            })
        ));
        let eeprom = Eeprom::claim(&wire, &device, "reading", Claim::Force)
            .await
            .expect("taken");
        let mut vendor = [0; 4];
        eeprom.read(8, &mut vendor).await.expect("read");
        assert_ne!(vendor, [0; 4]);
        eeprom.give_back().await.expect("given back");
        let mut access = [0; 1];
        wire.read(device.station, 0x0500, &mut access)
            .await
            .expect("read");
        access
    });
    assert_eq!(access, [1]);
}

#[test]
fn a_mailbox_in_init_is_opened_and_closed_again() {
    let (done, link) = with_drives(async |wire| {
        let found = addressed(&wire).await;
        let device = found[0].named("x");
        let eeprom = Eeprom::claim(&wire, &device, "reading", Claim::IfFree)
            .await
            .expect("free");
        let image = eeprom.image(&mut |_, _| {}).await.expect("read");
        let sii = sii::parse(&image).expect("an image");
        let mut lent = mailbox::lend(&wire, &device, &sii).await.expect("lent");
        let vendor = lent
            .coe
            .upload(&wire, 0x1018, 1, false)
            .await
            .expect("read");
        // A second one is used as it is set up, and leaves the state alone.
        let mut again = mailbox::lend(&wire, &device, &sii).await.expect("lent");
        assert_eq!(again.found, AlState::PreOp);
        assert_eq!(again.coe.layout(), lent.coe.layout());
        let same = again
            .coe
            .upload(&wire, 0x1018, 1, false)
            .await
            .expect("read");
        again.give_back(&wire).await.expect("given back");
        lent.give_back(&wire).await.expect("given back");
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
fn who_is_meant() {
    let found: Vec<Found> = [(0, 5), (1, 0), (2, 5)]
        .map(|(position, alias)| Found {
            position,
            station: 0x1000 + position,
            alias,
            state: AlState::Init,
            error: false,
            code: 0,
        })
        .into();
    let position = |which: Which| {
        which
            .among(&found)
            .map(|f| f.position)
            .map_err(|e| e.to_string())
    };
    assert_eq!(position(Which::Position(2)), Ok(2));
    assert_eq!(position(Which::Station(0x1001)), Ok(1));
    assert_eq!(
        position(Which::Position(3)),
        Err("no SubDevice has position 3; 3 answer, at positions 0 to 2".to_owned())
    );
    assert_eq!(
        position(Which::Alias(7)),
        Err("no SubDevice has alias 7; their aliases are 5, 0, 5".to_owned())
    );
    assert_eq!(
        position(Which::Alias(5)),
        Err("2 SubDevices have alias 5: at positions 0, 2".to_owned())
    );
}

#[test]
fn the_user_ends_it() {
    std::thread::spawn(|| {
        Clock::Virtual.enter();
        let demo = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/demo.toml");
        let machine = config::load(&demo).expect("a machine");
        let mut link = SimLink::new(simulated_bus(&machine, 1, None, None).expect("a bus"));
        let stop = AtomicBool::new(true);
        let done = carry(&mut link, Clock::Virtual, &stop, async |wire| {
            census(&wire).await
        });
        assert!(matches!(done, Err(RunError::Interrupted)));
    })
    .join()
    .expect("no panic");
}
