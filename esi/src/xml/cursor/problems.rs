//! Warnings, errors, and how much a file may make us allocate.

use super::super::scan;
use super::path::shorten;
use super::{Cursor, Element};
use crate::error::{EsiError, EsiProblem};
use crate::model::{Position, Warning};

pub(super) const MAX_WARNINGS: usize = 500;
/// Bytes of data that one file's objects may expand to; the largest known file needs a tenth of it. A choice
/// copies them.
const MAX_EXPANSION: usize = 32 << 20;

impl<'a> Cursor<'a> {
    pub fn warn(&mut self, element: &Element<'a>, message: String) {
        self.warn_at(self.position(element), element, message);
    }

    /// For oddities found after the element itself was left; `within` names the part of the file.
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

    /// Tells of what could not be read.
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

    pub(super) fn error(&self, problem: EsiProblem) -> EsiError {
        EsiError::new(self.at(self.within().offset), self.current_path(), problem)
    }

    pub(super) fn truncated(&self) -> EsiError {
        self.error(EsiProblem::Truncated(shorten(scan::local_name(
            self.within().qualified,
        ))))
    }
}
