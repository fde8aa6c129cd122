//! A report as data: title, headings, items, tables and charts, each in the order of the page.
//!
//! A subsystem builds one [`Document`]; [`Document::text`] and [`Document::html`] render it.
//!
//! - `text`: aligned columns, wrapped to a width; without charts;
//! - `html`: one self-contained XHTML file; `chart`, `svg`: its charts; `report.css`, `report.js`;
//! - [`mod@format`]: figures, times and options as text.

use std::collections::BTreeMap;

mod chart;
pub mod format;
mod html;
mod svg;
mod text;

pub use chart::{Axis, Chart, Format, Marker, Series, Shape};
pub(crate) use html::escape;

/// A report.
#[derive(Debug, Clone, Default)]
pub struct Document {
    title: String,
    lead: Option<Lead>,
    blocks: Vec<Block>,
}

/// The main result.
#[derive(Debug, Clone)]
struct Lead {
    text: String,
    bad: bool,
}

#[derive(Debug, Clone)]
enum Block {
    Heading(String),
    Item { lead: String, text: String },
    Table(Table),
    Chart(Chart),
    Gap,
}

impl Document {
    /// An empty title is not shown as text.
    #[must_use]
    pub fn new(title: impl Into<String>) -> Self {
        Self {
            title: title.into(),
            lead: None,
            blocks: Vec::new(),
        }
    }

    /// Sets the main result, which a page shows first. `bad`: it is a fault.
    pub fn lead(&mut self, text: impl Into<String>, bad: bool) {
        let text = text.into();
        self.lead = Some(Lead { text, bad });
    }

    /// Adds a heading, after an empty line.
    pub fn heading(&mut self, text: impl Into<String>) {
        self.blocks.push(Block::Heading(text.into()));
    }

    /// Adds an indented text. Continuation lines begin below the text, not below `lead`. A text
    /// with line feeds, such as a command, is not wrapped.
    pub fn item(&mut self, lead: impl Into<String>, text: impl Into<String>) {
        let (lead, text) = (lead.into(), text.into());
        self.blocks.push(Block::Item { lead, text });
    }

    /// Adds an indented line.
    pub fn line(&mut self, text: impl Into<String>) {
        self.item("", text);
    }

    /// Adds a table unless it has no rows; an empty line separates it from a table before it.
    pub fn table(&mut self, table: Table) {
        if table.rows.is_empty() {
            return;
        }
        if let Some(Block::Table(_)) = self.blocks.last() {
            self.gap();
        }
        self.blocks.push(Block::Table(table));
    }

    /// Adds a heading and a table unless the table has no rows.
    pub fn section(&mut self, heading: impl Into<String>, table: Table) {
        if !table.rows.is_empty() {
            self.heading(heading);
            self.table(table);
        }
    }

    /// Adds a line with the names of vendor ids, each once.
    pub fn vendors<'n>(&mut self, named: impl IntoIterator<Item = (u32, &'n str)>) {
        let named: BTreeMap<u32, &str> = named.into_iter().collect();
        let named = named
            .iter()
            .map(|(id, name)| format!("{} {name}", format::hex32(*id)));
        let named: Vec<String> = named.collect();
        if !named.is_empty() {
            self.item("vendors: ", named.join(", "));
        }
    }

    /// Adds a chart, which only a page shows.
    pub fn chart(&mut self, chart: Chart) {
        self.blocks.push(Block::Chart(chart));
    }

    /// Adds an empty line before the next block, if one follows.
    pub fn gap(&mut self) {
        self.blocks.push(Block::Gap);
    }
}

/// A table whose columns are as wide as their widest cell.
#[derive(Debug, Clone, Default)]
pub struct Table {
    head: Vec<String>,
    rows: Vec<Vec<String>>,
    /// The number of first and last rows that text shows.
    ends: Option<(usize, usize)>,
}

impl Table {
    /// Returns a table with these headings, separated by `|`. Without headings it lists facts.
    #[must_use]
    pub fn new(head: &str) -> Self {
        let cells = head.split('|').filter(|_| !head.is_empty());
        Self {
            head: cells.map(str::to_owned).collect(),
            ..Self::default()
        }
    }

    /// Adds a row with as many cells as the header, such as `cells![name, count]`.
    pub fn row<const N: usize>(&mut self, cells: [String; N]) {
        self.rows.push(cells.into());
    }

    /// Adds a row whose number of cells depends on the data.
    pub fn line(&mut self, cells: Vec<String>) {
        self.rows.push(cells);
    }

    /// Limits the rows that text shows.
    #[must_use]
    pub fn shorten(mut self, first: usize, last: usize) -> Self {
        self.ends = Some((first, last));
        self
    }

    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }
}

/// The cells of a row, from values that implement `Display`.
#[macro_export]
macro_rules! cells {
    ($($cell:expr),* $(,)?) => { [$(($cell).to_string()),*] };
}
