//! Documents as one self-contained XHTML file with inline style and drawings.

use super::{Block, Document, Table};

/// The maximum number of table rows; further ones are counted.
const ROWS: usize = 500;

const STYLE: &str = "body{font:15px/1.5 system-ui,sans-serif;max-width:900px;margin:2em auto;padding:0 1em;color:#1a1a1a}\
h1{font-size:1.5em}h2{font-size:1.15em;margin-top:2em}p{margin:.3em 0}\
table{border-collapse:collapse;width:100%;margin:.5em 0;font-variant-numeric:tabular-nums}\
th,td{text-align:right;padding:.25em .6em;border-bottom:1px solid #ddd}th:first-child,td:first-child{text-align:left}\
th{font-weight:600}svg{width:100%;height:auto;margin:.5em 0}svg text{font-size:11px;fill:#444}\
.grid{stroke:#e5e5e5}.key{display:inline-block;width:.8em;height:.8em;margin:0 .4em 0 1em}.facts td{text-align:left}\
.facts td:first-child{width:11em;color:#555}footer{margin-top:2em;color:#777;font-size:.9em}";

impl Document {
    /// Returns the complete page.
    #[must_use]
    pub fn html(&self) -> String {
        let title = escape(&self.title);
        let mut out = format!(
            "<!DOCTYPE html>\n<html xmlns=\"http://www.w3.org/1999/xhtml\" lang=\"en\"><head><meta charset=\"utf-8\"/>\
             <meta name=\"viewport\" content=\"width=device-width\"/><title>{title}</title>\
             <style>{STYLE}</style></head><body>\n<h1>{title}</h1>\n"
        );
        for block in &self.blocks {
            out += &match block {
                Block::Heading(text) => format!("<h2>{}</h2>\n", escape(text)),
                Block::Item { lead, text } if text.is_empty() => {
                    let lead = lead.trim_end_matches([' ', ':']);
                    format!("<p>{}</p>\n", escape(lead))
                }
                Block::Item { lead, text } => {
                    format!("<p>{}{}</p>\n", escape(lead), escape(text))
                }
                Block::Table(table) => table.html(),
                Block::Chart(chart) => chart.html(),
                Block::Gap => String::new(),
            };
        }
        let version = env!("CARGO_PKG_VERSION");
        out + &format!("<footer>ecaxis {version}</footer></body></html>\n")
    }
}

impl Table {
    fn html(&self) -> String {
        let row = |cells: &[String], tag: &str| {
            let cells = cells.iter();
            let cells = cells.map(|cell| format!("<{tag}>{}</{tag}>", escape(cell)));
            format!("<tr>{}</tr>\n", cells.collect::<String>())
        };
        let (class, head) = match self.head.is_empty() {
            true => (" class=\"facts\"", String::new()),
            false => ("", format!("<thead>{}</thead>", row(&self.head, "th"))),
        };
        let rows = self.rows.iter().take(ROWS).map(|cells| row(cells, "td"));
        let rows: String = rows.collect();
        let more = match self.rows.len().saturating_sub(ROWS) {
            0 => String::new(),
            more => format!("<p>… and {more} more.</p>\n"),
        };
        format!("<table{class}>{head}<tbody>{rows}</tbody></table>\n{more}")
    }
}

/// Escapes `&`, `<`, `>` and quotes, and removes characters that XML does not allow.
pub(super) fn escape(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out += "&amp;",
            '<' => out += "&lt;",
            '>' => out += "&gt;",
            '"' => out += "&quot;",
            '\'' => out += "&#39;",
            '\u{fffe}' | '\u{ffff}' => {}
            c if c.is_control() && !matches!(c, '\n' | '\t') => {}
            c => out.push(c),
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn item_without_text_shows_its_name() {
        let mut document = Document::new("x");
        document.item("sleep: ", "");
        document.item("spin: ", "1 < 2");
        let page = document.html();
        assert!(page.contains("<p>sleep</p>"), "{page}");
        assert!(page.contains("<p>spin: 1 &lt; 2</p>"), "{page}");
    }
}
