//! Touch probes: the position at an edge (0x60B8–0x60BD, CiA 402-2 "touch probe functionality").
//!
//! A probe captures one edge, once. Its byte of 0x60B8 is 0 until 0x60B9 shows the probe switched
//! off, so that an old edge is not taken for a new one. Then the probe is armed, and the first
//! stored edge is the capture.

/// Touch probe 1 or 2.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Probe {
    /// Touch probe 1.
    First,
    /// Touch probe 2.
    Second,
}

/// The edge that a touch probe captures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Edge {
    /// The rising edge.
    Positive,
    /// The falling edge.
    Negative,
}

/// The signal of the edge.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Source {
    /// The input of the probe.
    Input,
    /// The index pulse of the encoder.
    ZeroImpulse,
    /// The source selected by 0x60D0.
    Selected,
}

/// The status of a touch probe.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum ProbeStatus {
    /// Switched off.
    #[default]
    Off,
    /// Requested; the drive has not confirmed it.
    Arming,
    /// The drive waits for the edge.
    Armed,
    /// Position at the edge, user units.
    Captured {
        /// The position, user units.
        position: f64,
    },
}

/// Bits of one byte of 0x60B8.
mod function {
    pub const ENABLE: u8 = 1;
    pub const ZERO_IMPULSE: u8 = 1 << 2;
    pub const SELECTED: u8 = 1 << 3;
    pub const POSITIVE: u8 = 1 << 4;
    pub const NEGATIVE: u8 = 1 << 5;
}

