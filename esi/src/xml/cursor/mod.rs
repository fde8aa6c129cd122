//! A pull cursor over the scanner's events. The cursor tracks line, column and element path, and
//! limits nesting depth and allocated memory.
//!
//! This file moves from element to element. `values` reads text, numbers and flags, `entities`
//! expands references, `path` formats element paths, and `problems` creates warnings and errors.

mod entities;
mod path;
mod problems;
mod values;

use super::lines::Lines;
use super::pdo::PdoDefinitions;
use super::scan::{Malformed, XmlEvent, XmlReader, local_name};
use crate::error::{EsiError, EsiProblem};
use crate::model::{Position, Warning};
use path::{NUMBERED, shorten};

const MAX_DEPTH: usize = 64;

pub(super) struct Cursor<'a> {
    scanner: XmlReader<'a>,
    lines: Lines<'a>,
    /// The open elements. Levels beyond `depth` stay allocated for reuse.
    stack: Vec<Level<'a>>,
    depth: usize,
    /// The siblings of the root, for numbering.
    top: Level<'a>,
    /// True if the element on top of the stack has the form `<…/>`.
    ends_at_once: bool,
    spent: usize,
    /// The number of `Device` elements so far, over all lists of the file.
    pub devices: u32,
    pub warnings: Vec<Warning>,
    /// The PDOs with a `RefName`.
    pub pdo_definitions: PdoDefinitions,
    /// The first error that caused an element to be skipped.
    pub first_left_out: Option<EsiError>,
}

#[derive(Default)]
struct Level<'a> {
    /// The name with its prefix, as the end tag must contain it.
    qualified: &'a str,
    number: u32,
    offset: usize,
    /// The number of children so far, for each numbered element name.
    seen: [u32; NUMBERED],
}

/// A start tag. The receiver reads its children or its text; unread parts are skipped.
#[derive(Clone, Copy)]
pub(super) struct Element<'a> {
    pub name: &'a str,
    attributes: &'a str,
    offset: usize,
    number: u32,
    depth: usize,
}

/// The end of a start tag.
pub(super) struct Mark {
    offset: usize,
    ends_at_once: bool,
    warnings: usize,
}

impl Element<'_> {
    /// Returns the start offset, for [`Cursor::at`].
    pub fn offset(&self) -> usize {
        self.offset
    }
}

