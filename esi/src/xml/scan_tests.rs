//! Tests of events, their offsets, and damaged text.

use super::lines::Lines;
use super::scan::{Malformed, XmlEvent, XmlReader, attribute};
use proptest::prelude::*;

fn pieces(document: &str) -> Result<Vec<XmlEvent<'_>>, Malformed> {
    let mut scanner = XmlReader::new(document);
    let mut all = Vec::new();
    let mut at = 0;
    loop {
        let piece = scanner.next()?;
        assert!(
            scanner.offset() > at || piece == XmlEvent::Eof,
            "{document}"
        );
        at = scanner.offset();
        if let XmlEvent::Start { name, offset, .. } = piece {
            assert!(document[offset..].starts_with(&format!("<{name}")));
        }
        match piece {
            XmlEvent::Eof => return Ok(all),
            piece => all.push(piece),
        }
    }
}

/// Formats the events as `start`, `/end`, `"text"`.
fn seen(document: &str) -> String {
    let pieces = pieces(document).unwrap().into_iter();
    let pieces = pieces.map(|piece| match piece {
        XmlEvent::Start {
            name,
            attributes,
            empty,
            ..
        } => {
            let end = if empty { "/" } else { "" };
            format!("{name}[{}]{end}", attributes.trim())
        }
        XmlEvent::End { name, .. } => format!("/{name}"),
        XmlEvent::Text(text) | XmlEvent::CData(text) => format!("{text:?}"),
        XmlEvent::Eof => String::new(),
    });
    pieces.collect::<Vec<_>>().join(" ")
}

#[test]
fn scanner_reads_every_kind_of_markup() {
    for (document, expected) in [
        ("", ""),
        ("plain", "\"plain\""),
        ("<a/>", "a[]/"),
        ("<a>x</a >", "a[] \"x\" /a"),
        (
            "<a b='1>2' c=\"it's\">&lt;t&gt;</a>",
            "a[b='1>2' c=\"it's\"] \"&lt;\" \"t\" \"&gt;\" /a",
        ),
        (
            "<?xml version='1.0'?><!DOCTYPE a [<!ENTITY x \"<b>\"> <!-- c > -->]><a>&x;</a>",
            "a[] \"&x;\" /a",
        ),
        (
            "<a><!-- <b> - -- x --><![CDATA[<b> & ]] >]]>t</a>",
            "a[] \"<b> & ]] >\" \"t\" /a",
        ),
        (
            "<p:a xmlns:p='u'><p:b\n\tx = \"1\"\n/></p:a>",
            "p:a[xmlns:p='u'] p:b[x = \"1\"]/ /p:a",
        ),
        ("<a>1 & 2</a>", "a[] \"1 \" \"& 2\" /a"),
        ("<a><?pi <b> ?></a>", "a[] /a"),
        ("</a><b>", "/a b[]"),
    ] {
        assert_eq!(seen(document), expected, "{document}");
    }
}

#[test]
fn scanner_ends_at_the_end_of_text_with_open_markup() {
    for document in [
        "<",
        "<a",
        "<a b='",
        "<a b=\"x'>",
        "</",
        "</a",
        "<!",
        "<!-",
        "<!--",
        "<!-- x --",
        "<![CDA",
        "<![CDATA[ x ]]",
        "<?xml",
        "<!DOCTYPE a [ <!ENTITY x \">]",
        "<!DOCTYPE",
    ] {
        let text = format!("<r>{document}");
        let expected = Malformed {
            offset: 3,
            what: None,
        };
        assert_eq!(pieces(&text).unwrap_err(), expected, "{document}");
    }
    for document in ["< a>", "<>", "<!ELEMENT a>", "<!x            >"] {
        let error = pieces(document).unwrap_err();
        assert!(error.what.is_some(), "{document}: {error:?}");
    }
}

#[test]
fn attribute_finds_values_by_local_name() {
    let tag = " a='1'\n p:b = \"x 'y' = z\" c=''";
    for (name, value) in [
        ("a", Some("1")),
        ("b", Some("x 'y' = z")),
        ("c", Some("")),
        ("p", None),
        ("d", None),
    ] {
        assert_eq!(attribute(tag, name).unwrap().as_deref(), value, "{name}");
    }
    for tag in ["a", "a=1", "a='1", "a='1' b"] {
        assert!(attribute(tag, "none").is_err(), "{tag}");
    }
}

fn any_markup() -> impl Strategy<Value = String> {
    let piece = prop_oneof![
        Just("<a>".to_owned()),
        Just("</a>".to_owned()),
        Just("<b c='1' d=\"2\"/>".to_owned()),
        Just("<!-- x -->".to_owned()),
        Just("<![CDATA[ y ]]>".to_owned()),
        Just("&amp;".to_owned()),
        "[a-zä€ \n\r\t]{0,6}",
    ];
    proptest::collection::vec(piece, 0..20).prop_map(|pieces| pieces.concat())
}

proptest! {
    /// Checks that no text causes a panic, and that each event advances the offset.
    #[test]
    fn scanner_survives_any_damage(document in any_markup(), at in any::<prop::sample::Index>(), by in "[<>/!?'\"\\[\\]ä=-]{0,3}") {
        let mut at = at.index(document.len() + 1);
        while !document.is_char_boundary(at) {
            at -= 1;
        }
        let damaged = format!("{}{by}{}", &document[..at], &document[at..]);
        let _ = pieces(&damaged);
        let _ = attribute(&damaged, "c");
        let cut = &damaged[..at];
        let _ = pieces(cut);
    }

    #[test]
    fn lines_position_matches_a_character_count(
        text in "[aä€\n]{0,1500}",
        at in proptest::collection::vec(any::<prop::sample::Index>(), 1..8),
    ) {
        // Earlier requests must not change the result.
        let lines = Lines::new(&text);
        for at in at {
            let mut offset = at.index(text.len() + 1);
            while !text.is_char_boundary(offset) {
                offset -= 1;
            }
            let before = &text[..offset];
            let line = before.matches('\n').count() + 1;
            let column = before.rsplit('\n').next().unwrap().chars().count() + 1;
            let (found_line, found_column) = lines.position(offset);
            prop_assert_eq!((found_line as usize, found_column as usize), (line, column));
        }
    }
}
