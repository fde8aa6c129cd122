//! The element cache reads repeated text once. Model and findings must equal those of a reader
//! without a cache.
//!
//! A comment of constant length stands inside each cacheable element. With equal comments, the
//! elements come from the cache. With numbered comments, all texts differ. Lines and columns are
//! the same in both cases.

use crate::common;
use ecaxis_esi::{EsiError, EsiFile, parse};
use proptest::prelude::*;

/// End tags after which a comment is inserted, one in each cacheable element.
const BEHIND: [&str; 3] = ["</Index>", "</Name>", "</Access>"];

/// Returns the text with equal comments and with numbered comments.
fn commented(text: &str) -> [Vec<u8>; 2] {
    let (mut same, mut counted) = (String::new(), String::new());
    let mut rest = text;
    let mut number = 0;
    let next = |rest: &str| {
        let ends = BEHIND
            .iter()
            .filter_map(|tag| Some(rest.find(tag)? + tag.len()));
        ends.min()
    };
    while let Some(end) = next(rest) {
        let (before, behind) = rest.split_at(end);
        number += 1;
        same.push_str(&format!("{before}<!--{:06}-->", 0));
        counted.push_str(&format!("{before}<!--{number:06}-->"));
        rest = behind;
    }
    [same, counted].map(|text| (text + rest).into_bytes())
}

fn shown(read: &Result<EsiFile, EsiError>) -> String {
    format!("{read:#?}")
}

fn assert_same(text: &str) {
    let [same, counted] = commented(text);
    let (remembered, read) = (parse(&same), parse(&counted));
    let (remembered, read) = (shown(&remembered), shown(&read));
    if let Some((a, b)) = remembered.lines().zip(read.lines()).find(|(a, b)| a != b) {
        panic!("remembered {a:?}, read {b:?}\n{text}");
    }
    assert_eq!(remembered.len(), read.len(), "{text}");
}

fn document(devices: &[String]) -> String {
    let mut text = "<EtherCATInfo><Vendor><Id>1</Id></Vendor><Descriptions><Devices>".to_owned();
    for device in devices {
        text.push_str(device);
    }
    text + "</Devices></Descriptions></EtherCATInfo>"
}

fn device(body: &str) -> String {
    format!("<Device><Type ProductCode=\"1\">\u{e4}</Type>{body}</Device>")
}

const ENTRY: &str = "<Entry><Index>#x6000</Index><SubIndex>1</SubIndex><BitLen>8</BitLen><Name>\u{fc}n</Name></Entry>";
/// An entry that causes a warning.
const NO_BITS: &str = "<Entry><Index>#x6000</Index><BitLen>0</BitLen></Entry>";
const OBJECT: &str = "<Object><Index>#x2000</Index><Name>o</Name><Type>DT2000</Type><Info><SubItem><Name>a</Name>\
    <Info><DefaultData>01</DefaultData></Info></SubItem></Info><Flags><Access>rw</Access></Flags></Object>";
const TYPE: &str = "<DataType><Name>DT2000</Name><BitSize>16</BitSize><SubItem><SubIdx>0</SubIdx><Name>a</Name>\
    <Type>USINT</Type><BitSize>8</BitSize><BitOffs>0</BitOffs><Flags><Access>ro</Access></Flags></SubItem>\
    <SubItem><SubIdx>1</SubIdx><Name>b</Name><Type>USINT</Type><BitSize>8</BitSize><BitOffs>8</BitOffs></SubItem></DataType>";

fn pdo(direction: &str, entries: &str) -> String {
    format!(
        "<{direction}Pdo Sm=\"3\"><Index>#x1a00</Index>{entries}<Name>p</Name></{direction}Pdo>"
    )
}

fn dictionary(types: &str, objects: &str) -> String {
    format!(
        "<Profile><Dictionary><DataTypes>{types}</DataTypes><Objects>{objects}</Objects></Dictionary></Profile>"
    )
}

#[test]
fn cached_elements_keep_their_own_positions() {
    let two = pdo("Tx", &format!("{ENTRY}\n  {ENTRY}"));
    let body = format!("{two}{two}\n\t\u{e4}{two}");
    let text = document(&[device(&body), device(&body)]);
    assert_same(&text);
    let file = parse(text.as_bytes()).unwrap();
    for (device, text) in file.devices.iter().zip(text.split("<Device>").skip(1)) {
        let seen = device.tx_pdos.iter().map(|pdo| pdo.position.line);
        assert_eq!(text.matches("<TxPdo").count(), device.tx_pdos.len());
        assert!(seen.is_sorted());
    }
    let lines: Vec<&str> = text.split('\n').collect();
    for entry in file
        .devices
        .iter()
        .flat_map(|d| &d.tx_pdos)
        .flat_map(|p| &p.entries)
    {
        let line: String = lines[entry.position.line as usize - 1]
            .chars()
            .skip(entry.position.column as usize - 1)
            .collect();
        assert!(line.starts_with("<Entry>"), "{}: {line}", entry.position);
    }
}

