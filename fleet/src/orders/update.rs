//! Writes firmware and parameters to one device.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

use ecaxis_client::Machine;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::digest::FileDigest;
use super::executor::{Ended, OrderExecutor};
use super::files::{self, at};
use super::manifest::{BundlePath, FileRef, MAX_MANIFEST};
use super::program;
use super::server;
use crate::error::{Error, Result};

const INFO: Duration = Duration::from_secs(60);
const UPDATE: Duration = Duration::from_secs(1800);
/// The file that remembers what each device runs.
const RECORDS: &str = "firmware.json";

/// The identity of a device after an update.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct FirmwareRecord {
    sha256: FileDigest,
    identity: Value,
}

/// Returns what changes with the firmware or the device of `ecaxis firmware info --json`.
fn identity(info: &Value) -> Value {
    let keys = [
        "runs",
        "eeprom",
        "identity",
        "software_version",
        "software_identification",
    ];
    let values = keys
        .iter()
        .map(|key| ((*key).to_owned(), info[*key].clone()));
    Value::Object(values.collect())
}

impl OrderExecutor {
    pub(super) fn update_firmware(
        &self,
        device: &str,
        name: &BundlePath,
        file: FileRef,
        signature: Option<&str>,
        sender: &str,
        progress: &mut dyn FnMut(String),
    ) -> std::result::Result<String, Ended> {
        check_device(device)?;
        let path = self.place(name, file, signature, progress)?;
        let digest = self.digest()?;
        let record = |info: &Value| FirmwareRecord {
            sha256: file.sha256,
            identity: identity(info),
        };
        let machine = server::connect(&self.socket, sender).map_err(server::text)?;
        server::take_disabled(&machine)?;
        self.require_own(&machine, digest)?;
        let was_up = server::bus_down(&machine).map_err(Ended::Failed)?;
        progress("read the version".to_owned());
        let known = self.records().map_err(Ended::Failed)?.remove(device);
        if known.is_some_and(|known| {
            let info = self.firmware_info(&machine, device);
            info.is_ok_and(|info| record(&info) == known)
        }) {
            // A bus that was down waits for the repair of another device.
            if was_up {
                self.restore_bus(machine, device, sender)?;
            }
            return Ok(format!("`{device}` has this firmware already"));
        }
        let held = machine.keep().map_err(server::text);
        held.map_err(|e| failed(device, &e.to_string()))?;
        progress("write".to_owned());
        let words = self.words(
            &["firmware", "update"],
            device,
            &["--yes", "--json"],
            Some(&path),
        );
        let output = program::run(&words, UPDATE, &mut || machine.keep().map_err(server::text));
        let output = output.map_err(|e| failed(device, &e.to_string()))?;
        if !output.ok {
            return Err(failed(device, &output.reason()));
        }
        let info = self
            .firmware_info(&machine, device)
            .map_err(|e| failed(device, &e.to_string()))?;
        let mut records = self.records().map_err(Ended::Failed)?;
        records.insert(device.to_owned(), record(&info));
        let text = serde_json::to_vec(&records).unwrap_or_default();
        files::write(&self.table.folder.join(RECORDS), &text).map_err(Ended::Failed)?;
        self.restore_bus(machine, device, sender)?;
        let report: Value = serde_json::from_str(&output.stdout).unwrap_or_default();
        let version = |key: &str| {
            let version = report[key]["software_version"].as_str();
            version.unwrap_or("unknown").to_owned()
        };
        let (before, after) = (version("before"), version("after"));
        Ok(format!(
            "`{device}`: software version {before} before, {after} now"
        ))
    }

    pub(super) fn update_parameters(
        &self,
        device: &str,
        name: &BundlePath,
        file: FileRef,
        sender: &str,
        progress: &mut dyn FnMut(String),
    ) -> std::result::Result<String, Ended> {
        check_device(device)?;
        let path = self.place(name, file, None, progress)?;
        let digest = self.digest()?;
        let machine = server::connect(&self.socket, sender).map_err(server::text)?;
        server::take_disabled(&machine)?;
        self.require_own(&machine, digest)?;
        server::bus_down(&machine).map_err(Ended::Failed)?;
        let steps = [
            (
                self.words(&["sdo", "restore"], device, &[], Some(&path)),
                "write",
            ),
            (self.words(&["sdo", "store"], device, &[], None), "store"),
        ];
        for (words, step) in steps {
            progress(step.to_owned());
            let held = machine.keep().map_err(server::text);
            held.map_err(|e| failed(device, &e.to_string()))?;
            let output = program::run(&words, UPDATE, &mut || machine.keep().map_err(server::text));
            let output = output.map_err(|e| failed(device, &e.to_string()))?;
            if !output.ok {
                return Err(failed(device, &format!("{step}: {}", output.reason())));
            }
        }
        self.restore_bus(machine, device, sender)?;
        Ok(format!("`{device}` has the parameters, stored"))
    }

