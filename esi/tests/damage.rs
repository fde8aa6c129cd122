//! Any file content yields an error with a position or a usable result. It never causes a panic or
//! unbounded memory use.

use std::path::Path;

use ecaxis_esi::{
    DeviceQuery, EsiError, EsiFile, EsiProblem, Mode, SelectOptions, find_device, parse, select,
    sii,
};
use proptest::prelude::*;

fn own(name: &str) -> String {
    std::fs::read_to_string(
        Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../configs/esi")
            .join(name),
    )
    .unwrap()
}

/// Returns an ESI file with one device that contains `inside`.
fn device(inside: &str) -> String {
    format!(
        "<EtherCATInfo><Vendor><Id>1</Id></Vendor><Descriptions><Devices><Device Physics=\"YY\">\n\
         <Type ProductCode=\"1\" RevisionNo=\"1\">T</Type>{inside}</Device></Devices></Descriptions></EtherCATInfo>"
    )
}

fn refused(text: &str) -> EsiError {
    parse(text.as_bytes()).unwrap_err()
}

/// Derives everything from an accepted file and checks that nothing panics.
fn derive_all(file: &EsiFile) {
    for device in &file.devices {
        for mode in [None, Some(Mode::Csp), Some(Mode::Csv), Some(Mode::Cst)] {
            let _ = select(
                file,
                device,
                &SelectOptions {
                    mode,
                    cycle_ns: 1_000_000,
                    ..SelectOptions::default()
                },
            );
        }
        let image = sii::emit(device, &file.modules, &sii::SiiOptions::default());
        assert!(sii::parse(&image).is_ok());
    }
}

#[test]
fn errors_name_position_path_and_reason() {
    let error = refused(&device(
        "\n<Sm StartAddress=\"#x1000\"/>\n  <Sm StartAddress=\"#x11000\">Inputs</Sm>",
    ));
    assert_eq!((error.position().line, error.position().column), (4, 3));
    assert_eq!(
        error.path(),
        "EtherCATInfo/Descriptions/Devices/Device[1]/Sm[2]"
    );
    assert_eq!(
        error.to_string(),
        "4:3 EtherCATInfo/Descriptions/Devices/Device[1]/Sm[2]: \
         StartAddress \"#x11000\" is not a number that fits (0 to 65535)"
    );
}

#[test]
fn parse_rejects_files_that_are_not_esi() {
    assert!(matches!(refused("").problem(), EsiProblem::Empty));
    assert!(matches!(refused(" \n").problem(), EsiProblem::Empty));
    // Bytes before the first tag make it no tag of a document, whatever follows.
    for text in [
        "plain text",
        "MZ\u{90}<EtherCATInfo/>",
        "\u{1b}[31m<foo>bar</foo>",
    ] {
        let error = refused(text);
        assert!(matches!(error.problem(), EsiProblem::NotXml), "{text:?}");
        assert!(!error.to_string().contains(char::is_control), "{text:?}");
    }
    assert!(matches!(
        refused("<EtherCATConfig/>").problem(),
        EsiProblem::NotEsi(_)
    ));
    assert!(matches!(
        refused("<EtherCATInfo/>").problem(),
        EsiProblem::Missing { what: "Vendor" }
    ));
    assert!(matches!(
        refused("<EtherCATInfo><Vendor>").problem(),
        EsiProblem::Truncated(_)
    ));
    assert!(matches!(
        refused("<EtherCATInfo></Vendor>").problem(),
        EsiProblem::Syntax(_)
    ));
    assert!(parse(&[0xff, 0xfe, 0x3c]).is_err());
    assert!(parse(&[0; 64]).is_err());
}

#[test]
fn parse_rejects_elements_without_layout_data() {
    for (inside, part) in [
        (
            "<RxPdo><Entry><Index>1</Index></Entry></RxPdo>",
            "PDO Index",
        ),
        (
            "<RxPdo><Index>#x1600</Index><Entry><BitLen>8</BitLen></Entry></RxPdo>",
            "Entry/Index",
        ),
        ("<RxPdo><Index>sixteen</Index></RxPdo>", "sixteen"),
        (
            "<RxPdo><Index>#x1600</Index><Entry><Index>1</Index><BitLen>-1</BitLen></Entry></RxPdo>",
            "-1",
        ),
        ("<RxPdo Sm=\"256\"><Index>#x1600</Index></RxPdo>", "256"),
        ("<Sm>Inputs</Sm>", "StartAddress"),
        (
            "<Mailbox><CoE><InitCmd><Index>1</Index><Data>0</Data></InitCmd></CoE></Mailbox>",
            "hexadecimal",
        ),
    ] {
        let message = match parse(device(inside).as_bytes()) {
            Err(error) => error.to_string(),
            Ok(file) => {
                let problem = file.warnings.iter().find(|warning| warning.left_out);
                problem.expect(inside).message.clone()
            }
        };
        assert!(message.contains(part), "{message}");
    }
}

