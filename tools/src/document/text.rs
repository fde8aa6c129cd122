//! Documents as text: aligned columns and wrapped lines.

use std::fmt::Write;

use super::{Block, Document, Table};

/// The gap between columns.
const GAP: usize = 2;
/// The minimum width before narrower columns are shrunk as well.
const NARROW: usize = 14;
/// The absolute minimum width of a column.
const NARROWEST: usize = 6;

impl Document {
    /// Formats the document without charts for `columns`; `None`: lines of any length.
    #[must_use]
    pub fn text(&self, columns: Option<usize>) -> String {
        let mut out = String::new();
        item(&mut out, "", "  ", &self.title, columns);
        let mut gap = false;
        for block in &self.blocks {
            gap |= matches!(block, Block::Gap | Block::Heading(_));
            if matches!(block, Block::Gap | Block::Chart(_)) {
                continue;
            }
            if std::mem::take(&mut gap) && !out.is_empty() {
                out.push('\n');
            }
            match block {
                Block::Heading(text) => item(&mut out, "", "  ", text, columns),
                Block::Item { lead, text } => {
                    let lead = format!("  {lead}");
                    let hanging = " ".repeat(lead.chars().count());
                    item(&mut out, &lead, &hanging, text, columns);
                }
                Block::Table(table) => table.write(&mut out, 2, columns),
                Block::Chart(_) | Block::Gap => {}
            }
        }
        out
    }
}

/// Writes a text with `lead` before its first line and `hanging` before the others.
fn item(out: &mut String, lead: &str, hanging: &str, text: &str, columns: Option<usize>) {
    let width = columns.unwrap_or(usize::MAX);
    let width = width.saturating_sub(hanging.chars().count());
    let lines: Vec<String> = match text.contains('\n') {
        true => text.lines().map(str::to_owned).collect(),
        false => fill(text, width),
    };
    for (n, line) in lines.iter().enumerate() {
        let line = format!("{}{line}", if n == 0 { lead } else { hanging });
        let _ = writeln!(out, "{}", line.trim_end());
    }
}

/// Breaks a text between words into lines of at most `width` characters. A longer word gets a line
/// of its own. An empty text has no line.
fn fill(text: &str, width: usize) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in text.split(' ') {
        match lines.last_mut() {
            Some(line) if line.chars().count() + 1 + word.chars().count() <= width => {
                line.push(' ');
                *line += word;
            }
            _ => lines.push(word.to_owned()),
        }
    }
    lines.retain(|line| !line.is_empty());
    lines
}

/// Breaks a text into lines of at most `width` characters, within words if they are longer.
fn wrap(text: &str, width: usize) -> Vec<String> {
    if text.chars().count() <= width {
        return vec![text.to_owned()];
    }
    let mut lines = Vec::new();
    for line in fill(text, width.max(1)) {
        let letters: Vec<char> = line.chars().collect();
        lines.extend(letters.chunks(width.max(1)).map(String::from_iter));
    }
    lines
}

impl Table {
    /// Formats the table, indented by `indent`; `None`: lines of any length.
    #[must_use]
    pub fn text(&self, indent: usize, columns: Option<usize>) -> String {
        let mut out = String::new();
        self.write(&mut out, indent, columns);
        out
    }

    /// Shrinks the widest columns until no line exceeds `limit` characters.
    fn write(&self, out: &mut String, indent: usize, limit: Option<usize>) {
        let (first, last) = self.ends.unwrap_or((self.rows.len(), 0));
        let hidden = self.rows.len().saturating_sub(first + last);
        let shown = |n: usize| hidden == 0 || n < first || n >= first + hidden;
        let rows = self.rows.iter().enumerate().filter(|(n, _)| shown(*n));
        let head = Some(&self.head).filter(|head| !head.is_empty());
        let rows: Vec<_> = head.into_iter().chain(rows.map(|(_, row)| row)).collect();
        let widths = self.widths(&rows, indent, limit.unwrap_or(usize::MAX));
        let limit = limit.unwrap_or(usize::MAX);
        let gaps = indent + GAP * widths.len().saturating_sub(1);
        if head.is_some() && widths.iter().sum::<usize>() + gaps > limit {
            self.write_records(out, &rows, indent, limit);
            if hidden > 0 {
                more(out, indent, hidden);
            }
            return;
        }
        for (n, row) in rows.iter().enumerate() {
            if hidden > 0 && n == first + self.head.len().min(1) {
                more(out, indent, hidden);
            }
            let cells = row.iter().zip(&widths);
            let cells: Vec<_> = cells.map(|(cell, width)| wrap(cell, *width)).collect();
            for n in 0..cells.iter().map(Vec::len).max().unwrap_or(0) {
                let mut line = " ".repeat(indent);
                for (cell, width) in cells.iter().zip(&widths) {
                    let part = cell.get(n).map_or("", String::as_str);
                    let _ = write!(line, "{part:<w$}", w = width + GAP);
                }
                let _ = writeln!(out, "{}", line.trim_end());
            }
        }
        if hidden > 0 && last == 0 {
            more(out, indent, hidden);
        }
    }

