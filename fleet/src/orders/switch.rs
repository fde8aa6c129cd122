//! Takes bundles, and goes back to the previous one.

use std::io;
use std::path::Path;
use std::thread;
use std::time::Duration;

use ecaxis_client::Machine;
use serde_json::json;

use super::bundle;
use super::digest::FileDigest;
use super::executor::{Ended, OrderExecutor};
use super::manifest::{FileRef, MAX_MANIFEST, Manifest};
use super::program;
use super::server;
use super::signing::Right;
use super::slots::{Switch, Unpacked};
use crate::error::{Error, Result};

const COMPARE: Duration = Duration::from_secs(120);
const RESTART: Duration = Duration::from_secs(120);
/// The time between two tries to go back.
const RETRY: Duration = Duration::from_secs(2);

/// Who orders a switch.
#[derive(Debug)]
pub(super) struct SwitchOrder<'a> {
    pub sender: &'a str,
    pub nonce: &'a str,
    /// The sender says that no server of this machine runs.
    pub no_server: bool,
}

impl OrderExecutor {
    pub(super) fn push(
        &self,
        file: FileRef,
        signature: &str,
        order: &SwitchOrder<'_>,
        progress: &mut dyn FnMut(String),
    ) -> std::result::Result<String, Ended> {
        if self.table.restart.is_empty() {
            let what = "`restart` of `[orders]` is missing in the file of the agent";
            return Err(Error::new(what).into());
        }
        if file.size > MAX_MANIFEST {
            return Err(Error::new("the manifest of the bundle is too long").into());
        }
        let text = self.fetch(file, progress)?;
        let key = self.keys.verify("the bundle", &text, signature)?;
        key.require(Right::Bundle)?;
        let manifest = Manifest::parse(&text)?;
        if manifest.machine != self.machine {
            let (for_, here) = (&manifest.machine, &self.machine);
            return Err(Error::new(format!("the bundle is for {for_}, not for {here}")).into());
        }
        let current = self.table.folder.join("current");
        let expected = current.join(manifest.machine_file.as_path());
        if expected != self.table.machine_file {
            return Err(Error::new(format!(
                "the machine file of the bundle is `{}`, the server uses {}",
                manifest.machine_file,
                self.table.machine_file.display()
            ))
            .into());
        }
        if self.slots.current() == Some(file.sha256) {
            return Ok("this bundle is the current one".to_owned());
        }
        let listed = manifest.files.iter().map(|listed| listed.sha256);
        self.discard(listed.chain([file.sha256]));
        let contents = manifest.files.iter();
        let contents = contents.map(|file| self.fetch(file.content(), progress));
        let contents = contents.collect::<Result<Vec<_>>>()?;
        let unpacked = Unpacked {
            id: file.sha256,
            text,
            signature: signature.to_owned(),
            manifest,
        };
        let taken = match self.slots.unpack(&unpacked, &contents) {
            Ok(_) => self.take(&unpacked, order, progress),
            Err(error) => Err(error.into()),
        };
        self.discard([]);
        taken
    }

    pub(super) fn back(
        &self,
        order: &SwitchOrder<'_>,
        progress: &mut dyn FnMut(String),
    ) -> std::result::Result<String, Ended> {
        let Some(previous) = self.slots.previous() else {
            return Err(Error::new("there is no previous bundle").into());
        };
        let unpacked = self.slots.unpacked(previous)?;
        let taken = self.take(&unpacked, order, progress);
        self.discard([]);
        taken
    }

