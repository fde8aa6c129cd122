//! Stops the machine after a panic in the cycle.
//!
//! After the first panic the cycle continues and stops the machine as for any other cause. After a
//! second panic the axis state is no longer trusted. The drives then receive "quick stop" in plain
//! frames, and "disable voltage" once they stand still. Sercos drives keep "quick stop" until they have
//! no torque.

use std::panic::{AssertUnwindSafe, catch_unwind};

use ecaxis_axis::{Controlword, DriveWords, State, Statusword};

use super::{Engine, Nanos};
use crate::clock;
use crate::rt::bus_monitor::StopCause;
use crate::rt::channel::RtCommand;

/// An axis stands still if its position has not changed for this time.
const STANDING: Nanos = 100_000_000;
/// Position changes up to this many counts are noise.
const NOISE: u64 = 2;
/// Added to the stopping time of the slowest axis.
const MARGIN_S: f64 = 2.0;

/// The progress of the stop after a second panic.
#[derive(Debug, Default)]
pub(super) struct Plain {
    since: Option<Nanos>,
    /// For each axis, the last position and the time since which it is unchanged.
    rest: Vec<(i64, Nanos)>,
    /// The longest time from full speed to rest.
    slowest_s: f64,
    /// The number of panics.
    panics: u32,
}

/// After this many panics the link is considered unusable.
const MOST_PANICS: u32 = 100;

impl Plain {
    #[allow(
        clippy::disallowed_macros,
        clippy::disallowed_methods,
        reason = "runs before the loop"
    )]
    pub(super) fn new(axes: &[super::RtAxis]) -> Self {
        let times = axes.iter().map(|slot| {
            let config = slot.axis.config();
            config.stop_time_s(config.mode, config.limits.velocity)
        });
        Self {
            since: None,
            rest: vec![(i64::MAX, 0); axes.len()],
            slowest_s: times.fold(0.0, f64::max),
            panics: 0,
        }
    }
}

impl Engine {
    /// Runs one cycle. RT: blocks on the clock and the wire only; O(image + axes). A panic inside
    /// stops the machine.
    pub fn cycle(&mut self) {
        let due = self.next;
        if self.plain.since.is_some() {
            self.plain_cycle();
            return;
        }
        if !self.catch(Self::turn) {
            return;
        }
        let again = self
            .stopping()
            .is_some_and(|s| s.cause == StopCause::Panicked)
            || self
                .stopping()
                .is_some_and(|s| s.failure == Some(StopCause::Panicked));
        let failed = again
            || self.catch(|engine| {
                engine.stop(None, StopCause::Panicked);
                if engine.next == due {
                    engine.exchange.stage();
                    engine.schedule_next_cycle(0);
                }
            });
        if failed {
            self.plain.since = Some(clock::now());
            self.next = self.next.max(due) + self.config.cycle_ns;
        }
    }

    /// Returns true if `work` panicked.
    fn catch(&mut self, work: impl FnOnce(&mut Self)) -> bool {
        let panicked = catch_unwind(AssertUnwindSafe(|| work(self))).is_err();
        self.plain.panics += u32::from(panicked);
        panicked
    }

    fn plain_cycle(&mut self) {
        self.clock.sleep_until(self.next, self.margin.get());
        let woke = clock::now();
        self.catch(|engine| engine.send(0));
        self.catch(|engine| engine.receive(woke));
        self.catch(|engine| engine.answer = engine.exchange.evaluate());
        let mut ended = true;
        self.catch(|engine| ended = engine.write_plain_words(woke));
        ended |= self.plain.panics > MOST_PANICS;
        self.catch(|engine| engine.exchange.stage());
        self.catch(|engine| engine.publish_plain(woke, ended));
        self.catch(|engine| {
            while let Ok(command) = engine.end.commands.pop() {
                engine.commands_taken += 1;
                engine.halted |= command == RtCommand::Halt;
            }
            engine.halted |= engine.end.commands.is_abandoned() && ended;
        });
        self.next += self.config.cycle_ns;
        let now = clock::now();
        while self.next <= now {
            self.next += self.config.cycle_ns;
        }
    }

    /// Writes the Controlwords. Returns true if nothing more can be done.
    fn write_plain_words(&mut self, now: Nanos) -> bool {
        let since = self.plain.since.unwrap_or(now);
        let most_ns = ((self.plain.slowest_s + MARGIN_S) * 1e9) as Nanos;
        let over = now.saturating_sub(since) > most_ns;
        let mut ended = true;
        for (slot, rest) in self.axes.iter_mut().zip(&mut self.plain.rest) {
            let image = self.exchange.inputs();
            let word = slot
                .words
                .statusword(slot.bits.statusword.get(image) as u16);
            let word = Statusword::from_bits_retain(word);
            let powered = State::from_statusword(word).has_power();
            let position = slot.bits.position.map(|bits| bits.get(image));
            match position {
                Some(position) if position.abs_diff(rest.0) <= NOISE => {}
                _ => *rest = (position.unwrap_or(i64::MAX), now),
            }
            let stands = now.saturating_sub(rest.1) > STANDING && self.answer.inputs_fresh;
            // A Sercos drive removes its torque itself, once its brake has closed.
            let ends = matches!(slot.words, DriveWords::Sercos(_));
            let word = if !powered || stands && !ends || over {
                Controlword::DISABLE_VOLTAGE_COMMAND
            } else {
                Controlword::QUICK_STOP_COMMAND
            };
            ended &= !powered;
            let outputs = self.exchange.outputs_mut();
            let word = slot.words.control(word.bits()).word;
            slot.bits.controlword.set(outputs, i64::from(word));
        }
        // One more second for the drives to receive the Controlword.
        ended || now.saturating_sub(since) > most_ns + 1_000_000_000
    }

    fn publish_plain(&mut self, now: Nanos, ended: bool) {
        let snapshot = self.end.snapshots.input_buffer_mut();
        snapshot.time = now;
        snapshot.inputs_fresh = self.answer.inputs_fresh;
        snapshot.al_status = self.answer.al_status;
        snapshot.stopping = Some(StopCause::Panicked);
        snapshot.stop_ended = ended;
        snapshot.commands_taken = self.commands_taken;
        self.end.snapshots.publish();
    }
}
