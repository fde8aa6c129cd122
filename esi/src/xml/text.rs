//! Names in several languages.

use super::cursor::{Cursor, Element};
use crate::error::EsiError;
use crate::model::LocalName;

const ENGLISH: u32 = 1033;

/// Collects sibling `Name` elements.
#[derive(Default)]
pub(super) struct Names(Vec<LocalName>);

impl Names {
    pub fn add<'a>(
        &mut self,
        cursor: &mut Cursor<'a>,
        element: &Element<'a>,
    ) -> Result<(), EsiError> {
        let lcid = cursor
            .attribute(element, "LcId")?
            .and_then(|id| id.trim().parse().ok());
        let text = cursor.text(element)?;
        self.0.push(LocalName { lcid, text });
        Ok(())
    }

    /// English where it is marked, else the first.
    pub fn take(self) -> String {
        self.take_all().0
    }

    /// The same, and all of them.
    pub fn take_all(mut self) -> (String, Vec<LocalName>) {
        let english = self.0.iter().find(|name| name.lcid == Some(ENGLISH));
        let best = english.or(self.0.first());
        let text = best.map_or_else(String::new, |name| name.text.clone());
        self.0.shrink_to_fit();
        (text, self.0)
    }
}
