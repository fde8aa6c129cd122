//! The string category: texts are referenced by number, from 1; 0 means no text.

/// Other MainDevices store names in fixed buffers of 64 bytes.
const MAX_BYTES: usize = 63;
const MAX_STRINGS: usize = 255;

#[derive(Default)]
pub(super) struct Table {
    texts: Vec<Vec<u8>>,
}

impl Table {
    /// Returns the number of `text`; equal texts share a number. Returns 0 if `text` is empty or
    /// the table is full.
    pub fn number(&mut self, text: &str) -> u8 {
        let bytes: Vec<u8> = text.chars().map(visible).take(MAX_BYTES).collect();
        if bytes.is_empty() {
            return 0;
        }
        let place = match self.texts.iter().position(|known| *known == bytes) {
            Some(place) => place,
            None if self.texts.len() < MAX_STRINGS => {
                self.texts.push(bytes);
                self.texts.len() - 1
            }
            None => return 0,
        };
        u8::try_from(place.saturating_add(1)).unwrap_or(0)
    }

    pub fn to_bytes(&self) -> Vec<u8> {
        let mut out = vec![u8::try_from(self.texts.len()).unwrap_or(u8::MAX)];
        for text in &self.texts {
            out.push(u8::try_from(text.len()).unwrap_or(u8::MAX));
            out.extend_from_slice(text);
        }
        out
    }

    pub fn parse(data: &[u8]) -> Self {
        let mut table = Self::default();
        let Some((&count, mut rest)) = data.split_first() else {
            return table;
        };
        for _ in 0..count {
            let Some((&length, after)) = rest.split_first() else {
                break;
            };
            let Some((text, after)) = after.split_at_checked(usize::from(length)) else {
                break;
            };
            table.texts.push(text.to_vec());
            rest = after;
        }
        table
    }

    pub fn len(&self) -> usize {
        self.texts.len()
    }

    pub fn text(&self, number: u8) -> String {
        let text = usize::from(number)
            .checked_sub(1)
            .and_then(|place| self.texts.get(place));
        text.into_iter()
            .flatten()
            .map(|&byte| char::from(byte))
            .collect::<String>()
            .trim_end_matches('\0')
            .to_owned()
    }
}

/// Replaces non-ASCII characters. VISIBLE_STRING contains ASCII only, and some MainDevices reject
/// other characters.
fn visible(character: char) -> u8 {
    match character {
        ' '..='~' => u8::try_from(character).unwrap_or(b'?'),
        '\u{b5}' | '\u{3bc}' => b'u',
        '\u{e4}' | '\u{c4}' => b'a',
        '\u{f6}' | '\u{d6}' => b'o',
        '\u{fc}' | '\u{dc}' => b'u',
        _ => b'?',
    }
}
