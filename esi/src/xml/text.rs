//! Names in several languages.

use std::borrow::Cow;

use super::cursor::{Cursor, Element};
use crate::error::EsiError;
use crate::model::LocalName;

const ENGLISH: u32 = 1033;

/// Collects sibling `Name` elements, borrowed if the file contains the text in one piece.
#[derive(Default)]
pub(super) struct Names<'a> {
    first: Option<Name<'a>>,
    /// Further names; few elements have more than one.
    more: Vec<Name<'a>>,
}

struct Name<'a> {
    lcid: Option<u32>,
    text: Cow<'a, str>,
}

impl<'a> Names<'a> {
    pub fn add(&mut self, cursor: &mut Cursor<'a>, element: &Element<'a>) -> Result<(), EsiError> {
        let lcid = cursor.value(element, "LcId")?;
        let lcid = lcid.and_then(|id| id.trim().parse().ok());
        let text = cursor.content(element)?;
        let name = Name { lcid, text };
        match &self.first {
            None => self.first = Some(name),
            Some(_) => self.more.push(name),
        }
        Ok(())
    }

    /// Returns the English name if one is marked, otherwise the first.
    pub fn take(self) -> Cow<'a, str> {
        let is_english = |name: &Name<'_>| name.lcid == Some(ENGLISH);
        let Some(first) = self.first else {
            return Cow::default();
        };
        if is_english(&first) {
            return first.text;
        }
        let english = self.more.into_iter().find(is_english);
        english.unwrap_or(first).text
    }

    /// Same as [`Self::take`], with all names.
    pub fn take_all(self) -> (String, Vec<LocalName>) {
        let all = self.first.iter().chain(&self.more).map(|name| LocalName {
            lcid: name.lcid,
            text: name.text.clone().into_owned(),
        });
        let all = all.collect();
        (self.take().into_owned(), all)
    }
}
