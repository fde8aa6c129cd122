//! Objects that homing, mode switches and probes need in the process data. A device gets them
//! without `pdo` keys, if its PDOs can carry them.

use std::collections::BTreeMap;

use ecaxis_axis::{Edge, Mode};
use ecaxis_esi as esi;

use super::axis::MODE_OBJECTS;
use super::fields::KeyExt;
use super::raw::{RawAction, RawDevice, RawProbe, RawStep};

/// Objects of an axis, each once.
#[derive(Debug, Clone, Default)]
pub(crate) struct NeededObjects {
    rx: Vec<u16>,
    tx: Vec<u16>,
}

impl NeededObjects {
    fn add(&mut self, rx: &[u16], tx: &[u16]) {
        for (list, more) in [(&mut self.rx, rx), (&mut self.tx, tx)] {
            for index in more {
                if !list.contains(index) {
                    list.push(*index);
                }
            }
        }
    }

    /// Adds the objects of a mode. An unknown one is reported elsewhere.
    fn add_mode(&mut self, mode: &str) {
        let mode = mode.parse::<esi::Mode>();
        let mode = mode.map(|mode| Mode::from_code(mode.code()));
        let known = MODE_OBJECTS.iter().find(|(known, ..)| Ok(*known) == mode);
        if let Some((_, targets, reported)) = known {
            self.add(targets, reported);
        }
    }
}

/// Returns the outputs of PP and PV, and none of other modes.
pub(crate) fn profile(mode: &str) -> &'static [u16] {
    let mode = match mode.parse() {
        Ok(esi::Mode::Pp) => Mode::Pp,
        Ok(esi::Mode::Pv) => Mode::Pv,
        _ => return &[],
    };
    let known = MODE_OBJECTS.iter().find(|(known, ..)| *known == mode);
    known.map_or(&[], |(_, targets, _)| *targets)
}

/// The needs of each axis by name.
pub(crate) type Needs = BTreeMap<String, NeededObjects>;

const MODE: (&[u16], &[u16]) = (&[0x6060], &[0x6061]);

/// Returns what the steps need.
pub(crate) fn of_steps(steps: &[RawStep]) -> Needs {
    let mut needs = Needs::new();
    collect(steps, &mut needs);
    needs
}

fn collect(steps: &[RawStep], needs: &mut Needs) {
    for step in steps {
        match &step.action {
            RawAction::Mode(targets) => {
                for (axis, mode) in targets {
                    let own = needs.entry(axis.get_ref().clone()).or_default();
                    own.add(MODE.0, MODE.1);
                    own.add_mode(mode.get_ref());
                }
            }
            RawAction::Probe(axis, probe) => {
                let own = needs.entry(axis.get_ref().clone()).or_default();
                own.add(&[0x60b8], &[0x60b9, position_object(probe)]);
            }
            RawAction::Repeat { steps, .. }
            | RawAction::While { steps, .. }
            | RawAction::Call { steps, .. } => collect(steps, needs),
            RawAction::If {
                steps, otherwise, ..
            } => {
                collect(steps, needs);
                collect(otherwise, needs);
            }
            RawAction::Parallel(branches) => {
                for steps in branches {
                    collect(steps, needs);
                }
            }
            _ => {}
        }
    }
}

fn position_object(probe: &RawProbe) -> u16 {
    let second = u16::from(probe.input.value() == Some(2));
    let falling = u16::from(probe.edge.value() == Some(Edge::Negative));
    0x60ba + 2 * second + falling
}

