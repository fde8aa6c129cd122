//! `[override]`, and the step `override`.

use ecaxis_axis::MAX_RATE;
use ecaxis_ecat::index::GroupIndex;
use toml::Spanned;

use super::ProgramChecker;
use crate::config::fields::KeyExt;
use crate::config::problem::{Problems, suggestion};
use crate::config::raw::{Named, RawOverride};
use crate::config::roles::InputUse;
use crate::config::signal::{self, SignalDirection};
use crate::config::{Action, InputRef, Machine, OverrideConfig, OverrideInput};
use crate::text::percent;

/// The word for the whole machine in a step `override`.
const MACHINE: &str = "machine";

impl ProgramChecker<'_> {
    /// Returns the settings of the override. Mistakes are reported and replaced by defaults.
    pub(super) fn overrides(&mut self, raw: &RawOverride, p: &mut Problems<'_>) -> OverrideConfig {
        self.usage = InputUse::Hold;
        let conditions = raw.hold.iter().flat_map(|conditions| &conditions.0);
        let hold = conditions.filter_map(|raw| self.condition(raw, p));
        let hold = hold.collect();
        let initial = raw.initial.as_ref();
        let initial = initial.and_then(|value| factor(value, 0.0, p));
        OverrideConfig {
            initial: initial.unwrap_or(1.0),
            hold,
            input: self.override_input(raw, p),
        }
    }

    fn override_input(&mut self, raw: &RawOverride, p: &mut Problems<'_>) -> Option<OverrideInput> {
        let Some(text) = &raw.input else {
            let alone = [&raw.zero, &raw.full];
            for value in alone.into_iter().flatten() {
                p.add_hint(
                    value.span(),
                    "no input is named",
                    "write `input = \"io.Channel 1\"`",
                );
            }
            return None;
        };
        let named = self.signals.iter().find(|s| s.name == *text.get_ref());
        let word = named.map_or_else(|| text.get_ref().clone(), |named| named.signal.clone());
        let input = match signal::of_text(&word, self.devices, SignalDirection::In) {
            Ok(input) => input?,
            Err(error) => {
                p.add_hint(text.span(), error.message, error.hint);
                return None;
            }
        };
        let zero = raw.zero.value().unwrap_or(0.0);
        let Some(full) = &raw.full else {
            let hint = "write the value of the input at 100 %: `full = 32767`";
            p.add_hint(text.span(), "`full` is missing", hint);
            return None;
        };
        if zero == *full.get_ref() {
            p.add(full.span(), "`zero` and `full` are the same value");
            return None;
        }
        self.usage = InputUse::Override;
        self.use_input(input.clone(), text.span());
        Some(OverrideInput {
            input: InputRef(signal::known(&mut self.inputs, input)),
            zero,
            full: *full.get_ref(),
        })
    }

    pub(super) fn override_step(&self, values: Named<f64>, p: &mut Problems<'_>) -> Option<Action> {
        let count = values.len();
        let mut resolved = Vec::with_capacity(count);
        for (name, value) in values {
            let word = name.get_ref();
            let group = match self.groups.iter().position(|group| group == word) {
                Some(index) => Some(GroupIndex(index + 1)),
                None => (word == MACHINE).then_some(GroupIndex::MACHINE),
            };
            let Some(group) = group else {
                let names = self.groups.iter().map(String::as_str).chain([MACHINE]);
                let hint = suggestion(word, names, "groups");
                p.add_hint(name.span(), format!("no group is named `{word}`"), hint);
                continue;
            };
            // The program would wait for ever at its next motion.
            resolved.push((group, factor(&value, 1.0, p)?));
        }
        (count > 0 && resolved.len() == count).then_some(Action::Override(resolved))
    }
}

impl Machine {
    pub(in crate::config) fn describe_overrides(&self, values: &[(GroupIndex, f64)]) -> String {
        let each = values.iter().map(|&(group, factor)| {
            let of = match self.group_name(group) {
                "" => String::new(),
                name => format!(" of {name}"),
            };
            format!("override{of} {} %", percent(factor))
        });
        each.collect::<Vec<_>>().join(", ")
    }
}

/// Returns a factor from percent.
fn factor(percent: &Spanned<f64>, lowest: f64, p: &mut Problems<'_>) -> Option<f64> {
    let most = MAX_RATE * 100.0;
    let value = *percent.get_ref();
    // Written so that NaN is rejected, too.
    if (lowest..=most).contains(&value) {
        return Some((value / 100.0).min(MAX_RATE));
    }
    let message = format!("{value} % is not an override between {lowest} % and {most} %");
    p.add(percent.span(), message);
    None
}
