//! Text → tags and text, by quick-xml, with the place of each.
//!
//! That elements are closed in order is checked by the cursor. A document type is passed over, so nothing that it
//! declares is ever expanded.

use std::borrow::Cow;

use quick_xml::Reader;
use quick_xml::errors::SyntaxError;
use quick_xml::events::attributes::{AttrError, Attributes};
use quick_xml::events::{BytesStart, Event};

/// A piece of the document; everything else (comments, declarations, processing instructions) is passed over.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Piece<'a> {
    /// `<name attributes>` or, with `empty`, `<name attributes/>`.
    Start {
        name: &'a str,
        attributes: &'a str,
        offset: usize,
        empty: bool,
    },
    End {
        name: &'a str,
        offset: usize,
    },
    /// As written, references included.
    Text(&'a str),
    CData(&'a str),
    Eof,
}

/// Not well-formed at a byte of the text.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Malformed {
    pub offset: usize,
    /// `None`: the text ends inside a tag, a comment or the like.
    pub what: Option<String>,
}

pub(super) struct Scanner<'a> {
    text: &'a str,
    reader: Reader<&'a [u8]>,
    /// Bytes of the text that the reader has not seen.
    skipped: usize,
}

impl<'a> Scanner<'a> {
    pub fn new(text: &'a str) -> Self {
        Self {
            text,
            reader: reader(text),
            skipped: 0,
        }
    }

    /// Reads on from a byte, whatever was read before.
    pub fn begin_at(&mut self, offset: usize) {
        self.reader = reader(self.text.get(offset..).unwrap_or_default());
        self.skipped = offset;
    }

    pub fn offset(&self) -> usize {
        self.skipped + to_usize(self.reader.buffer_position())
    }

    /// All that stands from a byte on.
    pub fn rest(&self, from: usize) -> &'a [u8] {
        self.text.as_bytes().get(from..).unwrap_or_default()
    }

    /// The next tag, whatever text stands before it.
    pub fn next_tag(&mut self) -> Result<Piece<'a>, Malformed> {
        loop {
            match self.next()? {
                Piece::Text(_) | Piece::CData(_) => {}
                piece => return Ok(piece),
            }
        }
    }

    pub fn next(&mut self) -> Result<Piece<'a>, Malformed> {
        loop {
            let offset = self.offset();
            let event = self.reader.read_event();
            let event = event.map_err(|error| self.malformed(&error))?;
            let written = self.text.get(offset..self.offset()).unwrap_or_default();
            return match event {
                Event::Start(tag) => self.start(&tag, written, offset, false),
                Event::Empty(tag) => self.start(&tag, written, offset, true),
                Event::End(_) => {
                    let name = written.get(2..written.len() - 1).unwrap_or_default();
                    let name = name.trim_ascii_end();
                    Ok(Piece::End { name, offset })
                }
                Event::Text(_) | Event::GeneralRef(_) => Ok(Piece::Text(written)),
                Event::CData(_) => {
                    let inner = written.strip_prefix("<![CDATA[");
                    let inner = inner.and_then(|inner| inner.strip_suffix("]]>"));
                    Ok(Piece::CData(inner.unwrap_or_default()))
                }
                Event::Eof => Ok(Piece::Eof),
                Event::Comment(_) | Event::Decl(_) | Event::PI(_) | Event::DocType(_) => continue,
            };
        }
    }

    fn start(
        &self,
        tag: &BytesStart<'_>,
        written: &'a str,
        offset: usize,
        empty: bool,
    ) -> Result<Piece<'a>, Malformed> {
        let inner = written.get(1..written.len() - 1 - usize::from(empty));
        let inner = inner.and_then(|inner| inner.split_at_checked(tag.name().0.len()));
        let (name, attributes) = inner.unwrap_or_default();
        if local_name(name).is_empty() {
            let what = Some("a tag without a name".to_owned());
            return Err(Malformed { offset, what });
        }
        Ok(Piece::Start {
            name,
            attributes,
            offset,
            empty,
        })
    }

    fn malformed(&self, error: &quick_xml::Error) -> Malformed {
        let offset = self.skipped + to_usize(self.reader.error_position());
        let ends = match error {
            quick_xml::Error::Syntax(SyntaxError::InvalidBangMarkup) => {
                !self.rest(offset).contains(&b'>')
            }
            error => matches!(error, quick_xml::Error::Syntax(_)),
        };
        let what = (!ends).then(|| error.to_string());
        Malformed { offset, what }
    }
}

fn reader(text: &str) -> Reader<&[u8]> {
    let mut reader = Reader::from_str(text);
    let config = reader.config_mut();
    config.check_end_names = false;
    config.allow_unmatched_ends = true;
    config.allow_dangling_amp = true;
    reader
}

fn to_usize(offset: u64) -> usize {
    usize::try_from(offset).unwrap_or(usize::MAX)
}

/// Without the namespace's prefix.
pub(super) fn local_name(qualified: &str) -> &str {
    let local = qualified.rsplit_once(':');
    local.map_or(qualified, |(_, local)| local)
}

/// The value of one attribute as written; `Err` where the tag is not made of `name="value"` before it.
pub(super) fn attribute<'a>(
    attributes: &'a str,
    name: &str,
) -> Result<Option<Cow<'a, str>>, AttrError> {
    for attribute in Attributes::new(attributes, 0).with_checks(false) {
        let attribute = attribute?;
        if local_name(attribute.key.0) == name {
            return Ok(Some(attribute.value));
        }
    }
    Ok(None)
}
