//! Touch probes 1 and 2: 0x60B8 selects the edges, 0x60BA–0x60BD hold the positions (CiA 402-2,
//! "touch probe functionality").

use super::io::{Inputs, input};
use super::modes::PositionFrame;
use super::objects::ProbeSlots;
use super::travel::Edge;
use crate::coe::object_dictionary::ObjectStore;

/// Bits of one byte of 0x60B8.
mod function {
    pub const ENABLE: u8 = 1;
    pub const CONTINUOUS: u8 = 1 << 1;
    pub const SOURCE_SHIFT: u8 = 2;
    /// The positive edge, then the negative edge.
    pub const EDGES: [u8; 2] = [1 << 4, 1 << 5];
}

/// Bits of one byte of 0x60B9.
mod status {
    pub const ENABLED: u8 = 1;
    pub const STORED: [u8; 2] = [1 << 1, 1 << 2];
    /// Toggle with every value that continuous sampling stores.
    pub const TOGGLE: [u8; 2] = [1 << 6, 1 << 7];
}

/// The trigger source of a probe.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Source {
    Input(u8),
    ZeroImpulse,
}

#[derive(Debug, Clone, Copy, Default)]
struct Probe {
    function: u8,
    status: u8,
}

#[derive(Debug, Clone, Default)]
pub(super) struct TouchProbes {
    function: i64,
    probes: [Probe; 2],
}

impl TouchProbes {
    /// Runs one control cycle.
    pub(super) fn step(
        &mut self,
        store: &mut ObjectStore,
        slots: &ProbeSlots,
        inputs: &Inputs,
        frame: &PositionFrame,
    ) {
        let word = store.get(slots.function);
        if word == 0 && self.function == 0 {
            return;
        }
        self.function = word;
        let [low, high, ..] = word.to_le_bytes();
        for (n, (probe, function)) in self.probes.iter_mut().zip([low, high]).enumerate() {
            let source = source(function, n, store, slots);
            if !probe.arm(function, source.is_some() && slots.exists(n)) {
                continue;
            }
            let mut take = |probe: &mut Probe, edge: Edge| {
                let which = usize::from(!edge.on);
                if probe.samples(which) {
                    slots.latch(store, n, which, frame.turned(frame.show(edge.counts)));
                }
            };
            match source {
                Some(Source::Input(bit)) => inputs.edges(bit).for_each(|edge| take(probe, edge)),
                Some(Source::ZeroImpulse) => {
                    if let Some(counts) = inputs.index() {
                        take(probe, Edge { on: true, counts });
                    }
                }
                None => {}
            }
        }
        let [first, second] = self.probes.map(|probe| probe.status);
        store.show(slots.status, i64::from(u16::from_le_bytes([first, second])));
    }
}

impl Probe {
    /// Applies the probe's byte of 0x60B8. True while the probe is enabled.
    fn arm(&mut self, function: u8, possible: bool) -> bool {
        let switched_on = function & !self.function;
        self.function = function;
        if function & function::ENABLE == 0 || !possible {
            self.status = 0;
            return false;
        }
        if self.status == 0 || switched_on & function::ENABLE != 0 {
            self.status = status::ENABLED;
        }
        // An edge that is enabled again may store a new value.
        for (edge, stored) in function::EDGES.into_iter().zip(status::STORED) {
            if switched_on & edge != 0 {
                self.status &= !stored;
            }
        }
        true
    }

    /// Handles an edge: 0 positive, 1 negative. True if its position is to be stored.
    fn samples(&mut self, which: usize) -> bool {
        let (Some(edge), Some(stored), Some(toggle)) = (
            function::EDGES.get(which),
            status::STORED.get(which),
            status::TOGGLE.get(which),
        ) else {
            return false;
        };
        let continuous = self.function & function::CONTINUOUS != 0;
        if self.function & edge == 0 || (self.status & stored != 0 && !continuous) {
            return false;
        }
        self.status |= stored;
        if continuous {
            self.status ^= toggle;
        }
        true
    }
}

/// Returns the source of 0x60B8 bits 2 and 3, or of 0x60D0 if they select it.
fn source(function: u8, n: usize, store: &ObjectStore, slots: &ProbeSlots) -> Option<Source> {
    let own = if n == 0 {
        input::TOUCH_PROBE_1
    } else {
        input::TOUCH_PROBE_2
    };
    match function >> function::SOURCE_SHIFT & 3 {
        0 => Some(Source::Input(own)),
        1 => Some(Source::ZeroImpulse),
        2 => match slots.source(store, n)? {
            1 => Some(Source::Input(input::TOUCH_PROBE_1)),
            2 => Some(Source::Input(input::TOUCH_PROBE_2)),
            5 => Some(Source::ZeroImpulse),
            _ => None,
        },
        _ => None,
    }
}
