//! `[stop]` as written.

use toml::Spanned;

use super::{RawCondition, Span, Value, step, tables};
use crate::config::fields::{self, Fields};
use crate::config::problem::Problems;

/// `[stop]`.
#[derive(Debug, Default)]
pub(crate) struct RawStop {
    pub others: Option<Spanned<String>>,
    pub bus_lost: Option<Spanned<String>>,
    pub emergency: Vec<RawCondition>,
    pub groups: Vec<RawGroup>,
}

/// `[[stop.group]]`.
#[derive(Debug)]
pub(crate) struct RawGroup {
    pub span: Span,
    pub name: Option<Spanned<String>>,
    pub axes: Vec<Spanned<String>>,
    pub devices: Vec<Spanned<String>>,
    pub others: Option<Spanned<String>>,
    pub outside: Option<Spanned<String>>,
}

pub(super) fn read(mut f: Fields<'_>, p: &mut Problems<'_>) -> RawStop {
    let emergency = f.get("emergency");
    let groups = f.get("group");
    let stop = RawStop {
        others: optional!(p, f, "others", string),
        bus_lost: optional!(p, f, "bus_lost", string),
        emergency: emergency
            .and_then(|v| step::conditions(v, p))
            .unwrap_or_default(),
        groups: tables(p, groups, "[[stop.group]]")
            .into_iter()
            .filter_map(|(value, span)| {
                let fields = fields::table(p, value, "[[stop.group]]")?;
                Some(read_group(fields, span, p))
            })
            .collect(),
    };
    f.done(p);
    stop
}

fn read_group(mut f: Fields<'_>, span: Span, p: &mut Problems<'_>) -> RawGroup {
    let name = f.need("name", "name = \"gantry\"");
    let axes = f.need("axes", "axes = [\"x\", \"y\"]");
    let devices = f.get("devices");
    let group = RawGroup {
        span,
        name: name.and_then(|v| fields::string(p, v)),
        axes: axes
            .map(|v| names(v, "a list of axes", p))
            .unwrap_or_default(),
        devices: devices
            .map(|v| names(v, "a list of devices", p))
            .unwrap_or_default(),
        others: optional!(p, f, "others", string),
        outside: optional!(p, f, "outside", string),
    };
    f.done(p);
    group
}

fn names(value: Value<'_>, wanted: &str, p: &mut Problems<'_>) -> Vec<Spanned<String>> {
    let elements = fields::array(p, value, wanted).unwrap_or_default();
    if elements.is_empty() {
        p.add_hint(
            value.span(),
            "nothing is named here",
            "write a list such as [\"x\", \"y\"]",
        );
    }
    let named = elements.into_iter().filter_map(|v| fields::string(p, v));
    named.collect()
}
