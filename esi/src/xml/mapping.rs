//! PDOs of devices that describe them only in the dictionary: defaults of mapping objects (0x1600
//! …, 0x1A00 …) and assignment objects (0x1C1x).

use crate::model::{
    Device, Dictionary, Direction, Entry, Object, Pdo, SlotDependence, SmUse, Writable,
};

/// Fills a direction that has no PDO elements. Devices with slots are excluded, because their
/// modules define the PDOs.
pub(super) fn complete(device: &mut Device) {
    if device.slots.is_some() {
        return;
    }
    let has_elements = !device.rx_pdos.is_empty() || !device.tx_pdos.is_empty();
    let mut configurable = false;
    for direction in [Direction::Rx, Direction::Tx] {
        let pdos = match direction {
            Direction::Rx => &device.rx_pdos,
            Direction::Tx => &device.tx_pdos,
        };
        if !pdos.is_empty() {
            continue;
        }
        let pdos = pdos_of(device, direction);
        configurable |= pdos.iter().any(|pdo| !pdo.fixed);
        match direction {
            Direction::Rx => device.rx_pdos = pdos,
            Direction::Tx => device.tx_pdos = pdos,
        }
    }
    // Without PDO elements, the access of the mapping objects says what is configurable.
    let coe = device
        .mailbox
        .as_mut()
        .and_then(|mailbox| mailbox.coe.as_mut());
    if let Some(coe) = coe.filter(|_| configurable && !has_elements) {
        coe.pdo_config = true;
        let counts = [0x1c12, 0x1c13].map(|index| device.dictionary.item(index, 0));
        let mut known = counts.into_iter().flatten().peekable();
        coe.pdo_assign |=
            known.peek().is_some() && known.all(|count| count.access.write != Writable::Never);
    }
}

fn pdos_of(device: &Device, direction: Direction) -> Vec<Pdo> {
    let usage = SmUse::from(direction);
    let range = match direction {
        Direction::Rx => 0x1600..=0x17ff,
        Direction::Tx => 0x1a00..=0x1bff,
    };
    let dictionary = &device.dictionary;
    let mut mapped: Vec<&Object> = dictionary
        .objects
        .iter()
        .filter(|object| range.contains(&object.index))
        .collect();
    mapped.sort_by_key(|object| object.index);
    mapped.dedup_by_key(|object| object.index);
    let mut pdos: Vec<Pdo> = mapped
        .into_iter()
        .filter_map(|object| pdo(dictionary, direction, object))
        .collect();
    let sync_managers: Vec<u8> = (0..=u8::MAX)
        .zip(&device.sync_managers)
        .filter(|(_, sm)| sm.usage == usage && !sm.virtual_)
        .map(|(number, _)| number)
        .collect();
    let mut assigned = Vec::new();
    let mut stated = false;
    for &sm in &sync_managers {
        let Some(object) = dictionary.object(0x1c10u16.saturating_add(u16::from(sm))) else {
            continue;
        };
        stated = true;
        for index in defaults(object) {
            let at = pdos.iter().position(|pdo| u32::from(pdo.index) == index);
            if let Some(at) =
                at.filter(|at| pdos.get(*at).is_some_and(|pdo| !pdo.entries.is_empty()))
            {
                let mut pdo = pdos.remove(at);
                pdo.sm = Some(sm);
                assigned.push(pdo);
            }
        }
    }
    // A device without assignment objects has one PDO in each direction.
    let mut used = pdos.iter_mut().filter(|pdo| !pdo.entries.is_empty());
    if let (false, Some(first), Some(sm)) = (stated, used.next(), sync_managers.first()) {
        first.sm = Some(*sm);
    }
    assigned.append(&mut pdos);
    assigned
}

fn pdo(dictionary: &Dictionary, direction: Direction, object: &Object) -> Option<Pdo> {
    let entries: Vec<Entry> = defaults(object)
        .map(|mapping| {
            let [bits, sub, low, high] = mapping.to_le_bytes();
            let index = u16::from_le_bytes([low, high]);
            let item = dictionary.item(index, sub);
            Entry {
                position: object.position,
                index,
                sub,
                bit_len: u16::from(bits),
                name: item.map(|item| item.name.clone()).unwrap_or_default(),
                data_type: item.map(|item| item.type_name.clone()).unwrap_or_default(),
                depends_on: SlotDependence::default(),
            }
        })
        .collect();
    let writable = object
        .items
        .first()
        .is_some_and(|count| count.access.write != Writable::Never);
    (!entries.is_empty() || writable).then(|| Pdo {
        position: object.position,
        direction,
        index: object.index,
        name: object.name.to_string(),
        sm: None,
        su: None,
        excluded_sm: Vec::new(),
        fixed: !writable,
        mandatory: false,
        virtual_: false,
        overwritten_by_module: false,
        depends_on: SlotDependence::default(),
        oversampling: None,
        exclude: Vec::new(),
        entries,
    })
}

/// Returns the values of the subindices 1 to the count in subindex 0.
fn defaults(object: &Object) -> impl Iterator<Item = u32> {
    let (count, rest) = match object.items.split_first() {
        Some((count, rest)) => (value(&count.default), rest),
        None => (0, &[][..]),
    };
    let count = usize::try_from(count).unwrap_or(usize::MAX);
    rest.iter()
        .take(count)
        .filter(|item| item.has_default)
        .map(|item| value(&item.default))
}

fn value(bytes: &[u8]) -> u32 {
    let mut all = [0; 4];
    for (to, from) in all.iter_mut().zip(bytes) {
        *to = *from;
    }
    u32::from_le_bytes(all)
}