#[test]
fn cached_elements_repeat_warnings_at_their_own_positions() {
    let body = pdo("Tx", &format!("{NO_BITS}\n{NO_BITS}{NO_BITS}"));
    let text = document(&[device(&format!("{body}{body}"))]);
    assert_same(&text);
    let file = parse(text.as_bytes()).unwrap();
    let mut places: Vec<_> = file
        .warnings
        .iter()
        .map(|w| (w.position.line, w.position.column))
        .collect();
    let paths: Vec<_> = file.warnings.iter().map(|w| w.path.as_str()).collect();
    assert_eq!(places.len(), 6, "{paths:?}");
    places.dedup();
    assert_eq!(places.len(), 6, "{places:?}");
    assert!(
        paths[5].ends_with("Device[1]/TxPdo[2]/Entry[3]"),
        "{paths:?}"
    );
}

#[test]
fn cached_text_is_read_again_in_another_context() {
    // The first use of a text must not hide an error in the second use. Types with the same items
    // remain different.
    let wrong = "<Entry><Index>#x6000</Index><BitLen>x</BitLen></Entry>";
    let other_type = TYPE.replace(">USINT<", ">UINT<");
    let other_type = other_type.as_str();
    for devices in [
        vec![
            device(&pdo("Tx", ENTRY)),
            device(&pdo("Tx", &format!("{ENTRY}{wrong}"))),
        ],
        vec![device(&pdo("Tx", ENTRY)), device(&pdo("Rx", ENTRY))],
        vec![
            device(&dictionary(TYPE, OBJECT)),
            device(&dictionary(other_type, OBJECT)),
        ],
        vec![
            device(&dictionary(TYPE, OBJECT)),
            device(&dictionary("", OBJECT)),
        ],
    ] {
        assert_same(&document(&devices));
    }
}

#[test]
fn cached_elements_handle_end_tags_in_comments_and_other_spellings() {
    let hidden = "<Entry><!--</Entry>--><Index>#x6001</Index><BitLen>8</BitLen></Entry>";
    let cdata =
        "<Entry><Name><![CDATA[</Entry>]]></Name><Index>#x6001</Index><BitLen>8</BitLen></Entry>";
    let spaced = "<Entry><Index>#x6001</Index><BitLen>8</BitLen></Entry >";
    let nested = "<Entry><Entry></Entry><Index>#x6001</Index><BitLen>8</BitLen></Entry>";
    let prefixed = "<e:Entry><Index>#x6001</Index><BitLen>8</BitLen></e:Entry>";
    let empty = "<Entry/>";
    let unclosed = "<Entry><Index>#x6001</Index><BitLen>8</BitLen>";
    for odd in [hidden, cdata, spaced, nested, prefixed, empty, unclosed] {
        let entries = format!("{odd}{ENTRY}{odd}{odd}{ENTRY}");
        assert_same(&document(&[
            device(&pdo("Tx", &entries)),
            device(&pdo("Tx", &entries)),
        ]));
    }
}

fn entry() -> impl Strategy<Value = String> {
    let texts = [
        ENTRY,
        NO_BITS,
        "<Entry/>",
        "\n",
        "\u{e4} ",
        "<!--</Entry>-->",
        "&odd;",
    ];
    proptest::sample::select(texts.to_vec()).prop_map(str::to_owned)
}

fn part() -> impl Strategy<Value = String> {
    let pdos = (any::<bool>(), prop::collection::vec(entry(), 0..5));
    let pdos = pdos.prop_map(|(rx, entries)| pdo(if rx { "Rx" } else { "Tx" }, &entries.concat()));
    let objects = ["", "\n", OBJECT, "<Object><Index>x</Index></Object>"];
    let objects = prop::collection::vec(proptest::sample::select(objects.to_vec()), 0..4);
    let types = proptest::sample::select(vec!["", TYPE]);
    let dictionaries =
        (types, objects).prop_map(|(types, objects)| dictionary(types, &objects.concat()));
    prop_oneof![4 => pdos, 2 => dictionaries, 1 => Just("\r\n".to_owned())]
}

proptest! {
    #[test]
    fn cached_elements_in_any_order_read_the_same(parts in prop::collection::vec(part(), 0..12), at in any::<prop::sample::Index>()) {
        let (first, second) = parts.split_at(at.index(parts.len() + 1));
        let text = document(&[first, second].map(|parts| device(&parts.concat())));
        assert_same(&text);
    }
}

#[test]
fn vendor_files_are_read_the_same() {
    for path in common::files("esi", &["xml"]) {
        let bytes = std::fs::read(&path).unwrap();
        assert_same(&String::from_utf8_lossy(&bytes));
    }
}
