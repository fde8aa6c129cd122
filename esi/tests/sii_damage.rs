//! Damaged EEPROM images: an error or a warning names offset and category, and nothing panics.

use crate::common;
use ecaxis_esi::parse;
use ecaxis_esi::sii::{self, SiiOptions};

const STRINGS: u16 = 10;
const GENERAL: u16 = 30;
const FMMU: u16 = 40;
const SYNC_MANAGER: u16 = 41;
const TX_PDO: u16 = 50;
const RX_PDO: u16 = 51;
const DC: u16 = 60;

/// Returns the image of a drive.
fn whole() -> Vec<u8> {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../configs/esi/EPOS4.xml");
    let file = parse(&std::fs::read(path).unwrap()).unwrap();
    sii::emit(&file.devices[0], &file.modules, &SiiOptions::default())
}

fn word(image: &[u8], at: usize) -> u16 {
    u16::from_le_bytes([image[at], image[at + 1]])
}

fn put(image: &mut [u8], at: usize, value: u16) {
    image[at..at + 2].copy_from_slice(&value.to_le_bytes());
}

/// Returns the offset of a category's header; 0xffff is the end mark.
fn head(image: &[u8], kind: u16) -> usize {
    let mut at = 0x80;
    while word(image, at) != kind {
        at += 4 + 2 * usize::from(word(image, at + 2));
    }
    at
}

/// Returns the offset of a category's data.
fn data(image: &[u8], kind: u16) -> usize {
    head(image, kind) + 4
}

fn insert(image: &mut Vec<u8>, at: usize, bytes: &[u8]) {
    image.splice(at..at, bytes.iter().copied());
}

/// The damage, its implementation, and a part of the message.
type Case = (&'static str, fn(&mut Vec<u8>), &'static str);

