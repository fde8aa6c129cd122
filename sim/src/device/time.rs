//! What a device does by itself, in the order of its clock; and until when it does nothing, so that nobody has to ask.

use super::SimDevice;
use super::application::Application;
use super::mailbox::Mailbox;
use crate::Nanos;
use crate::drive::Drive;
use crate::frame::Datagram;

/// Devices that live their lives together.
const TOGETHER: usize = 4;

/// What need not be asked of a device again while neither its time nor a frame has come.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Rest {
    /// Before this true time nothing happens in it by itself.
    wake: Nanos,
    /// Where it is addressed, if that is known and datagrams to other addresses leave it as it is.
    addresses: Option<(u16, Option<u16>)>,
    /// When the last frame passed that left it as it is.
    passed: Option<Nanos>,
}

/// How far a device has come.
enum Run {
    /// A drive's control cycle is over: its motor is to turn before [`SimDevice::tick`] goes on.
    Control,
    /// As far as it was to; before this true time nothing happens in it by itself.
    Until(Nanos),
}

impl SimDevice {
    /// Lets the device live up to `now`. Allocates only for mailbox traffic and state changes.
    pub(crate) fn advance(&mut self, now: Nanos) {
        Self::advance_together(std::slice::from_mut(self), &mut [Rest::default()], |_| now);
    }

    /// As [`SimDevice::advance`] of each, the n-th up to `until(n)`.
    pub(crate) fn advance_together(
        devices: &mut [Self],
        rests: &mut [Rest],
        until: impl Fn(usize) -> Nanos,
    ) {
        let all = devices.chunks_mut(TOGETHER).zip(rests.chunks_mut(TOGETHER));
        for (chunk, (devices, rests)) in all.enumerate() {
            loop {
                let mut controls = [false; TOGETHER];
                let each = devices.iter_mut().zip(&mut *rests).zip(&mut controls);
                for (n, ((device, rest), controls)) in each.enumerate() {
                    let until = until(chunk * TOGETHER + n);
                    if rest.wake > until {
                        continue;
                    }
                    device.disturb(rest);
                    match device.run(until) {
                        Run::Control => *controls = true,
                        Run::Until(next) => rest.wake = next,
                    }
                }
                if controls == [false; TOGETHER] {
                    break;
                }
                let mut drives = devices.iter_mut().zip(controls).map(|(device, controls)| {
                    match &mut device.application {
                        Application::Drive(drive) if controls => Some(&mut **drive),
                        _ => None,
                    }
                });
                Drive::turn(std::array::from_fn(|_| drives.next().flatten()));
                for (device, _) in devices.iter_mut().zip(controls).filter(|(_, c)| *c) {
                    device.tick();
                }
            }
        }
    }

    /// Lives up to `now`, or until a drive's motor is to turn before [`SimDevice::tick`] goes on.
    fn run(&mut self, now: Nanos) -> Run {
        if !self.powered {
            let turns = self.coast(now);
            return Run::Until(if turns {
                now.saturating_add(1)
            } else {
                Nanos::MAX
            });
        }
        let mut local = self.esc.clock.local(now);
        loop {
            let sync = self.esc.dc.as_ref().map_or(u64::MAX, |dc| dc.sync.due());
            let (eeprom, watchdog) = (self.esc.eeprom.due(), self.esc.watchdog.due());
            let pdi = self.esc.pdi_watchdog_due();
            let (tick, mailbox, al) = if self.application_runs() {
                let mailbox = self.mailbox.as_ref().filter(|_| !self.mailbox_silent);
                let mailbox = mailbox.map_or(u64::MAX, Mailbox::due);
                (self.tick, mailbox, self.al.due)
            } else {
                (u64::MAX, u64::MAX, u64::MAX)
            };
            let own = tick.min(mailbox).min(al);
            let restarted = match self.restarts_until {
                Some(until) if !self.hangs => until,
                _ => u64::MAX,
            };
            let own = own.min(restarted);
            let due = sync.min(eeprom).min(watchdog).min(pdi).min(own);
            if due > local {
                return Run::Until(now.saturating_add(self.esc.clock.at_least(due - local)));
            }
            self.local = due;
            if due == restarted {
                self.restarted(due);
            } else if due == sync {
                let edges = self.esc.fire_sync(due);
                self.synchronized(edges);
            } else if due == tick {
                if let Application::Drive(drive) = &mut self.application {
                    drive.begin_control(&self.store);
                    return Run::Control;
                }
                self.tick();
            } else if due == watchdog {
                self.watchdog_expired();
            } else if due == eeprom {
                self.eeprom_finished(due);
            } else if due == mailbox {
                self.show();
                self.serve_mailbox(due);
            } else if due == al {
                self.show();
                self.al_step(due);
                if self.starts_new_program() {
                    self.reset(due);
                    // Its clock started anew.
                    local = self.esc.clock.local(now);
                }
            } else {
                self.esc.expire_pdi_watchdog();
            }
        }
    }

    /// Something is about to happen in the device that nobody foresaw.
    pub(crate) fn disturb(&mut self, rest: &mut Rest) {
        if let Some(at) = std::mem::take(rest).passed {
            self.local = self.esc.clock.local(at);
        }
    }

    /// Whether a frame that is here at `now` leaves the device as it is and is left as it is, as all its datagrams go to
    /// other stations.
    pub(crate) fn is_passed(
        &self,
        rest: &mut Rest,
        frame: &[u8],
        datagrams: &[Datagram],
        now: Nanos,
    ) -> bool {
        if rest.addresses.is_none() {
            let quiet = !self.was_reset && !self.application.samples_at_frames();
            rest.addresses = self.esc.addresses().filter(|_| quiet);
        }
        let passed = rest.addresses.is_some_and(|(station, alias)| {
            let mut to = datagrams.iter().map(|datagram| datagram.adp(frame));
            !to.any(|to| to == station || Some(to) == alias)
        });
        if passed {
            rest.passed = Some(now);
        }
        passed
    }
}
