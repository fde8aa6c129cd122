//! 0x6091: the ratio of encoder counts and units of positions, without 0x608F and 0x6092.
//!
//! The motor model counts in units of positions. A new ratio therefore gives it another number of
//! counts per turn, and its positions the same angle.

use crate::coe::object_dictionary::{EntryHandle, ObjectStore};
use crate::drive::objects::GearSlots;
use crate::drive::plant::PlantParams;
use crate::drive::travel::Track;

/// The gear of a drive with [`super::Quirks::gear_encoder`].
#[derive(Debug, Clone)]
pub(in crate::drive) struct Gear {
    slots: [EntryHandle; 2],
    encoder: u32,
    /// The motor in the units of the machine file.
    user: PlantParams,
}

impl Gear {
    pub(in crate::drive) fn new(slots: GearSlots, plant: &PlantParams) -> Option<Self> {
        Some(Self {
            slots: slots.0?,
            encoder: plant.quirks.gear_encoder?,
            user: *plant,
        })
    }

    /// Returns the motor in the units of the present ratio.
    pub(in crate::drive) fn plant(&self, store: &ObjectStore) -> PlantParams {
        let [encoder, units] = self
            .slots
            .map(|slot| store.get(slot).clamp(1, i64::from(u32::MAX)));
        let wide = u128::from(self.encoder) * u128::from(units.unsigned_abs());
        let half = u128::from(encoder.unsigned_abs()) / 2;
        let counts = (wide + half) / u128::from(encoder.unsigned_abs());
        let counts_per_turn = u32::try_from(counts).unwrap_or(u32::MAX).max(1);
        let ratio = f64::from(counts_per_turn) / f64::from(self.user.counts_per_turn.max(1));
        let track = self.user.track;
        let scaled = |counts: i32| scaled(counts, ratio);
        let range = |range: Option<(i32, i32)>| range.map(|(a, b)| (scaled(a), scaled(b)));
        PlantParams {
            counts_per_turn,
            initial_position: scaled(self.user.initial_position),
            backlash: self.user.backlash * ratio,
            track: Track {
                negative_limit: track.negative_limit.map(scaled),
                positive_limit: track.positive_limit.map(scaled),
                home: range(track.home),
                probes: track.probes.map(range),
                index: track.index.map(scaled),
                ends: range(track.ends),
                normally_closed: track.normally_closed,
            },
            ..self.user
        }
    }
}

#[expect(clippy::cast_possible_truncation, reason = "saturates")]
fn scaled(counts: i32, ratio: f64) -> i32 {
    (f64::from(counts) * ratio).round() as i32
}
