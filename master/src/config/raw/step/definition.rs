//! The JSON schema of a step.

use serde_json::{Map, Value as Json, json};

use super::super::super::fields::{Domain, Ns};
use super::super::super::schema::{self, Schema, any_of, described, named};
use super::super::condition::{Levels, RawWhen};
use super::super::number::RawNumber;
use super::{
    ARRIVALS, COMPANIONS, FOREVER, MOST_BRANCHES, NONE, RawGear, RawProbe, RawStep, RawWave,
    TIMEOUTS, VERBS,
};

impl Schema for RawStep {
    fn schema() -> Json {
        schema::definition("step")
    }
}

impl RawStep {
    /// Returns the schema of a step: one verb, and the keys that go with it.
    pub fn definition() -> Json {
        let verbs = VERBS.map(|(verb, example, _)| {
            let text = format!("`{example}`");
            (verb.to_owned(), described(argument(verb), &text))
        });
        let companions =
            COMPANIONS.map(|(key, text)| (key.to_owned(), described(companion(key), text)));
        let with = |(key, _): &(&str, &str)| {
            let goes = VERBS.iter().filter(|(.., keys)| keys.contains(key));
            let any = goes.map(|(verb, ..)| match *key {
                "ramp" if *verb == "torque" => typed(verb, key, Ns::schema()),
                "ramp" => typed(verb, key, RawNumber::<f64>::schema()),
                _ => json!({ "required": [verb] }),
            });
            (
                (*key).to_owned(),
                json!({ "anyOf": any.collect::<Vec<_>>() }),
            )
        };
        json!({
            "type": "object",
            "properties": Map::from_iter(verbs.into_iter().chain(companions)),
            "additionalProperties": false,
            "oneOf": VERBS.map(|(verb, ..)| json!({ "required": [verb] })).to_vec(),
            "dependencies": Map::from_iter(COMPANIONS.iter().map(with)),
        })
    }
}

/// Returns the schema of a step with this verb, in which a key has a type.
fn typed(verb: &str, key: &str, schema: Json) -> Json {
    json!({ "required": [verb], "properties": { key: schema } })
}

/// Returns the schema of a verb's argument.
fn argument(verb: &str) -> Json {
    let only = |schema: Json| {
        let mut schema = named(schema);
        schema["maxProperties"] = 1.into();
        schema
    };
    match verb {
        "enable" | "disable" | "reset" | "stop" | "home" | "couple" | "decouple" => any_of([
            json!({ "enum": [true] }),
            String::schema(),
            json!({ "type": "array", "items": { "type": "string" }, "minItems": 1 }),
        ]),
        "move" | "move_by" | "line" | "line_by" | "phase" | "superimpose" | "velocity"
        | "torque" => named(RawNumber::<f64>::schema()),
        "sine" | "square" => only(RawWave::schema()),
        "probe" => {
            let mut probe = RawProbe::schema();
            probe["oneOf"] = json!([{ "required": ["to"] }, { "required": ["by"] }]);
            only(probe)
        }
        "gear" => only(RawGear::schema()),
        "table" | "mode" => named(String::schema()),
        "dwell" => RawNumber::<Ns>::schema(),
        "wait" | "while" | "if" => RawWhen::schema(),
        "set" => Levels::schema(),
        "override" => any_of([f64::schema(), named(f64::schema())]),
        "let" | "add" => named(RawNumber::<f64>::schema()),
        "message" | "alarm" | "call" | "path" => String::schema(),
        "parallel" => json!({
            "type": "array", "minItems": 2, "maxItems": MOST_BRANCHES,
            "items": {
                "type": "object", "properties": {
                    "step": described(Vec::<RawStep>::schema(), "The steps of the branch"),
                },
                "required": ["step"], "additionalProperties": false,
            },
        }),
        _ => any_of([schema::integer(1, 1_000_000), json!({ "enum": [FOREVER] })]),
    }
}

/// Returns the schema of a key that goes with a verb.
fn companion(key: &str) -> Json {
    match key {
        "speed" => RawNumber::<f64>::schema(),
        "ramp" => any_of([RawNumber::<f64>::schema(), Ns::schema()]),
        "with" => named(any_of([f64::schema(), String::schema(), bool::schema()])),
        "arrive" => ARRIVALS.schema(),
        "timeout" => any_of([TIMEOUTS.schema(), json!({ "enum": [NONE] })]),
        "until" => RawWhen::schema(),
        _ => Vec::<RawStep>::schema(),
    }
}
