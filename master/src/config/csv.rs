//! Files with rows of numbers.

use std::path::Path;

use toml::Spanned;

use super::problem::Problems;
use crate::file::{self, unreadable};
use crate::signature::SignedKind;

/// The maximum length of a file in bytes.
const MAX_BYTES: u64 = 64 << 20;

/// A row and its line in the file, from 1.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct CsvRow {
    pub line: usize,
    pub fields: Vec<f64>,
}

/// Returns the text of a file that the machine file names.
pub(crate) fn text(file: &Spanned<String>, folder: &Path, p: &mut Problems<'_>) -> Option<String> {
    let path = folder.join(file.get_ref());
    let text = match file::read_text(&path, MAX_BYTES) {
        Ok(text) => text,
        Err(error) => {
            let hint = "paths are relative to the machine file";
            p.add_hint(file.span(), unreadable(&path, &error), hint);
            return None;
        }
    };
    if let Err(error) = p.files.add(SignedKind::Tables, &path, text.as_bytes()) {
        p.add_hint(file.span(), error.to_string(), error.hint());
        return None;
    }
    Some(text)
}

/// Returns the rows of a file. Commas, semicolons or blanks separate the fields. Empty lines, text
/// after `#`, and a first row that begins with a word are ignored. `hint` says what a row is.
pub(crate) fn read(
    file: &Spanned<String>,
    folder: &Path,
    hint: &str,
    p: &mut Problems<'_>,
) -> Option<Vec<CsvRow>> {
    let text = text(file, folder, p)?;
    let text = text.strip_prefix('\u{feff}').unwrap_or(&text);
    let mut rows: Vec<CsvRow> = Vec::new();
    for (line, content) in (1..).zip(text.lines()) {
        let content = content.split('#').next().unwrap_or_default().trim();
        let separator = |c: char| c == ',' || c == ';' || c.is_whitespace();
        let mut fields = content
            .split(separator)
            .filter(|field| !field.is_empty())
            .peekable();
        let word = |field: &&str| field.starts_with(|c: char| c.is_alphabetic());
        if fields.peek().is_none() || (rows.is_empty() && fields.peek().is_some_and(word)) {
            continue;
        }
        let fields: Result<Vec<f64>, _> = fields.map(str::parse).collect();
        let Ok(fields) = fields else {
            let path = folder.join(file.get_ref());
            let message = format!("{}, line {line}: a field is not a number", path.display());
            p.add_hint(file.span(), message, hint);
            return None;
        };
        rows.push(CsvRow { line, fields });
    }
    Some(rows)
}
