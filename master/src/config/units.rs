//! Position units. They are only displayed, never converted. The list of known units detects
//! misspellings.

use toml::Spanned;

use super::problem::{Problems, suggestion};

const DEFAULT: &str = "turn";

/// Units of a turn, which need no scale.
const TURNS: [&str; 4] = ["turn", "turns", "rev", "revs"];

const KNOWN: [&str; 23] = [
    "mm", "um", "µm", "nm", "cm", "m", "in", "inch", "ft", "deg", "°", "rad", "mrad", "arcmin",
    "arcsec", "turn", "turns", "rev", "revs", "count", "counts", "inc", "%",
];

/// The prefix of a unit that is not in the list.
const CUSTOM: &str = "custom:";

/// Returns the unit's name for display.
pub(crate) fn unit(given: Option<&Spanned<String>>, p: &mut Problems<'_>) -> Option<String> {
    let Some(given) = given else {
        return Some(DEFAULT.to_owned());
    };
    let word = given.get_ref().trim();
    if let Some(own) = word.strip_prefix(CUSTOM) {
        let own = own.trim();
        if (1..=16).contains(&own.chars().count()) && !own.contains(char::is_control) {
            return Some(own.to_owned());
        }
        let message = "a unit's name has 1 to 16 characters";
        p.add_hint(given.span(), message, "write `unit = \"custom:slots\"`");
        return None;
    }
    // Greek mu and the micro sign look the same.
    let word = word.replace('μ', "µ");
    if KNOWN.contains(&word.as_str()) {
        return Some(word);
    }
    let known = suggestion(&word, KNOWN, "units");
    let own = if word.is_empty() { "slots" } else { &word };
    p.add_hint(
        given.span(),
        format!("unknown unit `{word}`"),
        format!("{known}\nfor a unit of your own write `unit = \"{CUSTOM}{own}\"`"),
    );
    None
}

/// Returns `true` if the unit is a turn of the motor or of the gear's output shaft.
pub(crate) fn is_turn(unit: &str) -> bool {
    TURNS.contains(&unit)
}

/// Returns the metres or radians in one unit; `None` for units of neither.
#[must_use]
pub fn si_factor(unit: &str) -> Option<f64> {
    use std::f64::consts::{PI, TAU};
    Some(match unit {
        "m" => 1.0,
        "cm" => 1e-2,
        "mm" => 1e-3,
        "um" | "µm" => 1e-6,
        "nm" => 1e-9,
        "in" | "inch" => 0.0254,
        "ft" => 0.3048,
        "rad" => 1.0,
        "mrad" => 1e-3,
        "deg" | "°" => PI / 180.0,
        "arcmin" => PI / (180.0 * 60.0),
        "arcsec" => PI / (180.0 * 3600.0),
        unit if is_turn(unit) => TAU,
        _ => return None,
    })
}
