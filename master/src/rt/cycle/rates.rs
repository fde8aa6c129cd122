//! Passes override and hold to every axis, once per cycle.

use ecaxis_axis::setpoint::Rate;
use ecaxis_axis::{Command, HomingStatus};
use ecaxis_ecat::index::{AxisIndex, GroupIndex};

use super::Engine;
use crate::rt::axis::RtAxis;
use crate::rt::gantry;
use crate::rt::overrides::Rates;

impl Engine {
    /// Sets the rates of this cycle. All axes of a line have the lowest of their rates, so that they
    /// stay on it. The tables of a group have a common time.
    pub(super) fn set_rates(&mut self) {
        for group in self.groups.indices() {
            self.play_tables(group);
        }
        for index in self.axes.indices() {
            let line = self.line_rate(index);
            let Some(slot) = self.axes.get_mut(index) else {
                continue;
            };
            let own = self.overrides.rate(slot.group);
            slot.axis.set_rate(own.value());
            slot.rates = Rates { own, line };
        }
        self.stop_held();
    }

    /// Returns the lowest rate of the axes on the line of an axis.
    fn line_rate(&self, index: AxisIndex) -> Rate {
        let Some(line) = self.axes.get(index).and_then(|slot| slot.generator.line()) else {
            return Rate::WHOLE;
        };
        let members = self.axes.iter();
        let members = members.filter(|slot| slot.generator.line() == Some(line));
        let rates = members.map(|slot| self.overrides.rate(slot.group));
        rates.reduce(Rate::min).unwrap_or(Rate::WHOLE)
    }

    /// Stops the search for home of held axes: that of a drive cannot wait.
    fn stop_held(&mut self) {
        for index in self.axes.indices() {
            let Some(slot) = self.axes.get_mut(index) else {
                continue;
            };
            let homes = slot.axis.status().homing == HomingStatus::Running;
            if !slot.rates.own.is_held() || !homes {
                slot.stopped_by_hold = false;
            } else if !std::mem::replace(&mut slot.stopped_by_hold, true) {
                // A stop is never refused.
                let (axes, gantries) = (&mut self.axes, &mut self.gantries);
                let _ = gantry::command(axes, gantries, index, Command::HoldHoming);
            }
        }
    }

    /// Advances the rate of the tables of a group, and their common time.
    fn play_tables(&mut self, group: GroupIndex) {
        let wanted = self.overrides.rate(group);
        let Some(rate) = self.overrides.tables.get_mut(group) else {
            return;
        };
        // New tables wait at their start while the rate changes.
        let begun = rate.changes();
        let plays = |slot: &RtAxis| slot.group == group && slot.generator.plays(begun);
        if !self.axes.iter().any(plays) {
            rate.set(wanted);
            return;
        }
        let cycle_s = self.config.cycle_ns as f64 * 1e-9;
        let value = rate.advance(wanted, cycle_s, |course| {
            let mut players = self.axes.iter().filter(|slot| plays(slot));
            players.all(|slot| {
                slot.generator
                    .keeps(&slot.axis, &self.tables, course, cycle_s)
            })
        });
        for slot in &mut self.axes {
            if plays(slot) {
                slot.generator.play(&self.tables, value, cycle_s);
            }
        }
    }
}
