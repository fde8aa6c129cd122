//! Names in several languages.

use super::cursor::{Cursor, Element};
use crate::error::EsiError;
use crate::model::LocalName;

const ENGLISH: u32 = 1033;

/// Collects sibling `Name` elements.
#[derive(Default)]
pub(super) struct Names {
    first: Option<LocalName>,
    /// Few have more than one.
    more: Vec<LocalName>,
}

impl Names {
    pub fn add<'a>(
        &mut self,
        cursor: &mut Cursor<'a>,
        element: &Element<'a>,
    ) -> Result<(), EsiError> {
        let lcid = cursor.value(element, "LcId")?;
        let lcid = lcid.and_then(|id| id.trim().parse().ok());
        let text = cursor.text(element)?;
        let name = LocalName { lcid, text };
        match &self.first {
            None => self.first = Some(name),
            Some(_) => self.more.push(name),
        }
        Ok(())
    }

    /// English where it is marked, else the first.
    pub fn take(self) -> String {
        let is_english = |name: &LocalName| name.lcid == Some(ENGLISH);
        let Some(first) = self.first else {
            return String::new();
        };
        if is_english(&first) {
            return first.text;
        }
        let english = self.more.into_iter().find(is_english);
        english.unwrap_or(first).text
    }

    /// The same, and all of them.
    pub fn take_all(self) -> (String, Vec<LocalName>) {
        let all = self.first.iter().chain(&self.more).cloned().collect();
        (self.take(), all)
    }
}
