//! The cycle's I/O: sends and receives frames, and keeps their release in phase.

use super::{DropCause, Engine};
use crate::clock::{self, Nanos};
use crate::link::LinkError;
use crate::rt::channel::Event;
use crate::rt::common_time::{Jump, Observed};
use crate::rt::event_log::LogEntryKind;
use crate::rt::exchange::{ExchangeMode, Received};
use crate::rt::reaction_group::ReactionGroup;

/// Frames received in a row without reading the clock; more than one cycle and one mailbox ever
/// bring.
const FRAMES_AT_ONCE: usize = 32;

impl Engine {
    pub(super) fn send(&mut self, lateness: Nanos) {
        let sent = self.exchange.send(self.link.as_mut(), lateness);
        self.note(sent);
        // One frame with mailbox and other datagrams follows the cyclic ones.
        let sent = self.port.send_one(self.link.as_mut());
        self.note(sent);
    }

    fn note(&mut self, result: Result<(), LinkError>) {
        if result.is_err() {
            self.stats.counters.link_errors += 1;
            self.log(LogEntryKind::LinkError);
        }
    }

    /// Receives until the due frames are back or three quarters of the cycle are over. In pipelined
    /// mode, takes only the frames that have already arrived.
    pub(super) fn receive(&mut self, woke: Nanos) {
        let released = self.next;
        self.round_trip = None;
        let quarter = self.config.cycle_ns / 4;
        // After a late wake-up the frames still get time to return.
        let deadline = (released + 3 * quarter).max(woke + quarter);
        loop {
            for _ in 0..FRAMES_AT_ONCE {
                match self.link.recv(&mut self.buf) {
                    Ok(Some(len)) => self.dispatch_frame(len),
                    Ok(None) => break,
                    Err(error) => {
                        self.note(Err(error));
                        break;
                    }
                }
            }
            if self.exchange.mode() == ExchangeMode::Pipelined {
                return;
            }
            let now = clock::now();
            if self.exchange.complete() {
                let round_trip = now.saturating_sub(released);
                self.round_trip = Some(round_trip);
                self.stats.round_trip.record(round_trip);
                return;
            }
            if now >= deadline {
                return;
            }
            self.clock.relax(
                self.link
                    .next_arrival()
                    .map_or(deadline, |at| at.min(deadline)),
            );
        }
    }

    fn dispatch_frame(&mut self, len: usize) {
        let frame = &self.buf[..len];
        match self.exchange.receive(frame) {
            Received::Current => {}
            Received::Late => {
                self.stats.counters.late_frames += 1;
                self.log(LogEntryKind::Late);
            }
            Received::NotOurs => self.port.receive(frame),
        }
    }

    pub(super) fn update_counters(&mut self) {
        let others = self.link.main_devices();
        let more = others.saturating_sub(std::mem::replace(&mut self.main_devices, others));
        if more > 0 {
            self.log(LogEntryKind::OtherMainDevice(more));
        }
        if self.guarding {
            if !self.answer.complete {
                self.stats.counters.lost_frames += 1;
                self.log(LogEntryKind::Lost);
            } else if !self.answer.inputs_fresh {
                self.stats.counters.wkc_errors += 1;
                let (seen, expected) = self.answer.wkc;
                self.log(LogEntryKind::WorkingCounter(seen, expected));
            }
            if let Some((status, answered)) = self.answer.al_status
                && self.al_status.replace((status, answered)) != Some((status, answered))
            {
                self.log(LogEntryKind::AlStatus(status, answered));
            }
            self.watch_clock();
        }
        self.stats.counters.refused_answers = self.port.refused - self.refused_before;
    }

    /// Checks the difference of one clock. An offset outside the window is reported once. The
    /// report is re-armed when the offset falls well inside the window.
    fn watch_clock(&mut self) {
        let Some((device, difference_ns)) = self.exchange.clock_read() else {
            return;
        };
        // The clock of a lost device is set as it returns.
        let group = self.config.devices.get(device).map(|data| data.group);
        let group = group.and_then(|group| self.groups.get(group));
        let stop = group.and_then(ReactionGroup::stop);
        if stop.is_some_and(|stop| stop.cause.is_failure()) {
            return;
        }
        let Some(off) = self.clocks_off.get_mut(device) else {
            return;
        };
        let amount = u64::from(difference_ns.unsigned_abs());
        if amount > self.config.clock_window_ns && !*off {
            *off = true;
            let cycle = self.stats.counters.cycles;
            self.report(Event::ClockOff {
                cycle,
                device,
                difference_ns,
            });
        } else if amount <= self.config.clock_window_ns / 2 {
            *off = false;
        }
    }

    /// Returns the correction to the next cycle in ns.
    pub(super) fn follow_clock(&mut self) -> i64 {
        let reference = self.exchange.reference();
        let delivers = self.answer.system_time.is_some();
        if let Some(device) = reference.filter(|_| delivers && reference != self.reference) {
            let cycle = self.stats.counters.cycles;
            self.reference = reference;
            self.report(Event::ReferenceReplaced { cycle, device });
        }
        let Some(phase) = &mut self.phase else {
            return 0;
        };
        let Some(system_time) = self.answer.system_time else {
            return phase.holdover();
        };
        let before = phase.locked();
        let answer = &self.answer;
        let step = phase.update(system_time, answer.sent_at, answer.sent_late);
        let now_locked = phase.locked();
        self.phase_error = step.error;
        if now_locked {
            self.stats.phase.record(step.error.unsigned_abs());
        }
        let cycle = self.stats.counters.cycles;
        match (before, now_locked) {
            (false, true) => self.report(Event::PhaseLocked { cycle }),
            (true, false) => self.report(Event::PhaseLost { cycle }),
            _ => {}
        }
        step.adjust
    }

    /// Measures common time, and corrects the reference clock if SYNC0 is aligned.
    pub(super) fn follow_common_time(&mut self) {
        let reference = self.exchange.reference();
        if let Some((device, offset)) = self.exchange.take_offset()
            && Some(device) == reference
        {
            self.common.take_offset(device, offset);
        }
        let jump = self.common.update(&Observed {
            reference,
            system_time: self.answer.system_time,
            offset_taken: self.answer.offset_taken,
            sent_at: self.answer.sent_at,
        });
        if let Some(Jump { by_ns }) = jump {
            let cycle = self.stats.counters.cycles;
            self.drop_deferred(DropCause::Jumped);
            self.report(Event::CommonTimeJumped { cycle, by_ns });
        }
        if !self.common.locked() {
            self.drop_deferred(DropCause::Unlocked);
        }
        self.exchange
            .want_offset(self.common.wanted_offset(reference));
        self.exchange
            .set_reference_offset(self.common.offset(reference));
    }
}
