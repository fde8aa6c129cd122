//! The drive alone: a store without an ESI, and process data written by the test.

mod abuse;
mod devices;
mod faults;
mod halts;
mod homing;
mod inputs;
mod motion;
mod options;
mod polarity;
mod probes;
mod profiles;
mod quirks;
mod speeds;
mod transitions;

use ecaxis_esi::model::Access;

use super::*;
use crate::coe::object_dictionary::EntryHandle;

/// A drive with a minimal bus: one SYNC per bus cycle, a control cycle every 0.4 ms.
pub(super) struct Rig {
    pub(super) store: ObjectStore,
    pub(super) drive: Drive,
    in_op: bool,
    counts_per_turn: u32,
    cycle_ns: u64,
    now_ns: u64,
    control_ns: u64,
}

const MS: u64 = 1_000_000;

/// An object that a drive has only if its ESI lists it: index, subindex, bits, name.
type Extra = (u16, u8, u32, &'static str);

impl Rig {
    pub(super) fn new(plant: PlantParams) -> Self {
        Self::with(plant, &[])
    }

    fn with(plant: PlantParams, extras: &[Extra]) -> Self {
        let mut store = ObjectStore::default();
        for unit in [0x60a9, 0x60aa] {
            store.ensure(unit, 0, "SI unit", 32, Access::default(), &[]);
        }
        for (index, sub, bits, name) in extras {
            store.ensure(*index, *sub, name, *bits, Access::default(), &[]);
        }
        let drive = Drive::new(&mut store, plant);
        let mut rig = Self {
            store,
            drive,
            in_op: true,
            counts_per_turn: plant.counts_per_turn,
            cycle_ns: MS,
            now_ns: 0,
            control_ns: CONTROL_PERIOD_NS,
        };
        rig.set(0x60c2, 1, 1);
        rig
    }

    pub(super) fn slot(&self, index: u16, sub: u8) -> EntryHandle {
        self.store.slot(index, sub).expect("the drive made it")
    }

    pub(super) fn set(&mut self, index: u16, sub: u8, value: i64) {
        let slot = self.slot(index, sub);
        self.store.set(slot, value);
    }

    pub(super) fn get(&self, index: u16) -> i64 {
        self.store.get_signed(self.slot(index, 0))
    }

    /// Returns the emergencies since the last call.
    fn emergencies(&mut self) -> Vec<u16> {
        std::iter::from_fn(|| self.drive.take_emergency())
            .map(|emergency| emergency.code)
            .collect()
    }

    fn word(&self) -> i64 {
        self.store.get(self.slot(0x6041, 0))
    }

    /// Runs one bus cycle: SYNC, then the control cycles of that period.
    fn cycle(&mut self) {
        self.drive.sync(&self.store);
        self.now_ns += self.cycle_ns;
        while self.control_ns <= self.now_ns {
            self.drive.control(&mut self.store, self.in_op);
            self.control_ns += CONTROL_PERIOD_NS;
        }
    }

    fn cycles(&mut self, n: u32) {
        for _ in 0..n {
            self.cycle();
        }
    }

    /// Runs one SYNC and one control cycle: at most one transition.
    fn step(&mut self, controlword: i64) -> State {
        self.set(0x6040, 0, controlword);
        self.drive.sync(&self.store);
        self.drive.control(&mut self.store, self.in_op);
        self.drive.state()
    }

    pub(super) fn run_ms(&mut self, ms: u64) {
        self.cycles(u32::try_from(ms * MS / self.cycle_ns).unwrap());
    }

    pub(super) fn enable(&mut self, mode: i64) {
        self.set(0x6060, 0, mode);
        self.set(0x6040, 0, 0);
        self.run_ms(10);
        for word in [0x06, 0x0f] {
            self.set(0x6040, 0, word);
            let position = self.get(0x6064);
            self.set(0x607a, 0, position);
            self.run_ms(10);
        }
        assert_eq!(self.drive.state(), State::OperationEnabled);
        assert_eq!(self.get(0x6061), mode);
    }
}

fn rig() -> Rig {
    Rig::new(PlantParams::default())
}
