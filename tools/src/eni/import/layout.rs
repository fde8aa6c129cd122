//! The keys of a machine file that give a device the process data of the ENI.

use ecaxis_esi as esi;
use ecaxis_esi::model::{Device, Entry, Pdo, SlotDependence};
use ecaxis_esi::{Direction, EntryRef, Layout, SelectError, SelectOptions, Selection, UserSdo};

use super::super::command::CoeCommand;
use super::super::network::{NetworkDevice, NetworkPdo};
use crate::scan::esi_match::EsiMatch;

/// The most modules that are tried one by one.
const MAX_MODULES: usize = 64;
/// The objects of PDO assignment: 0x1C10 and the number of the SyncManager.
const ASSIGNMENT: u16 = 0x1c10;
const MAX_SYNC_MANAGERS: u16 = 16;
const MODULE_LIST: u16 = 0xf030;

/// The choices of a machine file for one device.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct DeviceKeys {
    pub modules: Option<Vec<String>>,
    pub assignment: Option<String>,
    pub rx: Option<Vec<(u16, u8)>>,
    pub tx: Option<Vec<(u16, u8)>>,
    pub dc: Option<String>,
}

impl DeviceKeys {
    pub fn select(
        &self,
        described: &EsiMatch,
        cycle_ns: u64,
        sdo: &[UserSdo],
    ) -> Result<Selection, SelectError> {
        let names = self.modules.as_ref();
        let modules: Option<Vec<&str>> =
            names.map(|names| names.iter().map(String::as_str).collect());
        let entries = |list: &Option<Vec<(u16, u8)>>| {
            let list = list.as_ref()?.iter();
            let entry = |&(index, sub): &(u16, u8)| EntryRef { index, sub };
            Some(list.map(entry).collect::<Vec<_>>())
        };
        let (rx, tx) = (entries(&self.rx), entries(&self.tx));
        let options = SelectOptions {
            rx: rx.as_deref(),
            tx: tx.as_deref(),
            modules: modules.as_deref(),
            assignment: self.assignment.as_deref(),
            dc_mode: self.dc.as_deref(),
            cycle_ns,
            sdo,
            ..SelectOptions::default()
        };
        esi::select(&described.file, &described.device, &options)
    }
}

/// The process data that the ENI gives a device.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum WantedLayout {
    Objects(Box<Layout>),
    /// Bits out and in: the ENI describes no objects.
    Bits(u32, u32),
    /// The ENI says nothing.
    Unknown,
}

impl WantedLayout {
    pub fn new(network: &NetworkDevice, described: &EsiMatch) -> Self {
        let pdos = match network.pdos.is_empty() {
            true => assigned(network, described),
            false => Some(network.pdos.clone()),
        };
        let laid_out = pdos.and_then(|pdos| {
            let of = |direction| {
                let own = pdos.iter().filter(move |pdo| pdo.direction == direction);
                own.map(pdo).collect::<Vec<_>>()
            };
            Layout::new(&described.device, &of(Direction::Rx), &of(Direction::Tx)).ok()
        });
        let bits = |windows: &[(u32, u32)]| windows.iter().map(|(_, len)| len).sum();
        match laid_out {
            Some(layout) => Self::Objects(Box::new(layout)),
            None if network.outputs.is_empty() && network.inputs.is_empty() => Self::Unknown,
            None => Self::Bits(bits(&network.outputs), bits(&network.inputs)),
        }
    }

    /// Returns true if a selection has this process data.
    pub fn matches(&self, selection: &Selection) -> bool {
        let own = &selection.layout;
        match self {
            Self::Unknown => true,
            Self::Bits(out, inp) => {
                let bytes = |bits: &u32| bits.div_ceil(8) as usize;
                (own.rx_bytes(), own.tx_bytes()) == (bytes(out), bytes(inp))
            }
            Self::Objects(wanted) => same_layout(wanted, own),
        }
    }
}

