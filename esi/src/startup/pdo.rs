//! 0x16xx, 0x1Axx, 0x1C12, 0x1C13: contents and assignment of PDOs.

use super::List;
use crate::model::{Coe, Device, Direction, Pdo, Writable};
use crate::select::{SelectError, SelectOptions, Selection};

/// Adds the PDO SDOs in the order of the vendor's example: clear assignments, input contents,
/// output contents, set assignments.
pub(super) fn configure(
    device: &Device,
    coe: &Coe,
    selection: &Selection,
    choice: &SelectOptions<'_>,
    list: &mut List<'_>,
) -> Result<(), SelectError> {
    let assignments = assignments(device, selection);
    if !coe.pdo_assign {
        check_assignment(device, selection)?;
    }
    if !coe.pdo_config {
        check_contents(device, selection)?;
    }
    let mut changes = List::new(list.objects);
    if coe.pdo_config {
        contents(device, Direction::Tx, selection, choice, &mut changes);
        contents(device, Direction::Rx, selection, choice, &mut changes);
    }
    // Contents are writable only while the assignment is empty. If the contents stay the same,
    // complete access replaces the whole assignment at once.
    let at_once = coe.complete_access && changes.sdos.is_empty();
    if coe.pdo_assign && !at_once {
        for (sm, pdos) in &assignments {
            let (index, origin) = (assign_object(*sm), sm_origin(device, *sm));
            match pdos.is_empty() {
                true => list.push_optional(index, 0, vec![0], &origin),
                false => list.push(index, 0, vec![0], &origin),
            }
        }
    }
    list.sdos.append(&mut changes.sdos);
    if coe.pdo_assign && at_once {
        for (sm, pdos) in &assignments {
            let count = u8::try_from(pdos.len()).unwrap_or(u8::MAX);
            let mut data = vec![count, 0];
            data.extend(pdos.iter().flat_map(|pdo| pdo.index.to_le_bytes()));
            let is_optional = pdos.is_empty();
            list.push_whole(
                assign_object(*sm),
                data,
                &sm_origin(device, *sm),
                is_optional,
            );
        }
    } else if coe.pdo_assign {
        for (sm, pdos) in assignments.iter().filter(|(_, pdos)| !pdos.is_empty()) {
            let index = assign_object(*sm);
            for (sub, pdo) in (1..=u8::MAX).zip(pdos) {
                list.push(
                    index,
                    sub,
                    pdo.index.to_le_bytes().to_vec(),
                    &pdo_origin(device, selection, pdo),
                );
            }
            let count = u8::try_from(pdos.len()).unwrap_or(u8::MAX);
            list.push(index, 0, vec![count], &sm_origin(device, *sm));
        }
    }
    Ok(())
}

/// Checks a device without writable PDO objects. A device without a mailbox has no assignment
/// objects. Its SyncManagers define the process data, so a named assignment of the ESI is possible.
pub(super) fn check_unchanged(device: &Device, selection: &Selection) -> Result<(), SelectError> {
    if selection.assignment.is_none() {
        check_assignment(device, selection)?;
    }
    check_contents(device, selection)
}

fn assign_object(sm: u8) -> u16 {
    0x1c10u16.saturating_add(u16::from(sm))
}

/// Returns each process data SyncManager with its PDOs, outputs first. SyncManagers without PDOs
/// are included, to clear their assignment. Dictionaries often lack the assignment objects, so they
/// do not decide whether the device has one.
fn assignments<'s>(device: &Device, selection: &'s Selection) -> Vec<(u8, Vec<&'s Pdo>)> {
    use crate::model::SmUse::{Inputs, Outputs};
    let mut numbers: Vec<u8> = (0..=u8::MAX)
        .zip(&device.sync_managers)
        .filter(|(_, sm)| matches!(sm.usage, Outputs | Inputs))
        .map(|(number, _)| number)
        .chain(
            selection
                .rx
                .iter()
                .chain(&selection.tx)
                .filter_map(|pdo| pdo.sm),
        )
        .collect();
    numbers.sort_unstable();
    numbers.dedup();
    numbers
        .into_iter()
        .map(|number| {
            let all = selection.rx.iter().chain(&selection.tx);
            (
                number,
                all.filter(|pdo| pdo.sm == Some(number)).collect::<Vec<_>>(),
            )
        })
        .collect()
}

