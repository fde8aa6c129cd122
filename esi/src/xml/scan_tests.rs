//! The scanner against quick-xml, a reader that it shares no code with, and against damage.

use proptest::prelude::*;
use quick_xml::Reader;
use quick_xml::events::Event;

use super::lines::Lines;
use super::scan::{Malformed, Piece, Scanner, attribute};

/// What both readers should find; neighbouring text is one.
#[derive(Debug, PartialEq)]
enum Seen {
    Start(String, String),
    End(String),
    Text(String),
}

fn text(all: &mut Vec<Seen>, part: &str) {
    if part.is_empty() {
        return;
    }
    match all.last_mut() {
        Some(Seen::Text(known)) => known.push_str(part),
        _ => all.push(Seen::Text(part.to_owned())),
    }
}

fn ours(document: &str) -> Result<Vec<Seen>, Malformed> {
    let mut scanner = Scanner::new(document);
    let mut all = Vec::new();
    loop {
        match scanner.next()? {
            Piece::Start {
                name,
                local,
                attributes,
                offset,
                empty,
            } => {
                assert_eq!(name.rsplit(':').next(), Some(local));
                assert!(document[offset..].starts_with(&format!("<{name}")));
                all.push(Seen::Start(name.to_owned(), attributes.trim().to_owned()));
                if empty {
                    all.push(Seen::End(name.to_owned()));
                }
            }
            Piece::End { name, .. } => all.push(Seen::End(name.to_owned())),
            Piece::Text(part) | Piece::CData(part) => text(&mut all, part),
            Piece::Eof => return Ok(all),
        }
    }
}

fn theirs(document: &str) -> Result<Vec<Seen>, quick_xml::Error> {
    let mut reader = Reader::from_str(document);
    reader.config_mut().check_end_names = false;
    reader.config_mut().allow_unmatched_ends = true;
    let mut all = Vec::new();
    loop {
        let event = reader.read_event()?;
        match event {
            Event::Start(ref tag) | Event::Empty(ref tag) => {
                let name: &str = tag.name().0;
                let attributes: &str = tag.attributes_raw();
                let attributes = attributes.trim().to_owned();
                all.push(Seen::Start(name.to_owned(), attributes));
                if matches!(event, Event::Empty(_)) {
                    all.push(Seen::End(name.to_owned()));
                }
            }
            Event::End(tag) => all.push(Seen::End(tag.name().0.to_owned())),
            Event::Text(part) => text(&mut all, &part),
            Event::CData(part) => text(&mut all, &part),
            Event::GeneralRef(name) => text(&mut all, &format!("&{};", &*name)),
            Event::Eof => return Ok(all),
            Event::Comment(_) | Event::Decl(_) | Event::PI(_) | Event::DocType(_) => {}
        }
    }
}

#[test]
fn every_kind_of_markup_as_another_reader_sees_it() {
    for document in [
        "",
        "plain",
        "<a/>",
        "<a>x</a >",
        "<a b='1>2' c=\"it's\">&lt;t&gt;</a>",
        "<?xml version='1.0'?><!DOCTYPE a [<!ENTITY x \"<b>\"> <!-- c > -->]><a>&x;</a>",
        "<a><!-- <b> - -- x --><![CDATA[<b> & ]] >]]>t</a>",
        "<p:a xmlns:p='u'><p:b\n\tx = \"1\"\n/></p:a>",
        "<a><?pi <b> ?></a>",
        "</a><b>",
    ] {
        assert_eq!(
            ours(document).unwrap(),
            theirs(document).unwrap(),
            "{document}"
        );
    }
}

#[test]
fn what_is_not_closed_ends_at_the_end() {
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
        assert_eq!(ours(&text).unwrap_err(), expected, "{document}");
    }
    for document in ["< a>", "<>", "<!ELEMENT a>", "<!x            >"] {
        let error = ours(document).unwrap_err();
        assert!(error.what.is_some(), "{document}: {error:?}");
    }
}

#[test]
fn attributes_by_their_local_name() {
    let tag = " a='1'\n p:b = \"x 'y' = z\" c=''";
    for (name, value) in [
        ("a", Some("1")),
        ("b", Some("x 'y' = z")),
        ("c", Some("")),
        ("p", None),
        ("d", None),
    ] {
        assert_eq!(attribute(tag, name), Ok(value), "{name}");
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
    #[test]
    fn any_document_as_another_reader_sees_it(document in any_markup()) {
        prop_assert_eq!(ours(&document).unwrap(), theirs(&document).unwrap());
    }

    /// Nothing panics, and everything ends: every piece moves on.
    #[test]
    fn any_damage_is_survived(document in any_markup(), at in any::<prop::sample::Index>(), by in "[<>/!?'\"\\[\\]ä=-]{0,3}") {
        let mut at = at.index(document.len() + 1);
        while !document.is_char_boundary(at) {
            at -= 1;
        }
        let damaged = format!("{}{by}{}", &document[..at], &document[at..]);
        let _ = ours(&damaged);
        let _ = attribute(&damaged, "c");
        let cut = &damaged[..at];
        let _ = ours(cut);
    }

    #[test]
    fn lines_and_columns_as_counted_one_by_one(
        text in "[aä€\n]{0,1500}",
        at in proptest::collection::vec(any::<prop::sample::Index>(), 1..8),
    ) {
        // What was asked for before must not matter.
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
