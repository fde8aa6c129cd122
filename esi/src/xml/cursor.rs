//! A pull cursor over the scanner's pieces that knows line, column and element path, refuses to nest without
//! bound and meters how much a file may make us allocate. General entities are never expanded.

use std::borrow::Cow;

use super::number;
use super::scan::{self, Lines, Malformed, Piece, Scanner};
use crate::error::{EsiError, EsiProblem};
use crate::model::{Position, SlotDependence, Warning};

const MAX_DEPTH: usize = 64;
const MAX_WARNINGS: usize = 500;
/// Bytes of data that one file's objects may expand to; the largest known file needs a tenth of it. A choice
/// copies them.
const MAX_EXPANSION: usize = 32 << 20;

/// Elements that occur several times and therefore carry their number in a path.
const NUMBERED: usize = 16;

/// Which of them; the length tells most apart.
fn numbered(name: &str) -> Option<usize> {
    let names: &[(usize, &str)] = match name.len() {
        2 => &[(0, "Sm")],
        4 => &[(1, "Fmmu"), (2, "Slot")],
        5 => &[(3, "Entry"), (4, "TxPdo"), (5, "RxPdo")],
        6 => &[(6, "Object"), (7, "Device"), (8, "Module"), (9, "OpMode")],
        7 => &[(10, "SubItem"), (11, "Exclude"), (12, "InitCmd")],
        8 => &[(13, "DataType")],
        11 => &[(14, "ModuleIdent")],
        12 => &[(15, "EtherCATInfo")],
        _ => return None,
    };
    let found = names.iter().find(|(_, known)| *known == name);
    found.map(|(which, _)| *which)
}

pub(super) struct Cursor<'a> {
    scanner: Scanner<'a>,
    lines: Lines<'a>,
    /// Levels beyond `depth` are kept for their memory.
    stack: Vec<Level<'a>>,
    depth: usize,
    /// The root's siblings, for numbering.
    top: Level<'a>,
    /// The element on top of the stack was written `<…/>`.
    ends_at_once: bool,
    spent: usize,
    pub warnings: Vec<Warning>,
}

#[derive(Default)]
struct Level<'a> {
    /// With its prefix, as the end tag must have it.
    qualified: &'a str,
    name: &'a str,
    number: u32,
    offset: usize,
    /// How many of each numbered element below have begun.
    seen: [u32; NUMBERED],
}

impl Level<'_> {
    fn count(&mut self, name: &str) -> u32 {
        match numbered(name).and_then(|which| self.seen.get_mut(which)) {
            Some(count) => {
                *count = count.saturating_add(1);
                *count
            }
            None => 1,
        }
    }
}

/// A start tag. Whoever receives it reads its children or its text; what is left unread is skipped.
#[derive(Clone, Copy)]
pub(super) struct Element<'a> {
    pub name: &'a str,
    attributes: &'a str,
    offset: usize,
    number: u32,
    depth: usize,
}

