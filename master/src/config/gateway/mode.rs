//! The modes of an axis behind a gateway, the process data that they need, and the objects that the
//! drive must hold.
//!
//! The gateway holds its outputs outside Op, and no reaction of it or of the drive depends on the
//! EtherCAT side. So only modes are possible in which a held set-point is a position: the axis is at
//! rest there.

use ecaxis_axis::units::{UserAcceleration, UserVelocity};
use ecaxis_axis::{Mode, Modes, VelocityUnit};
use ecaxis_esi as esi;

use super::{NodeSetup, PdoLink, RawNode};
use crate::config::problem::{Problems, suggestion};
use crate::config::{AxisSetup, UnitSource};

/// The modes after start.
const MODES: [esi::Mode; 2] = [esi::Mode::Csp, esi::Mode::Pp];

/// The set-point of position mode (−1), which does the work of CSP, and that of PP.
const POSITION_SETTING: u16 = 0x2062;
const TARGET_POSITION: u16 = 0x607a;
const CONTROLWORD: u16 = 0x6040;

fn maps(link: &PdoLink, index: u16) -> bool {
    link.contents.iter().any(|object| object.0 == index)
}

/// Returns the output PDO whose Controlword arrives first. Of frames that wait at the same time, the
/// one with the lowest identifier is sent first.
fn first_controlword(node: &NodeSetup) -> Option<&PdoLink> {
    let links = node.outputs.iter();
    links
        .filter(|link| maps(link, CONTROLWORD))
        .min_by_key(|link| link.pdo)
}

/// True if the node can run in this mode.
fn serves(node: &NodeSetup, mode: esi::Mode) -> bool {
    match mode {
        esi::Mode::Csp => node.outputs.iter().any(|link| maps(link, POSITION_SETTING)),
        // The target must not arrive after the edge of Controlword bit 4.
        esi::Mode::Pp => first_controlword(node).is_some_and(|link| maps(link, TARGET_POSITION)),
        _ => false,
    }
}

/// Returns the mode after start, or reports what is missing.
pub(super) fn start(raw: &RawNode, node: &NodeSetup, p: &mut Problems<'_>) -> Option<esi::Mode> {
    let mode = chosen(raw, p)?;
    let layout = &node.selection.layout;
    let needed = [
        (true, CONTROLWORD, "Controlword"),
        (true, 0x6060, "modes of operation, in PDO 3"),
        (false, 0x6041, "Statusword"),
        (false, 0x6064, "position actual value"),
        (false, 0x6061, "modes of operation display, in PDO 3"),
    ];
    let lacks = |(output, index, _): &(bool, u16, &str)| match output {
        true => layout.rx_field(*index, 0).is_none(),
        false => layout.tx_field(*index, 0).is_none(),
    };
    let (target, what) = match mode {
        esi::Mode::Pp => (
            TARGET_POSITION,
            "target position, in the first PDO with a Controlword",
        ),
        _ => (POSITION_SETTING, "position mode setting value"),
    };
    let lacking = needed.into_iter().find(lacks);
    let lacking = lacking.or((!serves(node, mode)).then_some((true, target, what)));
    let Some((output, index, what)) = lacking else {
        return Some(mode);
    };
    let way = if output { "outputs" } else { "inputs" };
    let message = format!(
        "an axis behind a gateway needs {} ({what}) in the `{way}` of its node",
        esi::address(index, 0)
    );
    let hint = match mode {
        esi::Mode::Pp => {
            "its mode is \"pp\": PDO 1 with Controlword and 0x607A, PDO 3 for the mode"
        }
        _ => "its mode is \"csp\": PDO 1 with Controlword and 0x2062, PDO 3 for the mode",
    };
    p.add_hint(raw.span.clone(), message, hint);
    None
}

fn chosen(raw: &RawNode, p: &mut Problems<'_>) -> Option<esi::Mode> {
    let Some(text) = &raw.mode else {
        return Some(esi::Mode::Csp);
    };
    let names = MODES.iter().map(|mode| mode.name());
    match text.get_ref().parse::<esi::Mode>() {
        Ok(mode) if MODES.contains(&mode) => Some(mode),
        Ok(mode) => {
            let message = format!(
                "mode \"{mode}\" is not safe behind a gateway: it holds its outputs outside Op, and the \
                 drive would go on"
            );
            let hint = "write `mode = \"csp\"`, in which `velocity` steps are possible";
            p.add_hint(text.span(), message, hint);
            None
        }
        Err(_) => {
            let message = format!("unknown mode \"{}\"", text.get_ref());
            p.add_hint(
                text.span(),
                message,
                suggestion(text.get_ref(), names, "modes"),
            );
            None
        }
    }
}

/// Sets the units of these drives, which count rpm and rpm/s.
pub(super) fn adopt_units(setup: &mut AxisSetup) {
    if setup.velocity_unit_from != UnitSource::Nothing {
        return;
    }
    let scale = setup.config.scale.with_velocity_unit(VelocityUnit::RPM);
    setup.config.scale = scale;
    (setup.velocity_unit_from, setup.acceleration_unit_from) = (UnitSource::Esi, UnitSource::Esi);
    if let Some(homing) = &mut setup.homing {
        homing.rescale(&scale, 0);
    }
}

/// Returns the modes to which the axis can switch.
pub(super) fn modes(node: &NodeSetup, own: Mode) -> Modes {
    let served = MODES.into_iter().filter(|mode| serves(node, *mode));
    let modes = served.map(|mode| Mode::from_code(mode.code()));
    modes.fold(Modes::only(own), Modes::with).with(Mode::Hm)
}

/// Returns the objects that the drive must hold: those of homing, and the profile of PP, which takes
/// the limits of the axis because no PDO can carry it.
pub(super) fn objects(setup: &AxisSetup) -> Vec<(u16, u8, Vec<u8>)> {
    let homing = setup.homing.iter().flat_map(|homing| &homing.startup);
    let mut objects: Vec<_> = homing
        .map(|sdo| (sdo.index, sdo.sub, sdo.data.clone()))
        .collect();
    if setup.config.modes.contains(Mode::Pp) {
        let (scale, limits) = (&setup.config.scale, &setup.config.limits);
        let speed = scale.velocity_to_raw(UserVelocity(limits.velocity)).0;
        let ramp = scale
            .acceleration_to_raw(UserAcceleration(limits.acceleration))
            .0;
        let values = [
            (0x6081, speed.unsigned_abs()),
            (0x6083, ramp),
            (0x6084, ramp),
        ];
        let bytes = values.map(|(index, value)| (index, 0, value.max(1).to_le_bytes().to_vec()));
        objects.extend(bytes);
    }
    objects
}
