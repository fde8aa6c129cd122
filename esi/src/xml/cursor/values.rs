//! Text, numbers and flags of elements and attributes.

use std::borrow::Cow;

use super::super::{number, scan};
use super::entities::{expand, line_ends};
use super::path::shorten;
use super::{Cursor, Element, Token};
use crate::error::{EsiError, EsiProblem};
use crate::model::SlotDependence;

impl<'a> Cursor<'a> {
    /// Returns the element's own text, trimmed.
    pub fn text(&mut self, element: &Element<'a>) -> Result<String, EsiError> {
        self.content(element).map(Cow::into_owned)
    }

    /// Same as [`Self::text`], but borrowed if the file contains the text in one piece.
    pub fn content(&mut self, element: &Element<'a>) -> Result<Cow<'a, str>, EsiError> {
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

    /// Same as [`Self::number`], but an empty element counts as absent.
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

    /// Returns an attribute value, borrowed if it needs no change.
    pub fn value(
        &self,
        element: &Element<'a>,
        name: &str,
    ) -> Result<Option<Cow<'a, str>>, EsiError> {
        if element.attributes.is_empty() {
            return Ok(None);
        }
        let value = scan::attribute(element.attributes, name)
            .map_err(|problem| self.error_at(element, EsiProblem::Syntax(problem.to_string())))?;
        let Some(raw) = value else {
            return Ok(None);
        };
        let plain = !raw
            .bytes()
            .any(|byte| matches!(byte, b'&' | b'\t' | b'\r' | b'\n'));
        if plain {
            return Ok(Some(raw));
        }
        let spaced = raw.replace("\r\n", " ").replace(['\t', '\r', '\n'], " ");
        let mut unknown = None;
        let expanded = expand(&spaced, |entity| {
            unknown.get_or_insert_with(|| shorten(entity));
        });
        match unknown.filter(|entity| !entity.is_empty()) {
            Some(entity) => {
                let problem = format!("attribute {name}: unknown entity &{entity};");
                Err(self.error_at(element, EsiProblem::Syntax(problem)))
            }
            None => Ok(Some(Cow::Owned(expanded))),
        }
    }

    /// Returns a numeric attribute; an empty one counts as absent.
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
        // Some vendors write Default="".
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

    /// Reads `DependOnSlot` and `DependOnSlotGroup` of an index.
    pub fn slot_dependence(&mut self, element: &Element<'a>) -> Result<SlotDependence, EsiError> {
        if element.attributes.is_empty() {
            return Ok(SlotDependence::default());
        }
        Ok(SlotDependence {
            slot: self.attribute_flag(element, "DependOnSlot")?,
            group: self.attribute_flag(element, "DependOnSlotGroup")?,
        })
    }

    /// Returns the element's text as a Boolean. Invalid text counts as false and causes a warning.
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
}

/// The range of a number type, for error texts.
pub(in super::super) trait Bounds {
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
