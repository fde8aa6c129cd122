//! Text tables for files and terminals.

use crate::render::output::stdout_width;

/// A table whose columns are as wide as their widest cell.
#[derive(Debug)]
pub(crate) struct Table {
    rows: Vec<Vec<String>>,
}

impl Table {
    pub fn new(head: &[&str]) -> Self {
        Self {
            rows: vec![head.iter().map(|cell| (*cell).to_owned()).collect()],
        }
    }

    pub fn row<const N: usize>(&mut self, cells: [&str; N]) {
        self.line(cells.map(ToOwned::to_owned).to_vec());
    }

    /// Adds a row with as many cells as the header.
    pub fn line(&mut self, cells: Vec<String>) {
        self.rows.push(cells);
    }

    /// Formats the table, indented by `by`, without a final line feed.
    pub fn indented(&self, by: usize) -> String {
        self.fitted(by, None)
    }

    /// Like [`Self::indented`], but wraps long cells to the width of a terminal.
    pub fn shown(&self, by: usize) -> String {
        self.fitted(by, stdout_width())
    }

    /// Formats the table for `width` columns, or more if the terminal is wider.
    pub fn within(&self, by: usize, width: usize) -> String {
        self.fitted(by, Some(stdout_width().unwrap_or(width).max(width)))
    }

    /// Formats the table for exactly this many columns.
    pub fn on_page(&self, by: usize, columns: usize) -> String {
        self.fitted(by, Some(columns))
    }

    /// Shrinks the widest columns until no line exceeds `limit` characters.
    fn fitted(&self, by: usize, limit: Option<usize>) -> String {
        let columns = self.rows.iter().map(Vec::len).max().unwrap_or(0);
        let width = |column: usize| {
            let cells = self.rows.iter().filter_map(|row| row.get(column));
            cells.map(|cell| cell.chars().count()).max().unwrap_or(0)
        };
        let mut widths: Vec<usize> = (0..columns).map(width).collect();
        let between = by + GAP * columns.saturating_sub(1);
        let limit = limit.unwrap_or(usize::MAX);
        // If wrapping between words does not suffice, words are broken as well.
        let words = |column: usize| {
            let cells = self.rows.iter().filter_map(|row| row.get(column));
            let words = cells.flat_map(|cell| cell.split(' '));
            words.map(|word| word.chars().count()).max().unwrap_or(0)
        };
        let words: Vec<usize> = (0..columns).map(words).collect();
        for floor in [NARROWEST, 0, NARROWEST_WORD] {
            let floors = words.iter().map(|word| match floor {
                0 => (*word).clamp(NARROWEST_WORD, NARROWEST),
                floor => floor,
            });
            let floors: Vec<usize> = floors.collect();
            while widths.iter().sum::<usize>() + between > limit {
                let wide = widths.iter_mut().zip(&floors);
                let widest = wide
                    .filter(|(width, floor)| **width > **floor)
                    .max_by_key(|(width, _)| **width);
                let Some((widest, _)) = widest else { break };
                *widest -= 1;
            }
        }
        let mut lines = Vec::new();
        for row in &self.rows {
            let cells: Vec<Vec<String>> = row
                .iter()
                .zip(&widths)
                .map(|(cell, width)| broken(cell, *width))
                .collect();
            let height = cells.iter().map(Vec::len).max().unwrap_or(0).max(1);
            for n in 0..height {
                let mut line = " ".repeat(by);
                for (column, (cell, width)) in cells.iter().zip(&widths).enumerate() {
                    let part = cell.get(n).map_or("", String::as_str);
                    let gap = if column == 0 { 0 } else { GAP };
                    line += &format!("{:gap$}{part:<width$}", "");
                }
                lines.push(line.trim_end().to_owned());
            }
        }
        lines.join("\n")
    }
}

/// The gap between columns.
const GAP: usize = 2;
/// The minimum width before narrower columns are shrunk as well.
const NARROWEST: usize = 14;
/// The absolute minimum width of a column.
const NARROWEST_WORD: usize = 6;

/// Breaks a cell into lines of at most `width` characters, between words if possible.
pub(crate) fn broken(cell: &str, width: usize) -> Vec<String> {
    if cell.chars().count() <= width {
        return vec![cell.to_owned()];
    }
    let mut lines = vec![String::new()];
    for word in cell.split_inclusive(' ') {
        let mut word: Vec<char> = word.chars().collect();
        loop {
            let used = lines.last().map_or(0, |line| line.chars().count());
            let bare = word.iter().rposition(|c| *c != ' ').map_or(0, |at| at + 1);
            if used + bare <= width {
                break;
            }
            if used > 0 {
                lines.push(String::new());
                continue;
            }
            // The word is longer than a line.
            lines.pop();
            lines.push(word.drain(..width.max(1)).collect());
            lines.push(String::new());
        }
        if let Some(line) = lines.last_mut() {
            line.extend(word);
        }
    }
    lines.retain(|line| !line.trim().is_empty());
    lines
        .into_iter()
        .map(|line| line.trim_end().to_owned())
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_align() {
        let mut table = Table::new(&["a", "bé", "c"]);
        table.row(["long", "x", ""]);
        assert_eq!(table.indented(1), " a     bé  c\n long  x");
    }

    #[test]
    fn table_wraps_cells_on_a_narrow_terminal() {
        let mut table = Table::new(&["no", "what it takes", "name"]);
        table.row([
            "1",
            "one module, another module, a third",
            "an_endless_name_without_a_space",
        ]);
        let expected = "  no  what it takes     name
  1   one module,       an_endless_name_
      another module,   without_a_space
      a third";
        assert_eq!(table.fitted(2, Some(40)), expected);
        assert_eq!(table.fitted(2, Some(400)), table.indented(2));
        for limit in 0..100 {
            let text = table.fitted(0, Some(limit));
            let letters = |text: &str| {
                let mut all: Vec<char> = text.chars().filter(|c| !c.is_whitespace()).collect();
                all.sort_unstable();
                all
            };
            assert_eq!(letters(&text), letters(&table.indented(0)), "{limit}");
            let widest = text.lines().map(|line| line.chars().count()).max();
            assert!(
                widest <= Some(limit.max(2 * NARROWEST + 2 + 2 * GAP)),
                "{limit}: {text}"
            );
        }
    }
}
