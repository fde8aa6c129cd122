//! Problems in a readable image.

use std::fmt;

use super::category;
use super::parse::{Category, byte};
use super::strings::Table;

/// The maximum number of reported warnings.
const MOST: usize = 100;

/// One problem and its location.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct SiiWarning {
    /// The offset from the start of the image.
    pub offset: usize,
    /// `None`: in the header, or in the image as a whole.
    pub category: Option<u16>,
    /// The problem.
    pub remark: WarningKind,
}

/// A problem of a readable EEPROM image.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum WarningKind {
    /// The checksum is wrong, so a controller ignores the configuration.
    Checksum {
        /// The checksum in the image.
        found: u8,
        /// The correct checksum.
        right: u8,
    },
    /// The end mark is missing.
    NoEnd,
    /// The end mark comes first: the image contains only the header.
    NoCategories,
    /// A category that must be unique occurs again; the first counts.
    Repeated,
    /// The image ends within the category; this category and later ones are ignored.
    Truncated {
        /// The length in its header, in bytes.
        claimed: usize,
        /// The bytes up to the end of the image.
        left: usize,
    },
    /// The entries of a PDO exceed its category; this PDO and later ones of the category are
    /// ignored.
    Pdo {
        /// The index of the PDO.
        pdo: u16,
        /// The number of entries in its header.
        entries: u8,
    },
    /// The categories end beyond the size of the EEPROM in word 0x3E.
    BeyondSize {
        /// The length of the image up to the end of its categories.
        length: usize,
        /// The size in word 0x3E, in bytes.
        size: usize,
    },
    /// The remaining bytes do not form a whole record.
    LeftOver {
        /// The bytes after the last record.
        bytes: usize,
        /// The length of a record in bytes.
        record: usize,
    },
    /// The category ends before its last text.
    Strings {
        /// The claimed number.
        claimed: u8,
        /// The number found.
        found: usize,
    },
    /// The referenced text does not exist; it reads as empty.
    NoString {
        /// The text number.
        number: u8,
        /// The number of texts.
        strings: usize,
    },
    /// Not a direction and not the mailbox state.
    Fmmu {
        /// The value in the image.
        code: u8,
    },
    /// Not a type of ETG.2010.
    SyncManager {
        /// The value in the image.
        code: u8,
    },
}

impl fmt::Display for SiiWarning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "byte 0x{:x}", self.offset)?;
        if let Some(category) = self.category {
            write!(f, ", category {category}")?;
        }
        f.write_str(": ")?;
        match self.remark {
            WarningKind::Checksum { found, right } => {
                write!(
                    f,
                    "the checksum is 0x{found:02x}, right would be 0x{right:02x}; a controller ignores its configuration"
                )
            }
            WarningKind::NoEnd => f.write_str("the image stops without an end mark"),
            WarningKind::NoCategories => f.write_str("there are no categories, the header is all"),
            WarningKind::Repeated => {
                f.write_str("the category is there a second time; the first counts")
            }
            WarningKind::Truncated { claimed, left } => {
                write!(f, "the category claims {claimed} bytes, {left} are left")
            }
            WarningKind::Pdo { pdo, entries } => {
                write!(
                    f,
                    "PDO 0x{pdo:04x} claims {entries} entries, more than the category holds"
                )
            }
            WarningKind::BeyondSize { length, size } => {
                write!(
                    f,
                    "the categories end at byte {length}, the size in word 0x3E is {size} bytes"
                )
            }
            WarningKind::LeftOver { bytes, record } => {
                write!(f, "{bytes} bytes are left over, records have {record}")
            }
            WarningKind::Strings { claimed, found } => {
                write!(f, "the category claims {claimed} texts and holds {found}")
            }
            WarningKind::NoString { number, strings } => {
                write!(f, "text {number} is named, there are {strings}")
            }
            WarningKind::Fmmu { code } => write!(f, "{code} is not a defined use of an FMMU"),
            WarningKind::SyncManager { code } => {
                write!(f, "{code} is not a defined SyncManager type")
            }
        }
    }
}

#[derive(Default)]
pub(super) struct Warnings {
    pub all: Vec<SiiWarning>,
    /// Those about contents that are ignored; also in `all` if there is room.
    pub damage: Vec<SiiWarning>,
}

impl Warnings {
    pub fn add(&mut self, offset: usize, category: Option<u16>, remark: WarningKind) {
        let damage = matches!(
            remark,
            WarningKind::Truncated { .. } | WarningKind::Pdo { .. }
        );
        let warning = SiiWarning {
            offset,
            category,
            remark,
        };
        if damage && self.damage.len() < MOST {
            self.damage.push(warning.clone());
        }
        if self.all.len() < MOST {
            self.all.push(warning);
        }
    }
}

/// The texts that one category references.
pub(super) struct StringRefs<'a> {
    pub table: &'a Table,
    pub here: Category<'a>,
    pub notes: &'a mut Warnings,
}

impl StringRefs<'_> {
    /// Returns the text whose number is at offset `at` of the category.
    pub fn text(&mut self, at: usize) -> String {
        let number = byte(self.here.data, at);
        let strings = self.table.len();
        if usize::from(number) > strings {
            let remark = WarningKind::NoString { number, strings };
            self.notes
                .add(self.here.offset + at, Some(self.here.kind), remark);
        }
        self.table.text(number)
    }
}

pub(super) fn strings_of(here: &Category<'_>, notes: &mut Warnings) -> Table {
    let table = Table::parse(here.data);
    let (claimed, found) = (byte(here.data, 0), table.len());
    if usize::from(claimed) > found {
        notes.add(
            here.offset,
            Some(here.kind),
            WarningKind::Strings { claimed, found },
        );
    }
    table
}

/// True for a category that an image contains at most once (ETG.2010). PDOs may be spread over
/// several categories.
pub(super) fn occurs_once(kind: u16) -> bool {
    matches!(
        kind,
        category::STRINGS
            | category::GENERAL
            | category::FMMU
            | category::SYNC_MANAGER
            | category::FMMU_DETAILS
            | category::SYNC_UNIT
            | category::DC
    )
}

/// Reports incomplete records and invalid codes.
pub(super) fn trailing_bytes(here: &Category<'_>, notes: &mut Warnings) {
    let record = match here.kind {
        category::SYNC_MANAGER | category::TX_PDO | category::RX_PDO => 8,
        category::FMMU_DETAILS => 4,
        category::DC => 24,
        _ => 1,
    };
    let bytes = here.data.len() % record;
    if bytes != 0 {
        let at = here.offset + here.data.len() - bytes;
        notes.add(at, Some(here.kind), WarningKind::LeftOver { bytes, record });
    }
    match here.kind {
        category::FMMU => {
            for (at, &code) in here.data.iter().enumerate() {
                // 0 and 0xff: unused.
                if !matches!(code, 0..=3 | 0xff) {
                    notes.add(
                        here.offset + at,
                        Some(here.kind),
                        WarningKind::Fmmu { code },
                    );
                }
            }
        }
        category::SYNC_MANAGER => {
            for (n, sm) in here.data.chunks_exact(8).enumerate() {
                let code = byte(sm, 7);
                if code > 4 {
                    let at = here.offset + n * 8 + 7;
                    notes.add(at, Some(here.kind), WarningKind::SyncManager { code });
                }
            }
        }
        _ => {}
    }
}
