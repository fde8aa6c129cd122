//! The values of the keys of a gateway and its nodes.

use ecaxis_esi as esi;
use ecaxis_sim::gateway::Epos;

use crate::config::fields::{Ns, Read, Value};
use crate::config::problem::{Problems, suggestion};
use crate::config::raw::RawEntry;
use crate::config::schema::{self, Schema};

use super::MS;

impl Read for Epos {
    fn read(value: Value<'_>, key: &str, p: &mut Problems<'_>) -> Option<Self> {
        let name = String::read(value, key, p)?;
        let found = Self::from_name(&name);
        if found.is_none() {
            let names = Self::ALL.iter().map(|drive| drive.name());
            let hint = suggestion(&name, names, "drives");
            p.add_hint(value.span(), format!("unknown drive `{name}`"), hint);
        }
        found
    }
}

impl Schema for Epos {
    fn schema() -> serde_json::Value {
        schema::words(Self::ALL.map(Self::name))
    }
}

/// A period in ms. 0: none.
#[derive(Debug)]
pub(crate) struct Heartbeat(pub(super) u16);

impl Read for Heartbeat {
    fn read(value: Value<'_>, key: &str, p: &mut Problems<'_>) -> Option<Self> {
        let ms = u16::try_from(Ns::read(value, key, p)? / MS).ok();
        let ms = ms.filter(|ms| *ms == 0 || *ms >= 10);
        if ms.is_none() {
            p.add(
                value.span(),
                "the period is 10 ms to 65 s, or \"0ms\" for none",
            );
        }
        ms.map(Self)
    }
}

impl Schema for Heartbeat {
    fn schema() -> serde_json::Value {
        Ns::schema()
    }
}

/// Index, subindex and bits of an object.
#[derive(Debug)]
pub(crate) struct MappableObject(pub(super) u16, pub(super) u8, pub(super) u8);

impl Read for MappableObject {
    const LIST: &'static str = RawEntry::LIST;

    fn read(value: Value<'_>, key: &str, p: &mut Problems<'_>) -> Option<Self> {
        let RawEntry { index, sub, .. } = RawEntry::read(value, key, p)?;
        let bits = Epos::mappable_bits(index, sub);
        if bits.is_none() {
            let message = format!("{} cannot be mapped", esi::address(index, sub));
            p.add(value.span(), message);
        }
        bits.map(|bits| Self(index, sub, bits))
    }
}

impl Schema for MappableObject {
    fn schema() -> serde_json::Value {
        RawEntry::schema()
    }
}
