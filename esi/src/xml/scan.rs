//! Text → tags and text with their offsets, through quick-xml.
//!
//! The cursor checks that elements are closed in order. A document type is skipped, so its
//! declarations are never expanded.

use std::borrow::Cow;

use quick_xml::Reader;
use quick_xml::errors::SyntaxError;
use quick_xml::events::attributes::{AttrError, Attributes};
use quick_xml::events::{BytesStart, Event};

/// One piece of the document. Comments, declarations and processing instructions are skipped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum XmlEvent<'a> {
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
    /// Text as written, with references.
    Text(&'a str),
    CData(&'a str),
    Eof,
}

/// The offset of a byte at which the text is not well-formed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Malformed {
    pub offset: usize,
    /// `None`: the text ends inside a tag, a comment or similar.
    pub what: Option<String>,
}

pub(super) struct XmlReader<'a> {
    text: &'a str,
    reader: Reader<&'a [u8]>,
    /// The number of bytes before the part that the reader sees.
    skipped: usize,
}

impl<'a> XmlReader<'a> {
    pub fn new(text: &'a str) -> Self {
        Self {
            text,
            reader: reader(text),
            skipped: 0,
        }
    }

    /// Continues reading at an offset.
    pub fn begin_at(&mut self, offset: usize) {
        self.reader = reader(self.text.get(offset..).unwrap_or_default());
        self.skipped = offset;
    }

    pub fn offset(&self) -> usize {
        self.skipped + to_usize(self.reader.buffer_position())
    }

    /// Returns the text from an offset to the end.
    pub fn rest(&self, from: usize) -> &'a [u8] {
        self.text.as_bytes().get(from..).unwrap_or_default()
    }

    /// Returns the next tag and skips text before it.
    pub fn next_tag(&mut self) -> Result<XmlEvent<'a>, Malformed> {
        loop {
            match self.next()? {
                XmlEvent::Text(_) | XmlEvent::CData(_) => {}
                piece => return Ok(piece),
            }
        }
    }

    pub fn next(&mut self) -> Result<XmlEvent<'a>, Malformed> {
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
                    Ok(XmlEvent::End { name, offset })
                }
                Event::Text(_) | Event::GeneralRef(_) => Ok(XmlEvent::Text(written)),
                Event::CData(_) => {
                    let inner = written.strip_prefix("<![CDATA[");
                    let inner = inner.and_then(|inner| inner.strip_suffix("]]>"));
                    Ok(XmlEvent::CData(inner.unwrap_or_default()))
                }
                Event::Eof => Ok(XmlEvent::Eof),
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
    ) -> Result<XmlEvent<'a>, Malformed> {
        let inner = written.get(1..written.len() - 1 - usize::from(empty));
        let inner = inner.and_then(|inner| inner.split_at_checked(tag.name().0.len()));
        let (name, attributes) = inner.unwrap_or_default();
        if local_name(name).is_empty() {
            let what = Some("a tag without a name".to_owned());
            return Err(Malformed { offset, what });
        }
        Ok(XmlEvent::Start {
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

/// Returns the name without its namespace prefix.
pub(super) fn local_name(qualified: &str) -> &str {
    let local = qualified.rsplit_once(':');
    local.map_or(qualified, |(_, local)| local)
}

/// Returns the raw value of one attribute. Fails if the tag before the attribute is not a list of
/// `name="value"`.
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