fn left_out(file: &EsiFile) -> Vec<(u32, u32, &str)> {
    let lost = file.warnings.iter().filter(|warning| warning.left_out);
    lost.map(|w| (w.position.line, w.position.column, w.path.as_str()))
        .collect()
}

/// Returns a file with one device per line, from line 2.
fn devices(insides: &[&str]) -> String {
    let mut text = "<EtherCATInfo><Vendor><Id>1</Id></Vendor><Descriptions><Devices>".to_owned();
    for (n, inside) in insides.iter().enumerate() {
        text += &format!("\n<Device><Type ProductCode=\"{n}\">T{n}</Type>{inside}</Device>");
    }
    text + "</Devices></Descriptions></EtherCATInfo>"
}

#[test]
fn a_broken_device_is_skipped_alone() {
    const SM: &str = "EtherCATInfo/Descriptions/Devices/Device[2]/Sm[1]";
    const DEVICE: &str = "EtherCATInfo/Descriptions/Devices/Device[2]";
    for (broken, column, path) in [
        ("<Sm StartAddress=\"lots\">Outputs</Sm>", 40, SM),
        ("<Sm StartAddress=1>Outputs</Sm>", 40, SM),
        (
            "<Name>a</Nam>",
            47,
            "EtherCATInfo/Descriptions/Devices/Device[2]/Name",
        ),
        ("</Sm>", 40, DEVICE),
        ("< >", 40, DEVICE),
    ] {
        let text = devices(&["", broken, ""]);
        let file = parse(text.as_bytes()).unwrap();
        let names: Vec<_> = file.devices.iter().map(|d| d.type_name.as_str()).collect();
        assert_eq!(names, ["T0", "T2"], "{broken}");
        assert_eq!(left_out(&file), [(3, column, path)], "{broken}");
        assert!(
            file.devices
                .iter()
                .all(|device| device.identity.vendor == 1)
        );
        derive_all(&file);
        let query = DeviceQuery {
            name: Some("T1"),
            ..DeviceQuery::default()
        };
        let error = find_device(&file, &query).unwrap_err().to_string();
        let place = format!("; a device is left out, 3:{column} {path}: ");
        assert!(error.contains(&place), "{error}");
    }
}

#[test]
fn a_broken_pdo_is_skipped_alone_with_a_warning() {
    const PDO: &str = "<Index>#x1600</Index><Entry><Index>#x7000</Index><BitLen>8</BitLen></Entry>";
    let text = device(&format!(
        "<Sm StartAddress=\"#x1100\" ControlByte=\"#x64\" Enable=\"1\">Outputs</Sm>\n\
         <RxPdo Sm=\"0\">{PDO}</RxPdo>\n<RxPdo Sm=\"0\"><Index>none</Index></RxPdo>\n\
         <TxPdo><Entry/></TxPdo>"
    ));
    let file = parse(text.as_bytes()).unwrap();
    let at = "EtherCATInfo/Descriptions/Devices/Device[1]";
    let (rx, tx) = (
        format!("{at}/RxPdo[2]/Index"),
        format!("{at}/TxPdo[1]/Entry[1]"),
    );
    assert_eq!(left_out(&file), [(4, 15, rx.as_str()), (5, 8, tx.as_str())]);
    let selection = select(&file, &file.devices[0], &SelectOptions::default()).unwrap();
    assert_eq!(selection.rx.len(), 1);
    assert_eq!(selection.notes.len(), 2, "{:?}", selection.notes);
}

#[test]
fn a_broken_assignment_is_skipped_alone_with_a_warning() {
    let mapping = |name: &str, pdo: &str| {
        format!(
            "<AlternativeSmMapping><Name>{name}</Name><Sm No=\"2\"><Pdo>{pdo}</Pdo></Sm></AlternativeSmMapping>"
        )
    };
    let both = mapping("A", "#x1600") + &mapping("B", "");
    for inside in [
        both.clone(),
        format!("<Info><VendorSpecific><TwinCAT>{both}</TwinCAT></VendorSpecific></Info>"),
    ] {
        let file = parse(devices(&[&inside]).as_bytes()).unwrap();
        let names: Vec<_> = file.devices[0]
            .sm_mappings
            .iter()
            .map(|m| &*m.name)
            .collect();
        assert_eq!(names, ["A"], "{inside}");
        assert_eq!(left_out(&file).len(), 1, "{inside}");
    }
}

