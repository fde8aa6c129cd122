//! The causes: a fault script or keys of the bus for each, and what each axis must do then.

use super::features::{Axis, BUDDY, EMERGENCY, Feature, HOLD, IO, Role, WITNESS};
use super::judge::Expect;

/// The default of `lost_frames`.
pub const LOST_FRAMES: usize = 3;
/// The time in ms from the single lost or late frame to the many.
pub const BURST_MS: u64 = 120;
/// The time in ms of a hold.
const HOLD_MS: u64 = 400;
const CODE: &str = "0x2310";

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Cause {
    DriveFault,
    DeviceLost,
    FramesLost,
    FramesLate,
    Emergency,
    Hold,
    /// The group of the feature stops because of another member.
    StoppedGroup,
    /// Likewise; then the program resets and enables the group.
    GroupReset,
    /// The other group stops.
    OtherGroupStopped,
    BrokenRing,
    Pipelined,
}

/// Every cause of the matrix, with its runs.
pub const ALL: [(&str, &[Cause]); 9] = [
    ("drive fault", &[Cause::DriveFault]),
    ("device lost", &[Cause::DeviceLost]),
    ("frames lost", &[Cause::FramesLost]),
    ("frames late", &[Cause::FramesLate]),
    ("emergency", &[Cause::Emergency]),
    ("hold", &[Cause::Hold]),
    (
        "stopped group",
        &[
            Cause::StoppedGroup,
            Cause::GroupReset,
            Cause::OtherGroupStopped,
        ],
    ),
    ("broken ring", &[Cause::BrokenRing]),
    ("pipelined exchange", &[Cause::Pipelined]),
];

/// How the bus is connected and exchanges its data.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Bus {
    Line,
    Ring,
    Pipelined,
}

impl Bus {
    /// Returns the keys of `[bus]`.
    pub fn keys(self) -> &'static str {
        match self {
            Self::Line => "",
            Self::Ring => "redundant = \"sim2\"\n",
            Self::Pipelined => "exchange = \"pipelined\"\n",
        }
    }

    /// Returns the cycles by which an answer is later.
    pub fn later(self) -> usize {
        usize::from(self == Self::Pipelined)
    }
}

