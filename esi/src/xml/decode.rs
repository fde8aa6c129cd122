//! Bytes → text, by byte order mark and XML declaration.
//!
//! Windows tools write windows-1252 and declare it as ISO-8859-1, so both are read as windows-1252.
//! Invalid UTF-8 is read as windows-1252 too: this damages letters in names, but not the layout.

use std::borrow::Cow;

/// windows-1252, 0x80 to 0x9f; the rest equals ISO-8859-1. The five unassigned codes stay C1
/// controls.
const HIGH_CONTROLS: [char; 32] = [
    '\u{20ac}', '\u{81}', '\u{201a}', '\u{192}', '\u{201e}', '\u{2026}', '\u{2020}', '\u{2021}',
    '\u{2c6}', '\u{2030}', '\u{160}', '\u{2039}', '\u{152}', '\u{8d}', '\u{17d}', '\u{8f}',
    '\u{90}', '\u{2018}', '\u{2019}', '\u{201c}', '\u{201d}', '\u{2022}', '\u{2013}', '\u{2014}',
    '\u{2dc}', '\u{2122}', '\u{161}', '\u{203a}', '\u{153}', '\u{9d}', '\u{17e}', '\u{178}',
];

pub(super) struct Decoded<'a> {
    pub text: Cow<'a, str>,
    /// A warning about the encoding, with its byte offset in `text`.
    pub remark: Option<(usize, String)>,
}

pub(super) fn decode(bytes: &[u8]) -> Decoded<'_> {
    let mut decoded = by_encoding(bytes);
    // XML does not permit NUL, but the rest of the text is readable.
    if let (None, Some(at)) = (&decoded.remark, memchr::memchr(0, decoded.text.as_bytes())) {
        let message = "a NUL character; the file may be damaged".to_owned();
        decoded.remark = Some((at, message));
    }
    decoded
}

fn by_encoding(bytes: &[u8]) -> Decoded<'_> {
    if let Some(rest) = bytes.strip_prefix(&[0xef, 0xbb, 0xbf]) {
        return utf8(rest);
    }
    match bytes {
        [0xff, 0xfe, rest @ ..] => return utf16(rest, u16::from_le_bytes),
        [0xfe, 0xff, rest @ ..] => return utf16(rest, u16::from_be_bytes),
        [b'<', 0, ..] => return utf16(bytes, u16::from_le_bytes),
        [0, b'<', ..] => return utf16(bytes, u16::from_be_bytes),
        _ => {}
    }
    match declared(bytes).as_deref() {
        None | Some("utf-8" | "utf8" | "us-ascii" | "ascii") => utf8(bytes),
        Some(
            "iso-8859-1" | "iso8859-1" | "latin1" | "latin-1" | "windows-1252" | "cp1252"
            | "iso-8859-15",
        ) => Decoded {
            text: windows_1252(bytes),
            remark: None,
        },
        Some(other) => {
            let mut decoded = utf8(bytes);
            let other: String = other.chars().take(40).collect();
            let message = format!("encoding {other:?} is not supported; names may be unreadable");
            decoded.remark = Some((0, message));
            decoded
        }
    }
}

fn utf8(bytes: &[u8]) -> Decoded<'_> {
    match std::str::from_utf8(bytes) {
        Ok(text) => Decoded {
            text: Cow::Borrowed(text),
            remark: None,
        },
        Err(error) => {
            let (valid, _) = bytes.split_at(error.valid_up_to());
            let at = windows_1252(valid).len();
            let message = format!(
                "byte {} is not UTF-8; the file is read as windows-1252",
                error.valid_up_to()
            );
            Decoded {
                text: windows_1252(bytes),
                remark: Some((at, message)),
            }
        }
    }
}

fn windows_1252(bytes: &[u8]) -> Cow<'_, str> {
    if bytes.is_ascii()
        && let Ok(text) = std::str::from_utf8(bytes)
    {
        return Cow::Borrowed(text);
    }
    let mut text = String::with_capacity(bytes.len() + bytes.len() / 16);
    // ASCII is copied in large pieces; other bytes are decoded in small pieces.
    for piece in bytes.chunks(1024) {
        if !push_ascii(&mut text, piece) {
            for piece in piece.chunks(64) {
                if !push_ascii(&mut text, piece) {
                    text.extend(piece.iter().map(|&byte| windows_1252_letter(byte)));
                }
            }
        }
    }
    Cow::Owned(text)
}

/// Appends `bytes` if they are ASCII. Returns false otherwise.
fn push_ascii(text: &mut String, bytes: &[u8]) -> bool {
    let ascii = bytes.is_ascii();
    if let (true, Ok(plain)) = (ascii, std::str::from_utf8(bytes)) {
        text.push_str(plain);
    }
    ascii
}

fn windows_1252_letter(byte: u8) -> char {
    match byte {
        0x80..=0x9f => HIGH_CONTROLS
            .get(usize::from(byte - 0x80))
            .copied()
            .unwrap_or('\u{fffd}'),
        _ => char::from(byte),
    }
}

fn utf16(bytes: &[u8], unit: fn([u8; 2]) -> u16) -> Decoded<'static> {
    let units = bytes.chunks_exact(2).map(|pair| unit([pair[0], pair[1]]));
    let text: String = char::decode_utf16(units)
        .map(|c| c.unwrap_or('\u{fffd}'))
        .collect();
    Decoded {
        text: Cow::Owned(text.trim_start_matches('\u{feff}').to_owned()),
        remark: None,
    }
}

/// Returns the encoding that the XML declaration names, in lower case.
fn declared(bytes: &[u8]) -> Option<String> {
    let head = bytes.get(..bytes.len().min(256))?;
    let head: String = head.iter().map(|&b| char::from(b)).collect();
    let declaration = head
        .trim_start()
        .strip_prefix("<?xml")?
        .split("?>")
        .next()?;
    let after = declaration
        .split_once("encoding")?
        .1
        .trim_start()
        .strip_prefix('=')?
        .trim_start();
    let quote = after.chars().next().filter(|c| matches!(c, '"' | '\''))?;
    let name = after.get(1..)?.split(quote).next()?;
    Some(name.trim().to_ascii_lowercase())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn decode_yields_the_same_text_for_each_encoding() {
        let plain = "<?xml version=\"1.0\"?><a>\u{fc}\u{b5}</a>";
        let mut bom = vec![0xef, 0xbb, 0xbf];
        bom.extend_from_slice(plain.as_bytes());
        let mut little = vec![0xff, 0xfe];
        little.extend(plain.encode_utf16().flat_map(u16::to_le_bytes));
        let big: Vec<u8> = plain.encode_utf16().flat_map(u16::to_be_bytes).collect();
        for bytes in [plain.as_bytes(), &bom, &little, &big] {
            assert_eq!(decode(bytes).text, plain);
        }
    }

    #[test]
    fn decode_reads_declared_latin_1_as_windows_1252() {
        let decoded = decode(b"<?xml version='1.0' encoding='ISO-8859-1'?><a>\xfc \x80</a>");
        assert!(decoded.text.ends_with("<a>\u{fc} \u{20ac}</a>"));
        assert_eq!(decoded.remark, None);
    }

    #[test]
    fn decode_reads_broken_utf_8_with_a_remark() {
        let decoded = decode(b"<a>\xfc</a>");
        assert_eq!(decoded.text, "<a>\u{fc}</a>");
        assert!(decoded.remark.is_some_and(|(at, _)| at == 3));
    }
}