/// Compares objects, their bits and the bytes.
pub(super) fn same_layout(a: &Layout, b: &Layout) -> bool {
    let places = |fields: &[esi::Field]| {
        let place = |f: &esi::Field| (f.index, f.sub, f.bit_offset, f.bit_len);
        fields.iter().map(place).collect::<Vec<_>>()
    };
    (a.rx_bytes(), a.tx_bytes()) == (b.rx_bytes(), b.tx_bytes())
        && places(&a.rx) == places(&b.rx)
        && places(&a.tx) == places(&b.tx)
}

fn pdo(pdo: &NetworkPdo) -> Pdo {
    let entry = |&(index, sub, bit_len): &(u16, u8, u16)| Entry {
        position: esi::Position::default(),
        index,
        sub,
        bit_len,
        name: esi::Text::default(),
        data_type: esi::Text::default(),
        depends_on: SlotDependence::default(),
    };
    Pdo {
        position: esi::Position::default(),
        direction: pdo.direction,
        index: pdo.index,
        name: String::new(),
        sm: Some(pdo.sm),
        su: None,
        excluded_sm: Vec::new(),
        fixed: false,
        mandatory: false,
        virtual_: false,
        overwritten_by_module: false,
        depends_on: SlotDependence::default(),
        oversampling: None,
        exclude: Vec::new(),
        entries: pdo.entries.iter().map(entry).collect(),
    }
}

/// Returns true if an object belongs to the PDO assignment, to PDO contents or to the modules: other
/// keys than `sdo` set them.
pub(super) fn is_layout_object(index: u16) -> bool {
    matches!(index, 0x1600..=0x17ff | 0x1a00..=0x1bff | MODULE_LIST)
        || (ASSIGNMENT..ASSIGNMENT + MAX_SYNC_MANAGERS).contains(&index)
}

/// Returns the numbers that the SDOs write to the list object `index`, whole or one by one, each of
/// `size` bytes.
fn written_list(sdos: &[&CoeCommand], index: u16, size: usize) -> Option<Vec<u32>> {
    let mut list: Option<Vec<u32>> = None;
    let number = |bytes: &[u8]| {
        let little = bytes.iter().rev();
        little.fold(0_u32, |value, byte| value << 8 | u32::from(*byte))
    };
    for sdo in sdos.iter().filter(|sdo| sdo.index == index) {
        if sdo.complete_access && sdo.sub == 0 {
            let count = usize::from(sdo.data.first().copied().unwrap_or(0));
            let rest = sdo.data.get(2..).unwrap_or_default();
            list = Some(rest.chunks_exact(size).take(count).map(number).collect());
        } else if sdo.sub == 0 {
            let count = usize::from(sdo.data.first().copied().unwrap_or(0));
            list.get_or_insert_default().truncate(count);
        } else if sdo.data.len() == size {
            let list = list.get_or_insert_default();
            let place = usize::from(sdo.sub) - 1;
            list.resize(list.len().max(place + 1), 0);
            if let Some(entry) = list.get_mut(place) {
                *entry = number(&sdo.data);
            }
        }
    }
    list
}

/// Returns the assigned PDOs by the SDOs of the ENI, with contents from the SDOs or from the ESI.
/// `None` if the ENI assigns none, or unknown ones.
fn assigned(network: &NetworkDevice, described: &EsiMatch) -> Option<Vec<NetworkPdo>> {
    let sdos: Vec<_> = network.sdos.iter().map(|(_, sdo)| sdo).collect();
    let device = &described.device;
    let mut pdos = Vec::new();
    let mut any = false;
    for (sm, manager) in (0..MAX_SYNC_MANAGERS).zip(&device.sync_managers) {
        let direction = match manager.usage {
            esi::SmUse::Outputs => Direction::Rx,
            esi::SmUse::Inputs => Direction::Tx,
            _ => continue,
        };
        let Some(list) = written_list(&sdos, ASSIGNMENT + sm, 2) else {
            continue;
        };
        any = true;
        for index in list {
            let index = u16::try_from(index).ok()?;
            let entries = match written_list(&sdos, index, 4) {
                Some(entries) => entries.into_iter().map(unpacked).collect(),
                None => contents(device, &described.file.modules, index)?,
            };
            pdos.push(NetworkPdo {
                direction,
                index,
                sm: u8::try_from(sm).ok()?,
                entries,
            });
        }
    }
    any.then_some(pdos)
}

