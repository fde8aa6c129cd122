//! Steps with several parameters per axis: waves, gears, probing.

use toml::Spanned;

use super::super::fields::{self, Fields};
use super::super::problem::Problems;
use super::Value;
use super::step::{RawAction, only};

/// `probe`: exactly one of `to` and `by` is given.
#[derive(Debug)]
pub(crate) struct RawProbe {
    pub axis: Spanned<String>,
    pub to: Option<Spanned<f64>>,
    pub by: Option<Spanned<f64>>,
    pub input: Option<Spanned<u8>>,
    pub edge: Option<Spanned<String>>,
    pub speed: Option<Spanned<f64>>,
    pub ramp: Option<Spanned<f64>>,
}

pub(super) fn wave(square: bool, value: Value<'_>, p: &mut Problems<'_>) -> Option<RawAction> {
    let example = "{ x = { amplitude = 1.0, frequency = 2.0, periods = 5 } }";
    let (axis, value) = only(value, example, p)?;
    let mut f = fields::table(p, value, "a wave")?;
    let amplitude = f.need("amplitude", "amplitude = 1.0");
    let frequency = f.need("frequency", "frequency = 2.0");
    let periods = f.need("periods", "periods = 5");
    let wave = RawAction::Wave {
        square,
        axis,
        amplitude: amplitude.and_then(|v| fields::number(p, v)),
        frequency: frequency.and_then(|v| fields::number(p, v)),
        periods: periods.and_then(|v| fields::integer(p, v, 1, 1_000_000)),
    };
    f.done(p);
    Some(wave)
}

pub(super) fn gear(value: Value<'_>, p: &mut Problems<'_>) -> Option<RawAction> {
    let (axis, value) = only(value, "{ y = { to = \"x\", ratio = 2.0 } }", p)?;
    let mut f = fields::table(p, value, "a gear")?;
    let to = f.need("to", "to = \"x\"");
    let gear = RawAction::Gear {
        axis,
        to: to.and_then(|v| fields::string(p, v)),
        ratio: f.get("ratio").and_then(|v| fields::number(p, v)),
        actual: f.get("actual").and_then(|v| fields::boolean(p, v)),
        offset: f.get("offset").and_then(|v| fields::number(p, v)),
        smoothing: f.get("smoothing").and_then(|v| fields::duration(p, v)),
    };
    f.done(p);
    Some(gear)
}

pub(super) fn probe(
    value: Value<'_>,
    step: &mut Fields<'_>,
    p: &mut Problems<'_>,
) -> Option<RawAction> {
    let speed = step.get("speed").and_then(|v| fields::number(p, v));
    let ramp = step.get("ramp").and_then(|v| fields::number(p, v));
    let (axis, value) = only(value, "{ x = { to = 50.0, input = 1 } }", p)?;
    let mut f = fields::table(p, value, "a probe")?;
    let (to, by) = (f.get("to"), f.get("by"));
    let said = (to.is_some(), by.is_some());
    let probe = RawProbe {
        axis,
        to: to.and_then(|v| fields::number(p, v)),
        by: by.and_then(|v| fields::number(p, v)),
        input: f.get("input").and_then(|v| fields::integer(p, v, 1, 2)),
        edge: f.get("edge").and_then(|v| fields::string(p, v)),
        speed,
        ramp,
    };
    let wrong_key = f.unknown();
    f.done(p);
    match said {
        (true, true) => {
            let message = "`to` and `by` both say how far to search";
            p.add_hint(value.span(), message, "leave one of them out");
            None
        }
        (false, false) => {
            if !wrong_key {
                let message = "it is not said how far to search for the edge";
                let hint =
                    "add `to = 50.0`, a position, or `by = 10.0`, a way from where the axis is";
                p.add_hint(value.span(), message, hint);
            }
            None
        }
        _ => Some(RawAction::Probe(probe)),
    }
}
