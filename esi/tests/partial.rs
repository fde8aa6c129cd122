//! `parse_where` builds the wanted devices as `parse` does, and a `Ref` repeats the PDO with that
//! `RefName`.

use std::path::Path;

use ecaxis_esi::{Device, parse, parse_where};

use crate::common::files;

#[test]
fn wanted_devices_equal_those_of_the_whole_file() {
    let own = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/esi");
    let mut paths: Vec<_> = std::fs::read_dir(own)
        .unwrap()
        .flatten()
        .map(|e| e.path())
        .collect();
    paths.extend(files("esi", &["xml", "XML"]));
    let (mut built, mut skipped) = (0, 0);
    for path in paths {
        let bytes = std::fs::read(&path).unwrap();
        let Ok(whole) = parse(&bytes) else {
            continue;
        };
        let odd = parse_where(&bytes, &|header| header.number % 2 == 1).unwrap();
        (built, skipped) = (built + odd.devices.len(), skipped + odd.skipped.len());
        let even = parse_where(&bytes, &|header| header.number % 2 == 0).unwrap();
        let mut parts: Vec<_> = odd.devices.iter().chain(&even.devices).collect();
        parts.sort_by_key(|device| device.position);
        parts.dedup_by_key(|device| device.position);
        assert_eq!(
            format!("{parts:?}"),
            format!("{:?}", whole.devices.iter().collect::<Vec<_>>())
        );
        for header in odd.skipped.iter().chain(&even.skipped) {
            let path = format!("/Device[{}]", header.number);
            let named = (header.identity, &header.type_name, &header.name);
            let is_it = |device: &Device| {
                device.path.ends_with(&path)
                    && (device.identity, &device.type_name, &device.name) == named
            };
            let is_broken = || {
                whole
                    .warnings
                    .iter()
                    .any(|w| w.left_out && w.path.contains(&path))
            };
            assert!(whole.devices.iter().any(is_it) || is_broken(), "{header:?}");
        }
    }
    assert!(built > 0 && skipped > 0);
}

fn two_devices(first: &str, second: &str) -> Vec<u8> {
    format!(
        "<EtherCATInfo><Vendor><Id>7</Id></Vendor><Descriptions><Devices>\n\
         <Device><Type ProductCode=\"1\">A</Type>{first}</Device>\n\
         <Device><Type ProductCode=\"2\">B</Type>{second}</Device>\n\
         </Devices></Descriptions></EtherCATInfo>"
    )
    .into_bytes()
}

#[test]
fn content_of_a_skipped_device_is_not_checked() {
    let bytes = two_devices("<Sm StartAddress=\"many\"/>", "<Name>Second</Name>");
    let file = parse_where(&bytes, &|device| device.type_name == "B").unwrap();
    assert_eq!(
        (file.devices.len(), file.devices[0].identity.product),
        (1, 2)
    );
    assert_eq!(file.skipped.len(), 1);
    assert_eq!(
        (file.skipped[0].identity.vendor, file.skipped[0].number),
        (7, 1)
    );
    assert!(file.warnings.is_empty());
    let file = parse_where(&bytes, &|device| device.type_name == "A").unwrap();
    assert_eq!(
        (file.devices.len(), file.skipped[0].name.as_str()),
        (0, "Second")
    );
    assert_eq!(file.warnings.len(), 1);
}

#[test]
fn device_without_a_type_is_reported_even_if_it_is_not_wanted() {
    let bytes = String::from_utf8(two_devices("", "")).unwrap();
    let bytes = bytes.replace("<Type ProductCode=\"1\">A</Type>", "");
    let file = parse_where(bytes.as_bytes(), &|_| false).unwrap();
    assert_eq!(file.skipped.len(), 1);
    assert_eq!(file.warnings.len(), 1);
    assert_eq!(file.warnings[0].position.line, 2);
}

const DEFINITION: &str = "<TxPdo RefName=\"status\" Fixed=\"1\" Sm=\"3\"><Index>#x1A00</Index>\
    <Name>Status</Name><Entry><Index>#x6041</Index><BitLen>16</BitLen></Entry></TxPdo>";

#[test]
fn reference_repeats_the_pdo_before_and_after_its_definition() {
    let reference = "<Pdo Ref=\"status\"/>";
    for (first, second) in [(DEFINITION, reference), (reference, DEFINITION)] {
        let file = parse(&two_devices(first, second)).unwrap();
        assert_eq!(file.warnings, []);
        let [a, b] = &file.devices[..] else {
            panic!("two devices");
        };
        let (a, b) = (&a.tx_pdos[0], &b.tx_pdos[0]);
        assert_ne!(a.position, b.position);
        assert_eq!(
            (a.index, a.sm, a.fixed, &a.name),
            (0x1a00, Some(3), true, &b.name)
        );
        assert_eq!(a.entries, b.entries);
    }
}