    /// Formats each row as lines of heading and value, for a terminal that no row fits.
    fn write_records(&self, out: &mut String, rows: &[&Vec<String>], indent: usize, limit: usize) {
        let label = self.head.iter().map(|head| head.chars().count());
        let label = label.max().unwrap_or(0);
        let room = limit.saturating_sub(indent + label + GAP).max(NARROWEST);
        for (n, row) in rows.iter().skip(1).enumerate() {
            if n > 0 {
                out.push('\n');
            }
            for (head, cell) in self.head.iter().zip(*row) {
                for (n, part) in wrap(cell, room).iter().enumerate() {
                    let head = if n == 0 { head } else { "" };
                    let line = format!("{:indent$}{head:<label$}{:GAP$}{part}", "", "");
                    let _ = writeln!(out, "{}", line.trim_end());
                }
            }
        }
    }

    fn widths(&self, rows: &[&Vec<String>], indent: usize, limit: usize) -> Vec<usize> {
        let columns = rows.iter().map(|row| row.len()).max().unwrap_or(0);
        let of = |column: usize, len: fn(&String) -> usize| {
            let cells = rows.iter().filter_map(|row| row.get(column));
            cells.map(len).max().unwrap_or(0)
        };
        let len = |cell: &String| cell.chars().count();
        let word = |cell: &String| {
            let words = cell.split(' ').map(|word| word.chars().count());
            words.max().unwrap_or(0)
        };
        let mut widths: Vec<usize> = (0..columns).map(|column| of(column, len)).collect();
        let words = (0..columns).map(|column| of(column, word));
        let words: Vec<usize> = words.map(|word| word.clamp(NARROWEST, NARROW)).collect();
        let between = indent + GAP * columns.saturating_sub(1);
        // If wrapping between words does not suffice, words are broken as well.
        for floors in [&vec![NARROW; columns], &words, &vec![NARROWEST; columns]] {
            while widths.iter().sum::<usize>() + between > limit {
                let wide = widths.iter_mut().zip(floors);
                let wide = wide.filter(|(width, floor)| **width > **floor);
                let Some((widest, _)) = wide.max_by_key(|(width, _)| **width) else {
                    break;
                };
                *widest -= 1;
            }
        }
        widths
    }
}

fn more(out: &mut String, indent: usize, hidden: usize) {
    let _ = writeln!(out, "{:indent$}… {hidden} more, `--all` shows them", "");
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_align() {
        let mut table = Table::new("a|bé|c");
        table.row(crate::cells!["long", "x", ""]);
        assert_eq!(table.text(1, None), " a     bé  c\n long  x\n");
    }

    #[test]
    fn table_wraps_cells_on_a_narrow_terminal() {
        let mut table = Table::new("no|what it takes|name");
        table.row(crate::cells![
            1,
            "one module, another module, a third",
            "an_endless_name_without_a_space",
        ]);
        let expected = "  no  what it takes     name
  1   one module,       an_endless_name_
      another module,   without_a_space
      a third
";
        assert_eq!(table.text(2, Some(40)), expected);
        assert_eq!(table.text(2, Some(400)), table.text(2, None));
        for limit in 0..100 {
            let text = table.text(0, Some(limit));
            let widest = text.lines().map(|line| line.chars().count()).max();
            assert!(
                widest <= Some(limit.max(2 * NARROW + 2 + 2 * GAP)),
                "{limit}: {text}"
            );
        }
    }

    #[test]
    fn table_becomes_records_if_no_row_fits() {
        let mut table = Table::new("axis|state|final position|largest following error");
        for name in ["x", "y"] {
            table.row(crate::cells![
                name,
                "Switch on disabled",
                "0.0000 mm",
                "0.3032 mm"
            ]);
        }
        let record = |name: &str| {
            format!(
                "axis                     {name}\nstate                    Switch\n                         on\n                         disabl\n                         ed\nfinal position           0.0000\n                         mm\nlargest following error  0.3032\n                         mm\n"
            )
        };
        let expected = format!("{}\n{}", record("x"), record("y"));
        assert_eq!(table.text(0, Some(27)), expected);
        assert_eq!(
            table.text(0, Some(28)).lines().next(),
            Some("axis  state   final   larges")
        );
    }

    #[test]
    fn shortened_table_counts_the_rows_that_it_hides() {
        let mut table = Table::new("n");
        (0..9).for_each(|n| table.row(crate::cells![n]));
        let text = table.clone().shorten(2, 1).text(0, None);
        assert_eq!(text, "n\n0\n1\n… 6 more, `--all` shows them\n8\n");
        let text = table.clone().shorten(1, 0).text(0, None);
        assert_eq!(text, "n\n0\n… 8 more, `--all` shows them\n");
        assert_eq!(
            table.clone().shorten(8, 1).text(0, None),
            table.text(0, None)
        );
    }

    #[test]
    fn document_wraps_items_below_their_text_and_keeps_commands() {
        let mut document = Document::new("a title of words");
        document.heading("Facts");
        document.item("- ", "one two three four");
        document.item("now ", "a command of \\\n  two lines");
        let expected = "a title of
  words

Facts
  - one two
    three
    four
  now a command of \\
        two lines
";
        assert_eq!(document.text(Some(12)), expected);
    }
}