fn contents(
    device: &Device,
    direction: Direction,
    selection: &Selection,
    choice: &SelectOptions<'_>,
    list: &mut List<'_>,
) {
    let (chosen, offered) = match direction {
        Direction::Rx => (&selection.rx, &device.rx_pdos),
        Direction::Tx => (&selection.tx, &device.tx_pdos),
    };
    let own = match direction {
        Direction::Rx => choice.rx.map(|_| "pdo.rx in "),
        Direction::Tx => choice.tx.map(|_| "pdo.tx in "),
    };
    for pdo in chosen.iter().filter(|pdo| !pdo.fixed) {
        let origin = own.unwrap_or_default().to_owned() + &pdo_origin(device, selection, pdo);
        list.push(pdo.index, 0, vec![0], &origin);
        for (sub, entry) in (1..=u8::MAX).zip(&pdo.entries) {
            list.push(
                pdo.index,
                sub,
                entry.mapping().to_le_bytes().to_vec(),
                &origin,
            );
        }
        // Without entries, the initial zero already is the final count.
        if !pdo.entries.is_empty() {
            let count = u8::try_from(pdo.entries.len()).unwrap_or(u8::MAX);
            list.push(pdo.index, 0, vec![count], &origin);
        }
    }
    // Some drives reject an object that two mapping objects contain, even if unassigned.
    let unused = offered.iter().filter(|pdo| {
        let assigned = chosen.iter().any(|other| other.index == pdo.index);
        let writable = list
            .objects
            .item(pdo.index, 0)
            .is_some_and(|i| i.access.write != Writable::Never);
        !assigned && !pdo.fixed && !pdo.mandatory && !pdo.virtual_ && writable
    });
    for pdo in unused {
        list.push(
            pdo.index,
            0,
            vec![0],
            &format!("{} not used", pdo_origin(device, selection, pdo)),
        );
    }
}

fn check_assignment(device: &Device, selection: &Selection) -> Result<(), SelectError> {
    for (chosen, offered, direction) in [
        (&selection.rx, &device.rx_pdos, Direction::Rx),
        (&selection.tx, &device.tx_pdos, Direction::Tx),
    ] {
        // The device assigns a module's PDOs itself once it knows the module.
        let of_module = |index: u16| {
            !selection.modules.is_empty() && !offered.iter().any(|pdo| pdo.index == index)
        };
        // A further sample has the position of its first sample and is assigned with it.
        let is_sample = |chosen: &Pdo| {
            let mut all = offered.iter().filter(|pdo| pdo.oversampling.is_some());
            all.any(|pdo| pdo.position == chosen.position && pdo.index != chosen.index)
        };
        let default: Vec<u16> = offered
            .iter()
            .filter(|pdo| pdo.sm.is_some() && !pdo.virtual_)
            .map(|pdo| pdo.index)
            .collect();
        let wanted: Vec<u16> = chosen
            .iter()
            .filter(|pdo| !is_sample(pdo))
            .map(|pdo| pdo.index)
            .filter(|index| !of_module(*index))
            .collect();
        // The default may list PDOs that exclude each other. A subset in the same order is then
        // valid.
        let conflict_free =
            wanted.len() == default.len() || has_excludes(offered, &default, direction);
        if wanted.iter().any(|index| !default.contains(index)) || !conflict_free {
            return Err(SelectError::AssignmentFixed {
                device: device.name.clone(),
                default: indices(&default),
                wanted: indices(&wanted),
            });
        }
    }
    Ok(())
}

fn has_excludes(offered: &[Pdo], default: &[u16], direction: Direction) -> bool {
    offered
        .iter()
        .filter(|pdo| pdo.direction == direction && default.contains(&pdo.index))
        .any(|pdo| {
            pdo.exclude
                .iter()
                .any(|other| default.contains(&other.index))
        })
}

fn check_contents(device: &Device, selection: &Selection) -> Result<(), SelectError> {
    for pdo in selection.rx.iter().chain(&selection.tx) {
        let offered = device
            .rx_pdos
            .iter()
            .chain(&device.tx_pdos)
            .find(|known| known.index == pdo.index && !known.virtual_);
        if let Some(offered) = offered
            && selection.modules.is_empty()
            && offered.oversampling.is_none()
            && offered.entries != pdo.entries
        {
            return Err(SelectError::ContentsFixed {
                device: device.name.clone(),
                pdo: pdo.index,
            });
        }
    }
    Ok(())
}

fn indices(list: &[u16]) -> String {
    let texts: Vec<String> = list.iter().map(|index| format!("0x{index:04x}")).collect();
    if texts.is_empty() {
        "nothing".to_owned()
    } else {
        texts.join(", ")
    }
}

fn sm_origin(device: &Device, sm: u8) -> String {
    let manager = device.sync_managers.get(usize::from(sm));
    let position = manager.map(|sm| sm.position).unwrap_or_default();
    format!("Sm {sm} ({})", position.origin())
}

fn pdo_origin(device: &Device, selection: &Selection, pdo: &Pdo) -> String {
    let (kind, of_device) = match pdo.direction {
        Direction::Rx => ("RxPdo", &device.rx_pdos),
        Direction::Tx => ("TxPdo", &device.tx_pdos),
    };
    let of_device = of_device.iter().any(|known| known.position == pdo.position);
    let mut modules = selection.modules.iter().filter(|_| !of_device);
    let module = modules.find(|module| module.pdos.contains(&pdo.index));
    let module = module.map_or_else(String::new, |module| {
        format!("module {:?} ", module.type_name)
    });
    let line = pdo.position.origin();
    format!("{module}{kind} 0x{:04x} ({line})", pdo.index)
}
