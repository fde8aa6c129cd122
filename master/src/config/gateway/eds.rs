//! The EDS of a node (CiA 306-1): the objects that a PDO can carry, and the contents of its PDOs at
//! delivery.

use std::collections::BTreeMap;
use std::path::Path;

use configparser::ini::{Ini, IniDefault};
use ecaxis_esi as esi;
use ecaxis_sim::gateway::PdoLink;

use crate::file::{self, unreadable};
use crate::signature::{SignedKind, VerifiedFiles};

const MAX_BYTES: u64 = 4 << 20;
/// The most objects in a PDO (CiA 301).
const MAX_MAPPED: u32 = 64;

/// A parsed EDS.
#[derive(Debug)]
pub(super) struct Eds {
    /// The sections by their names in lower case: `1a00sub1`.
    sections: BTreeMap<String, BTreeMap<String, Option<String>>>,
}

impl Eds {
    /// Reads a file that a machine file names. An error is a message with a hint.
    pub(super) fn read(
        path: &Path,
        files: &mut VerifiedFiles<'_>,
    ) -> Result<Self, (String, String)> {
        let text = file::read_text(path, MAX_BYTES).map_err(|error| {
            let hint = "paths are relative to the machine file";
            (unreadable(path, &error), hint.to_owned())
        })?;
        files
            .add(SignedKind::Esi, path, text.as_bytes())
            .map_err(|error| (error.to_string(), error.hint().to_owned()))?;
        Self::parse(&text).map_err(|error| {
            let hint = "the vendor of the drive has its EDS file (CiA 306-1)";
            (format!("{}: {error}", path.display()), hint.to_owned())
        })
    }

    pub(super) fn parse(text: &str) -> Result<Self, String> {
        let mut defaults = IniDefault::default();
        defaults.delimiters = vec!['='];
        defaults.comment_symbols = vec![';'];
        defaults.inline_comment_symbols = Some(Vec::new());
        let mut ini = Ini::new_from_defaults(defaults);
        let sections = ini.read(text.to_owned())?.into_iter();
        let sections = sections.map(|(name, keys)| (name, keys.into_iter().collect()));
        let eds = Self {
            sections: sections.collect(),
        };
        match eds.number("deviceinfo", "vendornumber") {
            Some(_) => Ok(eds),
            None => Err("[DeviceInfo] has no VendorNumber: the file is not an EDS".to_owned()),
        }
    }

    fn text(&self, section: &str, key: &str) -> Option<&str> {
        self.sections.get(section)?.get(key)?.as_deref()
    }

    /// Returns a number in decimal or hexadecimal digits.
    fn number(&self, section: &str, key: &str) -> Option<u32> {
        let text = self.text(section, key)?.trim();
        let digits = text.strip_prefix("0x").or_else(|| text.strip_prefix("0X"));
        match digits {
            Some(digits) => u32::from_str_radix(digits, 16).ok(),
            None => text.parse().ok(),
        }
    }

    /// Returns the section of an object. A variable has none for subindex 0.
    fn section(&self, index: u16, sub: u8) -> Option<String> {
        let with_sub = format!("{index:x}sub{sub:x}");
        let plain = format!("{index:x}");
        let known = |name: &String| self.sections.contains_key(name);
        let plain = Some(plain).filter(|name| sub == 0 && known(name));
        Some(with_sub).filter(known).or(plain)
    }

    /// Returns the contents of a PDO at delivery; `None` if the EDS does not have the PDO.
    fn contents(&self, pdo: u16) -> Option<Vec<(u16, u8, u8)>> {
        let value = |sub| self.number(&self.section(pdo, sub)?, "defaultvalue");
        let count = value(0)?.min(MAX_MAPPED);
        let entries = (1..=count).map(|sub| {
            let [bits, sub, low, high] = value(u8::try_from(sub).ok()?)?.to_le_bytes();
            Some((u16::from_le_bytes([low, high]), sub, bits))
        });
        entries.collect()
    }

    /// Fills in the contents of PDO 1 or 2 that the machine file leaves to the drive, and checks
    /// them all. `first`: the mapping object of PDO 1.
    pub(super) fn complete(&self, link: &mut PdoLink, first: u16) -> Result<(), String> {
        let pdo = first.saturating_add(u16::from(link.pdo)).saturating_sub(1);
        let own = self.contents(pdo);
        if link.contents.is_empty() && link.pdo < 3 {
            link.contents = own.unwrap_or_default();
        } else if let (true, Some(own)) = (link.contents.is_empty(), own)
            && let Some(&(index, sub, _)) = own.get(2)
        {
            let object = esi::address(index, sub);
            return Err(format!("its PDO {} carries {object} as well", link.pdo));
        }
        for &(index, sub, _) in &link.contents {
            let section = self.section(index, sub);
            let mappable = section.map(|section| self.number(&section, "pdomapping"));
            let object = esi::address(index, sub);
            match mappable {
                None => return Err(format!("it has no object {object}")),
                Some(None | Some(0)) => return Err(format!("its PDOs cannot carry {object}")),
                Some(Some(_)) => {}
            }
        }
        Ok(())
    }
}

#[cfg(test)]
#[path = "eds_tests.rs"]
mod tests;
