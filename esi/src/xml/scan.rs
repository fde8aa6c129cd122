//! Text → tags and text, by hand and without a copy: ESI files of several megabytes are read at every start.
//!
//! Checked here: that tags, comments, CDATA sections and quotes are closed. That elements are closed in order is the
//! cursor's business. A document type is passed over, so nothing that it declares is ever expanded.

use memchr::{memchr, memmem};

/// A piece of the document; everything else (comments, declarations, processing instructions) is passed over.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Piece<'a> {
    /// `<name attributes>` or, with `empty`, `<name attributes/>`.
    Start {
        name: &'a str,
        /// The name without the namespace's prefix.
        local: &'a str,
        attributes: &'a str,
        offset: usize,
        empty: bool,
    },
    End {
        name: &'a str,
        offset: usize,
    },
    /// As written, references included.
    Text(&'a str),
    CData(&'a str),
    Eof,
}

/// Not well-formed at a byte of the text.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Malformed {
    pub offset: usize,
    /// `None`: the text ends inside a tag, a comment or the like.
    pub what: Option<&'static str>,
}

pub(super) struct Scanner<'a> {
    text: &'a str,
    at: usize,
}

impl<'a> Scanner<'a> {
    pub fn new(text: &'a str) -> Self {
        Self { text, at: 0 }
    }

    pub fn offset(&self) -> usize {
        self.at
    }

    /// Where the next tag begins.
    pub fn next_offset(&self) -> usize {
        self.at + before_tag(self.rest(self.at))
    }

