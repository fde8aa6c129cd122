//! Which axes stop, and how, when one of them has to.

/// As many axes as an [`AxisSet`] holds.
pub const MAX_AXES: usize = 128;

/// A set of axes by index. Indices from [`MAX_AXES`] on are never in it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Hash)]
pub struct AxisSet(u128);

impl AxisSet {
    pub const EMPTY: Self = Self(0);
    pub const ALL: Self = Self(u128::MAX);

    #[must_use]
    pub const fn first(count: usize) -> Self {
        if count >= MAX_AXES {
            Self::ALL
        } else {
            Self((1 << count) - 1)
        }
    }

    pub fn insert(&mut self, axis: usize) {
        self.0 |= Self::bit(axis);
    }

    #[must_use]
    pub const fn contains(self, axis: usize) -> bool {
        self.0 & Self::bit(axis) != 0
    }

    #[must_use]
    pub const fn is_empty(self) -> bool {
        self.0 == 0
    }

    #[must_use]
    pub const fn len(self) -> usize {
        self.0.count_ones() as usize
    }

    #[must_use]
    pub const fn and(self, other: Self) -> Self {
        Self(self.0 & other.0)
    }

    #[must_use]
    pub const fn or(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }

    #[must_use]
    pub const fn without(self, other: Self) -> Self {
        Self(self.0 & !other.0)
    }

    pub fn iter(self) -> impl Iterator<Item = usize> {
        (0..MAX_AXES).filter(move |&axis| self.contains(axis))
    }

    const fn bit(axis: usize) -> u128 {
        if axis < MAX_AXES { 1 << axis } else { 0 }
    }
}

impl FromIterator<usize> for AxisSet {
    fn from_iter<I: IntoIterator<Item = usize>>(axes: I) -> Self {
        let mut set = Self::EMPTY;
        for axis in axes {
            set.insert(axis);
        }
        set
    }
}

/// Why axes stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Cause {
    /// The drive reports a fault.
    Fault,
    /// The master's own supervision has stopped the axis.
    Trip,
    /// The device misses from the process data: its working counter is wrong, or it left Op.
    Missing,
    /// The bus has been without a valid answer for `lost_frames` cycles.
    BusLost,
    /// Ordered.
    EmergencyStop,
}

impl Cause {
    pub const ALL: [Self; 5] = [
        Self::Fault,
        Self::Trip,
        Self::Missing,
        Self::BusLost,
        Self::EmergencyStop,
    ];
}

/// What an axis does. A later one is stronger, and replaces an earlier.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default, Hash)]
pub enum Reaction {
    #[default]
    Continue,
    /// Decelerates within its limits, then stays enabled.
    Ramp,
    /// Decelerates within its limits, then loses power.
    RampAndDisable,
    /// The drive's own quick stop, then no power.
    QuickStop,
    /// No power at once: the axis coasts, or its brake falls in.
    Disable,
}

/// One line per [`Cause`]: what the axis that has it does, and what the others of its group do.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Reactions {
    pub fault: [Reaction; 2],
    pub trip: [Reaction; 2],
    pub missing: [Reaction; 2],
    /// Of all axes; the bus has no axis.
    pub bus_lost: Reaction,
    pub emergency_stop: Reaction,
}

impl Default for Reactions {
    /// A drive in fault stops by itself; what the master has tripped, or no longer hears, is to stop by its own means; the others brake
    /// within their limits and lose power. Without a bus every drive has to stop by itself.
    fn default() -> Self {
        Self {
            fault: [Reaction::Disable, Reaction::RampAndDisable],
            trip: [Reaction::QuickStop, Reaction::RampAndDisable],
            missing: [Reaction::QuickStop, Reaction::RampAndDisable],
            bus_lost: Reaction::QuickStop,
            emergency_stop: Reaction::QuickStop,
        }
    }
}

impl Reactions {
    /// Of the axis with the cause, and of the others.
    #[must_use]
    pub const fn to(&self, cause: Cause) -> [Reaction; 2] {
        match cause {
            Cause::Fault => self.fault,
            Cause::Trip => self.trip,
            Cause::Missing => self.missing,
            Cause::BusLost => [self.bus_lost; 2],
            Cause::EmergencyStop => [self.emergency_stop; 2],
        }
    }
}

/// What is the case in a cycle.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Events {
    pub fault: AxisSet,
    pub trip: AxisSet,
    pub missing: AxisSet,
    pub bus_lost: bool,
    /// These axes, and with them their groups.
    pub emergency_stop: AxisSet,
    /// Standing, or without power.
    pub at_rest: AxisSet,
}

impl Events {
    /// The axes that have the cause.
    #[must_use]
    pub const fn with(&self, cause: Cause) -> AxisSet {
        match cause {
            Cause::Fault => self.fault,
            Cause::Trip => self.trip,
            Cause::Missing => self.missing,
            Cause::BusLost => {
                if self.bus_lost {
                    AxisSet::ALL
                } else {
                    AxisSet::EMPTY
                }
            }
            Cause::EmergencyStop => self.emergency_stop,
        }
    }
}

