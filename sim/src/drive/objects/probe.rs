//! Touch probe objects, if the ESI has them.

use super::bind::Binder;
use crate::coe::object_dictionary::{EntryHandle, ObjectStore};

#[derive(Debug, Clone)]
pub(in crate::drive) struct ProbeSlots {
    pub function: EntryHandle,
    pub status: EntryHandle,
    /// 0x60BA–0x60BD, by probe, then positive and negative edge.
    positions: [[Option<EntryHandle>; 2]; 2],
    /// 0x60D5–0x60D8.
    counters: [[Option<EntryHandle>; 2]; 2],
    /// 0x60D0.
    sources: [Option<EntryHandle>; 2],
}

impl ProbeSlots {
    pub(super) fn find(b: &Binder<'_>) -> Option<Self> {
        let four = |first: u16| {
            [[first, first + 1], [first + 2, first + 3]]
                .map(|edges| edges.map(|index| b.slot(index, 0)))
        };
        Some(Self {
            function: b.slot(0x60b8, 0)?,
            status: b.slot(0x60b9, 0)?,
            positions: four(0x60ba),
            counters: four(0x60d5),
            sources: [1, 2].map(|sub| b.slot(0x60d0, sub)),
        })
    }

    /// True if the probe has an object for its positions.
    pub(in crate::drive) fn exists(&self, probe: usize) -> bool {
        self.positions
            .get(probe)
            .is_some_and(|edges| edges.iter().any(Option::is_some))
    }

    /// Returns 0x60D0.
    pub(in crate::drive) fn source(&self, store: &ObjectStore, probe: usize) -> Option<i64> {
        let slot = (*self.sources.get(probe)?)?;
        Some(store.get_signed(slot))
    }

    pub(in crate::drive) fn latch(
        &self,
        store: &mut ObjectStore,
        probe: usize,
        edge: usize,
        position: i64,
    ) {
        let at = |slots: &[[Option<EntryHandle>; 2]; 2]| *slots.get(probe)?.get(edge)?;
        if let Some(slot) = at(&self.positions) {
            store.show(slot, position);
        }
        if let Some(slot) = at(&self.counters) {
            store.show(slot, store.get(slot).wrapping_add(1));
        }
    }
}
