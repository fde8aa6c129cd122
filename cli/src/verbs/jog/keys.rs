//! Bytes from a terminal → keys.

/// A key, or a terminal event such as a focus change.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Key {
    Char(char),
    Up,
    Down,
    Left,
    Right,
    Enter,
    Backspace,
    Escape,
    /// Ctrl-C, Ctrl-D.
    Leave,
    FocusGained,
    FocusLost,
    /// A key without function.
    Other,
}

/// The maximum length of an escape sequence.
const LONGEST: usize = 32;
const PASTE_ENDS: &[u8] = b"\x1b[201~";

/// A decoder that buffers incomplete sequences.
#[derive(Debug, Default)]
pub(super) struct Keys {
    bytes: Vec<u8>,
    pasting: bool,
}

impl Keys {
    /// Returns the keys that these bytes complete. Pasted text produces no keys.
    pub fn take(&mut self, bytes: &[u8]) -> Vec<Key> {
        self.bytes.extend_from_slice(bytes);
        let mut keys = Vec::new();
        loop {
            if self.pasting {
                let end = self.bytes.windows(PASTE_ENDS.len());
                let end = end.into_iter().position(|w| w == PASTE_ENDS);
                let Some(end) = end else {
                    // The end marker itself may arrive in two pieces.
                    let keep = self.bytes.len().saturating_sub(PASTE_ENDS.len() - 1);
                    self.bytes.drain(..keep);
                    return keys;
                };
                self.bytes.drain(..end + PASTE_ENDS.len());
                self.pasting = false;
            }
            let Some((key, length)) = first(&self.bytes) else {
                return keys;
            };
            self.bytes.drain(..length.min(self.bytes.len()));
            match key {
                Some(key) => keys.push(key),
                None => self.pasting = true,
            }
        }
    }

    /// Decodes the remaining bytes after a pause.
    pub fn flush(&mut self) -> Option<Key> {
        if self.pasting || self.bytes.is_empty() {
            return None;
        }
        let alone = self.bytes == [0x1b];
        self.bytes.clear();
        Some(if alone { Key::Escape } else { Key::Other })
    }
}

/// Returns the first complete key and its length; no key at the start of pasted text.
fn first(bytes: &[u8]) -> Option<(Option<Key>, usize)> {
    let key = |key, length| Some((Some(key), length));
    match *bytes.first()? {
        0x1b => sequence(bytes),
        b'\r' | b'\n' => key(Key::Enter, 1),
        0x03 | 0x04 => key(Key::Leave, 1),
        0x08 | 0x7f => key(Key::Backspace, 1),
        b'\t' => key(Key::Down, 1),
        0..=0x1f => key(Key::Other, 1),
        byte @ 0x20..=0x7e => key(Key::Char(char::from(byte)), 1),
        lead => {
            let length = match lead {
                0xc2..=0xdf => 2,
                0xe0..=0xef => 3,
                0xf0..=0xf4 => 4,
                _ => return key(Key::Other, 1),
            };
            let text = bytes.get(..length)?;
            match std::str::from_utf8(text)
                .ok()
                .and_then(|t| t.chars().next())
            {
                Some(c) => key(Key::Char(c), length),
                None => key(Key::Other, 1),
            }
        }
    }
}

/// Decodes an escape sequence (ECMA-48: CSI parameters final, SS3 final).
fn sequence(bytes: &[u8]) -> Option<(Option<Key>, usize)> {
    let key = |key, length| Some((Some(key), length));
    match *bytes.get(1)? {
        b'O' => key(arrow(*bytes.get(2)?), 3),
        b'[' => {
            let rest = bytes.get(2..)?;
            let last = rest.iter().position(|b| (0x40..=0x7e).contains(b));
            let Some(last) = last else {
                let endless = rest.len() >= LONGEST;
                return endless.then_some((Some(Key::Other), bytes.len()));
            };
            let length = last + 3;
            match (&rest[..last], rest[last]) {
                (b"200", b'~') => Some((None, length)),
                (b"", b'O') => key(Key::FocusLost, length),
                (b"", b'I') => key(Key::FocusGained, length),
                (b"", last) => key(arrow(last), length),
                _ => key(Key::Other, length),
            }
        }
        // Two keys; the first is Escape.
        0x1b => key(Key::Escape, 1),
        // Alt with another key.
        _ => key(Key::Other, 2),
    }
}

fn arrow(last: u8) -> Key {
    match last {
        b'A' => Key::Up,
        b'B' => Key::Down,
        b'C' => Key::Right,
        b'D' => Key::Left,
        _ => Key::Other,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use Key::{
        Backspace, Char, Down, Enter, Escape, FocusGained, FocusLost, Leave, Left, Other, Right, Up,
    };

    #[test]
    fn keys_decodes_terminal_sequences() {
        for (bytes, expected) in [
            (&b"a Z"[..], &[Char('a'), Char(' '), Char('Z')][..]),
            (b"\x1b[A\x1b[B\x1b[C\x1b[D", &[Up, Down, Right, Left]),
            (b"\x1bOC\x1bOD", &[Right, Left]),
            (
                b"\r\n\x7f\x08\t",
                &[Enter, Enter, Backspace, Backspace, Down],
            ),
            (b"\x03\x04", &[Leave, Leave]),
            (b"\x1b[O\x1b[I", &[FocusLost, FocusGained]),
            (b"\x1b[1;5C\x1b[3~x", &[Other, Other, Char('x')]),
            (b"\x1b\x1b[C", &[Escape, Right]),
            (b"\x1bx", &[Other]),
            ("µ".as_bytes(), &[Char('µ')]),
            (b"\xff\x80", &[Other, Other]),
            (b"\x00\x1f", &[Other, Other]),
        ] {
            assert_eq!(Keys::default().take(bytes), expected, "{bytes:?}");
        }
    }

    #[test]
    fn keys_decodes_split_input() {
        let bytes = b"a\x1b[Cb\x1b[200~xe\x1b[Cq\x1b[201~\x1b[D\xc2\xb5";
        let whole = Keys::default().take(bytes);
        assert_eq!(
            whole,
            [Char('a'), Right, Char('b'), Left, Char('µ')],
            "pasted text is not a key"
        );
        let mut keys = Keys::default();
        let pieces: Vec<Key> = bytes.iter().flat_map(|b| keys.take(&[*b])).collect();
        assert_eq!(pieces, whole);
    }

    #[test]
    fn lone_escape_is_a_key() {
        let mut keys = Keys::default();
        assert_eq!(keys.take(b"\x1b"), []);
        assert_eq!(keys.flush(), Some(Escape));
        assert_eq!(keys.flush(), None);
        assert_eq!(keys.take(b"\x1b[1"), []);
        assert_eq!(keys.flush(), Some(Other));
    }

    #[test]
    fn keys_buffer_is_bounded() {
        let mut keys = Keys::default();
        for _ in 0..1000 {
            keys.take(b"\x1b[1111111111111111");
            assert!(keys.bytes.len() < 100);
        }
        let mut keys = Keys::default();
        keys.take(b"\x1b[200~");
        for _ in 0..1000 {
            assert_eq!(keys.take(b"quit e x"), []);
            assert!(keys.bytes.len() < 100);
        }
    }
}