/// Bits of one byte of 0x60B9.
mod status {
    pub const ENABLED: u8 = 1;
    pub const POSITIVE: u8 = 1 << 1;
    pub const NEGATIVE: u8 = 1 << 2;
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Phase {
    Off,
    Clearing,
    Arming,
    Armed,
    Captured(f64),
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct ProbeChannel {
    phase: Phase,
    edge: Edge,
    source: Source,
    stop: bool,
}

/// Both touch probes of a drive.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Probes([ProbeChannel; 2]);

impl Default for Probes {
    fn default() -> Self {
        Self::new()
    }
}

impl Probe {
    /// Returns the number of the probe, 1 or 2.
    #[must_use]
    pub const fn number(self) -> u8 {
        match self {
            Self::First => 1,
            Self::Second => 2,
        }
    }

    /// Returns the index in [`crate::AxisStatus::probes`].
    #[must_use]
    pub const fn index(self) -> usize {
        match self {
            Self::First => 0,
            Self::Second => 1,
        }
    }
}

impl Probes {
    #[must_use]
    pub const fn new() -> Self {
        const OFF: ProbeChannel = ProbeChannel {
            phase: Phase::Off,
            edge: Edge::Positive,
            source: Source::Input,
            stop: false,
        };
        Self([OFF, OFF])
    }

    /// Arms a probe for the next edge and discards its last capture. `stop`: [`Probes::step`]
    /// returns true at this edge.
    pub fn arm(&mut self, probe: Probe, edge: Edge, source: Source, stop: bool) {
        if let Some(one) = self.0.get_mut(probe.index()) {
            *one = ProbeChannel {
                phase: Phase::Clearing,
                edge,
                source,
                stop,
            };
        }
    }

    pub fn disarm(&mut self, probe: Probe) {
        if let Some(one) = self.0.get_mut(probe.index()) {
            one.phase = Phase::Off;
        }
    }

    /// True while an edge would stop the axis.
    pub fn may_stop(&self) -> bool {
        let waits = |one: &ProbeChannel| !matches!(one.phase, Phase::Off | Phase::Captured(_));
        self.0.iter().any(|one| one.stop && waits(one))
    }

    /// Runs one fresh cycle. `status`: 0x60B9. `position`: returns 0x60BA, 0x60BB, 0x60BC or 0x60BD
    /// (index 0 to 3) in user units. Returns true at a new edge that is to stop the axis.
    pub fn step(&mut self, status: u16, position: impl Fn(usize) -> Option<f64>) -> bool {
        let mut stop = false;
        for (n, (one, byte)) in self.0.iter_mut().zip(status.to_le_bytes()).enumerate() {
            let enabled = byte & status::ENABLED != 0;
            let (stored, slot) = match one.edge {
                Edge::Positive => (byte & status::POSITIVE != 0, 2 * n),
                Edge::Negative => (byte & status::NEGATIVE != 0, 2 * n + 1),
            };
            one.phase = match one.phase {
                Phase::Clearing if !enabled => Phase::Arming,
                Phase::Arming | Phase::Armed if enabled && stored => match position(slot) {
                    Some(position) => {
                        stop |= one.stop;
                        Phase::Captured(position)
                    }
                    None => one.phase,
                },
                Phase::Arming if enabled => Phase::Armed,
                same => same,
            };
        }
        stop
    }

    /// Returns the value of 0x60B8.
    #[must_use]
    pub fn function(&self) -> u16 {
        u16::from_le_bytes(self.0.map(ProbeChannel::function))
    }

    #[must_use]
    pub fn status(&self) -> [ProbeStatus; 2] {
        self.0.map(|one| match one.phase {
            Phase::Off => ProbeStatus::Off,
            Phase::Clearing | Phase::Arming => ProbeStatus::Arming,
            Phase::Armed => ProbeStatus::Armed,
            Phase::Captured(position) => ProbeStatus::Captured { position },
        })
    }
}

impl ProbeChannel {
    const fn function(self) -> u8 {
        if !matches!(self.phase, Phase::Arming | Phase::Armed) {
            return 0;
        }
        let source = match self.source {
            Source::Input => 0,
            Source::ZeroImpulse => function::ZERO_IMPULSE,
            Source::Selected => function::SELECTED,
        };
        let edge = match self.edge {
            Edge::Positive => function::POSITIVE,
            Edge::Negative => function::NEGATIVE,
        };
        function::ENABLE | source | edge
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WHERE: [f64; 4] = [1.0, 2.0, 3.0, 4.0];

    fn step(probes: &mut Probes, status: u16) -> [ProbeStatus; 2] {
        let captured = |of: [ProbeStatus; 2]| {
            let one = |s: &&ProbeStatus| matches!(s, ProbeStatus::Captured { .. });
            of.iter().filter(one).count()
        };
        let before = captured(probes.status());
        let stop = probes.step(status, |slot| WHERE.get(slot).copied());
        // Returned once, in the cycle of the capture.
        assert_eq!(stop, captured(probes.status()) > before);
        probes.status()
    }

    #[test]
    fn function_words_row_by_row() {
        for (probe, edge, source, word) in [
            (Probe::First, Edge::Positive, Source::Input, 0x0011),
            (Probe::First, Edge::Negative, Source::Input, 0x0021),
            (Probe::First, Edge::Positive, Source::ZeroImpulse, 0x0015),
            (Probe::First, Edge::Positive, Source::Selected, 0x0019),
            (Probe::Second, Edge::Positive, Source::Input, 0x1100),
            (Probe::Second, Edge::Negative, Source::ZeroImpulse, 0x2500),
        ] {
            let mut probes = Probes::new();
            probes.arm(probe, edge, source, false);
            assert_eq!(probes.function(), 0, "first it is switched off");
            step(&mut probes, 0);
            assert_eq!(probes.function(), word);
            probes.disarm(probe);
            assert_eq!(probes.function(), 0);
        }
    }

    #[test]
    fn each_probe_captures_each_edge() {
        use ProbeStatus::*;
        for (probe, edge, enabled, stored, position) in [
            (Probe::First, Edge::Positive, 0x0001, 0x0003, 1.0),
            (Probe::First, Edge::Negative, 0x0001, 0x0005, 2.0),
            (Probe::Second, Edge::Positive, 0x0100, 0x0300, 3.0),
            (Probe::Second, Edge::Negative, 0x0100, 0x0500, 4.0),
        ] {
            let at = probe.index();
            let mut probes = Probes::new();
            probes.arm(probe, edge, Source::Input, true);
            // The drive still shows the previous capture.
            assert_eq!(step(&mut probes, stored)[at], Arming);
            assert_eq!(step(&mut probes, stored)[at], Arming);
            assert_eq!(step(&mut probes, 0)[at], Arming);
            assert_eq!(step(&mut probes, enabled)[at], Armed);
            // The other edge is not armed.
            let other = (stored ^ enabled)
                ^ if probe == Probe::First {
                    0x0006
                } else {
                    0x0600
                };
            assert_eq!(step(&mut probes, enabled | other)[at], Armed);
            assert_eq!(step(&mut probes, stored)[at], Captured { position });
            // One capture only; afterwards the probe is switched off.
            assert_eq!(probes.function(), 0);
            assert_eq!(step(&mut probes, stored)[at], Captured { position });
            assert_eq!(step(&mut probes, 0)[1 - at], Off);
        }
    }

    #[test]
    fn probe_without_mapped_position_captures_nothing() {
        let mut probes = Probes::new();
        probes.arm(Probe::First, Edge::Positive, Source::Input, true);
        assert!(!probes.step(0, |_| None));
        assert!(!probes.step(3, |_| None));
        assert_eq!(probes.status()[0], ProbeStatus::Arming);
    }
}