    /// Checks an unpacked bundle and makes it the current one.
    fn take(
        &self,
        unpacked: &Unpacked,
        order: &SwitchOrder<'_>,
        progress: &mut dyn FnMut(String),
    ) -> std::result::Result<String, Ended> {
        let folder = self.slots.path(unpacked.id);
        let machine_file = folder.join(unpacked.manifest.machine_file.as_path());
        progress("check".to_owned());
        let checked = bundle::check(&self.table.ecaxis, &machine_file)?;
        if checked.sha256 != unpacked.manifest.machine_sha256 {
            return Err(Error::new("the files are not those of the manifest").into());
        }
        let expected = self.digest()?;
        let machine = self.without_power(order.sender)?;
        match &machine {
            Some(machine) => self.require_own(machine, expected)?,
            None if order.no_server => {}
            None => {
                let what = format!("no server answers at {}", self.socket.display());
                let help = "compare `socket` in the file of the agent with that of the server; if \
                            no server of this machine runs, push with --no-server";
                return Err(Error::new(what).help(help).into());
            }
        }
        let mut keep = || {
            let held = machine.as_ref().map_or(Ok(()), |machine| machine.keep());
            held.map_err(server::text)
        };
        if self.table.compare {
            progress("compare with the bus".to_owned());
            let down = machine.as_ref().map(server::bus_down).transpose();
            let down = down.map_err(Ended::Failed)?;
            let compared = self.compare(&machine_file, &mut keep).and_then(|()| {
                let machine = machine.as_ref();
                machine.map_or(Ok(()), server::take_disabled)
            });
            if let (Err(_), Some(machine), Some(true)) = (&compared, &machine, down) {
                server::bus_up(machine)?;
            }
            compared?;
        }
        let switch = Switch {
            to: unpacked.id,
            current: self.slots.current(),
            previous: self.slots.previous(),
            sender: order.sender.to_owned(),
            nonce: Some(order.nonce.to_owned()),
        };
        let switched = self.slots.switch(&switch).and_then(|()| {
            // The disk may have taken longer than the lease.
            machine.as_ref().map_or(Ok(()), server::take_disabled)
        });
        progress("restart".to_owned());
        // The restart ends the connection, and with it the lease.
        if let Err(error) = switched.and_then(|()| self.restart(machine.as_ref())) {
            drop(machine);
            return self.undo(&switch, error, progress);
        }
        drop(machine);
        self.finish(&switch, progress)
    }

    fn compare(&self, machine_file: &Path, tick: &mut dyn FnMut() -> Result<()>) -> Result<()> {
        let file = machine_file.display().to_string();
        let words = [self.table.ecaxis.as_str(), "compare", &file].map(str::to_owned);
        let output = program::run(&words, COMPARE, tick)?;
        if output.ok {
            return Ok(());
        }
        let differences = output
            .stdout
            .trim()
            .lines()
            .take(3)
            .collect::<Vec<_>>()
            .join("; ");
        let reason = output.reason();
        let reason = reason.lines().next().unwrap_or_default();
        Err(Error::new(format!(
            "`ecaxis compare` refuses it: {reason}; {differences}"
        )))
    }

    /// Runs the restart command. No other client gets the lease before the server ends.
    fn restart(&self, machine: Option<&Machine>) -> Result<()> {
        let output = program::run(&self.table.restart, RESTART, &mut || {
            let _ = machine.map(Machine::keep);
            Ok(())
        })?;
        if output.ok {
            return Ok(());
        }
        Err(Error::new(format!(
            "the restart failed: {}",
            output.reason()
        )))
    }

    /// Waits for the health of a switched machine; else goes back.
    pub(super) fn finish(
        &self,
        switch: &Switch,
        progress: &mut dyn FnMut(String),
    ) -> std::result::Result<String, Ended> {
        progress("wait until the machine is healthy".to_owned());
        let healthy = self.slots.unpacked(switch.to).and_then(|unpacked| {
            let sha256 = Some(unpacked.manifest.machine_sha256);
            self.await_health(sha256, &switch.sender)
        });
        if let Err(error) = healthy {
            return self.undo(switch, error, progress);
        }
        self.slots.confirm().map_err(Ended::Failed)?;
        Ok(format!("the machine runs the bundle {}", switch.to))
    }

    fn await_health(&self, sha256: Option<FileDigest>, sender: &str) -> Result<()> {
        let timeout = self.health_timeout();
        server::await_health(&mut None, &self.socket, sender, sha256, timeout)
    }

