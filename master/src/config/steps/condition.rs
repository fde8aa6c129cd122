//! Signals, variables and conditions by name.

use toml::Spanned;

use super::ProgramChecker;
use super::number::{check_range, unknown_variable};
use crate::config::fields::{Key, KeyExt};
use crate::config::problem::{Problems, Span, suggestion};
use crate::config::raw::{
    Conditions, NamedValues, RawCondition, RawInput, RawNumber, RawSignal, RawSimulation,
    RawVariable, RawWhen,
};
use crate::config::roles::UsedInput;
use crate::config::signal::{self, SignalDirection};
use crate::config::{
    AxisValue, Bound, Bounds, Condition, InputRef, NamedSignal, NumberPlace, OutputRef, Signal,
    Subject, SwitchedInput, Test, Variable, VariableRef, When,
};

impl ProgramChecker<'_> {
    /// Takes the names of `[signals]`.
    pub(super) fn name_signals(&mut self, raw: NamedValues<String>, p: &mut Problems<'_>) {
        for (name, text) in raw.0 {
            if !self.is_free(&name, p) {
                continue;
            }
            let of = |way| signal::of_text(text.get_ref(), self.devices, way);
            let found = of(SignalDirection::In)
                .or_else(|input| of(SignalDirection::Out).map_err(|output| input.or(output)));
            match found {
                // Of an invalid device, which has been reported, nothing is known.
                Ok(signal) => self.signals.push(NamedSignal {
                    name: name.into_inner(),
                    signal: signal.map_or_else(String::new, |signal| signal.name),
                }),
                Err(error) => p.add_hint(text.span(), error.message, error.hint),
            }
        }
    }

    /// Takes the names of `[variables]`.
    pub(super) fn name_variables(&mut self, raw: NamedValues<RawVariable>, p: &mut Problems<'_>) {
        for (name, variable) in raw.0 {
            let RawVariable { initial, range } = variable.into_inner();
            let free = self.is_free(&name, p);
            if check_range(&name, initial, &range, p).is_some() && free {
                self.variables.push(Variable {
                    name: name.into_inner(),
                    initial,
                    range: range.value(),
                });
            }
        }
    }

    /// Reports a name that something else has.
    fn is_free(&self, name: &Spanned<String>, p: &mut Problems<'_>) -> bool {
        let word = name.get_ref();
        let taken = if self.devices.iter().any(|device| device.name == word) {
            "a device"
        } else if self.axes.iter().any(|axis| axis.name == word) {
            "an axis"
        } else if self.signals.iter().any(|signal| signal.name == *word) {
            "a signal"
        } else {
            return true;
        };
        p.add_hint(
            name.span(),
            format!("`{word}` is the name of {taken} already"),
            "take another name",
        );
        false
    }

    pub(super) fn variable(
        &self,
        name: &Spanned<String>,
        p: &mut Problems<'_>,
    ) -> Option<VariableRef> {
        let word = name.get_ref();
        let found = self.variables.iter().position(|known| known.name == *word);
        if found.is_none() {
            let names = self.variables.iter().map(|known| known.name.as_str());
            let hint = unknown_variable(word, names);
            p.add_hint(name.span(), format!("no variable is named `{word}`"), hint);
        }
        found.map(VariableRef)
    }

    /// Returns the device and the signal of a name of `[signals]`.
    fn signal(&self, raw: &RawSignal, p: &mut Problems<'_>) -> Option<RawSignal> {
        if let Some(device) = &raw.device {
            let named = |name: &str| name == device.get_ref();
            if self.signals.iter().any(|known| named(&known.name))
                || self.variables.iter().any(|known| named(&known.name))
            {
                let bound = raw.name.get_ref();
                let message = format!("`{bound}` is not a bound of `{}`", device.get_ref());
                let hint = suggestion(bound, ["above", "below"], "bounds");
                p.add_hint(raw.name.span(), message, hint);
                return None;
            }
            return Some(raw.clone());
        }
        let (word, span) = (raw.name.get_ref(), raw.name.span());
        let Some(named) = self.signals.iter().find(|signal| signal.name == *word) else {
            if self.devices.iter().any(|device| device.name == word) {
                let hint =
                    format!("write a device and its signal: `{{ {word}.\"Input 1\" = true }}`");
                p.add_hint(span, format!("no signal of `{word}` is named"), hint);
                return None;
            }
            let names = self.signals.iter().map(|signal| signal.name.as_str());
            let hint = match self.signals.is_empty() {
                true => format!("write `{word} = \"io.Input 1\"` under [signals]"),
                false => suggestion(word, names, "signals"),
            };
            p.add_hint(span, format!("no signal is named `{word}`"), hint);
            return None;
        };
        let split = signal::split_device(&named.signal, self.devices)?;
        let (device, signal) = (&named.signal[..split], &named.signal[split + 1..]);
        Some(RawSignal {
            device: Some(Spanned::new(span.clone(), device.to_owned())),
            name: Spanned::new(span, signal.to_owned()),
        })
    }

    /// Returns a condition on an input, for the cycle.
    pub(super) fn condition(
        &mut self,
        raw: &RawCondition,
        p: &mut Problems<'_>,
    ) -> Option<Condition> {
        for bound in [&raw.equal, &raw.above, &raw.below].into_iter().flatten() {
            if let RawNumber::Variable(_) = bound.get_ref() {
                let message = "this condition holds without the program, which has the variables";
                p.add_hint(bound.span(), message, "write a number");
                return None;
            }
        }
        let (input, bounds) = (self.input(raw, p)?, self.bounds(raw, p)?);
        let bounds = bounds.map(|bound| match bound {
            Bound::Number(n) => n,
            Bound::Variable(_) => f64::NAN,
        });
        Some(Condition { input, bounds })
    }

    /// Notes an input of the condition or setting that is being checked.
    pub(super) fn use_input(&mut self, signal: Signal, place: Span) {
        self.used.push(UsedInput {
            usage: self.usage,
            signal,
            place,
        });
    }

    /// Returns the input that a condition tests.
    fn input(&mut self, raw: &RawCondition, p: &mut Problems<'_>) -> Option<InputRef> {
        let signal = self.signal(&raw.signal, p)?;
        let input = signal::resolve(&signal, self.devices, SignalDirection::In, p)?;
        if let Some(equal) = &raw.equal
            && let RawNumber::Fixed(n) = equal.get_ref()
        {
            possible(&input, *n, equal.span(), p)?;
        }
        let place = raw
            .signal
            .device
            .as_ref()
            .unwrap_or(&raw.signal.name)
            .span();
        self.use_input(input.clone(), place);
        Some(InputRef(signal::known(&mut self.inputs, input)))
    }

    /// Returns a condition of a step.
    pub(super) fn when(&mut self, raw: &RawWhen, p: &mut Problems<'_>) -> Option<When> {
        let first = raw.0.iter().flat_map(|Conditions(each)| each).next();
        if let Some(first) = first {
            let name = first.signal.device.as_ref().unwrap_or(&first.signal.name);
            let place = (format!("{}?", self.number), None);
            self.places.borrow_mut().insert(place, name.span());
        }
        let mut alternatives = Vec::with_capacity(raw.0.len());
        for Conditions(each) in &raw.0 {
            let tests: Vec<_> = each.iter().filter_map(|raw| self.test(raw, p)).collect();
            if tests.len() == each.len() && !tests.is_empty() {
                alternatives.push(tests);
            }
        }
        (alternatives.len() == raw.0.len()).then_some(When(alternatives))
    }

    fn test(&mut self, raw: &RawCondition, p: &mut Problems<'_>) -> Option<Test> {
        let name = &raw.signal.name;
        let of = match &raw.signal.device {
            Some(axis) => {
                let value = AxisValue::ALL
                    .iter()
                    .find(|(word, _)| *word == name.get_ref());
                let axis = value.and_then(|_| self.axis_named(axis));
                axis.zip(value)
                    .map(|(axis, (_, value))| Subject::Axis(axis, *value))
            }
            None => {
                let mut all = self.variables.iter();
                let at = all.position(|known| known.name == *name.get_ref());
                at.map(|at| Subject::Variable(VariableRef(at)))
            }
        };
        let Some(of) = of else {
            let of = Subject::Input(self.input(raw, p)?);
            let bounds = self.bounds(raw, p)?;
            return Some(Test { of, bounds });
        };
        if let (Subject::Axis(_, value), Some(equal)) = (of, &raw.equal) {
            let other = |n: &RawNumber| !matches!(n, RawNumber::Fixed(n) if *n == 0.0 || *n == 1.0);
            if value.is_yes_or_no() && other(equal.get_ref()) {
                let axis = raw
                    .signal
                    .device
                    .as_ref()
                    .map_or("x", |axis| axis.get_ref());
                let message = format!("`{}` is true or false", name.get_ref());
                let hint = format!("write `{axis}.{} = true`", name.get_ref());
                p.add_hint(equal.span(), message, hint);
                return None;
            }
            if !value.is_yes_or_no() {
                let hint = "write `{ above = 9.9, below = 10.1 }`";
                p.add_hint(
                    equal.span(),
                    "a measured value is never exactly a number",
                    hint,
                );
                return None;
            }
        }
        let bounds = self.bounds(raw, p)?;
        Some(Test { of, bounds })
    }

    /// Returns the bounds of a condition.
    fn bounds(&mut self, raw: &RawCondition, p: &mut Problems<'_>) -> Option<Bounds<Bound>> {
        let mut bound = |raw: &Key<RawNumber>| match raw {
            None => Some(None),
            Some(raw) => match raw.get_ref() {
                RawNumber::Fixed(n) => Some(Some(Bound::Number(*n))),
                RawNumber::Variable(name) => {
                    let name = Spanned::new(raw.span(), name.clone());
                    Some(Some(Bound::Variable(self.variable(&name, p)?)))
                }
            },
        };
        let found = [&raw.equal, &raw.above, &raw.below].map(&mut bound);
        let [equal, above, below] = found;
        let (equal, above, below) = (equal?, above?, below?);
        if let (Some(low), Some(high), Some(at)) = (above, below, &raw.above)
            && self.ends(low)[0] >= self.ends(high)[1]
        {
            let [low, high] = [low, high].map(|bound| self.bound_text(bound));
            let message = format!("no value is above {low} and below {high}");
            let hint = format!(
                "swap them, or write a list: `[{{ … above = {low} }}, {{ … below = {high} }}]`"
            );
            p.add_hint(at.span(), message, hint);
            return None;
        }
        Some(Bounds {
            equal,
            above,
            below,
        })
    }

    /// Returns the least and the greatest value of a bound.
    pub(super) fn ends(&self, bound: Bound) -> [f64; 2] {
        match bound {
            Bound::Number(n) => [n; 2],
            Bound::Variable(at) => {
                let range = self.variables.get(at.0).and_then(|known| known.range);
                range.unwrap_or([f64::NEG_INFINITY, f64::INFINITY])
            }
        }
    }

    pub(super) fn bound_text(&self, bound: Bound) -> String {
        match bound {
            Bound::Number(n) => n.to_string(),
            Bound::Variable(at) => {
                let name = self.variables.get(at.0).map(|known| known.name.as_str());
                format!("`{}`", name.unwrap_or("?"))
            }
        }
    }

    /// Returns the inputs that the simulated bus switches.
    pub(super) fn switched_inputs(
        &mut self,
        raw: RawSimulation,
        p: &mut Problems<'_>,
    ) -> Vec<SwitchedInput> {
        let mut switched = Vec::new();
        for RawInput {
            at, duration, set, ..
        } in raw.inputs
        {
            for (signal, value) in set.0 {
                let input = self.signal(&signal, p).and_then(|signal| {
                    signal::resolve(&signal, self.devices, SignalDirection::In, p)
                });
                let Some(input) = input else { continue };
                let RawNumber::Fixed(n) = *value.get_ref() else {
                    let message = "the simulated bus knows no variables of the program";
                    p.add_hint(value.span(), message, "write a number, true or false");
                    continue;
                };
                if possible(&input, n, value.span(), p).is_none() {
                    continue;
                }
                let device = self.devices[input.device].device;
                if device.is_some_and(|device| device.selection.mode.is_some()) {
                    let message = format!(
                        "`{}` is an input of a drive, which the drive sets",
                        input.name
                    );
                    p.add_hint(signal.name.span(), message, "switch inputs of I/O devices");
                    continue;
                }
                switched.push(SwitchedInput {
                    at_ns: at.value().unwrap_or(0),
                    for_ns: duration.value(),
                    input,
                    value: n,
                });
            }
        }
        switched
    }

    /// Returns an output of `set`, the one at this place, with its value.
    pub(super) fn output(
        &mut self,
        place: usize,
        raw: &RawSignal,
        value: &Spanned<RawNumber>,
        p: &mut Problems<'_>,
    ) -> Option<(OutputRef, f64)> {
        let signal = self.signal(raw, p)?;
        let output = signal::resolve(&signal, self.devices, SignalDirection::Out, p)?;
        let number = self.number(value, NumberPlace::Output(place), p)?;
        let is_fixed = matches!(value.get_ref(), RawNumber::Fixed(_));
        for end in number.ends {
            // A whole number of a variable is rounded when the step runs.
            let end = if is_fixed { end } else { end.round() };
            possible(&output, end, value.span(), p)?;
        }
        let index = signal::known(&mut self.outputs, output);
        if self.output_places.len() < self.outputs.len() {
            self.output_places.push(raw.name.span());
        }
        Some((OutputRef(index), number.value))
    }
}

/// Checks that the signal's bits can hold the value.
fn possible(signal: &Signal, n: f64, at: Span, p: &mut Problems<'_>) -> Option<()> {
    let (low, high, whole) = signal.range();
    if (low..=high).contains(&n) && (!whole || n.fract() == 0.0) {
        return Some(());
    }
    let message = format!("{n} is not a value of `{}`", signal.name);
    let hint = if high == 1.0 {
        "it is one bit: true or false".to_owned()
    } else if whole {
        format!("it has {} bits: {low} to {high}", signal.field.bit_len)
    } else {
        "it is a floating-point number of 32 bits".to_owned()
    };
    p.add_hint(at, message, hint);
    None
}
