//! Passes override and hold to every axis, once per cycle.

use ecaxis_axis::setpoint::table_rate;
use ecaxis_ecat::index::{AxisIndex, GroupIndex};

use super::Engine;
use crate::rt::axis::RtAxis;
use crate::rt::overrides::Rates;

impl Engine {
    /// Sets the rates of this cycle. All axes of a line have the lowest of their rates, so that they
    /// stay on it. The tables of a group keep their common time.
    pub(super) fn set_rates(&mut self) {
        if self.guarding {
            self.overrides.read(&self.inputs);
        }
        for group in self.groups.indices() {
            self.set_table_rate(group);
        }
        for index in self.axes.indices() {
            let line = self.line_rate(index);
            let Some(slot) = self.axes.get_mut(index) else {
                continue;
            };
            let own = self.overrides.rate(slot.group);
            slot.axis.set_rate(own);
            slot.rates = Rates {
                own,
                line,
                table: self
                    .overrides
                    .tables
                    .get(slot.group)
                    .copied()
                    .unwrap_or(0.0),
            };
        }
    }

    /// Returns the lowest rate of the axes on the line of an axis.
    fn line_rate(&self, index: AxisIndex) -> f64 {
        let Some(line) = self.axes.get(index).and_then(|slot| slot.generator.line()) else {
            return f64::INFINITY;
        };
        let members = self.axes.iter();
        let members = members.filter(|slot| slot.generator.line() == Some(line));
        let rates = members.map(|slot| self.overrides.rate(slot.group));
        rates.fold(f64::INFINITY, f64::min)
    }

    fn set_table_rate(&mut self, group: GroupIndex) {
        let wanted = self.overrides.rate(group).min(1.0);
        let Some(now) = self.overrides.tables.get(group).copied() else {
            return;
        };
        let plays = |slot: &&RtAxis| slot.group == group && slot.generator.plays();
        let mut players = self.axes.iter().filter(plays);
        // A node of a gateway steps in some cycles only; until then the rate is constant.
        if now == wanted || players.any(|slot| slot.acted) {
            return;
        }
        let mut dt_s = 0.0;
        for slot in self.axes.iter().filter(plays) {
            dt_s = slot.dt_s(self.config.cycle_ns);
        }
        let next = if dt_s == 0.0 {
            wanted
        } else {
            table_rate(now, wanted, dt_s, |rate| {
                let mut players = self.axes.iter().filter(plays);
                players.all(|slot| {
                    let dt_s = slot.dt_s(self.config.cycle_ns);
                    slot.generator
                        .permits_rate(&slot.axis, &self.tables, rate, dt_s)
                })
            })
        };
        if let Some(rate) = self.overrides.tables.get_mut(group) {
            *rate = next;
        }
    }
}