enum Token<'a> {
    Start(Element<'a>),
    /// References as they are written.
    Text(&'a str),
    CData(&'a str),
    End,
    Eof,
}

impl<'a> Cursor<'a> {
    pub fn new(text: &'a str) -> Self {
        Self {
            scanner: Scanner::new(text),
            lines: Lines::new(text),
            stack: Vec::new(),
            depth: 0,
            top: Level::default(),
            ends_at_once: false,
            spent: 0,
            warnings: Vec::new(),
        }
    }

    /// Where the element starts.
    pub fn position(&self, element: &Element<'_>) -> Position {
        self.at(element.offset)
    }

    /// Line and column of a byte of the text.
    pub fn at(&self, offset: usize) -> Position {
        let (line, column) = self.lines.position(offset);
        Position { line, column }
    }

    /// The first element of the document.
    pub fn root(&mut self) -> Result<Element<'a>, EsiError> {
        loop {
            match self.tag()? {
                Token::Start(element) => return Ok(element),
                Token::Text(_) | Token::CData(_) | Token::End => {}
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
        while self.depth >= parent.depth {
            match self.tag()? {
                Token::Start(child) => {
                    visit(self, &child)?;
                    self.finish(child.depth)?;
                }
                Token::Text(_) | Token::CData(_) | Token::End => {}
                Token::Eof => return Err(self.truncated()),
            }
        }
        Ok(())
    }

    /// The element's own text, trimmed.
    pub fn text(&mut self, element: &Element<'a>) -> Result<String, EsiError> {
        self.content(element).map(Cow::into_owned)
    }

    /// The same, borrowed where it stands in the file in one piece.
    pub fn content(&mut self, element: &Element<'a>) -> Result<Cow<'a, str>, EsiError> {
        if self.depth == element.depth
            && !self.ends_at_once
            && let Some(text) = self.scanner.text_to_end(self.within().qualified)
        {
            let text = text.trim();
            let content = if text.bytes().any(|byte| matches!(byte, b'&' | b'\r')) {
                line_ends(self.expanded(text))
            } else {
                Cow::Borrowed(text)
            };
            self.depth -= 1;
            return Ok(content);
        }
        let mut content = Cow::Borrowed("");
        while self.depth >= element.depth {
            let part = match self.token()? {
                Token::Start(child) => {
                    self.finish(child.depth)?;
                    continue;
                }
                Token::Text(part) => self.expanded(part),
                Token::CData(part) => Cow::Borrowed(part),
                Token::End => continue,
                Token::Eof => return Err(self.truncated()),
            };
            let part = line_ends(part);
            if content.is_empty() {
                content = part;
            } else {
                content.to_mut().push_str(&part);
            }
        }
        Ok(match content {
            Cow::Borrowed(text) => Cow::Borrowed(text.trim()),
            Cow::Owned(text) => Cow::Owned(text.trim().to_owned()),
        })
    }

    pub fn number<T>(&mut self, element: &Element<'a>, what: &'static str) -> Result<T, EsiError>
    where
        T: TryFrom<i128> + Bounds,
    {
        let text = self.content(element)?;
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
        let text = self.content(element)?;
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
        let text = self.content(element)?;
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
        Ok(self.value(element, name)?.map(Cow::into_owned))
    }

    /// The same, borrowed where it needs no change.
    pub fn value(
        &self,
        element: &Element<'a>,
        name: &str,
    ) -> Result<Option<Cow<'a, str>>, EsiError> {
        let value = scan::attribute(element.attributes, name)
            .map_err(|problem| self.error_at(element, EsiProblem::Syntax(problem.to_owned())))?;
        let Some(raw) = value else {
            return Ok(None);
        };
        let plain = !raw
            .bytes()
            .any(|byte| matches!(byte, b'&' | b'\t' | b'\r' | b'\n'));
        if plain {
            return Ok(Some(Cow::Borrowed(raw)));
        }
        let spaced = raw.replace("\r\n", " ").replace(['\t', '\r', '\n'], " ");
        let mut unknown = None;
        let expanded = expand(&spaced, |entity| {
            unknown.get_or_insert_with(|| shorten(entity));
        });
        match unknown.filter(|entity| !entity.is_empty()) {
            Some(entity) => {
                let problem = format!("attribute {name}: nobody knows the entity &{entity};");
                Err(self.error_at(element, EsiProblem::Syntax(problem)))
            }
            None => Ok(Some(Cow::Owned(expanded))),
        }
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
        match self.value(element, name)? {
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
            .value(element, name)?
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
        if element.attributes.is_empty() {
            return Ok(SlotDependence::default());
        }
        Ok(SlotDependence {
            slot: self.attribute_flag(element, "DependOnSlot")?,
            group: self.attribute_flag(element, "DependOnSlotGroup")?,
        })
    }

    /// The element's text as true or false; anything else is false, with a warning.
    pub fn flag(&mut self, element: &Element<'a>) -> Result<bool, EsiError> {
        let text = self.content(element)?;
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
        self.warn_at(self.position(element), element, message);
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
        EsiError::new(self.position(element), self.path_of(element), problem)
    }

    fn error(&self, problem: EsiProblem) -> EsiError {
        EsiError::new(self.at(self.within().offset), self.current_path(), problem)
    }

    /// The element that was begun last and not closed.
    fn within(&self) -> &Level<'a> {
        let last = self.depth.checked_sub(1).and_then(|at| self.stack.get(at));
        last.unwrap_or(&self.top)
    }

    fn truncated(&self) -> EsiError {
        self.error(EsiProblem::Truncated(shorten(self.within().name)))
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
        while self.depth >= depth {
            if let Token::Eof = self.tag()? {
                return Err(self.truncated());
            }
        }
        Ok(())
    }

    fn token(&mut self) -> Result<Token<'a>, EsiError> {
        self.next(Scanner::next)
    }

    /// The next token that is not text.
    fn tag(&mut self) -> Result<Token<'a>, EsiError> {
        let open = self.depth.checked_sub(1).and_then(|at| self.stack.get(at));
        if !self.ends_at_once
            && let Some(level) = open
            && self.scanner.closes(level.qualified)
        {
            self.depth -= 1;
            return Ok(Token::End);
        }
        self.next(Scanner::next_tag)
    }

    #[inline]
    fn next(
        &mut self,
        piece: impl Fn(&mut Scanner<'a>) -> Result<Piece<'a>, Malformed>,
    ) -> Result<Token<'a>, EsiError> {
        if std::mem::take(&mut self.ends_at_once) {
            self.depth = self.depth.saturating_sub(1);
            return Ok(Token::End);
        }
        match piece(&mut self.scanner) {
            Ok(Piece::Start {
                name,
                attributes,
                offset,
                empty,
            }) => {
                self.ends_at_once = empty;
                self.open(name, attributes, offset).map(Token::Start)
            }
            Ok(Piece::End { name, offset }) => self.close(name, offset),
            Ok(Piece::Text(text)) => Ok(Token::Text(text)),
            Ok(Piece::CData(text)) => Ok(Token::CData(text)),
            Ok(Piece::Eof) => Ok(Token::Eof),
            Err(Malformed { offset, what }) => {
                let problem = match what {
                    Some(what) => EsiProblem::Syntax(what.to_owned()),
                    None => EsiProblem::TruncatedTag,
                };
                Err(EsiError::new(self.at(offset), self.current_path(), problem))
            }
        }
    }

    fn open(
        &mut self,
        qualified: &'a str,
        attributes: &'a str,
        offset: usize,
    ) -> Result<Element<'a>, EsiError> {
        let name = scan::local_name(qualified);
        let parent = match self.depth.checked_sub(1) {
            Some(parent) => self.stack.get_mut(parent),
            None => Some(&mut self.top),
        };
        let number = parent.map_or(1, |parent| parent.count(name));
        if self.depth >= MAX_DEPTH {
            return Err(self.error(EsiProblem::TooDeep { limit: MAX_DEPTH }));
        }
        if self.stack.len() == self.depth {
            self.stack.push(Level::default());
        }
        if let Some(level) = self.stack.get_mut(self.depth) {
            level.qualified = qualified;
            level.name = name;
            level.number = number;
            level.offset = offset;
            level.seen = [0; NUMBERED];
        }
        self.depth += 1;
        Ok(Element {
            name,
            attributes,
            offset,
            number,
            depth: self.depth,
        })
    }

    fn close(&mut self, name: &'a str, offset: usize) -> Result<Token<'a>, EsiError> {
        let open = self.depth.checked_sub(1).and_then(|at| self.stack.get(at));
        if open.is_some_and(|level| level.qualified == name) {
            self.depth -= 1;
            return Ok(Token::End);
        }
        let name = shorten(name);
        let problem = match open {
            Some(level) => format!(
                "expected `</{}>`, but `</{name}>` was found",
                shorten(level.qualified)
            ),
            None => format!("</{name}> closes nothing"),
        };
        Err(EsiError::new(
            self.at(offset),
            self.current_path(),
            EsiProblem::Syntax(problem),
        ))
    }

    /// Character references and XML's own five; everything else stays as written, with a warning.
    fn expanded(&mut self, text: &'a str) -> Cow<'a, str> {
        if !text.contains('&') {
            return Cow::Borrowed(text);
        }
        let mut unknown = Vec::new();
        let expanded = expand(text, |name| {
            if unknown.len() < MAX_WARNINGS {
                unknown.push(shorten(name));
            }
        });
        for name in unknown {
            if self.warnings.len() >= MAX_WARNINGS {
                break;
            }
            let message = match name.as_str() {
                "" => "a lone & is taken as it stands".to_owned(),
                name => format!("entity &{name}; is not expanded"),
            };
            self.warnings.push(Warning {
                position: self.at(self.within().offset),
                path: self.current_path(),
                message,
            });
        }
        Cow::Owned(expanded)
    }

    /// Also of an element that was left already; what is around it is still open.
    fn path_of(&self, element: &Element<'a>) -> String {
        let mut path = self.path(element.depth.saturating_sub(1));
        append(&mut path, element.name, element.number);
        path
    }

    fn path(&self, depth: usize) -> String {
        let mut path = String::new();
        for level in self.stack.iter().take(depth.min(self.depth)) {
            append(&mut path, level.name, level.number);
        }
        path
    }

    /// Of what is read right now; before and behind the root that is the file.
    fn current_path(&self) -> String {
        match self.depth {
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
    if numbered(name).is_some() && (number > 1 || name != "EtherCATInfo") {
        path.push_str(&format!("[{number}]"));
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

/// Line ends of other systems become one character, as XML wants it.
fn line_ends(text: Cow<'_, str>) -> Cow<'_, str> {
    match text.contains('\r') {
        true => Cow::Owned(text.replace("\r\n", "\n").replace('\r', "\n")),
        false => text,
    }
}

/// Tells the names of entities that nobody knows, and nothing (`""`) for an `&` that begins none.
fn expand(text: &str, mut unknown: impl FnMut(&str)) -> String {
    let mut out = String::with_capacity(text.len());
    let mut rest = text;
    while let Some((before, after)) = rest.split_once('&') {
        out.push_str(before);
        let is_name = |c: char| c.is_alphanumeric() || matches!(c, '#' | '_' | '-' | '.' | ':');
        let end = after.find(|c| !is_name(c)).unwrap_or(after.len());
        let (name, behind) = after.split_at(end);
        let known = match name {
            "lt" => Some('<'),
            "gt" => Some('>'),
            "amp" => Some('&'),
            "apos" => Some('\''),
            "quot" => Some('"'),
            _ => character(name),
        };
        match (behind.strip_prefix(';').filter(|_| !name.is_empty()), known) {
            (Some(behind), Some(character)) => {
                out.push(character);
                rest = behind;
            }
            (Some(_), None) => {
                unknown(name);
                out.push('&');
                rest = after;
            }
            (None, _) => {
                unknown("");
                out.push('&');
                rest = after;
            }
        }
    }
    out.push_str(rest);
    out
}

/// `#228` or `#xe4`.
fn character(reference: &str) -> Option<char> {
    let digits = reference.strip_prefix('#')?;
    let code = match digits.strip_prefix(['x', 'X']) {
        Some(hex) => u32::from_str_radix(hex, 16).ok()?,
        None => digits.parse().ok()?,
    };
    char::from_u32(code).filter(|character| *character != '\0')
}

/// Keeps what a damaged file may put into an error text short.
fn shorten(text: &str) -> String {
    text.chars().take(40).collect()
}