    /// Waits until no axis has power, and goes back. The switch is pending until then.
    fn undo(
        &self,
        switch: &Switch,
        error: Error,
        progress: &mut dyn FnMut(String),
    ) -> std::result::Result<String, Ended> {
        let what = error.to_string();
        let what = what.split("\nhelp:").next().unwrap_or_default().to_owned();
        let failed = |then: &str| Ended::Failed(Error::new(format!("{what}; {then}")));
        let mut machine = self.await_without_power(switch, progress);
        if let Err(error) = self.slots.undo(switch) {
            return Err(failed(&format!("the return failed as well: {error}")));
        }
        // The disk may have taken longer than the lease.
        if let Some(lost) = machine.take_if(|machine| server::take_disabled(machine).is_err()) {
            drop(lost);
            machine = self.await_without_power(switch, progress);
        }
        let returned = self
            .restart(machine.as_ref())
            .and_then(|()| match switch.current {
                Some(current) => {
                    let sha256 = self.slots.unpacked(current)?.manifest.machine_sha256;
                    self.await_health(Some(sha256), &switch.sender)
                }
                None => Ok(()),
            });
        drop(machine);
        if let Err(error) = self.slots.confirm() {
            return Err(failed(&error.to_string()));
        }
        if switch.current.is_none() {
            return Err(failed("no bundle is current, as before"));
        }
        match returned {
            Ok(()) => Err(failed("the machine is back at its previous bundle")),
            Err(error) => Err(failed(&format!(
                "the previous bundle is current again, but it does not run: {error}"
            ))),
        }
    }
}

impl OrderExecutor {
    /// Returns the digest of the machine file that the server uses; `None` before the first bundle.
    pub(super) fn digest(&self) -> Result<Option<FileDigest>> {
        if let Some(current) = self.slots.current() {
            return Ok(Some(self.slots.unpacked(current)?.manifest.machine_sha256));
        }
        let file = &self.table.machine_file;
        let exists = file.exists();
        exists
            .then(|| bundle::check(&self.table.ecaxis, file).map(|checked| checked.sha256))
            .transpose()
    }

    /// Requires that the server is that of this machine: a wrong `socket` is that of another.
    pub(super) fn require_own(&self, machine: &Machine, digest: Option<FileDigest>) -> Result<()> {
        let described = machine.request("machine", json!({}));
        let described = described.map_err(server::text)?;
        if digest.is_some_and(|digest| described["sha256"] == json!(digest)) {
            return Ok(());
        }
        let (socket, file) = (self.socket.display(), self.table.machine_file.display());
        let what = format!("the server at {socket} does not run {file}");
        Err(Error::new(what).help(
            "compare `socket` in the file of the agent with that of the server; restart the server \
             if its files were changed",
        ))
    }

    /// Waits until no axis has power. Returns the connection with the lease, if there is a server.
    fn await_without_power(
        &self,
        switch: &Switch,
        progress: &mut dyn FnMut(String),
    ) -> Option<Machine> {
        loop {
            match self.without_power(&switch.sender) {
                Ok(machine) => return machine,
                Err(error) => {
                    let error = error.to_string();
                    let why = error.lines().next().unwrap_or_default();
                    tracing::warn!("the return waits: {why}");
                    progress(format!("the return waits: {why}"));
                }
            }
            thread::sleep(RETRY);
        }
    }

    /// Takes the lease and requires disabled axes; `None` if there is no server.
    fn without_power(&self, sender: &str) -> Result<Option<Machine>> {
        match server::connect(&self.socket, sender) {
            Ok(machine) => server::take_disabled(&machine).map(|()| Some(machine)),
            Err(_) if is_absent(&self.socket) => Ok(None),
            Err(error) => Err(server::text(error)),
        }
    }
}

/// True if no process listens on the socket.
fn is_absent(socket: &Path) -> bool {
    match std::os::unix::net::UnixStream::connect(socket) {
        Ok(_) => false,
        Err(error) => matches!(
            error.kind(),
            io::ErrorKind::NotFound | io::ErrorKind::ConnectionRefused
        ),
    }
}
