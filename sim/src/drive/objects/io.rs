//! Digital inputs and outputs: 0x60FD, 0x60FE and, of maxon drives, 0x3141, 0x3142, 0x3150.

use super::bind::{Binder, RO, RW};
use crate::coe::object_dictionary::{EntryHandle, ObjectStore};
use crate::drive::io::input;

/// Inputs that 0x3142 assigns. All other inputs are always connected.
const ASSIGNED: u32 = 1 << input::NEGATIVE_LIMIT | 1 << input::POSITIVE_LIMIT | 1 << input::HOME;

#[derive(Debug, Clone)]
pub(in crate::drive) struct IoSlots {
    pub inputs: EntryHandle,
    pub outputs: EntryHandle,
    /// 0x60FE:02: the outputs that are driven. Without it, all outputs are driven.
    output_mask: Option<EntryHandle>,
    polarity: Option<EntryHandle>,
    /// 0x3142:n: the bit of 0x60FD that input n drives.
    configuration: [Option<EntryHandle>; 8],
    /// 0x3141:01.
    logic: Option<EntryHandle>,
}

impl IoSlots {
    pub(super) fn bind(b: &mut Binder<'_>) -> Self {
        const NAMES: [&str; 8] = [
            "Digital input 1 configuration",
            "Digital input 2 configuration",
            "Digital input 3 configuration",
            "Digital input 4 configuration",
            "High-speed digital input 1 configuration",
            "High-speed digital input 2 configuration",
            "High-speed digital input 3 configuration",
            "High-speed digital input 4 configuration",
        ];
        let mut sub = 0;
        let configuration = NAMES.map(|name| {
            sub += 1;
            b.own(0x3142, sub, name)
        });
        Self {
            inputs: b.bind(0x60fd, 0, "Digital inputs", 32, RO),
            outputs: b.bind(0x60fe, 1, "Physical outputs", 32, RW),
            output_mask: b.slot(0x60fe, 2),
            polarity: b.own(0x3141, 2, "Digital inputs polarity"),
            configuration,
            logic: b.own(0x3141, 1, "Digital inputs logic state"),
        }
    }

    /// Returns the bits of 0x60FD with inverted polarity, and the bits that have an input.
    pub(in crate::drive) fn wiring(&self, store: &ObjectStore) -> (u32, u32) {
        if self.configuration.iter().all(Option::is_none) {
            return (0, u32::MAX);
        }
        let polarity = self.polarity.map_or(0, |slot| store.get(slot));
        let (mut inverted, mut live) = (0, !ASSIGNED);
        for (n, bit) in self.lines(store) {
            live |= bit;
            if polarity >> n & 1 != 0 {
                inverted |= bit;
            }
        }
        (inverted, live)
    }

    /// Writes 0x60FD, and the same levels by input to 0x3141:01.
    pub(in crate::drive) fn publish(&self, store: &mut ObjectStore, inputs: u32) {
        store.show(self.inputs, i64::from(inputs));
        if let Some(slot) = self.logic {
            let levels = self
                .lines(store)
                .filter(|(_, bit)| inputs & bit != 0)
                .fold(0, |word, (n, _)| word | 1 << n);
            store.show(slot, levels);
        }
    }

    /// Returns the assigned inputs with their bits in 0x60FD.
    fn lines<'a>(&'a self, store: &'a ObjectStore) -> impl Iterator<Item = (usize, u32)> + 'a {
        self.configuration
            .iter()
            .enumerate()
            .filter_map(move |(n, slot)| {
                let bit = u32::try_from(store.get((*slot)?)).ok()?;
                Some((n, 1_u32.checked_shl(bit)?))
            })
    }

    /// Returns 0x60FE as driven at the terminals.
    pub(in crate::drive) fn outputs(&self, store: &ObjectStore) -> u32 {
        let mask = self.output_mask.map_or(-1, |slot| store.get(slot));
        let [a, b, c, d, ..] = (store.get(self.outputs) & mask).to_le_bytes();
        u32::from_le_bytes([a, b, c, d])
    }
}