#[test]
fn parse_accepts_cr_as_line_end() {
    let text = devices(&["", "<Sm/>"]).replace('\n', "\r");
    let file = parse(text.as_bytes()).unwrap();
    assert_eq!(
        left_out(&file).first().map(|at| (at.0, at.1)),
        Some((3, 40))
    );
}

#[test]
fn parse_accepts_numbers_with_two_prefixes() {
    for (written, value) in [("#x0x6041", 0x6041), ("0x6041", 0x6041), ("#X6041", 0x6041)] {
        let pdo = format!(
            "<TxPdo><Index>#x1a00</Index><Entry><Index>{written}</Index><BitLen>16</BitLen></Entry></TxPdo>"
        );
        let file = parse(device(&pdo).as_bytes()).unwrap();
        assert_eq!(file.devices[0].tx_pdos[0].entries[0].index, value);
    }
}

#[test]
fn absurd_sizes_are_refused_at_once() {
    for size in ["4294967296", "#x100000000", "99999999999999999999999999"] {
        let text = device(&format!("<Eeprom><ByteSize>{size}</ByteSize></Eeprom>"));
        let error = refused(&text).to_string();
        assert!(error.contains(size), "{error}");
    }
    let text = device("<Eeprom><ByteSize>4294967295</ByteSize></Eeprom>");
    let error = refused(&text).to_string();
    assert!(error.contains("ByteSize"), "{error}");
}

#[test]
fn a_bit_length_of_zero_causes_a_warning() {
    let text = device(
        "<RxPdo Sm=\"0\"><Index>#x1600</Index><Entry><Index>#x7000</Index><BitLen>0</BitLen></Entry></RxPdo>",
    );
    let file = parse(text.as_bytes()).unwrap();
    assert_eq!(file.warnings.len(), 1);
    derive_all(&file);
}

#[test]
fn nesting_depth_is_limited() {
    let deep = format!("{}{}", "<a>".repeat(100_000), "</a>".repeat(100_000));
    assert!(matches!(
        refused(&device(&deep)).problem(),
        EsiProblem::TooDeep { .. }
    ));
    let infos = format!(
        "{}{}",
        "<Info><SubItem>".repeat(5_000),
        "</SubItem></Info>".repeat(5_000)
    );
    let text = device(&format!(
        "<Profile><Dictionary><Objects><Object>{infos}</Object></Objects></Dictionary></Profile>"
    ));
    assert!(matches!(
        refused(&text).problem(),
        EsiProblem::TooDeep { .. }
    ));
}

#[test]
fn entities_are_not_expanded() {
    let text = format!(
        "<!DOCTYPE x [<!ENTITY a \"aaaaaaaaaa\"><!ENTITY b \"&a;&a;&a;&a;&a;&a;&a;&a;\">]>{}",
        device("<Name>&b;&lt;&#956;&amp;&nosuch;</Name>")
    );
    let file = parse(text.as_bytes()).unwrap();
    assert_eq!(file.devices[0].name, "&b;<\u{3bc}&&nosuch;");
    assert_eq!(file.warnings.len(), 2);
}

fn dictionary(types: &str, objects: &str) -> String {
    device(&format!(
        "<Profile><Dictionary><DataTypes>{types}</DataTypes><Objects>{objects}</Objects></Dictionary></Profile>"
    ))
}

#[test]
fn a_small_file_cannot_allocate_gigabytes() {
    let object = "<Object><Index>1</Index><Type>BIG</Type><BitSize>8000000</BitSize></Object>";
    let error = refused(&dictionary("", &object.repeat(1_000)));
    assert!(
        matches!(error.problem(), EsiProblem::TooLarge { .. }),
        "{error}"
    );
    let error = refused(&dictionary(
        "",
        "<Object><Index>1</Index><Type>B</Type><BitSize>4294967295</BitSize></Object>",
    ));
    assert!(
        matches!(error.problem(), EsiProblem::TooLarge { .. }),
        "{error}"
    );
    let array = "<DataType><Name>A</Name><BaseType>USINT</BaseType><BitSize>8</BitSize>\
                 <ArrayInfo><LBound>4294967295</LBound><Elements>4294967295</Elements></ArrayInfo></DataType>\
                 <DataType><Name>R</Name><BitSize>8</BitSize><SubItem><SubIdx>0</SubIdx><Type>USINT</Type><BitSize>8</BitSize></SubItem>\
                 <SubItem><Name>E</Name><Type>A</Type><BitSize>8</BitSize></SubItem></DataType>";
    let file =
        parse(dictionary(array, "<Object><Index>1</Index><Type>R</Type></Object>").as_bytes())
            .unwrap();
    assert!(file.devices[0].dictionary.objects[0].items.len() <= 256);
}

