//! The limit of torques in modes in which the drive computes them: `limits.torque` as 0x6072, or as
//! 0x60E0 and 0x60E1.

use ecaxis_axis::Mode;
use ecaxis_esi as esi;
use ecaxis_esi::{ObjectItem, Writable};

use super::super::problem::Problems;
use super::super::raw::{RawAxis, RawSdo};
use super::super::{AxisSetup, sdo};
use super::control::startup_sdo;

/// The objects that limit torques in both directions together, and in each direction.
const LIMITS: [&[u16]; 2] = [&[0x6072], &[0x60e0, 0x60e1]];

/// The modes in which the drive computes torques.
const MODES: [Mode; 4] = [Mode::Csp, Mode::Csv, Mode::Pp, Mode::Pv];

/// What `limits.torque` does in modes other than CST.
#[derive(Debug, Clone, Default, PartialEq)]
pub enum TorqueLimit {
    /// The file has no limit, or the axis has no such mode.
    #[default]
    NotNeeded,
    /// Written to the drive and read back.
    Written(Vec<esi::StartupSdo>),
    /// The drive does not receive it.
    NotEffective { reason: &'static str },
}

impl TorqueLimit {
    pub(crate) fn startup(&self) -> &[esi::StartupSdo] {
        match self {
            Self::Written(startup) => startup,
            Self::NotNeeded | Self::NotEffective { .. } => &[],
        }
    }

    /// Returns the note of a limit without effect.
    #[must_use]
    pub fn note(&self) -> Option<String> {
        match self {
            Self::NotEffective { reason } => {
                Some(format!("`limits.torque` acts in CST only: {reason}"))
            }
            Self::NotNeeded | Self::Written(_) => None,
        }
    }
}

/// Returns the value of a limit object: thousandths of rated torque.
fn value(percent: f64) -> Vec<u8> {
    // `as` saturates; the value is positive.
    ((percent * 10.0).round() as u16).to_le_bytes().to_vec()
}

/// Returns what the limit does, and its start-up SDOs. `selection`: as that of a drive with this
/// axis alone.
pub(crate) fn torque_limit(
    raw: &RawAxis,
    setup: &AxisSetup,
    sdos: &[RawSdo],
    selection: &esi::Selection,
    p: &mut Problems<'_>,
) -> TorqueLimit {
    let in_drive = raw.torque_limit_in_drive.as_ref();
    let in_drive = in_drive.filter(|in_drive| *in_drive.get_ref());
    let Some(limit) = &raw.limits.torque else {
        if let Some(key) = in_drive {
            let message = "`limits.torque` is missing, which the drive is to have";
            p.add_hint(key.span(), message, "add `torque = 100.0` to `limits`");
        }
        return TorqueLimit::NotNeeded;
    };
    if !MODES.iter().any(|mode| setup.config.modes.contains(*mode)) {
        return TorqueLimit::NotNeeded;
    }
    let dictionary = &selection.dictionary;
    let data = value(setup.config.limits.torque);
    let mut all = LIMITS.into_iter().flatten();
    if all.any(|index| sdos.iter().any(|sdo| sdo.index == *index)) {
        // Smaller values of the file are reported with the drive's limits.
        let number = |data: &[u8]| sdo::little_endian(data, false);
        let is_limit = |own: &esi::StartupSdo| number(&own.data) <= number(&data);
        let own = |indices: &[u16]| {
            let mut found = indices.iter().map(|index| {
                let mut all = selection.startup.iter().rev();
                all.find(|own| own.index == *index)
            });
            found.all(|own| own.is_some_and(is_limit))
        };
        return match LIMITS.into_iter().any(own) {
            true => TorqueLimit::NotNeeded,
            false => TorqueLimit::NotEffective {
                reason: "an `sdo` entry lets the drive have more",
            },
        };
    }
    let Some(in_drive) = in_drive else {
        return TorqueLimit::NotEffective {
            reason: "no `torque_limit_in_drive`",
        };
    };
    let item = |index: &u16| dictionary.item(*index, 0).filter(|item| is_writable(item));
    let Some(indices) = LIMITS
        .into_iter()
        .find(|indices| indices.iter().all(|index| item(index).is_some()))
    else {
        let message = "the ESI has neither 0x6072 nor 0x60E0 and 0x60E1 to write";
        let hint = "remove the key: the drive has its torque limit elsewhere";
        p.add_hint(in_drive.span(), message, hint);
        return TorqueLimit::NotNeeded;
    };
    for index in indices {
        let problem = item(index).and_then(|item| sdo::outside_esi_range(item, &data));
        if let Some(problem) = problem {
            let message = format!("{}: {problem}", esi::address(*index, 0));
            p.add_hint(
                limit.span(),
                message,
                "lower `limits.torque`: the object has thousandths of rated torque",
            );
        }
    }
    let startup = indices.iter().map(|index| {
        let origin = "`limits.torque` of the machine file";
        let sdo = startup_sdo(selection, (*index, 0), data.clone(), origin);
        esi::StartupSdo {
            index: esi::axis::object(*index, setup.number),
            optional: true,
            ..sdo
        }
    });
    TorqueLimit::Written(startup.collect())
}

fn is_writable(item: &ObjectItem) -> bool {
    match item.access.write {
        Writable::Never => false,
        Writable::Always => true,
        Writable::Only { pre_op, .. } => pre_op,
    }
}

impl AxisSetup {
    /// Converts the SDOs of the limit to the motor's rated torque.
    pub(in super::super) fn rescale_torque_limit(&mut self) {
        let data = value(self.config.limits.torque);
        if let TorqueLimit::Written(startup) = &mut self.torque_limit {
            for sdo in startup {
                sdo.data.clone_from(&data);
            }
        }
    }
}