const CASES: &[Case] = &[
    ("nothing left", |i| i.clear(), "the image has 0 bytes"),
    (
        "half a header",
        |i| i.truncate(64),
        "the image has 64 bytes",
    ),
    (
        "one byte short of a header",
        |i| i.truncate(127),
        "the image has 127 bytes",
    ),
    (
        "header only",
        |i| i.truncate(128),
        "byte 0x80: the image stops without an end mark",
    ),
    (
        "half a category type",
        |i| i.truncate(129),
        "byte 0x81: the image stops",
    ),
    (
        "category type without length",
        |i| i.truncate(130),
        "byte 0x82: the image stops",
    ),
    (
        "cut in the texts",
        |i| i.truncate(0x90),
        "byte 0x80, category 10: the category claims",
    ),
    (
        "cut in the PDOs",
        |i| i.truncate(data(i, RX_PDO) + 9),
        "category 51: the category claims",
    ),
    (
        "cut before the end mark",
        |i| i.truncate(head(i, 0xffff)),
        "the image stops without an end mark",
    ),
    ("checksum", |i| i[14] ^= 0x55, "byte 0xe: the checksum is"),
    ("configuration", |i| i[2] ^= 1, "byte 0xe: the checksum is"),
    (
        "nothing but ones",
        |i| i.fill(0xff),
        "byte 0xe: the checksum is 0xff",
    ),
    (
        "nothing but zeros",
        |i| i.fill(0),
        "the image stops without an end mark",
    ),
    (
        "ones behind the header",
        |i| i[0x80..0x100].fill(0xff),
        "byte 0x80: there are no categories",
    ),
    (
        "a category to the end of the world",
        |i| {
            let at = head(i, GENERAL);
            put(i, at + 2, 0xffff);
        },
        "category 30: the category claims 131070 bytes",
    ),
    (
        "a category one word beyond the end",
        |i| {
            let at = head(i, DC);
            let left = (i.len() - at - 4) / 2;
            put(i, at + 2, u16::try_from(left + 1).unwrap());
        },
        "category 60: the category claims",
    ),
    (
        "an empty category that never ends",
        |i| {
            let at = head(i, STRINGS);
            i.truncate(at);
            i.extend([0, 0, 0, 0].repeat(16_000));
        },
        "the image stops without an end mark",
    ),
    (
        "the texts again and again",
        |i| {
            let texts = i[head(i, STRINGS)..head(i, GENERAL)].to_vec();
            for _ in 0..300 {
                insert(i, 0x80, &texts);
            }
        },
        "category 10: the category is there a second time",
    ),
    (
        "general twice",
        |i| {
            let at = head(i, GENERAL);
            let again = i[at..at + 36].to_vec();
            insert(i, at, &again);
        },
        "category 30: the category is there a second time",
    ),
    (
        "name that does not exist",
        |i| {
            let at = data(i, GENERAL);
            i[at + 3] = 0xfe;
        },
        "category 30: text 254 is named",
    ),
    (
        "PDO name that does not exist",
        |i| {
            let at = data(i, TX_PDO);
            i[at + 5] = 0xfd;
        },
        "category 50: text 253 is named",
    ),
    (
        "entry name that does not exist",
        |i| {
            let at = data(i, RX_PDO);
            i[at + 8 + 3] = 0xfc;
        },
        "category 51: text 252 is named",
    ),
    (
        "DC name that does not exist",
        |i| {
            let at = data(i, DC);
            i[at + 18] = 0xfb;
        },
        "category 60: text 251 is named",
    ),
    (
        "no texts, all named",
        |i| {
            let at = data(i, STRINGS);
            i[at] = 0;
        },
        "is named, there are 0",
    ),
    (
        "more texts than there are",
        |i| {
            let at = data(i, STRINGS);
            i[at] = 0xff;
        },
        "category 10: the category claims 255 texts and holds",
    ),
    (
        "a text longer than the category",
        |i| {
            let at = data(i, STRINGS);
            i[at + 1] = 0xff;
        },
        "category 10: the category claims",
    ),
    (
        "more entries than there are",
        |i| {
            let at = data(i, RX_PDO);
            i[at + 2] = 0xff;
        },
        "claims 255 entries, more than the category holds",
    ),
    (
        "half a PDO",
        |i| {
            let at = head(i, TX_PDO);
            let n = word(i, at + 2);
            put(i, at + 2, n + 2);
            insert(i, at + 4 + 2 * usize::from(n), &[1, 0x1a, 0, 3]);
        },
        "category 50: 4 bytes are left over, records have 8",
    ),
    (
        "half a SyncManager",
        |i| {
            let at = head(i, SYNC_MANAGER);
            let n = word(i, at + 2);
            put(i, at + 2, n + 1);
            insert(i, at + 4 + 2 * usize::from(n), &[0, 0x10]);
        },
        "category 41: 2 bytes are left over, records have 8",
    ),
    (
        "half a DC mode",
        |i| {
            let at = head(i, DC);
            let n = word(i, at + 2);
            put(i, at + 2, n + 1);
            insert(i, at + 4 + 2 * usize::from(n), &[0, 0]);
        },
        "category 60: 2 bytes are left over, records have 24",
    ),
    (
        "a SyncManager of no type",
        |i| {
            let at = data(i, SYNC_MANAGER);
            i[at + 7] = 9;
        },
        "category 41: 9 is not a defined SyncManager type",
    ),
    (
        "an FMMU of no use",
        |i| {
            let at = data(i, FMMU);
            i[at] = 0x42;
        },
        "category 40: 66 is not a defined use of an FMMU",
    ),
    (
        "every PDO byte ones",
        |i| {
            let at = head(i, RX_PDO);
            let n = usize::from(word(i, at + 2));
            i[at + 4..at + 4 + 2 * n].fill(0xff);
        },
        "PDO 0xffff claims 255 entries",
    ),
];

/// Word 0x3E: the size of the EEPROM in KiBit minus one (ETG.1000.6, table 16).
fn set_size(image: &mut [u8], bytes: usize) {
    put(image, 0x7c, u16::try_from(bytes / 128 - 1).unwrap());
}

/// Without an end mark, the list of categories ends at the size in word 0x3E. An image
/// whose size word is too small has an end mark.
#[test]
fn size_word_bounds_a_list_without_end_mark() {
    let _alone = crate::measure();
    let whole = whole();
    let expected = sii::parse(&whole).unwrap();
    let end = head(&whole, 0xffff);
    let size = end.next_multiple_of(128);
    let mut image = whole[..size].to_vec();
    image[end..].fill(0);
    set_size(&mut image, size);
    // The remains of another image behind the size.
    image.extend(
        [SYNC_MANAGER, 4, 1, 2, 3, 4, 60, 0x4000]
            .map(u16::to_le_bytes)
            .concat(),
    );
    let sii = sii::parse(&image).unwrap();
    assert_eq!(sii.sync_managers, expected.sync_managers);
    assert_eq!((&sii.damage, sii.ended), (&Vec::new(), false));
    // A size that is too small, as some vendors have it.
    let mut image = whole;
    set_size(&mut image, 256);
    let sii = sii::parse(&image).unwrap();
    assert_eq!((&sii.rx_pdos, sii.ended), (&expected.rx_pdos, true));
}

