//! An EDS, with what is missing or damaged in it.

use super::*;
use proptest::prelude::*;

const EDS: &str = "\
; a drive
[DeviceInfo]
VendorName=any: #1
VendorNumber=0xfb
[6040]
PDOMapping=1
[6041]
PDOMapping=1
[2062]
PDOMapping=1
[6081]
PDOMapping=0
[1600]
SubNumber=3
[1600sub0]
DefaultValue=2
[1600sub1]
DefaultValue=0x60400010
[1600Sub2]
DefaultValue=0x20620020
[1602sub0]
DefaultValue=3
[1602sub1]
DefaultValue=0x60400010
[1602sub2]
DefaultValue=0x60600008
[1602sub3]
DefaultValue=0x60810020
";

fn link(pdo: u8, contents: &[(u16, u8, u8)]) -> PdoLink {
    PdoLink {
        pdo,
        at: 2,
        contents: contents.to_vec(),
        synchronous: true,
    }
}

#[test]
fn contents_of_the_drive_are_filled_in() {
    let eds = Eds::parse(EDS).unwrap();
    let mut first = link(1, &[]);
    eds.complete(&mut first, 0x1600).unwrap();
    assert_eq!(first.contents, [(0x6040, 0, 16), (0x2062, 0, 32)]);
    // The file's own contents stay, and a PDO that the EDS does not have.
    let mut own = link(1, &[(0x6041, 0, 16)]);
    eds.complete(&mut own, 0x1600).unwrap();
    assert_eq!(own.contents, [(0x6041, 0, 16)]);
    let mut second = link(2, &[]);
    eds.complete(&mut second, 0x1600).unwrap();
    assert_eq!(second.contents, []);
}

#[test]
fn objects_that_the_drive_cannot_map_are_refused() {
    let eds = Eds::parse(EDS).unwrap();
    for (mut link, expected) in [
        (
            link(1, &[(0x6081, 0, 32)]),
            "its PDOs cannot carry 0x6081:00",
        ),
        (link(1, &[(0x607a, 0, 32)]), "it has no object 0x607a:00"),
        (link(3, &[]), "its PDO 3 carries 0x6081:00 as well"),
    ] {
        assert_eq!(eds.complete(&mut link, 0x1600), Err(expected.to_owned()));
    }
}

#[test]
fn other_files_are_refused() {
    for text in [
        "",
        "[DeviceInfo]\n",
        "<EtherCATInfo/>",
        "[DeviceInfo]\nVendorNumber=maxon\n",
    ] {
        assert!(Eds::parse(text).is_err(), "{text}");
    }
}

proptest! {
    /// Damaged files never panic.
    #[test]
    fn damaged_files_are_read_or_refused(
        changes in prop::collection::vec((0..EDS.len(), any::<u8>()), 0..8),
        end in 0..EDS.len(),
    ) {
        let mut bytes = EDS.as_bytes().to_vec();
        for (at, byte) in changes {
            bytes[at] = byte;
        }
        bytes.truncate(end);
        if let Ok(eds) = Eds::parse(&String::from_utf8_lossy(&bytes)) {
            for pdo in 0..=255 {
                let _ = eds.complete(&mut link(pdo, &[]), 0x1600);
            }
        }
    }
}
