//! Element paths for warnings and errors, `EtherCATInfo/Descriptions/Devices/Device[2]/Sm[3]`.

use super::super::scan;
use super::{Cursor, Element, Level};

/// The number of element names that may occur several times and therefore carry a number in a path.
pub(super) const NUMBERED: usize = 16;

/// Returns the slot of a numbered element name.
fn numbered(name: &str) -> Option<usize> {
    Some(match name {
        "Sm" => 0,
        "Fmmu" => 1,
        "Slot" => 2,
        "Entry" => 3,
        "TxPdo" => 4,
        "RxPdo" => 5,
        "Object" => 6,
        "Device" => 7,
        "Module" => 8,
        "OpMode" => 9,
        "SubItem" => 10,
        "Exclude" => 11,
        "InitCmd" => 12,
        "DataType" => 13,
        "ModuleIdent" => 14,
        "EtherCATInfo" => 15,
        _ => return None,
    })
}

impl Level<'_> {
    pub(super) fn count(&mut self, name: &str) -> u32 {
        match numbered(name).and_then(|which| self.seen.get_mut(which)) {
            Some(count) => {
                *count = count.saturating_add(1);
                *count
            }
            None => 1,
        }
    }
}

impl<'a> Cursor<'a> {
    /// Returns the path of an element, even if the element is already closed. Its parents must
    /// still be open.
    pub fn path_of(&self, element: &Element<'a>) -> String {
        let mut path = self.path(element.depth.saturating_sub(1));
        append(&mut path, element.name, element.number);
        path
    }

    fn path(&self, depth: usize) -> String {
        let mut path = String::new();
        for level in self.stack.iter().take(depth.min(self.depth)) {
            append(&mut path, scan::local_name(level.qualified), level.number);
        }
        path
    }

    /// Returns the path of the innermost open element, or `(file)` outside the root.
    pub(super) fn current_path(&self) -> String {
        match self.depth {
            0 => "(file)".to_owned(),
            depth => self.path(depth),
        }
    }
}

fn append(path: &mut String, name: &str, number: u32) {
    if !path.is_empty() {
        path.push('/');
    }
    path.push_str(short(name));
    if numbered(name).is_some() && (number > 1 || name != "EtherCATInfo") {
        path.push('[');
        path.push_str(&number.to_string());
        path.push(']');
    }
}

/// Shortens text from a damaged file for an error message.
pub(super) fn shorten(text: &str) -> String {
    short(text).to_owned()
}

fn short(text: &str) -> &str {
    const MAX: usize = 40;
    if text.len() <= MAX {
        return text;
    }
    let end = text.char_indices().nth(MAX);
    end.map_or(text, |(end, _)| &text[..end])
}
