//! A pull cursor over quick-xml's events that knows line, column and element path, refuses to nest without
//! bound and meters how much a file may make us allocate. General entities are never expanded.

use quick_xml::escape::resolve_xml_entity;
use quick_xml::events::{BytesRef, BytesStart, Event};
use quick_xml::{Reader, XmlVersion};

use super::number;
use crate::error::{EsiError, EsiProblem};
use crate::model::{Position, SlotDependence, Warning};

const MAX_DEPTH: usize = 64;
const MAX_WARNINGS: usize = 500;
/// Bytes of data that one file's objects may expand to; the largest known file needs a tenth of it. A choice
/// copies them.
const MAX_EXPANSION: usize = 32 << 20;

/// Elements that occur several times and therefore carry their number in a path.
const NUMBERED: [&str; 16] = [
    "Device",
    "Module",
    "Fmmu",
    "Sm",
    "RxPdo",
    "TxPdo",
    "Entry",
    "Exclude",
    "InitCmd",
    "OpMode",
    "Slot",
    "ModuleIdent",
    "DataType",
    "SubItem",
    "Object",
    "EtherCATInfo",
];

pub(super) struct Cursor<'a> {
    reader: Reader<&'a [u8]>,
    text: &'a str,
    stack: Vec<Level<'a>>,
    /// Names of the root's level, for numbering.
    top: Vec<(&'a str, u32)>,
    at: Position,
    at_offset: usize,
    spent: usize,
    pub warnings: Vec<Warning>,
}

struct Level<'a> {
    name: &'a str,
    number: u32,
    position: Position,
    /// Only what is numbered in paths.
    seen: Vec<(&'a str, u32)>,
}

/// A start tag. Whoever receives it reads its children or its text; what is left unread is skipped.
pub(super) struct Element<'a> {
    pub name: &'a str,
    pub position: Position,
    number: u32,
    start: BytesStart<'a>,
    depth: usize,
}

enum Token<'a> {
    Start(Element<'a>),
    Text(String),
    End,
    Eof,
}

impl<'a> Cursor<'a> {
    pub fn new(text: &'a str) -> Self {
        let mut reader = Reader::from_str(text);
        reader.config_mut().expand_empty_elements = true;
        Self {
            reader,
            text,
            stack: Vec::new(),
            top: Vec::new(),
            at: Position { line: 1, column: 1 },
            at_offset: 0,
            spent: 0,
            warnings: Vec::new(),
        }
    }

