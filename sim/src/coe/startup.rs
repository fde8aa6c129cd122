//! Start-up downloads that a device accepts whatever its dictionary says.
//!
//! A vendor's InitCmds work on the vendor's device, and so may an `sdo` of a machine file. If the
//! dictionary of the ESI lacks their object or contradicts them, the dictionary is wrong.

use ecaxis_esi::model::{Access, Device, InitCmd, Module, Writable};

use super::object_dictionary::ObjectStore;
use super::pdo::PdoRules;

/// A download that a device accepts.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StartupWrite {
    /// The index.
    pub index: u16,
    /// The subindex.
    pub sub: u8,
    /// True if all subindices are written at once, from `sub` on.
    pub complete_access: bool,
    /// The value.
    pub data: Vec<u8>,
}

impl From<&InitCmd> for StartupWrite {
    fn from(cmd: &InitCmd) -> Self {
        Self {
            index: cmd.index,
            sub: cmd.sub,
            complete_access: cmd.complete_access,
            data: cmd.data.clone(),
        }
    }
}

/// The start-up downloads of one device.
#[derive(Debug, Clone, Default)]
pub(crate) struct StartupWrites {
    all: Vec<StartupWrite>,
}

impl StartupWrites {
    /// Returns the InitCmds of a device and of its modules at their places, and `more`.
    pub(crate) fn new<'a>(
        device: &Device,
        modules: impl Iterator<Item = &'a Module>,
        more: Vec<StartupWrite>,
    ) -> Self {
        let mailbox = device.mailbox.as_ref();
        let coe = mailbox.and_then(|mailbox| mailbox.coe.as_ref());
        let own = coe.into_iter().flat_map(|coe| &coe.init_cmds);
        let commands = own.chain(modules.flat_map(|module| &module.init_cmds));
        let mut all = more;
        for write in commands.map(StartupWrite::from) {
            if !all.contains(&write) {
                all.push(write);
            }
        }
        Self { all }
    }

    /// Creates the missing objects. Excludes the lists of PDOs and modules, which stay checked.
    pub(crate) fn prepare(&mut self, store: &mut ObjectStore, pdo: &PdoRules) {
        self.all.retain(|write| !pdo.is_list(write.index));
        let access = Access {
            read: true,
            write: Writable::Always,
        };
        for write in &self.all {
            let StartupWrite { index, sub, .. } = *write;
            let bits = |len: usize| u32::try_from(len * 8).unwrap_or(u32::MAX);
            if !write.complete_access {
                store.ensure(index, sub, "", bits(write.data.len()), access, &[]);
            } else if !store.has_object(index) {
                // What follows subindex 0 has an unknown structure.
                let header = if sub == 0 { 2 } else { 0 };
                let rest = write.data.len().saturating_sub(header);
                store.ensure(index, 0, "", 8, access, &[]);
                store.ensure(index, 1, "", bits(rest), access, &[]);
            }
        }
    }

    fn of(&self, index: u16, sub: u8, complete: bool) -> impl Iterator<Item = &StartupWrite> {
        let all = self.all.iter();
        all.filter(move |w| (w.index, w.sub, w.complete_access) == (index, sub, complete))
    }

    /// Returns the bytes of the longest download to this object; `None` without one.
    pub(crate) fn capacity(&self, index: u16, sub: u8, complete: bool) -> Option<usize> {
        let all = self.of(index, sub, complete);
        all.map(|write| write.data.len()).max()
    }

    /// True if this is one of the downloads.
    pub(crate) fn contains(&self, index: u16, sub: u8, complete: bool, data: &[u8]) -> bool {
        self.of(index, sub, complete)
            .any(|write| write.data == data)
    }
}