/// Which axes do what. An axis is in at most one of the sets.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Stops {
    pub ramp: AxisSet,
    pub ramp_and_disable: AxisSet,
    pub quick_stop: AxisSet,
    pub disable: AxisSet,
}

impl Stops {
    #[must_use]
    pub const fn reaction(&self, axis: usize) -> Reaction {
        if self.disable.contains(axis) {
            Reaction::Disable
        } else if self.quick_stop.contains(axis) {
            Reaction::QuickStop
        } else if self.ramp_and_disable.contains(axis) {
            Reaction::RampAndDisable
        } else if self.ramp.contains(axis) {
            Reaction::Ramp
        } else {
            Reaction::Continue
        }
    }

    /// For an axis in several groups, or with several causes, the stronger reaction.
    #[must_use]
    pub const fn or(self, other: Self) -> Self {
        let disable = self.disable.or(other.disable);
        let quick_stop = self.quick_stop.or(other.quick_stop).without(disable);
        let stronger = disable.or(quick_stop);
        let ramp_and_disable = self
            .ramp_and_disable
            .or(other.ramp_and_disable)
            .without(stronger);
        let stronger = stronger.or(ramp_and_disable);
        Self {
            ramp: self.ramp.or(other.ramp).without(stronger),
            ramp_and_disable,
            quick_stop,
            disable,
        }
    }

    const fn of(axes: AxisSet, reaction: Reaction) -> Self {
        let mut stops = Self {
            ramp: AxisSet::EMPTY,
            ramp_and_disable: AxisSet::EMPTY,
            quick_stop: AxisSet::EMPTY,
            disable: AxisSet::EMPTY,
        };
        match reaction {
            Reaction::Continue => {}
            Reaction::Ramp => stops.ramp = axes,
            Reaction::RampAndDisable => stops.ramp_and_disable = axes,
            Reaction::QuickStop => stops.quick_stop = axes,
            Reaction::Disable => stops.disable = axes,
        }
        stops
    }
}

/// Axes that stop together.
///
/// The reaction lasts until [`ReactionGroup::acknowledge`], also when its cause has passed: a drive that comes back does not set the others
/// in motion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReactionGroup {
    members: AxisSet,
    reactions: Reactions,
    stop_within_s: f64,
    first: Option<(Cause, AxisSet)>,
    stops: Stops,
    elapsed_s: f64,
}

impl ReactionGroup {
    /// An axis that is not at rest `stop_within_s` after the group began to stop loses its power (infinite: never; what is not a
    /// number or negative: at once).
    #[must_use]
    pub const fn new(members: AxisSet, reactions: Reactions, stop_within_s: f64) -> Self {
        Self {
            members,
            reactions,
            stop_within_s,
            first: None,
            stops: Stops {
                ramp: AxisSet::EMPTY,
                ramp_and_disable: AxisSet::EMPTY,
                quick_stop: AxisSet::EMPTY,
                disable: AxisSet::EMPTY,
            },
            elapsed_s: 0.0,
        }
    }

    #[must_use]
    pub const fn members(&self) -> AxisSet {
        self.members
    }

    /// What stopped the group first, and which axes had it in that cycle.
    #[must_use]
    pub const fn first(&self) -> Option<(Cause, AxisSet)> {
        self.first
    }

    /// One cycle. RT: O(1).
    pub fn step(&mut self, events: &Events, dt_s: f64) -> Stops {
        if self.first.is_some() {
            self.elapsed_s += dt_s.max(0.0);
        }
        for cause in Cause::ALL {
            let here = events.with(cause).and(self.members);
            if here.is_empty() {
                continue;
            }
            let [own, others] = self.reactions.to(cause);
            let others = Stops::of(self.members.without(here), others);
            let stops = Stops::of(here, own).or(others);
            if stops != Stops::default() {
                self.first.get_or_insert((cause, here));
            }
            self.stops = self.stops.or(stops);
        }
        if self.first.is_some() {
            let in_time = self.elapsed_s <= self.stop_within_s;
            if !in_time {
                let stopping = AxisSet::EMPTY
                    .or(self.stops.ramp)
                    .or(self.stops.ramp_and_disable)
                    .or(self.stops.quick_stop);
                let late = stopping.without(events.at_rest);
                self.stops = self.stops.or(Stops::of(late, Reaction::Disable));
            }
        }
        self.stops
    }

    /// Forgets. A cause that is still there stops the group again in the next cycle.
    pub fn acknowledge(&mut self) {
        *self = Self::new(self.members, self.reactions, self.stop_within_s);
    }
}

#[cfg(test)]
#[path = "reaction_tests.rs"]
mod tests;
