//! Formats keys, values and comments in columns.

/// The column of comments if the value leaves room.
const COMMENTS: usize = 36;

#[derive(Debug, Default)]
pub(crate) struct TomlWriter {
    header: Option<&'static str>,
    /// Key, value, comment; without a key, only a comment.
    lines: Vec<(String, String, String)>,
}

impl TomlWriter {
    pub fn header(&mut self, header: &'static str) {
        self.header = Some(header);
    }

    /// Adds a line. `comment` may be empty.
    pub fn add(&mut self, key: &str, value: &str, comment: &str) {
        self.lines
            .push((key.to_owned(), value.to_owned(), one_line(comment)));
    }

    pub fn comment(&mut self, comment: &str) {
        self.lines
            .push((String::new(), String::new(), one_line(comment)));
    }

    pub fn text(&self) -> String {
        let keys = self.lines.iter().map(|(key, ..)| key.chars().count());
        let width = keys.max().unwrap_or(0);
        let mut text = self.header.map(|h| format!("{h}\n")).unwrap_or_default();
        for (key, value, comment) in &self.lines {
            let line = match (key.is_empty(), comment.is_empty()) {
                (true, _) => format!("# {comment}"),
                (false, true) => format!("{key:<width$} = {value}"),
                (false, false) => {
                    let line = format!("{key:<width$} = {value}");
                    format!("{line:<COMMENTS$}  # {comment}")
                }
            };
            text += &line;
            text.push('\n');
        }
        text
    }
}

/// Removes control characters: names come from ESI files and EEPROMs.
fn one_line(comment: &str) -> String {
    let plain = |c: char| if c.is_control() { ' ' } else { c };
    comment.chars().map(plain).collect()
}