impl Cause {
    /// Returns the moments at which the cause strikes, and the bus of each. A ring and the pipelined
    /// exchange are causes themselves.
    pub fn buses(self) -> &'static [Bus] {
        match self {
            Self::BrokenRing => &[Bus::Ring; 3],
            Self::Pipelined => &[Bus::Pipelined],
            _ => &[Bus::Line, Bus::Ring, Bus::Pipelined],
        }
    }

    /// Returns the bus of the run without the cause. The exchange changes nothing but latency.
    pub fn reference_bus(self, moment: usize) -> Bus {
        match self {
            Self::Pipelined => Bus::Line,
            _ => self.buses()[moment],
        }
    }

    /// Returns the last steps of the program.
    pub fn steps(self, feature: &Feature) -> String {
        if self != Self::GroupReset {
            return String::new();
        }
        let names = feature.axes.iter().map(|axis| format!("\"{}\"", axis.name));
        // The program names the first half of a gantry.
        let count = if feature.is_gantry() { 1 } else { names.len() };
        let names = names.take(count).collect::<Vec<_>>().join(", ");
        format!(
            "[[step]]\nreset = [\"b\"]\n[[step]]\nenable = [{names}]\n[[step]]\ndwell = \"300ms\"\n"
        )
    }

    /// Returns the axis whose drive has the fault, for each moment another one.
    pub fn victim(feature: &Feature, moment: usize) -> usize {
        let drives = feature
            .axes
            .iter()
            .filter(|axis| axis.device != feature.axes[0].device);
        moment % (drives.count() + 1)
    }

    /// Returns the fault script. `at`: in ns since the start of the bus.
    pub fn script(self, feature: &Feature, at: u64, moment: usize) -> String {
        let bus = self.buses()[moment];
        let fault = |kind: &str, at: u64, keys: &str| {
            format!("[[fault]]\nkind = \"{kind}\"\nat = \"{at}ns\"\n{keys}\n")
        };
        let input = |bit: u8, keys: &str| {
            let sub = bit.trailing_zeros() + 1;
            let keys = format!("device = {IO}\nindex = 0x6000\nsub = {sub}\nvalue = 1\n{keys}");
            fault("input", at, &keys)
        };
        let drive = |device: usize| {
            fault(
                "drive-fault",
                at,
                &format!("device = {device}\ncode = {CODE}"),
            )
        };
        let burst = at + BURST_MS * 1_000_000;
        match (self, feature.node) {
            (Self::DriveFault, Some(node)) => {
                let device = feature.axes[0].device;
                fault(
                    "node-error",
                    at,
                    &format!("device = {device}\nnode = {node}"),
                )
            }
            (Self::DriveFault, None) => drive(feature.axes[Self::victim(feature, moment)].device),
            (Self::DeviceLost, _) => {
                // It returns, except at the first moment.
                let back = if moment > 0 { "for = \"300ms\"" } else { "" };
                let keys = format!("device = {}\n{back}", feature.lost);
                fault("power-off", at, &keys)
            }
            (Self::FramesLost, _) => {
                let one = "probability = 1.0\nfor = \"1ms\"";
                let many = "probability = 1.0\nfor = \"30ms\"";
                fault("frame-loss", at, one) + &fault("frame-loss", burst, many)
            }
            (Self::FramesLate, _) => {
                let delay = 1200 + 1000 * bus.later();
                let keys = format!("probability = 1.0\ndelay = \"{delay}us\"\n");
                let [one, many] = ["1ms", "30ms"].map(|time| format!("{keys}for = \"{time}\""));
                fault("frame-delay", at, &one) + &fault("frame-delay", burst, &many)
            }
            (Self::Emergency, _) => input(EMERGENCY, ""),
            (Self::Hold, _) => input(HOLD, &format!("for = \"{HOLD_MS}ms\"")),
            (Self::StoppedGroup | Self::GroupReset, _) => drive(BUDDY),
            (Self::OtherGroupStopped, _) => drive(WITNESS),
            (Self::BrokenRing, _) => {
                let device = feature.axes[0].device;
                fault("link-break", at, &format!("device = {device}\nport = 0"))
            }
            (Self::Pipelined, _) => String::new(),
        }
    }

    /// Returns what an axis must do (`docs/stops.md`; `docs/motion.md`, "Groups", "Gantries").
    pub fn expect(self, feature: &Feature, axis: &Axis, moment: usize) -> Expect {
        let outside = match feature.is_blocked(moment) {
            true => Expect::UntilProgramFails,
            false => Expect::Undisturbed,
        };
        let faulty = axis.name == feature.axes[Self::victim(feature, moment)].name;
        match (self, axis.role) {
            (Self::FramesLost | Self::FramesLate, _) => Expect::Lost,
            (Self::Emergency, _) => Expect::QuickStop,
            (Self::Hold, Role::Buddy) => Expect::Undisturbed,
            (Self::Hold, _) => Expect::Hold,
            (Self::BrokenRing | Self::Pipelined, _) => Expect::Undisturbed,
            (Self::OtherGroupStopped, Role::Witness) => Expect::OwnFault,
            (Self::OtherGroupStopped, _) => Expect::Undisturbed,
            (Self::DeviceLost, Role::Witness) if feature.lost_elsewhere => Expect::Ramp,
            (Self::DeviceLost, _) if feature.lost_elsewhere => Expect::Undisturbed,
            (_, Role::Witness) => outside,
            (Self::StoppedGroup | Self::GroupReset, Role::Buddy) => Expect::OwnFault,
            (Self::StoppedGroup, _) => Expect::Ramp,
            (Self::GroupReset, _) => Expect::RampThenReset,
            // A node in error is a lost node.
            (Self::DriveFault, _) if faulty && feature.node.is_some() => Expect::Lost,
            (Self::DriveFault, _) if faulty => Expect::OwnFault,
            (Self::DriveFault, Role::Feature | Role::Half) if feature.is_gantry() => {
                Expect::QuickStop
            }
            (Self::DriveFault, _) => Expect::Ramp,
            (Self::DeviceLost, Role::Buddy) => Expect::Ramp,
            (Self::DeviceLost, _) if axis.device == feature.lost || feature.is_gantry() => {
                Expect::Lost
            }
            (Self::DeviceLost, _) => Expect::Ramp,
        }
    }

    /// Returns what the user must read; `None`: the run succeeds.
    pub fn texts(self, feature: &Feature, moment: usize) -> Option<Vec<String>> {
        let faulty = format!("`{}`", feature.axes[Self::victim(feature, moment)].name);
        let texts = match (self, feature.node) {
            (Self::Hold | Self::BrokenRing | Self::Pipelined | Self::GroupReset, _) => return None,
            (Self::DriveFault, Some(node)) => vec![format!("node {node}"), "in error".to_owned()],
            (Self::DriveFault, None) => vec![faulty, "fault".to_owned()],
            (Self::DeviceLost, _) => vec!["no longer answers".to_owned()],
            (Self::FramesLost | Self::FramesLate, _) => vec!["cycles in a row".to_owned()],
            (Self::Emergency, _) => vec!["emergency stop".to_owned(), "pressed".to_owned()],
            (Self::StoppedGroup, _) => vec!["`b`".to_owned(), CODE.to_owned()],
            (Self::OtherGroupStopped, _) => vec!["`w`".to_owned(), CODE.to_owned()],
        };
        Some(texts)
    }
}
