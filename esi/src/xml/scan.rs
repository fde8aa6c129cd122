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

    /// The next tag, whatever text stands before it.
    pub fn next_tag(&mut self) -> Result<Piece<'a>, Malformed> {
        loop {
            let rest = &self.text.as_bytes()[self.at..];
            self.at += memchr(b'<', rest).unwrap_or(rest.len());
            match self.next()? {
                Piece::CData(_) => {}
                piece => return Ok(piece),
            }
        }
    }

    /// Passes whatever text stands before the next tag, and that where it closes `name`.
    pub fn closes(&mut self, name: &str) -> bool {
        let rest = &self.text.as_bytes()[self.at..];
        let Some(tag) = memchr(b'<', rest) else {
            return false;
        };
        let closed = is_end(&rest[tag..], name);
        self.at += tag + if closed { name.len() + 3 } else { 0 };
        closed
    }

    /// The text up to the next tag where that closes `name`; then both are passed.
    pub fn text_to_end(&mut self, name: &str) -> Option<&'a str> {
        let rest = &self.text.as_bytes()[self.at..];
        // Most text is short.
        let near = rest.iter().take(24).position(|byte| *byte == b'<');
        let length = near.or_else(|| memchr(b'<', rest))?;
        if !is_end(&rest[length..], name) {
            return None;
        }
        let text = &self.text[self.at..self.at + length];
        self.at += length + 2 + name.len() + 1;
        Some(text)
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
                    let length = memchr(b'<', rest).unwrap_or(rest.len());
                    self.at = start + length;
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

    fn tag(&mut self, start: usize) -> Result<Piece<'a>, Malformed> {
        let bytes = self.text.as_bytes();
        let name_end = bytes[start + 1..]
            .iter()
            .position(|byte| ENDS_NAME[usize::from(*byte)]);
        let name_end = start + 1 + name_end.unwrap_or(bytes.len() - start - 1);
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

/// Whether `</name>` stands there, without a space.
fn is_end(tag: &[u8], name: &str) -> bool {
    let name = name.as_bytes();
    tag.get(name.len() + 2) == Some(&b'>')
        && tag.starts_with(b"</")
        && tag.get(2..name.len() + 2) == Some(name)
}

const ENDS_NAME: [bool; 256] = {
    let mut table = [false; 256];
    let ends = b">/ \t\r\n";
    let mut n = 0;
    while n < ends.len() {
        table[ends[n] as usize] = true;
        n += 1;
    }
    table
};

/// Without the namespace's prefix.
pub(super) fn local_name(qualified: &str) -> &str {
    let colon = qualified.bytes().rposition(|byte| byte == b':');
    colon.map_or(qualified, |colon| &qualified[colon + 1..])
}

/// The value of one attribute as written; `Err` where the tag is not made of `name="value"` before it.
pub(super) fn attribute<'a>(
    attributes: &'a str,
    name: &str,
) -> Result<Option<&'a str>, &'static str> {
    let mut rest = attributes.trim_ascii_start();
    while !rest.is_empty() {
        let Some((key, after)) = rest.split_once('=') else {
            return Err("an attribute has no value");
        };
        let after = after.trim_ascii_start();
        let quote = match after.as_bytes() {
            [quote @ (b'"' | b'\''), ..] => *quote,
            _ => return Err("an attribute's value has no quotes"),
        };
        let Some(end) = memchr(quote, &after.as_bytes()[1..]) else {
            return Err("an attribute's value is not closed");
        };
        let key = key.trim_ascii_end();
        let local = local_name(key);
        if local == name {
            return Ok(Some(&after[1..=end]));
        }
        rest = after[end + 2..].trim_ascii_start();
    }
    Ok(None)
}

/// Line and column of byte offsets, without a table of all lines: a file may be nothing but line ends, or one line.
pub(super) struct Lines<'a> {
    text: &'a [u8],
    /// Line ends before each block, and characters since the last of them.
    before: Vec<(u32, u32)>,
}

const BLOCK: usize = 512;

impl<'a> Lines<'a> {
    pub fn new(text: &'a str) -> Self {
        let text = text.as_bytes();
        let mut at = (0, 0);
        // One more than there are whole blocks, for what is behind the last of them.
        let mut before = Vec::with_capacity(text.len() / BLOCK + 1);
        before.push(at);
        for block in text.chunks_exact(BLOCK) {
            at = passed(at, block);
            before.push(at);
        }
        Self { text, before }
    }

    /// Both from 1; columns count characters.
    pub fn position(&self, offset: usize) -> (u32, u32) {
        let offset = offset.min(self.text.len());
        let block = offset / BLOCK;
        let known = self.before.get(block).copied().unwrap_or_default();
        let (lines, characters) = passed(known, &self.text[block * BLOCK..offset]);
        (lines.saturating_add(1), characters.saturating_add(1))
    }
}

/// Lines and characters behind `bytes`.
fn passed((lines, characters): (u32, u32), bytes: &[u8]) -> (u32, u32) {
    let small = |n: usize| u32::try_from(n).unwrap_or(u32::MAX);
    // A character is counted by its first byte.
    let count = |bytes: &[u8]| {
        let first = |byte: &&u8| **byte & 0xc0 != 0x80;
        small(bytes.iter().filter(first).count())
    };
    match memchr::memrchr(b'\n', bytes) {
        None => (lines, characters.saturating_add(count(bytes))),
        Some(last) => {
            let ends = memchr::memchr_iter(b'\n', &bytes[..=last]).count();
            (lines.saturating_add(small(ends)), count(&bytes[last + 1..]))
        }
    }
}
