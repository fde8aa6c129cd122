//! The EEPROM before and after a command, and its backup.

use std::thread;

use ecaxis_master::acyclic::AlState;
use ecaxis_master::cancel::CancelToken;
use ecaxis_master::clock::Clock;
use ecaxis_master::config::{self, Locator, Nic};
use ecaxis_master::link::sim::SimLink;
use ecaxis_master::mailbox::MailboxTransport;
use ecaxis_master::session::run_on_link;
use ecaxis_sim::{DeviceOptions, Segment, SegmentOptions, SimDevice};

use super::*;

/// The EEPROM size in bytes in these tests.
const CHIP: usize = 2048;

/// Runs a command on a drive with this EEPROM image. Returns the EEPROM afterwards. It needs a
/// separate thread, because virtual time is thread-local.
fn with_eeprom_of<T: Send + 'static>(
    image: Vec<u8>,
    work: impl AsyncFnOnce(&mut OpenDevice) -> T + Send + 'static,
) -> (T, Vec<u8>) {
    let there = thread::Builder::new().stack_size(16 << 20).spawn(move || {
        Clock::Virtual.enter();
        let demo = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/demo.toml");
        let machine = config::load(&demo).expect("a machine");
        let config = machine.devices.first().expect("a device");
        let options = DeviceOptions {
            sii: Some(image),
            ..DeviceOptions::default()
        };
        let device = SimDevice::from_esi(&config.device, &config.esi.modules, options);
        let devices = vec![device.expect("a device")];
        let mut link = SimLink::new(Segment::new(devices, SegmentOptions::default()));
        let stop = CancelToken::default();
        let done = run_on_link(&mut link, Clock::Virtual, &stop, async |wire| {
            let at = OpenDevice::find(wire, Locator::Position(0), None, Nic::Sim).await;
            work(&mut at.expect("located")).await
        });
        let device = link.segment().device(0).expect("a device");
        (done.expect("carried"), device.sii().to_vec())
    });
    there.expect("a thread").join().expect("no panic")
}

/// The image of the demonstration drive, padded to the size of the chip.
fn good() -> Vec<u8> {
    let demo = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/demo.toml");
    let machine = config::load(&demo).expect("a machine");
    let config = machine.devices.first().expect("a device");
    let sii = Sii::from_device(
        &config.device,
        &config.esi.modules,
        &sii::SiiOptions::default(),
    );
    let mut image = sii.to_bytes();
    image.resize(CHIP, 0xff);
    image[0x7c..0x7e].copy_from_slice(&15_u16.to_le_bytes());
    image
}

fn keeps(path: PathBuf) -> BackupOptions {
    BackupOptions {
        yes: true,
        backup: Some(path),
    }
}

#[test]
fn backup_contains_bytes_after_the_end_of_the_image() {
    let folder = tempfile::tempdir().expect("a folder");
    let kept = folder.path().join("kept.bin");
    let mut there = good();
    there[1500..1504].copy_from_slice(b"own.");
    let mut new = good();
    new[0x1c] ^= 1;
    let (before, care, wanted) = (there.clone(), keeps(kept.clone()), new.clone());
    let (done, after) = with_eeprom_of(there, async move |at| {
        let old = image(at, false).await.expect("an image");
        assert!(old.len() < 1500, "{}", old.len());
        burn(at, &care, &old, &wanted).await
    });
    // The serial number, and two words after the end of the old image.
    let done = done.expect("written");
    assert!(done.contains("3 words written"), "{done}");
    assert_eq!(after, new);
    assert_eq!(std::fs::read(kept).expect("kept"), before);
}

#[test]
fn image_with_small_size_word_is_read_and_repaired() {
    for said in [0_u16, 1] {
        let folder = tempfile::tempdir().expect("a folder");
        let kept = folder.path().join("kept.bin");
        let mut there = good();
        there[0x7c..0x7e].copy_from_slice(&said.to_le_bytes());
        let new = good();
        let (care, wanted) = (keeps(kept), new.clone());
        let (done, after) = with_eeprom_of(there, async move |at| {
            let old = image(at, false).await.expect("an image");
            let all = image(at, true).await.expect("all of it");
            assert!(all.starts_with(&old));
            (sii::parse(&old), burn(at, &care, &old, &wanted).await)
        });
        let (old, done) = done;
        let old = old.expect("an image");
        assert!(old.ended && !old.sync_managers.is_empty());
        let done = done.expect("written");
        assert!(done.contains("1 word written"), "{done}");
        assert_eq!(after, new);
    }
}

#[test]
fn image_larger_than_the_chip_is_not_written() {
    let folder = tempfile::tempdir().expect("a folder");
    let kept = folder.path().join("kept.bin");
    let mut new = good();
    new.resize(2 * CHIP, 0x5a);
    new[0x7c..0x7e].copy_from_slice(&31_u16.to_le_bytes());
    let (care, shown) = (keeps(kept.clone()), kept.display().to_string());
    let (failure, after) = with_eeprom_of(good(), async move |at| {
        let old = image(at, false).await.expect("an image");
        burn(at, &care, &old, &new).await.expect_err("no room")
    });
    assert_eq!(after, good());
    assert_eq!(failure.code, hints::FAILED);
    let message = &failure.message;
    let reported = format!("holds 2048 bytes; nothing was written; the old image is in {shown}");
    assert!(message.ends_with(&reported), "{message}");
    assert!(kept.exists());
}

#[test]
fn cancelled_write_reports_that_nothing_was_written() {
    let folder = tempfile::tempdir().expect("a folder");
    let kept = folder.path().join("kept.bin");
    let mut new = good();
    new[0x1c] ^= 1;
    let care = keeps(kept.clone());
    let (failure, after) = with_eeprom_of(good(), async move |at| {
        let old = image(at, false).await.expect("an image");
        at.wire.stop().cancel();
        burn(at, &care, &old, &new).await.expect_err("ended")
    });
    let reported = "writing its EEPROM: interrupted; nothing was written";
    assert!(failure.message.ends_with(reported), "{failure:?}");
    assert!(!failure.hints.is_empty() && !kept.exists());
    assert_eq!(after, good());
}

#[test]
fn sound_rejects_zeros_of_any_length() {
    let (read, _) = with_eeprom_of(vec![0; CHIP], async |at| image(at, false).await);
    assert!(read.expect("read").len() < 0x100);
}

#[test]
fn at_rest_accepts_only_init_and_preop() {
    let (allowed, _) = with_eeprom_of(good(), async |at| {
        let states = [
            (AlState::Init, true),
            (AlState::PreOp, true),
            (AlState::Bootstrap, false),
            (AlState::SafeOp, false),
            (AlState::Op, false),
        ];
        states.map(|(state, good)| {
            at.state = state;
            (at.at_rest("parameters are reset"), state, good)
        })
    });
    for (allowed, state, good) in allowed {
        assert_eq!(allowed.is_ok(), good, "{state}");
        if let Err(failure) = allowed {
            let reported = format!("is in {state}: parameters are reset in PreOp");
            assert_eq!(failure.code, hints::FAILED);
            assert!(failure.message.ends_with(&reported), "{failure:?}");
            assert!(!failure.hints.is_empty());
        }
    }
}