#[test]
fn reference_replaces_what_it_names_itself() {
    let reference = "<TxPdo Ref=\"status\" Sm=\"2\"><Index>#x1A01</Index>\
        <Entry><Index>#x6064</Index><BitLen>32</BitLen></Entry></TxPdo>";
    let file = parse(&two_devices(DEFINITION, reference)).unwrap();
    let pdo = &file.devices[1].tx_pdos[0];
    assert_eq!(
        (pdo.index, pdo.sm, pdo.name.as_str()),
        (0x1a01, Some(2), "Status")
    );
    let entries: Vec<_> = pdo.entries.iter().map(|e| (e.index, e.bit_len)).collect();
    assert_eq!(entries, [(0x6064, 32)]);
}

#[test]
fn reference_without_definition_loses_only_its_pdo() {
    let file = parse(&two_devices(DEFINITION, "\n  <Pdo Ref=\"state\"/>")).unwrap();
    assert_eq!(file.devices.len(), 2);
    assert!(file.devices[1].tx_pdos.is_empty());
    let [warning] = &file.warnings[..] else {
        panic!("one warning: {:?}", file.warnings);
    };
    assert!(warning.left_out);
    assert_eq!((warning.position.line, warning.position.column), (4, 3));
    assert_eq!(
        warning.message,
        "no PDO of this file has the RefName \"state\""
    );
}

#[test]
fn references_may_refer_forwards_twice() {
    let chain = "<Pdo Ref=\"b\"/><TxPdo Ref=\"status\" RefName=\"b\"><Name>B</Name></TxPdo>";
    let file = parse(&two_devices(chain, DEFINITION)).unwrap();
    assert_eq!(file.warnings, []);
    let names: Vec<_> = file.devices[0]
        .tx_pdos
        .iter()
        .map(|pdo| &*pdo.name)
        .collect();
    assert_eq!(names, ["B", "B"]);
}

/// A copy needs as much memory as its definition, which a file of this size does not.
#[test]
fn many_references_to_a_long_name_lose_their_device() {
    let name = "n".repeat(1 << 20);
    let definition =
        format!("<TxPdo RefName=\"x\"><Index>#x1A00</Index><Name>{name}</Name></TxPdo>");
    let file = parse(&two_devices(&definition, &"<Pdo Ref=\"x\"/>".repeat(2_000))).unwrap();
    assert_eq!(file.devices.len(), 1);
    assert!(file.warnings[0].message.contains("exceed"));
}

#[test]
fn many_references_to_a_long_pdo_lose_their_device() {
    let entry = "<Entry><Index>0</Index><BitLen>1</BitLen></Entry>".repeat(10_000);
    let definition = format!("<TxPdo RefName=\"x\"><Index>#x1A00</Index>{entry}</TxPdo>");
    let file = two_devices(&definition, &"<Pdo Ref=\"x\"/>".repeat(2_000));
    let file = parse(&file).unwrap();
    let built: Vec<_> = file
        .devices
        .iter()
        .map(|device| &device.type_name)
        .collect();
    assert_eq!(built, ["A"]);
    let message = &file.warnings[0].message;
    assert!(message.contains("exceed"), "{message}");
}

/// `ethercat xml` lists each device in an `EtherCATInfo` of its own.
#[test]
fn devices_of_a_list_have_numbers_and_vendors_of_their_own() {
    let one = |n: u32| {
        format!(
            "<EtherCATInfo><Vendor><Id>{n}</Id><Name>V{n}</Name></Vendor><Descriptions><Devices>\
             <Device><Type ProductCode=\"{n}\">T{n}</Type></Device></Devices></Descriptions></EtherCATInfo>"
        )
    };
    let all: String = (1..=3).map(one).collect();
    let file = format!("<EtherCATInfoList>{all}</EtherCATInfoList>").into_bytes();
    let whole = parse(&file).unwrap();
    for (n, device) in (1..).zip(&whole.devices) {
        assert_eq!((device.number, device.identity.vendor), (n, n));
        assert_eq!(whole.vendor_name(n), format!("V{n}"));
    }
    let second = parse_where(&file, &|header| header.number == 2).unwrap();
    assert_eq!(second.devices.len(), 1);
    assert_eq!(second.devices[0].type_name, "T2");
}
