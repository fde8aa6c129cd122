//! Timed events of a device in the order of its clock. Idle times are cached, so idle devices are
//! skipped.

use super::SimDevice;
use super::mailbox::Mailbox;
use crate::Nanos;
use crate::drive::Drive;
use crate::frame::Datagram;

/// Number of devices that advance together.
const TOGETHER: usize = 4;

/// Cached facts about a device. They stay valid until a timed event or a frame for the device.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Rest {
    /// No timed event occurs before this true time.
    wake: Nanos,
    /// Station address and alias, if known and if frames to other addresses do not affect the
    /// device.
    addresses: Option<(u16, Option<u16>)>,
    /// The true time of the last frame that did not affect the device.
    passed: Option<Nanos>,
}

/// The progress of a device.
enum Run {
    /// A control cycle of a drive is over. Its motor must turn before [`SimDevice::tick`]
    /// continues.
    Control,
    /// The device has reached the requested time. No timed event occurs before this true time.
    Until(Nanos),
}

impl SimDevice {
    /// Advances the device to `now`. Allocates only for mailbox traffic and state changes.
    pub(crate) fn advance(&mut self, now: Nanos) {
        Self::advance_together(std::slice::from_mut(self), &mut [Rest::default()], |_| now);
    }

    /// Advances several devices, the n-th to `until(n)`.
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
                    let drives = device.application.drives_mut();
                    drives.first_mut().filter(|_| controls)
                });
                Drive::turn(std::array::from_fn(|_| drives.next().flatten()));
                for (device, _) in devices.iter_mut().zip(controls).filter(|(_, c)| *c) {
                    device.tick();
                }
            }
        }
    }

    /// Runs to `now`, or until the motor of a drive must turn before [`SimDevice::tick`] continues.
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
                let drives = self.application.drives_mut();
                if drives.is_empty() {
                    self.tick();
                } else {
                    for drive in drives {
                        drive.begin_control(&self.store);
                    }
                    return Run::Control;
                }
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
                    // The reset restarted the clock.
                    local = self.esc.clock.local(now);
                }
            } else {
                self.esc.expire_pdi_watchdog();
            }
        }
    }

    /// Drops the cached facts before an event that they do not cover.
    pub(crate) fn disturb(&mut self, rest: &mut Rest) {
        if let Some(at) = std::mem::take(rest).passed {
            self.local = self.esc.clock.local(at);
        }
    }

    /// True if a frame at `now` does not affect the device and is not changed by it, because all
    /// datagrams address other stations.
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
