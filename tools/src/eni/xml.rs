//! An ENI as a tree of elements, to and from text. The order of elements matters (`xs:sequence`), so
//! the tree keeps it.
//!
//! Reading is bounded: length, depth, elements and attributes have limits, and a document type with
//! its entities is refused.

use ecaxis_esi::Position;
use quick_xml::events::{BytesDecl, BytesEnd, BytesStart, BytesText, Event};
use quick_xml::{Reader, Writer, XmlVersion, escape};

/// The largest file in bytes.
pub const MAX_BYTES: u64 = 64 << 20;
/// The largest number of elements: 500 devices have about 350,000.
const MAX_ELEMENTS: usize = 500_000;
const MAX_DEPTH: usize = 32;
const MAX_ATTRIBUTES: usize = 32;

/// Why a file is not usable as an ENI.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{position}: {message}")]
pub struct EniError {
    pub position: Position,
    pub message: String,
    /// What the user can do.
    pub help: &'static str,
}

/// One element with its text or its children.
#[derive(Debug, Clone, Default)]
pub struct Element {
    pub name: String,
    pub attributes: Vec<(String, String)>,
    pub text: String,
    pub children: Vec<Self>,
    /// Where it starts in the file.
    pub position: Position,
}

const DAMAGED: &str = "the file is damaged or incomplete: export it again";

impl Element {
    #[must_use]
    pub fn new(name: &str) -> Self {
        Self {
            name: name.to_owned(),
            ..Self::default()
        }
    }

    /// Adds a child with a text.
    #[must_use]
    pub fn with(mut self, name: &str, text: impl ToString) -> Self {
        let text = text.to_string();
        self.children.push(Self {
            text,
            ..Self::new(name)
        });
        self
    }

    /// Adds a child with a text, if there is one.
    #[must_use]
    pub fn with_some(self, name: &str, text: Option<impl ToString>) -> Self {
        match text {
            Some(text) => self.with(name, text),
            None => self,
        }
    }

    #[must_use]
    pub fn with_attribute(mut self, name: &str, value: impl ToString) -> Self {
        self.attributes.push((name.to_owned(), value.to_string()));
        self
    }

    #[must_use]
    pub fn child(mut self, child: Self) -> Self {
        self.children.push(child);
        self
    }

    #[must_use]
    pub fn with_children(mut self, children: impl IntoIterator<Item = Self>) -> Self {
        self.children.extend(children);
        self
    }

    /// Returns the document of this root.
    #[must_use]
    pub fn to_document(&self) -> String {
        let mut writer = Writer::new_with_indent(Vec::new(), b' ', 2);
        let declaration = BytesDecl::new("1.0", Some("UTF-8"), None);
        // Writing to memory cannot fail.
        let _ = writer.write_event(Event::Decl(declaration));
        let _ = self.write(&mut writer);
        let mut text = String::from_utf8(writer.into_inner()).unwrap_or_default();
        text.push('\n');
        text
    }

    fn write(&self, writer: &mut Writer<Vec<u8>>) -> std::io::Result<()> {
        let mut start = BytesStart::new(self.name.as_str());
        for (name, value) in &self.attributes {
            start.push_attribute((name.as_str(), printable(value).as_str()));
        }
        if self.text.is_empty() && self.children.is_empty() {
            return writer.write_event(Event::Empty(start));
        }
        writer.write_event(Event::Start(start))?;
        if !self.text.is_empty() {
            let text = printable(&self.text);
            writer.write_event(Event::Text(BytesText::new(&text)))?;
        }
        for child in &self.children {
            child.write(writer)?;
        }
        writer.write_event(Event::End(BytesEnd::new(self.name.as_str())))
    }

    /// Reads a document.
    ///
    /// # Errors
    /// The first place at which it is not well-formed, or beyond the limits.
    pub fn parse(text: &str) -> Result<Self, EniError> {
        Parser {
            text,
            reader: Reader::from_str(text),
            counted: 0,
            position: Position { line: 1, column: 1 },
        }
        .document()
    }
}

/// Replaces characters that XML 1.0 does not permit.
fn printable(text: &str) -> String {
    let permitted = |c: char| matches!(c, '\t' | '\n' | '\r' | ' '..='\u{d7ff}' | '\u{e000}'..='\u{fffd}' | '\u{10000}'..);
    let replaced = text.chars().map(|c| if permitted(c) { c } else { '?' });
    replaced.collect()
}

struct Parser<'t> {
    text: &'t str,
    reader: Reader<&'t [u8]>,
    /// The bytes that `position` has passed.
    counted: usize,
    position: Position,
}