enum Token<'a> {
    Start(Element<'a>),
    /// Text with unexpanded references.
    Text(&'a str),
    CData(&'a str),
    End,
    Eof,
}

impl<'a> Cursor<'a> {
    pub fn new(text: &'a str) -> Self {
        Self {
            scanner: XmlReader::new(text),
            lines: Lines::new(text),
            stack: Vec::new(),
            depth: 0,
            top: Level::default(),
            ends_at_once: false,
            spent: 0,
            devices: 0,
            warnings: Vec::new(),
            pdo_definitions: PdoDefinitions::default(),
            first_left_out: None,
        }
    }

    /// Returns the position at which the element starts.
    pub fn position(&self, element: &Element<'_>) -> Position {
        self.at(element.offset)
    }

    /// Returns line and column of a byte offset in the text.
    pub fn at(&self, offset: usize) -> Position {
        let (line, column) = self.lines.position(offset);
        Position { line, column }
    }

    /// Returns the first element of the document.
    pub fn root(&mut self) -> Result<Element<'a>, EsiError> {
        let text = self.scanner.rest(0).trim_ascii_start();
        if !text.is_empty() && !text.starts_with(b"<") {
            return Err(self.error(EsiProblem::NotXml));
        }
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

    /// Skips an unreadable element and continues after it. Fails if the text after the element is
    /// unreadable.
    pub fn leave_out(
        &mut self,
        element: &Element<'a>,
        read: Result<(), EsiError>,
    ) -> Result<(), EsiError> {
        let Err(error) = read else {
            return Ok(());
        };
        if !error.problem().is_of_one_element() {
            return Err(error);
        }
        self.left_out(&error);
        self.finish(element.depth)
    }

    /// Same as [`Self::leave_out`], but damaged text is skipped up to the next end tag of the same
    /// name.
    pub fn leave_out_damaged(
        &mut self,
        element: &Element<'a>,
        read: Result<(), EsiError>,
    ) -> Result<(), EsiError> {
        let Err(error) = self.leave_out(element, read) else {
            return Ok(());
        };
        let level = self.stack.get(element.depth.saturating_sub(1));
        let end = format!("</{}>", level.map_or("", |level| level.qualified));
        let from = self.scanner.offset().max(element.offset);
        let Some(at) = memchr::memmem::find(self.scanner.rest(from), end.as_bytes()) else {
            return Err(error);
        };
        self.left_out(&error);
        self.scanner.begin_at(from + at + end.len());
        self.ends_at_once = false;
        self.depth = element.depth.saturating_sub(1);
        Ok(())
    }

    /// Returns the offset after the start tag that was read last, for [`Self::rewind`].
    pub fn mark(&self) -> Mark {
        Mark {
            offset: self.scanner.offset(),
            ends_at_once: self.ends_at_once,
            warnings: self.warnings.len(),
        }
    }

    /// Continues after the start tag of the element.
    pub fn rewind(&mut self, element: &Element<'a>, mark: Mark) {
        self.scanner.begin_at(mark.offset);
        self.ends_at_once = mark.ends_at_once;
        self.warnings.truncate(mark.warnings);
        self.depth = element.depth;
        if let Some(level) = self.stack.get_mut(element.depth.saturating_sub(1)) {
            level.seen = [0; NUMBERED];
        }
    }

    /// Reads until the element at `depth` is closed.
    fn finish(&mut self, depth: usize) -> Result<(), EsiError> {
        while self.depth >= depth {
            if let Token::Eof = self.tag()? {
                return Err(self.truncated());
            }
        }
        Ok(())
    }

    fn token(&mut self) -> Result<Token<'a>, EsiError> {
        if std::mem::take(&mut self.ends_at_once) {
            self.depth = self.depth.saturating_sub(1);
            return Ok(Token::End);
        }
        let piece = self.scanner.next();
        self.take(piece)
    }

    /// Returns the next token that is not text.
    fn tag(&mut self) -> Result<Token<'a>, EsiError> {
        if std::mem::take(&mut self.ends_at_once) {
            self.depth = self.depth.saturating_sub(1);
            return Ok(Token::End);
        }
        let piece = self.scanner.next_tag();
        self.take(piece)
    }

    #[inline(always)]
    fn take(&mut self, piece: Result<XmlEvent<'a>, Malformed>) -> Result<Token<'a>, EsiError> {
        match piece {
            Ok(XmlEvent::Start {
                name,
                attributes,
                offset,
                empty,
            }) => {
                self.ends_at_once = empty;
                let element = self.open((name, local_name(name)), attributes, offset);
                element.map(Token::Start)
            }
            Ok(XmlEvent::End { name, offset }) => self.close(name, offset),
            Ok(XmlEvent::Text(text)) => Ok(Token::Text(text)),
            Ok(XmlEvent::CData(text)) => Ok(Token::CData(text)),
            Ok(XmlEvent::Eof) => Ok(Token::Eof),
            Err(Malformed { offset, what }) => {
                let problem = match what {
                    Some(what) => EsiProblem::Syntax(what),
                    None => EsiProblem::TruncatedTag,
                };
                Err(EsiError::new(self.at(offset), self.current_path(), problem))
            }
        }
    }

    #[inline]
    fn open(
        &mut self,
        (qualified, name): (&'a str, &'a str),
        attributes: &'a str,
        offset: usize,
    ) -> Result<Element<'a>, EsiError> {
        let number = self.count(name);
        if self.depth >= MAX_DEPTH {
            return Err(self.error(EsiProblem::TooDeep { limit: MAX_DEPTH }));
        }
        if self.stack.len() == self.depth {
            self.stack.push(Level::default());
        }
        if let Some(level) = self.stack.get_mut(self.depth) {
            level.qualified = qualified;
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

    /// Returns the number of a child that starts in the innermost open element.
    #[inline]
    fn count(&mut self, name: &str) -> u32 {
        let parent = match self.depth.checked_sub(1) {
            Some(parent) => self.stack.get_mut(parent),
            None => Some(&mut self.top),
        };
        parent.map_or(1, |parent| parent.count(name))
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

    /// Returns the innermost open element.
    fn within(&self) -> &Level<'a> {
        let last = self.depth.checked_sub(1).and_then(|at| self.stack.get(at));
        last.unwrap_or(&self.top)
    }
}
