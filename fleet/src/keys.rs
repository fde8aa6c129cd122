//! The key expressions of a fleet: `ecaxis/SITE/MACHINE/…`.

use std::fmt;

use serde::{Deserialize, Serialize};

/// The first chunk of every key.
const PREFIX: &str = "ecaxis";
/// The longest name.
const MAX_NAME: usize = 64;

/// All liveliness tokens.
pub const ALL_ALIVE: &str = "ecaxis/*/*/alive";
/// All states.
pub const ALL_STATES: &str = "ecaxis/*/*/state";
/// All lists of fault reports.
pub const ALL_REPORTS: &str = "ecaxis/*/*/reports";
/// All fault reports, as they are announced.
pub const EACH_REPORT: &str = "ecaxis/*/*/report/*";
/// All events.
pub const EACH_EVENT: &str = "ecaxis/*/*/event/*";

/// The name of a site or a machine: `[A-Za-z0-9_-]{1,64}`.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(try_from = "String")]
pub struct Name(String);

impl TryFrom<String> for Name {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        let allowed = |byte: u8| byte.is_ascii_alphanumeric() || matches!(byte, b'_' | b'-');
        if text.is_empty() || text.len() > MAX_NAME || !text.bytes().all(allowed) {
            return Err(format!(
                "`{}` is not a name: 1 to {MAX_NAME} letters, digits, `_` and `-`",
                text.chars()
                    .take(MAX_NAME)
                    .collect::<String>()
                    .escape_debug()
            ));
        }
        Ok(Self(text))
    }
}

impl fmt::Display for Name {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(&self.0)
    }
}

/// A machine of the fleet.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
pub struct MachineId {
    /// The hall or plant.
    pub site: Name,
    /// Its name there.
    pub machine: Name,
}

impl MachineId {
    /// Returns the key of something of this machine, such as `state`.
    #[must_use]
    pub fn key(&self, suffix: &str) -> String {
        format!("{PREFIX}/{}/{}/{suffix}", self.site, self.machine)
    }

    /// Returns the machine of a key and what follows; `None` for other keys.
    #[must_use]
    pub fn of_key(key: &str) -> Option<(Self, &str)> {
        let mut parts = key.splitn(4, '/');
        let (prefix, site, machine, suffix) =
            (parts.next()?, parts.next()?, parts.next()?, parts.next()?);
        let name = |text: &str| Name::try_from(text.to_owned()).ok();
        let (site, machine) = (name(site)?, name(machine)?);
        (prefix == PREFIX).then_some((Self { site, machine }, suffix))
    }
}

impl fmt::Display for MachineId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(&format!("{}/{}", self.site, self.machine))
    }
}

impl std::str::FromStr for MachineId {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (site, machine) = text.split_once('/').ok_or("write SITE/MACHINE")?;
        Ok(Self {
            site: site.to_owned().try_into()?,
            machine: machine.to_owned().try_into()?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_names_its_machine() {
        let id: MachineId = "hall-1/press_3".parse().unwrap();
        assert_eq!(id.key("report/ab"), "ecaxis/hall-1/press_3/report/ab");
        let (again, rest) = MachineId::of_key("ecaxis/hall-1/press_3/report/ab").unwrap();
        assert_eq!((again, rest), (id, "report/ab"));
    }

    #[test]
    fn other_keys_and_names_are_refused() {
        for key in [
            "",
            "ecaxis",
            "ecaxis/a/b",
            "other/a/b/state",
            "ecaxis//b/state",
        ] {
            assert_eq!(MachineId::of_key(key), None, "{key}");
        }
        let long = "a".repeat(65);
        for name in ["", "a b", "..", "a/b", "ä", "*", &long] {
            assert!(Name::try_from(name.to_owned()).is_err(), "{name}");
        }
    }
}
