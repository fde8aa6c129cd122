//! Documents as one self-contained XHTML file with inline style and drawings.

use super::{Block, Document, Lead, Table};

/// The maximum number of table rows; further ones are counted.
const ROWS: usize = 500;

const STYLE: &str = include_str!("report.css");
const SCRIPT: &str = include_str!("report.js");
/// The buttons above the page of a report with plots.
const TOOLS: &str = "<div class=\"tools\"><button type=\"button\" data-act=\"closer\" title=\"zoom in\">+</button>\
<button type=\"button\" data-act=\"farther\" title=\"zoom out\">−</button>\
<button type=\"button\" data-act=\"whole\">Whole</button>\
<span>Drag over a plot to zoom; double-click shows the whole. Keys: + − 0 ← →.</span></div>\n";

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
        if let Some(Lead { text, bad }) = &self.lead {
            let class = if *bad { "lead bad" } else { "lead" };
            out += &format!("<p class=\"{class}\">{}</p>\n", escape(text));
        }
        let charts = self
            .blocks
            .iter()
            .any(|block| matches!(block, Block::Chart(_)));
        if charts {
            out += TOOLS;
        }
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
        out += &format!("<footer>ecaxis {version}</footer>");
        if charts {
            // The comments hide the section of XML from scripts, and the script from XML.
            out += &format!("<script>//<![CDATA[\n{SCRIPT}//]]></script>");
        }
        out + "</body></html>\n"
    }
}

impl Table {
    fn html(&self) -> String {
        // Numbers are aligned to the right, except in the first column.
        let columns = self.rows.iter().map(Vec::len).max().unwrap_or(0);
        let is_number = |n: usize| {
            let cells = self.rows.iter().filter_map(|row| row.get(n));
            n > 0 && !self.head.is_empty() && cells.clone().all(|cell| is_number(cell))
        };
        let numbers: Vec<bool> = (0..columns).map(is_number).collect();
        let row = |cells: &[String], tag: &str| {
            let cells = cells.iter().zip(&numbers).map(|(cell, number)| {
                let class = if *number { " class=\"n\"" } else { "" };
                format!("<{tag}{class}>{}</{tag}>", escape(cell.trim()))
            });
            format!("<tr>{}</tr>", cells.collect::<String>())
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
        format!(
            "<div class=\"scroll\"><table{class}>{head}<tbody>{rows}</tbody></table></div>\n{more}"
        )
    }
}

/// True for `12`, `-0.5 mm`, `+3 ppm`, `-` and nothing, but not for `0x1000`.
fn is_number(cell: &str) -> bool {
    let digits = cell.trim().trim_start_matches(['-', '+']);
    let first = digits.chars().next();
    first.is_none_or(|c| c.is_ascii_digit()) && !digits.starts_with("0x")
}

/// Escapes `&`, `<`, `>` and quotes, and removes characters that XML does not allow.
pub(crate) fn escape(text: &str) -> String {
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
