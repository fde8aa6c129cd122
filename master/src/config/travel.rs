//! `track` of `[device.sim]`: switches, probes and ends along a simulated axis.

use ecaxis_axis::Scale;
use ecaxis_axis::units::UserUnits;
use ecaxis_sim::Track;
use toml::Spanned;
use toml::de::DeValue;

use super::AxisSetup;
use super::fields::{Field, Key, Read, Table, TableKey, Value, Written};
use super::problem::{Problems, Span};
use super::schema::{self, Schema};

table! { "`track`",
    /// Positions are in the axis's unit, as shown at power-on.
    table RawTrack {
        /// Position of the axis at power-on (unit; default 0)
        start: Key<f64>,
        /// Position of the negative limit switch (unit)
        negative_limit: Key<f64>,
        /// Position of the positive limit switch (unit)
        positive_limit: Key<f64>,
        /// Range of the home switch ([from, to], unit)
        home: Key<[f64; 2]>,
        /// Range of the target of touch probe 1 ([from, to], unit)
        probe1: Key<[f64; 2]>,
        /// Range of the target of touch probe 2 ([from, to], unit)
        probe2: Key<[f64; 2]>,
        /// Mechanical ends ([from, to], unit)
        ends: Key<[f64; 2]>,
        /// Position of the index pulse, or false for none (unit; default 0)
        index: Key<Index>,
    }
}

/// The position of the index pulse; `None` is written `false`: there is no pulse.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Index(Option<f64>);

impl Read for Index {
    fn read(value: Value<'_>, key: &str, p: &mut Problems<'_>) -> Option<Self> {
        match value.get_ref() {
            DeValue::Boolean(false) => Some(Self(None)),
            _ => f64::read(value, key, p).map(|position| Self(Some(position))),
        }
    }
}

impl Schema for Index {
    fn schema() -> serde_json::Value {
        schema::any_of([serde_json::json!({ "enum": [false] }), f64::schema()])
    }
}

/// The position of the simulated axis at power-on in the drive's counts, and its track.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct TrackSetup {
    pub start: i32,
    pub track: Track,
}

/// Converts positions to counts. `axis`: the device's axis; `Err`: it has none; `None`: it is
/// invalid.
pub(crate) fn check(
    raw: &RawTrack,
    axis: Result<Option<&AxisSetup>, ()>,
    p: &mut Problems<'_>,
) -> Option<TrackSetup> {
    let Ok(axis) = axis else {
        let hint = "only drives with a [device.axis] have one";
        p.add_hint(raw.span.clone(), "a track without an axis", hint);
        return None;
    };
    // An invalid axis has been reported.
    let mut to = Counts {
        scale: &axis?.config.scale,
        p,
    };
    let inverted = to.scale.inverted();
    let setup = TrackSetup {
        start: to.counts(raw.start.as_ref()).unwrap_or_default(),
        track: Track {
            negative_limit: to.counts(raw.negative_limit.as_ref()),
            positive_limit: to.counts(raw.positive_limit.as_ref()),
            home: to.range(raw.home.as_ref(), "home"),
            probes: [
                to.range(raw.probe1.as_ref(), "probe1"),
                to.range(raw.probe2.as_ref(), "probe2"),
            ],
            ends: to.range(raw.ends.as_ref(), "ends"),
            index: match &raw.index {
                None => Track::default().index,
                Some(index) => {
                    let Index(position) = *index.get_ref();
                    position.and_then(|position| to.place(position, &index.span()))
                }
            },
            normally_closed: 0,
        },
    };
    let limits = [raw.negative_limit.as_ref(), raw.positive_limit.as_ref()];
    if let [Some(negative), Some(positive)] = limits
        && (negative.get_ref() < positive.get_ref()) == inverted
    {
        let hint = "limit switches are named as the drive counts; with `invert` that is the other way round";
        p.add_hint(
            negative.span(),
            "the limit switches are both on at any place",
            hint,
        );
    }
    Some(setup)
}

struct Counts<'c, 'p, 'd> {
    scale: &'c Scale,
    p: &'p mut Problems<'d>,
}