    /// All that stands from a byte on.
    pub fn rest(&self, from: usize) -> &'a [u8] {
        self.text.as_bytes().get(from..).unwrap_or_default()
    }

    /// Goes on behind an element that is known.
    pub fn go_to(&mut self, offset: usize) {
        self.at = offset;
    }

    /// The next tag, whatever text stands before it; `None` where that closes `open`.
    #[inline]
    pub fn next_tag(&mut self, open: &str) -> Result<Option<Piece<'a>>, Malformed> {
        loop {
            self.at += before_tag(&self.text.as_bytes()[self.at..]);
            let rest = &self.text.as_bytes()[self.at..];
            let piece = match rest.get(1) {
                Some(b'/') if is_end(rest, open) => {
                    self.at += open.len() + 3;
                    return Ok(None);
                }
                Some(b'A'..=b'Z') => self.tag(self.at)?,
                _ => self.next()?,
            };
            if !matches!(piece, Piece::CData(_)) {
                return Ok(Some(piece));
            }
        }
    }

    /// The text up to the next tag where that closes `name`, trimmed; then both are passed. With it whether the text
    /// says what is meant: without references and line ends of other systems.
    #[inline]
    pub fn text_to_end(&mut self, name: &str) -> Option<(&'a str, bool)> {
        let rest = &self.text.as_bytes()[self.at..];
        let length = before_tag(rest);
        if !is_end(&rest[length..], name) {
            return None;
        }
        let text = &self.text[self.at..self.at + length];
        self.at += length + 2 + name.len() + 1;
        Some(trimmed(text))
    }

    pub fn next(&mut self) -> Result<Piece<'a>, Malformed> {
        loop {
            let start = self.at;
            let rest = &self.text.as_bytes()[start..];
            match rest {
                [] => return Ok(Piece::Eof),
                [b'<', b'/', ..] => {
                    let end = self.find(start, rest.iter().position(|byte| *byte == b'>'), 1)?;
                    let name = self.text[start + 2..end - 1].trim_ascii_end();
                    return Ok(Piece::End {
                        name,
                        offset: start,
                    });
                }
                [b'<', b'?', ..] => {
                    self.find(start, memmem::find(rest, b"?>"), 2)?;
                }
                [b'<', b'!', ..] => {
                    if let Some(section) = self.declaration(start, rest)? {
                        return Ok(Piece::CData(section));
                    }
                }
                [b'<', ..] => return self.tag(start),
                _ => {
                    self.at = start + before_tag(rest);
                    return Ok(Piece::Text(&self.text[start..self.at]));
                }
            }
        }
    }

    /// Moves behind what was found, which is `length` bytes long.
    fn find(
        &mut self,
        start: usize,
        found: Option<usize>,
        length: usize,
    ) -> Result<usize, Malformed> {
        let ends_inside = Malformed {
            offset: start,
            what: None,
        };
        self.at = start + found.ok_or(ends_inside)? + length;
        Ok(self.at)
    }

    #[inline(always)]
    fn tag(&mut self, start: usize) -> Result<Piece<'a>, Malformed> {
        let bytes = self.text.as_bytes();
        let part = |from: usize| from + name_length(&bytes[from..]);
        let mut local = start + 1;
        let mut name_end = part(local);
        while bytes.get(name_end) == Some(&b':') {
            local = name_end + 1;
            name_end = part(local);
        }
        if name_end == start + 1 {
            let what = if name_end == bytes.len() {
                None
            } else {
                Some("a tag without a name")
            };
            return Err(Malformed {
                offset: start,
                what,
            });
        }
        let ends_inside = Malformed {
            offset: start,
            what: None,
        };
        let mut at = name_end;
        let end = loop {
            match bytes.get(at).ok_or(ends_inside)? {
                b'>' => break at,
                quote @ (b'"' | b'\'') => {
                    at += 2 + memchr(*quote, &bytes[at + 1..]).ok_or(ends_inside)?;
                }
                _ => at += 1,
            }
        };
        self.at = end + 1;
        let empty = end > name_end && bytes[end - 1] == b'/';
        let attributes = &self.text[name_end..if empty { end - 1 } else { end }];
        Ok(Piece::Start {
            name: &self.text[start + 1..name_end],
            local: &self.text[local..name_end],
            attributes,
            offset: start,
            empty,
        })
    }

    /// `<!…`: the contents of a CDATA section; comments and document types are passed over.
    fn declaration(&mut self, start: usize, rest: &[u8]) -> Result<Option<&'a str>, Malformed> {
        const CDATA: &[u8] = b"<![CDATA[";
        let ends_inside = Malformed {
            offset: start,
            what: None,
        };
        if let Some(comment) = rest.strip_prefix(b"<!--") {
            self.find(start, memmem::find(comment, b"-->"), 4 + 3)?;
            return Ok(None);
        }
        if rest.starts_with(CDATA) {
            let end = self.find(start, memmem::find(rest, b"]]>"), 3)?;
            return Ok(Some(&self.text[start + CDATA.len()..end - 3]));
        }
        let head = rest.get(..9).unwrap_or(rest);
        if !head.eq_ignore_ascii_case(b"<!DOCTYPE") {
            let ends = CDATA.starts_with(rest) || b"<!--".starts_with(rest) || rest.len() < 9;
            let what = if ends {
                None
            } else {
                Some("<! begins neither a comment nor CDATA nor DOCTYPE")
            };
            return Err(Malformed {
                offset: start,
                what,
            });
        }
        // Its own declarations stand between brackets and may hold anything between quotes.
        let mut depth = 0_usize;
        let mut quote = None;
        let mut at = 0;
        while let Some(&byte) = rest.get(at) {
            match (quote, byte) {
                (Some(open), _) if byte == open => quote = None,
                (Some(_), _) => {}
                (None, b'"' | b'\'') => quote = Some(byte),
                (None, b'<') if rest[at..].starts_with(b"<!--") => {
                    let end = memmem::find(&rest[at + 4..], b"-->");
                    at += 4 + end.ok_or(ends_inside)? + 2;
                }
                (None, b'<') => depth += 1,
                (None, b'>') => {
                    depth = depth.saturating_sub(1);
                    if depth == 0 {
                        self.at = start + at + 1;
                        return Ok(None);
                    }
                }
                _ => {}
            }
            at += 1;
        }
        Err(ends_inside)
    }
}

const ONES: u64 = u64::MAX / 255;
const HIGHS: u64 = ONES << 7;

/// How many bytes stand before the next tag.
#[inline]
fn before_tag(rest: &[u8]) -> usize {
    // Mostly a few, for which a search by vectors costs more than it saves.
    for (n, word) in rest.as_chunks::<8>().0.iter().take(4).enumerate() {
        let differs = u64::from_le_bytes(*word) ^ (ONES * u64::from(b'<'));
        // The lowest of these bits is that of the first byte which does not differ.
        let found = differs.wrapping_sub(ONES) & !differs & HIGHS;
        if found != 0 {
            return n * 8 + first_byte(found);
        }
    }
    memchr(b'<', rest).unwrap_or(rest.len())
}

