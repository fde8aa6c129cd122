//! Drives with several axes. The objects of each further axis are 0x800 later than those of the axis
//! before (CiA 402-1, multiple axes).
//!
//! ```
//! use ecaxis_esi::axis;
//!
//! assert_eq!(axis::object(0x6040, 1), 0x6840);
//! assert_eq!(axis::of(0x6840), Some((1, 0x6040)));
//! assert_eq!(axis::object(0x1018, 1), 0x1018); // all axes share it
//! ```

use std::borrow::Cow;

use crate::layout::{Field, Layout};
use crate::model::{Dictionary, Object};
use crate::select::Selection;
use crate::startup::StartupSdo;

/// The axes of a drive at most.
pub const MAX_AXES: u16 = 8;
const STRIDE: u16 = 0x800;
const FIRST_OBJECT: u16 = 0x6000;

/// Returns the index of an object of axis `axis`, counted from 0, from that of the first axis.
/// Objects that all axes share keep theirs.
#[must_use]
pub const fn object(index: u16, axis: u16) -> u16 {
    match of(index) {
        Some((0, _)) if axis < MAX_AXES => index + axis * STRIDE,
        _ => index,
    }
}

/// Returns the axis of an object, counted from 0, and the same object of the first axis. `None`: all
/// axes share the object.
#[must_use]
pub const fn of(index: u16) -> Option<(u16, u16)> {
    let Some(after) = index.checked_sub(FIRST_OBJECT) else {
        return None;
    };
    let axis = after / STRIDE;
    if axis < MAX_AXES {
        Some((axis, index - axis * STRIDE))
    } else {
        None
    }
}

/// The objects of CiA 402 that mean the same as IDNs of Sercos drives, with the same units. Only the
/// bits of control word and status word differ.
const SAME_AS_IDN: [(u16, u16); 11] = [
    (134, 0x6040),
    (135, 0x6041),
    (36, 0x60ff),
    (37, 0x60b1),
    (40, 0x606c),
    (47, 0x607a),
    (51, 0x6064),
    (80, 0x6071),
    (81, 0x60b2),
    (84, 0x6077),
    (189, 0x60f4),
];

/// Returns the object of CiA 402 that means the same as an IDN.
#[must_use]
pub fn same_as_idn(idn: u16) -> Option<u16> {
    let mut known = SAME_AS_IDN.iter();
    known.find(|(own, _)| *own == idn).map(|(_, same)| *same)
}

/// Returns the index that an object of this axis has in the first axis; `None` for an object of
/// another axis.
fn seen(index: u16, axis: u16) -> Option<u16> {
    match of(index) {
        Some((own, same)) => (own == axis).then_some(same),
        None => Some(index),
    }
}

impl Layout {
    /// Returns the process data as a drive with this axis alone has them: its objects have the
    /// indices of a first axis, the other axes have none. IDNs of a Sercos drive have the indices of
    /// the objects that mean the same; other IDNs are left out.
    #[must_use]
    pub fn of_axis(&self, axis: u16) -> Cow<'_, Self> {
        if axis == 0 && !self.idns {
            return Cow::Borrowed(self);
        }
        let seen = |field: &Field| match self.idns {
            true => same_as_idn(field.index).filter(|_| u16::from(field.sub) == axis),
            false => seen(field.index, axis),
        };
        let own = |fields: &[Field]| {
            let own = fields.iter().filter_map(|field| {
                let index = seen(field)?;
                Some(Field {
                    index,
                    sub: if self.idns { 0 } else { field.sub },
                    ..field.clone()
                })
            });
            own.collect()
        };
        Cow::Owned(Self {
            rx: own(&self.rx),
            tx: own(&self.tx),
            ..self.clone()
        })
    }
}

impl Dictionary {
    /// Returns the objects as a drive with this axis alone has them.
    #[must_use]
    pub fn of_axis(&self, axis: u16) -> Cow<'_, Self> {
        if axis == 0 {
            return Cow::Borrowed(self);
        }
        let own = self.objects.iter().filter_map(|object| {
            let index = seen(object.index, axis)?;
            Some(Object {
                index,
                ..object.clone()
            })
        });
        Cow::Owned(Self {
            objects: own.collect(),
        })
    }
}

impl Selection {
    /// Returns the selection as that of a drive with this axis alone. Its PDOs and modules stay.
    #[must_use]
    pub fn of_axis(&self, axis: u16) -> Cow<'_, Self> {
        if axis == 0 && !self.layout.idns {
            return Cow::Borrowed(self);
        }
        let startup = self.startup.iter().filter_map(|sdo| {
            let index = seen(sdo.index, axis)?;
            Some(StartupSdo {
                index,
                ..sdo.clone()
            })
        });
        Cow::Owned(Self {
            dictionary: self.dictionary.of_axis(axis).into_owned(),
            layout: self.layout.of_axis(axis).into_owned(),
            startup: startup.collect(),
            ..self.clone()
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// CiA 402-1, table of the object areas of logical devices: 0x6000–0x67FF, 0x6800–0x6FFF, … up to
    /// 0x9800–0x9FFF.
    #[test]
    fn areas_of_the_axes() {
        for (index, expected) in [
            (0x5fff, None),
            (0x6000, Some((0, 0x6000))),
            (0x67ff, Some((0, 0x67ff))),
            (0x6840, Some((1, 0x6040))),
            (0x7040, Some((2, 0x6040))),
            (0x9fff, Some((7, 0x67ff))),
            (0xa000, None),
        ] {
            assert_eq!(of(index), expected, "{index:#06x}");
            if let Some((axis, same)) = expected {
                assert_eq!(object(same, axis), index);
            }
        }
        assert_eq!(object(0x6040, 8), 0x6040);
    }
}