#[test]
fn circular_types_are_resolved_in_finite_time() {
    let types = "<DataType><Name>A</Name><BaseType>B</BaseType></DataType><DataType><Name>B</Name><BaseType>A</BaseType></DataType>";
    let file =
        parse(dictionary(types, "<Object><Index>1</Index><Type>A</Type></Object>").as_bytes())
            .unwrap();
    assert_eq!(file.devices[0].dictionary.objects[0].items[0].bit_len, 0);
}

#[test]
fn inconsistent_dictionaries_cause_warnings() {
    let object = "<Object><Index>#x2000</Index><Name>N</Name><Type>USINT</Type><BitSize>8</BitSize>\
                  <Info><DefaultValue>300</DefaultValue><MinValue>x</MinValue></Info></Object>";
    let file = parse(dictionary("", object).as_bytes()).unwrap();
    let item = file.devices[0].dictionary.item(0x2000, 0).unwrap();
    assert!(!item.has_default && item.default == [0] && item.min.is_none());
    assert_eq!(file.warnings.len(), 2);
    assert!(
        file.warnings[0]
            .message
            .contains("0x2000:00: default \"300\" does not fit 8 bits")
    );
}

#[test]
fn every_truncation_of_a_file_is_refused() {
    let text = own("IO8.xml");
    let end = text.trim_end().len();
    for length in 0..end {
        if let Some(part) = text.get(..length) {
            assert!(parse(part.as_bytes()).is_err(), "{length}");
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, cases: 64, ..ProptestConfig::default() })]

    #[test]
    fn parse_never_panics_on_any_bytes(bytes in prop::collection::vec(any::<u8>(), 0..512)) {
        let _ = parse(&bytes);
    }

    #[test]
    fn changed_bytes_never_panic(which in 0..2usize, changes in prop::collection::vec((any::<u32>(), any::<u8>()), 1..12)) {
        let mut bytes = own(["EPOS4.xml", "IO8.xml"][which]).into_bytes();
        for (at, value) in changes {
            let at = at as usize % bytes.len();
            bytes[at] = value;
        }
        if let Ok(file) = parse(&bytes) {
            derive_all(&file);
        }
    }

    /// The text is well-formed, but every number may have any value.
    #[test]
    fn changed_numbers_never_panic(which in 0..3usize, seed in any::<u64>(), values in prop::collection::vec(any::<u32>(), 1..40)) {
        let text = own(["EPOS4.xml", "IDX.xml", "IO8.xml"][which]);
        let mut state = seed;
        let mut next = 0;
        let mut changed = String::with_capacity(text.len());
        for (place, part) in text.split("#x").enumerate() {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            let digits = part.chars().take_while(char::is_ascii_hexdigit).count();
            if place == 0 {
                changed.push_str(part);
            } else if state >> 58 == 0 {
                let value = values[next % values.len()] >> (state >> 32 & 31);
                changed.push_str(&format!("#x{value:x}{}", &part[digits..]));
                next += 1;
            } else {
                changed.push_str("#x");
                changed.push_str(part);
            }
        }
        if let Ok(file) = parse(changed.as_bytes()) {
            derive_all(&file);
        }
    }

    /// Fields lie inside their SyncManagers and do not overlap, for any mapping.
    #[test]
    fn fields_never_overlap(lengths in prop::collection::vec((0..3u8, 1..64u16, any::<bool>()), 0..40)) {
        let mut pdos = String::new();
        for (number, (sm, bits, gap)) in lengths.iter().enumerate() {
            let index = if *gap { 0 } else { 0x6000 + number };
            pdos.push_str(&format!(
                "<TxPdo Fixed=\"1\" Sm=\"{sm}\"><Index>{}</Index><Entry><Index>{index}</Index><BitLen>{bits}</BitLen></Entry></TxPdo>",
                0x1a00 + number
            ));
        }
        let sms = "<Sm StartAddress=\"#x1000\">Inputs</Sm>".repeat(3);
        let file = parse(device(&format!("{sms}{pdos}")).as_bytes()).unwrap();
        let selection = select(&file, &file.devices[0], &SelectOptions::default()).unwrap();
        let layout = &selection.layout;
        let mut end = 0;
        for field in &layout.tx {
            prop_assert!(field.bit_offset >= end);
            end = field.bit_offset + u32::from(field.bit_len);
        }
        prop_assert!(end as usize <= layout.tx_bytes() * 8);
        let mapped: u32 = lengths.iter().map(|(_, bits, _)| u32::from(*bits)).sum();
        prop_assert!(layout.tx_bytes() * 8 >= mapped as usize);
        prop_assert!(layout.tx_bytes() * 8 < mapped as usize + 3 * 8);
    }
}