fn unpacked(mapping: u32) -> (u16, u8, u16) {
    let [bits, sub, i0, i1] = mapping.to_le_bytes();
    (u16::from_le_bytes([i0, i1]), sub, bits.into())
}

fn contents(device: &Device, modules: &[esi::Module], index: u16) -> Option<Vec<(u16, u8, u16)>> {
    let of_modules = modules
        .iter()
        .flat_map(|m| m.rx_pdos.iter().chain(&m.tx_pdos));
    let mut all = device
        .rx_pdos
        .iter()
        .chain(&device.tx_pdos)
        .chain(of_modules);
    let pdo = all.find(|pdo| pdo.index == index)?;
    let entries = pdo.entries.iter();
    Some(entries.map(|e| (e.index, e.sub, e.bit_len)).collect())
}

/// Returns the keys that give the process data of the ENI, or those that come first without an
/// error, and false.
pub(super) fn find(
    network: &NetworkDevice,
    described: &EsiMatch,
    dc: Option<&String>,
    cycle_ns: u64,
) -> (Option<DeviceKeys>, bool) {
    let wanted = WantedLayout::new(network, described);
    let own = |direction| own_entries(&wanted, direction);
    let (rx, tx) = (own(Direction::Rx), own(Direction::Tx));
    let mut first = None;
    let assignments = described.device.sm_mappings.iter();
    let assignments: Vec<_> = std::iter::once(None)
        .chain(assignments.map(|mapping| Some(mapping.name.clone())))
        .collect();
    for modules in modules(network, described) {
        for assignment in &assignments {
            let contents = [
                (None, None),
                (rx.clone(), None),
                (None, tx.clone()),
                (rx.clone(), tx.clone()),
            ];
            for (rx, tx) in contents {
                let keys = DeviceKeys {
                    modules: modules.clone(),
                    assignment: assignment.clone(),
                    rx,
                    tx,
                    dc: dc.cloned(),
                };
                let Ok(selection) = keys.select(described, cycle_ns, &[]) else {
                    continue;
                };
                if wanted.matches(&selection) {
                    return (Some(keys), true);
                }
                first.get_or_insert(keys);
            }
        }
    }
    (first, false)
}

/// Returns the objects of one direction, for `pdo.rx` and `pdo.tx`.
fn own_entries(wanted: &WantedLayout, direction: Direction) -> Option<Vec<(u16, u8)>> {
    let WantedLayout::Objects(layout) = wanted else {
        return None;
    };
    let fields = match direction {
        Direction::Rx => &layout.rx,
        Direction::Tx => &layout.tx,
    };
    let entries: Vec<_> = fields
        .iter()
        .map(|field| (field.index, field.sub))
        .collect();
    (!entries.is_empty()).then_some(entries)
}

/// Returns the lists of modules to try: those that the ENI configures, those of the ESI's default,
/// then each module in the first slot and in all slots, then none.
fn modules(network: &NetworkDevice, described: &EsiMatch) -> Vec<Option<Vec<String>>> {
    let Some(slots) = &described.device.slots else {
        return vec![None];
    };
    let modules = &described.file.modules;
    let sdos: Vec<_> = network.sdos.iter().map(|(_, sdo)| sdo).collect();
    let configured = written_list(&sdos, MODULE_LIST, 4);
    let mut lists: Vec<_> = configured
        .map(|idents| Some(esi::module_names(modules, &idents)))
        .into_iter()
        .collect();
    lists.push(None);
    for module in modules.iter().take(MAX_MODULES) {
        for count in [1, slots.slots.len()] {
            let list = Some(vec![module.type_name.clone(); count]);
            if !lists.contains(&list) {
                lists.push(list);
            }
        }
    }
    lists.push(Some(Vec::new()));
    lists
}
