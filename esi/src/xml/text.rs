//! Names in several languages.

use super::cursor::{Cursor, Element};
use crate::error::EsiError;

const ENGLISH: u32 = 1033;

/// Collects sibling `Name` elements: English where it is marked, else the first.
#[derive(Default)]
pub(super) struct Names {
    best: Option<(bool, String)>,
}

impl Names {
    pub fn add<'a>(
        &mut self,
        cursor: &mut Cursor<'a>,
        element: &Element<'a>,
    ) -> Result<(), EsiError> {
        let english = cursor
            .attribute(element, "LcId")?
            .and_then(|id| id.trim().parse().ok())
            == Some(ENGLISH);
        let text = cursor.text(element)?;
        if self
            .best
            .as_ref()
            .is_none_or(|(best_is_english, _)| english && !best_is_english)
        {
            self.best = Some((english, text));
        }
        Ok(())
    }

    pub fn take(self) -> String {
        self.best.map_or_else(String::new, |(_, text)| text)
    }
}