impl Counts<'_, '_, '_> {
    fn counts(&mut self, position: Option<&Spanned<f64>>) -> Option<i32> {
        let position = position?;
        self.place(*position.get_ref(), &position.span())
    }

    fn place(&mut self, position: f64, at: &Span) -> Option<i32> {
        let counts = self.scale.position_to_counts(UserUnits(position)).0;
        let found = i32::try_from(counts).ok();
        if found.is_none() {
            let message = format!("{position} is {counts} counts, more than 32 bits hold");
            self.p.add(at.clone(), message);
        }
        found
    }

    /// Returns the range in ascending counts.
    fn range(&mut self, range: Option<&Spanned<[f64; 2]>>, key: &str) -> Option<(i32, i32)> {
        let range = range?;
        let [first, last] = *range.get_ref();
        if first > last {
            let message = format!("`{key}` ends before it begins");
            self.p
                .add_hint(range.span(), message, "write the lower end first");
            return None;
        }
        let ends = [first, last].map(|end| self.place(end, &range.span()));
        let [Some(first), Some(last)] = ends else {
            return None;
        };
        Some((first.min(last), first.max(last)))
    }
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use ecaxis_ecat::index::DeviceIndex;
    use ecaxis_sim::Track;

    use super::super::{ConfigError, Machine, Problem, parse};
    use super::TrackSetup;

    fn load(axis: &str, track: &str) -> Result<Machine, ConfigError> {
        let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../configs");
        let text = format!(
            "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n[[device]]\nname = \"x\"\nesi = \"esi/EPOS4.xml\"\nposition = 0\nmode = \"csp\"\n\
             [device.sim]\ntrack = {track}\n\
             [device.axis]\nunit = \"mm\"\nper_turn = 5.0\nencoder = 2000\n{axis}\nlimits = {{ velocity = 100.0, acceleration = 1000.0 }}\n"
        );
        parse(&folder.join("test.toml"), &text)
    }

    fn problems(axis: &str, track: &str) -> Vec<Problem> {
        match load(axis, track) {
            Err(ConfigError::Problems(problems)) => problems,
            other => panic!("{track}: {other:?}"),
        }
    }

    fn track(axis: &str, track: &str) -> TrackSetup {
        match load(axis, track) {
            Ok(machine) => machine.devices[DeviceIndex(0)].sim.track,
            Err(error) => panic!("{error}"),
        }
    }

    #[test]
    fn track_converts_axis_positions_to_drive_counts() {
        let all = "{ start = 5, negative_limit = -50.0, positive_limit = 50.0, home = [10.0, 12.5], probe1 = [1, 2], ends = [-60.0, 60.0], index = 2.5 }";
        let expected = TrackSetup {
            start: 2000,
            track: Track {
                negative_limit: Some(-20_000),
                positive_limit: Some(20_000),
                home: Some((4000, 5000)),
                probes: [Some((400, 800)), None],
                ends: Some((-24_000, 24_000)),
                index: Some(1000),
                normally_closed: 0,
            },
        };
        assert_eq!(track("", all), expected);
        assert_eq!(track("", "{}"), TrackSetup::default());
        assert_eq!(track("", "{ index = false }").track.index, None);
        let inverted = track(
            "invert = true",
            "{ negative_limit = 50.0, positive_limit = -50.0, home = [10.0, 12.5] }",
        );
        assert_eq!(inverted.track.negative_limit, Some(-20_000));
        assert_eq!(inverted.track.home, Some((-5000, -4000)));
    }

    #[test]
    #[rustfmt::skip] // one row per mistake
    fn track_rejects_invalid_positions() {
        for (axis, track, message, hint) in [
            ("", "{ home = [2.0, 1.0] }", "`home` ends before it begins", "lower end first"),
            ("", "{ home = 2.0 }", "expected a list of two positions, found a number", ""),
            ("", "{ home = [2.0] }", "`home` has two ends", "home = [10.0, 10.5]"),
            ("", "{ index = true }", "expected a number, found true or false", ""),
            ("", "{ start = 1e9 }", "more than 32 bits hold", ""),
            ("", "{ limit = 3.0 }", "unknown key `limit` in `track`", "known keys"),
            ("", "{ negative_limit = 5.0, positive_limit = -5.0 }", "both on at any place", "as the drive counts"),
            ("invert = true", "{ negative_limit = -5.0, positive_limit = 5.0 }", "both on at any place", "as the drive counts"),
        ] {
            let found = problems(axis, track);
            let [problem] = found.as_slice() else { panic!("{track}: {found:#?}") };
            assert!(problem.message.contains(message), "{problem}");
            assert!(problem.hint.as_deref().unwrap_or_default().contains(hint), "{problem}");
            assert_eq!(problem.line, 10);
        }
    }
}