/// How many bytes a name has, or its prefix.
#[inline]
fn name_length(rest: &[u8]) -> usize {
    // Mostly it is made of letters; all that ends it stands before them.
    let letters = rest.first_chunk::<8>().map_or(0, |word| {
        let word = u64::from_le_bytes(*word);
        let found = word.wrapping_sub(ONES * u64::from(b'A')) & !word & HIGHS;
        first_byte(found)
    });
    let ends = |byte: &u8| KIND[usize::from(*byte)] & (ENDS_NAME | COLON) != 0;
    let more = &rest[letters..];
    letters + more.iter().position(ends).unwrap_or(more.len())
}

/// Of a word of which the found bytes have their highest bit set; 8 without any.
#[inline]
fn first_byte(found: u64) -> usize {
    (found.trailing_zeros() / 8) as usize
}

/// Without white space around it, and whether it says what is meant: without references and line ends of other
/// systems.
#[inline]
fn trimmed(text: &str) -> (&str, bool) {
    let bytes = text.as_bytes();
    let kinds = bytes.iter().fold(0, |all, b| all | KIND[usize::from(*b)]);
    let space = |byte: Option<&u8>| byte.is_some_and(|byte| KIND[usize::from(*byte)] & SPACE != 0);
    if kinds & ODD == 0 && !space(bytes.first()) && !space(bytes.last()) {
        return (text, true);
    }
    let text = text.trim();
    let plain = !text.bytes().any(|byte| matches!(byte, b'&' | b'\r'));
    (text, plain)
}

/// Whether `</name>` stands there, without a space.
#[inline]
fn is_end(tag: &[u8], name: &str) -> bool {
    let name = name.as_bytes();
    !name.is_empty()
        && tag.get(1) == Some(&b'/')
        && tag.get(name.len() + 2) == Some(&b'>')
        && tag.get(2..name.len() + 2) == Some(name)
}

/// Bits of [`KIND`].
const ENDS_NAME: u8 = 1;
const SPACE: u8 = 2;
/// Text with such a byte needs a closer look.
const ODD: u8 = 4;
/// Ends the prefix of a name.
const COLON: u8 = 8;

const KIND: [u8; 256] = {
    let mut table = [0; 256];
    let mut byte = 0;
    while byte < 256 {
        table[byte] = match byte as u8 {
            b'>' | b'/' => ENDS_NAME,
            b' ' | b'\t' | b'\n' => ENDS_NAME | SPACE,
            b'\r' => ENDS_NAME | SPACE | ODD,
            b':' => COLON,
            // Some letters beyond ASCII are spaces, too.
            b'&' | 0..0x20 | 0x80.. => ODD,
            _ => 0,
        };
        byte += 1;
    }
    table
};

/// Without the namespace's prefix.
pub(super) fn local_name(qualified: &str) -> &str {
    let local = qualified.rsplit_once(':');
    local.map_or(qualified, |(_, local)| local)
}

/// The value of one attribute as written; `Err` where the tag is not made of `name="value"` before it.
pub(super) fn attribute<'a>(
    attributes: &'a str,
    name: &str,
) -> Result<Option<&'a str>, &'static str> {
    let mut rest = attributes.trim_ascii_start();
    while !rest.is_empty() {
        let Some(equals) = rest.bytes().position(|byte| byte == b'=') else {
            return Err("an attribute has no value");
        };
        let (key, after) = (rest[..equals].trim_ascii_end(), &rest[equals + 1..]);
        let after = after.trim_ascii_start();
        let quote = match after.as_bytes() {
            [quote @ (b'"' | b'\''), ..] => *quote,
            _ => return Err("an attribute's value has no quotes"),
        };
        let Some(length) = after.bytes().skip(1).position(|byte| byte == quote) else {
            return Err("an attribute's value is not closed");
        };
        let prefix = key.strip_suffix(name);
        if prefix.is_some_and(|prefix| prefix.is_empty() || prefix.ends_with(':')) {
            return Ok(Some(&after[1..=length]));
        }
        rest = after[length + 2..].trim_ascii_start();
    }
    Ok(None)
}