fn said(image: &[u8]) -> Vec<String> {
    match sii::inspect(image) {
        Ok((_, warnings)) => warnings.iter().map(ToString::to_string).collect(),
        Err(error) => vec![error.to_string()],
    }
}

#[test]
fn damage_is_reported_with_its_position() {
    let _alone = crate::measure();
    assert_eq!(said(&whole()), Vec::<String>::new());
    for (what, damage, expected) in CASES {
        let mut image = whole();
        damage(&mut image);
        let said = said(&image);
        println!("{what}: {}", said.first().map_or("", String::as_str));
        assert!(said.len() <= 100, "{what}");
        assert!(
            said.iter().any(|line| line.contains(expected)),
            "{what}: {said:?} lacks {expected:?}"
        );
        assert_eq!(
            sii::parse(&image).ok(),
            sii::inspect(&image).ok().map(|(sii, _)| sii)
        );
    }
    assert!(CASES.len() >= 30);
}

/// Checks every cut and every wrong byte.
#[test]
fn parse_never_panics_on_cuts_and_wrong_bytes() {
    let _alone = crate::measure();
    let image = whole();
    let used = head(&image, 0xffff) + 2;
    for end in 0..used {
        let cut = said(&image[..end]);
        assert!(!cut.is_empty(), "cut at {end}");
    }
    for at in 0..used {
        for value in [0, 1, 0x7f, 0x80, 0xff] {
            let mut image = image.clone();
            image[at] = value;
            let _ = said(&image);
        }
    }
}

/// Reading takes at most a few times the image's length in memory, for any lengths and counts in
/// the image.
#[test]
fn parse_needs_bounded_memory_for_any_counts() {
    const LIMIT: usize = 64 << 20;
    let _alone = crate::measure();
    let mut long = whole();
    let end = head(&long, 0xffff);
    long.truncate(end);
    // An image of maximum size, full of categories with maximum counts.
    for kind in (1..=DC).cycle() {
        if long.len() + 4 + 2 * 0xff > 512 << 10 {
            break;
        }
        long.extend(kind.to_le_bytes());
        long.extend(0xff_u16.to_le_bytes());
        long.extend([0xff; 2 * 0xff]);
    }
    long.extend([0xff, 0xff]);
    crate::reset();
    let _ = said(&long);
    let mut image = whole();
    for at in (0x80..image.len() - 1).step_by(2) {
        let before = word(&image, at);
        put(&mut image, at, 0xfffe);
        let _ = said(&image);
        put(&mut image, at, before);
    }
    assert!(crate::peak() < LIMIT, "{} bytes", crate::peak());
}

/// ETG.2010 lists each category once; of two, SOEM and ethercrab use the first as well. PDOs may be
/// spread over several categories 50 and 51: IgH appends them.
#[test]
fn the_first_of_equal_categories_counts_and_pdo_categories_add_up() {
    let good = sii::parse(&whole()).unwrap();
    for kind in [STRINGS, GENERAL, FMMU, SYNC_MANAGER, DC] {
        let mut image = whole();
        let (at, end) = (head(&image, kind), head(&image, 0xffff));
        let length = 4 + 2 * usize::from(word(&image, at + 2));
        let mut again = image[at..at + length].to_vec();
        again[4..].fill(0);
        insert(&mut image, end, &again);
        let (sii, warnings) = sii::inspect(&image).unwrap();
        assert_eq!(sii, good, "category {kind}");
        let text = warnings.iter().map(ToString::to_string);
        assert_eq!(
            text.filter(|w| w.contains("the first counts")).count(),
            1,
            "category {kind}"
        );
    }
    let mut image = whole();
    let (at, end) = (head(&image, TX_PDO), head(&image, 0xffff));
    let length = 4 + 2 * usize::from(word(&image, at + 2));
    let mut again = image[at..at + length].to_vec();
    // The first PDO of the second category is another one; the rest is there already.
    again[4] ^= 0x80;
    insert(&mut image, end, &again);
    let (sii, warnings) = sii::inspect(&image).unwrap();
    assert_eq!(sii.tx_pdos.len(), good.tx_pdos.len() + 1);
    assert_eq!(sii.tx_pdos[..good.tx_pdos.len()], good.tx_pdos);
    assert_eq!(warnings.len(), 1);
    assert!(warnings[0].to_string().contains("the first counts"));
}

