//! Options for start-up SDOs besides writing them.

use ecaxis_esi::StartupSdo;

use super::raw::RawDevice;

/// The options of a device's start-up SDOs.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Startup {
    all: StartupOptions,
    /// Options in the file for single objects, by index and subindex.
    own: Vec<(u16, u8, StartupOptions)>,
}

/// What is done in addition to writing an object.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct StartupOptions {
    /// Reads the object back and compares.
    pub verify: bool,
    /// Reads the object first and skips the write if the value is equal.
    pub skip_equal: bool,
}

impl Startup {
    /// Returns the options of a device. An SDO's own options override the device's.
    pub(crate) fn of(raw: &RawDevice) -> Self {
        let all = StartupOptions {
            verify: raw.startup.verify.unwrap_or(false),
            skip_equal: raw.startup.skip_equal.unwrap_or(false),
        };
        let own = raw.sdo.iter().map(|sdo| {
            let (index, sub) = sdo.address();
            let options = StartupOptions {
                verify: sdo.verify.unwrap_or(all.verify),
                skip_equal: sdo.skip_equal.unwrap_or(all.skip_equal),
            };
            (index, sub, options)
        });
        let own = own.collect();
        Self { all, own }
    }

    /// Reads objects of derived start-up SDOs back, unless the file has options for them.
    pub(crate) fn verify(&mut self, derived: &[StartupSdo]) {
        for sdo in derived {
            let options = StartupOptions {
                verify: true,
                ..self.all
            };
            // The last options win, and an `sdo` entry has precedence.
            self.own.insert(0, (sdo.index, sdo.sub, options));
        }
    }

    /// Returns the options of IDNs (SoE).
    #[must_use]
    pub fn of_idns(&self) -> StartupOptions {
        self.all
    }

    /// Returns the options of an object. Store and restore parameters (0x1010, 0x1011) read back
    /// other values than written, so they have none.
    #[must_use]
    pub fn way(&self, index: u16, sub: u8) -> StartupOptions {
        if matches!(index, 0x1010 | 0x1011) {
            return StartupOptions::default();
        }
        let own = self
            .own
            .iter()
            .rev()
            .find(|own| (own.0, own.1) == (index, sub));
        own.map_or(self.all, |own| own.2)
    }
}