/// Returns the objects that the process data lacks; `None` if nothing is missing, or the file has
/// PDO contents of its own.
pub(crate) fn missing(
    raw: &RawDevice,
    axes: &[u16],
    needs: &Needs,
    layout: &esi::layout::Layout,
) -> Option<AddedObjects> {
    // A Sercos drive has no mode in its process data.
    if raw.pdo.rx.is_some() || raw.pdo.tx.is_some() || layout.idns {
        return None;
    }
    let mut missing = [Vec::new(), Vec::new()];
    for (axis, &number) in raw.axes.0.iter().zip(axes) {
        let name = axis.name.as_ref().or(raw.name.as_ref());
        let own = name.and_then(|name| needs.get(name.get_ref()));
        let mut own = own.cloned().unwrap_or_default();
        if axis.homing.is_some() {
            own.add(MODE.0, MODE.1);
        }
        if let Some(mode) = &raw.mode {
            own.add(profile(mode.get_ref()), &[]);
        }
        for (missing, (list, fields)) in missing
            .iter_mut()
            .zip([(&own.rx, &layout.rx), (&own.tx, &layout.tx)])
        {
            let objects = list.iter().map(|index| esi::axis::object(*index, number));
            missing.extend(objects.filter(|index| fields.iter().all(|f| f.index != *index)));
        }
    }
    if missing.iter().all(Vec::is_empty) {
        return None;
    }
    let [rx, tx] = missing.map(|list| {
        let entries = list.into_iter();
        let entries = entries.map(|index| esi::EntryRef { index, sub: 0 });
        entries.collect::<Vec<_>>()
    });
    let whole = |fields: &[esi::layout::Field], more: &[esi::EntryRef]| {
        let there = fields.iter().filter(|field| field.index != 0);
        let there = there.map(|field| esi::EntryRef {
            index: field.index,
            sub: field.sub,
        });
        let whole = || there.chain(more.iter().copied()).collect();
        (!more.is_empty()).then(whole)
    };
    Some(AddedObjects {
        whole_rx: whole(&layout.rx, &rx),
        whole_tx: whole(&layout.tx, &tx),
        note: note(&rx, &tx),
        rx,
        tx,
    })
}

impl AddedObjects {
    /// Returns the selection with the objects: in the PDOs that it has, otherwise all objects in a
    /// PDO that can be configured. `None` if the device can carry them in neither way.
    pub fn select<'a>(
        &'a self,
        file: &esi::EsiFile,
        device: &esi::Device,
        choice: esi::SelectOptions<'a>,
    ) -> Option<(esi::Selection, esi::SelectOptions<'a>)> {
        let added = esi::SelectOptions {
            more_rx: &self.rx,
            more_tx: &self.tx,
            ..choice
        };
        let whole = esi::SelectOptions {
            rx: self.whole_rx.as_deref(),
            tx: self.whole_tx.as_deref(),
            ..choice
        };
        let mut ways = [added, whole].into_iter();
        ways.find_map(|way| {
            let selection = esi::select(file, device, &way).ok()?;
            fits(&selection).then_some((selection, way))
        })
    }
}

/// True if the mapping objects have a subindex for each entry, as far as the dictionary knows.
fn fits(selection: &esi::Selection) -> bool {
    let dictionary = &selection.dictionary;
    let all = selection.rx.iter().chain(&selection.tx);
    let mut all = all.filter(|pdo| dictionary.item(pdo.index, 1).is_some());
    all.all(|pdo| {
        let last = u8::try_from(pdo.entries.len());
        last.is_ok_and(|last| dictionary.item(pdo.index, last).is_some())
    })
}

/// Objects that are added to the PDOs of a device.
#[derive(Debug)]
pub(crate) struct AddedObjects {
    rx: Vec<esi::EntryRef>,
    tx: Vec<esi::EntryRef>,
    /// The whole contents with them; `None`: nothing is added.
    whole_rx: Option<Vec<esi::EntryRef>>,
    whole_tx: Option<Vec<esi::EntryRef>>,
    pub note: String,
}

fn note(rx: &[esi::EntryRef], tx: &[esi::EntryRef]) -> String {
    let all = rx.iter().chain(tx);
    let all: Vec<_> = all.map(|entry| format!("0x{:04X}", entry.index)).collect();
    let verb = if all.len() == 1 { "is" } else { "are" };
    format!(
        "{} {verb} added to the process data: homing, a mode or a probe needs it",
        all.join(", ")
    )
}
