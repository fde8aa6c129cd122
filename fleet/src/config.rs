//! The files of the programs: TOML, with Zenoh's own configuration in the table `zenoh`.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::de::{DeserializeOwned, Error as _};
use serde::{Deserialize, Deserializer};
use serde_json::{Map, Value, json};

use crate::error::{Error, Result};
use crate::keys::{MachineId, Name};
use crate::orders::executor::OrdersTable;
use crate::orders::signing::KeyTable;

/// The longest file.
const MAX_FILE: u64 = 1 << 20;
/// The silence after which the other side of a link counts as gone, in ms. A machine without power
/// vanishes after this time.
const LEASE_MS: u32 = 1500;
/// The sessions of a router.
const MAX_SESSIONS: u32 = 8192;
/// The time in which a command finds a router, in ms.
const CONNECT_MS: u32 = 5000;

/// The mode of a Zenoh session, and how it connects.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Role {
    /// It connects again and again until it is ended.
    Service,
    /// A service that forwards.
    Router,
    /// It fails if nothing answers soon.
    Command,
}

/// The file of an agent.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AgentFile {
    /// The hall or plant.
    pub site: Name,
    /// The name of the machine.
    pub machine: Name,
    /// The control socket of `ecaxis serve`.
    pub socket: PathBuf,
    /// The folder that keeps the fault reports.
    pub spool: PathBuf,
    /// The address of the machine's own page.
    pub page: Option<String>,
    /// How orders are executed. Without it, the agent only reads.
    pub orders: Option<OrdersTable>,
    /// The keys whose orders are executed.
    #[serde(default)]
    pub key: Vec<KeyTable>,
    /// The axes whose set-points are published, for the line shafts of other machines.
    #[serde(default)]
    pub setpoints: BTreeSet<Name>,
    /// The time between two set-points of an axis, 1 to 1000 ms.
    #[serde(default = "setpoints_interval_ms")]
    pub setpoints_interval_ms: u64,
    /// The line shafts of this machine.
    #[serde(default)]
    pub line_shaft: Vec<LineShaftTable>,
    /// The configuration of Zenoh.
    #[serde(default)]
    pub zenoh: toml::Table,
}

/// `[[line_shaft]]` of an agent's file.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LineShaftTable {
    /// Its name in the machine file.
    pub name: String,
    /// The machine that leads: `SITE/MACHINE`.
    #[serde(deserialize_with = "machine_id")]
    pub from: MachineId,
    /// Its axis.
    pub axis: Name,
}

fn machine_id<'de, D: Deserializer<'de>>(
    deserializer: D,
) -> std::result::Result<MachineId, D::Error> {
    String::deserialize(deserializer)?
        .parse()
        .map_err(D::Error::custom)
}

fn setpoints_interval_ms() -> u64 {
    5
}

impl AgentFile {
    /// Returns the time between two set-points.
    ///
    /// # Errors
    /// Fails if it is out of its range.
    pub fn setpoints_interval(&self) -> Result<Duration> {
        let ms = self.setpoints_interval_ms;
        let range = "`setpoints_interval_ms` must be 1 to 1000";
        let given = (1..=1000).contains(&ms).then(|| Duration::from_millis(ms));
        given.ok_or_else(|| Error::new(format!("{range}, not {ms}")))
    }

    /// Checks that each line shaft has one leader.
    ///
    /// # Errors
    /// Fails with the name of two tables.
    pub fn check_line_shafts(&self) -> Result<()> {
        let names = self.line_shaft.iter().map(|table| &table.name);
        let mut known = BTreeSet::new();
        let twice = { names }.find(|name| !known.insert(*name));
        twice.map_or(Ok(()), |name| {
            let what = format!("two [[line_shaft]] have the name `{name}`");
            Err(Error::new(what).help("give each shaft one leader"))
        })
    }

    /// Returns the machine of the agent.
    #[must_use]
    pub fn id(&self) -> MachineId {
        MachineId {
            site: self.site.clone(),
            machine: self.machine.clone(),
        }
    }
}

/// The file of an archive.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ArchiveFile {
    /// The folder of the history.
    pub folder: PathBuf,
    /// The fault reports that are kept of each machine.
    #[serde(default = "max_reports")]
    pub max_reports: usize,
    /// The time between two queries of all machines, in s.
    #[serde(default = "query_interval_s")]
    pub query_interval_s: f64,
    /// The configuration of Zenoh.
    #[serde(default)]
    pub zenoh: toml::Table,
}

fn max_reports() -> usize {
    10_000
}

fn query_interval_s() -> f64 {
    60.0
}

/// The file of a router, or of the commands.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ZenohFile {
    /// The configuration of Zenoh.
    #[serde(default)]
    pub zenoh: toml::Table,
}

/// Reads a file.
///
/// # Errors
/// Fails if the file cannot be read, or with the line of the mistake.
pub fn read<T: DeserializeOwned>(path: &Path) -> Result<T> {
    let at = |what: String| Error::new(format!("{}: {what}", path.display()));
    let size = fs::metadata(path).map_err(|e| at(e.to_string()))?.len();
    if size > MAX_FILE {
        return Err(at(format!("the file is longer than {MAX_FILE} bytes")));
    }
    let text = fs::read_to_string(path).map_err(|e| at(e.to_string()))?;
    toml::from_str(&text).map_err(|error| {
        let line = error.span().map_or(0, |span| {
            text[..span.start.min(text.len())].matches('\n').count() + 1
        });
        at(format!("line {line}: {}", error.message()))
            .help("docs/fleet.md describes the keys; `configs/fleet` has samples")
    })
}