    /// The first element of the document.
    pub fn root(&mut self) -> Result<Element<'a>, EsiError> {
        loop {
            match self.token()? {
                Token::Start(element) => return Ok(element),
                Token::Text(_) | Token::End => {}
                Token::Eof => return Err(self.error(EsiProblem::Empty)),
            }
        }
    }

    /// Calls `visit` with every child element of `parent`.
    pub fn children(
        &mut self,
        parent: &Element<'a>,
        mut visit: impl FnMut(&mut Self, &Element<'a>) -> Result<(), EsiError>,
    ) -> Result<(), EsiError> {
        while self.stack.len() >= parent.depth {
            match self.token()? {
                Token::Start(child) => {
                    visit(self, &child)?;
                    self.finish(child.depth)?;
                }
                Token::Text(_) | Token::End => {}
                Token::Eof => return Err(self.truncated()),
            }
        }
        Ok(())
    }

    /// The element's own text, trimmed.
    pub fn text(&mut self, element: &Element<'a>) -> Result<String, EsiError> {
        let mut text = String::new();
        while self.stack.len() >= element.depth {
            match self.token()? {
                Token::Start(child) => self.finish(child.depth)?,
                Token::Text(part) => text.push_str(&part),
                Token::End => {}
                Token::Eof => return Err(self.truncated()),
            }
        }
        Ok(text.trim().to_owned())
    }

    pub fn number<T>(&mut self, element: &Element<'a>, what: &'static str) -> Result<T, EsiError>
    where
        T: TryFrom<i128> + Bounds,
    {
        let text = self.text(element)?;
        self.to_number(element, what, &text)
    }

    /// Like [`Self::number`]; an empty element counts as absent.
    pub fn optional_number<T>(
        &mut self,
        element: &Element<'a>,
        what: &'static str,
    ) -> Result<Option<T>, EsiError>
    where
        T: TryFrom<i128> + Bounds,
    {
        let text = self.text(element)?;
        if text.is_empty() {
            Ok(None)
        } else {
            self.to_number(element, what, &text).map(Some)
        }
    }

    pub fn hex_bytes(
        &mut self,
        element: &Element<'a>,
        what: &'static str,
    ) -> Result<Vec<u8>, EsiError> {
        let text = self.text(element)?;
        number::hex_bytes(&text).ok_or_else(|| {
            self.error_at(
                element,
                EsiProblem::HexBytes {
                    what,
                    text: shorten(&text),
                },
            )
        })
    }

    pub fn attribute(&self, element: &Element<'a>, name: &str) -> Result<Option<String>, EsiError> {
        for attribute in element.start.attributes().with_checks(false) {
            let attribute = attribute.map_err(|e| {
                self.error_at(element, EsiProblem::Syntax(format!("attribute: {e}")))
            })?;
            if attribute.key.local_name().as_ref() == name {
                let value = attribute
                    .normalized_value(XmlVersion::Implicit1_0)
                    .map_err(|e| {
                        self.error_at(
                            element,
                            EsiProblem::Syntax(format!("attribute {name}: {e}")),
                        )
                    })?;
                return Ok(Some(value.into_owned()));
            }
        }
        Ok(None)
    }

    /// A numeric attribute; an empty one counts as absent.
    pub fn attribute_number<T>(
        &self,
        element: &Element<'a>,
        name: &'static str,
    ) -> Result<Option<T>, EsiError>
    where
        T: TryFrom<i128> + Bounds,
    {
        match self.attribute(element, name)? {
            Some(text) if !text.trim().is_empty() => self.to_number(element, name, &text).map(Some),
            _ => Ok(None),
        }
    }

    pub fn attribute_flag(&mut self, element: &Element<'a>, name: &str) -> Result<bool, EsiError> {
        Ok(self.attribute_optional_flag(element, name)? == Some(true))
    }

    pub fn attribute_optional_flag(
        &mut self,
        element: &Element<'a>,
        name: &str,
    ) -> Result<Option<bool>, EsiError> {
        // Some makers write Default="".
        let Some(text) = self
            .attribute(element, name)?
            .filter(|text| !text.trim().is_empty())
        else {
            return Ok(None);
        };
        let flag = number::boolean(&text);
        if flag.is_none() {
            let text = shorten(&text);
            self.warn(
                element,
                format!("{name}={text:?} is neither true nor false; taken as false"),
            );
        }
        Ok(flag)
    }

    /// `DependOnSlot` and `DependOnSlotGroup` of an index.
    pub fn slot_dependence(&mut self, element: &Element<'a>) -> Result<SlotDependence, EsiError> {
        Ok(SlotDependence {
            slot: self.attribute_flag(element, "DependOnSlot")?,
            group: self.attribute_flag(element, "DependOnSlotGroup")?,
        })
    }

    /// The element's text as true or false; anything else is false, with a warning.
    pub fn flag(&mut self, element: &Element<'a>) -> Result<bool, EsiError> {
        let text = self.text(element)?;
        if let Some(flag) = number::boolean(&text) {
            return Ok(flag);
        }
        let (name, text) = (element.name, shorten(&text));
        self.warn(
            element,
            format!("{name} {text:?} is neither true nor false; taken as false"),
        );
        Ok(false)
    }

    pub fn warn(&mut self, element: &Element<'a>, message: String) {
        self.warn_at(element.position, element, message);
    }

    /// For oddities found after the element itself was left; `within` names the part of the file.
    pub fn warn_at(&mut self, position: Position, within: &Element<'a>, message: String) {
        if self.warnings.len() < MAX_WARNINGS {
            let path = self.path_of(within);
            self.warnings.push(Warning {
                position,
                path,
                message,
            });
        }
    }

    /// Accounts for `bytes` of data built from what stands at `position`.
    pub fn spend(
        &mut self,
        bytes: usize,
        (position, within): (Position, &Element<'a>),
    ) -> Result<(), EsiError> {
        self.spent = self.spent.saturating_add(bytes);
        if self.spent > MAX_EXPANSION {
            let (what, limit) = ("the objects' bytes", MAX_EXPANSION);
            return Err(self.error_within(position, within, EsiProblem::TooLarge { what, limit }));
        }
        Ok(())
    }

    /// For what is found after the element itself was left; `within` names the part of the file.
    pub fn error_within(
        &self,
        position: Position,
        within: &Element<'a>,
        problem: EsiProblem,
    ) -> EsiError {
        EsiError::new(position, self.path_of(within), problem)
    }

    pub fn error_at(&self, element: &Element<'a>, problem: EsiProblem) -> EsiError {
        EsiError::new(element.position, self.path_of(element), problem)
    }

    fn error(&self, problem: EsiProblem) -> EsiError {
        let position = self.stack.last().map_or(self.at, |level| level.position);
        EsiError::new(position, self.current_path(), problem)
    }

    fn truncated(&self) -> EsiError {
        let name = self.stack.last().map_or("", |level| level.name);
        self.error(EsiProblem::Truncated(shorten(name)))
    }

    fn to_number<T>(
        &self,
        element: &Element<'a>,
        what: &'static str,
        text: &str,
    ) -> Result<T, EsiError>
    where
        T: TryFrom<i128> + Bounds,
    {
        number::number(text)
            .and_then(|n| T::try_from(n).ok())
            .ok_or_else(|| {
                let problem = EsiProblem::Number {
                    what,
                    text: shorten(text),
                    min: T::MIN,
                    max: T::MAX,
                };
                self.error_at(element, problem)
            })
    }

    /// Reads on until the element at `depth` is closed.
    fn finish(&mut self, depth: usize) -> Result<(), EsiError> {
        while self.stack.len() >= depth {
            if let Token::Eof = self.token()? {
                return Err(self.truncated());
            }
        }
        Ok(())
    }

    fn token(&mut self) -> Result<Token<'a>, EsiError> {
        loop {
            let offset = usize::try_from(self.reader.buffer_position()).unwrap_or(usize::MAX);
            let event = match self.reader.read_event() {
                Ok(event) => event,
                Err(error) => {
                    self.move_to(usize::try_from(self.reader.error_position()).unwrap_or(offset));
                    let path = self.current_path();
                    return Err(EsiError::new(
                        self.at,
                        path,
                        EsiProblem::Syntax(error.to_string()),
                    ));
                }
            };
            match event {
                Event::Start(start) => return self.open(start, offset).map(Token::Start),
                Event::End(_) => {
                    self.stack.pop();
                    return Ok(Token::End);
                }
                Event::Text(text) => return Ok(Token::Text(text.xml10_content().into_owned())),
                Event::CData(text) => return Ok(Token::Text(text.xml10_content().into_owned())),
                Event::GeneralRef(reference) => return Ok(Token::Text(self.reference(&reference))),
                Event::Eof => return Ok(Token::Eof),
                // expand_empty_elements leaves no Empty; the others carry nothing for us.
                Event::Empty(_)
                | Event::Decl(_)
                | Event::PI(_)
                | Event::DocType(_)
                | Event::Comment(_) => {}
            }
        }
    }

    fn open(&mut self, start: BytesStart<'a>, offset: usize) -> Result<Element<'a>, EsiError> {
        self.move_to(offset);
        let length = start.name().as_ref().len();
        let qualified = self
            .text
            .get(offset.saturating_add(1)..)
            .and_then(|rest| rest.get(..length))
            .unwrap_or("");
        let name = qualified.rsplit(':').next().unwrap_or(qualified);
        let seen = self
            .stack
            .last_mut()
            .map_or(&mut self.top, |level| &mut level.seen);
        let number = match seen.iter_mut().find(|(known, _)| *known == name) {
            _ if !NUMBERED.contains(&name) => 1,
            Some((_, count)) => {
                *count = count.saturating_add(1);
                *count
            }
            None => {
                seen.push((name, 1));
                1
            }
        };
        if self.stack.len() >= MAX_DEPTH {
            return Err(self.error(EsiProblem::TooDeep { limit: MAX_DEPTH }));
        }
        self.stack.push(Level {
            name,
            number,
            position: self.at,
            seen: Vec::new(),
        });
        Ok(Element {
            name,
            position: self.at,
            number,
            start,
            depth: self.stack.len(),
        })
    }

    /// Character references and XML's own five; everything else stays as written.
    fn reference(&mut self, reference: &BytesRef<'_>) -> String {
        if let Ok(Some(character)) = reference.resolve_char_ref() {
            return character.to_string();
        }
        let name = reference.xml10_content();
        if let Some(text) = resolve_xml_entity(&name) {
            return text.to_owned();
        }
        if self.warnings.len() < MAX_WARNINGS {
            let position = self.stack.last().map_or(self.at, |level| level.position);
            let message = format!("entity &{}; is not expanded", shorten(&name));
            self.warnings.push(Warning {
                position,
                path: self.current_path(),
                message,
            });
        }
        format!("&{name};")
    }

    fn move_to(&mut self, offset: usize) {
        let Some(passed) = self.text.get(self.at_offset..offset) else {
            return;
        };
        for character in passed.chars() {
            step(&mut self.at, character);
        }
        self.at_offset = offset;
    }

    /// Also of an element that was left already; what is around it is still open.
    fn path_of(&self, element: &Element<'a>) -> String {
        let mut path = self.path(element.depth.saturating_sub(1));
        append(&mut path, element.name, element.number);
        path
    }

    fn path(&self, depth: usize) -> String {
        let mut path = String::new();
        for level in self.stack.iter().take(depth) {
            append(&mut path, level.name, level.number);
        }
        path
    }

    /// Of what is read right now; before and behind the root that is the file.
    fn current_path(&self) -> String {
        match self.stack.len() {
            0 => "(file)".to_owned(),
            depth => self.path(depth),
        }
    }
}

fn append(path: &mut String, name: &str, number: u32) {
    if !path.is_empty() {
        path.push('/');
    }
    path.push_str(&shorten(name));
    if NUMBERED.contains(&name) && (number > 1 || name != "EtherCATInfo") {
        path.push_str(&format!("[{number}]"));
    }
}

/// Line and column of a byte of `text`.
pub(super) fn position(text: &str, offset: usize) -> Position {
    let mut position = Position { line: 1, column: 1 };
    for character in text.get(..offset).unwrap_or_default().chars() {
        step(&mut position, character);
    }
    position
}

fn step(position: &mut Position, character: char) {
    if character == '\n' {
        position.line = position.line.saturating_add(1);
        position.column = 1;
    } else {
        position.column = position.column.saturating_add(1);
    }
}

/// The range of a number type, for error texts.
pub(super) trait Bounds {
    const MIN: i128;
    const MAX: i128;
}

macro_rules! bounds {
    ($($type:ty),*) => {
        $(impl Bounds for $type {
            const MIN: i128 = <$type>::MIN as i128;
            const MAX: i128 = <$type>::MAX as i128;
        })*
    };
}
bounds!(u8, u16, u32, i32, i64);

/// Keeps what a damaged file may put into an error text short.
fn shorten(text: &str) -> String {
    text.chars().take(40).collect()
}
