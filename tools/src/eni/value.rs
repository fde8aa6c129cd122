//! Values of elements: numbers, bytes, flags.

use ecaxis_esi::Position;

use super::xml::{Element, EniError, shorten};

const NUMBER: &str = "correct the value: decimal, 0x… or #x… hexadecimal";

impl Element {
    /// Returns the first child of a name.
    #[must_use]
    pub fn get(&self, name: &str) -> Option<&Self> {
        self.children.iter().find(|child| child.name == name)
    }

    /// Returns all children of a name.
    pub fn all<'e>(&'e self, name: &'e str) -> impl Iterator<Item = &'e Self> {
        self.children.iter().filter(move |child| child.name == name)
    }

    /// Returns all elements at a path below this one.
    #[must_use]
    pub fn at<'e>(&'e self, path: &[&'e str]) -> Vec<&'e Self> {
        path.iter().fold(vec![self], |found, name| {
            found.into_iter().flat_map(|e| e.all(name)).collect()
        })
    }

    /// Returns the text of a child without white space around it.
    #[must_use]
    pub fn text_of(&self, name: &str) -> &str {
        self.get(name).map_or("", |child| child.text.trim())
    }

    /// Returns the number of this element.
    pub(super) fn number<T: TryFrom<i64>>(&self) -> Result<T, EniError> {
        let text = self.text.trim();
        let number = parse(text).and_then(|number| T::try_from(number).ok());
        number.ok_or_else(|| {
            let message = match text {
                "" => format!("<{}> is empty, not a number", self.name),
                text => format!(
                    "<{}> {:?} is not a number that fits",
                    self.name,
                    shorten(text)
                ),
            };
            self.error(message, NUMBER)
        })
    }

    /// Returns the number of a child, if there is one.
    pub(super) fn number_of<T: TryFrom<i64>>(&self, name: &str) -> Result<Option<T>, EniError> {
        self.get(name).map(Self::number).transpose()
    }

    /// Returns the number of a child that must be there.
    pub(super) fn needed<T: TryFrom<i64>>(&self, name: &str) -> Result<T, EniError> {
        self.number_of(name)?.ok_or_else(|| {
            let message = format!("<{}> has no <{name}>", shorten(&self.name));
            self.error(
                message,
                "ETG.2100 requires the element: export the file again",
            )
        })
    }

    /// Returns 32 bits, written with or without a sign (`xs:int`).
    pub(super) fn bits_of(&self, name: &str) -> Result<Option<u32>, EniError> {
        let Some(child) = self.get(name) else {
            return Ok(None);
        };
        let number: i64 = child.number()?;
        let bits = match i32::try_from(number) {
            Ok(number) => Some(u32::from_ne_bytes(number.to_ne_bytes())),
            Err(_) => u32::try_from(number).ok(),
        };
        let message = || format!("<{name}> {number} does not fit 32 bits");
        bits.map(Some).ok_or_else(|| child.error(message(), NUMBER))
    }

    /// Returns the bytes of a child (`xs:hexBinary`).
    pub(super) fn bytes_of(&self, name: &str) -> Result<Option<Vec<u8>>, EniError> {
        let Some(child) = self.get(name) else {
            return Ok(None);
        };
        let digits: Option<Vec<u8>> = child
            .text
            .chars()
            .filter(|c| !c.is_whitespace())
            .map(|c| u8::try_from(c.to_digit(16)?).ok())
            .collect();
        let digits = digits.filter(|digits| digits.len().is_multiple_of(2));
        let digits = digits.ok_or_else(|| {
            let message = format!("<{name}> is not a sequence of hexadecimal bytes");
            child.error(message, "write two digits for each byte")
        })?;
        let pairs = digits.chunks_exact(2);
        Ok(Some(pairs.map(|pair| pair[0] << 4 | pair[1]).collect()))
    }

    /// Returns true if an attribute is true (`xs:boolean`).
    pub(super) fn has_flag(&self, name: &str) -> bool {
        let mut all = self.attributes.iter();
        all.any(|(key, value)| key == name && is_true(value))
    }

    /// Returns true if a child is true.
    pub(super) fn is_set(&self, name: &str) -> bool {
        is_true(self.text_of(name))
    }

    /// Returns the number of an attribute, if there is one.
    pub(super) fn attribute_number<T: TryFrom<i64>>(&self, name: &str) -> Option<T> {
        let mut all = self.attributes.iter();
        let (_, value) = all.find(|(key, _)| key == name)?;
        T::try_from(parse(value.trim())?).ok()
    }

    pub(super) fn error(&self, message: String, help: &'static str) -> EniError {
        error(self.position, message, help)
    }
}

pub(super) fn error(position: Position, message: String, help: &'static str) -> EniError {
    EniError {
        position,
        message,
        help,
    }
}

fn is_true(text: &str) -> bool {
    matches!(text.trim(), "1" | "true" | "True" | "TRUE")
}

/// Parses a decimal or hexadecimal number.
fn parse(text: &str) -> Option<i64> {
    let hexadecimal = ["#x", "#X", "0x", "0X"];
    let hexadecimal = hexadecimal.iter().find_map(|p| text.strip_prefix(p));
    match hexadecimal {
        Some(digits) if !digits.starts_with(['+', '-']) => i64::from_str_radix(digits, 16).ok(),
        Some(_) => None,
        None => text.parse().ok(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_have_all_spellings_and_limits() {
        for (text, value) in [
            ("24672", Some(24672)),
            (" #x1a02 ", Some(0x1a02)),
            ("0x1C13", Some(0x1c13)),
            ("-1", None),
            ("65536", None),
            ("", None),
            ("99999999999999999999999999", None),
            ("#x-5", None),
            ("12a", None),
        ] {
            let element = Element::new("E").with("N", text);
            assert_eq!(
                element.number_of::<u16>("N").ok().flatten(),
                value,
                "{text}"
            );
        }
        let element = Element::new("E").with("N", -2).with("B", "4294967294");
        assert_eq!(element.bits_of("N"), Ok(Some(0xffff_fffe)));
        assert_eq!(element.bits_of("B"), Ok(Some(0xffff_fffe)));
        let error = Element::new("E").needed::<u8>("Ccs").unwrap_err();
        assert_eq!(error.message, "<E> has no <Ccs>");
    }

    #[test]
    fn bytes_are_pairs_of_digits() {
        for (text, bytes) in [
            ("0100021a", Some(vec![1, 0, 2, 0x1a])),
            (" 01 00\n", Some(vec![1, 0])),
            ("", Some(vec![])),
            ("1", None),
            ("0g", None),
            ("é1", None),
        ] {
            let element = Element::new("E").with("Data", text);
            assert_eq!(element.bytes_of("Data").ok().flatten(), bytes, "{text}");
        }
    }
}
