//! References in text. General entities are never expanded.

use std::borrow::Cow;

use super::Cursor;
use super::path::shorten;
use super::problems::MAX_WARNINGS;
use crate::model::Warning;

impl<'a> Cursor<'a> {
    /// Expands character references and the five predefined entities of XML. Other references stay
    /// as written and cause a warning.
    pub(super) fn expanded(&mut self, text: &'a str) -> Cow<'a, str> {
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
                file: None,
                position: self.at(self.within().offset),
                path: self.current_path(),
                left_out: false,
                message,
            });
        }
        Cow::Owned(expanded)
    }
}

/// Converts line ends of other systems to one character, as XML requires.
pub(super) fn line_ends(text: Cow<'_, str>) -> Cow<'_, str> {
    match text.contains('\r') {
        true => Cow::Owned(text.replace("\r\n", "\n").replace('\r', "\n")),
        false => text,
    }
}

/// Expands references. Calls `unknown` with the names of unknown entities, and with `""` for an `&`
/// without a reference.
pub(super) fn expand(text: &str, mut unknown: impl FnMut(&str)) -> String {
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

/// Decodes `#228` or `#xe4`.
fn character(reference: &str) -> Option<char> {
    let digits = reference.strip_prefix('#')?;
    let code = match digits.strip_prefix(['x', 'X']) {
        Some(hex) => u32::from_str_radix(hex, 16).ok()?,
        None => digits.parse().ok()?,
    };
    char::from_u32(code).filter(|character| *character != '\0')
}