    /// Brings the bus up and waits until the machine is healthy. Otherwise, the bus goes down again
    /// unless another client has enabled an axis.
    fn restore_bus(
        &self,
        machine: Machine,
        device: &str,
        sender: &str,
    ) -> std::result::Result<(), Ended> {
        let taken = machine.take(false).map_err(server::text);
        let up = taken.and_then(|()| server::bus_up(&machine));
        let mut leased = Some(machine);
        let wait = |leased: &mut Option<Machine>| {
            server::await_health(leased, &self.socket, sender, None, self.health_timeout())
        };
        up.and_then(|()| wait(&mut leased)).map_err(|error| {
            let machine = leased.map_or_else(|| server::connect_and_take(&self.socket, sender), Ok);
            let down = machine.and_then(|machine| {
                server::take_disabled(&machine)?;
                server::bus_down(&machine)
            });
            let then = down.map_or_else(|e| format!("; the bus stays up: {e}"), |_| String::new());
            Ended::Failed(Error::new(format!("after `{device}`: {error}{then}")))
        })
    }

    /// Writes a received file where `ecaxis` reads it.
    fn place(
        &self,
        name: &BundlePath,
        file: FileRef,
        signature: Option<&str>,
        progress: &mut dyn FnMut(String),
    ) -> Result<PathBuf> {
        if !name.is_name() {
            return Err(Error::new(format!("`{name}` is not the name of a file")));
        }
        self.discard([file.sha256]);
        let bytes = self.fetch(file, progress)?;
        let folder = self.table.folder.join("update");
        if folder.exists() {
            fs::remove_dir_all(&folder).map_err(at(&folder))?;
        }
        fs::create_dir(&folder).map_err(at(&folder))?;
        let path = folder.join(name.as_path());
        files::write(&path, &bytes)?;
        if let Some(signature) = signature {
            files::write(&super::signature_path(&path), signature.as_bytes())?;
        }
        Ok(path)
    }

    fn records(&self) -> Result<BTreeMap<String, FirmwareRecord>> {
        let path = self.table.folder.join(RECORDS);
        if !path.exists() {
            return Ok(BTreeMap::new());
        }
        let text = files::read(&path, MAX_MANIFEST)?;
        serde_json::from_slice(&text).map_err(|e| Error::new(format!("{}: {e}", path.display())))
    }

    /// Reads identity and versions while the bus is down, and keeps the lease meanwhile.
    fn firmware_info(&self, machine: &Machine, device: &str) -> Result<Value> {
        let words = self.words(&["firmware", "info"], device, &["--json"], None);
        let output = program::run(&words, INFO, &mut || machine.keep().map_err(server::text))?;
        if !output.ok {
            return Err(Error::new(output.reason()));
        }
        serde_json::from_str(&output.stdout)
            .map_err(|e| Error::new(format!("`ecaxis firmware info --json`: {e}")))
    }

    fn words(
        &self,
        verb: &[&str],
        device: &str,
        options: &[&str],
        file: Option<&Path>,
    ) -> Vec<String> {
        let machine_file = self.table.machine_file.display().to_string();
        let mut words = vec![self.table.ecaxis.clone()];
        words.extend(verb.iter().chain(options).map(|word| (*word).to_owned()));
        words.extend(["--".to_owned(), machine_file, device.to_owned()]);
        words.extend(file.map(|file| file.display().to_string()));
        words
    }
}

fn check_device(device: &str) -> Result<()> {
    let bad = |c: char| c.is_control();
    if device.is_empty() || device.len() > 64 || device.contains(bad) {
        return Err(Error::new("the name of the device is not one"));
    }
    Ok(())
}

/// The bus stays down: the server must not disturb the repair.
fn failed(device: &str, why: &str) -> Ended {
    let what = format!("`{device}`: {why}");
    Ended::Failed(Error::new(what).help("repair the device, then send the update again"))
}
