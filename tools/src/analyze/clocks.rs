//! Distributed clocks of a recording: the reference clock against the recording's clock, and the
//! other devices' differences from it.

use std::collections::BTreeMap;

use hdrhistogram::Histogram;

/// The maximum number of devices with clocks.
const CLOCKS: usize = 1024;
/// Readings farther apart in ns are not used for jitter.
const APART_NS: u64 = 100_000_000;

/// Readings of the reference clock.
#[derive(Debug)]
pub struct Reference {
    pub station: u16,
    pub readings: u64,
    /// The time of the recording and of the reference clock at the first and last reading.
    pub first: (u64, u64),
    pub last: (u64, u64),
    /// The differences between intervals of the reference clock and of the recording in ns.
    pub jitter: Histogram<u64>,
}

/// Readings of a device's system time difference (0x092C).
#[derive(Debug)]
pub struct Difference {
    pub last: i64,
    pub readings: u64,
    /// The absolute values in ns.
    pub amounts: Histogram<u64>,
}

#[derive(Debug, Default)]
pub struct Clocks {
    pub reference: Option<Reference>,
    /// The differences by station address.
    pub differences: BTreeMap<u16, Difference>,
}

impl Clocks {
    /// Adds the reference clock's system time (0x0910), read at `at`.
    pub fn reference(&mut self, station: u16, at: u64, data: &[u8]) {
        let wide = data
            .first_chunk::<8>()
            .map(|bytes| u64::from_le_bytes(*bytes));
        let narrow = || {
            data.first_chunk::<4>()
                .map(|bytes| u64::from(u32::from_le_bytes(*bytes)))
        };
        let Some(mut time) = wide.or_else(narrow) else {
            return;
        };
        let fresh = Histogram::new(3).ok();
        match &mut self.reference {
            Some(reference) if reference.station == station => {
                let (host, before) = reference.last;
                if wide.is_none() {
                    // 32 bits wrap every 4.3 s.
                    let ahead = (time as u32).wrapping_sub(before as u32);
                    time = before.wrapping_add(u64::from(ahead));
                }
                let (host, before) = (at.saturating_sub(host), time.saturating_sub(before));
                if host > 0 && host < APART_NS && before < APART_NS {
                    let _ = reference.jitter.record(host.abs_diff(before));
                }
                reference.last = (at, time);
                reference.readings += 1;
            }
            slot => {
                if let Some(jitter) = fresh {
                    *slot = Some(Reference {
                        station,
                        readings: 1,
                        first: (at, time),
                        last: (at, time),
                        jitter,
                    });
                }
            }
        }
    }

    /// Adds a value of 0x092C: 31 bits, and a sign that is set if the local copy is greater.
    pub fn difference(&mut self, station: u16, raw: u32) {
        if self.differences.len() >= CLOCKS && !self.differences.contains_key(&station) {
            return;
        }
        let amount = u64::from(raw & 0x7fff_ffff);
        let signed = amount as i64;
        let Ok(amounts) = Histogram::new(3) else {
            return;
        };
        let difference = self.differences.entry(station).or_insert(Difference {
            last: 0,
            readings: 0,
            amounts,
        });
        difference.readings += 1;
        difference.last = if raw >> 31 == 0 { signed } else { -signed };
        let _ = difference.amounts.record(amount);
    }
}

impl Reference {
    /// Returns the deviation of the reference clock's rate from the recording's in ppm; `None`
    /// below 100 ms.
    pub fn rate_ppm(&self) -> Option<f64> {
        let host = self.last.0.checked_sub(self.first.0)?;
        let own = self.last.1.checked_sub(self.first.1)?;
        let ppm = (own as f64 - host as f64) / host as f64 * 1e6;
        (host >= 100_000_000 && ppm.abs() < 1e4).then_some(ppm)
    }
}
