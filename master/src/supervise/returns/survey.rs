//! Compares the devices that answer with those of the machine file.

use std::collections::BTreeMap;

use ecaxis_ecat::index::{DeviceIndex, IndexVec};
use ecaxis_ecat::registers;

use super::unknown::UnknownDevices;
use super::{RunningSegment, STEP, Search};
use crate::acyclic::enumerate;
use crate::acyclic::topology::{ParentPort, in_line, parents};
use crate::bringup::accepts;
use crate::config::Locator;
use crate::link::redundant::RingState;
use crate::report::{Cause, DevicePlace, Error};

/// A device that answers.
#[derive(Debug, Clone, Copy)]
struct Answering {
    /// The device of the machine file with its station address.
    device: Option<DeviceIndex>,
    parent: Option<ParentPort>,
}

impl RunningSegment {
    /// Reads the segment. Identifies devices without an address of the machine, as far as they are
    /// behind one of the machine. Returns those of `wanted` that are there; others are reported.
    /// `lost`: all missing devices, also those that must not return now.
    pub(super) async fn survey(
        &self,
        (wanted, lost): (&[DeviceIndex], &[DeviceIndex]),
        searches: &mut IndexVec<DeviceIndex, Search>,
        unknown: &mut UnknownDevices,
    ) -> Result<Vec<DeviceIndex>, Error> {
        let count = enumerate::count(&self.wire).await?;
        unknown.begin_survey(count);
        if usize::from(count) <= self.devices.len().saturating_sub(lost.len()) {
            unknown.end_survey();
            return Ok(Vec::new());
        }
        let words = async |register| enumerate::words(&self.wire, count, STEP, register).await;
        let stations = words(registers::STATION_ADDRESS).await?;
        let status = words(registers::DL_STATUS).await?.into_iter().zip(0..);
        let ring = self.wire.ring();
        let after_gap = match ring {
            Some(RingState::Broken { behind, devices })
                if usize::from(devices) < self.devices.len() =>
            {
                Some(behind)
            }
            _ => None,
        };
        let status = status.map(|(status, at)| in_line(at, status, ring));
        let own: BTreeMap<_, _> = self
            .devices
            .enumerate()
            .map(|(d, at)| (at.at.station, d))
            .collect();
        let answering = stations.iter().zip(parents(status));
        let mut answering: Vec<_> = answering
            .map(|(station, parent)| Answering {
                device: own.get(station).copied(),
                parent,
            })
            .collect();
        // Some have been connected since they were asked: the next search asks them again.
        let connected = |seen: &Answering| seen.device.is_some_and(|d| wanted.contains(&d));
        if answering.iter().any(connected) {
            return Ok(Vec::new());
        }
        let mut found = Vec::new();
        for (position, index) in (0..count).zip(0..) {
            let Some(&Answering {
                device: None,
                parent,
            }) = answering.get(index)
            else {
                continue;
            };
            let before = parent.map(|port| {
                let device = answering.get(usize::from(port.device));
                (device.and_then(|seen| seen.device), port.port)
            });
            // Behind a gap of a ring, the first device may be any of those that are missing.
            if after_gap.is_some_and(|after| position >= after) {
                continue;
            }
            // Behind a device that is unknown itself: that one is reported.
            let place = match before {
                None => None,
                Some((Some(device), port)) => Some((device, port)),
                Some((None, _)) => continue,
            };
            let locator = |index: DeviceIndex| self.machine.devices[index].at;
            let here = |index: &DeviceIndex| {
                let in_segment = matches!(locator(*index), Locator::Behind(..));
                !in_segment
                    && searches[*index].place.is_some_and(|before| match place {
                        None => before.parent.is_none() && before.position == position,
                        place => before.parent == place,
                    })
            };
            // The device that was here comes first. Others are found by alias or identification.
            let all: Vec<_> = self.devices.enumerate().map(|(device, _)| device).collect();
            let in_segment = self.find_in_segment(&answering, index, &all);
            // It is not known yet that it was lost, or an attempt to bring it back still runs.
            if in_segment.is_some_and(|device| !wanted.contains(&device)) {
                continue;
            }
            let expected = in_segment.or_else(|| wanted.iter().copied().find(here));
            let moved = wanted.iter().copied().filter(|index| {
                let has_number = matches!(locator(*index), Locator::Alias(_) | Locator::Id(_));
                has_number && Some(*index) != expected
            });
            let waiting = lost.iter().filter(|index| !wanted.contains(index));
            let waiting: Vec<_> = waiting.map(|index| (*index, here(index))).collect();
            let candidates: Vec<_> = expected.into_iter().chain(moved).collect();
            if expected.is_none() && !unknown.is_due(place) {
                continue;
            }
            match self.identify(&candidates, searches, position).await {
                Ok(Ok(device)) => {
                    let search = &mut searches[device];
                    search.restarted = true;
                    search.place = Some(DevicePlace {
                        position,
                        parent: place,
                    });
                    unknown.remove(place);
                    if let Some(seen) = answering.get_mut(index) {
                        seen.device = Some(device);
                    }
                    found.push(device);
                }
                Ok(Err((numbers, error))) => {
                    // It must not return now; the reason has been reported.
                    let waits = |(index, is_here): &(DeviceIndex, bool)| {
                        let serial = searches[*index].serial;
                        let is_same = serial != 0 && serial == numbers.serial;
                        let config = &self.machine.devices[*index];
                        (is_same || *is_here) && accepts(config, numbers.identity)
                    };
                    if expected.is_none() && waiting.iter().any(waits) {
                        continue;
                    }
                    if let (Some(device), Some(error)) = (expected, error) {
                        self.refuse(device, &mut searches[device], &error);
                    }
                    // A device of the machine behind it would be cut off.
                    let leads_on = leads_to_known(&answering, index);
                    unknown.add(self, place, Some(numbers), leads_on).await?;
                }
                Err(error) => match expected {
                    Some(device) => self.refuse(device, &mut searches[device], &error),
                    // Not in Init, or its EEPROM is unreadable: it has no identity.
                    None if matches!(*error.cause, Cause::Datagram(_)) => return Err(error),
                    None => {
                        let leads_on = leads_to_known(&answering, index);
                        unknown.add(self, place, None, leads_on).await?;
                    }
                },
            }
        }
        unknown.end_survey();
        Ok(found)
    }
}

