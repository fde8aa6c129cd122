//! Numbers of steps: fixed, or the value of a variable with a range.

use toml::Spanned;

use super::ProgramChecker;
use crate::config::fields::{Key, Ns};
use crate::config::problem::{Problems, suggestion};
use crate::config::raw::{Named, RawNumber};
use crate::config::{NumberPlace, VariableRef, VariableUse};

/// The maximum time of a step in s: a week.
const LONGEST_S: f64 = 604_800.0;

/// A number, with the least and the greatest value that it can have.
#[derive(Debug, Clone, Copy)]
pub(super) struct Number {
    pub value: f64,
    pub ends: [f64; 2],
}

impl ProgramChecker<'_> {
    /// Returns a number of the present step.
    pub(super) fn number(
        &mut self,
        raw: &Spanned<RawNumber>,
        place: NumberPlace,
        p: &mut Problems<'_>,
    ) -> Option<Number> {
        match raw.get_ref() {
            RawNumber::Fixed(value) => Some(Number {
                value: *value,
                ends: [*value; 2],
            }),
            RawNumber::Variable(name) => {
                let name = Spanned::new(raw.span(), name.clone());
                let variable = self.variable(&name, p)?;
                self.use_variable(variable, raw, place, p)
            }
        }
    }

    fn use_variable<T>(
        &mut self,
        variable: VariableRef,
        raw: &Spanned<T>,
        place: NumberPlace,
        p: &mut Problems<'_>,
    ) -> Option<Number> {
        let known = &self.variables[variable.0];
        // A number for another variable is checked when the step runs.
        let free = matches!(place, NumberPlace::Value(_)).then_some([f64::MIN, f64::MAX]);
        let Some(ends) = known.range.or(free) else {
            let name = &known.name;
            let message = format!("`{name}` has no range, so it may be any number");
            let hint = format!(
                "write `{name} = {{ initial = {:?}, range = [0.0, 10.0] }}` under [variables]",
                known.initial
            );
            p.add_hint(raw.span(), message, hint);
            return None;
        };
        let value = known.initial;
        self.uses.push(VariableUse { place, variable });
        Some(Number { value, ends })
    }

    /// Returns a fraction of a limit; 1 without the key.
    pub(super) fn fraction(
        &mut self,
        raw: &Key<RawNumber>,
        place: NumberPlace,
        p: &mut Problems<'_>,
    ) -> Option<f64> {
        let Some(raw) = raw else { return Some(1.0) };
        let Number { value, ends } = self.number(raw, place, p)?;
        let outside = ends.into_iter().find(|n| !(*n > 0.0 && *n <= 1.0));
        let Some(n) = outside else {
            return Some(value);
        };
        let (what, limit) = match place {
            NumberPlace::Speed => ("speed", "velocity"),
            _ => ("ramp", "acceleration"),
        };
        let message = match raw.get_ref() {
            RawNumber::Fixed(_) => {
                format!("`{what}` is {n}, but it is a fraction of the axis' {limit} limit")
            }
            RawNumber::Variable(name) => format!(
                "`{name}` may be {n}, but `{what}` is a fraction of the axis' {limit} limit"
            ),
        };
        p.add_hint(raw.span(), message, "a number above 0.0 and up to 1.0");
        None
    }

    /// Returns a time in ns.
    pub(super) fn time(
        &mut self,
        raw: &Spanned<RawNumber<Ns>>,
        p: &mut Problems<'_>,
    ) -> Option<Ns> {
        let name = match raw.get_ref() {
            RawNumber::Fixed(ns) => return Some(*ns),
            RawNumber::Variable(name) => Spanned::new(raw.span(), name.clone()),
        };
        let variable = self.variable(&name, p)?;
        let number = self.use_variable(variable, raw, NumberPlace::Time, p)?;
        let outside = number
            .ends
            .into_iter()
            .find(|n| !(0.0..=LONGEST_S).contains(n));
        if let Some(n) = outside {
            let message = format!(
                "`{}` may be {n}, but a time in s is 0 to {LONGEST_S}",
                name.get_ref()
            );
            p.add_hint(raw.span(), message, "correct its range under [variables]");
            return None;
        }
        // In the range; the cast saturates.
        Some((number.value * 1e9) as Ns)
    }

    /// Returns the variables of `let` and `add` with their numbers.
    pub(super) fn assignments(
        &mut self,
        add: bool,
        values: Named<RawNumber>,
        p: &mut Problems<'_>,
    ) -> Option<Vec<(VariableRef, f64)>> {
        let count = values.len();
        let mut assigned = Vec::with_capacity(count);
        for (at, (name, raw)) in values.into_iter().enumerate() {
            let variable = self.variable(&name, p);
            let number = self.number(&raw, NumberPlace::Value(at), p);
            let (Some(variable), Some(number)) = (variable, number) else {
                continue;
            };
            let known = &self.variables[variable.0];
            let n = number.value;
            // What a sum or another variable gives is checked when the step runs.
            let outside = known.range.filter(|[low, high]| match raw.get_ref() {
                RawNumber::Fixed(_) if add => n.abs() > high - low,
                RawNumber::Fixed(_) => !(low..=high).contains(&&n),
                RawNumber::Variable(_) => number.ends[0] > *high || number.ends[1] < *low,
            });
            if let Some([low, high]) = outside {
                let message = format!(
                    "{n} leads `{}` out of its range, {low} to {high}",
                    known.name
                );
                p.add_hint(
                    raw.span(),
                    message,
                    "correct the step, or the range under [variables]",
                );
                continue;
            }
            assigned.push((variable, n));
        }
        (count > 0 && assigned.len() == count).then_some(assigned)
    }
}

/// Reports a variable that is not in its range at the start.
pub(super) fn check_range(
    name: &Spanned<String>,
    initial: f64,
    range: &Key<[f64; 2]>,
    p: &mut Problems<'_>,
) -> Option<()> {
    let Some(range) = range else { return Some(()) };
    let [low, high] = *range.get_ref();
    let (message, hint) = if low > high {
        let message = format!(
            "the range of `{}` ends at {high}, below its start {low}",
            name.get_ref()
        );
        (message, format!("write `range = [{high:?}, {low:?}]`"))
    } else if !(low..=high).contains(&initial) {
        let message = format!(
            "`{}` starts with {initial}, outside its range, {low} to {high}",
            name.get_ref()
        );
        (message, "correct `initial` or `range`".to_owned())
    } else {
        return Some(());
    };
    p.add_hint(range.span(), message, hint);
    None
}

/// Returns the hint for a name that is none of the variables.
pub(super) fn unknown_variable<'v>(
    word: &str,
    names: impl IntoIterator<Item = &'v str> + Clone,
) -> String {
    match names.clone().into_iter().next() {
        None => format!("write `{word} = 0` under [variables]"),
        Some(_) => suggestion(word, names, "variables"),
    }
}
