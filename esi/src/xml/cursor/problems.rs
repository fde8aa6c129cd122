//! Warnings, errors and the memory limit.

use super::super::scan;
use super::path::shorten;
use super::{Cursor, Element};
use crate::error::{EsiError, EsiProblem};
use crate::model::{Position, Warning};

pub(super) const MAX_WARNINGS: usize = 500;
/// The maximum size in bytes to which the objects of one file may expand. The largest known file
/// needs a tenth of it. A selection copies the objects.
const MAX_EXPANSION: usize = 32 << 20;

impl<'a> Cursor<'a> {
    pub fn warn(&mut self, element: &Element<'a>, message: String) {
        self.warn_at(self.position(element), element, message);
    }

    /// Adds a warning for a problem found after the element was closed. `within` is an enclosing
    /// open element.
    pub fn warn_at(&mut self, position: Position, within: &Element<'a>, message: String) {
        if self.warnings.len() < MAX_WARNINGS {
            let path = self.path_of(within);
            self.warnings.push(Warning {
                file: None,
                position,
                path,
                left_out: false,
                message,
            });
        }
    }

    /// Adds a warning about an unreadable element.
    pub fn left_out(&mut self, error: &EsiError) {
        if self.warnings.len() < MAX_WARNINGS {
            self.warnings.push(Warning {
                file: None,
                position: error.position(),
                path: error.path().to_owned(),
                left_out: true,
                message: error.problem().to_string(),
            });
        }
        self.first_left_out.get_or_insert_with(|| error.clone());
    }

    /// Counts `bytes` of data for the element at `position`. Fails above the limit.
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

    /// Returns an error for a problem found after the element was closed. `within` is an enclosing
    /// open element.
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

    pub(super) fn error(&self, problem: EsiProblem) -> EsiError {
        EsiError::new(self.at(self.within().offset), self.current_path(), problem)
    }

    pub(super) fn truncated(&self) -> EsiError {
        self.error(EsiProblem::Truncated(shorten(scan::local_name(
            self.within().qualified,
        ))))
    }
}