impl Parser<'_> {
    fn document(mut self) -> Result<Element, EniError> {
        let mut open: Vec<Element> = Vec::new();
        let mut root = None;
        let mut elements = 0;
        loop {
            self.advance(to_usize(self.reader.buffer_position()));
            let event = self.reader.read_event();
            let event = event.map_err(|error| {
                self.advance(to_usize(self.reader.error_position()));
                self.error(format!("not well-formed XML: {error}"), DAMAGED)
            })?;
            match event {
                Event::Start(ref tag) | Event::Empty(ref tag) => {
                    elements += 1;
                    if elements > MAX_ELEMENTS || open.len() >= MAX_DEPTH {
                        let message = match open.len() >= MAX_DEPTH {
                            true => format!("elements are nested deeper than {MAX_DEPTH}"),
                            false => format!("more than {MAX_ELEMENTS} elements"),
                        };
                        return Err(self.error(message, "no ENI needs that: name another file"));
                    }
                    if root.is_some() {
                        return Err(self.error("a second root element".to_owned(), DAMAGED));
                    }
                    let element = self.element(tag)?;
                    match event {
                        Event::Start(_) => open.push(element),
                        _ => attach(element, &mut open, &mut root),
                    }
                }
                Event::End(_) => {
                    if let Some(element) = open.pop() {
                        attach(element, &mut open, &mut root);
                    }
                }
                Event::Text(text) => {
                    let text = text.xml_content(XmlVersion::Implicit1_0);
                    add_text(&mut open, &text);
                }
                Event::CData(text) => {
                    let text = text.xml_content(XmlVersion::Implicit1_0);
                    add_text(&mut open, &text);
                }
                Event::GeneralRef(reference) => {
                    let text = escape::unescape(&format!("&{};", &*reference))
                        .map(std::borrow::Cow::into_owned);
                    let text = text.map_err(|_| {
                        let message = format!("unknown entity &{};", shorten(&reference));
                        self.error(message, "write the text itself instead of an entity")
                    })?;
                    add_text(&mut open, &text);
                }
                Event::DocType(_) => {
                    let message = "a document type (<!DOCTYPE>), which no ENI has".to_owned();
                    return Err(self.error(message, "remove it: entities are not read"));
                }
                Event::Eof => break,
                Event::Comment(_) | Event::Decl(_) | Event::PI(_) => {}
            }
        }
        if let Some(element) = open.last() {
            let message = format!("the file ends inside <{}>", shorten(&element.name));
            return Err(self.error(message, DAMAGED));
        }
        let empty = || self.error("there is no XML element in the file".to_owned(), DAMAGED);
        root.ok_or_else(empty)
    }

    fn element(&self, tag: &BytesStart<'_>) -> Result<Element, EniError> {
        let mut element = Element {
            name: local_name(tag.name().0).to_owned(),
            position: self.position,
            ..Element::default()
        };
        for attribute in tag.attributes() {
            let attribute = attribute
                .map_err(|error| self.error(format!("not well-formed XML: {error}"), DAMAGED))?;
            if element.attributes.len() >= MAX_ATTRIBUTES {
                let message = format!("more than {MAX_ATTRIBUTES} attributes");
                return Err(self.error(message, DAMAGED));
            }
            let name = local_name(attribute.key.0).to_owned();
            element
                .attributes
                .push((name, attribute.value.into_owned()));
        }
        Ok(element)
    }

    /// Moves the position to a byte of the text.
    fn advance(&mut self, to: usize) {
        let passed = self.text.get(self.counted..to).unwrap_or_default();
        for c in passed.chars() {
            match c {
                '\n' => {
                    self.position.line = self.position.line.saturating_add(1);
                    self.position.column = 1;
                }
                _ => self.position.column = self.position.column.saturating_add(1),
            }
        }
        self.counted = self.counted.max(to);
    }

    fn error(&self, message: String, help: &'static str) -> EniError {
        EniError {
            position: self.position,
            message,
            help,
        }
    }
}

fn attach(element: Element, open: &mut [Element], root: &mut Option<Element>) {
    match open.last_mut() {
        Some(parent) => parent.children.push(element),
        None => *root = Some(element),
    }
}

/// Adds text to the innermost element, without the white space between elements.
fn add_text(open: &mut [Element], text: &str) {
    if let Some(element) = open.last_mut()
        && (element.children.is_empty() || !text.trim().is_empty())
    {
        element.text.push_str(text);
    }
}

fn local_name(qualified: &str) -> &str {
    let local = qualified.rsplit_once(':');
    local.map_or(qualified, |(_, local)| local)
}

fn to_usize(offset: u64) -> usize {
    usize::try_from(offset).unwrap_or(usize::MAX)
}

/// Returns the start of a text for a message.
pub(super) fn shorten(text: &str) -> String {
    text.chars().take(40).collect()
}
