//! What is done with start-up SDOs besides writing them.

use super::raw::{RawDevice, RawStartup};

/// How a device's start-up SDOs are sent.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Startup {
    all: StartupWay,
    /// What the file says otherwise of an object, by index and subindex.
    own: Vec<(u16, u8, StartupWay)>,
}

/// What is done beside writing an object.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct StartupWay {
    /// Read back and compared.
    pub verify: bool,
    /// Read before, and not written where the device holds the value.
    pub skip_equal: bool,
}

impl Startup {
    /// An SDO's own word counts before that of the whole list.
    pub(crate) fn of(raw: &RawDevice) -> Self {
        let way = |own: RawStartup| StartupWay {
            verify: own.verify.or(raw.startup.verify).unwrap_or(false),
            skip_equal: own.skip_equal.or(raw.startup.skip_equal).unwrap_or(false),
        };
        let own = raw
            .sdo
            .iter()
            .map(|sdo| (sdo.index, sdo.sub, way(sdo.startup)));
        Self {
            all: way(RawStartup::default()),
            own: own.collect(),
        }
    }

    /// Of an object. Orders to store and to restore parameters are no values: what is read of them is something else.
    #[must_use]
    pub fn way(&self, index: u16, sub: u8) -> StartupWay {
        if matches!(index, 0x1010 | 0x1011) {
            return StartupWay::default();
        }
        let own = self
            .own
            .iter()
            .rev()
            .find(|own| (own.0, own.1) == (index, sub));
        own.map_or(self.all, |own| own.2)
    }
}
