//! Access to EEPROMs and writing them.

use super::*;

#[test]
fn eeprom_reads_image_and_whole_chip() {
    let (read, link) = with_drives(async |wire| {
        let found = addressed(&wire).await;
        let device = found[1].named("y");
        let eeprom = Eeprom::claim(&wire, &device, "reading", EepromAccess::IfFree)
            .await
            .expect("free");
        let mut reported = Vec::new();
        let image = eeprom
            .image(&mut |at, of| reported.push((at, of)))
            .await
            .expect("read");
        assert!(reported.iter().all(|(at, of)| at <= of), "{reported:?}");
        let all = eeprom.all(&mut |_, _| {}).await.expect("read");
        eeprom.release().await.expect("given back");
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
fn eeprom_writes_a_word() {
    let (word, _) = with_drives(async |wire| {
        let found = addressed(&wire).await;
        let device = found[0].named("x");
        let eeprom = Eeprom::claim(&wire, &device, "writing", EepromAccess::IfFree)
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
fn eeprom_of_the_pdi_is_claimed_only_by_force_and_released() {
    let (access, _) = with_drives(async |wire| {
        let found = addressed(&wire).await;
        let device = found[0].named("x");
        wire.write(device.station, 0x0500, &[1])
            .await
            .expect("written");
        let refused = Eeprom::claim(&wire, &device, "reading", EepromAccess::IfFree).await;
        let error = refused.expect_err("in use");
        assert!(matches!(*error.cause, Cause::Eeprom(EepromError::InUse)));
        let eeprom = Eeprom::claim(&wire, &device, "reading", EepromAccess::Force)
            .await
            .expect("taken");
        let mut vendor = [0; 4];
        eeprom.read(8, &mut vendor).await.expect("read");
        assert_ne!(vendor, [0; 4]);
        eeprom.release().await.expect("given back");
        let mut access = [0; 1];
        wire.read(device.station, 0x0500, &mut access)
            .await
            .expect("read");
        access
    });
    assert_eq!(access, [1]);
}

#[test]
fn with_eeprom_restores_access_when_stopped() {
    let (done, left, _) = stopped(1, async |wire, found: EnumeratedDevice, at, stop| {
        let claim = EepromAccess::of(found.state);
        let read = with_eeprom(&wire, &at, "reading its EEPROM", claim, async |eeprom| {
            let mut reported = 0;
            let mut progress = |_, _| {
                reported += 1;
                if reported == 3 {
                    stop.cancel();
                }
            };
            eeprom.image(&mut progress).await
        });
        read.await
    });
    let error = done.expect("a report").expect_err("ended");
    assert!(error.is_interruption(), "{error}");
    assert!(
        error
            .to_string()
            .contains("reading its EEPROM: interrupted")
    );
    assert_eq!(left, ("Init".to_owned(), 1));
}

/// Returns the first drive's image with ten changed words in a reserved area.
fn changed(there: &[u8]) -> Vec<u8> {
    let mut image = there.to_vec();
    for byte in &mut image[0x50..0x64] {
        *byte ^= 0x5a;
    }
    image
}

#[test]
fn eeprom_write_completes_after_its_first_word() {
    // Ten words; after the first written word, `stop` has no effect.
    for stop_at in [0, 5] {
        let (done, left, sii) = stopped(1, async move |wire, found: EnumeratedDevice, at, stop| {
            let claim = EepromAccess::of(found.state);
            let written = with_eeprom(&wire, &at, "writing its EEPROM", claim, async |eeprom| {
                let image = changed(&eeprom.image(&mut |_, _| {}).await?);
                let mut progress = |n, _| {
                    if n == stop_at {
                        stop.cancel();
                    }
                };
                let written = write(eeprom, &image, &mut progress).await;
                Ok::<_, Error>((written.map_err(|e| e.to_string()), image))
            });
            written.await
        });
        let (written, image) = done.expect("a report").expect("written");
        assert_eq!(written, Ok(10), "stopped at {stop_at}");
        assert_eq!(sii[..image.len()], image);
        assert_eq!(left, ("Init".to_owned(), 1));
    }
}

#[test]
fn eeprom_write_error_reports_the_words_written() {
    for (words, reported) in [
        (0, "; nothing was written"),
        (6, "; 6 of 10 words were written"),
    ] {
        let (done, _, _) = stopped(0, async move |wire, _, at, _| {
            // All datagrams from the word after `words` on are lost.
            let (left, is_cut) = (Cell::<usize>::new(words), Cell::new(false));
            let cut = Lossy {
                wire: &wire,
                loses: |register, written: Option<&[u8]>| {
                    if register == 0x0508 && written.is_some() {
                        is_cut.set(is_cut.get() || left.get() == 0);
                        left.set(left.get().saturating_sub(1));
                    }
                    is_cut.get()
                },
            };
            let claim = EepromAccess::IfFree;
            let written = with_eeprom(&cut, &at, "writing its EEPROM", claim, async |eeprom| {
                let image = changed(&eeprom.image(&mut |_, _| {}).await?);
                Ok::<_, Error>(write(eeprom, &image, &mut |_, _| {}).await)
            });
            written.await
        });
        let failed: Result<usize, WriteError> = done.expect("a report").expect("a result");
        let error = failed.expect_err("cut");
        assert_eq!((error.written, error.of), (words, 10));
        let text = error.to_string();
        assert!(
            text.contains("writing its EEPROM") && text.ends_with(reported),
            "{text}"
        );
    }
}

/// A small chip ignores the upper address bits: addresses beyond its end wrap around to its
/// beginning.
#[test]
fn eeprom_write_rejects_an_image_beyond_the_chip() {
    for more in [4, 2048] {
        let (done, _, sii) = stopped(0, async move |wire, _, at, _| {
            let claim = EepromAccess::IfFree;
            let written = with_eeprom(&wire, &at, "writing its EEPROM", claim, async |eeprom| {
                let there = eeprom.all(&mut |_, _| {}).await?;
                let mut image = changed(&there);
                image.resize(there.len() + more, 0x5a);
                Ok::<_, Error>((there, write(eeprom, &image, &mut |_, _| {}).await))
            });
            written.await
        });
        let (there, failed) = done.expect("a report").expect("a result");
        let error = failed.expect_err("no room");
        let smaller = EepromError::Smaller { bytes: there.len() };
        assert!(
            matches!(*error.source.cause, Cause::Eeprom(error) if error == smaller),
            "{error}"
        );
        assert_eq!(error.written, 0);
        assert_eq!(sii, there);
    }
}