/// Returns a path of a file relative to the folder of that file.
#[must_use]
pub fn resolve(file: &Path, path: &Path) -> PathBuf {
    file.parent().unwrap_or(Path::new("")).join(path)
}

/// Returns the configuration of Zenoh: the table of a file over the defaults of a fleet.
///
/// # Errors
/// Fails if Zenoh does not know a key.
pub fn zenoh(table: &toml::Table, file: &Path, role: Role) -> Result<zenoh::Config> {
    let mistake = |what: String| {
        Error::new(format!("{}: table `zenoh`: {what}", file.display()))
            .help("the keys are those of Zenoh's DEFAULT_CONFIG.json5")
    };
    let given = serde_json::to_value(table).map_err(|e| mistake(e.to_string()))?;
    let connects = given
        .pointer("/connect/endpoints")
        .is_some_and(|endpoints| *endpoints != json!([]));
    let mut config = json!({
        "mode": if role == Role::Router { "router" } else if connects { "client" } else { "peer" },
        "connect": {
            "timeout_ms": if role == Role::Command { i64::from(CONNECT_MS) } else { -1 },
            "exit_on_failure": role == Role::Command,
        },
        // Who names the other side does not want to find more of them.
        "scouting": {"multicast": {"enabled": role != Role::Router && !connects}},
        "transport": {
            "unicast": {"max_sessions": MAX_SESSIONS},
            "link": {"tx": {"lease": LEASE_MS, "keep_alive": 4}},
        },
    });
    merge(&mut config, given);
    if role == Role::Router && config["mode"] != "router" {
        return Err(mistake("`mode` of a router is \"router\"".to_owned()));
    }
    if let Some(Value::Object(tls)) = config.pointer_mut("/transport/link/tls") {
        resolve_certificates(tls, file);
    }
    zenoh::Config::from_json5(&config.to_string()).map_err(|error| {
        let text = error.to_string();
        // Zenoh appends the whole configuration.
        let first = text.split(['{', '\n']).next().unwrap_or_default();
        mistake(first.chars().take(200).collect())
    })
}

/// Makes the files of TLS relative to the file that names them.
fn resolve_certificates(tls: &mut Map<String, Value>, file: &Path) {
    for (key, value) in tls {
        if !key.ends_with("_certificate") && !key.ends_with("_private_key") {
            continue;
        }
        if let Some(path) = value.as_str() {
            *value = json!(resolve(file, Path::new(path)));
        }
    }
}

/// Replaces what `over` has, table by table.
fn merge(under: &mut Value, over: Value) {
    match (under, over) {
        (Value::Object(under), Value::Object(over)) => {
            for (key, value) in over {
                merge(under.entry(key).or_insert(Value::Null), value);
            }
        }
        (under, over) => *under = over,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn config(text: &str, role: Role) -> Result<zenoh::Config> {
        let table = toml::from_str(text).unwrap();
        zenoh(&table, Path::new("/etc/ecaxis/agent.toml"), role)
    }

    #[test]
    fn a_file_changes_the_defaults() {
        let text = "connect.endpoints = [\"tcp/router:7447\"]\ntransport.link.tx.lease = 900";
        let config = config(text, Role::Service).unwrap();
        assert_eq!(config.get_json("mode").unwrap(), "\"client\"");
        assert_eq!(config.get_json("transport/link/tx/lease").unwrap(), "900");
        assert_eq!(
            config.get_json("scouting/multicast/enabled").unwrap(),
            "false"
        );
        let connect = config.get_json("connect/endpoints").unwrap();
        assert!(connect.contains("router:7447"), "{connect}");
    }

    #[test]
    fn certificates_are_relative_to_the_file() {
        let text = "transport.link.tls = { root_ca_certificate = \"ca.pem\", enable_mtls = true }";
        let config = config(text, Role::Router).unwrap();
        let path = config
            .get_json("transport/link/tls/root_ca_certificate")
            .unwrap();
        assert_eq!(path, "\"/etc/ecaxis/ca.pem\"");
    }

    #[test]
    fn unknown_keys_are_refused() {
        let error = config("conect.endpoints = []", Role::Service).unwrap_err();
        assert!(
            error.to_string().contains("agent.toml: table `zenoh`"),
            "{error}"
        );
        assert!(config("mode = \"peer\"", Role::Router).is_err());
        for (text, good) in [
            ("from = \"a/b\"\naxis = \"x\"", true),
            ("from = \"b\"\naxis = \"x\"", false),
            ("from = \"a/b\"\naxis = \"*\"", false),
        ] {
            let table = toml::from_str::<LineShaftTable>(&format!("name = \"shaft\"\n{text}"));
            assert_eq!(table.is_ok(), good, "{text}");
        }
        assert!(toml::from_str::<AgentFile>("site = \"a\"\nmachin = \"b\"").is_err());
    }
}