/// ETG.1000.6 and ETG.2010: the identity is in words 8 to 15, before all categories.
#[test]
fn a_damaged_category_keeps_the_identity_and_earlier_categories() {
    let good = sii::parse(&whole()).unwrap();
    let mut image = whole();
    let at = head(&image, DC);
    put(&mut image, at + 2, 0xffff);
    let sii = sii::parse(&image).unwrap();
    assert_eq!(
        (sii.identity, sii.general, sii.sync_managers),
        (
            good.identity,
            good.general.clone(),
            good.sync_managers.clone()
        )
    );
    assert_eq!((&sii.rx_pdos, sii.dc.len()), (&good.rx_pdos, 0));
    assert_eq!(sii.damage.len(), 1);
    assert!(!sii.ended);

    // The last PDO of a category: the others and later categories remain.
    let mut image = whole();
    let mut last = data(&image, TX_PDO);
    for pdo in good.tx_pdos.iter().take(good.tx_pdos.len() - 1) {
        last += 8 + 8 * pdo.entries.len();
    }
    image[last + 2] = 0xff;
    let sii = sii::parse(&image).unwrap();
    assert_eq!(sii.tx_pdos, good.tx_pdos[..good.tx_pdos.len() - 1]);
    assert_eq!((sii.rx_pdos, sii.dc), (good.rx_pdos, good.dc));
    assert_eq!((sii.damage.len(), sii.ended), (1, true));
}

/// Word 0x3E is the size in KiBit minus one. A chip ignores upper address bits, so that a read
/// beyond its end returns its beginning (Atmel AT24C16 data sheet, "Device addressing").
#[test]
fn categories_end_with_the_chip_and_a_wrong_size_word_is_reported() {
    let mut image = whole();
    let end = head(&image, 0xffff);
    image.truncate(2048);
    // Instead of the end mark, one category up to the end of the chip.
    put(&mut image, end, 0x0900);
    put(
        &mut image,
        end + 2,
        u16::try_from((2048 - end - 4) / 2).unwrap(),
    );
    put(&mut image, 0x7c, 15);
    let once = sii::parse(&image).unwrap();
    let mut read = image.repeat(4);
    assert_eq!(sii::chip_length(&read), 2048);
    assert_eq!(sii::parse(&read).unwrap(), once);
    assert!(!once.ended && once.damage.is_empty());
    // The last category exceeds the chip.
    put(&mut read, end + 2, u16::try_from((2048 - end) / 2).unwrap());
    let damage = sii::parse(&read).unwrap().damage;
    assert_eq!(damage.len(), 1, "{damage:?}");

    let mut image = whole();
    put(&mut image, 0x7c, 1);
    let (sii, warnings) = sii::inspect(&image).unwrap();
    assert_eq!(sii.rx_pdos, sii::parse(&whole()).unwrap().rx_pdos);
    let text: Vec<String> = warnings.iter().map(ToString::to_string).collect();
    assert_eq!(text.len(), 1, "{text:?}");
    assert!(text[0].contains("the size in word 0x3E is 256 bytes"));
    // Zeros beyond the size are not categories.
    let end = head(&image, 0xffff);
    image[end..].fill(0);
    assert_eq!(sii::parse(&image).unwrap().others, sii.others);
}

#[test]
fn emitted_images_have_no_warnings() {
    let _alone = crate::measure();
    for path in common::files("esi", &["xml"]) {
        let file = parse(&std::fs::read(&path).unwrap()).unwrap();
        for device in &file.devices {
            let image = sii::emit(device, &file.modules, &SiiOptions::default());
            assert_eq!(said(&image), Vec::<String>::new(), "{}", device.name);
        }
    }
}

/// A warning about values that real devices contain would be a false alarm.
#[test]
fn recorded_images_have_one_warning() {
    let _alone = crate::measure();
    let mut odd = Vec::new();
    for path in common::files("sii", &["bin", "hex", "sii"]) {
        let bytes = std::fs::read(&path).unwrap();
        if bytes.first() == Some(&b':') {
            continue; // Intel HEX; the .bin file contains the same bytes.
        }
        let name = path.file_name().unwrap().to_string_lossy();
        odd.extend(said(&bytes).iter().map(|line| format!("{name}: {line}")));
    }
    if common::fixtures().is_some() {
        let expected =
            "xmc4300_sii_eeprom.bin: byte 0x11c, category 60: text 6 is named, there are 2";
        assert_eq!(odd, [expected]);
    }
}
