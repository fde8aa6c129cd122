//! Finds an object: `0x6064`, `0x1018:1`, `Statusword`, `"Identity: Vendor ID"`.

use std::collections::BTreeMap;

use ecaxis_esi::{Address, Dictionary, address};

use super::{items, name_of};
use crate::mailbox::object_name;
use crate::text::nearest;

/// The maximum number of candidates listed for an ambiguous name.
const MAX_REPORTED: usize = 6;

/// An object, or one of its subindices.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct ObjectQuery {
    pub index: u16,
    /// `None`: all subindices.
    pub sub: Option<u8>,
}

#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum FindError {
    #[error(
        "`{0}` is not an object: indices have 16 bits, subindices two hexadecimal digits, such as 0x6041 or 0x1018:01"
    )]
    Number(String),
    #[error("no object is called `{name}`")]
    Unknown { name: String, near: Option<String> },
    #[error("`{name}` is the name of several: {}", among.join(", "))]
    Ambiguous { name: String, among: Vec<String> },
}

/// Finds an object in the dictionary, or by its standard name without one.
///
/// # Errors
/// [`FindError`].
pub fn find(dictionary: Option<&Dictionary>, text: &str) -> Result<ObjectQuery, FindError> {
    let text = text.trim();
    if text.starts_with(|c: char| c.is_ascii_digit()) {
        return number(text).ok_or_else(|| FindError::Number(text.to_owned()));
    }
    let mut names: BTreeMap<String, Vec<ObjectQuery>> = BTreeMap::new();
    let mut originals = Vec::new();
    let mut add = |name: &str, wanted: ObjectQuery| {
        let known = names.entry(plain(name)).or_default();
        if !known.contains(&wanted) {
            known.push(wanted);
            originals.push(name.to_owned());
        }
    };
    for (object, item) in dictionary.into_iter().flat_map(items) {
        let index = object.index;
        add(&object.name, ObjectQuery { index, sub: None });
        let sub = Some(item.sub);
        if object.items.len() > 1 {
            add(&name_of(object, item), ObjectQuery { index, sub });
            add(&item.name, ObjectQuery { index, sub });
        }
    }
    let wanted = plain(text);
    if !names.contains_key(&wanted) {
        for (name, known) in standard_objects() {
            let entry = names.entry(plain(&name)).or_default();
            if !entry.contains(&known) {
                entry.push(known);
                originals.push(name);
            }
        }
    }
    match names.get(&wanted).map(Vec::as_slice) {
        Some([one]) if !wanted.is_empty() => Ok(*one),
        Some([_, ..]) if !wanted.is_empty() => {
            let all = names.get(&wanted).into_iter().flatten();
            let mut among: Vec<String> = all.take(MAX_REPORTED).map(ToString::to_string).collect();
            if names
                .get(&wanted)
                .is_some_and(|all| all.len() > MAX_REPORTED)
            {
                among.push("…".to_owned());
            }
            Err(FindError::Ambiguous {
                name: text.to_owned(),
                among,
            })
        }
        _ => Err(FindError::Unknown {
            name: text.to_owned(),
            near: nearest(text, originals.iter().map(String::as_str)).map(ToOwned::to_owned),
        }),
    }
}

impl std::fmt::Display for ObjectQuery {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self.sub {
            Some(sub) => write!(f, "{}", address(self.index, sub)),
            None => write!(f, "{:#06x}", self.index),
        }
    }
}

/// Normalizes a name: case, spaces and hyphens differ between files.
fn plain(name: &str) -> String {
    let letters = name.chars().filter(|c| c.is_alphanumeric());
    letters.flat_map(char::to_lowercase).collect()
}

/// Names of objects in CiA 301, CiA 402 and ETG.1000.6. Names of subindices also occur with the
/// object's name as prefix.
fn standard_objects() -> impl Iterator<Item = (String, ObjectQuery)> {
    let indices = (0x1000..0x1100).chain(0x6000..0x6600);
    indices.flat_map(|index| {
        (0..8).flat_map(move |sub| {
            let object = object_name(index, 0xfe);
            let name = object_name(index, sub);
            // A name common to all subindices is the object's name.
            let whole = object == name || sub == 0;
            let both = object.zip(name).filter(|_| !whole);
            let both = both.map(|(object, name)| format!("{object}: {name}"));
            let sub = (!whole).then_some(sub);
            let names = name.map(ToOwned::to_owned).into_iter().chain(both);
            names.map(move |name| (name, ObjectQuery { index, sub }))
        })
    })
}

/// Parses subindices as in the machine file: hexadecimal.
fn number(text: &str) -> Option<ObjectQuery> {
    let (index, sub) = match text.split_once(':') {
        Some((index, sub)) => (index, Some(sub)),
        None => (text, None),
    };
    let value = |text: &str| match text.strip_prefix("0x").or(text.strip_prefix("0X")) {
        Some(hex) if hex.chars().all(|c| c.is_ascii_hexdigit()) => {
            u32::from_str_radix(hex, 16).ok()
        }
        Some(_) => None,
        None => text.parse().ok(),
    };
    Some(ObjectQuery {
        index: u16::try_from(value(index)?).ok()?,
        sub: match sub {
            Some(sub) => Some(Address::sub_of(sub)?),
            None => None,
        },
    })
}
