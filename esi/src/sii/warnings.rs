//! What is wrong with an image and does not keep anybody from reading it.

use std::fmt;

use super::category;
use super::parse::{Category, byte};
use super::strings::Table;

/// More are not worth reading.
const MOST: usize = 100;

/// One thing that is wrong, and where.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SiiWarning {
    /// From the beginning of the image.
    pub offset: usize,
    /// `None`: in the header, or the image as a whole.
    pub category: Option<u16>,
    pub remark: Remark,
}

#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum Remark {
    /// A controller ignores its configuration.
    Checksum { found: u8, right: u8 },
    /// The end mark is missing.
    NoEnd,
    /// The end mark comes first: only the header says anything.
    NoCategories,
    /// A category of which there should be one comes again.
    Repeated,
    /// What is left at the end makes no whole record.
    LeftOver { bytes: usize, record: usize },
    /// The category ends before its last text.
    Strings { claimed: u8, found: usize },
    /// A text that does not exist is referred to; it reads as empty.
    NoString { number: u8, strings: usize },
    /// Neither a direction nor the mailbox state.
    Fmmu { code: u8 },
    /// None of ETG.2010's types.
    SyncManager { code: u8 },
}

impl fmt::Display for SiiWarning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "byte 0x{:x}", self.offset)?;
        if let Some(category) = self.category {
            write!(f, ", category {category}")?;
        }
        f.write_str(": ")?;
        match self.remark {
            Remark::Checksum { found, right } => {
                write!(
                    f,
                    "the checksum is 0x{found:02x}, right would be 0x{right:02x}; a controller ignores its configuration"
                )
            }
            Remark::NoEnd => f.write_str("the image stops without an end mark"),
            Remark::NoCategories => f.write_str("there are no categories, the header is all"),
            Remark::Repeated => f.write_str("the category is there a second time"),
            Remark::LeftOver { bytes, record } => {
                write!(f, "{bytes} bytes are left over, records have {record}")
            }
            Remark::Strings { claimed, found } => {
                write!(f, "the category claims {claimed} texts and holds {found}")
            }
            Remark::NoString { number, strings } => {
                write!(f, "text {number} is named, there are {strings}")
            }
            Remark::Fmmu { code } => write!(f, "{code} is no use of an FMMU"),
            Remark::SyncManager { code } => write!(f, "{code} is no type of a SyncManager"),
        }
    }
}

#[derive(Default)]
pub(super) struct Notes(pub Vec<SiiWarning>);

impl Notes {
    pub fn add(&mut self, offset: usize, category: Option<u16>, remark: Remark) {
        if self.0.len() < MOST {
            self.0.push(SiiWarning {
                offset,
                category,
                remark,
            });
        }
    }
}

/// Texts that one category refers to.
pub(super) struct Texts<'a> {
    pub table: &'a Table,
    pub here: Category<'a>,
    pub notes: &'a mut Notes,
}

impl Texts<'_> {
    /// The text whose number stands at this byte of the category.
    pub fn text(&mut self, at: usize) -> String {
        let number = byte(self.here.data, at);
        let strings = self.table.len();
        if usize::from(number) > strings {
            let remark = Remark::NoString { number, strings };
            self.notes
                .add(self.here.offset + at, Some(self.here.kind), remark);
        }
        self.table.text(number)
    }
}

pub(super) fn strings_of(here: &Category<'_>, notes: &mut Notes) -> Table {
    let table = Table::parse(here.data);
    let (claimed, found) = (byte(here.data, 0), table.len());
    if usize::from(claimed) > found {
        notes.add(
            here.offset,
            Some(here.kind),
            Remark::Strings { claimed, found },
        );
    }
    table
}

pub(super) fn repeated(found: &[Category<'_>], notes: &mut Notes) {
    const ONCE: [u16; 7] = [
        category::STRINGS,
        category::GENERAL,
        category::FMMU,
        category::SYNC_MANAGER,
        category::FMMU_DETAILS,
        category::SYNC_UNIT,
        category::DC,
    ];
    for kind in ONCE {
        for again in found.iter().filter(|c| c.kind == kind).skip(1) {
            notes.add(again.offset, Some(kind), Remark::Repeated);
        }
    }
}

/// Half records, and codes that mean nothing.
pub(super) fn left_over(here: &Category<'_>, notes: &mut Notes) {
    let record = match here.kind {
        category::SYNC_MANAGER | category::TX_PDO | category::RX_PDO => 8,
        category::FMMU_DETAILS => 4,
        category::DC => 24,
        _ => 1,
    };
    let bytes = here.data.len() % record;
    if bytes != 0 {
        let at = here.offset + here.data.len() - bytes;
        notes.add(at, Some(here.kind), Remark::LeftOver { bytes, record });
    }
    match here.kind {
        category::FMMU => {
            for (at, &code) in here.data.iter().enumerate() {
                // 0 and 0xff: unused.
                if !matches!(code, 0..=3 | 0xff) {
                    notes.add(here.offset + at, Some(here.kind), Remark::Fmmu { code });
                }
            }
        }
        category::SYNC_MANAGER => {
            for (n, sm) in here.data.chunks_exact(8).enumerate() {
                let code = byte(sm, 7);
                if code > 4 {
                    let at = here.offset + n * 8 + 7;
                    notes.add(at, Some(here.kind), Remark::SyncManager { code });
                }
            }
        }
        _ => {}
    }
}