impl RunningSegment {
    /// Returns the device that the file locates at this place behind the head of a segment.
    fn find_in_segment(
        &self,
        answering: &[Answering],
        index: usize,
        wanted: &[DeviceIndex],
    ) -> Option<DeviceIndex> {
        let devices = &self.machine.devices;
        let parent = |at: usize| Some(usize::from(answering.get(at)?.parent?.device));
        let above = std::iter::successors(parent(index), |at| parent(*at));
        let mut heads = above.filter_map(|at| Some((devices[answering.get(at)?.device?].at, at)));
        heads.find_map(|(head, at)| {
            let place = index - at;
            let mut wanted = wanted.iter().copied();
            wanted.find(|device| match devices[*device].at {
                Locator::Behind(of, n) => of.locator() == head && usize::from(n) == place,
                _ => false,
            })
        })
    }
}

/// True if a device of the machine is behind this one.
fn leads_to_known(answering: &[Answering], index: usize) -> bool {
    let above = |of: usize| {
        let parent = answering.get(of).and_then(|seen| seen.parent);
        parent.map(|port| usize::from(port.device))
    };
    let behind =
        |at: usize| std::iter::successors(above(at), |of| above(*of)).any(|of| of == index);
    let known = answering
        .iter()
        .enumerate()
        .filter(|(_, seen)| seen.device.is_some());
    known.map(|(at, _)| at).any(behind)
}
